"""The resolution schedule: training starts with smaller photos, whose steps take less time.

Pixels of a downscaled photo are means over blocks of the full photo, so a camera of that size sees the
same scene.
"""

from dataclasses import dataclass

from splatax.cameras import Camera
from splatax.dataset import Mask, Pixels
from splatax.resampling import ALL, resize, resize_mask


@dataclass(frozen=True)
class Resolution:
    """The factor by which photos are downscaled in each stage of a run.

    Attributes:
        stages: (last step, divisor) pairs, in order; after the last stage photos have full size.
        smallest: pixels; photos whose shorter side would become smaller keep their full size.
    """

    stages: tuple[tuple[int, int], ...] = ()
    smallest: int = 1

    @property
    def divisors(self) -> tuple[int, ...]:
        """All factors by which photos are downscaled during a run."""
        return tuple(sorted({1, *(divisor for _, divisor in self.stages)}))

    def divisor(self, step: int, size: tuple[int, int]) -> int:
        """Returns the factor by which photos of this size are downscaled at this step, counted from 1.

        1 is full size.
        """
        divisor = next((divisor for last, divisor in self.stages if step <= last), 1)
        return divisor if min(size) // divisor >= self.smallest else 1


def divided(
    camera: Camera, photo: Pixels, mask: Mask | None, divisor: int
) -> tuple[Camera, Pixels, Mask | None]:
    """Returns a view whose width and height are divided by `divisor`.

    A pixel of the smaller mask counts only if all pixels that it covers do.
    """
    if divisor == 1:
        return camera, photo, mask
    size = camera.width // divisor, camera.height // divisor
    smaller = None if mask is None else resize_mask(mask, *size, above=ALL)
    return camera.resized(*size), resize(photo, *size), smaller
