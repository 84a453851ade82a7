"""Measures rigs on two models with known poses: `python docs/measure_rigs.py hand|robot|recover STEPS COUNT`.

`recover` takes two more numbers: the width of the photos, and how many show each training pose. The word
"antialiasing" at the end trains with `Antialiasing(0.1)`, and "antialiasing=0.3" with the filter of
`splatax rig --low-pass antialiasing`.

The models are in SPLATAX_DATA/rigs: `hand-right.glb` of @webxr-input-profiles/assets (MIT), and
`RobotExpressive.glb` by Tomas Laulhe (CC0). Their surfaces get a procedural texture and are photographed
without light, so that the photos are exact in every pose.
"""

import os
import sys
import time
from dataclasses import replace
from pathlib import Path

import jax
import numpy as np
from make_hand import FINGERS, connected, curled
from PIL import Image
from scipy.spatial.transform import Rotation

import splatax as sx
from splatax.demo.meshes import photograph_mesh
from splatax.demo.rigged import camera_around, moves_of, posed_dataset
from splatax.io.rigs import read_body
from splatax.metrics import to_8bit
from splatax.scene.binding import covering
from splatax.scene.body import Body
from splatax.scene.rigged import RiggedScene
from splatax.scene.skeleton import Pose
from splatax.scene.skin import skin
from splatax.training.posing import Search, fit_pose
from splatax.training.rigged import optimize_rig, recipe_for
from splatax.training.rigged_step import Learned

DATA = Path(os.environ.get("SPLATAX_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")) / "rigs"
FREE, STIFF = (0.0, 0.0, 0.0), (0.0, 0.05, 0.05)  # fingers bend about x, and hardly twist or bend sideways
SIZE = 128
PICTURE = Path(__file__).parent / "images" / "rigs.jpg"


def hand() -> Body:
    """Returns the hand, with its joints in chains."""
    return connected(read_body(DATA / "hand-right.glb"))


def photographed(
    body: Body, poses: dict[str, Pose], held_out: set[str], views: int, seed: int = 1, size: int = SIZE
):
    """Returns a capture with `views` photos of each pose from random sides, and the pose of each photo."""
    rng = np.random.default_rng(seed)
    photos, pose_of = {}, {}
    for name, pose in poses.items():
        for i in range(views):
            photo = f"{name}-{seed}-{i}.png"
            camera = camera_around(body, rng.uniform(0, 2 * np.pi), rng.uniform(-0.7, 0.7), size)
            photos[photo], pose_of[photo] = (pose, camera), name
    return posed_dataset(body, photos, [p for p in photos if pose_of[p] in held_out]), pose_of


def psnr(gaussians, rig, poses, views, pose_of) -> float:
    """Returns the mean PSNR over photos, dB, of whole images over white."""
    errors = squared_errors(gaussians, rig, poses, views, pose_of)
    return float(np.mean([-10 * np.log10(np.mean(error)) for error in errors]))


def squared_errors(gaussians, rig, poses, views, pose_of) -> list[np.ndarray]:
    """Returns the squared errors of each photo over white, [h w 3]."""

    @jax.jit
    def draw(pose, camera):
        posed = skin(gaussians, rig, rig.skeleton.worlds(pose))
        return sx.render(posed, camera, background=sx.WHITE).rgb

    errors = []
    for view in views:
        drawn = to_8bit(np.asarray(draw(poses[pose_of[view.name]], view.camera))) / 255.0
        errors.append((drawn - over_white(view.pixels())) ** 2)
    return errors


