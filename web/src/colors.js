// An affine map of a part's colours, which the graphics device applies after the harmonics.
import { dyno } from '@sparkjsdev/spark';
import { Vector3 } from 'three';

const { add, combineGsplat, dot, dynoBlock, dynoFloat, dynoVec3, Gsplat, splitGsplat } = dyno;
const KEPT = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]; // prettier-ignore

export class ColorMap {
  #rows = KEPT.map((row) => ({ factors: dynoVec3(new Vector3(...row)), offset: dynoFloat(row[3]) }));
  #state = JSON.stringify(KEPT);

  constructor() {
    this.modifier = dynoBlock({ gsplat: Gsplat }, { gsplat: Gsplat }, ({ gsplat }) => {
      const { rgb } = splitGsplat(gsplat).outputs;
      const [r, g, b] = this.#rows.map(({ factors, offset }) => add(dot(factors, rgb), offset));
      return { gsplat: combineGsplat({ gsplat, r, g, b }) };
    });
  }

  /** Sets the rows of the map, three factors and an offset each; null keeps colours. Returns whether they changed. */
  set(rows) {
    const state = JSON.stringify(rows ?? KEPT);
    if (state === this.#state) return false;
    this.#state = state;
    (rows ?? KEPT).forEach(([r, g, b, offset], i) => {
      this.#rows[i].factors.value.set(r, g, b);
      this.#rows[i].offset.value = offset;
    });
    return true;
  }
}
