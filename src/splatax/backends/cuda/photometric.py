"""L1 and D-SSIM on the GPU; see `splatax.losses` for what it computes."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import losses
from splatax.backends.cuda.library import Library


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def photometric(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, library: Library
) -> Float[Array, ""]:
    """Computes the loss; differentiable in `image` alone."""
    return _with_gradient(image, photo, ssim_weight, library)[0]


@photometric.defjvp
def _(ssim_weight: float, library: Library, primals, tangents):
    loss, gradient = _with_gradient(*primals, ssim_weight, library)
    return loss, jnp.sum(gradient * tangents[0])


@partial(jax.custom_jvp, nondiff_argnums=(2, 3))
def _with_gradient(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, library: Library
) -> tuple[Float[Array, ""], Float[Array, "h w c"]]:
    loss, gradient = library.call(
        "splatax_cuda_photometric", [(), image.shape], (image, photo), ssim_weight=np.float32(ssim_weight)
    )
    return loss, gradient


@_with_gradient.defjvp
def _(ssim_weight: float, library: Library, primals, tangents):
    # Second derivatives come from the portable kernel, which JAX differentiates.
    image, photo = primals
    loss, gradient = _with_gradient(image, photo, ssim_weight, library)
    portable = jax.grad(lambda image: losses.photometric(image, photo, ssim_weight))
    _, d_gradient = jax.jvp(portable, (image,), tangents[:1])
    return (loss, gradient), (jnp.sum(gradient * tangents[0]), d_gradient)
