"""Measures a twin against MuJoCo: `MUJOCO_GL=egl python docs/measure_twin.py [STEPS [GAUSSIANS [SIZE]]]`.

MuJoCo photographs a small arm (`splatax.demo.robot.ARM`) from many sides in one pose, in colour and depth, by
default with 128 x 128 pixels. A scene is trained on these RGB-D frames, and the true segmentation of the same
photos splits it into parts. The parts then follow the bodies to 20 other joint configurations, and MuJoCo's
color, depth and segmentation of each is the truth. It needs the packages of the extra "twins", and draws
docs/images/twins.jpg.
"""

import sys
import time
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import NamedTuple

import jax
import mujoco
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

import splatax as sx
from splatax import editing, twins
from splatax.demo.robot import ARM
from splatax.metrics import psnr, to_8bit
from splatax.sensors import Color, Depth, Labels, observe
from splatax.training.geometry import Surfaces
from splatax.transforms import Similarity

SIZE, FINER = 128, 4  # pixels of a photo, and samples along each side of a pixel
PHOTOS, CONFIGURATIONS = 72, 20
LOOK_AT, DISTANCE, FIELD = np.array([0.0, 0, 0.42]), 1.55, 42.0
TRAINED = np.array([0.3, 0.35, -0.5, 0.4])  # joints of the pose that the twin is trained in
REACH = np.array([1.0, 0.7, 0.8, 0.9])  # largest change of a joint from it, radians
SENSORS = {"rgb": Color(), "depth": Depth(), "labels": Labels()}
# A depth camera measures every pixel, without wrong points.
SURFACES = Surfaces(spread=0.1, consistency=0.0, points=2.0, points_limit=0.03, after=0.0)
LOW_PASS = sx.Antialiasing(0.1)  # about a pixel's area; a wider blur makes boxes shrink by half a pixel
PICTURE = Path(__file__).parent / "images" / "twins.jpg"


class Truth(NamedTuple):
    """MuJoCo's images from one camera."""

    camera: sx.Camera
    rgba: np.ndarray  # 8 bits; alpha is the covered part of the pixel
    depth: np.ndarray  # metres along the axis; 0 without a surface
    bodies: np.ndarray  # body at the centre of the pixel; -1 without a surface


