"""One step of the scene's rows by the native library; see `splatax.moving` for what it computes."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax.backends.cpu.library import Build
from splatax.gaussians import ARRAYS, Gaussians
from splatax.moving import Moments, Rule, Step, checked, corrections, prior_weights

FIELDS = len(ARRAYS)


def move(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    step: Step,
    rule: Rule,
    block: int,
    build: Build,
) -> tuple[Gaussians, Moments]:
    """Makes one step with all rows, in place if the caller donates the arrays.

    Parameters whose gradient and moments are zero are not written. Numbers below 2^-126 count as zero.

    Raises:
        ValueError: if arrays do not fit together.
    """
    checked(gaussians, gradients, moments, step, block)
    arrays = [*jax.tree.leaves((gaussians, gradients, moments)), *_inputs(step, rule)]
    shapes = [leaf.shape for leaf in jax.tree.leaves((gaussians, moments))]
    places = [*range(FIELDS), *range(2 * FIELDS, 4 * FIELDS)]  # all of them but the gradients
    moved = build.call(
        "splatax_move",
        shapes,
        arrays,
        aliases=dict(zip(places, range(len(places)), strict=True)),
        block=np.int64(block),
    )
    structure = jax.tree.structure((gaussians, moments))
    return jax.tree.unflatten(structure, moved)


def _inputs(step: Step, rule: Rule) -> list[Array]:
    """Returns the arguments of the kernel that are no fields of a scene."""
    rates = step.rates
    return [
        _numbers(step, rule),
        rates.means[:, 0],
        rates.sh[0, :, 0],
        step.free.astype(jnp.float32),
        step.keys,
    ]


def _numbers(step: Step, rule: Rule) -> Float[Array, "15"]:
    """Returns the numbers of a step in the order of `MoveNumber` in native/cpu/moving.h."""
    opacity, scale = prior_weights(step, rule)
    numbers = [
        step.good,
        rule.b1,
        1 - rule.b1,
        rule.b2,
        1 - rule.b2,
        rule.eps,
        *corrections(step, rule),
        step.rates.quats[0, 0],
        step.rates.log_scales[0, 0],
        step.rates.opacity_logits[0],
        opacity if rule.opacity else 0.0,
        scale if rule.scale else 0.0,
        rule.noise,
        1 / step.extent if rule.noise else 0.0,
    ]
    return jnp.stack([jnp.asarray(number).astype(jnp.float32) for number in numbers])
