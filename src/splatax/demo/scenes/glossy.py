"""Chrome, lacquer and a polished floor under an open sky: surfaces whose colours depend on the viewpoint."""

from splatax.demo.scene import Light, Scene
from splatax.demo.shapes import Cylinder, Rectangle, Sphere, box
from splatax.demo.textures import Surface, checks, open_sky, plain, rings
from splatax.demo.viewpoints import Orbit

GLOSSY = Scene(
    "chrome and lacquer on a polished floor",
    (
        Surface(
            Rectangle((-2, -2, 0), (4, 0, 0), (0, 4, 0)),
            checks(plain(0.85, 0.83, 0.8), plain(0.25, 0.27, 0.32), 0.5),
            gloss=0.3,
            mirror=0.2,
        ),
        Surface(Sphere((-0.45, 0.1, 0.4), 0.4), plain(0.9, 0.9, 0.9), gloss=0.8, mirror=0.75),
        Surface(Sphere((0.45, -0.35, 0.28), 0.28), plain(0.7, 0.08, 0.1), gloss=0.8, mirror=0.12),
        Surface(
            Cylinder((0.45, 0.5, 0), (0.45, 0.5, 0.9), 0.22),
            rings(plain(0.15, 0.3, 0.55), plain(0.8, 0.75, 0.6), (0, 0.2, 1), 0.1),
            gloss=0.6,
            mirror=0.15,
        ),
        *(
            Surface(face, checks(plain(0.75, 0.55, 0.2), plain(0.5, 0.3, 0.1), 0.12), gloss=0.5, mirror=0.1)
            for face in box((-0.35, -0.9, 0), (0.4, 0.1, 0), (-0.1, 0.4, 0), (0, 0, 0.25))
        ),
    ),
    Light((-1.8, -2.6, 3.6)),
    Orbit((0, 0, 0.3), 2.9, elevations=(14.0, 30.0, 48.0)),
    sky=open_sky,
    photos=40,
)
