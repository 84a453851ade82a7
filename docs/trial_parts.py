"""Parts of recipes that were tried and are not in splatax, for `measure_trials.py`."""

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.losses import ssim
from splatax.math import quaternions
from splatax.outputs import over
from splatax.pipeline import composite
from splatax.sky import Sky
from splatax.splats import Splats
from splatax.training import per_photo
from splatax.training.density.splitting import Observed, Splitting
from splatax.training.feed import Batch
from splatax.training.optimizer import Adam, free_coefficients
from splatax.training.per_photo import PerPhoto, PerView
from splatax.training.protocols import DensityPlan, DensityStrategy, Source
from splatax.training.recipes import Recipe
from splatax.training.step import Shown, TrainState, advanced, compare, photo_over
from splatax.training.steppers import OneView


@dataclass(frozen=True)
class JaxAdam(Adam):
    """Adam by functions of JAX: kernels expect the gradients of splats that nothing has changed."""


@dataclass(frozen=True)
class OpacityNoise:
    """Multiplies opacities by 1 + noise in each training view (Chen et al. 2025, arXiv 2508.12720).

    Attributes:
        strategy: of density control, otherwise unchanged.
        deviation: standard deviation of the noise.
    """

    strategy: DensityStrategy
    deviation: float

    def init(self, capacity: int) -> Any:
        """Returns the state of the strategy."""
        return self.strategy.init(capacity)

    def watch(self, splats: Splats) -> Splats:
        """Returns splats with other opacities. The numbers are drawn by the bits of their positions."""
        bits = jax.lax.bitcast_convert_type(jax.lax.stop_gradient(splats.means2d), jnp.uint32)
        mixed = bits[:, 0] ^ (bits[:, 1] * jnp.uint32(0x9E3779B9))
        for factor in (0x85EBCA6B, 0xC2B2AE35):  # the finalizer of MurmurHash3
            mixed = (mixed ^ (mixed >> jnp.uint32(15))) * jnp.uint32(factor)
        uniform = ((mixed >> jnp.uint32(8)).astype(jnp.float32) + 0.5) / 2**24
        noise = 1 + self.deviation * jax.scipy.special.ndtri(uniform)
        return self.strategy.watch(replace(splats, opacities=jnp.clip(splats.opacities * noise, 0, 1)))

    def observe(self, state: Any, splats: Splats, d_splats: Splats) -> Any:
        """Returns what the strategy does."""
        return self.strategy.observe(state, splats, d_splats)

    def due(self, step: int) -> bool:
        """Returns what the strategy does."""
        return self.strategy.due(step)

    def columns(self, state: Any, gaussians: Gaussians) -> Any:
        """Returns what the strategy does."""
        return self.strategy.columns(state, gaussians)

    def plan(self, columns: Any, step: int, extent: float, key: Any) -> DensityPlan:
        """Returns what the strategy does."""
        return self.strategy.plan(columns, step, extent, key)

    def reborn(self, gaussians: Gaussians, state: Any, given: Any) -> Gaussians:
        """Returns what the strategy does."""
        return self.strategy.reborn(gaussians, state, given)


@dataclass(frozen=True)
class FarPulls(Splitting):
    """Splitting by pulls that count less near the camera, after Pixel-GS (Zhang et al. 2024).

    The pull of a view is multiplied by min((depth / full)^2, 1).

    Attributes:
        full: depth from which pulls count in full, world units.
    """

    full: float = 0.0

    def observe(self, state: Observed, splats: Splats, d_splats: Splats) -> Observed:
        """Adds one view to the statistics."""
        seen = super().observe(state, splats, d_splats)
        factor = jnp.clip(splats.depths / self.full, 0, 1) ** 2
        return seen._replace(pull=state.pull + factor * (seen.pull - state.pull))


@dataclass(frozen=True)
class Huber:
    """Photometric loss in which errors below a limit count by their squares (Huber 1964), others as in L1.

    Attributes:
        limit: of the errors of photos in [0, 1], above 0.
        ssim_weight: weight of D-SSIM.
    """

    limit: float
    ssim_weight: float = 0.2

    def __call__(self, image: Array, photo: Array, mask: None = None, kernel: Any = None) -> Array:
        """Computes the loss of photos without masks, by functions of JAX."""
        error = jnp.abs(image - photo)
        small = error < self.limit
        counted = jnp.where(small, error * error / (2 * self.limit), error - self.limit / 2)
        return (1 - self.ssim_weight) * jnp.mean(counted) + self.ssim_weight * (1 - ssim(image, photo))


CELLS = (4, 8, 8)  # of a bilateral grid: luminance, rows and columns


