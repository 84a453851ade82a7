"""What training minimizes: (1 - w) L1 + w (1 - SSIM)               (Kerbl et al. 2023, Eq. 7)."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from splatax import rasterizers

WINDOW = 11  # pixels; Gaussian, as in Wang et al. 2004
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # for values in [0, 1] (ibid.)

_offsets = np.arange(WINDOW) - WINDOW // 2
KERNEL = np.exp(-(_offsets**2) / (2 * SIGMA**2))
KERNEL = KERNEL / KERNEL.sum()


@dataclass(frozen=True)
class Photometric:
    """L1 and D-SSIM between a rendering and a photo."""

    ssim_weight: float = 0.2  # share of D-SSIM; the rest is L1

    def __call__(
        self,
        image: Float[Array, "h w 3"],
        photo: Float[Array, "h w 3"],
        mask: Bool[Array, "h w"] | None = None,
        *,
        backend: str = rasterizers.AUTO,
    ) -> Float[Array, ""]:
        """The loss; differentiable in `image` alone. A backend that has its own `photometric` uses that.

        With a mask, true where pixels count, both pictures are zero outside it, as they are beyond the
        border: what they show there changes nothing. The mean is over the pixels that count,
        and zero if none does.
        """
        if mask is not None:
            image, photo = (jnp.where(mask[..., None], picture, 0) for picture in (image, photo))
            share = jnp.mean(mask, dtype=image.dtype)
            return self(image, photo, backend=backend) / jnp.maximum(share, 1 / mask.size)
        implementation = rasterizers.implementation(rasterizers.resolve(backend, image.dtype))
        if hasattr(implementation, "photometric"):
            return implementation.photometric(image, photo, self.ssim_weight)
        image, photo = lax.optimization_barrier((image, photo))  # else XLA computes them in every window
        error = image - photo
        l1 = jnp.mean(jnp.abs(jnp.where(error == 0, 0, error)))  # JAX's d|x|/dx is 1 at 0, not 0
        return (1 - self.ssim_weight) * l1 + self.ssim_weight * (1 - ssim(image, photo))


@jax.custom_vjp
def ssim(image: Float[Array, "h w c"], photo: Float[Array, "h w c"]) -> Float[Array, ""]:
    """Mean structural similarity, with zeros beyond the border as in the authors' code.

    For values in [0, 1] and an 11 x 11 window. Differentiable in `image` alone: `photo` gets a
    zero gradient. Evaluation uses `metrics.ssim`, which leaves out the border.
    """
    return jnp.mean(_similarity(_moments(image, photo)))


def _forward(image, photo):
    moments = _moments(image, photo)
    return jnp.mean(_similarity(moments)), (image, photo, moments)


def _backward(residuals, cotangent):
    """The window is symmetric and padded by zeros, so blurring is its own adjoint:

    dS/dx = blur(dS/d mu) + 2 x blur(dS/d x2) + y blur(dS/d xy)  for moments mu, x2, xy of blur.
    """
    image, photo, moments = residuals
    d_moments = jax.grad(lambda m: jnp.sum(_similarity((*m, *moments[3:]))))(moments[:3])
    d_mean, d_square, d_product = blur(jnp.stack(d_moments))
    x, y = jnp.moveaxis(image, -1, 0), jnp.moveaxis(photo, -1, 0)
    gradient = (d_mean + 2 * x * d_square + y * d_product) * (cotangent / image.size)
    return jnp.moveaxis(gradient, 0, -1), jnp.zeros_like(photo)


ssim.defvjp(_forward, _backward)


def _moments(image: Float[Array, "h w c"], photo: Float[Array, "h w c"]):
    """Blurred x, x^2, x y, y, y^2, channels first: what differs in x comes first."""
    x, y = jnp.moveaxis(image, -1, 0), jnp.moveaxis(photo, -1, 0)
    return tuple(blur(jnp.stack([x, x * x, x * y, y, y * y])))


def _similarity(moments) -> Float[Array, "c h w"]:
    """Wang et al. 2004, Eq. 13, at every pixel."""
    mean_x, square_x, product, mean_y, square_y = moments
    variances = square_x - mean_x * mean_x + square_y - mean_y * mean_y
    covariance = product - mean_x * mean_y
    luminance = (2 * mean_x * mean_y + C1) / (mean_x * mean_x + mean_y * mean_y + C1)
    return luminance * (2 * covariance + C2) / (variances + C2)


def blur(planes: Float[Array, "k c h w"]) -> Float[Array, "k c h w"]:
    """Gaussian window over the last two axes, zeros beyond the border.

    Eleven shifted additions per axis of a padded array that XLA must not fold into them (the
    barriers): five times faster on CPU than without, fifty times faster than a convolution.
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
