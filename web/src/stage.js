// The scene on a canvas, rendered by three.js and Spark.
import { SparkRenderer } from '@sparkjsdev/spark';
import { Color, Group, PerspectiveCamera, Quaternion, Scene, SRGBColorSpace, Vector3, WebGLRenderer } from 'three';
import { Animation } from './animation.js';
import { Parts } from './parts.js';
import { project } from './pose.js';

const FAR = 1e5; // only for clipping: splats are sorted, not depth-tested
const SHARPEST = 2; // most device pixels per CSS pixel
export const QUALITIES = { high: 1, medium: 0.7, low: 0.45 }; // fraction of the device's pixels along each axis
const SLOW = 45; // milliseconds a frame, above which "auto" lowers the resolution while the view moves
// Size in pixels below which splats are merged: usually, and while the view moves and frames are slow.
const FINE = 0.3;
const COARSE = 2;
const MARGIN = 20; // degrees around the picture in which splats stay detailed, for turns
const HEADSET = [110, 130]; // degrees in which splats have full detail, and from which they have the least

export class Stage {
  quality = 'auto';
  settled = false; // whether the frame is final for the last pose
  opened = false; // whether a frame with splats has been drawn
  #reduced = 1; // current fraction of pixels of "auto", along each axis
  #frames = [];
  #drawn = '';
  #size = '';
  #fence = null; // signalled when the device has drawn the last frame
  #filled = false; // whether the last frame has splats
  #began = 0;

