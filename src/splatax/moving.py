"""One training step of a scene's rows: Adam, normalized quaternions, a prior and noise; it knows no backend.

With the gradient g of a number x, its learning rate r, and after t steps:

    g' = g + d prior / dx
    m <- b1 m + (1 - b1) g',   v <- b2 v + (1 - b2) g'^2                       (Kingma and Ba 2015, Alg. 1)
    x <- x - r (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)

Three rules let a step pass over what no view shows. A Gaussian whose gradients without the prior's are zero,
and the m of whose centre is zero, rests: its centre, quaternion and harmonics keep their x, m and v. A single
number with g' = 0 and m = 0 rests too. And where g' is zero, an m that would move its number by at most 2^-20
of the learning rate becomes zero instead, which happens after about 130 steps without a gradient.

Then quaternions that have changed are normalized, and noise moves the means of faint Gaussians; see `shaken`.
The update of a row depends on no other row.
"""

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import lax
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int, UInt32

from splatax.gaussians import Gaussians
from splatax.math import ellipsoids, quaternions
from splatax.shapes import check_arrays

SHARPNESS = 100  # slope of the noise's gate, which lets noise through to faint Gaussians only
FAINT = 0.005  # opacity at which the gate is half open
NOISELESS = FAINT + 24 * math.log(2) / SHARPNESS  # opacity from which it is shut: it would let 2^-24 through
FADED = 2.0**-20  # of the learning rate: step up to which a mean without a gradient becomes zero


@dataclass(frozen=True)
class Rule:
    """The settings of a step that stay the same during a run.

    Attributes:
        b1: decay of the mean of gradients per step, in [0, 1).
        b2: decay of the mean of their squares per step, in [0, 1).
        eps: added to the root of the mean square, positive.
        opacity: weight of the mean opacity in the loss.
        scale: weight of the mean standard deviation along an axis in the loss, in extents of the scene.
        noise: strength of the noise; see `shaken`.
    """

    b1: float
    b2: float
    eps: float
    opacity: float = 0.0
    scale: float = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        numbers = (self.b1, self.b2, self.eps, self.opacity, self.scale, self.noise)
        if not all(map(math.isfinite, numbers)):
            raise ValueError(f"{self}: every number of a step must be finite")
        if not (0 <= self.b1 < 1 and 0 <= self.b2 < 1 and self.eps > 0):
            raise ValueError(f"{self}: b1 and b2 must be in [0, 1), and eps must be positive")


class Moments(NamedTuple):
    """Moving averages of gradients, in the shape of the scene."""

    mean: Gaussians
    square: Gaussians


class Step(NamedTuple):
    """The numbers of one step."""

    rates: (
        Gaussians  # learning rates, in the shape of a scene of one Gaussian; those of means may have n rows
    )
    free: Bool[Array, " k"]  # which spherical harmonics are learned already
    good: Bool[Array, ""]  # false if gradients count as zero and nothing may move
    steps: Int[Array, ""]  # number of steps made, with this one
    living: Int[Array, ""]  # number of Gaussians that are no empty slots
    extent: Float[Array, ""]  # of the scene, world units
    keys: UInt32[Array, "b 2"]  # of the noise: threefry keys of blocks of rows


