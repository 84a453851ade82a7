"""Lenses that are not photographic: the whole sphere as a map, and parallel projection."""

import math
from dataclasses import dataclass
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.cameras.lenses.protocol import NEAR
from splatax.pytrees import pytree

POLE = 0.1  # tangent of the angle from a pole up to which the Jacobian follows the mean


@pytree
@dataclass(frozen=True)
class Equirectangular:
    """Longitude and latitude, radians: the 2:1 panoramas of 360-degree cameras.

    The middle of the image looks along z. With fx = width / (2 pi) and fy = height / pi, and the principal
    point in the middle, the image shows everything once; see `cameras.panorama`.
    """

    PERIOD: ClassVar[float | None] = 2 * math.pi
    CENTRAL: ClassVar[bool] = True

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Returns longitude, to the right, and latitude, downwards."""
        x, y, z = point
        return jnp.array([jnp.arctan2(x, z), jnp.arctan2(y, jnp.sqrt(x * x + z * z))])

    def unproject(self, place: Float[Array, "2"], depth: Float[Array, ""]) -> Float[Array, "3"]:
        """Returns the point at this distance from the camera at a longitude and latitude."""
        longitude, latitude = place
        aside = jnp.cos(latitude)
        return depth * jnp.array([aside * jnp.sin(longitude), jnp.sin(latitude), aside * jnp.cos(longitude)])

    def depth(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        """Returns the distance from the camera."""
        return jnp.linalg.norm(point)

    def sees(self, point: Float[Array, "3"]) -> Bool[Array, ""]:
        """Returns whether a point is neither at the camera nor exactly at a pole."""
        aside, squared = point[0] ** 2 + point[2] ** 2, jnp.sum(point * point)
        return (squared > NEAR**2) & (aside > 1e-8 * squared) & jnp.isfinite(squared)

    def linearized_at(
        self, point: Float[Array, "3"], low: Float[Array, "2"], high: Float[Array, "2"]
    ) -> Float[Array, "3"]:
        """Returns the point, moved away from the poles, where a Gaussian would cover all longitudes."""
        x, y, z = point
        aside = jnp.sqrt(x * x + z * z)
        away = jnp.maximum(POLE * jnp.abs(y) / aside, 1)
        return jnp.array([x * away, y, z * away])


@pytree
@dataclass(frozen=True)
class Orthographic:
    """Parallel projection along z, as of orthophotos. Focal lengths are pixels for a world unit."""

    PERIOD: ClassVar[float | None] = None
    CENTRAL: ClassVar[bool] = False

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Returns x and y, world units."""
        return point[:2]

    def unproject(self, place: Float[Array, "2"], depth: Float[Array, ""]) -> Float[Array, "3"]:
        """Returns the point of this z at a place."""
        return jnp.append(place, depth)

    def depth(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        """Returns z."""
        return point[2]

    def sees(self, point: Float[Array, "3"]) -> Bool[Array, ""]:
        """Returns whether a point is in front of the near plane."""
        return (point[2] > NEAR) & jnp.all(jnp.isfinite(point))

    def linearized_at(
        self, point: Float[Array, "3"], low: Float[Array, "2"], high: Float[Array, "2"]
    ) -> Float[Array, "3"]:
        """Returns the point itself: the Jacobian is the same everywhere."""
        return point
