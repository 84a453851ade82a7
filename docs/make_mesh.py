"""Measures and draws meshes of the demo scene, beside the truth.

    splatax demo --out RUN                             and
    splatax train RUN/capture --out RUN2 --geometry
    python docs/make_mesh.py RUN/capture RUN RUN2

The script prints the table of docs/mesh.md, and writes docs/images/mesh.jpg: a held-out photo with its true
normals above, and the mesh of each run with its normals below.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

import splatax as sx
from splatax import mesh
from splatax.cameras.geometry import seen_at
from splatax.demo.raycast import truth
from splatax.demo.scenes import DEFAULT, scene_named
from splatax.geometry_scores import best_depth
from splatax.mesh.comparison import places_on
from splatax.mesh.views import DepthView, Picture

IMAGES = Path(__file__).parent / "images"
FINE, SPACING = (
    4,
    0.01,
)  # times the photos' size, and distance, of the true points that meshes are compared with
POINTS = 3_000_000  # with which a mesh is drawn


def main(capture: Path, runs: list[Path]) -> None:
    dataset, scene = sx.load_dataset(capture), scene_named(DEFAULT)
    cameras = [view.camera for view in dataset.train]
    large = [camera.resized(FINE * camera.width, FINE * camera.height) for camera in cameras]
    samples = mesh.samples_of([(camera, np.asarray(truth(camera, scene).depth)) for camera in large], SPACING)
    exact = [DepthView(view.camera, lambda view=view: exact_picture(view)) for view in dataset.train]
    found = {"exact depth": mesh.extract(exact)}
    for run in runs:
        gaussians = sx.load(run / "scene.ply")
        depth = best_depth(gaussians, dataset.train)
        print(f"{run.name}: {depth}")
        found[run.name] = mesh.extract(mesh.depth_views(gaussians, cameras, depth=depth))
    for name, each in found.items():
        agreement = mesh.compare(each, samples)
        print(
            f"| {name} | {len(each.faces):,} | {agreement.median:.4f} | {agreement.most:.4f} | "
            f"{100 * agreement.precision:.1f} % | {100 * agreement.completeness:.1f} % |"
        )
    view = dataset.test[0]
    camera = view.camera.resized(2 * view.camera.width, 2 * view.camera.height)
    photo = np.asarray(Image.fromarray(view.pixels()).resize((camera.width, camera.height)))
    normals = np.asarray(truth(camera, scene).normals)
    rows = [np.concatenate([photo, as_colors(normals)], axis=1)]
    rows += [np.concatenate(drawn(found[run.name], camera), axis=1) for run in runs]
    Image.fromarray(np.concatenate(rows)).save(IMAGES / "mesh.jpg", quality=85)


def exact_picture(view: sx.View) -> Picture:
    """Returns the true depth of a view, and its photo."""
    return Picture(view.truth().depth.astype(np.float32), view.pixels() / np.float32(255))


def as_colors(normals: np.ndarray) -> np.ndarray:
    """Returns normals as colors; black where there are none."""
    colors = np.round(127.5 * (normals + 1)).astype(np.uint8)
    return np.where((normals != 0).any(axis=-1, keepdims=True), colors, 0)


def drawn(shape: sx.mesh.Mesh, camera: sx.Camera) -> tuple[np.ndarray, np.ndarray]:
    """Draws the colors and the normals of a mesh, as the nearest of many points on it at each pixel."""
    faces, weights = places_on(shape, POINTS)
    points, colors, normals = (
        np.sum(values[shape.faces[faces]] * weights[..., None], axis=1)
        for values in (shape.vertices, shape.colors, shape.normals)
    )
    pixels, depths = seen_at(camera, points)
    inside = np.flatnonzero(np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1))
    order = inside[np.argsort(-depths[inside])]  # the nearest is written last
    x, y = pixels[order].astype(int).T
    image, facing = (np.zeros((camera.height, camera.width, 3)) for _ in range(2))
    image[y, x], facing[y, x] = colors[order], normals[order]
    return image.astype(np.uint8), as_colors(facing)


if __name__ == "__main__":
    main(Path(sys.argv[1]), [Path(run) for run in sys.argv[2:]])