def checked(gaussians: Gaussians, gradients: Gaussians, moments: Moments, step: Step, block: int) -> None:
    """Checks that the arrays of a step fit together.

    Args:
        gaussians, gradients, moments, step: as of `move`.
        block: number of rows that share a key.

    Raises:
        ValueError: if a shape or dtype is wrong.
    """
    arrays: dict[str, tuple[Array, str]] = {}
    parts = {"": gaussians, "gradient of ": gradients, "mean of ": moments.mean, "square of ": moments.square}
    for prefix, scene in parts.items():
        arrays |= {
            f"{prefix}sh": (scene.sh, "n k 3"),
            f"{prefix}means": (scene.means, "n 3"),
            f"{prefix}quats": (scene.quats, "n 4"),
            f"{prefix}log_scales": (scene.log_scales, "n 3"),
            f"{prefix}opacity_logits": (scene.opacity_logits, "n"),
        }
    rows = len(step.rates.means)
    arrays["rates of means"] = (step.rates.means, "1 1" if rows == 1 else "n 1")
    arrays["rates of sh"] = (step.rates.sh, "1 k 1")
    n = check_arrays("Step", arrays)["n"]
    if block < 1 or (block < n and block % 16):
        raise ValueError(f"Step: blocks of {block} rows; they must be a multiple of 16, or the whole scene.")
    blocks = -(-n // block)
    if step.keys.shape != (blocks, 2) or step.keys.dtype != jnp.uint32:
        raise ValueError(
            f"Step: keys are {step.keys.dtype}{list(step.keys.shape)}, not uint32[{blocks}, 2]. "
            "Give a threefry key for each block of rows."
        )


def move(
    gaussians: Gaussians, gradients: Gaussians, moments: Moments, step: Step, rule: Rule, block: int
) -> tuple[Gaussians, Moments]:
    """Makes one step with all rows; returns the scene and the moments after it.

    Args:
        gaussians: n Gaussians.
        gradients: of the loss, without the prior.
        moments: before the step.
        step: its numbers.
        rule: the settings.
        block: number of rows that share a key of the noise.

    Raises:
        ValueError: if arrays do not fit together.
    """
    checked(gaussians, gradients, moments, step, block)
    gradients = replace(gradients, sh=jnp.where(step.free[None, :, None], gradients.sh, 0))
    if_good = partial(jax.tree.map, lambda leaf: jnp.where(step.good, leaf, 0))
    asleep = resting(if_good(gradients), moments)
    gradients, rates = if_good(with_prior(gaussians, gradients, step, rule)), if_good(step.rates)
    by_mean, by_square = corrections(step, rule)

    def moved(
        x: Array, rate: Array, g: Array, m: Array, v: Array, asleep: Array
    ) -> tuple[Array, Array, Array]:
        rests = asleep | ((g == 0) & (m == 0))
        mean = rule.b1 * m + (1 - rule.b1) * g
        square = rule.b2 * v + (1 - rule.b2) * (g * g)
        way = mean * by_mean / (jnp.sqrt(square * by_square) + rule.eps)
        faded = (g == 0) & (jnp.abs(way) <= FADED)
        after = jnp.where(rests | faded, x, x - rate * way)
        return after, jnp.where(rests, m, jnp.where(faded, 0, mean)), jnp.where(rests, v, square)

    each = jax.tree.map(moved, gaussians, rates, gradients, *moments, asleep)
    after, mean, square = jax.tree.transpose(
        jax.tree.structure(gaussians), jax.tree.structure((0, 0, 0)), each
    )
    changed = jnp.any(after.quats != gaussians.quats, axis=1, keepdims=True)
    quats = jnp.where(changed, jax.vmap(quaternions.normalize)(after.quats), gaussians.quats)
    # Without the barrier, XLA computes Adam again for each use in the noise.
    after, mean, square = lax.optimization_barrier((replace(after, quats=quats), mean, square))
    if rule.noise:
        drawn = normals(step.keys, len(after), block, after.means.dtype)
        after = shaken(after, rule.noise, rates.means[:, 0], step.extent, drawn)
    return after, Moments(mean, square)


def resting(gradients: Gaussians, moments: Moments) -> Gaussians:
    """Returns which Gaussians rest, for each field in its rank; never for scales and opacities.

    Args:
        gradients: of the loss, without the prior.
        moments: before the step.
    """
    moves = jnp.any(moments.mean.means != 0, axis=1)
    for leaf in (gradients.means, gradients.quats, gradients.sh):
        moves |= jnp.any(leaf != 0, axis=tuple(range(1, leaf.ndim)))
    rests, never = ~moves[:, None], jnp.zeros((1, 1), bool)
    return replace(
        gradients, means=rests, quats=rests, log_scales=never, opacity_logits=never[0], sh=rests[..., None]
    )


def corrections(step: Step, rule: Rule) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns 1 / (1 - b1^t) and 1 / (1 - b2^t), which undo that the moments start at zero."""
    count = step.steps.astype(step.extent.dtype)
    return 1 / (1 - rule.b1**count), 1 / (1 - rule.b2**count)


def prior_weights(step: Step, rule: Rule) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Returns the weights of one opacity and of one scale in the loss."""
    living = jnp.maximum(step.living, 1).astype(step.extent.dtype)
    return rule.opacity / living, rule.scale / (3 * living * step.extent)


def with_prior(gaussians: Gaussians, gradients: Gaussians, step: Step, rule: Rule) -> Gaussians:
    """Returns gradients with those of the weighted opacities and scales of living Gaussians added."""
    lives = gaussians.opacity_logits > -jnp.inf
    opacity, scale = prior_weights(step, rule)
    if rule.opacity:
        slope = gaussians.opacities * (1 - gaussians.opacities)
        added = jnp.where(lives, opacity * slope, 0)
        gradients = replace(gradients, opacity_logits=gradients.opacity_logits + added)
    if rule.scale:
        added = jnp.where(lives[:, None], scale * gaussians.scales, 0)
        gradients = replace(gradients, log_scales=gradients.log_scales + added)
    return gradients


def normals(keys: UInt32[Array, "b 2"], n: int, block: int, dtype: DTypeLike) -> Float[Array, "n 3"]:
    """Returns three normal deviates for each row, drawn for each block of rows with its own key."""
    rows = min(block, n)

    def drawn(key: UInt32[Array, "2"]) -> Float[Array, "rows 3"]:
        return jax.random.normal(jax.random.wrap_key_data(key, impl="threefry2x32"), (rows, 3), dtype)

    return jax.vmap(drawn)(keys).reshape(-1, 3)[:n]


def shaken(
    gaussians: Gaussians,
    strength: float,
    rate: Float[Array, " m"],
    extent: Float[Array, ""],
    drawn: Float[Array, "n 3"],
) -> Gaussians:
    """Returns a scene with noise in the centres of faint Gaussians (Kheradmand et al. 2024, Eq. 7).

    mean += strength * rate * Sigma (eps * sigmoid(-100 (opacity - 0.005))),   eps ~ N(0, I),

    with Sigma in units of the scene's extent. From an opacity of 0.171 on, the sigmoid counts as zero.

    Args:
        gaussians: the scene. Empty slots do not move.
        strength: of the noise.
        rate: learning rate of the means, world units per step: one, or one for each Gaussian.
        extent: of the scene, world units.
        drawn: the deviates eps.
    """
    opacities = gaussians.opacities
    open = (gaussians.opacity_logits > -jnp.inf) & (opacities < NOISELESS)
    gate = jax.nn.sigmoid(-SHARPNESS * (opacities - FAINT))
    shift = jax.vmap(by_covariance)(gaussians.quats, gaussians.scales / extent, drawn * gate[:, None])
    shift = jnp.where(open[:, None], strength * rate[:, None] * shift, 0)
    return replace(gaussians, means=gaussians.means + shift)


def by_covariance(
    quat: Float[Array, "4"], scale: Float[Array, "3"], v: Float[Array, "3"]
) -> Float[Array, "3"]:
    """Returns Sigma v."""
    factor = ellipsoids.covariance_factor(quat, scale)
    return factor @ (factor.T @ v)