def silhouettes(body: Body, pose: Pose, camera: sx.Camera) -> dict[str, np.ndarray]:
    """Returns the pixels that the body, and that its rigid parts, fill by more than half.

    Rigid parts are the triangles whose three corners follow one and the same joint only.
    """
    surface = body.surface
    joints = np.take_along_axis(surface.indices, surface.weights.argmax(axis=1)[:, None], axis=1)[:, 0]
    alone = surface.weights.max(axis=1) > 1 - 1e-6
    own, single = joints[surface.triangles], alone[surface.triangles].all(axis=1)
    rigid = np.repeat(single & (own == own[:, :1]).all(axis=1), 3)
    posed = surface.posed(moves_of(body, pose))[surface.triangles].reshape(-1, 3)
    corners, flags = np.arange(len(posed)).reshape(-1, 3), np.tile(rigid[:, None] * 1.0, 3)
    drawn = photograph_mesh(camera, posed, corners, posed, flags, lambda _, colors: colors) / 255.0
    return {"silhouette": drawn[..., 3] > 0.5, "rigid parts": drawn[..., 0] * drawn[..., 3] > 0.5}


def report_psnr(name: str, body, last, poses, views, pose_of) -> None:
    """Prints the mean PSNR over photos of whole images, inside the silhouette, and in rigid parts."""
    errors = squared_errors(last.gaussians, last.rig, poses, views, pose_of)
    scores: dict[str, list[float]] = {}
    for view, error in zip(views, errors, strict=True):
        masks = silhouettes(body, poses[pose_of[view.name]], view.camera)
        for region, mask in ({"whole image": np.ones(error.shape[:2], bool)} | masks).items():
            if mask.any():
                scores.setdefault(region, []).append(-10 * np.log10(np.mean(error[mask])))
    listed = ", ".join(f"{region} {np.mean(each):.2f} dB" for region, each in scores.items())
    print(f"{name}: {listed}")


