"""The response of splats that are drawn along rays, and its gradient; see `splatax.along_rays`.

With d = pixel - mean, t = u dx + v dy, s = w dy, m = 1 + g . d and H = (a, b; b, c),

    q = (t^2 + s^2) / D,   D = m^2 + d^T H d,

where that is less than the blur's f |d|^2 and m > 0; elsewhere q is that of the blur. Alpha is o exp(-q / 2).
With g_i = alpha dL/d alpha, let k = g_i / D and l = k q, both 0 where the blur is drawn, and e = g_i there:

    dL/d mean       = sum k (t (u, v) + s (0, w)) - l (m g + H d) + e f d
    dL/d(u, v, w)   = -sum k (t dx, t dy, s dy)
    dL/dg           = sum l m d
    dL/d(a, b, c)   = sum l (dx^2, 2 dx dy, dy^2) / 2

so the moments of k and l up to the second, those of e up to the first, and the sum of g_i are all that the
gradient needs.
"""

from dataclasses import replace
from typing import ClassVar, NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.backends.portable.responses import moments_of, offsets, per_opacity, without_shape
from splatax.backends.portable.tiles import Chunk
from splatax.splats import Splats, slants_of


class Ratio(NamedTuple):
    """The parts of q at the pixels of a tile."""

    dx: Float[Array, "b k p"]
    dy: Float[Array, "b k p"]
    t: Float[Array, "b k p"]
    s: Float[Array, "b k p"]
    ahead: Float[Array, "b k p"]  # m
    along: Float[Array, "b k p"]  # D, or 1 where the blur is drawn
    met: Bool[Array, "b k p"]  # false where the blur is drawn
    squared: Float[Array, "b k p"]  # q


class Slanted:
    """Splats drawn along rays. The table has mean x, y, u, v, w, opacity, g, a, b, c and f."""

    COLUMNS: ClassVar[int] = 12
    SUMS: ClassVar[int] = 16

    def columns(self, splats: Splats) -> list[Float[Array, "n _"]]:
        """Returns mean x, y, u, v, w, opacity and slants."""
        return [splats.means2d, splats.sqrt_conics, splats.opacities[:, None], slants_of(splats)]

    def raw_alphas(self, chunk: Chunk) -> Float[Array, "b k p"]:
        """Returns opacity G at the pixels of a tile, before it is clamped."""
        return chunk.rows[:, :, 5, None] * jnp.exp(-0.5 * ratio(chunk).squared)

    def sums(self, g: Float[Array, "b k p"], chunk: Chunk) -> Float[Array, "b k 16"]:
        """Returns the sum of g, and the moments about the means of k, l and e."""
        at = ratio(chunk)
        k = jnp.where(at.met, g / at.along, 0)
        parts = [moments_of(values, chunk) for values in (k, k * at.squared, jnp.where(at.met, 0, g))]
        return jnp.concatenate([jnp.sum(g, axis=-1, keepdims=True), *parts], axis=-1)[..., :16]

    def pull_of(self, g: Float[Array, "b k p"], chunk: Chunk) -> Float[Array, "b k 2"]:
        """Returns the sums over pixels of |dL/d mean|."""
        u, v, w = (chunk.rows[:, :, i, None] for i in range(2, 5))
        gx, gy, a, b, c, floor = (chunk.rows[:, :, i, None] for i in range(6, 12))
        at = ratio(chunk)
        k = jnp.where(at.met, g / at.along, 0)
        slack, e = k * at.squared, jnp.where(at.met, 0, g) * floor
        x = k * u * at.t - slack * (at.ahead * gx + a * at.dx + b * at.dy) + e * at.dx
        y = k * (v * at.t + w * at.s) - slack * (at.ahead * gy + b * at.dx + c * at.dy) + e * at.dy
        return jnp.stack([jnp.sum(jnp.abs(x), axis=-1), jnp.sum(jnp.abs(y), axis=-1)], axis=-1)

    def gradients_of(
        self, splats: Splats, sums: Float[Array, "n 16"], pull: Float[Array, "n 2"] | None
    ) -> Splats:
        """Turns sums into gradients of the splats, by the formulas of the module."""
        _, kx, ky, kxx, kxy, kyy = sums[:, 1:7].T
        slack, lx, ly, lxx, lxy, lyy = sums[:, 7:13].T
        _, ex, ey = sums[:, 13:].T
        u, v, w = splats.sqrt_conics.T
        gx, gy, a, b, c, floor = slants_of(splats).T
        along = u * kx + v * ky
        ahead = slack + gx * lx + gy * ly  # sum of l m
        x = u * along - (ahead * gx + a * lx + b * ly) + floor * ex
        y = v * along + w * w * ky - (ahead * gy + b * lx + c * ly) + floor * ey
        gx_sum, gy_sum = lx + gx * lxx + gy * lxy, ly + gx * lxy + gy * lyy
        slants = [gx_sum, gy_sum, lxx / 2, lxy, lyy / 2, jnp.zeros_like(lx)]
        return replace(
            without_shape(splats),
            means2d=jnp.stack([x, y], axis=1),
            sqrt_conics=-jnp.stack([u * kxx + v * kxy, u * kxy + v * kyy, w * kyy], axis=1),
            opacities=per_opacity(sums[:, 0], splats.opacities),
            slants=jnp.stack(slants, axis=1),
            pull=pull,
        )


def ratio(chunk: Chunk) -> Ratio:
    """Returns the parts of q at the pixels of a tile."""
    u, v, w = (chunk.rows[:, :, i, None] for i in range(2, 5))
    gx, gy, a, b, c, floor = (chunk.rows[:, :, i, None] for i in range(6, 12))
    dx, dy = offsets(chunk)
    t, s = u * dx + v * dy, w * dy
    ahead = 1 + gx * dx + gy * dy
    along = ahead * ahead + a * dx * dx + 2 * b * dx * dy + c * dy * dy
    across = t * t + s * s
    blur = floor * (dx * dx + dy * dy)
    met = (ahead > 0) & (across < blur * along)
    along = jnp.where(met, along, 1)
    return Ratio(dx, dy, t, s, ahead, along, met, jnp.where(met, across / along, blur))
