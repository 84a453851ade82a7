// The scene on a canvas, rendered by three.js and Spark.
import { SparkRenderer, SplatMesh } from '@sparkjsdev/spark';
import { Color, Group, PerspectiveCamera, Quaternion, Scene, SRGBColorSpace, Vector3, WebGLRenderer } from 'three';
import { Animation } from './animation.js';
import { ColorMap } from './colors.js';
import { project } from './pose.js';

const FAR = 1e5; // only for clipping: splats are sorted, not depth-tested
const SHARPEST = 2; // most device pixels per CSS pixel
export const QUALITIES = { high: 1, medium: 0.7, low: 0.45 }; // fraction of the device's pixels along each axis
const SLOW = 45; // milliseconds a frame, above which "auto" lowers the resolution while the view moves

export class Stage {
  quality = 'auto';
  settled = false; // whether the frame is final for the last pose
  #parts = [];
  #reduced = 1; // current fraction of pixels of "auto", along each axis
  #frames = [];
  #drawn = '';
  #size = '';
  #fence = null; // signalled when the device has drawn the last frame
  #began = 0;

  constructor(canvas, { background, lowPass, near, motion }) {
    this.near = near;
    this.motion = motion; // of the splats; null if they stay
    this.renderer = new WebGLRenderer({ canvas, antialias: false, powerPreference: 'high-performance' });
    this.scene = new Scene();
    this.scene.background = new Color().setRGB(...background, SRGBColorSpace);
    this.camera = new PerspectiveCamera();
    this.camera.matrixWorldAutoUpdate = false;
    // The same as in splatax: sorted by depth, footprints of any size down to 1/255, 32-bit positions.
    this.spark = new SparkRenderer({
      renderer: this.renderer,
      preBlurAmount: lowPass.dilation,
      blurAmount: lowPass.antialiasing,
      sortRadial: false,
      maxStdDev: Math.sqrt(2 * Math.log(255)),
      minAlpha: 1 / 255,
      maxPixelRadius: 1e4,
      accumExtSplats: true,
      covSplats: Boolean(motion), // blended bones shear the splats
      enableLod: false,
      onDirty: () => (this.dirty = true),
    });
    this.scene.add(this.spark);
  }

  /** Loads the SPZ files of parts, each once, and places the parts. `open` returns the bytes of a file. */
  async load(parts, open) {
    const files = {};
    for (const { file, position, quaternion, scale } of parts) {
      const source = files[file] ? { extSplats: files[file] } : { fileBytes: await open(file), fileType: 'spz', extSplats: true };
      const color = new ColorMap();
      const covSplats = Boolean(this.motion);
      const mesh = new SplatMesh({ ...source, covSplats, objectModifier: color.modifier, lod: false, raycastable: false });
      await mesh.initialized;
      files[file] ??= mesh.extSplats;
      mesh.position.set(...position);
      mesh.quaternion.set(...quaternion);
      mesh.scale.setScalar(scale);
      if (this.motion) this.animation = new Animation(mesh, this.motion);
      this.scene.add(mesh);
      this.#parts.push({ mesh, color });
    }
    this.dirty = true;
  }

  /** Shows or hides a part, and maps its colours by three rows of four numbers; null keeps them. */
  change(index, visible, rows) {
    const { mesh, color } = this.#parts[index];
    const recolored = color.set(rows);
    if (mesh.visible === visible && !recolored) return;
    mesh.visible = visible;
    mesh.updateVersion();
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
    this.settled = !changed && !moving && !this.dirty && !this.#busy(moving) && this.#sorted();
    if (!(changed || this.dirty) || !width || !height || this.#busy(moving)) return;
    this.#resize(width, height, ratio);
    this.#place(pose, width / height);
    this.dirty = false;
    this.#drawn = state;
    if (!moving && changed) this.spark.update(this); // sorts even after the smallest turn
    this.renderer.render(this.scene, this.camera);
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
    renderer.xr.enabled = true;
    renderer.xr.setReferenceSpaceType('local'); // begins at the eyes
    await renderer.xr.setSession(session);
    renderer.setAnimationLoop(() => renderer.render(scene, camera));
  }

  /** Returns whether the device is still drawing the last frame. */
  #busy(moving) {
    if (!this.#fence) return false;
    const gl = this.renderer.getContext();
    if (gl.getSyncParameter(this.#fence, gl.SYNC_STATUS) !== gl.SIGNALED) return true;
    gl.deleteSync(this.#fence);
    this.#fence = null;
    if (moving) this.#judge(performance.now() - this.#began);
    return false;
  }

  #sorted() {
    return !this.spark.sorting && !this.spark.sortDirty && this.spark.activeSplats > 0;
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
    camera.projectionMatrixInverse.copy(camera.projectionMatrix).invert();
  }

  #pixelRatio(moving) {
    const fraction = this.quality === 'auto' ? (moving ? this.#reduced : 1) : QUALITIES[this.quality];
    return Math.min(devicePixelRatio, SHARPEST) * fraction;
  }

  /** Lowers the resolution if frames take too long. */
  #judge(milliseconds) {
    this.#frames.push(milliseconds);
    if (this.#frames.length < 12) return;
    const median = this.#frames.sort((a, b) => a - b)[6];
    this.#frames = [];
    if (median > SLOW) this.#reduced = Math.max(this.#reduced * 0.7, QUALITIES.low);
  }
}
