"""Objects on a table in a corner: the scene of `splatax demo`."""

import jax.numpy as jnp

from splatax.demo.scene import Light, Scene
from splatax.demo.shapes import Cylinder, Point, Rectangle, Sphere, box
from splatax.demo.textures import Surface, checks, plain, rings, wood
from splatax.demo.viewpoints import Orbit


def helix(point: Point) -> Point:
    """Returns the colour of helical stripes around the vertical axis through (0.55, 0.35)."""
    turn = jnp.arctan2(point[1] - 0.35, point[0] - 0.55)
    stripe = jnp.sin(3 * turn + 18 * point[2]) > 0
    return jnp.where(stripe, jnp.array([0.92, 0.86, 0.7]), jnp.array([0.16, 0.42, 0.5]))


SURFACES = (
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

STILL_LIFE = Scene(
    "a still life on a table in a corner",
    SURFACES,
    Light((-0.9, -2.2, 3.2)),
    Orbit((-0.1, 0.05, 0.35), 2.7, azimuths=(-30.0, 70.0)),  # further left is behind the other wall
)
