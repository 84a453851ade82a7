"""The numbers of a training step as arrays, for foreign kernels of `splatax.moving.move`."""

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.gaussians import ARRAYS
from splatax.moving import Rule, Step, corrections, prior_weights

FIELDS = len(ARRAYS)
# Place of an argument -> place of the result that may take its memory. The arguments are the fields of a
# scene, of its gradients and of both moments; all but the gradients are moved.
PLACES = {place: i for i, place in enumerate([*range(FIELDS), *range(2 * FIELDS, 4 * FIELDS)])}


def inputs(step: Step, rule: Rule) -> list[Array]:
    """Returns the arguments of a kernel that are no fields of a scene."""
    rates = step.rates
    return [
        numbers(step, rule),
        rates.means[:, 0],
        rates.sh[0, :, 0],
        step.free.astype(jnp.float32),
        step.keys,
    ]


def numbers(step: Step, rule: Rule) -> Float[Array, "15"]:
    """Returns the numbers of a step in the order of `MoveNumber` in native/."""
    opacity, scale = prior_weights(step, rule)
    found = [
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
    return jnp.stack([jnp.asarray(number).astype(jnp.float32) for number in found])
