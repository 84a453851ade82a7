"""Forecasts the memory that training takes, from a fit to measured peaks of whole processes.

The peaks were measured with the cpu backend and the recipe `default`, on Linux. Memory of an accelerator is
not counted.
"""

import math

from splatax.dataset import Dataset

# Bytes of a process that repeats one step: Python, JAX and one program; for each pixel of a photo images,
# gradients and what the rasterizer keeps; for each Gaussian parameters, moments, gradients and splats.
PROCESS, PIXEL, GAUSSIAN = 0.47e9, 160, 1_450
# What a step on several photos adds: for each Gaussian a stored gradient, and copies on the way to and from
# the devices; for each Gaussian and photo its splat and cotangent; for each pixel of a photo 8-bit photos of
# this step and of two that are read ahead.
SEVERAL, VIEW, VIEW_PIXEL = 900, 140, 12
# What a block adds for each fixed Gaussian around it: parameters, splats and what the rasterizer keeps.
FIXED = 1_500
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


def fixed(dataset: Dataset) -> int:
    """Returns the number of fixed Gaussians in memory: those around a block, and the coarse scene."""
    if dataset.block is None:
        return 0
    return len(dataset.block.context) + round(len(dataset.block.start) / dataset.block.fraction)


def step_memory(
    gaussians: int,
    width: int,
    height: int,
    photos_bytes: int = 0,
    *,
    views: int = 1,
    devices: int = 1,
    around: int = 0,
) -> int:
    """Returns the bytes of a process that trains a scene of constant size, and does nothing else.

    Args:
        gaussians: their number.
        width: of a photo, pixels; of the largest where they differ.
        height: of a photo.
        photos_bytes: of all decoded photos, which stay in memory: width x height x channels of each.
        views: photos of a step that this process draws.
        devices: devices of this process, which draw at the same time.
        around: fixed Gaussians; see `fixed`.
    """
    each = PIXEL * min(devices, views) + (VIEW_PIXEL * views if views > 1 else 0)
    state = per_gaussian(views, devices) * gaussians + FIXED * around
    return round(PROCESS + photos_bytes + each * width * height + state)


def per_gaussian(views: int, devices: int) -> int:
    """Returns the bytes of one Gaussian in a step; arguments as of `step_memory`."""
    if views == 1:
        return GAUSSIAN
    return GAUSSIAN + SEVERAL + VIEW * views * (2 if devices > 1 else 1)  # sent by one, received by another


def memory(gaussians: int, width: int, height: int, photos_bytes: int = 0, **options: int) -> int:
    """Returns the peak bytes of a whole run, with evaluation and growth; arguments as of `step_memory`."""
    steps = step_memory(gaussians, width, height, photos_bytes, **options)
    return round(steps + RUN_PIXEL * width * height + RUN_ROOT * math.sqrt(gaussians))


def most_gaussians(memory_bytes: int, width: int, height: int, photos_bytes: int = 0, **options: int) -> int:
    """Returns the largest number of Gaussians for which `memory` is at most `memory_bytes`.

    Args:
        memory_bytes: of the process.
        width: as of `step_memory`, as are all that follow.
        height: of a photo.
        photos_bytes: of all decoded photos.
        options: `views`, `devices` and `around`.
    """
    left = memory_bytes - memory(0, width, height, photos_bytes, **options)
    if left <= 0:
        return 0
    # each n + RUN_ROOT sqrt(n) = left, which is quadratic in sqrt(n)
    each = per_gaussian(options.get("views", 1), options.get("devices", 1))
    root = (math.sqrt(RUN_ROOT**2 + 4 * each * left) - RUN_ROOT) / (2 * each)
    return math.floor(root**2)
