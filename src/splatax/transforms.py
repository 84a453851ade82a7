"""Similarity transforms of scenes. Transforming Gaussians and cameras alike keeps renderings the same."""

from dataclasses import dataclass, replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.math import harmonics, quaternions

GENERIC = np.array([0.36, 0.48, 0.8])  # a direction at which no harmonic up to degree 4 is zero


@dataclass(frozen=True)
class Similarity:
    """A similarity transform of space, p' = scale R p + t.

    Attributes:
        rotation: R, a rotation matrix.
        translation: t, world units after scaling.
        scale: a factor above zero.
    """

    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]
    scale: float = 1.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.translation).all() and 0 < self.scale < np.inf):
            raise ValueError(
                f"scale {self.scale} and translation {self.translation}: must be finite, scale > 0"
            )
        if not np.allclose(self.rotation @ self.rotation.T, np.eye(3), atol=1e-5):
            raise ValueError("not a rotation: its axes are not orthogonal and of length one")
        if np.linalg.det(self.rotation) < 0:
            raise ValueError("a reflection, which would mirror the scene, is not a rotation")

    @classmethod
    def of(
        cls,
        *,
        degrees: tuple[float, float, float] = (0, 0, 0),
        scale: float = 1.0,
        move: tuple[float, float, float] = (0, 0, 0),
    ) -> "Similarity":
        """Returns the transform that rotates, then scales, then translates.

        Args:
            degrees: angles of rotation about the world's x axis, then its y axis, then its z axis.
            scale: a factor above zero.
            move: the translation, world units after scaling.
        """
        rotation = Rotation.from_euler("xyz", degrees, degrees=True).as_matrix()
        return cls(rotation, np.array(move, np.float64), scale)

    def after(self, first: "Similarity") -> "Similarity":
        """Returns the composition that applies `first`, and then this transform."""
        translation = self.scale * self.rotation @ first.translation + self.translation
        return Similarity(self.rotation @ first.rotation, translation, self.scale * first.scale)

    def transform(self, gaussians: Gaussians) -> Gaussians:
        """Returns the transformed scene, with rotated spherical harmonics (see `harmonics.rotation`)."""
        x, y, z, w = Rotation.from_matrix(self.rotation).as_quat()
        turn = jnp.asarray([w, x, y, z], gaussians.quats.dtype)
        turned = np.asarray(gaussians.means, np.float64) @ self.rotation.T
        blocks = harmonics.rotation(self.rotation, gaussians.sh_degree)
        sh = np.einsum("kj,njc->nkc", blocks.astype(np.float32), np.asarray(gaussians.sh), optimize=True)
        return replace(
            gaussians,
            means=jnp.asarray(self.scale * turned + self.translation, gaussians.means.dtype),
            quats=jax.vmap(quaternions.multiply, (None, 0))(turn, gaussians.quats),
            log_scales=jnp.asarray(np.asarray(gaussians.log_scales) + np.float32(np.log(self.scale))),
            opacity_logits=gaussians.opacity_logits,
            sh=jnp.asarray(sh, gaussians.sh.dtype),
        )

    def transform_camera(self, camera: Camera) -> Camera:
        """Returns the camera that sees the transformed scene as `camera` sees the scene; depths scale."""
        pose = np.asarray(camera.cam_from_world, np.float64)
        rotation = pose[:3, :3] @ self.rotation.T
        moved = np.eye(4)
        moved[:3, :3] = rotation
        moved[:3, 3] = self.scale * pose[:3, 3] - rotation @ self.translation
        return replace(camera, cam_from_world=jnp.asarray(moved, camera.cam_from_world.dtype))


def half_turn(gaussians: Gaussians, axis: int) -> Gaussians:
    """Returns the scene rotated by 180 degrees about the world's axis 0, 1 or 2, without rounding.

    Only signs change. The rotation converts between frames of computer graphics: about x between
    right-down-forward (COLMAP) and right-up-back (OpenGL), about z to left-up-forward.
    """
    signs = np.where(np.arange(3) == axis, np.float32(1), np.float32(-1))
    degree = gaussians.sh_degree
    here, there = (
        np.asarray(harmonics.basis(jnp.asarray(d, jnp.float32), degree)) for d in (GENERIC, signs * GENERIC)
    )
    factors = {"means": signs, "quats": np.insert(signs, 0, 1), "sh": np.sign(here * there)[:, None]}
    turned: dict[str, Any] = {
        name: jnp.asarray(np.asarray(getattr(gaussians, name)) * f) for name, f in factors.items()
    }
    return replace(gaussians, **turned)
