"""The scene of the demo: objects on a table in a corner, with procedural textures."""

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp

from splatax.demo.shapes import Cylinder, Point, Rectangle, Shape, Sphere, Vector, box

Texture = Callable[[Point], Point]  # a point on a surface -> RGB albedo


@dataclass(frozen=True)
class Surface:
    """A shape with a texture, and the strength of its highlight."""

    shape: Shape
    texture: Texture
    gloss: float = 0.0


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


def wood(point: Point) -> Point:
    """Returns the colour of wood with its grain along x."""
    x, y, _ = point
    grain = jnp.sin(26 * y + 2.5 * jnp.sin(2.1 * x) + 1.3 * jnp.sin(7.3 * y + 0.8 * x))
    fine = jnp.sin(140 * y + 5 * jnp.sin(3 * x))
    return (0.8 + 0.12 * grain + 0.05 * fine) * jnp.array([0.62, 0.42, 0.26])


def helix(point: Point) -> Point:
    """Returns the colour of helical stripes around the vertical axis through (0.55, 0.35)."""
    turn = jnp.arctan2(point[1] - 0.35, point[0] - 0.55)
    stripe = jnp.sin(3 * turn + 18 * point[2]) > 0
    return jnp.where(stripe, jnp.array([0.92, 0.86, 0.7]), jnp.array([0.16, 0.42, 0.5]))


STILL_LIFE: tuple[Surface, ...] = (
    Surface(Rectangle((-1.6, -1.5, 0), (3.2, 0, 0), (0, 2.7, 0)), wood),
    Surface(
        Rectangle((1.6, 1.2, 0), (-3.2, 0, 0), (0, 0, 1.9)),
        checks(plain(0.72, 0.76, 0.8), plain(0.6, 0.66, 0.73), 0.3),
    ),
    Surface(
        Rectangle((-1.6, 1.2, 0), (0, -2.7, 0), (0, 0, 1.9)),
        rings(plain(0.85, 0.8, 0.68), plain(0.74, 0.62, 0.5), (0, 1, 0), 0.18),
    ),
    Surface(Sphere((-0.15, -0.1, 0.36), 0.36), plain(0.75, 0.1, 0.08), gloss=0.7),
    Surface(
        Sphere((-0.75, 0.4, 0.24), 0.24),
        rings(plain(0.95, 0.75, 0.15), plain(0.2, 0.25, 0.6), (0.6, 0.2, 0.77), 0.09),
    ),
    Surface(Cylinder((0.55, 0.35, 0), (0.55, 0.35, 0.85), 0.2), helix),
    *(
        Surface(face, checks(plain(0.2, 0.5, 0.25), plain(0.75, 0.82, 0.6), 0.1))
        for face in box((0.35, -0.75, 0), (0.34, 0.2, 0), (-0.2, 0.34, 0), (0, 0, 0.3))
    ),
    Surface(Cylinder((-0.95, -0.45, 0), (-1.05, -0.2, 1.15), 0.018), plain(0.9, 0.9, 0.85)),
    Surface(Cylinder((-0.95, -0.45, 0), (-0.75, -0.35, 1.05), 0.018), plain(0.15, 0.15, 0.2)),
    Surface(Cylinder((-0.95, -0.45, 0), (-1.15, -0.6, 0.95), 0.018), plain(0.8, 0.35, 0.1)),
)
