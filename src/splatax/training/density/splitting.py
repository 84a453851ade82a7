"""Relocation and growth by splitting the Gaussians with the largest gradients of their 2D means.

A copy that lies exactly on its parent gets the gradients of its parent, so the two stay together. Here the
parent is split along its longest axis instead (Improved-GS, arXiv 2508.12313), and a parent
is chosen with a probability that grows with the pull on it, not with its opacity.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy.special import expit

from splatax.gaussians import Gaussians
from splatax.math import ellipsoids
from splatax.splats import Splats
from splatax.training.density.growth import ByFactor, Growth, require_limit
from splatax.training.density.pulls import pulls
from splatax.training.protocols import DensityPlan, HostOrDevice


class Observed(NamedTuple):
    """Statistics of each Gaussian over the views since the last refinement."""

    pull: Float[Array, " n"]  # sum
    views: Float[Array, " n"]  # number of views in which it was visible
    nearest: Float[Array, " n"]  # least depth at which its centre was in a photo, world units, or infinite


class Columns(NamedTuple):
    """The columns on which the choice of parents depends."""

    opacity_logits: Float[HostOrDevice, " n"]
    pull: Float[HostOrDevice, " n"]
    views: Float[HostOrDevice, " n"]


@dataclass(frozen=True)
class Halves:
    """The two children of a Gaussian that is split along its longest axis.

    Together they cover about what their parent covers; the values are chosen by experiment (docs/recipes.md).
    """

    distance: float = 1.0  # of each child from the parent's centre, standard deviations of that axis
    along: float = 0.665  # factor on the scale of that axis
    across: float = 0.95  # factor on the two other scales
    opacity: float = 0.75  # factor


@dataclass(frozen=True)
class Splitting:
    """Moves dead Gaussians to where detail is missing, and grows the scene there, by splitting."""

    every: int = 100  # steps between refinements
    start: int = 500  # no refinement up to this step
    until: int = 25_000  # no refinement from this step on
    growth: Growth = ByFactor()
    min_opacity: float = 0.005  # Gaussians of at most this opacity are dead, and relocated
    focus: float = 3.0  # exponent of the pull in the probability of being a parent
    halves: Halves = Halves()
    largest: float = 0.5  # standard deviation, as a fraction of the least depth; larger ones are cut to it
    max_gaussians: int = 1_000_000

    def __post_init__(self) -> None:
        require_limit(self.max_gaussians)
        if not self.largest > 0:
            raise ValueError(f"largest must be above 0, not {self.largest}. For no limit of sizes: math.inf")

    def init(self, capacity: int) -> Observed:
        """Returns statistics of no view."""
        pull, views = jnp.zeros(capacity), jnp.zeros(capacity)
        # `jnp.full` would be weakly typed, so that the first step had a program of its own.
        return Observed(pull, views, jnp.full_like(pull, jnp.inf))

    def watch(self, splats: Splats) -> Splats:
        """Adds `pull` to the splats."""
        return replace(splats, pull=jnp.zeros_like(splats.means2d))

    def observe(self, state: Observed, splats: Splats, d_splats: Splats) -> Observed:
        """Adds one view to the statistics."""
        pull, visible = pulls(splats, d_splats)
        across, down = splats.means2d[:, 0] / splats.width, splats.means2d[:, 1] / splats.height
        inside = visible & (across >= 0) & (across <= 1) & (down >= 0) & (down <= 1)
        depths = jnp.where(inside, splats.depths, jnp.inf).astype(state.nearest.dtype)
        return Observed(
            state.pull + pull,
            state.views + visible.astype(state.views.dtype),
            jnp.minimum(state.nearest, depths),
        )

    def due(self, step: int) -> bool:
        """Returns whether the scene is refined after this many steps."""
        return self.start < step < self.until and step % self.every == 0

    def columns(self, state: Observed, gaussians: Gaussians) -> Columns:
        """Returns opacities, and what was observed of the pull."""
        return Columns(gaussians.opacity_logits, state.pull, state.views)

    def plan(self, columns: Columns, step: int, extent: float, key: PRNGKeyArray) -> DensityPlan:
        """Relocates the dead Gaussians and adds new ones; see `DensityStrategy.plan`.

        A parent is split once, so a refinement at most doubles the number of Gaussians. Dead Gaussians for
        which there is no parent stay where they are.
        """
        logits, pull, views = (leaf.astype(np.float64) for leaf in columns)
        count, dead = len(logits), expit(logits) <= self.min_opacity
        weights = np.where(dead, 0, (pull / np.maximum(views, 1)) ** self.focus)
        grown = max(self.growth.after(count, step, self.every, self.max_gaussians), count)
        rows = np.concatenate([np.flatnonzero(dead), np.arange(count, grown)])  # to be filled
        split = without_replacement(weights, len(rows), key)
        rows = rows[: len(split)]

        parents = np.arange(max(count, int(rows.max(initial=-1)) + 1))
        parents[rows] = split
        side = np.zeros(len(parents), np.float32)  # of the parent's centre, for a child
        side[rows], side[split] = 1, -1
        return DensityPlan(parents, side != 0, side, most=self.max_gaussians)

    def reborn(self, gaussians: Gaussians, state: Observed, given: Float[Array, " n"]) -> Gaussians:
        """Returns copies of the parents, or children on the given side of them.

        Scales above `largest` are cut first. A Gaussian behind a wall can grow without being seen, until
        it covers the picture of a camera beside which it lies: the linear projection of a Gaussian that is
        large compared with its depth covers far more than the Gaussian.
        """
        limit = jnp.log(self.largest * state.nearest)
        limited = replace(gaussians, log_scales=jnp.minimum(gaussians.log_scales, limit[:, None]))
        return _split(limited, given, self.halves)


def without_replacement(
    weights: Float[np.ndarray, " n"], draws: int, key: PRNGKeyArray
) -> Int[np.ndarray, " m"]:
    """Draws different indices, one after the other in proportion to the weights of those that are left.

    The largest of log w + Gumbel noise are such draws (Efraimidis and Spirakis 2006). Indices of zero weight
    are never drawn, so there may be fewer than `draws`.
    """
    possible = np.flatnonzero(weights)
    noise = np.random.default_rng(np.asarray(jax.random.key_data(key))).gumbel(size=len(possible))
    order = np.argsort(-(np.log(weights[possible]) + noise), kind="stable")
    return possible[order[:draws]]


def _split(rows: Gaussians, side: Float[Array, " n"], halves: Halves) -> Gaussians:
    """Returns Gaussians; one whose side is 1 or -1 is the child on that side of its parent."""
    is_child: Bool[Array, " n"] = side != 0
    longest = jax.nn.one_hot(jnp.argmax(rows.log_scales, axis=1), 3)
    axes = jax.vmap(ellipsoids.covariance_factor)(rows.quats, rows.scales)
    offsets = halves.distance * side[:, None] * jnp.einsum("nij,nj->ni", axes, longest)
    factors = jnp.where(longest > 0, halves.along, halves.across)
    opacity = jnp.clip(halves.opacity * rows.opacities, 1e-6, 1 - 1e-6)
    return replace(
        rows,
        means=rows.means + offsets,
        log_scales=rows.log_scales + jnp.where(is_child[:, None], jnp.log(factors), 0),
        opacity_logits=jnp.where(is_child, jnp.log(opacity / (1 - opacity)), rows.opacity_logits),
    )
