"""A furnished room, seen all around from its middle."""

from splatax.demo.scene import Light, Scene
from splatax.demo.shapes import Cylinder, Rectangle, Sphere, box
from splatax.demo.textures import Surface, checks, clouds, plain, rings, wood
from splatax.demo.viewpoints import Outward

WALLS = (
    Surface(Rectangle((-2.5, -2, 0), (5, 0, 0), (0, 4, 0)), wood),
    Surface(
        Rectangle((-2.5, -2, 2.5), (5, 0, 0), (0, 4, 0)),
        checks(plain(0.9, 0.9, 0.88), plain(0.82, 0.83, 0.85), 0.5),
    ),
    Surface(
        Rectangle((-2.5, 2, 0), (5, 0, 0), (0, 0, 2.5)),
        clouds(plain(0.75, 0.68, 0.5), plain(0.85, 0.8, 0.66), 0.3),
    ),
    Surface(
        Rectangle((-2.5, -2, 0), (5, 0, 0), (0, 0, 2.5)),
        rings(plain(0.55, 0.66, 0.7), plain(0.7, 0.78, 0.8), (1, 0, 0), 0.15),
    ),
    Surface(
        Rectangle((-2.5, -2, 0), (0, 4, 0), (0, 0, 2.5)),
        checks(plain(0.68, 0.42, 0.34), plain(0.6, 0.36, 0.3), 0.2),
    ),
    Surface(
        Rectangle((2.5, -2, 0), (0, 4, 0), (0, 0, 2.5)),
        clouds(plain(0.5, 0.62, 0.45), plain(0.62, 0.7, 0.5), 0.5),
    ),
)
PICTURES = (
    Surface(
        Rectangle((-0.9, 1.98, 1.1), (1.2, 0, 0), (0, 0, 0.8)),
        clouds(plain(0.1, 0.2, 0.5), plain(0.95, 0.75, 0.3), 0.22),
    ),
    Surface(
        Rectangle((2.48, -0.7, 1.0), (0, 1.0, 0), (0, 0, 1.1)),
        rings(plain(0.9, 0.9, 0.85), plain(0.7, 0.15, 0.15), (0, 1, 1), 0.12),
    ),
)
FURNITURE = (
    *(
        Surface(face, clouds(plain(0.25, 0.35, 0.55), plain(0.35, 0.48, 0.66), 0.12))
        for face in box((-2.4, -1.2, 0), (0.8, 0, 0), (0, 1.9, 0), (0, 0, 0.55))
    ),
    *(Surface(face, wood) for face in box((0.9, 1.2, 0), (1.2, 0, 0), (0, 0.6, 0), (0, 0, 0.75))),
    Surface(Sphere((1.3, 1.5, 0.93), 0.18), plain(0.85, 0.55, 0.1), gloss=0.4),
    Surface(
        Cylinder((1.8, -1.4, 0), (1.8, -1.4, 1.3), 0.2),
        checks(plain(0.85, 0.8, 0.75), plain(0.3, 0.25, 0.3), 0.13),
    ),
    Surface(Cylinder((-0.8, -1.7, 0), (-0.8, -1.7, 1.7), 0.03), plain(0.2, 0.2, 0.22)),
    Surface(
        Sphere((-0.8, -1.7, 1.75), 0.22), rings(plain(0.95, 0.9, 0.8), plain(0.8, 0.5, 0.4), (0, 0, 1), 0.06)
    ),
)

ROOM = Scene(
    "a furnished room, photographed all around from its middle",
    (*WALLS, *PICTURES, *FURNITURE),
    Light((0.3, -0.2, 2.3), ambient=0.5, diffuse=0.5),
    Outward((0.1, 0.1, 1.25), 0.75),
    photos=40,
    focal=95.0,
)
