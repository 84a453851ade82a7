"""A controller that servoes on simulated images: `python docs/servo_twin.py [SIZE]`.

A camera looks at the small arm of `splatax.demo.robot`. The controller knows one picture with depth, taken
where the arm should be. In each step it compares it with what the camera sees now, and turns the joints. How
far it turns them follows from the derivative of the picture in the joints: MuJoCo's Jacobians of the bodies,
pushed through the renderer by `jax.jvp`. It needs the packages of the extra "twins".
"""

import sys
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

import splatax as sx
from splatax import twins
from splatax.demo.robot import ARM, drawn_twin
from splatax.math import quaternions

DEPTH = 2.0  # weight of a metre of depth beside a step of colour from 0 to 1
DAMPING = 0.001  # of the least squares, relative to the largest curvature
GAIN = 0.5  # fraction of the way to the solution that a step takes
SUBSTEPS = 40  # steps of the simulation for each picture, 0.2 s
GOAL = np.array([0.3, 0.4, -0.5, 0.2])
START = GOAL + np.array([0.15, -0.12, 0.15, 0.2])


@dataclass(frozen=True)
class Step:
    """One step of the controller."""

    joints: np.ndarray  # positions, radians
    image_error: float  # root mean square difference to the goal's picture


def tangents_of(model: mujoco.MjModel, data: mujoco.MjData, frames: twins.Frames) -> twins.Frames:
    """Returns how the frames move with each joint, with a leading axis for the joints."""
    quats, places = [], []
    for name, quat in zip(frames.names, frames.quats, strict=True):
        linear, angular = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        mujoco.mj_jacBody(model, data, linear, angular, data.body(name).id)
        spins = np.concatenate([np.zeros((model.nv, 1)), angular.T], axis=1).astype(np.float32)
        turning = jax.vmap(quaternions.multiply, (0, None))(jnp.asarray(spins), jnp.asarray(quat))
        quats.append(0.5 * turning)  # the derivative of a unit quaternion: half of spin times quaternion
        places.append(linear.T.astype(np.float32))
    return twins.Frames(jnp.stack(quats, 1), jnp.stack(places, 1), frames.names)


@jax.jit
def picture_and_slopes(scene, frames, tangents, camera):
    """Returns the picture that the camera sees, and its derivative in each joint."""

    def picture(frames):
        outputs = ("rgb", "depth", "alpha")
        drawn = sx.render(frames.place(scene), camera, outputs=outputs)
        return jnp.dstack([drawn.rgb, DEPTH * drawn.depth * drawn.alpha])

    def along(tangent):
        return jax.jvp(picture, (frames,), (tangent,))[1]

    return picture(frames), jax.vmap(along)(tangents)


def servo(size: int = 64, count: int = 1500, steps: int = 40) -> list[Step]:
    """Moves the arm from START to GOAL by its pictures, and returns the steps."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    scene = jax.tree.map(jnp.asarray, drawn_twin(model, count))

    def look():
        frames = twins.frames_of(model, data, scene.names)
        camera = twins.camera_of(model, data, "front", size, size)
        return picture_and_slopes(scene, frames, tangents_of(model, data, frames), camera)

    data.qpos[:] = GOAL
    mujoco.mj_forward(model, data)
    goal, _ = look()
    mujoco.mj_resetData(model, data)
    data.qpos[:] = START
    data.ctrl[:] = START
    mujoco.mj_forward(model, data)
    found = []
    for _ in range(steps):
        seen, slopes = look()
        error = np.asarray(goal - seen, np.float64).ravel()
        found.append(Step(data.qpos.copy(), float(np.sqrt(np.mean(error**2)))))
        rows = np.asarray(slopes, np.float64).reshape(model.nv, -1)
        curvature = rows @ rows.T
        damped = curvature + DAMPING * curvature.diagonal().max() * np.eye(model.nv)
        data.ctrl[:] = data.qpos + GAIN * np.linalg.solve(damped, rows @ error)
        mujoco.mj_step(model, data, nstep=SUBSTEPS)
        mujoco.mj_forward(model, data)
    return found


def main(size: int = 64) -> None:
    for number, step in enumerate(servo(size)):
        apart = np.degrees(np.abs(step.joints - GOAL).max())
        print(f"step {number:2}: pictures differ by {step.image_error:.4f}, joints by {apart:.2f} degrees")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