@dataclass(frozen=True)
class BilateralGrid(PerView):
    """Learns a grid of affine maps of colours for each photo (Wang et al. 2024, as in gsplat).

    The map of a pixel is interpolated between cells by its place and its rendered luminance. The mean of the
    grids over the photos is held at the identity.
    """

    WIDTH: ClassVar[int] = 12 * CELLS[0] * CELLS[1] * CELLS[2]
    rate: float = 2e-3  # learning rate at the start
    rate_final: float = 2e-4  # learning rate at the end; log-linear between
    smoothness: float = 10.0  # weight of the mean squared difference of neighbouring cells

    @jax.default_matmul_precision("highest")
    def __call__(
        self, parameters: Float[Array, " k"], sums: Float[Array, "h w 3"], alpha: Float[Array, "h w"]
    ) -> Float[Array, "h w 3"]:
        """Applies the maps of a photo to the rendering, which is weighted by alpha."""
        height, width, _ = sums.shape
        luminance = sums @ jnp.array([0.2126, 0.7152, 0.0722], sums.dtype) / jnp.maximum(alpha, 1e-3)
        by_light = _tents(jnp.clip(luminance, 0, 1), CELLS[0])
        by_row = _tents((jnp.arange(height, dtype=jnp.float32) + 0.5) / height, CELLS[1])
        by_column = _tents((jnp.arange(width, dtype=jnp.float32) + 0.5) / width, CELLS[2])
        grid = parameters.reshape(*CELLS, 12)
        at_pixels = jnp.einsum("zyxc,hy,wx->hwzc", grid, by_row, by_column)
        change = jnp.einsum("hwzc,hwz->hwc", at_pixels, by_light).reshape(height, width, 3, 4)
        return sums + jnp.einsum("hwkc,hwc->hwk", change[..., :3], sums) + alpha[..., None] * change[..., 3]

    def update(
        self, state: PerPhoto, source: Source, gradient: Array, progress: Array, steps: Array
    ) -> PerPhoto:
        """Makes one step for one photo, then restores the mean grid to the identity."""
        gradient = gradient + jax.grad(self._roughness)(state.values[source.view])
        rate = per_photo.log_linear(self.rate, self.rate_final, progress)
        state = per_photo.updated(state, source.view, gradient, rate)
        return replace(state, values=per_photo.centred(state.values))

    def _roughness(self, row: Float[Array, " k"]) -> Float[Array, ""]:
        grid = row.reshape(*CELLS, 12)
        return self.smoothness * sum(jnp.mean(jnp.diff(grid, axis=axis) ** 2) for axis in range(3))


def _tents(places: Float[Array, "..."], cells: int) -> Float[Array, "... cells"]:
    """Returns the weights of linear interpolation between cells at places in [0, 1]."""
    return jnp.maximum(1 - jnp.abs(places[..., None] * (cells - 1) - jnp.arange(cells)), 0)


class Rays:
    """Poses and lenses of the training photos: a table that compares by identity.

    Attributes:
        rows: for each photo its rotation from world to camera axes, then focal lengths and principal point as
            fractions of its width and height.
    """

    def __init__(self, cameras: list[Camera]) -> None:
        rows = [
            [*np.ravel(c.rotation), *np.asarray(c.focal) / c.size, *np.asarray(c.center) / c.size]
            for c in cameras
        ]
        self.rows = jnp.asarray(np.array(rows, np.float32))


@dataclass(frozen=True)
class LearnedSky:
    """Draws a sky of spherical harmonics behind the scene, and learns it (an appearance of all photos)."""

    rays: Rays
    degree: int = 4
    rate: float = 0.01  # learning rate at the start
    rate_final: float = 0.001  # learning rate at the end; log-linear between

    def init(self, photos: int) -> PerPhoto:
        """Returns a grey sky: a table of one row."""
        return per_photo.zeros(1, 3 * (self.degree + 1) ** 2)

    def for_photo(self, state: PerPhoto, source: Source) -> tuple[Array, Array]:
        """Returns the sky, and the pose and the lens of a photo."""
        return state.values[0], self.rays.rows[source.view]

    def __call__(self, parameters: tuple[Array, Array], sums: Array, alpha: Array) -> Array:
        """Adds the sky where the scene is transparent."""
        row, pose = parameters
        height, width = alpha.shape
        across = ((jnp.arange(width, dtype=jnp.float32) + 0.5) / width - pose[11]) / pose[9]
        down = ((jnp.arange(height, dtype=jnp.float32) + 0.5) / height - pose[12]) / pose[10]
        x, y = jnp.meshgrid(across, down)
        directions = jnp.stack([x, y, jnp.ones_like(x)], axis=-1) @ pose[:9].reshape(3, 3)
        unit = directions / jnp.linalg.norm(directions, axis=-1, keepdims=True)
        return sums + (1 - alpha[..., None]) * Sky(row.reshape(-1, 3))(unit)

    def update(
        self, state: PerPhoto, source: Source, gradient: tuple[Array, Array], progress: Array, steps: Array
    ) -> PerPhoto:
        """Makes one step."""
        rate = per_photo.log_linear(self.rate, self.rate_final, progress)
        return per_photo.updated(state, jnp.int32(0), gradient[0], rate)


