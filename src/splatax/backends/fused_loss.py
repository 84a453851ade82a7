"""The loss by foreign kernels that compute it together with its gradient in the image."""

from collections.abc import Callable
from functools import partial

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax import losses

Kernel = Callable[  # (image, photo, ssim_weight) -> loss, d loss / d image; hashable
    [Float[Array, "h w c"], Float[Array, "h w c"], float], tuple[Float[Array, ""], Float[Array, "h w c"]]
]


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def photometric(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, kernel: Kernel
) -> Float[Array, ""]:
    """Computes the loss; differentiable only with respect to `image`."""
    return _with_gradient(image, photo, ssim_weight, kernel)[0]


@photometric.defjvp
def _(ssim_weight: float, kernel: Kernel, primals, tangents):
    loss, gradient = _with_gradient(*primals, ssim_weight, kernel)
    return loss, jnp.sum(gradient * tangents[0])


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _with_gradient(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, kernel: Kernel
) -> tuple[Float[Array, ""], Float[Array, "h w c"]]:
    return kernel(image, photo, ssim_weight)


@_with_gradient.defjvp
def _(ssim_weight: float, kernel: Kernel, primals, tangents):
    # Second derivatives come from the portable loss, which JAX differentiates.
    image, photo = primals
    loss, gradient = _with_gradient(image, photo, ssim_weight, kernel)
    portable = jax.grad(lambda image: losses.photometric(image, photo, ssim_weight))
    _, d_gradient = jax.jvp(portable, (image,), tangents[:1])
    return (loss, gradient), (jnp.sum(gradient * tangents[0]), d_gradient)
