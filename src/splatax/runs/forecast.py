"""Forecasts the memory that training takes, from a fit to measured peaks of whole processes.

The peaks were measured with the cpu backend and the recipe `default`, on Linux. Memory of an accelerator is
not counted.
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
    """Returns width and height of the largest training photo, and the bytes of all of them when decoded.

    The bytes are those of RGB, without alpha, or of the RGBA photos of a block.
    """
    sizes = [(view.camera.width, view.camera.height) for view in dataset.train]
    width, height = max(sizes, key=math.prod)
    return width, height, sum(channels(dataset) * math.prod(size) for size in sizes)


def channels(dataset: Dataset) -> int:
    """Returns the number of channels of a capture's photos: those of blocks have an alpha channel."""
    return 4 if dataset.block else 3


def step_memory(gaussians: int, width: int, height: int, photos_bytes: int = 0) -> int:
    """Returns the bytes of a process that trains a scene of constant size, and does nothing else.

    Args:
        gaussians: their number.
        width: of a photo, pixels; of the largest where they differ.
        height: of a photo.
        photos_bytes: of all decoded photos, which stay in memory: width x height x channels of each.
    """
    return round(PROCESS + photos_bytes + PIXEL * width * height + GAUSSIAN * gaussians)


def memory(gaussians: int, width: int, height: int, photos_bytes: int = 0) -> int:
    """Returns the peak bytes of a whole run, with evaluation and growth; arguments as of `step_memory`."""
    steps = step_memory(gaussians, width, height, photos_bytes)
    return round(steps + RUN_PIXEL * width * height + RUN_ROOT * math.sqrt(gaussians))


def most_gaussians(memory_bytes: int, width: int, height: int, photos_bytes: int = 0) -> int:
    """Returns the largest number of Gaussians for which `memory` is at most `memory_bytes`."""
    left = memory_bytes - memory(0, width, height, photos_bytes)
    if left <= 0:
        return 0
    # GAUSSIAN n + RUN_ROOT sqrt(n) = left, which is quadratic in sqrt(n)
    root = (math.sqrt(RUN_ROOT**2 + 4 * GAUSSIAN * left) - RUN_ROOT) / (2 * GAUSSIAN)
    return math.floor(root**2)
