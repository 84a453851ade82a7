"""A monument in a park, under an open sky: distances from 2 to 200 metres."""

import jax.numpy as jnp

from splatax.demo.scene import Light, Scene
from splatax.demo.shapes import Cylinder, Point, Rectangle, Sphere, box
from splatax.demo.textures import Surface, checks, clouds, open_sky, plain, rings
from splatax.demo.viewpoints import Orbit

TREES = (
    (6.0, 7.0, 1.3),
    (-7.0, 5.0, 1.6),
    (-6.0, -8.0, 1.2),
    (9.0, -6.0, 1.7),
    (1.0, 14.0, 2.2),
)  # x, y, radius
HILLS = ((120.0, 100.0, 60.0), (-140.0, 60.0, 75.0), (-30.0, -170.0, 70.0))  # x, y, radius


def lawn(point: Point) -> Point:
    """Returns the colour of grass, with patches that grow with the distance, and a round gravel path."""
    distance = jnp.linalg.norm(point[:2])
    near = clouds(plain(0.25, 0.4, 0.12), plain(0.45, 0.52, 0.2), 0.5)(point)
    far = clouds(plain(0.3, 0.45, 0.18), plain(0.42, 0.5, 0.22), 15.0)(point)
    grass = near + (far - near) * jnp.clip((distance - 8) / 20, 0, 1)
    gravel = clouds(plain(0.72, 0.66, 0.55), plain(0.58, 0.52, 0.44), 0.25)(point)
    return jnp.where((distance > 2.2) & (distance < 3.6), gravel, grass)


OUTDOOR = Scene(
    "a monument in a park, with hills and an open sky behind it",
    (
        Surface(Rectangle((-250, -250, 0), (500, 0, 0), (0, 500, 0)), lawn),
        *(
            Surface(face, checks(plain(0.7, 0.68, 0.65), plain(0.6, 0.58, 0.56), 0.25))
            for face in box((-0.5, -0.5, 0), (1, 0, 0), (0, 1, 0), (0, 0, 0.7))
        ),
        Surface(
            Cylinder((0, 0, 0.7), (0, 0, 1.7), 0.25),
            rings(plain(0.75, 0.7, 0.6), plain(0.55, 0.42, 0.35), (0.5, 0.3, 1), 0.12),
        ),
        Surface(
            Sphere((0, 0, 1.95), 0.32), clouds(plain(0.25, 0.5, 0.4), plain(0.5, 0.65, 0.5), 0.2), gloss=0.3
        ),
        *(Surface(Cylinder((x, y, 0), (x, y, 2.0), 0.18), plain(0.36, 0.26, 0.18)) for x, y, _ in TREES),
        *(
            Surface(
                Sphere((x, y, 2 + radius), radius), clouds(plain(0.1, 0.25, 0.08), plain(0.4, 0.5, 0.2), 0.6)
            )
            for x, y, radius in TREES
        ),
        *(
            Surface(
                Sphere((x, y, -radius / 2), radius),
                clouds(plain(0.3, 0.4, 0.35), plain(0.45, 0.5, 0.42), 30.0),
            )
            for x, y, radius in HILLS
        ),
    ),
    Light((60.0, -90.0, 110.0), ambient=0.5, diffuse=0.6),
    Orbit((0, 0, 1.3), 4.0, elevations=(2.0, 9.0, 18.0)),
    sky=open_sky,
    photos=40,
    focal=130.0,
)
