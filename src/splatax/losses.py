"""The photometric loss, (1 - w) L1 + w (1 - SSIM)               (Kerbl et al. 2023, Eq. 7)."""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatax.shapes import check_arrays

WINDOW = 11  # pixels; width of the Gaussian window, as in Wang et al. 2004
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # for values in [0, 1] (ibid.)

_offsets = np.arange(WINDOW) - WINDOW // 2
KERNEL = np.exp(-(_offsets**2) / (2 * SIGMA**2))
KERNEL = KERNEL / KERNEL.sum()


def photometric(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float
) -> Float[Array, ""]:
    """Computes (1 - ssim_weight) L1 + ssim_weight (1 - SSIM); differentiable only with respect to `image`."""
    image, photo = lax.optimization_barrier((image, photo))  # otherwise XLA recomputes them in every window
    error = image - photo
    l1 = jnp.mean(jnp.abs(jnp.where(error == 0, 0, error)))  # JAX's d|x|/dx is 1 at 0, not 0
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim(image, photo))


@dataclass(frozen=True)
class Photometric:
    """Photometric loss: L1 and D-SSIM between a rendering and a photo."""

    ssim_weight: float = 0.2  # weight of D-SSIM; that of L1 is 1 - ssim_weight

    def __call__(
        self,
        image: Float[Array, "h w 3"],
        photo: Float[Array, "h w 3"],
        mask: Bool[Array, "h w"] | None = None,
        kernel: Callable[..., Float[Array, ""]] = photometric,
    ) -> Float[Array, ""]:
        """Computes the loss; differentiable only with respect to `image`.

        If there is a mask, both pictures are set to zero outside it, so pixels there do not affect the loss.
        The loss is the mean over the pixels that count, and zero if none does.

        Args:
            image: rendering, in the photo's range of [0, 1].
            photo: photo, in [0, 1].
            mask: true where pixels count; None if all do.
            kernel: implementation of `photometric`; in training, that of a backend.

        Raises:
            ValueError: if the shapes or dtypes of the pictures differ.
        """
        sizes = check_arrays("the loss", {"image": (image, "h w 3"), "photo": (photo, "h w 3")})
        if mask is None:
            return kernel(image, photo, self.ssim_weight)
        if mask.shape != (sizes["h"], sizes["w"]):
            raise ValueError(f"the loss: mask has shape {mask.shape}, but the image is {image.shape}.")
        image, photo = (jnp.where(mask[..., None], picture, 0) for picture in (image, photo))
        coverage = jnp.mean(mask, dtype=image.dtype)
        return kernel(image, photo, self.ssim_weight) / jnp.maximum(coverage, 1 / mask.size)


def photometric_on_canvas(
    image: Float[Array, "h w c"],
    photo: Float[Array, "h w c"],
    ssim_weight: float,
    *,
    frame: Float[Array, "2"],
    kernel: Callable[..., Float[Array, ""]] = photometric,
) -> Float[Array, ""]:
    """Computes the sum of the loss over the pixels of a frame, divided by the number of pixels of the canvas.

    It is `photometric` of the two pictures cut to the frame, times the fraction of the canvas that the frame
    fills. Kernels see the whole canvas. Beyond the frame the pictures are equal, but windows there reach over
    its border: their dissimilarity is computed once more and subtracted. Differentiable only with respect to
    `image`.

    Args:
        image: rendering, zero beyond the frame.
        photo: photo, zero beyond the frame.
        ssim_weight: as in `photometric`.
        frame: width and height, pixels, from the top left corner of the canvas.
        kernel: implementation of `photometric`.
    """
    height, width, _ = image.shape
    right, bottom = jnp.round(frame).astype(jnp.int32)
    near = jnp.arange(
        -(WINDOW // 2), WINDOW // 2, dtype=jnp.int32
    )  # from the border, as far as windows reach
    columns, rows = right + near, bottom + near
    within = jnp.arange(width, dtype=jnp.int32) < right
    beside = jnp.where(
        ((near >= 0) & (columns < width))[None, None], _dissimilarity(image, photo, columns, 1), 0
    )
    below = jnp.where(
        ((near >= 0) & (rows < height))[None, :, None] & within[None, None],
        _dissimilarity(image, photo, rows, 0),
        0,
    )
    beyond = (jnp.sum(beside) + jnp.sum(below)) / image.size
    return kernel(image, photo, ssim_weight) - ssim_weight * beyond


def _dissimilarity(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], places: Int[Array, " k"], axis: int
) -> Float[Array, "c _ _"]:
    """Returns 1 - SSIM in a strip of some rows or columns; places beyond the pictures are zero."""
    strips = (jnp.take(picture, places, axis=axis, mode="fill", fill_value=0) for picture in (image, photo))
    return 1 - _similarity(_moments(*strips))


