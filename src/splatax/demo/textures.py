"""Colours of points on surfaces, as functions of position, and of the sky, as functions of direction."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.demo.shapes import Point, Shape, Vector

Texture = Callable[[Point], Point]  # a point on a surface -> RGB albedo; for a sky, a unit direction -> RGB


@dataclass(frozen=True)
class Surface:
    """A shape with a texture.

    Attributes:
        shape: the geometry.
        texture: albedo of each point.
        gloss: strength of the lamp's highlight.
        mirror: fraction of the light that comes from the mirrored direction, in [0, 1].
    """

    shape: Shape
    texture: Texture
    gloss: float = 0.0
    mirror: float = 0.0


def plain(*rgb: float) -> Texture:
    """Returns the texture of one RGB colour."""
    return lambda point: jnp.array(rgb)


def checks(first: Texture, second: Texture, size: float) -> Texture:
    """Returns a three-dimensional checkerboard of two textures."""

    def texture(point: Point) -> Point:
        odd = jnp.sum(jnp.floor(point / size + 1e-3)) % 2 == 1
        return jnp.where(odd, first(point), second(point))

    return texture


def rings(first: Texture, second: Texture, axis: Vector, width: float) -> Texture:
    """Returns smooth bands of two textures across an axis."""

    def texture(point: Point) -> Point:
        blend = jnp.clip(0.5 + jnp.sin(point @ jnp.array(axis, point.dtype) * (jnp.pi / width)), 0, 1)
        return first(point) + (second(point) - first(point)) * blend

    return texture


def clouds(first: Texture, second: Texture, size: float) -> Texture:
    """Returns an irregular mixture of two textures whose patches have about the given size.

    The mixture is a sum of three warped sines, each of half the wavelength and weight of the one before.
    """

    def texture(point: Point) -> Point:
        blend = _waves(point * (2 * jnp.pi / size))
        return first(point) + (second(point) - first(point)) * jnp.clip(0.5 + 0.4 * blend, 0, 1)

    return texture


def wood(point: Point) -> Point:
    """Returns the colour of wood with its grain along x."""
    x, y, _ = point
    grain = jnp.sin(26 * y + 2.5 * jnp.sin(2.1 * x) + 1.3 * jnp.sin(7.3 * y + 0.8 * x))
    fine = jnp.sin(140 * y + 5 * jnp.sin(3 * x))
    return (0.8 + 0.12 * grain + 0.05 * fine) * jnp.array([0.62, 0.42, 0.26])


def open_sky(direction: Point) -> Point:
    """Returns the colour of a cloudy sky along a direction whose z points up."""
    height = jnp.clip(direction[2], 0, 1)
    blue = jnp.array([0.75, 0.84, 0.95]) + height * jnp.array([-0.5, -0.4, -0.15])
    white = jnp.clip(_waves(direction * 9.0) - 0.4, 0, 1)
    return blue + white * (jnp.array([0.97, 0.97, 0.97]) - blue)


def _waves(point: Point) -> Float[Array, ""]:
    x, y, z = point
    coarse = jnp.sin(x + 1.7 * jnp.sin(0.6 * y + 0.4 * z) + 0.3 * z) * jnp.cos(y + 1.3 * jnp.sin(0.7 * x - z))
    middle = jnp.sin(1.9 * y - 1.1 * x + 2.3 * jnp.sin(1.3 * z + x))
    fine = jnp.sin(4.3 * x + 3.1 * z + 1.9 * jnp.sin(2.9 * y))
    return coarse + 0.5 * middle + 0.25 * fine
