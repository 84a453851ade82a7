"""Smaller photos at first: what is coarse is learnt from fewer pixels, in less time.

Pixels of a divided photo are means of the full ones, so a camera of that size sees the same.
"""

from dataclasses import dataclass

from splatax.camera import Camera
from splatax.dataset import Mask, Pixels
from splatax.resampling import ALL, resize, resize_mask


@dataclass(frozen=True)
class Resolution:
    """By what photos are divided in each part of a run.

    Attributes:
        stages: (last step, divisor), in order; after the last of them photos are as they are.
        smallest: pixels of the shorter side that photos are not made smaller than; they keep their size.
    """

    stages: tuple[tuple[int, int], ...] = ()
    smallest: int = 1

    def divisor(self, step: int, size: tuple[int, int]) -> int:
        """For a photo of a size in a step, from 1."""
        divisor = next((divisor for last, divisor in self.stages if step <= last), 1)
        return divisor if min(size) // divisor >= self.smallest else 1


def divided(
    camera: Camera, photo: Pixels, mask: Mask | None, divisor: int
) -> tuple[Camera, Pixels, Mask | None]:
    """A view with so many times fewer pixels a side. What a mask leaves out counts for no new pixel."""
    if divisor == 1:
        return camera, photo, mask
    size = camera.width // divisor, camera.height // divisor
    smaller = None if mask is None else resize_mask(mask, *size, above=ALL)
    return camera.resized(*size), resize(photo, *size), smaller
