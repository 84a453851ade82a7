"""Lenses that distort: coordinates of a point's direction, then a map of the plane near the identity.

    place = bent(coordinates(point))

A subclass chooses the coordinates (slopes, or angles), another one the map. Polynomials fold the plane over
from some radius on: points beyond it are not seen.
"""

from abc import abstractmethod
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from splatax.cameras.lenses.protocol import NEAR
from splatax.math import inversion

MAX_SLOPE = 1e6  # |x / z| beyond which the perspective of a point overflows
ENTRIES = 256  # of the table of a radial distortion
SMALL = 1e-3  # squared slope below which the series of the arc tangent is exact


class Plane:
    """A map of the plane of coordinates to the image plane, and its inverse."""

    @abstractmethod
    def bent(self, coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns the place on the image plane of a direction's coordinates."""

    @abstractmethod
    def straightened(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns the coordinates of a place: the inverse of `bent`."""

    @abstractmethod
    def nearly_straightened(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns the coordinates of a place by the radial part; those on its limit if beyond."""

    @abstractmethod
    def unfolded(self, coordinates: Float[Array, "2"]) -> Bool[Array, ""]:
        """Returns whether coordinates lie inside of where the map folds."""


class Undistorted(Plane):
    """The identity as the map of the plane."""

    def bent(self, coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns the coordinates unchanged."""
        return coordinates

    def straightened(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns the place unchanged."""
        return place

    def nearly_straightened(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns the place unchanged."""
        return place

    def unfolded(self, coordinates: Float[Array, "2"]) -> Bool[Array, ""]:
        """Returns true: the identity does not fold."""
        return jnp.isfinite(coordinates[0])


class Distorted(Plane):
    """A map of the plane that is not the identity."""

    # Set by the coordinates: the radii of the table of the radial part, and whether there are no more.
    RADII: ClassVar[np.ndarray]
    BOUNDED: ClassVar[bool]

    @abstractmethod
    def radial(self, radius: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Returns the radius on the image plane of a radius of coordinates, by the radial part of the map."""

    def rise(self, dtype: np.dtype) -> inversion.Rise:
        """Returns the table of the radial part, up to where it folds."""
        return inversion.rise_of(self.radial, jnp.asarray(self.RADII, dtype))

    def straightened(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns the coordinates of a place: the inverse of `bent`; beyond the fold, those on it."""
        start, rise = self.nearly_straightened(place), self.rise(place.dtype)
        beyond = jnp.sum(place * place) > rise.outputs[-1] ** 2
        if not self.BOUNDED:
            beyond &= jnp.isfinite(rise.limit)
        inside = inversion.solved(type(self).bent, self, jnp.where(beyond, 0, place), start)
        return jnp.where(beyond, start, inside)

    def nearly_straightened(self, place: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns the coordinates of a place by the table of the radial part; on its limit if beyond."""
        radius = jnp.sqrt(jnp.maximum(jnp.sum(place * place), jnp.finfo(place.dtype).tiny))
        return place * (self.rise(place.dtype).inverse(radius) / radius)

    def unfolded(self, coordinates: Float[Array, "2"]) -> Bool[Array, ""]:
        """Returns whether coordinates lie inside of where the radial part folds."""
        return jnp.sum(coordinates * coordinates) < self.rise(coordinates.dtype).limit ** 2


class Slopes(Plane):
    """Coordinates of a perspective: (x, y) / z. Sees what is in front of the camera."""

    PERIOD: ClassVar[float | None] = None
    CENTRAL: ClassVar[bool] = True
    BOUNDED: ClassVar[bool] = False
    RADII: ClassVar[np.ndarray] = np.tan(np.linspace(0, 1.5, ENTRIES))

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Returns the place of a point in front of the camera."""
        return self.bent(point[:2] / point[2])

    def unproject(self, place: Float[Array, "2"], depth: Float[Array, ""]) -> Float[Array, "3"]:
        """Returns the point of this z at a place."""
        return depth * jnp.append(self.straightened(place), jnp.ones((), place.dtype))

    def depth(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        """Returns z."""
        return point[2]

    def sees(self, point: Float[Array, "3"]) -> Bool[Array, ""]:
        """Returns whether a point is in front of the near plane, and its image is neither folded nor
        overflows."""
        x, y, z = point
        seen = (z > NEAR) & jnp.isfinite(z) & (jnp.maximum(jnp.abs(x), jnp.abs(y)) < MAX_SLOPE * z)
        return seen & self.unfolded(jnp.where(seen, point[:2], 0) / jnp.where(seen, z, 1))

    def linearized_at(
        self, point: Float[Array, "3"], low: Float[Array, "2"], high: Float[Array, "2"]
    ) -> Float[Array, "3"]:
        """Returns the point, moved to the image's margin if it lies beside it.

        Beside the image the Jacobian becomes very large, and a single splat would cover the whole image.
        """
        lowest, highest = self.box(low, high)
        slopes = jnp.clip(point[:2] / point[2], lowest, highest)
        return jnp.append(slopes * point[2], point[2])

    def box(self, low: Float[Array, "2"], high: Float[Array, "2"]) -> tuple[Array, Array]:
        """Returns the box of the slopes that a box of the image plane shows."""
        if isinstance(self, Undistorted):
            return low, high
        middle = (low + high) / 2
        border = [
            jnp.stack([x, y]) for x in (low[0], middle[0], high[0]) for y in (low[1], middle[1], high[1])
        ]
        slopes = jnp.stack([self.nearly_straightened(place) for place in border])
        return jnp.min(slopes, axis=0), jnp.max(slopes, axis=0)


class Angles(Plane):
    """Coordinates of a fisheye: the angle from the z axis, in radians, times the direction of (x, y)."""

    PERIOD: ClassVar[float | None] = None
    CENTRAL: ClassVar[bool] = True
    BOUNDED: ClassVar[bool] = True
    RADII: ClassVar[np.ndarray] = np.linspace(0, np.pi, ENTRIES)

    def project(self, point: Float[Array, "3"]) -> Float[Array, "2"]:
        """Returns the place of a point at less than 180 degrees from the axis."""
        return self.bent(angles_of(point))

    def unproject(self, place: Float[Array, "2"], depth: Float[Array, ""]) -> Float[Array, "3"]:
        """Returns the point at this distance from the camera at a place."""
        angles = self.straightened(place)
        squared = jnp.sum(angles * angles)
        off = squared > 0
        angle = jnp.sqrt(jnp.where(off, squared, 1))
        sideways = jnp.where(off, jnp.sin(angle) / angle, 1) * angles
        return depth * jnp.append(sideways, jnp.where(off, jnp.cos(angle), 1))

    def depth(self, point: Float[Array, "3"]) -> Float[Array, ""]:
        """Returns the distance from the camera."""
        return jnp.linalg.norm(point)

    def sees(self, point: Float[Array, "3"]) -> Bool[Array, ""]:
        """Returns whether a point is neither at the camera, nor exactly behind it, nor folded."""
        squared = jnp.sum(point * point)
        aside = jnp.sum(point[:2] * point[:2])
        seen = (squared > NEAR**2) & jnp.isfinite(squared) & ((point[2] > 0) | (aside > 1e-4 * squared))
        return seen & self.unfolded(angles_of(jnp.where(seen, point, jnp.array([0, 0, 1], point.dtype))))

    def linearized_at(
        self, point: Float[Array, "3"], low: Float[Array, "2"], high: Float[Array, "2"]
    ) -> Float[Array, "3"]:
        """Returns the point itself: angles have a bounded Jacobian."""
        return point


def polynomial(coefficients: Float[Array, " k"], x: Float[Array, "*m"]) -> Float[Array, "*m"]:
    """Returns 1 + c1 x + c2 x^2 + ..., by Horner's rule."""
    value = jnp.zeros_like(x)
    for coefficient in coefficients[::-1]:
        value = (value + coefficient) * x
    return 1 + value


def tangential(coefficients: Float[Array, "2"], coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
    """Returns the tangential distortion (2 p1 u v + p2 (q + 2 u^2), p1 (q + 2 v^2) + 2 p2 u v)."""
    u, v = coordinates
    p1, p2 = coefficients
    q = u * u + v * v
    return jnp.array([2 * p1 * u * v + p2 * (q + 2 * u * u), p1 * (q + 2 * v * v) + 2 * p2 * u * v])


def quartic_prism(coefficients: Float[Array, "4"], q: Float[Array, ""]) -> Float[Array, "2"]:
    """Returns the thin-prism distortion (s1 q + s2 q^2, s3 q + s4 q^2)."""
    s1, s2, s3, s4 = coefficients
    return q * jnp.array([s1 + q * s2, s3 + q * s4])


def angles_of(point: Float[Array, "3"]) -> Float[Array, "2"]:
    """Returns the angle of a point from the z axis, radians, times the direction of its (x, y)."""
    squared, z = jnp.sum(point[:2] * point[:2]), point[2]
    near = (z > 0) & (squared < SMALL * z * z)
    t = jnp.where(near, squared, 0) / jnp.where(near, z * z, 1)
    series = (1 - t / 3 + t * t / 5 - t * t * t / 7) / jnp.where(near, z, 1)
    radius = jnp.sqrt(jnp.where(near, 1, squared))
    return jnp.where(near, series, jnp.arctan2(radius, jnp.where(near, 1, z)) / radius) * point[:2]
