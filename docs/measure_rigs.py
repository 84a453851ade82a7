"""Measures rigs on two models with known poses: `python docs/measure_rigs.py hand|robot|recover STEPS COUNT`.

`recover` takes two more numbers: the width of the photos, and how many show each training pose.

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
import jax.numpy as jnp
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

import splatax as sx
from splatax.demo.rigged import camera_around, posed_dataset
from splatax.io.rigs import read_body
from splatax.metrics import to_8bit
from splatax.scene.binding import covering
from splatax.scene.body import Body
from splatax.scene.rigged import RiggedScene
from splatax.scene.skeleton import Pose, Skeleton
from splatax.scene.skin import skin
from splatax.training.posing import Search, fit_pose
from splatax.training.rigged import optimize_rig, recipe_for
from splatax.training.rigged_step import Learned

DATA = Path(os.environ.get("SPLATAX_DATA", Path(__file__).parents[2] / "shared" / "data")) / "rigs"
FINGERS = ("thumb", "index-finger", "middle-finger", "ring-finger", "pinky-finger")
BONES = ("metacarpal", "phalanx-proximal", "phalanx-intermediate", "phalanx-distal", "tip")
SIZE = 128
PICTURE = Path(__file__).parent / "images" / "rigs.jpg"


def hand() -> Body:
    """Returns the hand. Its joints, which hang on one node in the file, are connected to chains."""
    body = read_body(DATA / "hand-right.glb")
    skeleton = body.skeleton
    parents = dict(zip(skeleton.names, (skeleton.names[max(p, 0)] for p in skeleton.parents), strict=True))
    for finger in FINGERS:
        chain = [f"{finger}-{bone}" for bone in BONES if f"{finger}-{bone}" in skeleton.names]
        parents |= dict(zip(chain, ["wrist", *chain], strict=False))
    above = tuple(
        -1 if skeleton.parents[i] < 0 else skeleton.names.index(parents[name])
        for i, name in enumerate(skeleton.names)
    )
    worlds = np.asarray(skeleton.worlds(skeleton.rest), np.float64)
    root = np.asarray(skeleton.root, np.float64)
    locals_ = np.stack(
        [np.linalg.inv(worlds[p] if p >= 0 else root) @ w for w, p in zip(worlds, above, strict=True)]
    )
    scales = np.linalg.norm(locals_[:, :3, :3], axis=1)
    quats = Rotation.from_matrix(locals_[:, :3, :3] / scales[:, None]).as_quat()[:, [3, 0, 1, 2]]
    rest = Pose(*(jnp.asarray(rows, jnp.float32) for rows in (locals_[:, :3, 3], quats, scales)))
    return replace(body, skeleton=replace(skeleton, rest=rest, parents=above))


def curled(skeleton: Skeleton, angles: dict[str, float]) -> Pose:
    """Returns a pose with the three bones of each finger bent by an angle, radians."""
    return skeleton.turned(
        {
            name: jnp.array([-angle, 0.0, 0.0])
            for finger, angle in angles.items()
            for name in skeleton.names
            if name.startswith(finger) and "phalanx" in name
        }
    )


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
    """Returns the mean PSNR over photos, dB, over white."""

    @jax.jit
    def draw(pose, camera):
        posed = skin(gaussians, rig, rig.skeleton.worlds(pose))
        return sx.render(posed, camera, background=sx.WHITE).rgb

    scores = []
    for view in views:
        photo = over_white(view.pixels())
        drawn = to_8bit(np.asarray(draw(poses[pose_of[view.name]], view.camera))) / 255.0
        scores.append(-10 * np.log10(np.mean((drawn - photo) ** 2)))
    return float(np.mean(scores))


def trained(body, dataset, poses, pose_of, steps: int, count: int, learned=Learned(), seconds=None):
    """Trains, and returns the last progress, with the time that the steps took."""
    recipe = recipe_for(steps, count)
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
        print(f"hand, {name}: {psnr(last.gaussians, last.rig, poses, views, names):.2f} dB")


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
        print(f"robot, {name} clips: {psnr(last.gaussians, last.rig, poses, views, pose_of):.2f} dB")
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

    found = []
    for name in unseen:
        axes = rng.normal(size=(len(moved), 3))
        axes *= np.radians(10) / np.linalg.norm(axes, axis=1, keepdims=True)
        start = body.skeleton.turned(dict(zip(moved, axes, strict=True)), poses[name])
        photos = [view for view in dataset.test if pose_of[view.name] == name]
        search = Search(steps=600, background=(1.0, 1.0, 1.0), joints=tuple(moved))
        found.append(errors(fit_pose(scene, photos, start, search), poses[name]))
        report(name, found[-1])
    report("all", np.concatenate(found))


def report(name: str, degrees: np.ndarray) -> None:
    mean, median, most = degrees.mean(), np.median(degrees), degrees.max()
    print(f"{name}: {len(degrees)} joints, mean {mean:.2f}, median {median:.2f}, largest {most:.2f} degrees")


MEASURES = {"hand": measure_hand, "robot": measure_robot, "recover": measure_recovery}

if __name__ == "__main__":
    MEASURES[sys.argv[1]](*map(int, sys.argv[2:6]))
