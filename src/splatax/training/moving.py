"""The part of a training step that moves the Gaussians: by the backend's kernel, or by any rule of optax.

The kernel knows Adam, `Sparsity` and `Langevin`, which the presets are made of. A recipe with another rule,
prior or noise is moved by functions of JAX.
"""

from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax
from jax import lax
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray, UInt32

from splatax.backends.protocol import PullAndMove, PulledView
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.low_pass import LowPass
from splatax.moving import Moments, Rule, Step
from splatax.training import optimizer
from splatax.training.noise import Langevin, NoNoise
from splatax.training.optimizer import Adam, LearningRates
from splatax.training.priors import NoPrior, Sparsity
from splatax.training.recipes import Recipe


class Rows(NamedTuple):
    """Rows of a scene, and what is known of each."""

    gaussians: Gaussians
    gradients: Gaussians | None  # of the loss, without the prior; None where a kernel finds them
    opt_state: Any  # of the recipe's rule
    reach: Float[
        Array, " m"
    ]  # length that the means' learning rate is a fraction of: one, or one for each row


class Pace(NamedTuple):
    """The inputs of a move that all rows share."""

    learning_rates: LearningRates
    openings: Float[Array, " bands"]  # as `ShSchedule.openings`
    progress: Float[Array, ""]  # fraction of the run that is done
    good: Bool[Array, ""]  # false if nothing may move
    living: Int[Array, ""]  # number of Gaussians in the scene
    extent: Float[Array, ""]  # of the scene, world units

    def rates(self, rows: Rows) -> Gaussians:
        """Returns the learning rates in the shape of a scene of one Gaussian; zero if nothing may move."""
        rates = self.learning_rates.at(self.progress, rows.reach, rows.gaussians.sh.shape[1])
        return jax.tree.map(lambda leaf: jnp.where(self.good, leaf, 0), rates)


def rule_of(recipe: Recipe) -> Rule | None:
    """Returns the rule by which kernels move the scene of a recipe; None if they do not know a part of it."""
    adam, prior, noise = recipe.optimizer.rule, recipe.objective.prior, recipe.optimizer.noise
    if type(adam) is not Adam or adam.eps <= 0:
        return None
    if type(prior) not in (NoPrior, Sparsity) or type(noise) not in (NoNoise, Langevin):
        return None
    rule = Rule(adam.b1, adam.b2, adam.eps)
    if isinstance(prior, Sparsity):
        rule = replace(rule, opacity=prior.opacity, scale=prior.scale)
    if isinstance(noise, Langevin):
        rule = replace(rule, noise=noise.strength)
    return rule


def moved(
    rows: Rows, pace: Pace, noise_key: PRNGKeyArray, recipe: Recipe
) -> tuple[Gaussians, optax.OptState]:
    """Makes one step with a whole scene; returns the scene and the optimizer's state after it.

    Args:
        rows: of the scene.
        pace: the inputs that all rows share.
        noise_key: of the recipe's noise.
        recipe: the settings.
    """
    rule = rule_of(recipe)
    if rule is None or not draws_as_kernels(noise_key):
        return by_optax(rows, pace, noise_key, recipe)
    keys = jax.random.key_data(noise_key)[None]
    return by_kernel(rows, pace, rule, keys, max(len(rows.gaussians), 1), recipe)


def draws_as_kernels(key: PRNGKeyArray) -> bool:
    """Returns whether JAX is set to the random numbers that kernels draw."""
    return str(jax.random.key_impl(key)) == "threefry2x32" and jax.threefry_partitionable.value


def by_kernel(
    rows: Rows, pace: Pace, rule: Rule, keys: UInt32[Array, "b 2"], block: int, recipe: Recipe
) -> tuple[Gaussians, optax.OptState]:
    """Makes one step by the backend's kernel; returns the scene and the optimizer's state after it.

    Args:
        rows: own rows.
        pace: the inputs that all rows share.
        rule: as `rule_of`.
        keys: of the noise, for each block of rows.
        block: number of rows that share a key.
        recipe: the settings.
    """
    assert rows.gradients is not None
    adam, *_ = rows.opt_state
    step = _numbers(rows, pace, keys)
    move = recipe.drawing.kernels.move
    gaussians, moments = move(rows.gaussians, rows.gradients, Moments(adam.mu, adam.nu), step, rule, block)
    return gaussians, _after(rows, step, moments)


class ByView(NamedTuple):
    """A kernel that finds the gradient of a view and moves a scene by it, and the rule of the move."""

    kernel: PullAndMove
    rule: Rule

    def moved(
        self, rows: Rows, view: PulledView, pace: Pace, noise_key: PRNGKeyArray
    ) -> tuple[Gaussians, optax.OptState, Camera]:
        """Makes one step with a whole scene without given gradients; returns the camera's too."""
        adam, *_ = rows.opt_state
        step = _numbers(rows, pace, jax.random.key_data(noise_key)[None])
        block = max(len(rows.gaussians), 1)
        gaussians, moments, d_camera = self.kernel(
            rows.gaussians, view, Moments(adam.mu, adam.nu), step, self.rule, block
        )
        return gaussians, _after(rows, step, moments), d_camera


def by_view(camera: Camera, low_pass: LowPass, noise_key: PRNGKeyArray, recipe: Recipe) -> ByView | None:
    """Returns the kernel for the views and the rule of a recipe; None if two kernels or functions do it."""
    rule = rule_of(recipe)
    if rule is None or not draws_as_kernels(noise_key) or recipe.objective.geometry.outputs:
        return None
    kernel = recipe.drawing.kernels.moved_at_once(camera, low_pass)
    return None if kernel is None else ByView(kernel, rule)


def _numbers(rows: Rows, pace: Pace, keys: UInt32[Array, "b 2"]) -> Step:
    """Returns the numbers of a step with these rows."""
    coefficients = rows.gaussians.sh.shape[1]
    return Step(
        rates=pace.rates(rows),
        free=optimizer.free_coefficients(pace.progress, pace.openings, coefficients),
        good=pace.good,
        steps=optax.safe_increment(rows.opt_state[0].count),
        living=pace.living,
        extent=pace.extent,
        keys=keys,
    )


def _after(rows: Rows, step: Step, moments: Moments) -> optax.OptState:
    """Returns the state of Adam after a step."""
    adam, *rest = rows.opt_state
    return (adam._replace(count=step.steps, mu=moments.mean, nu=moments.square), *rest)


def by_optax(
    rows: Rows, pace: Pace, noise_key: PRNGKeyArray, recipe: Recipe
) -> tuple[Gaussians, optax.OptState]:
    """Makes one step by the transformation of optax that the recipe builds.

    Args:
        rows: own rows.
        pace: the inputs that all rows share.
        noise_key: of the recipe's noise.
        recipe: the settings.
    """
    prior = jax.grad(recipe.objective.prior)(rows.gaussians, pace.extent, pace.living)
    # A step that is not good has zero gradients and zero learning rates. Selecting between the old and the
    # new state instead would take a copy of all moments.
    gradients = jax.tree.map(lambda a, b: jnp.where(pace.good, a + b, 0), rows.gradients, prior)
    gradients = optimizer.without_locked_bands(gradients, pace.progress, pace.openings)
    rates = pace.rates(rows)
    gaussians, opt_state = optimizer.update(
        rows.gaussians, gradients, rows.opt_state, rates, recipe.optimizer.rule
    )
    gaussians = lax.optimization_barrier(gaussians)
    return recipe.optimizer.noise(gaussians, rates.means[:, 0], pace.extent, noise_key), opt_state
