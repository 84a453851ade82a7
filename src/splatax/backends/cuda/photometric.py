"""L1 and D-SSIM on the GPU; see `splatax.losses` for what it computes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends.cuda.library import Library


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def photometric(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, library: Library
) -> Float[Array, ""]:
    """Computes the loss; differentiable in `image` alone."""
    return _forward(image, photo, ssim_weight, library)[0]


def _forward(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, library: Library
):
    loss, gradient = library.call(
        "splatax_cuda_photometric",
        [(), image.shape],
        (image, photo),
        ssim_weight=np.float32(ssim_weight),
    )
    return loss, gradient


def _backward(
    ssim_weight: float, library: Library, gradient: Float[Array, "h w c"], cotangent: Float[Array, ""]
):
    return cotangent * gradient, jnp.zeros_like(gradient)


photometric.defvjp(_forward, _backward)
