"""Lenses that map angles, for fields of view up to 360 degrees: fisheyes and f-theta."""

from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.cameras.lenses.distortion import Angles, Distorted, polynomial, quartic_prism, tangential
from splatax.pytrees import pytree


class EvenPowers(Distorted, Angles):
    """Radial distortion of angles by even powers, t (1 + k1 t^2 + k2 t^4 + ...)."""

    radials: Float[Array, " k"]

    def radial(self, radius: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Returns distorted angles from the axis, by the radial part."""
        return radius * polynomial(self.radials, radius * radius)


@pytree
@dataclass(frozen=True)
class Fisheye(EvenPowers):
    """Fisheye of Kannala and Brandt (2006), as in OpenCV and COLMAP's OPENCV_FISHEYE.

        t' = t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)        for the angle t from the axis

    Attributes:
        radials: k1 to k4.
    """

    radials: Float[Array, "4"]

    def bent(self, coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns distorted angles."""
        return coordinates * polynomial(self.radials, jnp.sum(coordinates * coordinates))


@pytree
@dataclass(frozen=True)
class ThinPrismFisheye(EvenPowers):
    """Fisheye with tangential and thin-prism distortion, COLMAP's THIN_PRISM_FISHEYE.

    With angles (u, v) and q = u^2 + v^2:

        u' = u (1 + k1 q + k2 q^2 + k3 q^3 + k4 q^4) + 2 p1 u v + p2 (q + 2 u^2) + s1 q
        v' = v (the same) + p1 (q + 2 v^2) + 2 p2 u v + s2 q

    Attributes:
        radials: k1 to k4.
        tangentials: p1 and p2.
        prism: s1 and s2.
    """

    radials: Float[Array, "4"]
    tangentials: Float[Array, "2"]
    prism: Float[Array, "2"]

    def bent(self, coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns distorted angles."""
        q = jnp.sum(coordinates * coordinates)
        straight = coordinates * polynomial(self.radials, q)
        return straight + tangential(self.tangentials, coordinates) + q * self.prism


@pytree
@dataclass(frozen=True)
class RadTanThinPrismFisheye(EvenPowers):
    """Fisheye of Project Aria ("Fisheye624"), COLMAP's RAD_TAN_THIN_PRISM_FISHEYE.

    Radial distortion comes first; tangential and thin-prism distortion are those of its result (u, v):

        u' = u + 2 p1 u^2 + p1 q + 2 p2 u v + s1 q + s2 q^2
        v' = v + 2 p2 v^2 + p2 q + 2 p1 u v + s3 q + s4 q^2

    Attributes:
        radials: k1 to k6, of the powers 2 to 12 of the angle.
        tangentials: p1 and p2.
        prism: s1 to s4.
    """

    radials: Float[Array, "6"]
    tangentials: Float[Array, "2"]
    prism: Float[Array, "4"]

    def bent(self, coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns distorted angles."""
        first = coordinates * polynomial(self.radials, jnp.sum(coordinates * coordinates))
        q = jnp.sum(first * first)
        return first + tangential(self.tangentials[::-1], first) + quartic_prism(self.prism, q)


@pytree
@dataclass(frozen=True)
class FTheta(Distorted, Angles):
    """NVIDIA's f-theta lens: the radius on the image is a polynomial of the angle.

        r = t (1 + a1 t + a2 t^2 + a3 t^3 + a4 t^4)        for the angle t from the axis

    The first coefficient of the polynomial in pixels is the focal length.

    Attributes:
        powers: a1 to a4.
        widest: angle from the axis beyond which nothing is seen, radians.
    """

    powers: Float[Array, "4"]
    widest: Float[Array, ""]

    def bent(self, coordinates: Float[Array, "2"]) -> Float[Array, "2"]:
        """Returns angles mapped to the radius on the image."""
        squared = jnp.sum(coordinates * coordinates)
        off = squared > 0
        angle = jnp.sqrt(jnp.where(off, squared, 1))
        return coordinates * jnp.where(off, polynomial(self.powers, angle), 1)

    def radial(self, radius: Float[Array, "*m"]) -> Float[Array, "*m"]:
        """Returns radii on the image; it stops growing at the widest angle."""
        inside = jnp.minimum(radius, self.widest)
        return inside * polynomial(self.powers, inside)
