"""One Adam for all fields, a learning rate for each, and moments that follow their Gaussians."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

from splatax.gaussians import Gaussians
from splatax.math import harmonics, quaternions
from splatax.training.density.protocol import Lineage

ADAM = optax.scale_by_adam(b1=0.9, b2=0.999, eps=1e-15)  # epsilon of Kerbl et al. 2023: rates alone decide


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class LearningRates:
    """Steps of Adam for each field (authors' code of Kerbl et al. 2023).

    There, all but the means' stay as they are. If they fall at the end instead, Gaussians come to rest
    where they fit all photos, not the last few.
    """

    means: float = 1.6e-4  # times the scene's extent, at the start
    means_final: float = 1.6e-6  # times the scene's extent, at the end; log-linear between
    sh_dc: float = 2.5e-3
    sh_rest: float = 2.5e-3 / 20
    opacity_logits: float = 0.05
    log_scales: float = 5e-3
    quats: float = 1e-3
    settled: float = 1.0  # what all but the means' end at, of the above
    settling_from: float = 0.85  # share of the run after which they fall, log-linearly

    def at(self, progress: Float[Array, ""], extent: Float[Array, ""], coefficients: int) -> Gaussians:
        """Rates in the shape of a scene of one Gaussian.

        Args:
            progress: share of the run that is done, 0 to 1.
            extent: of the scene, world units.
            coefficients: of spherical harmonics.
        """
        means = self.means * (self.means_final / self.means) ** progress * extent
        fall = self.settled ** jnp.clip((progress - self.settling_from) / (1 - self.settling_from), 0, 1)
        sh = jnp.full((1, coefficients, 1), self.sh_rest).at[:, 0].set(self.sh_dc)
        return Gaussians(
            jnp.full((1, 1), means),
            jnp.full((1, 1), self.quats * fall),
            jnp.full((1, 1), self.log_scales * fall),
            jnp.full(1, self.opacity_logits * fall),
            sh * fall,
        )


def without_locked_bands(
    gradients: Gaussians, step: Int[Array, ""], sh_every: int | Int[Array, ""]
) -> Gaussians:
    """Zeroes the gradients of SH bands that are not free yet: band l is after l * `sh_every` steps."""
    band = jnp.array([l for l in range(harmonics.MAX_DEGREE + 1) for _ in range(2 * l + 1)])
    free = band[: gradients.sh.shape[1]] * sh_every <= step
    return replace(gradients, sh=jnp.where(free[None, :, None], gradients.sh, 0))


def update(
    gaussians: Gaussians, gradients: Gaussians, opt_state: optax.OptState, rates: Gaussians
) -> tuple[Gaussians, optax.OptState]:
    """One step of Adam; quaternions are unit again after it."""
    directions, opt_state = ADAM.update(gradients, opt_state)
    gaussians = jax.tree.map(lambda x, d, rate: x - rate * d, gaussians, directions, rates)
    return replace(gaussians, quats=jax.vmap(quaternions.normalize)(gaussians.quats)), opt_state


@jax.jit
def inherit(opt_state: optax.OptState, lineage: Lineage) -> optax.OptState:
    """Moments follow their Gaussian to its new row; newborns start from zero."""

    def follow(moments: Gaussians) -> Gaussians:
        def rows(leaf):
            newborn = lineage.newborn.reshape(-1, *[1] * (leaf.ndim - 1))
            return jnp.where(newborn, 0, leaf[lineage.parent])

        moved = jax.tree.map(rows, moments)
        return replace(moved, **{name: jnp.zeros_like(getattr(moved, name)) for name in lineage.restarted})

    return opt_state._replace(mu=follow(opt_state.mu), nu=follow(opt_state.nu))
