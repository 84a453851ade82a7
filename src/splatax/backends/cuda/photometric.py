"""L1 and D-SSIM on the GPU; see `splatax.losses` for what it computes."""

import numpy as np
from jaxtyping import Array, Float

from splatax.backends.cuda.library import Library


def with_gradient(
    image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float, library: Library
) -> tuple[Float[Array, ""], Float[Array, "h w c"]]:
    """Returns the loss and its gradient in the image."""
    loss, gradient = library.call(
        "splatax_cuda_photometric", [(), image.shape], (image, photo), ssim_weight=np.float32(ssim_weight)
    )
    return loss, gradient