@jax.custom_jvp
def ssim(image: Float[Array, "h w c"], photo: Float[Array, "h w c"]) -> Float[Array, ""]:
    """Returns the mean structural similarity, with zeros beyond the border as in the authors' code.

    Values are in [0, 1], and the window is 11 x 11 pixels. It is differentiable only with respect to
    `image`: `photo` gets a zero gradient. Evaluation uses `metrics.ssim`, which leaves out the border.
    """
    return jnp.mean(_similarity(_moments(image, photo)))


@ssim.defjvp
def _(primals, tangents):
    image, photo = primals
    moments = _moments(image, photo)
    return jnp.mean(_similarity(moments)), jnp.sum(_gradient(image, photo, moments) * tangents[0])


def _gradient(image, photo, moments):
    """Returns the gradient with respect to `image`.

    The window is symmetric and zero-padded, so blurring is its own adjoint:

    dS/dx = blur(dS/d mu) + 2 x blur(dS/d x2) + y blur(dS/d xy)  for moments mu, x2, xy of blur.
    """
    d_moments = jax.grad(lambda m: jnp.sum(_similarity((*m, *moments[3:]))))(moments[:3])
    d_mean, d_square, d_product = blur(jnp.stack(d_moments))
    x, y = jnp.moveaxis(image, -1, 0), jnp.moveaxis(photo, -1, 0)
    gradient = (d_mean + 2 * x * d_square + y * d_product) / image.size
    return jnp.moveaxis(gradient, 0, -1)


def _moments(image: Float[Array, "h w c"], photo: Float[Array, "h w c"]):
    """Returns blurred x, x^2, x y, y and y^2, channels first; the first three depend on x."""
    x, y = jnp.moveaxis(image, -1, 0), jnp.moveaxis(photo, -1, 0)
    return tuple(blur(jnp.stack([x, x * x, x * y, y, y * y])))


def _similarity(moments) -> Float[Array, "c h w"]:
    """Returns SSIM at every pixel (Wang et al. 2004, Eq. 13)."""
    mean_x, square_x, product, mean_y, square_y = moments
    variances = square_x - mean_x * mean_x + square_y - mean_y * mean_y
    covariance = product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x * mean_x + mean_y * mean_y + C1)
    return luminance * (2 * covariance + C2) / (variances + C2)


def blur(planes: Float[Array, "k c h w"]) -> Float[Array, "k c h w"]:
    """Applies a Gaussian window over the last two axes, with zeros beyond the border.

    It makes eleven shifted additions per axis of a padded array. The barriers keep XLA from fusing the
    padding into them: five times faster on CPU than without, fifty times faster than a convolution.
    """
    for axis in (2, 3):
        padding = [(0, 0)] * 4
        padding[axis] = (WINDOW // 2, WINDOW // 2)
        padded = lax.optimization_barrier(jnp.pad(planes, padding))
        length = planes.shape[axis]
        planes = jnp.zeros_like(planes)
        for i, weight in enumerate(KERNEL.tolist()):
            planes = planes + weight * lax.slice_in_dim(padded, i, i + length, axis=axis)
    return planes
