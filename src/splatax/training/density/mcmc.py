"""Relocation of dead Gaussians, and growth to a given number (3DGS-MCMC, Kheradmand et al. 2024).

The Gaussians are regarded as samples of a distribution. A Gaussian that has faded is moved onto a living
one, and new Gaussians are placed onto living ones, such that the image hardly changes. The noise of
`Langevin` then separates them.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int, PRNGKeyArray
from scipy.special import expit, logit

from splatax.gaussians import Gaussians
from splatax.splats import Splats
from splatax.training.density.growth import ByFactor, Growth, require_limit
from splatax.training.protocols import DensityPlan, HostOrDevice

MAX_COPIES = 51  # by which one Gaussian is replaced in a refinement (the authors' limit)


class Copies(NamedTuple):
    """The properties that each Gaussian gets in a refinement; without copies, the same as before."""

    opacity_logits: Float[HostOrDevice, " n"]
    log_factors: Float[HostOrDevice, " n"]  # of the scales


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

    def columns(self, state: tuple[()], gaussians: Gaussians) -> Float[Array, " n"]:
        """Returns the opacity logits."""
        return gaussians.opacity_logits

    def plan(
        self, columns: Float[np.ndarray, " n"], step: int, extent: float, key: PRNGKeyArray
    ) -> DensityPlan:
        """Relocates the dead Gaussians and adds new ones; see `DensityStrategy.plan`."""
        logits, count = columns, len(columns)
        opacities = expit(logits.astype(np.float64))
        dead = opacities <= self.min_opacity
        if dead.all():  # there is no Gaussian to move them onto
            given = Copies(logits, np.zeros_like(logits))
            return DensityPlan(np.arange(count), np.zeros(count, bool), given, most=self.max_gaussians)
        grown = max(self.growth.after(count, step, self.every, self.max_gaussians), count)
        seekers = np.concatenate([np.flatnonzero(dead), np.arange(count, grown)])
        sources = in_proportion(np.where(dead, 0, opacities), len(seekers), key)

        parents = np.arange(grown)
        parents[seekers] = sources
        copies = np.minimum(1 + np.bincount(sources, minlength=count), MAX_COPIES)
        opacity, factor = relocated(opacities, copies)
        opacity = np.clip(opacity, self.min_opacity, 1 - np.finfo(np.float32).eps)
        logits = np.where(copies > 1, logit(opacity), logits).astype(np.float32)
        given = Copies(logits[parents], np.log(factor).astype(np.float32)[parents])
        return DensityPlan(parents, (copies > 1)[parents], given, most=self.max_gaussians)

    def reborn(self, gaussians: Gaussians, state: tuple[()], given: Copies) -> Gaussians:
        """Returns copies of the parents, with new opacities and scales where a parent has several copies."""
        scales = gaussians.log_scales + given.log_factors[:, None]
        return replace(gaussians, opacity_logits=jnp.asarray(given.opacity_logits), log_scales=scales)


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
