"""A trellis of wires and rods in front of a wall: structures about as thin as a pixel."""

from splatax.demo.scene import Light, Scene
from splatax.demo.shapes import Cylinder, Rectangle, Sphere
from splatax.demo.textures import Surface, clouds, plain, wood
from splatax.demo.viewpoints import Orbit

UPRIGHTS = (-0.8, -0.48, -0.16, 0.16, 0.48, 0.8)  # x
RUNGS = (0.3, 0.6, 0.9, 1.2)  # z

THIN = Scene(
    "a trellis of thin rods and wires in front of a wall",
    (
        Surface(Rectangle((-2, -1.4, 0), (4, 0, 0), (0, 2.6, 0)), wood),
        Surface(
            Rectangle((-2, 1.2, 0), (4, 0, 0), (0, 0, 2.6)),
            clouds(plain(0.8, 0.76, 0.7), plain(0.6, 0.62, 0.66), 0.35),
        ),
        *(Surface(Cylinder((x, 0, 0), (x, 0, 1.4), 0.012), plain(0.2, 0.35, 0.25)) for x in UPRIGHTS),
        *(Surface(Cylinder((-0.85, 0.02, z), (0.85, 0.02, z), 0.009), plain(0.75, 0.6, 0.3)) for z in RUNGS),
        Surface(Cylinder((-0.8, -0.5, 0), (0.5, 0.4, 1.5), 0.006), plain(0.1, 0.1, 0.12)),
        Surface(Cylinder((0.8, -0.6, 0), (-0.3, 0.3, 1.5), 0.006), plain(0.7, 0.15, 0.1)),
        Surface(Cylinder((0, -0.7, 0), (0.1, -0.2, 1.3), 0.004), plain(0.15, 0.2, 0.5)),
        Surface(Sphere((0.45, -0.25, 0.2), 0.2), clouds(plain(0.7, 0.25, 0.2), plain(0.9, 0.6, 0.4), 0.15)),
    ),
    Light((-1.2, -2.4, 3.0)),
    Orbit((0, 0, 0.65), 2.6, azimuths=(-50.0, 50.0), elevations=(4.0, 16.0, 30.0)),
    photos=30,
    focal=160.0,
)
