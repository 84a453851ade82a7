"""Measures and draws meshes of a procedural scene, beside the truth.

    splatax demo --scene SCENE --out RUN               and
    splatax train RUN/capture --out RUN2 --geometry
    python docs/make_mesh.py SCENE RUN/capture RUN RUN2

The script prints rows of the tables of docs/mesh.md: for each run, the meshes of the depth that `auto` takes
and of the depths of planes. For the scene "still-life" it also writes docs/images/mesh.jpg: a held-out photo
with its true normals above, and the mesh of each run with its normals below.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial import cKDTree

import splatax as sx
from splatax import mesh
from splatax.cameras.geometry import seen_at
from splatax.demo.raycast import truth
from splatax.demo.scene import Scene
from splatax.demo.scenes import DEFAULT, scene_named
from splatax.demo.shapes import Cylinder
from splatax.geometry_scores import DEPTH, best_depth
from splatax.mesh.comparison import TOLERANCE, places_on, points_on
from splatax.mesh.views import DepthView, Picture
from splatax.surfaces import positions_of

IMAGES = Path(__file__).parent / "images"
FINE = 4  # times the photos' size, for the truth that meshes are compared with
SPACING = 0.01  # least distance of the true points
# Depth beyond which nothing counts. In "outdoor", the monument and the lawn around it are left: farther off,
# cameras see the lawn at angles at which their depth maps are no samples of its surface.
FAR, FAR_OUTDOORS = 12.0, 4.8
THIN = 0.02  # radius below which a cylinder is a thin part
POINTS = 3_000_000  # with which a mesh is drawn, and near which thin parts are searched
SURFACE_DEPTHS = ("surface_depth", "median_surface_depth")


def main(name: str, capture: Path, runs: list[Path]) -> None:
    dataset, scene = sx.load_dataset(capture), scene_named(name)
    far = FAR_OUTDOORS if name == "outdoor" else FAR
    cameras = [view.camera for view in dataset.train]
    large = [camera.resized(FINE * camera.width, FINE * camera.height) for camera in cameras]
    samples = mesh.samples_of([(camera, true_depth(camera, scene, far)) for camera in large], SPACING)
    thin = np.concatenate([thin_points(camera, scene) for camera in large])
    thin = thin[np.unique(np.floor(thin / SPACING).astype(int), axis=0, return_index=True)[1]]
    exact = [DepthView(view.camera, lambda view=view: exact_picture(view, far)) for view in dataset.train]
    found = {"exact depth": mesh.extract(exact)}
    for run in runs:
        gaussians = sx.load(run / "scene.ply")
        best = best_depth(gaussians, dataset.train) or DEPTH
        for depth in dict.fromkeys((best, *SURFACE_DEPTHS)):
            views = [near(view, far) for view in mesh.depth_views(gaussians, cameras, depth=depth)]
            title = f"{run.name} | {depth}{' (`auto`)' if depth == best else ''}"
            found[title] = mesh.extract(views)
            print(title, mesh.resolution_of(views), flush=True)
    for title, each in found.items():
        agreement = mesh.compare(each, samples)
        row = (
            f"| {title} | {len(each.faces):,} | {agreement.median:.4f} | {agreement.most:.4f} | "
            f"{100 * agreement.precision:.1f} % | {100 * agreement.completeness:.1f} % |"
        )
        if len(thin):
            apart = cKDTree(points_on(each, POINTS)).query(thin, distance_upper_bound=TOLERANCE)[0]
            row += f" {100 * np.mean(apart <= TOLERANCE):.1f} % |"
        print(row, flush=True)
    if name == DEFAULT:
        draw(dataset.test[0], scene, [each for title, each in found.items() if "auto" in title])


def draw(view: sx.View, scene: Scene, meshes: list[sx.mesh.Mesh]) -> None:
    """Writes the picture: a photo with its true normals above meshes with theirs."""
    camera = view.camera.resized(2 * view.camera.width, 2 * view.camera.height)
    photo = np.asarray(Image.fromarray(view.pixels()).resize((camera.width, camera.height)))
    normals = np.asarray(truth(camera, scene).normals)
    rows = [np.concatenate([photo, as_colors(normals)], axis=1)]
    rows += [np.concatenate(drawn(each, camera), axis=1) for each in meshes]
    Image.fromarray(np.concatenate(rows)).save(IMAGES / "mesh.jpg", quality=85)


def true_depth(camera: sx.Camera, scene: Scene, far: float) -> np.ndarray:
    """Returns the depth of the surfaces that count, and 0 elsewhere."""
    depth = np.asarray(truth(camera, scene).depth)
    return np.where(depth < far, depth, 0)


def thin_points(camera: sx.Camera, scene: Scene) -> np.ndarray:
    """Returns the points of rods and wires that a camera sees."""
    shapes = [surface.shape for surface in scene.surfaces]
    numbers = [i for i, shape in enumerate(shapes) if isinstance(shape, Cylinder) and shape.radius < THIN]
    exact = truth(camera, scene)
    shown = np.isin(np.asarray(exact.surfaces), numbers)
    return np.asarray(positions_of(camera, np.where(shown, exact.depth, 1).astype(np.float32)))[shown]


def near(view: DepthView, far: float) -> DepthView:
    """Returns a view without depths that do not count."""

    def read() -> Picture:
        picture = view.read()
        return picture._replace(depth=np.where(picture.depth < far, picture.depth, 0))

    return DepthView(view.camera, read)


def exact_picture(view: sx.View, far: float) -> Picture:
    """Returns the true depth of a view, and its photo."""
    depth = view.truth().depth.astype(np.float32)
    return Picture(np.where(depth < far, depth, 0), view.pixels()[..., :3] / np.float32(255))


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
    main(sys.argv[1], Path(sys.argv[2]), [Path(run) for run in sys.argv[3:]])
