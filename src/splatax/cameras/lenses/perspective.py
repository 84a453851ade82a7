"""Lenses that keep straight lines straight, up to a distortion: pinhole, OpenCV's, and COLMAP's FOV."""

from dataclasses import dataclass

import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from splatax.cameras.lenses.distortion import (
    Distorted,
    Slopes,
    Undistorted,
    polynomial,
    quartic_prism,
    tangential,
)
from splatax.pytrees import pytree


@pytree
@dataclass(frozen=True)
class Pinhole(Undistorted, Slopes):
    """Perspective without distortion: (x, y) / z."""


@pytree
@dataclass(frozen=True)
class OpenCV(Distorted, Slopes):
    """Perspective with OpenCV's distortion: radial (rational), tangential and thin prism.

    With slopes (x, y) and q = x^2 + y^2:

        f = (1 + k1 q + k2 q^2 + k3 q^3) / (1 + k4 q + k5 q^2 + k6 q^3)
        x' = x f + 2 p1 x y + p2 (q + 2 x^2) + s1 q + s2 q^2
        y' = y f + p1 (q + 2 y^2) + 2 p2 x y + s3 q + s4 q^2

    Attributes:
        radials: k1 to k6.
        tangentials: p1 and p2.
        prism: s1 to s4.
    """

    radials: Float[Array, "6"]
    tangentials: Float[Array, "2"]
    prism: Float[Array, "4"]

    def bent(self, coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns distorted slopes."""
        q = jnp.sum(coordinates * coordinates)
        straight = coordinates * self._factor(q)
        return straight + tangential(self.tangentials, coordinates) + quartic_prism(self.prism, q)

    def radial(self, radius: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Returns distorted radii."""
        return radius * self._factor(radius * radius)

    def _factor(self, q: Float[Array, "*m"]) -> Float[Array, "*m"]:
        return polynomial(self.radials[:3], q) / polynomial(self.radials[3:], q)


def opencv(*coefficients: float, dtype: DTypeLike = "float32") -> OpenCV:
    """Returns the lens of OpenCV's distortion coefficients, in OpenCV's order.

    Args:
        coefficients: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4; those that are left out are zero.
        dtype: of the numbers.
    """
    k1, k2, p1, p2, k3, k4, k5, k6, *prism = (*coefficients, *[0.0] * 12)[:12]
    arrays = ([k1, k2, k3, k4, k5, k6], [p1, p2], prism)
    return OpenCV(*(jnp.asarray(array, dtype) for array in arrays))


@pytree
@dataclass(frozen=True)
class FieldOfView(Distorted, Slopes):
    """Perspective distorted by an angle (Devernay and Faugeras 2001; COLMAP's FOV).

    With the radius r of the slopes: r' = atan(2 r tan(w / 2)) / w.

    Attributes:
        angle: w, radians, not zero.
    """

    angle: Float[Array, ""]

    def bent(self, coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns distorted slopes."""
        squared = jnp.sum(coordinates * coordinates)
        off = squared > 0
        radius = jnp.sqrt(jnp.where(off, squared, 1))
        return coordinates * jnp.where(off, self.radial(radius) / radius, self._stretch() / self.angle)

    def radial(self, radius: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Returns distorted radii."""
        return jnp.arctan(radius * self._stretch()) / self.angle

    def _stretch(self) -> Float[Array, ""]:
        return 2 * jnp.tan(self.angle / 2)
