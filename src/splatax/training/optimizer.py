"""The optimizer of the scene: an update rule of optax, a learning rate for each field, and noise."""

import math
from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Bool, Float

from splatax.gaussians import ARRAYS, Gaussians
from splatax.math import harmonics, quaternions
from splatax.pytrees import pytree
from splatax.training.capacity import across
from splatax.training.noise import NoNoise
from splatax.training.protocols import Noise, Reach, UpdateRule


@dataclass(frozen=True)
class Adam:
    """Adam (Kingma and Ba 2015) with the constants of the authors' code of Kerbl et al. 2023."""

    b1: float = 0.9  # decay of the mean of gradients per step
    b2: float = 0.999  # decay of the mean of their squares per step
    eps: float = 1e-15  # so small that the learning rates alone decide the length of a step

    def __call__(self) -> optax.GradientTransformation:
        """Returns Adam for a learning rate of 1."""
        return optax.adam(1.0, self.b1, self.b2, self.eps)


@pytree
@dataclass(frozen=True)
class LearningRates:
    """Learning rates of the fields (authors' code of Kerbl et al. 2023).

    The authors keep all rates but that of the means constant. Rates that fall at the end of the run let
    the Gaussians settle where they fit all photos, and not the last few.
    """

    means: float = 1.6e-4  # times the reach, by default the scene's extent, at the start
    means_final: float = 1.6e-6  # times the reach, at the end; log-linear between
    sh_dc: float = 2.5e-3  # band 0 of the spherical harmonics
    sh_rest: float = 2.5e-3 / 20  # the other bands
    opacity_logits: float = 0.05
    log_scales: float = 5e-3
    quats: float = 1e-3
    settled: float = 1.0  # final rate of all fields but the means, as a fraction of the rate above
    settling_from: float = 0.85  # fraction of the run after which these rates fall, log-linearly

    def times(self, factor: float) -> "LearningRates":
        """Returns rates that are all multiplied by a factor."""
        settling = {"settled", "settling_from"}
        rates = {f.name: factor * getattr(self, f.name) for f in fields(self) if f.name not in settling}
        return replace(self, **rates)

    def at(self, progress: Float[Array, ""], reach: Float[Array, " m"], coefficients: int) -> Gaussians:
        """Returns the learning rates in the shape of a scene of one Gaussian, those of means also of all.

        Args:
            progress: fraction of the run that is done, 0 to 1.
            reach: length that the rates of the means are a fraction of: one, or one for each Gaussian.
            coefficients: number of spherical harmonics.
        """
        means = self.means * (self.means_final / self.means) ** progress * reach
        fall = self.settled ** jnp.clip((progress - self.settling_from) / (1 - self.settling_from), 0, 1)
        sh = jnp.full((1, coefficients, 1), self.sh_rest).at[:, 0].set(self.sh_dc)
        return Gaussians(
            means[:, None],
            jnp.full((1, 1), self.quats * fall),
            jnp.full((1, 1), self.log_scales * fall),
            jnp.full(1, self.opacity_logits * fall),
            sh * fall,
        )


def rates_for(steps: int) -> LearningRates:
    """Returns learning rates for a run of this length: the authors', raised if it is short.

    At 2,000 steps, the rate of the means is 12 times that of the authors. The factor falls with the square
    root of the number of steps, down to the authors' rates, which are for 30,000 steps. Runs of fewer
    than 500 steps get the rates of 500.
    """
    authors, haste = LearningRates(), math.sqrt(2_000 / max(steps, 500))

    def raised(rate: float, by: float) -> float:
        return rate * max(by * haste, 1.0)

    return LearningRates(
        means=raised(authors.means, 12.0),
        means_final=raised(authors.means_final, 12.0),
        sh_dc=raised(authors.sh_dc, 3.0),
        sh_rest=raised(authors.sh_rest, 3.0),
        opacity_logits=authors.opacity_logits,
        log_scales=raised(authors.log_scales, 4.5),
        quats=raised(authors.quats, 6.0),
    )


@dataclass(frozen=True)
class SceneExtent:
    """Steps of the means are fractions of the scene's extent, for all Gaussians alike."""

    def __call__(self, depths: Float[Array, " n"], extent: Float[Array, ""]) -> Float[Array, " 1"]:
        """Returns the extent."""
        return extent[None]