@dataclass(frozen=True)
class SecondOrder(OneView):
    """Makes diagonal Gauss-Newton steps within a trust region, after 3DGS2-TR (arXiv 2602.00395).

        step = clip(pace m / h, -r, r),   m = mean of gradients,   h = mean of (J^T z)^2

    J is the derivative of the rendering. z has random signs and, at each number of the image, the variance
    |dL/dI| / (|I - photo| + 0.01): the quadratic that touches the loss there. E (J^T z)^2 is the diagonal of
    its Hessian (Hutchinson). The radius r of a trust region is a Hellinger distance for means, scales,
    quaternions and opacities, and a change of colour for harmonics. The means m and h are kept where Adam
    keeps its moments.
    """

    pace: float = 0.3  # Newton steps of single parameters are too long, because Gaussians overlap
    radius: float = 0.1  # at the start
    radius_final: float = 0.005  # at the end; log-linear between
    every: int = 2  # steps from one probe of the curvature to the next

    def step(self, state: TrainState, seen: Batch, recipe: Recipe) -> tuple[TrainState, Float[Array, ""]]:
        """Makes a step on one view."""
        return _second_order(state, seen, recipe.sh.openings(recipe.steps), recipe, self)


@partial(jax.jit, static_argnames=("recipe", "rule"), donate_argnames="state")
def _second_order(
    state: TrainState, batch: Batch, openings: Array, recipe: Recipe, rule: SecondOrder
) -> tuple[TrainState, Float[Array, ""]]:
    drawing_key, sign_key = jax.random.split(jax.random.fold_in(state.key, state.step))
    background, _ = recipe.drawing.sample(drawing_key)
    found = compare(state, batch, recipe, drawing_key)
    kernels, progress = recipe.drawing.kernels, state.step / state.total
    scene, adam = state.gaussians, state.opt_state[0]
    living = jnp.sum(scene.opacity_logits > -jnp.inf)

    def probed() -> Gaussians:
        def image(splats: Splats) -> Array:
            return over(*composite(splats, splats.colors, kernels), background)

        drawn, back = jax.vjp(image, found.shown.splats)
        photo = photo_over(batch.photo, background)
        pulls = jax.grad(recipe.objective.loss)(drawn, photo, None, kernels.photometric)
        size = jnp.sqrt(jnp.abs(pulls) / (jnp.abs(drawn - photo) + 0.01))
        signed = size * jax.random.rademacher(sign_key, size.shape, jnp.float32)
        (gradient, _) = found.pull_back(Shown(back(signed)[0], {}))
        return jax.tree.map(lambda h, g: 0.98 * h + 0.02 * g * g, adam.nu, gradient)

    curvature = jax.lax.cond(state.step % rule.every == 0, probed, lambda: adam.nu)
    gradient, _ = found.pull_back(found.d_shown)
    prior = jax.grad(recipe.objective.prior)(scene, state.extent, living)
    mean = jax.tree.map(lambda m, g, p: 0.9 * m + 0.1 * (g + p), adam.mu, gradient, prior)
    limits = _limits(scene)
    radius = per_photo.log_linear(rule.radius, rule.radius_final, progress)
    free = free_coefficients(progress, openings, scene.sh.shape[1])

    def moved(x: Array, m: Array, h: Array, limit: Array) -> Array:
        newton = rule.pace * m / (h + 1e-20)
        return x - jnp.clip(newton, -radius * limit, radius * limit)

    after = jax.tree.map(moved, scene, mean, curvature, limits)
    after = replace(
        after,
        sh=jnp.where(free[None, :, None], after.sh, scene.sh),
        quats=jax.vmap(quaternions.normalize)(after.quats),
        opacity_logits=jnp.where(scene.opacity_logits > -jnp.inf, after.opacity_logits, -jnp.inf),
    )
    good = jnp.isfinite(found.loss)
    steps = optax.safe_increment(adam.count)
    moments = (adam._replace(count=steps, mu=mean, nu=curvature), *state.opt_state[1:])
    kept = jax.tree.map(partial(jnp.where, good), (after, moments), (scene, state.opt_state))
    density = recipe.density.observe(state.density_state, found.shown.splats, found.d_shown.splats)
    learned = density, state.appearance, state.cameras, state.weights
    return advanced(replace(state, gaussians=kept[0], opt_state=kept[1]), learned, good), found.loss


def _limits(scene: Gaussians) -> Gaussians:
    """Returns the change of each parameter whose squared Hellinger distance is about 1 / 8 or 1 / 4."""
    scales = jnp.exp(scene.log_scales)
    spread = jnp.max(scales, axis=1, keepdims=True) / jnp.min(scales, axis=1, keepdims=True)
    opacities = jnp.clip(scene.opacities, 1e-3, 1 - 1e-3)
    # Along a world axis, the deviation of the marginal: the root of the diagonal of R S^2 R^T.
    axes = jax.vmap(quaternions.to_rotation)(scene.quats)
    along = jnp.sqrt(jnp.einsum("nij,nj->ni", axes**2, scales**2))
    bands = jnp.full((1, scene.sh.shape[1], 1), 0.2).at[:, 0].set(1.0)
    return Gaussians(
        along,
        jnp.broadcast_to(1 / jnp.maximum(spread - 1 / spread, 1.0), scene.quats.shape),
        jnp.ones_like(scales),
        0.5 / jnp.sqrt(opacities * (1 - opacities)),
        jnp.broadcast_to(bands, scene.sh.shape),
    )
