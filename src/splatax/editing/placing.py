"""Merging of scenes, levelling, and reduction of spherical harmonics."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera, rig
from splatax.errors import InputError
from splatax.gaussians import Gaussians, joined
from splatax.math import harmonics
from splatax.transforms import Similarity

UP = np.array([0.0, -1.0, 0.0])  # up in the files that viewers expect: y points down, as in a camera
LEAST_AGREEMENT = 0.2  # least length of the mean of the vectors to the tops of the images


def merge(scenes: Sequence[Gaussians]) -> Gaussians:
    """Merges scenes that share one coordinate frame. Missing higher harmonics become zeros.

    Raises:
        InputError: if the scenes were trained with different low-pass filters: none draws all of them right.
    """
    if len({scene.low_pass for scene in scenes}) > 1:
        raise InputError(
            "The scenes cannot be merged: they were trained with different low-pass filters. Train them "
            "alike."
        )
    return joined(scenes)


def reduce_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Returns the scene without harmonics above `degree`; a degree above the scene's changes nothing."""
    return replace(gaussians, sh=gaussians.sh[:, : harmonics.count(degree)])


def level(cameras: Sequence[Camera]) -> Similarity:
    """Returns the smallest rotation that levels a scene: the direction that is up to its cameras becomes -y.

    Raises:
        InputError: if the cameras do not agree on a direction that is up.
    """
    if np.linalg.norm(rig.tops_of(cameras).mean(axis=0)) < LEAST_AGREEMENT:
        raise InputError(
            "The cameras were held in all directions, so they do not tell which way is up. Give a rotation."
        )
    up = rig.up_of(cameras)
    axis = np.cross(up, UP)
    sine = float(np.linalg.norm(axis))
    axis = axis / sine if sine > 1e-9 else np.array([1.0, 0.0, 0.0])  # upside down: any horizontal axis
    angle = np.arctan2(sine, up @ UP)
    return Similarity(Rotation.from_rotvec(angle * axis).as_matrix(), np.zeros(3))
