// Moves a pose by mouse, touch and keys. Input is stored as pending motion, which is applied within a
// fraction of a second, so that motion is smooth on any device.
import { MathUtils, Vector3 } from 'three';

const SETTLE = 0.06; // seconds: time constant of the pending motion
const UP = new Vector3(0, 1, 0);
const STEEPEST = MathUtils.degToRad(86);
const NEAREST = 0.02; // distance to the pivot
const WHEEL = 0.0015; // fraction of the distance for each pixel of scrolling
const KEY_SPEED = 0.8; // distances to the pivot per second
const KEY_TURN = 1.2; // radians per second
const FASTER = 4; // with Shift
const LEVELLING = 3; // rate at which the horizon becomes level, per radian of rotation

const MOVES = {
  KeyW: ['ahead', 1], KeyS: ['ahead', -1], KeyD: ['right', 1], KeyA: ['right', -1],
  KeyE: ['up', 1], KeyQ: ['up', -1],
  ArrowLeft: ['yaw', 1], ArrowRight: ['yaw', -1], ArrowUp: ['pitch', 1], ArrowDown: ['pitch', -1],
}; // prettier-ignore

export class Controls {
  mode = 'orbit'; // or 'fly', which rotates about the camera itself
  #pending = { yaw: 0, pitch: 0, right: 0, up: 0, ahead: 0, zoom: 0 };
  #keys = new Set();
  #pointers = new Map();

  /** Listens to a canvas, and calls onInput whenever the user moves the camera. */
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

  /** Discards the pending motion. */
  stop() {
    for (const name in this.#pending) this.#pending[name] = 0;
  }

  /** Applies the pending motion of some seconds to a pose. Returns whether the pose moved. */
  advance(pose, seconds) {
    this.#holdKeys(seconds);
    const fraction = 1 - Math.exp(-seconds / SETTLE);
    const applied = {};
    let moved = false;
    for (const [name, value] of Object.entries(this.#pending)) {
      applied[name] = Math.abs(value) < 1e-5 ? value : value * fraction;
      this.#pending[name] -= applied[name];
      moved ||= applied[name] !== 0;
    }
    if (moved) this.#apply(pose, applied);
    return moved;
  }

  #apply(pose, { yaw, pitch, right, up, ahead, zoom }) {
    const orbit = this.mode === 'orbit';
    const point = orbit ? pose.pivot : pose.position.clone();
    const sign = orbit ? -1 : 1; // the dragged object follows the pointer
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

  /** Rotates the pose by a fraction towards a level horizon. Straight up and down have no horizon. */
  #level(pose, fraction) {
    const forward = pose.forward;
    const horizontal = new Vector3().crossVectors(forward, UP);
    if (horizontal.length() < 0.05) return;
    const right = pose.right;
    const sine = new Vector3().crossVectors(horizontal.normalize(), right).dot(forward);
    pose.turn(pose.position.clone(), forward, -fraction * Math.atan2(sine, horizontal.dot(right)));
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
      this.#pending.zoom += Math.log(this.#spread() / before);
    } else if (event.buttons & 6 || event.shiftKey) {
      this.#pan(dx / height, dy / height);
    } else {
      const radians = (this.mode === 'orbit' ? Math.PI : 1.2) / height;
      this.#pending.yaw += dx * radians;
      this.#pending.pitch += dy * radians;
    }
    this.onInput();
  }

  /** Moves sideways, by fractions of the window's height. */
  #pan(dx, dy) {
    this.#pending.right -= dx;
    this.#pending.up += dy;
  }

  /** Returns the distance between two fingers, pixels; 1 for one finger. */
  #spread() {
    const [a, b] = this.#pointers.values();
    return b ? Math.max(Math.hypot(a.x - b.x, a.y - b.y), 1) : 1;
  }

  #wheel(event) {
    event.preventDefault();
    const pixels = event.deltaY * [1, 16, 400][event.deltaMode];
    this.#pending.zoom -= MathUtils.clamp(pixels * WHEEL * (event.ctrlKey ? 5 : 1), -0.5, 0.5);
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
      this.#pending[name] += sign * rate * seconds;
    }
  }
}
