"""Footprints: the 2D Gaussians that stand for the images of 3D Gaussians.

    Ewa         pixel(x) is replaced by its tangent at the mean    (Zwicker et al. 2001; Kerbl et al. 2023)
    Unscented   pixel(x) at seven points, weighted                 (Wu et al. 2025)

Both tend to the same ellipse as Gaussians shrink. A covariance is kept as rows F and signed weights w, with
covariance F diag(w) F^T, so that no digits are lost for thin ellipses: see `math.ellipsoids`.
"""

from dataclasses import dataclass
from typing import NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from splatax.cameras import Camera

FRUSTUM_MARGIN = 0.3  # of half the image: margin up to which the Jacobian follows the mean (as in gsplat)


class Footprint(NamedTuple):
    """Image of one Gaussian without a low-pass.

    Attributes:
        mean2d: centre, pixels.
        rows: F; their m columns are offsets, pixels.
        weights: of the columns.
        usable: false if the Gaussian cannot be drawn this way. The numbers are finite even then.
    """

    mean2d: Float[Array, "2"]
    rows: Float[Array, "2 m"]
    weights: Float[Array, " m"]
    usable: Bool[Array, ""]


@runtime_checkable
class Method(Protocol):
    """Way to find footprints. It is hashable, so it can be a static argument of `jit`."""

    def __call__(
        self, camera: Camera, mean: Float[Array, "3"], point: Float[Array, "3"], spread: Float[Array, "3 3"]
    ) -> Footprint:
        """Returns the footprint of a Gaussian whose mean the lens sees.

        Args:
            camera: of the view.
            mean: world units.
            point: the mean in camera axes.
            spread: factor of the covariance in the world, Sigma = spread spread^T.
        """
        ...


@dataclass(frozen=True)
class Ewa:
    """Linearizes the camera at the mean: Sigma' = J W Sigma W^T J^T, with the Jacobian J of the lens."""

    def __call__(
        self, camera: Camera, mean: Float[Array, "3"], point: Float[Array, "3"], spread: Float[Array, "3 3"]
    ) -> Footprint:
        """Returns the image of the Gaussian under the tangent of the camera at its mean."""
        near = camera.lens.linearized_at(point, *visible_plane(camera))
        lens = jax.jacfwd(camera.lens.project)(near) * camera.focal[:, None]
        world = camera.rotation if camera.motion is None else jax.jacfwd(camera.to_camera)(mean)
        rows = lens @ world @ spread
        return Footprint(camera.to_pixel(point), rows, jnp.ones(3, rows.dtype), jnp.array(True))


@dataclass(frozen=True)
class Unscented:
    """Projects the mean and six points around it, and takes the mean and the covariance of their images.

    It follows the curvature of lenses and of rolling shutters over a Gaussian. A Gaussian is drawn only if
    the lens sees all seven points. Each point is seen at its own moment of the exposure.

    Attributes:
        alpha: spread of the points; they lie `alpha * sqrt(3 + kappa)` standard deviations from the mean.
        beta: prior knowledge of the distribution, 2 for a Gaussian.
        kappa: secondary spread.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __call__(
        self, camera: Camera, mean: Float[Array, "3"], point: Float[Array, "3"], spread: Float[Array, "3 3"]
    ) -> Footprint:
        """Returns the moments of the images of the seven points."""
        squared = self.alpha**2 * (3 + self.kappa)  # "3 + lambda": standard deviations to the points, squared
        offsets = squared**0.5 * jnp.concatenate([jnp.zeros_like(spread[:1]), spread.T, -spread.T])
        points = jax.vmap(camera.to_camera)(mean[None] + offsets)
        seen = jnp.all(jax.vmap(camera.lens.sees)(points))
        pixels = jax.vmap(camera.to_pixel)(jnp.where(seen, points, point[None]))
        if camera.lens.PERIOD is not None:  # a panorama's points lie on one side of its seam
            period = camera.lens.PERIOD * jnp.array([1.0, 0.0], pixels.dtype) * camera.focal
            turns = jnp.round((pixels[:, :1] - pixels[0, 0]) / period[0])
            pixels = pixels - turns * period[None]
        first, other = (squared - 3) / squared, 0.5 / squared
        center = first * pixels[0] + other * jnp.sum(pixels[1:], axis=0)
        weights = jnp.full(7, other, pixels.dtype).at[0].set(first + 1 - self.alpha**2 + self.beta)
        return Footprint(center, (pixels - center[None]).T, weights, seen)


def visible_plane(camera: Camera) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Returns the left top and right bottom corners, on the image plane, of the image and its margin."""
    size = camera.size
    margin = FRUSTUM_MARGIN * 0.5 * size
    low = -(camera.center + margin) / camera.focal
    return low, (size - camera.center + margin) / camera.focal


EWA = Ewa()
