"""Scenes: 3D Gaussians, stored as the unconstrained parameters that are optimized."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatax.low_pass import Dilation, LowPass
from splatax.math import ellipsoids, harmonics
from splatax.order import Order, check_order, common
from splatax.pytrees import pytree
from splatax.shapes import check_arrays

ARRAYS = ("means", "quats", "log_scales", "opacity_logits", "sh")  # the fields of a scene with a row for each


@pytree
@dataclass(frozen=True)
class Gaussians:
    """Scene of n anisotropic Gaussians with view-dependent colour (Kerbl et al. 2023, Sec. 4).

    A Gaussian whose opacity logit is -inf is an empty slot: it is exactly transparent, so it is not drawn and
    has no gradient. Training uses empty slots to keep its arrays a little larger than the scene.

    Attributes:
        means: centres, world units.
        quats: rotations (w, x, y, z), not necessarily unit.
        log_scales: natural logarithm of the standard deviation along each axis, world units.
        opacity_logits: inverse sigmoid of the opacity.
        sh: spherical harmonic coefficients of colour, k = (degree + 1)^2 per channel.
        low_pass: filter that the scene was trained with, and is drawn with unless another is asked for.
            Static under `jit`.
        order: order that the scene was trained in, and is drawn in. Static under `jit`.
    """

    means: Float[Array, "n 3"]
    quats: Float[Array, "n 4"]
    log_scales: Float[Array, "n 3"]
    opacity_logits: Float[Array, " n"]
    sh: Float[Array, "n k 3"]
    low_pass: LowPass = field(default=Dilation(), kw_only=True, metadata={"static": True})
    order: Order = field(default="depth", kw_only=True, metadata={"static": True})

    def __len__(self) -> int:
        return self.means.shape[0]

    @property
    def scales(self) -> Float[Array, "n 3"]:
        """Standard deviations along each axis, world units."""
        return jnp.exp(self.log_scales)

    @property
    def opacities(self) -> Float[Array, " n"]:
        """Opacity at the centre, in [0, 1]."""
        return jax.nn.sigmoid(self.opacity_logits)

    @property
    def covariances(self) -> Float[Array, "n 3 3"]:
        """Covariance matrices R S S^T R^T, world units squared."""
        factors = jax.vmap(ellipsoids.covariance_factor)(self.quats, self.scales)
        return jnp.einsum("nij,nkj->nik", factors, factors)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 4."""
        return harmonics.degree_of(self.sh.shape[1])


def checked(gaussians: Gaussians) -> Gaussians:
    """Checks that the arrays of Gaussians fit together, and returns the Gaussians.

    All readers and renderers call it. It checks only shapes and dtypes, so it works on traced arrays. Values
    need not be finite.

    Raises:
        ValueError: if a shape or dtype is wrong, no SH degree from 0 to 4 has this many coefficients, or the
            order is unknown.
    """
    check_order(gaussians.order)
    sizes = check_arrays(
        "Gaussians",
        {
            "means": (gaussians.means, "n 3"),
            "quats": (gaussians.quats, "n 4"),
            "log_scales": (gaussians.log_scales, "n 3"),
            "opacity_logits": (gaussians.opacity_logits, "n"),
            "sh": (gaussians.sh, "n k 3"),
        },
    )
    harmonics.degree_of(sizes["k"])
    return gaussians


def joined(scenes: Sequence[Gaussians]) -> Gaussians:
    """Returns the rows of scenes that share one low-pass filter, one scene after another.

    Harmonics that only some of them have become zeros in the others. The order is the one that they have in
    common, see `order.common`.
    """
    order = common(scene.order for scene in scenes)
    most = max(scene.sh.shape[1] for scene in scenes)
    padded = [
        replace(scene, sh=jnp.pad(scene.sh, ((0, 0), (0, most - scene.sh.shape[1]), (0, 0))), order=order)
        for scene in scenes
    ]
    return jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *padded)


@partial(jax.jit, inline=True)  # as in math/quaternions.py
def is_sound(
    mean: Float[Array, "3"],
    quat: Float[Array, "4"],
    log_scale: Float[Array, "3"],
    logit: Float[Array, ""],
    sh: Float[Array, "k 3"],
) -> Bool[Array, ""]:
    """Returns whether the numbers of a Gaussian are valid: none is NaN, and few may be infinite.

    Three infinite values have a meaning. A log scale of -inf is a flat Gaussian, an opacity logit of +inf a
    fully opaque one, and an opacity logit of -inf an empty slot.
    """
    finite = jnp.all(jnp.isfinite(mean)) & jnp.all(jnp.isfinite(quat)) & jnp.all(jnp.isfinite(sh))
    return finite & jnp.all(log_scale < jnp.inf) & ~jnp.isnan(logit)


@jax.jit
def rows_of(gaussians: Gaussians, rows: Int[Array, " m"]) -> Gaussians:
    """Returns some of the Gaussians, by their rows."""
    return jax.tree.map(lambda leaf: leaf[rows], gaussians)


def broken(gaussians: Gaussians) -> Bool[np.ndarray, " n"]:
    """Returns a mask of the Gaussians that are not sound; see `is_sound`."""
    return ~np.asarray(jax.vmap(is_sound)(*map(jnp.asarray, jax.tree.leaves(gaussians))))
