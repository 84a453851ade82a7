// Automatic motions. Each has `advance(pose, seconds)`, which returns the next pose, and `done`.
import { Vector3 } from 'three';
import { blend } from './pose.js';

const TURNTABLE = 0.25; // radians per second
const LONGEST = 60; // seconds: longest duration of a path
const NEAR = 3; // median steps: a path whose ends are closer is closed
const UP = new Vector3(0, 1, 0);

/** Moves from one pose to another in a given number of seconds. */
export class Glide {
  constructor(start, end, duration) {
    Object.assign(this, { start: start.clone(), end, duration, seconds: 0, done: false });
  }

  advance(_, seconds) {
    this.seconds += seconds;
    this.done = this.seconds >= this.duration;
    const t = this.seconds / this.duration;
    const eased = t * t * (3 - 2 * t);
    return this.done ? this.end.clone() : blend([this.start, this.end], [1 - eased, eased]);
  }
}

/** Flies along a uniform cubic B-spline of camera poses, in a loop or back and forth. */
export class Path {
  /** Takes the poses, and the duration of the whole path; without one, it depends on their number. */
  constructor(poses, seconds) {
    const steps = poses.slice(1).map((pose, i) => pose.position.distanceTo(poses[i].position));
    const median = steps.toSorted((a, b) => a - b)[steps.length >> 1];
    const gap = poses[0].position.distanceTo(poses.at(-1).position);
    this.poses = poses;
    this.closed = poses.length > 4 && gap < NEAR * median;
    const intervals = Math.max(this.closed ? poses.length : poses.length - 1, 1);
    this.pace = seconds ? seconds / intervals : Math.min(LONGEST / poses.length, 1.2); // from camera to camera
    this.seconds = 0;
    this.done = false;
  }

  advance(_, seconds) {
    this.seconds += seconds;
    return this.at(this.seconds / this.pace);
  }

  /** Returns the pose at a fractional camera index. */
  at(u) {
    const n = this.poses.length;
    const index = (i) => (this.closed ? (i + n) % n : Math.min(Math.max(i, 0), n - 1));
    if (!this.closed) u = n - 1 - Math.abs((u % (2 * n - 2)) - (n - 1));
    const i = Math.floor(u);
    const t = u - i;
    const weights = [(1 - t) ** 3, 3 * t ** 3 - 6 * t ** 2 + 4, -3 * t ** 3 + 3 * t ** 2 + 3 * t + 1, t ** 3];
    const near = [-1, 0, 1, 2].map((k) => this.poses[index(i + k)]);
    return blend(near, weights.map((weight) => weight / 6));
  }
}

/** Rotates around the pivot at constant speed. */
export class Turntable {
  done = false;

  advance(pose, seconds) {
    const next = pose.clone();
    next.turn(next.pivot, UP, TURNTABLE * seconds);
    return next;
  }
}
