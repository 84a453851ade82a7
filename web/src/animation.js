// Splats that follow bones: a clip that plays in a loop.
import { SplatSkinning } from '@sparkjsdev/spark';

const VALUES = 12; // of a bone's transform: three columns and the translation
const ROW = 16; // values of a bone in Spark's texture

const decoded = (base64) => Uint8Array.from(atob(base64), (letter) => letter.charCodeAt(0)).buffer;

class Bones {
  /** Spark's linear blend applies rest^-1 times bone, so the rest is the identity and bones are whole transforms. */
  constructor(mesh, { joints, bones, skin }) {
    Object.assign(this, { joints, bones: new Float32Array(decoded(bones)) });
    this.skinning = new SplatSkinning({ mesh, numBones: joints, mode: 'linear_blend' });
    this.skinning.skinData.set(new Uint16Array(decoded(skin)));
    this.skinning.skinTexture.needsUpdate = true;
    mesh.skinning = this.skinning;
    mesh.updateGenerator();
  }

  /** Poses the splats as at a stored pose, or between two. */
  show(pose) {
    const last = this.bones.length / (VALUES * this.joints) - 1;
    const place = Math.min(Math.max(pose, 0), last);
    const frame = Math.min(Math.floor(place), Math.max(last - 1, 0));
    const after = Math.min(frame + 1, last);
    const fraction = place - frame;
    for (let joint = 0; joint < this.joints; joint++) {
      for (let i = 0; i < VALUES; i++) {
        const at = (f) => this.bones[(f * this.joints + joint) * VALUES + i];
        this.skinning.boneData[joint * ROW + i] = (1 - fraction) * at(frame) + fraction * at(after);
      }
    }
    this.skinning.updateBones();
  }
}

export class Animation {
  time = 0; // seconds in the clip
  playing = true;

  /** `mesh` returns the mesh of a part, by its index. */
  constructor(mesh, { seconds, fps, parts }) {
    Object.assign(this, { seconds, fps });
    this.moving = parts.map((part) => new Bones(mesh(part.part), part));
    this.show(0);
  }

  /** Advances the clip if it plays, and returns whether the picture changes. */
  advance(seconds) {
    if (!this.playing || !this.seconds) return false;
    this.show((this.time + seconds) % this.seconds);
    return true;
  }

  /** Poses the splats as at a time of the clip. */
  show(time) {
    this.time = time;
    for (const bones of this.moving) bones.show(time * this.fps);
  }
}
