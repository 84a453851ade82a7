"""How much memory training takes, fitted to measured peaks of whole processes.

Measured with the cpu backend and the recipe `default`, on Linux. Memory of an accelerator is not counted.
"""

import math

from splatax.dataset import Dataset

# Bytes of a process that repeats one step: Python, JAX and one program; for each pixel of a photo images,
# gradients and what the rasterizer keeps; for each Gaussian parameters, moments, gradients and splats.
PROCESS, PIXEL, GAUSSIAN = 0.47e9, 160, 1_450
# And what a run adds: for each pixel evaluations and pictures; and for the square root of the number of
# Gaussians (a fit, nothing more) programs of the sizes that it grows through, copies that growing and moving
# them make, and the gaps that those leave in memory. A run of many steps takes more of it than a short one.
RUN_PIXEL, RUN_ROOT = 170, 2.2e6


def photos(dataset: Dataset) -> tuple[int, int, int]:
    """Width and height of the largest photo to train on, pixels, and bytes of all when they are decoded,
    without alpha."""
    sizes = [(view.camera.width, view.camera.height) for view in dataset.train]
    width, height = max(sizes, key=math.prod)
    return width, height, sum(3 * math.prod(size) for size in sizes)


def step_memory(gaussians: int, width: int, height: int, photos_bytes: int = 0) -> int:
    """Bytes of a process that trains a scene of one size, and does nothing else.

    Args:
        gaussians: how many.
        width: of a photo, pixels; of the largest where they differ.
        height: of a photo.
        photos_bytes: of all decoded photos, which stay in memory: width x height x channels of each.
    """
    return round(PROCESS + photos_bytes + PIXEL * width * height + GAUSSIAN * gaussians)


def memory(gaussians: int, width: int, height: int, photos_bytes: int = 0) -> int:
    """Bytes of a whole run of `splatax train` at its peak, for a scene that grows to so many; else as
    `step_memory`."""
    steps = step_memory(gaussians, width, height, photos_bytes)
    return round(steps + RUN_PIXEL * width * height + RUN_ROOT * math.sqrt(gaussians))


def most_gaussians(memory_bytes: int, width: int, height: int, photos_bytes: int = 0) -> int:
    """The most Gaussians for which `memory` is within so many bytes; 0 if not even one is."""
    left = memory_bytes - memory(0, width, height, photos_bytes)
    if left <= 0:
        return 0
    # GAUSSIAN n + RUN_ROOT sqrt(n) = left, which is quadratic in sqrt(n)
    root = (math.sqrt(RUN_ROOT**2 + 4 * GAUSSIAN * left) - RUN_ROOT) / (2 * GAUSSIAN)
    return math.floor(root**2)
