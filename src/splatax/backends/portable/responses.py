"""Opacity of splats at the pixels of a tile, and its gradient: ellipses, and the protocol of others.

The gradients are made of moments over pixels of g = alpha dL/d alpha, and of multiples of it. `slanted.py`
has the response of splats that are drawn along rays.
"""

from dataclasses import replace
from typing import ClassVar, Protocol, runtime_checkable

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends.portable.binning import TILE
from splatax.backends.portable.tiles import PIXELS, Chunk, X, Y
from splatax.splats import Splats

CENTRE = TILE / 2
MOMENTS = np.stack(  # of a tile's pixels about its centre, where coordinates are small
    [
        np.ones(PIXELS),
        X - CENTRE,
        Y - CENTRE,
        (X - CENTRE) ** 2,
        (X - CENTRE) * (Y - CENTRE),
        (Y - CENTRE) ** 2,
    ],
    axis=1,
)


@runtime_checkable
class Response(Protocol):
    """The alpha of splats at pixels, from the first columns of the table, which begin with the mean.

    Attributes:
        COLUMNS: of a table row, before its channels.
        SUMS: columns of the gradient, before those of the channels.
    """

    COLUMNS: ClassVar[int]
    SUMS: ClassVar[int]

    def columns(self, splats: Splats) -> list[Float[Array, "n _"]]:
        """Returns the first columns of the table, in the order of the splats."""
        ...

    def raw_alphas(self, chunk: Chunk) -> Float[Array, "b k p"]:
        """Returns opacity G at the pixels of a tile, before it is clamped."""
        ...

    def sums(self, g: Float[Array, "b k p"], chunk: Chunk) -> Float[Array, "b k m"]:
        """Returns the sums over pixels of which `gradients_of` makes gradients."""
        ...

    def pull_of(self, g: Float[Array, "b k p"], chunk: Chunk) -> Float[Array, "b k 2"]:
        """Returns the sums over pixels of |dL/d mean|."""
        ...

    def gradients_of(
        self, splats: Splats, sums: Float[Array, "n m"], pull: Float[Array, "n 2"] | None
    ) -> Splats:
        """Turns sums into gradients of the splats."""
        ...


class Ellipses:
    """2D Gaussians: the squared distance is t^2 + s^2 with t = u dx + v dy and s = w dy."""

    COLUMNS: ClassVar[int] = 6
    SUMS: ClassVar[int] = 6

    def columns(self, splats: Splats) -> list[Float[Array, "n _"]]:
        """Returns mean x, y, u, v, w and opacity."""
        return [splats.means2d, splats.sqrt_conics, splats.opacities[:, None]]

    def raw_alphas(self, chunk: Chunk) -> Float[Array, "b k p"]:
        """Returns opacity G at the pixels of a tile, before it is clamped."""
        t, s = along_axes(chunk)
        return chunk.rows[:, :, 5, None] * jnp.exp(-0.5 * (jnp.square(t) + jnp.square(s)))

    def sums(self, g: Float[Array, "b k p"], chunk: Chunk) -> Float[Array, "b k 6"]:
        """Returns sum g, sum g dx, sum g dy, sum g dx^2, sum g dx dy, sum g dy^2."""
        return moments_of(g, chunk)

    def pull_of(self, g: Float[Array, "b k p"], chunk: Chunk) -> Float[Array, "b k 2"]:
        """Returns the sums over pixels of |dL/d mean|, where dL/d mean is g (t (u, v) + s (0, w))."""
        u, v, w = (chunk.rows[:, :, i, None] for i in range(2, 5))
        t, s = along_axes(chunk)
        return jnp.stack(
            [jnp.sum(jnp.abs(g * u * t), axis=-1), jnp.sum(jnp.abs(g * (v * t + w * s)), axis=-1)], axis=-1
        )

    def gradients_of(
        self, splats: Splats, sums: Float[Array, "n 6"], pull: Float[Array, "n 2"] | None
    ) -> Splats:
        """Turns moments of g = alpha dL/d alpha about each mean into gradients of its splat.

        With alpha = o exp(-(s^2 + t^2) / 2), s = u dx + v dy, t = w dy and d = pixel - mean:

            dL/d mean = sum g (s (u, v) + t (0, w)),   dL/d(u, v, w) = -sum g (s dx, s dy, t dy).
        """
        g, gx, gy, gxx, gxy, gyy = sums.T
        u, v, w = splats.sqrt_conics.T
        along = u * gx + v * gy
        return replace(
            without_shape(splats),
            means2d=jnp.stack([u * along, v * along + w * w * gy], axis=1),
            sqrt_conics=-jnp.stack([u * gxx + v * gxy, u * gxy + v * gyy, w * gyy], axis=1),
            opacities=per_opacity(g, splats.opacities),
            pull=pull,
        )


def moments_of(g: Float[Array, "b k p"], chunk: Chunk) -> Float[Array, "b k 6"]:
    """Returns the moments up to the second of g about the means."""
    moments = jnp.einsum("bkp,pm->bkm", g, jnp.asarray(MOMENTS, g.dtype), precision="highest")
    return about_mean(moments, means_in_tile(chunk))


def means_in_tile(chunk: Chunk) -> Float[Array, "b k 2"]:
    """Returns the means of the splats, relative to the corner of their tile."""
    return chunk.rows[..., :2] - chunk.corner[:, None, :]


def offsets(chunk: Chunk) -> tuple[Float[Array, "b k p"], Float[Array, "b k p"]]:
    """Returns the offsets of a tile's pixels from the means."""
    x, y = jnp.moveaxis(means_in_tile(chunk), -1, 0)
    dx = jnp.asarray(X, x.dtype)[None, None] - x[..., None]
    dy = jnp.asarray(Y, y.dtype)[None, None] - y[..., None]
    return dx, dy


def about_mean(moments: Float[Array, "b k 6"], means: Float[Array, "b k 2"]) -> Float[Array, "b k 6"]:
    """Shifts moments about the tile's centre to moments about the splats' means."""
    g, gx, gy, gxx, gxy, gyy = jnp.moveaxis(moments, -1, 0)
    dx, dy = jnp.moveaxis(CENTRE - means, -1, 0)
    x1, y1 = gx + dx * g, gy + dy * g
    return jnp.stack(
        [g, x1, y1, gxx + dx * (gx + x1), gxy + dx * gy + dy * x1, gyy + dy * (gy + y1)], axis=-1
    )


def along_axes(chunk: Chunk) -> tuple[Float[Array, "b k p"], Float[Array, "b k p"]]:
    """Returns t = u dx + v dy and s = w dy at the pixels of a tile."""
    u, v, w = (chunk.rows[:, :, i, None] for i in range(2, 5))
    dx, dy = offsets(chunk)
    return u * dx + v * dy, w * dy


def without_shape(splats: Splats) -> Splats:
    """Returns a gradient of splats that is zero."""
    return replace(
        splats,
        depths=jnp.zeros_like(splats.depths),
        extents=jnp.zeros_like(splats.extents),
        colors=jnp.zeros_like(splats.colors),
    )


def per_opacity(g: Float[Array, " n"], opacities: Float[Array, " n"]) -> Float[Array, " n"]:
    """Returns the gradient of opacities, from the sums of alpha dL/d alpha."""
    return jnp.where(opacities > 0, g / jnp.where(opacities > 0, opacities, 1), 0)
