"""Measures color, depth and labels a second: `python docs/measure_frames.py [SCENE.ply [CAPTURE]]`.

The scene is the synthetic arm with 11,000 Gaussians in 6 parts, whose joints differ in each frame, or a
splat file that is cut into 6 slabs of equal size, each of which moves a little in each frame. The camera sees
all of it, or is the first one of a capture with a square image. 32 frames of 128 x 128 pixels are drawn
together by `vmap` in one compiled program. Times are the best of 5 rounds; CPU time counts all cores, so on a
busy machine `cores / CPU time` is what an idle one reaches at most.
"""

import os
import sys
import time

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import splatax as sx
from splatax import twins
from splatax.demo.robot import ARM, drawn_twin
from splatax.sensors import Color, Depth, Labels, observe
from splatax.trajectories import overview

SIZE, FRAMES, COUNT, ROUNDS, SLABS = 128, 32, 11_000, 5, 6
ASKED = {
    "RGB": {"rgb": Color()},
    "RGB-D, mean depth": {"rgb": Color(), "depth": Depth(surface="depth")},
    "RGB-D, surface depth": {"rgb": Color(), "depth": Depth()},
    "RGB-D-label, mean depth": {"rgb": Color(), "depth": Depth(surface="depth"), "labels": Labels()},
    "RGB-D-label, surface depth": {"rgb": Color(), "depth": Depth(), "labels": Labels()},
}


def arm() -> tuple[sx.Scene, twins.Frames, sx.Camera]:
    """Returns the synthetic arm, its bodies in different joint configurations, and a camera."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    scene, found = drawn_twin(model, COUNT), []
    for _ in range(FRAMES):
        data.qpos[:] = rng.uniform(-0.6, 0.6, model.nq)
        mujoco.mj_forward(model, data)
        found.append(twins.frames_of(model, data, scene.names))
    camera = twins.camera_of(model, data, "front", SIZE, SIZE)
    return scene, jax.tree.map(lambda *rows: jnp.stack(rows), *found), camera


def slabs(path: str, capture: str | None = None) -> tuple[sx.Scene, twins.Frames, sx.Camera]:
    """Returns a splat file as parts, poses that move each a little, and a camera."""
    gaussians = sx.load(path)
    order = np.argsort(np.asarray(gaussians.means[:, 0]))
    parts = {
        f"slab {i}": sx.Part(jax.tree.map(lambda leaf, rows=rows: leaf[rows], gaussians))
        for i, rows in enumerate(np.array_split(order, SLABS))
    }
    places = np.random.default_rng(0).normal(size=(FRAMES, SLABS, 3)).astype(np.float32) * 0.01
    turns = np.tile(np.float32([1, 0, 0, 0]), (FRAMES, SLABS, 1))
    camera = overview(np.asarray(gaussians.means), (SIZE, SIZE))
    if capture:
        view = sx.load_dataset(capture).views[0].camera
        focal = float(view.fy) * SIZE / view.height
        camera = sx.Camera.simple_pinhole(focal, view.cam_from_world, SIZE, SIZE)
    return sx.Scene(parts), twins.Frames(jnp.asarray(turns), jnp.asarray(places), tuple(parts)), camera


def main(path: str | None = None, capture: str | None = None) -> None:
    scene, frames, camera = slabs(path, capture) if path else arm()
    scene = jax.tree.map(jnp.asarray, scene)
    print(f"{len(scene):,} Gaussians in {len(scene.names)} parts, {os.cpu_count()} cores")
    programs = {
        name: jax.jit(
            jax.vmap(
                lambda scene, frames, camera, asked=asked: observe(frames.place(scene), camera, asked),
                in_axes=(None, 0, None),
            )
        )
        for name, asked in ASKED.items()
    }
    best = dict.fromkeys(ASKED, (np.inf, np.inf))
    for _ in range(ROUNDS + 1):  # the first round compiles
        for name, program in programs.items():
            wall, cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(program(scene, frames, camera))
            taken = time.perf_counter() - wall, time.process_time() - cpu
            best[name] = tuple(map(min, best[name], taken))
    for name, (wall, cpu) in best.items():
        print(
            f"{name:28} {FRAMES / wall:6.0f} frames/s measured, {1e3 * cpu / FRAMES:6.2f} ms of CPU a frame, "
            f"{os.cpu_count() * FRAMES / cpu:6.0f} frames/s at most"
        )


if __name__ == "__main__":
    main(*sys.argv[1:])
