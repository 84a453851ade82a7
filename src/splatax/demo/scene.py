"""Records of a synthetic scene: its surfaces, its light, and where its photos are taken."""

from dataclasses import dataclass
from typing import Literal

from splatax.cameras import Camera
from splatax.demo.shapes import Vector
from splatax.demo.textures import Surface, Texture, plain
from splatax.demo.viewpoints import Viewpoints

SIZE = (160, 120)  # pixels


@dataclass(frozen=True)
class Light:
    """One lamp, which casts shadows and highlights, and light from everywhere.

    Attributes:
        lamp: position.
        ambient: brightness of a white surface in shadow.
        diffuse: brightness that the lamp adds to a white surface that faces it.
        shininess: exponent of highlights (Phong 1975).
    """

    lamp: Vector
    ambient: float = 0.45
    diffuse: float = 0.65
    shininess: int = 50


@dataclass(frozen=True)
class Scene:
    """A scene to draw, and the photos to take of it.

    Attributes:
        summary: contents of the scene, as the end of a sentence.
        surfaces: in the order of their ids.
        light: lamp and ambient light.
        viewpoints: positions and directions of the cameras.
        sky: colour of rays that meet no surface; None leaves them transparent.
        photos: number of photos that suits the scene.
        focal: focal length, pixels, of photos that are 160 pixels wide.
    """

    summary: str
    surfaces: tuple[Surface, ...]
    light: Light
    viewpoints: Viewpoints
    sky: Texture | None = plain(0.05, 0.06, 0.08)
    photos: int = 24
    focal: float = 175.0

    @property
    def background(self) -> Literal["white"] | None:
        """Background to train on: white if photos are transparent, else the default of the recipe."""
        return None if self.sky else "white"

    def cameras(self, photos: int | None = None, size: tuple[int, int] = SIZE) -> list[Camera]:
        """Returns cameras. Their horizontal field of view does not depend on the size.

        Args:
            photos: number of photos; None for as many as suits the scene.
            size: width and height, pixels.
        """
        poses = self.viewpoints.poses(self.photos if photos is None else photos)
        return [Camera.simple_pinhole(self.focal * size[0] / SIZE[0], pose, *size) for pose in poses]
