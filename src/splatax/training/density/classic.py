"""Adaptive density control: clone, split, prune, and reset opacities (Kerbl et al. 2023, Sec. 5.2).

A large gradient of the loss with respect to the 2D mean of a Gaussian marks missing detail. A small
Gaussian covers too little there and is cloned; a large one covers too much and is split. Gradients of
single pixels that point in opposite directions cancel out in the sum, but not in the sum of their absolute
values (AbsGS, Ye et al. 2024).
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray
from scipy.special import expit, logit

from splatax.gaussians import Gaussians
from splatax.math import ellipsoids
from splatax.splats import Splats
from splatax.training.density.growth import require_limit
from splatax.training.density.pulls import pulls
from splatax.training.protocols import DensityPlan, HostOrDevice


class Observed(NamedTuple):
    """Statistics of each Gaussian over the views since the last refinement."""

    pull: Float[Array, " n"]  # sum of |dL/d means2d|, with the image running from -1 to 1
    views: Float[Array, " n"]  # number of views in which it was visible
    screen: Float[Array, " n"]  # largest extent seen, as a fraction of the image's longer side


class Columns(NamedTuple):
    """The columns on which the choice of children depends."""

    opacity_logits: Float[HostOrDevice, " n"]
    log_scales: Float[HostOrDevice, "n 3"]
    pull: Float[HostOrDevice, " n"]
    views: Float[HostOrDevice, " n"]
    screen: Float[HostOrDevice, " n"]


class Children(NamedTuple):
    """The properties that each Gaussian of a refined scene gets from the plan."""

    opacity_logits: Float[HostOrDevice, " n"]
    split: Bool[HostOrDevice, " n"]  # whether it is one of the two into which its parent was split
    normal: Float[HostOrDevice, "n 3"]  # its place, in standard deviations along the axes of the parent


@dataclass(frozen=True)
class Classic:
    """Clones, splits and prunes Gaussians and resets opacities, with the authors' settings."""

    every: int = 100  # steps between refinements
    start: int = 500  # no densification up to this step
    until: int = 15_000  # no refinement from this step on
    pull_threshold: float = 2e-4  # mean over views of |dL/d means2d|, image from -1 to 1
    absolute: bool = False  # whether |dL/dx| and |dL/dy| are summed over pixels (AbsGS)
    dense_size: float = 0.01  # fraction of the scene's extent: larger ones are split, smaller cloned
    shrink: float = 1.6  # factor by which the scales of a split Gaussian are divided
    min_opacity: float = 0.005  # fainter Gaussians are pruned
    max_world_size: float = 0.1  # fraction of the scene's extent: larger ones are pruned after a reset
    max_screen_size: float = 0.15  # fraction of the image's longer side; as above, up to `screen_until`
    screen_until: int = 4_000  # step (splatfacto's values: the authors' own test never fires)
    reset_every: int = 3_000  # steps between opacity resets
    reset_opacity: float = 0.01  # highest opacity after a reset
    max_gaussians: int = 5_000_000  # growth stops here; the largest gradients are densified first

    def __post_init__(self) -> None:
        require_limit(self.max_gaussians)

    def init(self, capacity: int) -> Observed:
        """Returns statistics of no view."""
        return Observed(*(jnp.zeros(capacity) for _ in Observed._fields))

    def watch(self, splats: Splats) -> Splats:
        """Adds `pull` to the splats if gradients are summed by absolute values."""
        return replace(splats, pull=jnp.zeros_like(splats.means2d)) if self.absolute else splats

    def observe(self, state: Observed, splats: Splats, d_splats: Splats) -> Observed:
        """Adds one view to the statistics."""
        pull, visible = pulls(splats, d_splats)
        screen = jnp.maximum(splats.extents[:, 0], splats.extents[:, 1]) / max(splats.width, splats.height)
        return Observed(
            state.pull + pull,
            state.views + visible.astype(state.views.dtype),
            jnp.maximum(state.screen, screen),
        )

    def due(self, step: int) -> bool:
        """Returns whether the scene is densified or its opacities are reset after this many steps."""
        return step < self.until and (self._densifies(step) or self._resets(step))

    def columns(self, state: Observed, gaussians: Gaussians) -> Columns:
        """Returns opacities and sizes, and what was observed."""
        return Columns(gaussians.opacity_logits, gaussians.log_scales, *state)

    def plan(self, columns: Columns, step: int, extent: float, key: PRNGKeyArray) -> DensityPlan:
        """Densifies, prunes and resets opacities as due; see `DensityStrategy.plan`."""
        logits = columns.opacity_logits
        parents = np.arange(len(logits))
        kinds = np.full(len(logits), KEPT)
        if self._densifies(step):
            parents, kinds = self._children(columns, step, extent)
        restarted: tuple[str, ...] = ()
        if self._resets(step):
            logits = np.minimum(logits, np.float32(logit(self.reset_opacity)))
            restarted = ("opacity_logits",)
        split = kinds == SPLIT
        normal = np.zeros((len(parents), 3), np.float32)
        draws = np.random.default_rng(np.asarray(jax.random.key_data(key)))
        normal[split] = draws.standard_normal((int(split.sum()), 3), np.float32)
        given = Children(logits[parents], split, normal)
        return DensityPlan(
            parents, kinds != KEPT, given, restarted, self._densifies(step), most=self.max_gaussians
        )

    def reborn(self, gaussians: Gaussians, state: Observed, given: Children) -> Gaussians:
        """Returns copies of the parents; those of a split are smaller, and placed by its density."""
        factors = jax.vmap(ellipsoids.covariance_factor)(gaussians.quats, gaussians.scales)
        offsets = jnp.einsum("nij,nj->ni", factors, given.normal)
        split = given.split[:, None]
        return replace(
            gaussians,
            means=jnp.where(split, gaussians.means + offsets, gaussians.means),
            log_scales=jnp.where(split, gaussians.log_scales - math.log(self.shrink), gaussians.log_scales),
            opacity_logits=jnp.asarray(given.opacity_logits),
        )

    def _densifies(self, step: int) -> bool:
        return step > self.start and step % self.every == 0

    def _resets(self, step: int) -> bool:
        return step % self.reset_every == 0

    def _children(
        self, columns: Columns, step: int, extent: float
    ) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """Returns the parent of each new Gaussian, and its kind: KEPT, CLONE or SPLIT."""
        count, pull, screen = len(columns.pull), columns.pull, columns.screen
        size = np.exp(columns.log_scales).max(axis=1)
        faint = expit(columns.opacity_logits) < self.min_opacity
        oversized = np.zeros(count, bool)
        if step > self.reset_every:
            oversized = size > self.max_world_size * extent
            if step <= self.screen_until:
                oversized |= screen > self.max_screen_size

        pull = np.where(faint, 0, pull / np.maximum(columns.views, 1))
        chosen = self._most_pulled(pull, room=self.max_gaussians - count)
        large = size > self.dense_size * extent
        clone, split = np.flatnonzero(chosen & ~large), np.flatnonzero(chosen & large)
        if step > self.reset_every:
            split = split[size[split] / self.shrink <= self.max_world_size * extent]
        kept = np.flatnonzero(~faint & ~oversized & ~(chosen & large))
        clone = clone[~oversized[clone]]
        parents = np.concatenate([kept, clone, split, split])
        children = np.repeat([KEPT, CLONE, SPLIT], [len(kept), len(clone), 2 * len(split)])
        return parents, children

    def _most_pulled(self, pull: Float[np.ndarray, " n"], room: int) -> Bool[np.ndarray, " n"]:
        """Returns which gradients exceed the threshold: the largest, if there is no room for all of them."""
        chosen = pull >= self.pull_threshold
        if chosen.sum() > room:
            strongest = np.argsort(-pull, kind="stable")[: max(room, 0)]
            chosen = np.isin(np.arange(len(pull)), strongest) & chosen
        return chosen


KEPT, CLONE, SPLIT = 0, 1, 2
