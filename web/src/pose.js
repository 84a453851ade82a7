// Poses of the viewer's camera: position, rotation, lens and pivot.
import { MathUtils, Quaternion, Vector3 } from 'three';

const MOST_CROPPED = 1.6; // largest factor by which a window of another shape crops the photo
const LENS = ['aspect', 'fx', 'fy', 'sx', 'sy'];

/**
 * A pose in three.js's axes: x right, y up, looking along -z.
 *
 * lens: of the photo, in units of half its width and height: focal lengths fx, fy, and the shift of the
 * principal point sx, sy; and the aspect, width / height.
 * focus: distance to the pivot, which the camera orbits.
 */
export class Pose {
  constructor(position, quaternion, lens, focus) {
    Object.assign(this, { position, quaternion, lens, focus });
  }

  static of({ position, quaternion, lens, focus }) {
    return new Pose(new Vector3(...position), new Quaternion(...quaternion), { ...lens }, focus);
  }

  clone() {
    return new Pose(this.position.clone(), this.quaternion.clone(), { ...this.lens }, this.focus);
  }

  get forward() {
    return new Vector3(0, 0, -1).applyQuaternion(this.quaternion);
  }

  get right() {
    return new Vector3(1, 0, 0).applyQuaternion(this.quaternion);
  }

  get up() {
    return new Vector3(0, 1, 0).applyQuaternion(this.quaternion);
  }

  get pivot() {
    return this.forward.multiplyScalar(this.focus).add(this.position);
  }

  /** Rotates about an axis through a point. */
  turn(point, axis, angle) {
    const turn = new Quaternion().setFromAxisAngle(axis, angle);
    this.position.sub(point).applyQuaternion(turn).add(point);
    this.quaternion.premultiply(turn).normalize();
  }
}

/** Returns the weighted mean of poses that are close to each other; weights sum to one. */
export function blend(poses, weights) {
  const position = new Vector3();
  const sum = [0, 0, 0, 0];
  const lens = Object.fromEntries(LENS.map((name) => [name, 0]));
  let focus = 0;
  poses.forEach((pose, i) => {
    const weight = weights[i];
    position.addScaledVector(pose.position, weight);
    const sign = pose.quaternion.dot(poses[0].quaternion) < 0 ? -1 : 1; // q and -q are the same rotation
    pose.quaternion.toArray().forEach((value, k) => (sum[k] += sign * weight * value));
    for (const name of LENS) lens[name] += weight * pose.lens[name];
    focus += weight * pose.focus;
  });
  return new Pose(position, new Quaternion(...sum).normalize(), lens, focus);
}

/**
 * Sets the projection matrix for a window. The photo fills the window, so that areas without training
 * data stay outside, unless more than MOST_CROPPED would be cropped.
 */
export function project(matrix, lens, windowAspect, near, far) {
  const wider = windowAspect / lens.aspect;
  const zoom = MathUtils.clamp(MOST_CROPPED / Math.max(wider, 1 / wider), 0, 1);
  const x = zoom * Math.max(1, 1 / wider);
  const y = zoom * Math.max(1, wider);
  // prettier-ignore
  matrix.set(
    lens.fx * x, 0, lens.sx * x, 0,
    0, lens.fy * y, lens.sy * y, 0,
    0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near),
    0, 0, -1, 0,
  );
}