  constructor(canvas, { background, lowPass, byDistance, near, motion }) {
    this.near = near;
    this.motion = motion; // of the splats; null if they stay
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: 'high-performance' });
    this.scene = new Scene();
    this.scene.background = new Color().setRGB(...background, SRGBColorSpace);
    this.camera = new PerspectiveCamera();
    this.camera.matrixWorldAutoUpdate = false;
    // The same as in splatax: sorted by distance or depth, footprints of any size down to 1/255, 32-bit positions.
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      preBlurAmount: lowPass.dilation,
      blurAmount: lowPass.antialiasing,
      sortRadial: byDistance,
      maxStdDev: Math.sqrt(2 * Math.log(255)),
      minAlpha: 1 / 255,
      maxPixelRadius: 1e4,
      accumExtSplats: true,
      covSplats: Boolean(motion), // blended bones shear the splats
      enableLod: false, // until `refine`
      lodRaycast: 0,
      onDirty: () => (this.dirty = true),
    });
    this.scene.add(this.spark);
    this.parts = new Parts(this.scene, this.spark);
  }

  /** Loads the parts, or the previews of those that have one. `open` returns the bytes of a file. */
  async load(parts, open) {
    await this.parts.load(parts, open);
    if (this.motion) this.animation = new Animation((part) => this.parts.mesh(part), this.motion);
    this.dirty = true;
  }

  /** Replaces previews by whole files, of which Spark draws what the view needs. */
  async refine(parts, open) {
    await this.parts.refine(parts, open);
    this.spark.enableLod = this.spark.enableDriveLod = parts.some(({ preview }) => preview);
    this.dirty = true;
  }

  /** Shows or hides a part, and maps its colours by three rows of four numbers; null keeps them. */
  change(index, visible, rows) {
    if (!this.parts.change(index, visible, rows)) return;
    this.#drawn = ''; // also if the view has not changed
    this.dirty = true;
  }

  /**
   * Draws a frame if the pose, the window or Spark's order of splats has changed. While the device is
   * still busy with the last frame, nothing is drawn, so that input never lags behind.
   */
  draw(pose, moving) {
    if (this.renderer.xr.isPresenting) return; // the headset draws at its own pace
    const { clientWidth: width, clientHeight: height } = this.renderer.domElement;
    const ratio = this.#pixelRatio(moving);
    const state = JSON.stringify([width, height, ratio, moving, pose, this.animation?.time]);
    const changed = state !== this.#drawn;
    if (this.parts.swap()) {
      this.dirty = true;
      this.#reduced = 1; // frames were slow while the whole scene was read
      this.#frames = [];
    }
    this.settled = !changed && !moving && !this.dirty && !this.#busy(moving) && this.#sorted();
    if (!(changed || this.dirty) || !width || !height || this.#busy(moving)) return;
    this.#resize(width, height, ratio);
    this.#place(pose, width / height);
    this.spark.lodRenderScale = moving && this.quality === 'auto' && this.#reduced < 1 ? COARSE : FINE;
    this.dirty = false;
    this.#drawn = state;
    if (!moving && changed) this.spark.update(this); // sorts even after the smallest turn
    this.renderer.render(this.scene, this.camera);
    this.#filled = this.spark.activeSplats > 0;
    const gl = this.renderer.getContext();
    this.#fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
    this.#began = performance.now();
    gl.flush();
  }

  /** Shows the scene in a headset, level and from the pose's position, until the session ends. */
  async enter(session, pose) {
    const { renderer, scene, near } = this;
    const camera = new PerspectiveCamera(50, 1, near, FAR);
    const floor = new Group(); // where the headset's own space begins
    const ahead = pose.forward;
    floor.position.copy(pose.position);
    floor.quaternion.copy(new Quaternion().setFromAxisAngle(new Vector3(0, 1, 0), Math.atan2(-ahead.x, -ahead.z)));
    floor.add(camera);
    scene.add(floor);
    session.addEventListener('end', () => {
      renderer.setAnimationLoop(null);
      renderer.xr.enabled = false;
      scene.remove(floor);
      this.#size = this.#drawn = ''; // the canvas has another size now
      this.dirty = true;
    });
    this.spark.lodRenderScale = FINE;
    [this.spark.coneFov0, this.spark.coneFov] = HEADSET;
    renderer.xr.enabled = true;
    renderer.xr.setReferenceSpaceType('local'); // begins at the eyes
    await renderer.xr.setSession(session);
    renderer.setAnimationLoop(() => {
      this.parts.swap();
      renderer.render(scene, camera);
    });
  }

  /** Returns whether the device is still drawing the last frame. */
  #busy(moving) {
    if (!this.#fence) return false;
    const gl = this.renderer.getContext();
    if (gl.getSyncParameter(this.#fence, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
    gl.deleteSync(this.#fence);
    this.#fence = null;
    this.opened ||= this.#filled;
    if (moving) this.#judge(performance.now() - this.#began);
    return false;
  }

  #sorted() {
    return !this.spark.sorting && !this.spark.sortDirty && this.spark.activeSplats > 0;
  }

  /** Whether the whole scene has been loaded, and Spark has chosen its level of detail for the last pose. */
  get complete() {
    return this.parts.whole && !this.spark.lodDirty && this.spark.lastLod === this.spark.currentLod;
  }

  #resize(width, height, ratio) {
    const size = `${width} ${height} ${ratio}`;
    if (size === this.#size) return;
    this.#size = size;
    this.renderer.setPixelRatio(ratio);
    this.renderer.setSize(width, height, false);
  }

  #place(pose, aspect) {
    const { camera } = this;
    camera.position.copy(pose.position);
    camera.quaternion.copy(pose.quaternion);
    camera.updateMatrix();
    camera.matrixWorld.copy(camera.matrix);
    camera.matrixWorldInverse.copy(camera.matrixWorld).invert();
    camera.near = this.near;
    camera.far = FAR;
    project(camera.projectionMatrix, pose.lens, aspect, this.near, FAR);
    this.#look(camera.projectionMatrix.elements);
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }

  /** Tells Spark the angles of view. Splats in the picture, and in a margin around it, keep full detail. */
  #look([x, , , , , y]) {
    const degrees = (tangent) => (360 / Math.PI) * Math.atan(tangent);
    this.camera.fov = degrees(1 / y);
    this.spark.coneFov0 = degrees(Math.hypot(1 / x, 1 / y)) + MARGIN;
    this.spark.coneFov = this.spark.coneFov0 + MARGIN;
  }

  #pixelRatio(moving) {
    const fraction = this.quality === 'auto' ? (moving ? this.#reduced : 1) : QUALITIES[this.quality];
    return Math.min(devicePixelRatio, SHARPEST) * fraction;
  }

  /** Lowers resolution and detail if frames take too long. */
  #judge(milliseconds) {
    this.#frames.push(milliseconds);
    if (this.#frames.length < 12) return;
    const median = this.#frames.sort((a, b) => a - b)[6];
    this.#frames = [];
    if (median > SLOW) this.#reduced = Math.max(this.#reduced * 0.7, QUALITIES.low);
  }
}
