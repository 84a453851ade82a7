"""The regularizers of 2DGS, which make discs lie on one surface and along it (Huang et al. 2024, Sec. 5)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.cameras import Camera
from splatax.outputs import Output
from splatax.training.geometry import FACING, LAYERS, inconsistency


@dataclass(frozen=True)
class DiscGeometry:
    """Penalizes depth distortion and normals that differ from those of the depth image.

    The distortion of a pixel is the sum over pairs of discs of w_i w_j (m_i - m_j)^2, where w are blending
    weights and m = 1 - near / depth, at the points where the ray meets the discs. The paper's Eq. 13 has the
    absolute value of the difference; the authors' code squares it, and so does this.

    Attributes:
        distortion: weight of the distortion; 1000 for bounded scenes and 100 for others in the paper.
        consistency: weight of 1 minus the cosine between the normals of discs and of the depth image.
        near: depth that m refers to, world units.
        distortion_from, consistency_from: fractions of the run before which the penalties are zero.
    """

    distortion: float = 100.0
    consistency: float = 0.05
    near: float = 0.2
    distortion_from: float = 3_000 / 30_000
    consistency_from: float = 7_000 / 30_000

    @property
    def outputs(self) -> Mapping[str, Output]:
        """The moments of inverse depth and the normals."""
        return {"layers": LAYERS, "facing": FACING}

    def __call__(
        self,
        images: Mapping[str, Any],
        camera: Camera,
        landmarks: Float[Array, "k 3"] | None,
        progress: Float[Array, ""],
    ) -> Float[Array, ""]:
        """Returns the sum of the penalties; see `splatax.training.protocols.Geometry`."""
        layers = images["layers"]
        distortion = self.near**2 * jnp.mean(layers.scatter)
        normals = inconsistency(images["facing"], layers.depth, camera)
        return (
            jnp.where(progress >= self.distortion_from, self.distortion, 0) * distortion
            + jnp.where(progress >= self.consistency_from, self.consistency, 0) * normals
        )