@dataclass(frozen=True)
class ViewDepth:
    """Steps of the means are fractions of the depth in the step's view, so that pictures change alike.

    A step is then as many pixels long for a distant Gaussian as for a near one, whatever the scene's extent.
    """

    factor: float = 0.4
    nearest: float = 0.05  # of the scene's extent: smaller depths count as this one
    farthest: float = 100.0  # of the scene's extent: larger depths count as this one

    def __call__(self, depths: Float[Array, " n"], extent: Float[Array, ""]) -> Float[Array, " n"]:
        """Returns `factor` times the depths."""
        return self.factor * jnp.clip(depths, self.nearest * extent, self.farthest * extent)


@dataclass(frozen=True)
class Optimizer:
    """Moves the Gaussians: field += learning rate * update, then noise.

    Attributes:
        rule: builds a transformation of optax whose updates are for a learning rate of 1, such as `Adam()`
            or `functools.partial(optax.rmsprop, 1.0)`.
        rates: learning rates of the fields.
        reach: length that the learning rates of the means are fractions of.
        noise: added to the scene after each step.
    """

    rule: UpdateRule = Adam()
    rates: LearningRates = LearningRates()
    reach: Reach = SceneExtent()
    noise: Noise = NoNoise()


def update(
    gaussians: Gaussians, gradients: Gaussians, opt_state: optax.OptState, rates: Gaussians, rule: UpdateRule
) -> tuple[Gaussians, optax.OptState]:
    """Makes one step; quaternions are unit again after it.

    Args:
        gaussians: the scene.
        gradients: of the loss.
        opt_state: of the rule's transformation.
        rates: learning rates, in the shape of a scene of one Gaussian.
        rule: builds the transformation.
    """
    updates, opt_state = rule().update(gradients, opt_state, gaussians)
    # A rule that reads the parameters, such as one with weight decay, must not move logits of -inf.
    empty = jnp.isneginf(gaussians.opacity_logits)
    updates = replace(updates, opacity_logits=jnp.where(empty, 0, updates.opacity_logits))
    gaussians = jax.tree.map(lambda x, rate, step: x + rate * step, gaussians, rates, updates)
    return replace(gaussians, quats=jax.vmap(quaternions.normalize)(gaussians.quats)), opt_state


def restarted(
    opt_state: optax.OptState,
    newborn: Bool[Array, " n"],
    fields: Collection[str],
    gaussians: Gaussians,
    rule: UpdateRule,
) -> optax.OptState:
    """Returns the optimizer state after a refinement: that of newborns starts anew.

    Args:
        opt_state: of the rule's transformation, for the parent of each row.
        newborn: the rows that start anew.
        fields: names of fields that start anew in every row.
        gaussians: the refined scene, or a part of its rows.
        rule: builds the transformation.

    Returns:
        The state. Whatever is not of the scene's shape, such as a step count, is kept.
    """

    def starts_anew(leaf: Array | optax.MaskedNode, field: bool) -> Array | optax.MaskedNode:
        return leaf if is_masked(leaf) else across(newborn | field, leaf.ndim)

    transformation = rule()
    map_params = partial(optax.tree_utils.tree_map_params, transformation, is_leaf=is_masked)
    flags: list[Any] = [name in fields for name in ARRAYS]
    anew = map_params(starts_anew, opt_state, Gaussians(*flags), transform_non_params=lambda _: False)
    return jax.tree.map(jnp.where, anew, transformation.init(gaussians), opt_state)


def is_masked(node: object) -> bool:
    """Returns whether an optimizer state has nothing in place of a field, as `optax.partition` leaves it."""
    return isinstance(node, optax.MaskedNode)


def without_locked_bands(
    gradients: Gaussians, progress: Float[Array, ""], openings: Float[Array, " bands"]
) -> Gaussians:
    """Zeroes the gradients of SH bands that are still locked.

    Args:
        gradients: of the loss.
        progress: fraction of the run that is done, in float32.
        openings: fraction of the run after which each band is learned; see `ShSchedule.openings`.
    """
    free = free_coefficients(progress, openings, gradients.sh.shape[1])
    return replace(gradients, sh=jnp.where(free[None, :, None], gradients.sh, 0))


def free_coefficients(
    progress: Float[Array, ""], openings: Float[Array, " bands"], coefficients: int
) -> Bool[Array, " k"]:
    """Returns which spherical harmonics are learned already; arguments as of `without_locked_bands`."""
    band = jnp.array([l for l in range(harmonics.MAX_DEGREE + 1) for _ in range(2 * l + 1)])
    return (openings <= progress)[band[:coefficients]]
