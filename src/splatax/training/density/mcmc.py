"""Relocation of dead Gaussians, and growth to a given number (3DGS-MCMC, Kheradmand et al. 2024).

The Gaussians are regarded as samples of a distribution. A Gaussian that has faded is moved onto a living
one, and new Gaussians are placed onto living ones, such that the image hardly changes. The noise of
`Langevin` then separates them.
"""

import math
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.training.capacity import bucket_for, with_empty_slots
from splatax.training.density.growth import ByFactor, Growth, require_limit
from splatax.training.protocols import DensityUpdate, Lineage

MAX_COPIES = 51  # by which one Gaussian is replaced in a refinement (the authors' limit)


@dataclass(frozen=True)
class Mcmc:
    """Relocates dead Gaussians and grows the scene, with the authors' settings."""

    every: int = 100  # steps between refinements
    start: int = 500  # no refinement up to this step
    until: int = 25_000  # no refinement from this step on
    growth: Growth = ByFactor()
    min_opacity: float = 0.005  # Gaussians of at most this opacity are dead, and relocated
    max_gaussians: int = 1_000_000

    def __post_init__(self) -> None:
        require_limit(self.max_gaussians)

    def init(self, capacity: int) -> tuple[()]:
        """Returns an empty state: relocation depends only on opacities."""
        return ()

    def watch(self, splats: Splats) -> Splats:
        """Returns the splats unchanged."""
        return splats

    def observe(self, state: tuple[()], splats: Splats, d_splats: Splats) -> tuple[()]:
        """Returns the state unchanged."""
        return state

    def due(self, step: int) -> bool:
        """Returns whether the scene is refined after this many steps."""
        return self.start < step < self.until and step % self.every == 0

    def refine(
        self, state: tuple[()], gaussians: Gaussians, count: int, step: int, extent: float, key: PRNGKeyArray
    ) -> DensityUpdate:
        """Relocates the dead Gaussians and adds new ones; see `DensityStrategy.refine`."""
        opacities = np.asarray(gaussians.opacities, np.float64)[:count]
        dead = opacities <= self.min_opacity
        if dead.all():  # there is no Gaussian to move them onto
            rows = len(gaussians)
            return DensityUpdate(gaussians, count, Lineage(jnp.arange(rows), jnp.zeros(rows, bool)), state)
        grown = max(self.growth.after(count, step, self.every, self.max_gaussians), count)
        seekers = np.concatenate([np.flatnonzero(dead), np.arange(count, grown)])
        sources = in_proportion(np.where(dead, 0, opacities), len(seekers), key)

        parent = np.arange(bucket_for(grown, len(gaussians), self.max_gaussians))
        parent[seekers] = sources
        parent[grown:] = 0
        copies = np.minimum(1 + np.bincount(sources, minlength=count), MAX_COPIES)
        opacity, factor = relocated(opacities, copies)
        opacity = np.clip(opacity, self.min_opacity, 1 - np.finfo(np.float32).eps)
        newborn = (copies > 1)[parent]  # sources among them
        newborn[grown:] = True
        return DensityUpdate(
            _moved(
                gaussians,
                jnp.asarray(parent),
                jnp.asarray(newborn),
                jnp.asarray(np.log(opacity / (1 - opacity))[parent], jnp.float32),
                jnp.asarray(np.log(factor)[parent], jnp.float32),
                jnp.int32(grown),
            ),
            grown,
            Lineage(jnp.asarray(parent), jnp.asarray(newborn)),
            state,
        )


def in_proportion(weights: Float[np.ndarray, " n"], draws: int, key: PRNGKeyArray) -> Int[np.ndarray, " m"]:
    """Draws indices with replacement, with probabilities proportional to the weights.

    Draws are stratified: one from each of `draws` equal intervals of the cumulated weights. They clump less
    than independent draws.
    """
    ends = np.cumsum(weights)
    offsets = np.random.default_rng(np.asarray(jax.random.key_data(key))).random(draws)
    index = np.searchsorted(ends, (np.arange(draws) + offsets) / max(draws, 1) * ends[-1], side="right")
    return np.minimum(index, np.flatnonzero(weights)[-1])


def relocated(
    opacities: Float[np.ndarray, " n"], copies: Int[np.ndarray, " n"]
) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Returns opacities and scale factors of N copies that replace one Gaussian.

    Drawn over each other, N copies of opacity o' = 1 - (1 - o)^(1/N) have the same coverage in the centre as
    the original, and the same total coverage if their scales are multiplied by (Kheradmand et al. 2024,
    Eq. 9)

        o / sum_i sum_k C(i-1, k) (-1)^k o'^(k+1) / sqrt(k+1),   k < i <= N,
      = o / sum_j C(N, j) (-1)^(j-1) o'^j / sqrt(j),             1 <= j <= N.

    Args:
        opacities: o.
        copies: N, at most `MAX_COPIES`.

    Returns:
        o' and the factors.
    """
    part = 1 - (1 - opacities) ** (1 / copies)
    total = np.zeros_like(opacities)
    for j in range(1, int(copies.max(initial=1)) + 1):
        choose = _BINOMIALS[copies, j]
        total += choose * (-1) ** (j - 1) * part**j / math.sqrt(j)
    return part, np.where(copies > 1, opacities / np.where(copies > 1, total, 1), 1)


_BINOMIALS = np.array(
    [[float(math.comb(n, j)) for j in range(MAX_COPIES + 1)] for n in range(MAX_COPIES + 1)]
)


@jax.jit
def _moved(
    gaussians: Gaussians,
    parent: Int[Array, " m"],
    newborn: Bool[Array, " m"],
    opacity_logits: Float[Array, " m"],
    log_factors: Float[Array, " m"],
    count: Int[Array, ""],
) -> Gaussians:
    """Returns copies of the parents, with new opacities and scales where a parent has several copies."""
    moved = jax.tree.map(lambda leaf: leaf[parent], gaussians)
    moved = replace(
        moved,
        opacity_logits=jnp.where(newborn, opacity_logits, moved.opacity_logits),
        log_scales=moved.log_scales + log_factors[:, None],
    )
    return with_empty_slots(moved, count)
