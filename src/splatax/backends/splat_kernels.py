"""Foreign rasterizers: the order of their arrays, the shape of their gradients, and second derivatives."""

from collections.abc import Sequence
from dataclasses import replace

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.backends.foreign import Shape
from splatax.backends.portable.composite import change_of_gradient, curvature_of_blend
from splatax.splats import Splats


def inputs_of(splats: Splats, channels: Float[Array, "n c"]) -> list[Array]:
    """Returns the arrays of splats and the channels to blend, in the order of the kernels."""
    shape = [splats.means2d, splats.sqrt_conics, splats.depths, splats.extents, splats.opacities]
    return [*shape, channels]


def gradient_shapes(splats: Splats, channels: Float[Array, "n c"]) -> list[Shape]:
    """Returns the shapes of what a gradient kernel returns; that of an unrequested `pull` is empty."""
    shapes = [splats.means2d.shape, splats.sqrt_conics.shape, splats.opacities.shape, channels.shape]
    return [*shapes, (0, 2) if splats.pull is None else splats.pull.shape]


def gradients_of(splats: Splats, arrays: Sequence[Array]) -> tuple[Splats, Float[Array, "n c"]]:
    """Returns the gradients of splats and channels, from the arrays that a gradient kernel returns."""
    means2d, sqrt_conics, opacities, d_channels, pull = arrays
    nothing = jax.tree.map(jnp.zeros_like, splats)
    d_splats = replace(nothing, means2d=means2d, sqrt_conics=sqrt_conics, opacities=opacities)
    return replace(d_splats, pull=None if splats.pull is None else pull), d_channels


def second_derivative(primals, tangents) -> tuple[Splats, Float[Array, "n c"]]:
    """Returns the tangents of the gradients, by the portable kernel; they can be differentiated again.

    Args:
        primals: residuals, which begin with splats and channels, and the cotangents of the image.
        tangents: of the primals. The image is a function of the splats, so its own tangent is not used.
    """
    (splats, channels, *_), cotangents = primals
    (d_splats, d_channels, *_), d_cotangents = tangents
    return change_of_gradient((splats, channels, cotangents), (d_splats, d_channels, d_cotangents))


def curvature(residuals, tangents: tuple[Array, ...], cotangents: tuple[Array, ...]):
    """Returns the gradient of the cotangents times the image's tangents, by the portable kernel.

    Args:
        residuals: of the kernel, which begin with splats and channels.
        tangents: of splats and channels.
        cotangents: of the image.

    Returns:
        The gradient, with the structure of the residuals; zero for all but splats and channels.
    """
    splats, channels, *rest = residuals
    found = curvature_of_blend(splats, channels, tangents, cotangents)
    return (*found, *jax.tree.map(jnp.zeros_like, rest))
