"""Views on a canvas: views of several sizes that one program draws in images of one size."""

from dataclasses import replace
from functools import partial

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.backends.protocol import Photometric
from splatax.cameras import Camera
from splatax.losses import photometric_on_canvas
from splatax.splats import Splats


def inside(frame: Float[Array, "2"], width: int, height: int) -> Bool[Array, "h w"]:
    """Returns which pixels of a canvas the view fills.

    Args:
        frame: width and height of the view, pixels.
        width, height: size of the canvas, pixels.
    """
    columns, rows = (
        jnp.arange(side, dtype=frame.dtype) + 0.5 < end
        for side, end in zip((width, height), frame, strict=True)
    )
    return rows[:, None] & columns[None]


def mean_over(values: Float[Array, "h w"], camera: Camera) -> Float[Array, ""]:
    """Returns the mean over the pixels of a view; those of a canvas beyond its frame do not count.

    Args:
        values: one for each pixel of the camera's image; any number beyond the frame.
        camera: of the view.
    """
    if camera.frame is None:
        return jnp.mean(values)
    counts = inside(camera.frame, camera.width, camera.height)
    return jnp.sum(jnp.where(counts, values, 0)) / jnp.sum(counts, dtype=values.dtype)


def filling(splats: Splats, d_splats: Splats, frame: Float[Array, "2"] | None) -> tuple[Splats, Splats]:
    """Returns the splats of a view on a canvas, and their gradients, as if the view filled the canvas.

    Density control then finds the sizes and the gradients, as fractions of the image, that the view has by
    itself. Extents are scaled by the longer sides of view and canvas.

    Args:
        splats: the 2D Gaussians of the view.
        d_splats: gradient of the loss with respect to them.
        frame: of the camera; None if the view fills its image.
    """
    if frame is None:
        return splats, d_splats
    canvas = jnp.array([splats.width, splats.height], frame.dtype)
    scale = (canvas / frame)[None]
    larger = replace(
        splats,
        means2d=splats.means2d * scale,
        extents=splats.extents * (jnp.max(canvas) / jnp.max(frame)),
    )
    pull = None if d_splats.pull is None else d_splats.pull / scale
    return larger, replace(d_splats, means2d=d_splats.means2d / scale, pull=pull)


def on_canvas(
    frame: Float[Array, "2"] | None,
    mask: Bool[Array, "h w"] | None,
    photo: Float[Array, "h w c"],
    kernel: Photometric,
) -> tuple[Bool[Array, "h w"] | None, Photometric]:
    """Returns the mask of what counts in the loss, and the kernel of the loss for it.

    On a canvas, only the frame counts, and windows end at its border.

    Args:
        frame: width and height of the view, pixels; None if it fills its image.
        mask: true where a pixel counts; None if all do.
        photo: the image that the view is compared with.
        kernel: of the loss of whole images.
    """
    if frame is None:
        return mask, kernel
    height, width = photo.shape[:2]
    counts = inside(frame, width, height)
    if mask is not None:
        counts &= mask
    return counts, partial(photometric_on_canvas, frame=frame, kernel=kernel)
