"""Blends a chunk of splats into a batch of tiles, and computes the gradient of the blend.

Both go front to back and take the same decisions. The gradient needs only the final sums of the blend.
Given values s_i = <c_i, dL/dC> and weights w_i = T_i alpha_i,

    alpha_i dL/d alpha_i = w_i s_i - alpha_i / (1 - alpha_i) (sum_{j>i} w_j s_j)

and the sum over the splats behind is the total minus the sum over the splats blended so far.
"""

import jax.numpy as jnp
from jax import lax
from jaxtyping import Array, Float

from splatax.backends.portable.responses import Response
from splatax.backends.portable.tiles import Chunk
from splatax.splats import MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE

GROUP = 4  # splats whose running product or sum is unrolled


def blend(
    state: tuple[Float[Array, "b p"], Float[Array, "b c p"]],
    shared: None,
    chunk: Chunk,
    response: Response,
) -> tuple[tuple[Float[Array, "b p"], Float[Array, "b c p"]], None]:
    """Adds a chunk to (transmittance, sums of weight times channel)."""
    transmittance, sums = state
    alphas = lax.optimization_barrier(clamp(response.raw_alphas(chunk)))
    weights, transmittance = blend_weights(alphas, transmittance)
    weights = lax.optimization_barrier(weights)
    # The loop over k is unrolled: XLA's small batched matmul is several times slower on CPU.
    for k in range(weights.shape[1]):
        sums = sums + chunk.rows[:, k, response.COLUMNS :, None] * weights[:, k, None, :]
    return (transmittance, sums), None


def blend_gradient(
    state: tuple[Float[Array, "b p"], Float[Array, "b p"], Float[Array, "b c p"]],
    gradients: Float[Array, "rows t"],
    chunk: Chunk,
    response: Response,
    watched: bool,
) -> tuple[tuple[Float[Array, "b p"], Float[Array, "b p"], Float[Array, "b c p"]], Float[Array, "rows t"]]:
    """Adds the contribution of a chunk to the gradients of its splats.

    Args:
        state: transmittance, sum of w_j s_j over the splats behind, dL/d sums.
        gradients: for each row, the sums over pixels that the response needs of g = alpha dL/d alpha; then
            dL/d channels; then, if watched, sum |dL/dx|, sum |dL/dy|.
        chunk: splats to process.
        response: of the splats at pixels.
        watched: whether the gradient of `Splats.pull` is requested.
    """
    transmittance, behind, d_sums = state
    raw = lax.optimization_barrier(response.raw_alphas(chunk))
    alphas = clamp(raw)
    weights, transmittance = blend_weights(alphas, transmittance)
    weights = lax.optimization_barrier(weights)
    values = sum(
        chunk.rows[:, :, response.COLUMNS + c, None] * d_sums[:, None, c] for c in range(d_sums.shape[1])
    )
    contributions = lax.optimization_barrier(weights * values)
    blended, total = running(jnp.add, contributions, jnp.zeros_like(behind))
    still_behind = behind[:, None] - blended - contributions
    # A clamped alpha does not depend on the splat's shape.
    flexible = (weights > 0) & (raw <= MAX_ALPHA)
    g = jnp.where(flexible, contributions - alphas / (1 - alphas) * still_behind, 0)
    g = lax.optimization_barrier(g)

    d_channels = jnp.einsum("bkp,bcp->bkc", weights, d_sums, precision="highest")
    columns = [response.sums(g, chunk), d_channels]
    if watched:
        columns.append(response.pull_of(g, chunk))
    rows = jnp.concatenate(columns, axis=-1)
    return (transmittance, behind - total, d_sums), gradients.at[chunk.ranks].add(rows)


def clamp(raw: Float[Array, "b k p"]) -> Float[Array, "b k p"]:
    """Returns min(0.99, alpha), or 0 below 1/255."""
    return jnp.where(raw >= MIN_ALPHA, jnp.minimum(raw, MAX_ALPHA), 0)


def blend_weights(
    alphas: Float[Array, "b k p"], transmittance: Float[Array, "b p"]
) -> tuple[Float[Array, "b k p"], Float[Array, "b p"]]:
    """Returns the weights T_i alpha_i, and the remaining transmittance.

    The transmittance is 0 once a splat would take it below 1e-4.
    """
    before, after = running(jnp.multiply, 1 - alphas, transmittance)
    weights = jnp.where(before * (1 - alphas) >= MIN_TRANSMITTANCE, before * alphas, 0)
    return weights, jnp.where(after >= MIN_TRANSMITTANCE, after, 0)


def running(
    combine, values: Float[Array, "b k p"], start: Float[Array, "b p"]
) -> tuple[Float[Array, "b k p"], Float[Array, "b p"]]:
    """Returns start, start * v_0, start * v_0 * v_1, ... along k, and the total, which includes all values.

    It has two levels, both unrolled: XLA's own cumulative sums and products are many times slower on CPU, and
    so is a loop over k.
    """
    b, k, p = values.shape
    groups = values.reshape(b, k // GROUP, GROUP, p)
    members = [groups[:, :, i] for i in range(GROUP)]
    whole = members[0]
    for member in members[1:]:
        whole = combine(whole, member)
    whole = lax.optimization_barrier(whole)
    totals = [start]
    for i in range(k // GROUP):
        totals.append(combine(totals[-1], whole[:, i]))
    before = [lax.optimization_barrier(jnp.stack(totals[:-1], axis=1))]
    for member in members[:-1]:
        before.append(combine(before[-1], member))
    return jnp.stack(before, axis=2).reshape(b, k, p), totals[-1]
