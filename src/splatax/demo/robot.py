"""A small robot arm: its MJCF, and Gaussians drawn on the boxes of a MuJoCo model.

The arm is lit evenly from all sides, without shadows, so that its colours are the same in every pose. Its
links are separate boxes with gaps between them, so that photos of one pose show all of their faces.
"""

from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from splatax.gaussians import Gaussians, joined
from splatax.math import harmonics
from splatax.scene import Part, Scene

BOX = 6  # mjGEOM_BOX
FLATNESS = 0.15  # thickness of a Gaussian over its width
OPACITY = 0.95
PALETTE = np.array(
    [[0.3, 0.45, 0.35], [0.5, 0.5, 0.55], [0.7, 0.5, 0.2], [0.7, 0.3, 0.2], [0.2, 0.35, 0.7], [0.3, 0.6, 0.3]]
)
JOINTS = ("turret", "shoulder", "elbow", "wrist")


def _textures(colors: dict[str, str]) -> str:
    rows = (
        f'<texture name="{name}" type="cube" builtin="flat" mark="random" random="0.35" rgb1="{rgb}" '
        f'markrgb="0.95 0.9 0.8" width="12" height="72"/><material name="{name}" texture="{name}"/>'
        for name, rgb in colors.items()
    )
    return "".join(rows)


ARM = f"""<mujoco model="arm">
  <compiler angle="radian"/>
  <option timestep="0.005" gravity="0 0 0"/>
  <visual>
    <headlight ambient="1 1 1" diffuse="0 0 0" specular="0 0 0"/>
    <quality offsamples="0"/>
    <global offwidth="1024" offheight="1024"/>
    <map znear="0.02"/>
  </visual>
  <asset>{
    _textures(
        {
            "table": ".25 .4 .3",
            "grey": ".45 .45 .5",
            "red": ".7 .2 .15",
            "blue": ".15 .3 .65",
            "green": ".2 .55 .25",
            "gold": ".75 .55 .1",
        }
    )
}</asset>
  <default>
    <joint damping="2"/><geom contype="0" conaffinity="0" density="300"/>
    <position kp="20" ctrlrange="-1.2 1.2"/>
  </default>
  <worldbody>
    <camera name="front" pos="1.5 -0.7 0.75" xyaxes="0.42 0.9 0 -0.2 0.1 0.97" fovy="42"/>
    <geom type="box" size=".4 .4 .01" pos="0 0 -.01" rgba="1 1 1 1" material="table"/>
    <body name="base" pos="0 0 .03">
      <geom type="box" size=".09 .09 .05" pos="0 0 .05" material="grey"/>
      <body name="turret" pos="0 0 .13">
        <joint name="turret" axis="0 0 1"/>
        <geom type="box" size=".06 .07 .03" pos="0 0 .03" material="gold"/>
        <body name="upper" pos="0 0 .08">
          <joint name="shoulder" axis="0 1 0"/>
          <geom type="box" size=".035 .045 .12" pos="0 0 .15" material="red"/>
          <body name="fore" pos="0 0 .3">
            <joint name="elbow" axis="0 1 0"/>
            <geom type="box" size=".03 .04 .1" pos="0 0 .135" material="blue"/>
            <body name="hand" pos="0 0 .265">
              <joint name="wrist" axis="1 0 0"/>
              <geom type="box" size=".05 .025 .04" pos="0 0 .07" material="green"/>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator>{"".join(f'<position joint="{joint}"/>' for joint in JOINTS)}</actuator>
</mujoco>
"""


def drawn_twin(model: Any, count: int, seed: int = 0) -> Scene:
    """Returns flat Gaussians on the boxes of a model: a stand-in for a trained scene of parts.

    Each body with boxes is a part, in the body's coordinates, with a colour and a pattern of its own.

    Args:
        model: `mujoco.MjModel`; only its boxes are drawn.
        count: number of Gaussians, divided among the boxes by their area.
        seed: of their places.

    Raises:
        ValueError: if the model has no boxes.
    """
    boxes = np.flatnonzero(np.asarray(model.geom_type) == BOX)
    if not len(boxes):
        raise ValueError("the model has no boxes to draw.")
    rng, sizes = np.random.default_rng(seed), np.asarray(model.geom_size)[boxes]
    faces = 8 * np.stack([sizes[:, 1] * sizes[:, 2], sizes[:, 0] * sizes[:, 2], sizes[:, 0] * sizes[:, 1]], 1)
    numbers = np.maximum(np.round(count * faces.sum(1) / faces.sum()).astype(int), 6)
    width = np.sqrt(faces.sum() / count)
    found: dict[str, list[Gaussians]] = {}
    for geom, number, area in zip(boxes, numbers, faces, strict=True):
        name = model.body(int(model.geom_bodyid[geom])).name
        found.setdefault(name, []).append(_box(model, int(geom), int(number), area, 0.6 * width, rng))
    return Scene({name: Part(joined(rows)) for name, rows in found.items()})


def _box(
    model: Any, geom: int, count: int, area: Float[np.ndarray, "3"], sigma: float, rng: np.random.Generator
) -> Gaussians:
    half = np.asarray(model.geom_size)[geom]
    axis = rng.choice(3, size=count, p=area / area.sum())
    local = rng.uniform(-1, 1, (count, 3)) * half
    side = np.eye(3)[axis]
    local = np.where(side > 0, np.sign(rng.uniform(-1, 1, (count, 1))) * half, local)
    scales = sigma * np.where(side > 0, FLATNESS, 1.0)
    w, x, y, z = np.asarray(model.geom_quat)[geom]
    turn = Rotation.from_quat([x, y, z, w])
    color = PALETTE[int(model.geom_bodyid[geom]) % len(PALETTE)]
    pattern = 0.2 * np.sin(local @ np.array([[60, 20, 10], [15, 70, 25], [20, 10, 50]]))
    rgb = np.clip(color + pattern, 0, 1)
    sh = np.zeros((count, 1, 3))
    sh[:, 0] = harmonics.from_rgb(rgb)
    fields = (
        turn.apply(local) + np.asarray(model.geom_pos)[geom],
        np.tile([w, x, y, z], (count, 1)),
        np.log(scales),
        np.full(count, np.log(OPACITY / (1 - OPACITY))),
        sh,
    )
    return Gaussians(*(jnp.asarray(rows, jnp.float32) for rows in fields))
