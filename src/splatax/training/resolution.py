"""Smaller photos at first: what is coarse is learnt from fewer pixels, in less time.

Pixels of a divided photo are means of the full ones, so a camera of that size sees the same.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from PIL import Image

from splatax.camera import Camera
from splatax.dataset import Mask, Pixels


@dataclass(frozen=True)
class Resolution:
    """By what photos are divided in each part of a run.

    Attributes:
        stages: (last step, divisor), in order; after the last of them photos are as they are.
    """

    stages: tuple[tuple[int, int], ...] = ()

    def divisor(self, step: int) -> int:
        """For a step, from 1."""
        return next((divisor for last, divisor in self.stages if step <= last), 1)


def divided(
    camera: Camera, photo: Pixels, mask: Mask | None, divisor: int
) -> tuple[Camera, Pixels, Mask | None]:
    """A view with so many times fewer pixels a side, at least one. What a mask leaves out counts for none."""
    size = max(camera.width // divisor, 1), max(camera.height // divisor, 1)
    smaller = np.asarray(Image.fromarray(photo).resize(size, Image.Resampling.BOX))
    return camera.resized(*size), smaller, None if mask is None else _kept(mask, size)


def _kept(mask: Mask, size: tuple[int, int]) -> Bool[np.ndarray, "_ _"]:
    """Where all that a pixel covers counts."""
    share = Image.fromarray(mask.astype(np.float32)).resize(size, Image.Resampling.BOX)
    return np.asarray(share) > 1 - 1e-3
