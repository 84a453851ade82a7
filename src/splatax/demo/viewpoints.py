"""Viewpoints from which the photos of a synthetic capture are taken."""

from dataclasses import dataclass
from itertools import count
from math import gcd

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.cameras import look_at
from splatax.demo.shapes import Vector

CIRCLE = (0.0, 360.0)


@dataclass(frozen=True)
class Orbit:
    """Cameras around a point, which they look at.

    Attributes:
        target: the point.
        distance: distance of the cameras from it.
        azimuths: range in degrees, from the direction of -y. `CIRCLE` is all around.
        elevations: degrees, which the cameras take in turn.
    """

    target: Vector
    distance: float
    azimuths: tuple[float, float] = CIRCLE
    elevations: tuple[float, ...] = (14.0, 30.0, 46.0)

    def poses(self, photos: int) -> list[Float[Array, "4 4"]]:
        """Returns `cam_from_world` of each photo. Every 8th of them lies between others."""
        target = np.array(self.target)
        poses = []
        for i, azimuth in enumerate(np.radians(in_turn(self.azimuths, photos))):
            elevation = np.radians(self.elevations[i % len(self.elevations)])
            level = np.array([np.sin(azimuth), -np.cos(azimuth), 0]) * np.cos(elevation)
            position = target + self.distance * (level + [0, 0, np.sin(elevation)])
            poses.append(_pose(position, target))
        return poses


@dataclass(frozen=True)
class Outward:
    """Cameras on a level circle that look away from its centre, as in a room.

    Attributes:
        centre: of the circle.
        radius: of the circle.
        tilts: degrees above the horizon, which the cameras take in turn.
        heights: offsets from the height of the centre, taken in turn.
    """

    centre: Vector
    radius: float
    tilts: tuple[float, ...] = (-18.0, 12.0)
    heights: tuple[float, ...] = (-0.25, 0.0, 0.25)

    def poses(self, photos: int) -> list[Float[Array, "4 4"]]:
        """Returns `cam_from_world` of each photo."""
        poses = []
        for i, azimuth in enumerate(np.radians(in_turn(CIRCLE, photos))):
            level = np.array([np.sin(azimuth), -np.cos(azimuth), 0])
            height = self.heights[i % len(self.heights)]
            position = np.array(self.centre) + self.radius * level + [0, 0, height]
            tilt = np.tan(np.radians(self.tilts[i % len(self.tilts)]))
            poses.append(_pose(position, position + level + [0, 0, tilt]))
        return poses


Viewpoints = Orbit | Outward


def in_turn(azimuths: tuple[float, float], photos: int) -> Float[np.ndarray, " photos"]:
    """Returns evenly spaced azimuths in an order in which neighbours are far apart, each once."""
    step = next(k for k in count(7) if gcd(k, photos) == 1)
    spaced = np.linspace(*azimuths, photos, endpoint=azimuths != CIRCLE)
    return spaced[(np.arange(photos) * step + photos // 2) % photos]


def _pose(position: np.ndarray, target: np.ndarray) -> Float[Array, "4 4"]:
    return look_at(*(jnp.asarray(v, jnp.float32) for v in (position, target, (0, 0, 1))))
