"""Images of splats by the native library, with derivatives that reuse the image's lists of tiles.

A walk over the splats returns a ticket with its image. Its derivative finds the lists again by the ticket.
"""

from functools import partial
from typing import Protocol

import jax
import numpy as np
from jaxtyping import Array, Float, Int

from splatax.backends.linear import Curved, linear_call
from splatax.backends.portable.composite import directions
from splatax.splats import Splats


class Walk(Curved, Protocol):
    """Draws splats, and is the derivative of their image. Hashable, and compares by value."""

    def draw(
        self, splats: Splats, channels: Float[Array, "n c"], gradient_follows: bool
    ) -> tuple[Float[Array, "h w c"], Float[Array, "h w"], Int[Array, ""]]:
        """Returns sums, alpha, and the ticket."""


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def image(splats: Splats, channels: Float[Array, "n c"], walk: Walk):
    """Returns sums and alpha."""
    return walk.draw(splats, channels, gradient_follows=False)[:2]


@image.defjvp
def _(walk: Walk, primals, tangents):
    *found, ticket = drawn_image(*primals, walk)
    return tuple(found), derivative_of_image(walk, primals, (*found, ticket), tangents)


@partial(jax.custom_jvp, nondiff_argnums=(2,))
def drawn_image(splats: Splats, channels: Float[Array, "n c"], walk: Walk):
    """Returns the image, and the ticket for its derivative. It can be differentiated again."""
    return walk.draw(splats, channels, gradient_follows=True)


@drawn_image.defjvp
def _(walk: Walk, primals, tangents):
    drawn = drawn_image(*primals, walk)
    no_tangent = np.zeros(drawn[2].shape, jax.dtypes.float0)
    return drawn, (*derivative_of_image(walk, primals, drawn, tangents), no_tangent)


def derivative_of_image(walk: Walk, primals, drawn: tuple[Array, ...], tangents):
    """Returns the tangents of the image that `drawn_image` returned for splats and channels."""
    return linear_call(walk, (*primals, *drawn), directions(*tangents), drawn[:2])
