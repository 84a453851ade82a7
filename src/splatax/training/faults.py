"""Numbers that are not finite: a step that meets them is left out, and the Gaussians they come from go.

Nothing of the sort should happen. But it does, on hardware that errs and in scenes nobody thought of, and
a single NaN that gets into the moments of Adam, or into a pixel, has reached everything two steps later.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int

from splatax.gaussians import Gaussians


class Faults(NamedTuple):
    """What has happened in a run until now."""

    steps: Int[Array, ""]  # that were left out
    gaussians: Int[Array, ""]  # that were removed


def none() -> Faults:
    """Before any step."""
    return Faults(jnp.int32(0), jnp.int32(0))


def find(
    gaussians: Gaussians, gradients: Gaussians, others: Any, loss: Float[Array, ""]
) -> tuple[Bool[Array, ""], Bool[Array, " n"]]:
    """Whether all that a step has computed is finite, and which Gaussians are at fault if not.

    At fault is one whose numbers, or whose gradients from a finite loss, are not finite when squared.
    A loss that is not finite gives such gradients to all that it sees, and so accuses no one.

    Args:
        gaussians: before the step.
        gradients: of the loss in them.
        others: all further gradients.
        loss: of the step.
    """
    told = jnp.isfinite(loss)
    total = sum(jnp.sum(leaf * leaf) for leaf in jax.tree.leaves(others))
    total = total + _total(gaussians) + _total(gradients)
    fine = told & jnp.isfinite(total)

    def search():
        return ~jnp.isfinite(_energy(gaussians) + jnp.where(told, _energy(gradients), 0))

    return fine, lax.cond(fine, lambda: jnp.zeros(len(gaussians), bool), search)


def counted(earlier: Faults, fine: Bool[Array, ""], at_fault: Bool[Array, " n"]) -> Faults:
    """The faults until now, those of a step among them."""
    return Faults(
        earlier.steps + (~fine).astype(jnp.int32), earlier.gaussians + jnp.sum(at_fault, dtype=jnp.int32)
    )


def chosen(fine: Bool[Array, ""], new: Any, old: Any) -> Any:
    """The new values if all is fine, else the old ones."""
    return jax.tree.map(lambda a, b: jnp.where(fine, a, b), new, old)


def emptied(
    gaussians: Gaussians, opt_state: optax.OptState, at_fault: Bool[Array, " n"]
) -> tuple[Gaussians, optax.OptState]:
    """The same rows, but those at fault are empty slots without moments."""

    def zeroed(tree: Gaussians) -> Gaussians:
        def rows(leaf):
            return jnp.where(at_fault.reshape(-1, *[1] * (leaf.ndim - 1)), 0, leaf)

        return jax.tree.map(rows, tree)

    gaussians = zeroed(gaussians)
    gaussians = replace(gaussians, opacity_logits=jnp.where(at_fault, -jnp.inf, gaussians.opacity_logits))
    return gaussians, opt_state._replace(mu=zeroed(opt_state.mu), nu=zeroed(opt_state.nu))


def _total(gaussians: Gaussians) -> Float[Array, ""]:
    """The sum of squares of all numbers. A dot product, because that is what all devices are fast at."""
    flat = [leaf.ravel() for leaf in jax.tree.leaves(_countable(gaussians))]
    return sum((jnp.dot(leaf, leaf) for leaf in flat), jnp.zeros(()))


def _energy(gaussians: Gaussians) -> Float[Array, " n"]:
    """The sum of squares of all numbers of each row."""
    rows = [leaf.reshape(len(gaussians), -1) for leaf in jax.tree.leaves(_countable(gaussians))]
    return sum((jnp.sum(row * row, axis=1) for row in rows), jnp.zeros(len(gaussians)))


def _countable(gaussians: Gaussians) -> Gaussians:
    """With zeros for logarithms of zero, which are meant: of empty slots and of flat Gaussians."""
    logits, scales = gaussians.opacity_logits, gaussians.log_scales
    return replace(
        gaussians,
        opacity_logits=jnp.where(logits == -jnp.inf, 0, logits),
        log_scales=jnp.where(scales == -jnp.inf, 0, scales),
    )
