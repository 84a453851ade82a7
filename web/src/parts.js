// The parts of the scene. A part with a preview shows that at first, and then its whole file with level of detail.
import { SplatMesh } from '@sparkjsdev/spark';
import { ColorMap } from './colors.js';

export class Parts {
  #parts = []; // each has a mesh, which `change` shows and hides, and a preview, drawn until the mesh has its level of detail
  #scene;
  #spark;

  constructor(scene, spark) {
    this.#scene = scene;
    this.#spark = spark;
  }

  /** Loads the files of parts, or their previews, each once. `open` returns the bytes of a file. */
  async load(described, open) {
    const files = {};
    for (const part of described) {
      const color = new ColorMap();
      const mesh = await this.#mesh(part, part.preview ?? part.file, { files, open, color });
      this.#scene.add(mesh);
      this.#parts.push({ mesh, color, preview: null, whole: !part.preview });
    }
  }

  /** Loads the whole files of parts that have previews. Spark draws of them what the view needs. */
  async refine(described, open) {
    const files = {};
    for (const [index, { file, preview, ...part }] of described.entries()) {
      if (!preview) continue;
      const own = this.#parts[index];
      const mesh = await this.#mesh(part, file, { files, open, color: own.color, lod: true });
      mesh.visible = own.mesh.visible;
      this.#scene.add(mesh);
      [own.preview, own.mesh] = [own.mesh, mesh];
    }
  }

  /** Removes the previews of parts whose level of detail has been chosen. Returns whether there were any. */
  swap() {
    const ready = this.#parts.filter(({ mesh, preview }) => preview && this.#spark.lodInstances.has(mesh));
    for (const part of ready) {
      this.#scene.remove(part.preview);
      part.preview = null;
      part.whole = true;
    }
    // The swap itself is no reason for Spark to choose levels again, and so to sort and draw twice.
    if (ready.length) for (const chosen of this.#spark.lodMeshes) chosen.version = Infinity;
    return ready.length > 0;
  }

  /** Whether all visible parts are drawn from their whole files. */
  get whole() {
    return this.#parts.every(({ mesh, whole }) => whole || !mesh.visible);
  }

  /** Shows or hides a part, and maps its colours. Returns whether the picture changes. */
  change(index, visible, rows) {
    const { mesh, preview, color } = this.#parts[index];
    const recolored = color.set(rows);
    if (mesh.visible === visible && !recolored) return false;
    for (const drawn of preview ? [mesh, preview] : [mesh]) {
      drawn.visible = visible;
      drawn.updateVersion();
    }
    // Spark would forget the levels of detail of a part that is hidden for 3 seconds.
    const levels = this.#spark.lodIds.get(mesh.extSplats.lodSplats);
    if (levels && !visible) levels.lastTouched = Infinity;
    return true;
  }

  /** The mesh of a part, by its index. */
  mesh(index) {
    return this.#parts[index].mesh;
  }

  async #mesh({ position, quaternion, scale }, file, { files, open, color, lod = false }) {
    const source = files[file] ? { extSplats: files[file] } : { fileBytes: await open(file), fileType: 'spz', extSplats: true };
    const { covSplats } = this.#spark;
    const mesh = new SplatMesh({ ...source, covSplats, objectModifier: color.modifier, lod, raycastable: false });
    await mesh.initialized;
    files[file] ??= mesh.extSplats;
    mesh.position.set(...position);
    mesh.quaternion.set(...quaternion);
    mesh.scale.setScalar(scale);
    return mesh;
  }
}