class Photographer:
    """MuJoCo with a camera that can be placed anywhere."""

    def __init__(self, size: int = SIZE) -> None:
        self.size, self.model = size, mujoco.MjModel.from_xml_string(ARM)
        self.data = mujoco.MjData(self.model)
        self.fine, self.plain = (
            mujoco.Renderer(self.model, size * times, size * times) for times in (FINER, 1)
        )
        self.model.cam_fovy[0] = FIELD

    def pose(self, joints: np.ndarray) -> None:
        """Moves the arm."""
        self.data.qpos[:] = joints
        mujoco.mj_forward(self.model, self.data)

    def look_from(self, azimuth: float, elevation: float) -> None:
        """Places the camera around the arm; angles in radians."""
        outward = np.array(
            [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        )
        right = np.cross([0, 0, 1], outward)
        right /= np.linalg.norm(right)
        axes = np.stack([right, np.cross(outward, right), outward], axis=1)  # it looks along -z
        self.model.cam_pos[0] = LOOK_AT + DISTANCE * outward
        self.model.cam_quat[0] = Rotation.from_matrix(axes).as_quat()[[3, 0, 1, 2]]
        mujoco.mj_forward(self.model, self.data)

    def truth(self) -> Truth:
        """Takes the photo, with color averaged over the area of each pixel."""
        camera = twins.camera_of(self.model, self.data, "front", self.size, self.size)
        color = self._drawn(self.fine, "color").astype(np.float64)
        covered = self._drawn(self.fine, "segmentation")[..., 0] >= 0
        premultiplied, alpha = (_averaged(image) for image in (color * covered[..., None], covered * 1.0))
        rgb = premultiplied / np.maximum(alpha, 1e-9)[..., None]
        geoms = self._drawn(self.plain, "segmentation")[..., 0]
        bodies = np.where(geoms >= 0, self.model.geom_bodyid[np.maximum(geoms, 0)], -1)
        depth = np.where(bodies >= 0, self._drawn(self.plain, "depth"), 0)
        rgba = np.dstack([rgb, 255 * alpha]).round().astype(np.uint8)
        return Truth(camera, rgba, depth, bodies)

    def _drawn(self, renderer: mujoco.Renderer, kind: str) -> np.ndarray:
        renderer.disable_depth_rendering()
        renderer.disable_segmentation_rendering()
        if kind == "depth":
            renderer.enable_depth_rendering()
        if kind == "segmentation":
            renderer.enable_segmentation_rendering()
        renderer.update_scene(self.data, "front")
        return renderer.render()


def _averaged(image: np.ndarray) -> np.ndarray:
    size = len(image) // FINER
    blocks = image.reshape(size, FINER, size, FINER, *image.shape[2:])
    return blocks.mean(axis=(1, 3))


def views_around(photographer: Photographer, count: int) -> list[Truth]:
    """Photographs the arm from `count` sides, from below the height of the table's edge to far above it."""
    found = []
    for i in range(count):
        photographer.look_from(i * 2.39996, np.radians(-12 + 80 * (i + 0.5) / count))
        found.append(photographer.truth())
    return found


def frame_of(truth: Truth) -> twins.RgbdFrame:
    """Returns what an RGB-D camera would have measured: colour over black, and depth."""
    rgb = truth.rgba[..., :3] * (truth.rgba[..., 3:] / 255.0) / 255.0
    return twins.RgbdFrame(truth.camera, rgb, truth.depth)


def trained(photos: list[Truth], steps: int, count: int) -> sx.Gaussians:
    """Trains a scene on RGB-D frames: it starts from their points, and its depth is compared with theirs."""
    views = tuple(
        sx.View(
            f"{i:03}.png",
            photo.camera,
            cache(lambda photo=photo: photo.rgba),
            landmarks=frame_of(photo).points,
        )
        for i, photo in enumerate(photos)
    )
    places = np.concatenate([view.landmarks() for view in views])
    colors = np.concatenate([photo.rgba[photo.depth > 0][:, :3] / 255 for photo in photos])
    chosen = np.random.default_rng(0).choice(len(places), count // 2, replace=False)
    points = sx.PointCloud(places[chosen].astype(np.float32), colors[chosen].astype(np.float32))
    recipe = sx.recipes.default(steps, count)
    recipe = replace(
        recipe,
        objective=replace(recipe.objective, geometry=SURFACES),
        drawing=replace(recipe.drawing, low_pass=LOW_PASS),
        sh=replace(recipe.sh, degree=0),
    )
    began = time.process_time()
    gaussians = sx.fit(sx.Dataset(views, (), points), recipe)
    print(
        f"trained {len(gaussians):,} Gaussians in {steps} steps, {time.process_time() - began:.0f} s of CPU"
    )
    return gaussians


def split(gaussians: sx.Gaussians, photos: list[Truth], names: tuple[str, ...]) -> sx.Scene:
    """Splits a scene into the bodies by the true segmentation of its photos."""
    views = [(photo.camera, photo.bodies.astype(np.int32)) for photo in photos]
    rows = editing.labels_of(editing.votes(gaussians, views, len(names)))
    return editing.split_by_label(gaussians, rows, names)


class Scores(NamedTuple):
    """How near the twin is to the truth in one image."""

    psnr: float  # dB, over black
    depth: float  # mean relative error where both have a surface
    median: float  # of the same errors
    missing: float  # fraction of the true surface that the twin does not measure


def compared(scene: sx.Scene, truth: Truth, draw) -> tuple[Scores, np.ndarray]:
    """Returns the scores of one image, and how many pixels each pair of true and found labels has."""
    seen = jax.tree.map(np.asarray, draw(scene, truth.camera))
    photo = truth.rgba[..., :3] * (truth.rgba[..., 3:] / 255.0)
    true, found = truth.depth > 0, seen["depth"] > 0
    errors = np.abs(seen["depth"] - truth.depth)[true & found] / truth.depth[true & found]
    count = len(scene.names) + 1
    pairs = np.bincount(((truth.bodies + 1) * count + seen["labels"] + 1).ravel(), minlength=count**2)
    scores = Scores(
        psnr(to_8bit(seen["rgb"]), photo.round().astype(np.uint8)),
        float(errors.mean()),
        float(np.median(errors)),
        float((true & ~found).sum() / true.sum()),
    )
    return scores, pairs.reshape(count, count)


def mean_iou(pairs: np.ndarray) -> float:
    """Returns the mean over labels, and over the background, of the intersection over union."""
    same = np.diag(pairs)
    return float(np.mean(same / (pairs.sum(0) + pairs.sum(1) - same)))


def report(name: str, found: list[tuple[Scores, np.ndarray]]) -> None:
    scores = np.array([row for row, _ in found])
    pairs = sum(counts for _, counts in found)
    print(
        f"{name}: PSNR {scores[:, 0].mean():.2f} dB ({scores[:, 0].min():.2f} to {scores[:, 0].max():.2f}), "
        f"depth error mean {100 * scores[:, 1].mean():.2f} %, median {100 * np.median(scores[:, 2]):.2f} %, "
        f"unmeasured {100 * scores[:, 3].mean():.2f} %, mIoU {mean_iou(pairs):.4f}, {len(found)} images"
    )


def located(scene: sx.Scene, truth: Truth, name: str, seed: int) -> tuple[float, float]:
    """Recovers the pose of one part from one frame, from 10 degrees and 3 cm beside it.

    Returns:
        The errors of rotation, degrees, and of the place of the part's middle, relative to its depth.
    """
    rng, right = np.random.default_rng(seed), scene[name].pose
    axis, way = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    middle = np.append(np.median(np.asarray(scene[name].gaussians.means), axis=0), 1)
    turn = Rotation.from_rotvec(np.radians(10) * axis).as_matrix()
    rotation = np.asarray(right.rotation, np.float64)
    center = rotation @ middle[:3] + np.asarray(right.translation)
    wrong = Similarity(turn @ rotation, center + 0.03 * way - turn @ rotation @ middle[:3])
    found = twins.located(scene.posed({name: wrong}), name, frame_of(truth))
    apart = np.asarray(found.rotation, np.float64) @ rotation.T
    angle = np.degrees(Rotation.from_matrix(apart).magnitude())
    there = np.asarray(found.rotation) @ middle[:3] + np.asarray(found.translation)
    depth = np.asarray(truth.camera.cam_from_world) @ np.append(center, 1)
    return float(angle), float(np.linalg.norm(there - center) / depth[2])


def main(steps: int = 2500, count: int = 7_000, size: int = SIZE) -> None:
    photographer = Photographer(size)
    model, data = photographer.model, photographer.data
    photographer.pose(TRAINED)
    photos = views_around(photographer, PHOTOS)
    held_out, photos = photos[::9], [photo for i, photo in enumerate(photos) if i % 9]
    gaussians = trained(photos, steps, count)
    names = tuple(model.body(i).name for i in range(model.nbody))
    scan = split(gaussians, photos, names)
    for name, part in scan.parts.items():
        print(f"{len(part.gaussians):7,} Gaussians  {name}")
    twin = twins.attached(scan, twins.frames_of(model, data, names))
    draw = jax.jit(lambda scene, camera: observe(scene, camera, SENSORS))
    report("training pose, training photos", [compared(twin, photo, draw) for photo in photos[::8]])
    report("training pose, held-out photos", [compared(twin, photo, draw) for photo in held_out])
    frames = moved(photographer, twin)
    report(f"{CONFIGURATIONS} other configurations", [compared(*frame, draw) for frame in frames])
    pictured(frames[::10], draw)
    for name, (where, images) in product(
        ("upper", "fore", "hand"),
        {"": frames[::8], ", other images": moved(photographer, twin, 7)[::8]}.items(),
    ):
        errors = np.array([located(scene, truth, name, i) for i, (scene, truth) in enumerate(images)])
        angles, places = errors.T
        print(
            f"pose of {name} from one frame{where}: rotation mean {angles.mean():.2f}, largest "
            f"{angles.max():.2f} degrees; place mean {100 * places.mean():.2f} %, largest "
            f"{100 * places.max():.2f} % of depth"
        )


def moved(photographer: Photographer, twin: sx.Scene, seed: int = 1) -> list[tuple[sx.Scene, Truth]]:
    """Returns the twin in other joint configurations, with MuJoCo's images of each from two new sides."""
    rng, frames = np.random.default_rng(seed), []
    for _ in range(CONFIGURATIONS):
        photographer.pose(TRAINED + REACH * rng.uniform(-1, 1, len(REACH)))
        scene = twins.frames_of(photographer.model, photographer.data, twin.names).place(twin)
        for _ in range(2):
            photographer.look_from(rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(-5, 60)))
            frames.append((scene, photographer.truth()))
    return frames


def pictured(frames: list[tuple[sx.Scene, Truth]], draw) -> None:
    """Draws photos above the twin in the same configurations, with its depth and labels."""
    columns = []
    for scene, truth in frames:
        seen = jax.tree.map(np.asarray, draw(scene, truth.camera))
        photo = (truth.rgba[..., :3] * (truth.rgba[..., 3:] / 255.0)).round().astype(np.uint8)
        depth = np.where(seen["depth"] > 0, np.clip(1.6 - 0.7 * seen["depth"], 0, 1), 0)
        colors = np.array([[0, 0, 0], *(Rotation.random(len(scene.names), 3).as_matrix()[:, 0] ** 2 * 255)])
        column = (photo, to_8bit(seen["rgb"]), to_8bit(np.repeat(depth[..., None], 3, 2)))
        columns.append(np.concatenate([*column, colors[seen["labels"] + 1].astype(np.uint8)]))
    Image.fromarray(np.concatenate(columns, axis=1)).save(PICTURE, quality=90)


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
