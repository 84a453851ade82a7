"""L1 and D-SSIM by the native library; see `splatax.losses` for what it computes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends.cpu.library import Build


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def photometric(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, build: Build
) -> Float[Array, ""]:
    """Computes the loss; differentiable in `image` alone."""
    return _forward(image, photo, ssim_weight, build)[0]


def _forward(image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, build: Build):
    loss, gradient = build.call(
        "splatax_photometric", [(), image.shape], (image, photo), ssim_weight=np.float32(ssim_weight)
    )
    return loss, gradient


def _backward(ssim_weight: float, build: Build, gradient: Float[Array, "h w c"], cotangent: Float[Array, ""]):
    return cotangent * gradient, jnp.zeros_like(gradient)


photometric.defvjp(_forward, _backward)
