"""A toy without surroundings: photos with alpha from all sides."""

from splatax.demo.scene import Light, Scene
from splatax.demo.shapes import Cylinder, Sphere, box
from splatax.demo.textures import Surface, checks, clouds, plain, rings
from splatax.demo.viewpoints import Orbit

OBJECT = Scene(
    "a toy on transparent ground, photographed from all sides",
    (
        *(
            Surface(face, checks(plain(0.2, 0.3, 0.6), plain(0.85, 0.85, 0.8), 0.1))
            for face in box((-0.4, -0.3, 0), (0.8, 0, 0), (0, 0.6, 0), (0, 0, 0.15))
        ),
        Surface(
            Cylinder((0, 0, 0.15), (0, 0, 0.65), 0.22),
            rings(plain(0.8, 0.2, 0.15), plain(0.95, 0.8, 0.3), (0, 0.3, 1), 0.08),
            gloss=0.3,
        ),
        Surface(Sphere((0, 0, 0.82), 0.2), clouds(plain(0.85, 0.65, 0.5), plain(0.5, 0.3, 0.2), 0.1)),
        Surface(Cylinder((0.2, 0, 0.55), (0.5, -0.15, 0.75), 0.05), plain(0.3, 0.55, 0.3)),
        Surface(Cylinder((-0.2, 0, 0.55), (-0.45, 0.1, 0.4), 0.05), plain(0.3, 0.55, 0.3)),
        Surface(Sphere((0.54, -0.17, 0.78), 0.09), plain(0.9, 0.5, 0.1), gloss=0.6),
        Surface(Cylinder((0, 0, 1.0), (0.05, 0, 1.25), 0.012), plain(0.1, 0.1, 0.1)),
    ),
    Light((-1.5, -2.5, 3.0)),
    Orbit((0, 0, 0.5), 2.4, elevations=(6.0, 28.0, 52.0)),
    sky=None,
    photos=36,
    focal=220.0,
)
