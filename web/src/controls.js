// Mouse, touch and keys -> motion of a pose. All input is kept as a debt that is paid off within a
// fraction of a second, so that motion is smooth on any device.
import { MathUtils, Vector3 } from 'three';

const SETTLE = 0.06; // seconds
const UP = new Vector3(0, 1, 0);
const STEEPEST = MathUtils.degToRad(86);
const NEAREST = 0.02; // distance to the pivot
const WHEEL = 0.0015; // of the distance, for each pixel of scrolling
const KEY_SPEED = 0.8; // distances to the pivot a second
const KEY_TURN = 1.2; // radians a second
const FASTER = 4; // with Shift
const LEVELLING = 3; // how soon the horizon becomes level, per radian turned

const MOVES = {
  KeyW: ['ahead', 1], KeyS: ['ahead', -1], KeyD: ['right', 1], KeyA: ['right', -1],
  KeyE: ['up', 1], KeyQ: ['up', -1],
  ArrowLeft: ['yaw', 1], ArrowRight: ['yaw', -1], ArrowUp: ['pitch', 1], ArrowDown: ['pitch', -1],
}; // prettier-ignore

export class Controls {
  mode = 'orbit'; // or 'fly': turns where it stands
  #owed = { yaw: 0, pitch: 0, right: 0, up: 0, ahead: 0, zoom: 0 };
  #keys = new Set();
  #pointers = new Map();

  /** onInput is called when the user takes over. */
  constructor(canvas, onInput) {
    this.canvas = canvas;
    this.onInput = onInput;
    canvas.addEventListener('pointerdown', (event) => this.#press(event));
    canvas.addEventListener('pointermove', (event) => this.#drag(event));
    for (const name of ['pointerup', 'pointercancel', 'lostpointercapture']) {
      canvas.addEventListener(name, (event) => this.#pointers.delete(event.pointerId));
    }
    canvas.addEventListener('wheel', (event) => this.#wheel(event), { passive: false });
    canvas.addEventListener('contextmenu', (event) => event.preventDefault());
    addEventListener('keydown', (event) => this.#key(event));
    addEventListener('keyup', (event) => this.#keys.delete(event.code));
    addEventListener('blur', () => this.#keys.clear());
  }

  /** Forgets motion that is under way. */
  stop() {
    for (const name in this.#owed) this.#owed[name] = 0;
  }

  /** Moves a pose by what is owed for some seconds. Returns whether it moved. */
  advance(pose, seconds) {
    this.#holdKeys(seconds);
    const share = 1 - Math.exp(-seconds / SETTLE);
    const paid = {};
    let moved = false;
    for (const [name, value] of Object.entries(this.#owed)) {
      paid[name] = Math.abs(value) < 1e-5 ? value : value * share;
      this.#owed[name] -= paid[name];
      moved ||= paid[name] !== 0;
    }
    if (moved) this.#apply(pose, paid);
    return moved;
  }

  #apply(pose, { yaw, pitch, right, up, ahead, zoom }) {
    const orbit = this.mode === 'orbit';
    const point = orbit ? pose.pivot : pose.position.clone();
    const sign = orbit ? -1 : 1; // what is dragged follows the pointer
    pose.turn(point, UP, sign * yaw);
    const elevation = Math.asin(MathUtils.clamp(pose.forward.y, -1, 1));
    const steepest = Math.max(STEEPEST, Math.abs(elevation));
    pose.turn(point, pose.right, MathUtils.clamp(elevation + sign * pitch, -steepest, steepest) - elevation);
    this.#level(pose, 1 - Math.exp(-LEVELLING * (Math.abs(yaw) + Math.abs(pitch))));

    const step = new Vector3();
    step.addScaledVector(pose.right, right).addScaledVector(pose.up, up).addScaledVector(pose.forward, ahead);
    pose.position.addScaledVector(step, pose.focus);
    const pivot = pose.pivot;
    if (orbit) {
      pose.focus = Math.max(pose.focus * Math.exp(-zoom), NEAREST);
      pose.position.copy(pivot).addScaledVector(pose.forward, -pose.focus);
    } else {
      pose.position.addScaledVector(pose.forward, zoom * pose.focus);
    }
  }

  /** Turns the horizon towards level. Looking straight up or down there is none. */
  #level(pose, share) {
    const forward = pose.forward;
    const horizontal = new Vector3().crossVectors(forward, UP);
    if (horizontal.length() < 0.05) return;
    const right = pose.right;
    const sine = new Vector3().crossVectors(horizontal.normalize(), right).dot(forward);
    pose.turn(pose.position.clone(), forward, -share * Math.atan2(sine, horizontal.dot(right)));
  }

  #press(event) {
    this.canvas.setPointerCapture(event.pointerId);
    this.#pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
    this.canvas.focus({ preventScroll: true });
    this.onInput();
  }

  #drag(event) {
    const last = this.#pointers.get(event.pointerId);
    if (!last) return;
    const before = this.#spread();
    const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
    Object.assign(last, { x: event.clientX, y: event.clientY });
    const height = this.canvas.clientHeight;
    if (this.#pointers.size > 1) {
      this.#pan(dx / this.#pointers.size / height, dy / this.#pointers.size / height);
      this.#owed.zoom += Math.log(this.#spread() / before);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.#pan(dx / height, dy / height);
    } else {
      const radians = (this.mode === 'orbit' ? Math.PI : 1.2) / height;
      this.#owed.yaw += dx * radians;
      this.#owed.pitch += dy * radians;
    }
    this.onInput();
  }

  /** By fractions of the window's height. */
  #pan(dx, dy) {
    this.#owed.right -= dx;
    this.#owed.up += dy;
  }

  /** Distance between two fingers. */
  #spread() {
    const [a, b] = this.#pointers.values();
    return b ? Math.max(Math.hypot(a.x - b.x, a.y - b.y), 1) : 1;
  }

  #wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * [1, 16, 400][event.deltaMode];
    this.#owed.zoom -= MathUtils.clamp(pixels * WHEEL * (event.ctrlKey ? 5 : 1), -0.5, 0.5);
    this.onInput();
  }

  #key(event) {
    const typing = event.target instanceof HTMLElement && event.target.closest('select, input, dialog');
    if (!MOVES[event.code] || typing || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    this.#keys.add(event.code);
    this.shift = event.shiftKey;
    this.onInput();
  }

  #holdKeys(seconds) {
    for (const code of this.#keys) {
      const [name, sign] = MOVES[code];
      const turns = name === 'yaw' || name === 'pitch';
      const rate = turns ? KEY_TURN * (this.mode === 'orbit' ? -1 : 1) : KEY_SPEED * (this.shift ? FASTER : 1);
      this.#owed[name] += sign * rate * seconds;
    }
  }
}
