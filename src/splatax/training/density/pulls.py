"""The pull on a Gaussian: the size of the gradient of its 2D mean, which is large where detail is missing."""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.splats import Splats


def pulls(splats: Splats, d_splats: Splats) -> tuple[Float[Array, " n"], Bool[Array, " n"]]:
    """Returns the pull on each splat of a view, and which splats are visible.

    The pull is |dL/d means2d|, with the image running from -1 to 1. Where the splats have `pull`, gradients
    are added up over pixels by their absolute values (AbsGS, Ye et al. 2024), so that opposite ones do not
    cancel out.

    Args:
        splats: the 2D Gaussians of the view.
        d_splats: gradient of the loss with respect to them.
    """
    visible = (splats.extents[:, 0] > 0) | (splats.extents[:, 1] > 0)
    gradient = d_splats.means2d if d_splats.pull is None else d_splats.pull
    # By columns, which XLA computes in one pass; norms along rows take one for each operation.
    across, down = gradient[:, 0] * (splats.width / 2), gradient[:, 1] * (splats.height / 2)
    return jnp.where(visible, jnp.sqrt(across * across + down * down), 0), visible
