"""Tiny scenes for tests."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np

from splatax.cameras import Camera, look_at
from splatax.gaussians import Gaussians
from splatax.math import harmonics
from splatax.splats import MIN_ALPHA, Splats
from splatax.training.capacity import bucket_for, pad

RED, GREEN, BLUE = np.eye(3, dtype=np.float32)


def splats_from_covariances(
    means2d, covariances, depths, colors, opacities, size, dtype=np.float32
) -> Splats:
    """Splats from plain 2 x 2 covariances, computed in double precision by NumPy's own linear algebra."""
    covariances = np.asarray(covariances, np.float64)
    # The upper triangular root U of the inverse, U^T U = covariance^-1, is L^T for inverse = L L^T.
    roots = np.linalg.cholesky(np.linalg.inv(covariances)).transpose(0, 2, 1)
    opacities = np.asarray(opacities, np.float64)
    reach = np.sqrt(2 * np.log(np.maximum(opacities / MIN_ALPHA, 1)))
    extents = reach[:, None] * np.sqrt(np.stack([covariances[:, 0, 0], covariances[:, 1, 1]], 1))
    arrays = (means2d, roots[:, [0, 0, 1], [0, 1, 1]], depths, extents, colors, opacities)
    return Splats(*(jnp.asarray(np.asarray(array, dtype)) for array in arrays), *size)


def at(x=0.5, y=0.5, *, sigma=1.0, depth=1.0, color=RED, opacity=0.9):
    """One round splat, for `splats`."""
    return (x, y), np.eye(2) * sigma**2, depth, color, opacity


def splats(*rows, size=(1, 1), dtype=np.float32) -> Splats:
    """Splats from rows made by `at`."""
    return splats_from_covariances(*map(np.stack, zip(*rows, strict=True)), size, dtype)


def random_splats(
    seed=0, n=400, size=(70, 53), sigma=(0.6, 8.0), opacity=(0.001, 1.0), dtype=np.float32
) -> Splats:
    """Ellipses of all shapes and sizes, some beside the image, some with equal depths."""
    rng = np.random.default_rng(seed)
    means2d = rng.uniform([-5, -5], [size[0] + 5, size[1] + 5], (n, 2))
    sigmas = np.exp(rng.uniform(*np.log(sigma), (n, 2)))
    angle = rng.uniform(0, np.pi, n)
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).transpose(2, 0, 1)
    covariances = np.einsum("nij,nj,nkj->nik", rotation, sigmas**2, rotation) + 0.3 * np.eye(2)
    depths = rng.choice(rng.uniform(1, 10, max(1, n // 2)), n)
    return splats_from_covariances(
        means2d, covariances, depths, rng.uniform(size=(n, 3)), rng.uniform(*opacity, n), size, dtype
    )


def random_gaussians(seed=0, n=60, degree=3, spread=1.0, scale=(0.02, 0.3), dtype=np.float32) -> Gaussians:
    """A cloud around the origin."""
    rng = np.random.default_rng(seed)
    sh = rng.normal(size=(n, harmonics.count(degree), 3)) * 0.3
    fields = (
        rng.uniform(-spread, spread, (n, 3)),
        rng.normal(size=(n, 4)),
        rng.uniform(*np.log(scale), (n, 3)),
        rng.normal(size=n),
        sh,
    )
    return Gaussians(*(jnp.asarray(np.asarray(field, dtype)) for field in fields))


def camera_at(
    position=(0.0, 0.0, -4.0), target=(0.0, 0.0, 0.0), size=(32, 24), focal=30.0, dtype=np.float32
) -> Camera:
    """A camera with y down that looks at `target`, its principal point a little off centre."""
    pose = look_at(*(jnp.asarray(v, dtype) for v in (position, target, (0.0, -1.0, 0.0))))
    cx, cy = size[0] / 2 + 0.7, size[1] / 2 - 0.4
    return Camera(*(jnp.asarray(v, dtype) for v in (focal, focal * 1.05, cx, cy)), pose, *size)


def with_slots(opacities, **settings) -> Gaussians:
    """Random Gaussians of these opacities, and empty slots, as in training."""
    opacities = np.array(opacities)
    logits = jnp.asarray(np.log(opacities / (1 - opacities)), jnp.float32)
    gaussians = replace(random_gaussians(n=len(opacities), **settings), opacity_logits=logits)
    return pad(gaussians, bucket_for(len(opacities)))


def plane_of_gaussians(
    normal, n=900, half=1.5, sigma=0.1, flat=1e-4, opacity=0.9, dtype=np.float32
) -> Gaussians:
    """Flat Gaussians at random places of a square around the origin, which is normal to a unit vector."""
    rng = np.random.default_rng(0)
    across = np.linalg.svd(np.asarray(normal)[None])[2][1:]
    axes = np.stack([across[0], np.cross(normal, across[0]), normal], axis=1)  # columns, right-handed
    w = 0.5 * np.sqrt(max(1 + np.trace(axes), 1e-9))
    xyz = np.array([axes[2, 1] - axes[1, 2], axes[0, 2] - axes[2, 0], axes[1, 0] - axes[0, 1]]) / (4 * w)
    fields = (
        rng.uniform(-half, half, (n, 2)) @ axes[:, :2].T,
        np.tile([w, *xyz], (n, 1)),
        np.tile(np.log([sigma, sigma, flat * sigma]), (n, 1)),
        np.full(n, np.log(opacity / (1 - opacity))),
        np.zeros((n, 1, 3)),
    )
    return Gaussians(*(jnp.asarray(np.asarray(field, dtype)) for field in fields))
