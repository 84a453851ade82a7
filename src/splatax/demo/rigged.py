"""Captures of bodies in known poses, photographed with exact cameras."""

from collections.abc import Mapping, Sequence
from functools import cache, partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera, look_at
from splatax.dataset import Dataset, Pixels, PointCloud, View
from splatax.demo.meshes import photograph_mesh
from splatax.io.rigs.nodes import FRAME
from splatax.scene.body import Body, Surface
from splatax.scene.clips import Channel, Clip
from splatax.scene.skeleton import Pose, Skeleton

DISTANCE = 2.2  # of the cameras from the middle, in sizes of the body
FOCAL = 1.75  # in widths of a photo
WAVES = np.array([47.0, 61.0, 53.0])  # radians over the size of the body, along each axis


def drawn_arm(bones: int = 3, sides: int = 12) -> Body:
    """Returns a tube that bends at joints, with a clip "Wave", made without any file.

    Args:
        bones: number of joints, one above the other, each the root of a bone of length 1.
        sides: corners of the tube's cross-section.
    """
    rings = 8 * bones + 1
    height = np.linspace(0, bones, rings)
    angle = 2 * np.pi * np.arange(sides) / sides
    radius = 0.35 - 0.15 * height / bones
    ring = np.stack([np.cos(angle), np.zeros(sides), np.sin(angle)], axis=1)
    vertices = ring[None] * radius[:, None, None] - np.array([0, 1, 0]) * height[:, None, None]
    vertices = np.concatenate([vertices.reshape(-1, 3), [[0, 0, 0], [0, -bones, 0]]])  # y points down
    place = np.concatenate([np.repeat(height, sides), [0, bones]])
    first = np.clip(np.floor(place - 0.5), 0, bones - 1).astype(int)
    second = np.minimum(first + 1, bones - 1)
    weight = np.clip((place - first - 0.75) / 0.5, 0, 1)  # blends a quarter bone around each joint
    i, k = np.meshgrid(np.arange(rings - 1), np.arange(sides), indexing="ij")
    a, b = i * sides + k, i * sides + (k + 1) % sides
    around = np.arange(sides)
    bottom, top = np.full(sides, rings * sides), np.full(sides, rings * sides + 1)
    after, last = (around + 1) % sides, (rings - 1) * sides
    triangles = np.concatenate(
        [
            np.stack([a, b, a + sides], axis=-1).reshape(-1, 3),
            np.stack([b, b + sides, a + sides], axis=-1).reshape(-1, 3),
            np.stack([bottom, after, around], axis=1),
            np.stack([top, last + around, last + after], axis=1),
        ]
    )
    steps = np.array([[0, 0 if bone == 0 else 1.0, 0] for bone in range(bones)])  # y up, as in glTF
    turns = np.tile([1.0, 0, 0, 0], (bones, 1))
    rest = Pose(*(jnp.asarray(rows, jnp.float32) for rows in (steps, turns, np.ones((bones, 3)))))
    worlds = np.tile(FRAME, (bones, 1, 1))
    worlds[:, 1, 3] = -np.arange(bones)
    skeleton = Skeleton(
        rest,
        jnp.asarray(np.linalg.inv(worlds), jnp.float32),
        jnp.asarray(FRAME, jnp.float32),
        tuple(f"bone {bone}" for bone in range(bones)),
        tuple(range(-1, bones - 1)),
    )
    times = np.linspace(0, 2, 9)
    bend = 0.6 * np.sin(np.pi * times)
    values = np.stack([np.cos(bend / 2), 0 * bend, 0 * bend, np.sin(bend / 2)], axis=1)[:, None]
    wave = Clip(
        "Wave",
        tuple(Channel(bone, "rotation", times, values, "LINEAR") for bone in range(1, bones)),
    )
    surface = Surface(
        vertices,
        triangles,
        np.stack([first, second], axis=1),
        np.stack([1 - weight, weight], axis=1),
        np.tile([0.8, 0.55, 0.35], (len(vertices), 1)),
    )
    return Body(skeleton, {"Wave": wave}, surface)


def moves_of(body: Body, pose: Pose) -> Float[np.ndarray, "j 4 4"]:
    """Returns the transforms of the joints from the bound pose, in double precision."""
    worlds = np.asarray(body.skeleton.worlds(pose), np.float64)
    return worlds @ np.asarray(body.skeleton.inverse_binds, np.float64)


def posed_dataset(
    body: Body, photos: Mapping[str, tuple[Pose, Camera]], held_out: Sequence[str] = ()
) -> Dataset:
    """Returns a capture of a body: photos on transparent ground, drawn when their `pixels` is called first.

    A procedural texture sticks to the surface, over its own colours.

    Args:
        body: the skeleton and its surface.
        photos: pose and camera of each photo, by name.
        held_out: names of the photos that are not for training.
    """
    views = [
        View(name, camera, cache(partial(_pixels, body, pose, camera)))
        for name, (pose, camera) in photos.items()
    ]
    train = tuple(view for view in views if view.name not in held_out)
    test = tuple(view for view in views if view.name in held_out)
    none = np.zeros((0, 3), np.float32)
    return Dataset(train, test, PointCloud(none, none), background="white")


def camera_around(body: Body, azimuth: float, elevation: float, size: int) -> Camera:
    """Returns a camera that looks at the middle of a body in its bound pose, y down.

    Args:
        body: the body.
        azimuth: radians around the vertical axis.
        elevation: radians above the horizon.
        size: width and height of the photo, pixels.
    """
    middle, length = _frame(body)
    direction = np.array(
        [
            np.cos(elevation) * np.sin(azimuth),
            -np.sin(elevation),
            -np.cos(elevation) * np.cos(azimuth),
        ]
    )
    eye = middle + DISTANCE * length * direction
    pose = look_at(*(jnp.asarray(v, jnp.float32) for v in (eye, middle, (0.0, -1.0, 0.0))))
    return Camera.simple_pinhole(FOCAL * size, pose, size, size)


def _pixels(body: Body, pose: Pose, camera: Camera) -> Pixels:
    surface, (middle, length) = body.surface, _frame(body)

    def texture(places: Float[np.ndarray, "p 3"], colors: Float[np.ndarray, "p 3"]) -> np.ndarray:
        u = (places - middle) / length
        stripes = np.sin(u * WAVES + [0, 1, 2] + 2 * np.sin(u[:, [1, 2, 0]] * 31))
        return 0.5 * colors + 0.25 + 0.22 * stripes

    posed = surface.posed(moves_of(body, pose))
    return photograph_mesh(camera, posed, surface.triangles, surface.vertices, surface.colors, texture)


def _frame(body: Body) -> tuple[Float[np.ndarray, "3"], float]:
    vertices = body.surface.vertices
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return (low + high) / 2, float((high - low).max())