def trained(body, dataset, poses, pose_of, steps: int, count: int, learned=Learned(), seconds=None):
    """Trains, and returns the last progress, with the time that the steps took."""
    recipe = recipe_for(steps, count)
    if filters := [word for word in sys.argv if word.startswith("antialiasing")]:
        variance = float(filters[0].partition("=")[2] or 0.1)  # 0.1 is about the blur of a pixel's area
        recipe = replace(recipe, drawing=replace(recipe.drawing, low_pass=sx.Antialiasing(variance)))
    began, cpu = None, 0.0
    for progress in optimize_rig(dataset, recipe, covering(body, count // 2), poses, pose_of, learned):
        if began is None:
            progress.loss.block_until_ready()
            began, cpu = time.perf_counter(), time.process_time()
        if seconds and time.process_time() - cpu > seconds:
            break
    progress.loss.block_until_ready()
    print(
        f"{progress.step} steps, {time.perf_counter() - began:.1f} s, CPU {time.process_time() - cpu:.1f} s"
    )
    return progress


def measure_hand(steps: int, count: int) -> None:
    """Trains the hand in 8 poses and measures it in 2 others."""
    body, rng = hand(), np.random.default_rng(1)
    poses = {f"pose{i}": curled(body.skeleton, {f: rng.uniform(0, 1.1) for f in FINGERS}) for i in range(10)}
    dataset, pose_of = photographed(body, poses, {"pose8", "pose9"}, views=6)
    others, other_of = photographed(body, poses, {"pose8", "pose9"}, views=6, seed=2)
    last = trained(body, dataset, poses, pose_of, steps, count)
    for name, views, names in (
        ("training poses, training photos", dataset.train, pose_of),
        ("training poses, other photos", others.train, other_of),
        ("held-out poses", (*dataset.test, *others.test), pose_of | other_of),
    ):
        report_psnr(f"hand, {name}", body, last, poses, views, names)


def measure_robot(steps: int, count: int) -> None:
    """Trains the robot in poses of some clips and measures it in others."""
    body = read_body(DATA / "RobotExpressive.glb")
    seen, unseen = ("Walking", "Wave", "ThumbsUp", "Sitting", "Jump"), ("Running", "Punch", "Dance")
    poses = {
        f"{clip}{i}": body.clips[clip].pose(body.skeleton.rest, time)
        for clip in (*seen, *unseen)
        for i, time in enumerate(np.linspace(0.1, 0.9, 3) * body.clips[clip].seconds)
    }
    held_out = {name for name in poses if name.startswith(unseen)}
    dataset, pose_of = photographed(body, poses, held_out, views=5)
    last = trained(body, dataset, poses, pose_of, steps, count)
    for name, views in (("training", dataset.train), ("unseen", dataset.test)):
        report_psnr(f"robot, {name} clips", body, last, poses, views, pose_of)
    scene, camera = RiggedScene(last.gaussians, last.rig), camera_around(body, 0.4, 0.15, 2 * SIZE)
    names = ("Running0", "Punch1", "Dance0", "Dance2")
    truth = posed_dataset(body, {name: (poses[name], camera) for name in names})
    photos = [over_white(view.pixels()) for view in truth.train]
    drawn = [
        np.asarray(sx.render(scene.posed(poses[name]), camera, background=sx.WHITE).rgb) for name in names
    ]
    rows = [np.concatenate([picture[40:-10] for picture in row], axis=1) for row in (photos, drawn)]
    Image.fromarray(to_8bit(np.concatenate(rows))).save(PICTURE, quality=90)


def over_white(pixels: np.ndarray) -> np.ndarray:
    """Returns RGBA pixels over white, in [0, 1]."""
    photo = pixels.astype(np.float64) / 255
    return photo[..., :3] * photo[..., 3:] + 1 - photo[..., 3:]


def measure_recovery(steps: int, count: int, size: int = SIZE, views: int = 6) -> None:
    """Turns the joints of the hand by 10 degrees around random axes, in 3 poses that training has not seen.

    They are recovered from 6 photos of each pose.
    """
    body, rng, more = hand(), np.random.default_rng(1), np.random.default_rng(3)
    poses = {
        f"pose{i}": curled(body.skeleton, {f: drawn.uniform(0, 1.1) for f in FINGERS})
        for i, drawn in enumerate([rng] * 9 + [more] * 2)
    }
    unseen = ("pose8", "pose9", "pose10")
    dataset, pose_of = photographed(body, poses, set(unseen), views=6, size=size)
    if views > 6:
        others, other_of = photographed(body, poses, set(unseen), views - 6, seed=2, size=size)
        dataset, pose_of = replace(dataset, train=dataset.train + others.train), pose_of | other_of
    last = trained(body, dataset, poses, pose_of, steps, count)
    print(f"photos of these poses: {psnr(last.gaussians, last.rig, poses, dataset.test, pose_of):.2f} dB")
    scene = RiggedScene(last.gaussians, last.rig)
    moved = [name for name in body.skeleton.names if "phalanx" in name]
    rows = [body.skeleton.index(name) for name in moved]

    def errors(pose: Pose, truth: Pose) -> np.ndarray:
        a, b = (Rotation.from_quat(np.asarray(p.quats)[rows][:, [1, 2, 3, 0]]) for p in (pose, truth))
        return np.degrees((a.inv() * b).magnitude())

    starts = {}
    for name in unseen:
        axes = rng.normal(size=(len(moved), 3))
        axes *= np.radians(10) / np.linalg.norm(axes, axis=1, keepdims=True)
        starts[name] = body.skeleton.turned(dict(zip(moved, axes, strict=True)), poses[name])
    for title, stiffness in (("free", FREE), ("stiff", STIFF)):
        found = []
        search = Search(600, background=(1.0, 1.0, 1.0), joints=tuple(moved), stiffness=stiffness)
        for name, start in starts.items():
            photos = [view for view in dataset.test if pose_of[view.name] == name]
            found.append(errors(fit_pose(scene, photos, start, search), poses[name]))
            report(f"{title} joints, {name}", found[-1])
        report(f"{title} joints, all", np.concatenate(found))


def report(name: str, degrees: np.ndarray) -> None:
    mean, median, most = degrees.mean(), np.median(degrees), degrees.max()
    print(f"{name}: {len(degrees)} joints, mean {mean:.2f}, median {median:.2f}, largest {most:.2f} degrees")


MEASURES = {"hand": measure_hand, "robot": measure_robot, "recover": measure_recovery}

if __name__ == "__main__":
    MEASURES[sys.argv[1]](*(int(word) for word in sys.argv[2:] if word.isdigit()))
