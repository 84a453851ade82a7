"""L1 and D-SSIM by the native library; see `splatax.losses` for what it computes."""

import numpy as np
from jaxtyping import Array, Float

from splatax.backends.cpu.library import Build


def with_gradient(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, build: Build
) -> tuple[Float[Array, ""], Float[Array, "h w c"]]:
    """Returns the loss and its gradient in the image."""
    loss, gradient = build.call(
        "splatax_photometric", [(), image.shape], (image, photo), ssim_weight=np.float32(ssim_weight)
    )
    return loss, gradient
