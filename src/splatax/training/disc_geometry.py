"""The regularizers of 2DGS, which make discs lie on one surface and along it (Huang et al. 2024, Sec. 5)."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, Float

from splatax.outputs import Output
from splatax.training.canvases import mean_over
from splatax.training.geometry import FACING, LAYERS, inconsistency
from splatax.training.objectives import TrainingView


@dataclass(frozen=True)
class DiscGeometry:
    """Penalizes depth distortion and normals that differ from those of the depth image.

    The distortion of a pixel is the sum over pairs of discs of w_i w_j (m_i - m_j)^2, where w are blending
    weights and m = depth of the pixel / depth, at the points where the ray meets the discs. The paper's
    Eq. 13 has the absolute value of the difference; the authors' code squares it, and so does this. The
    authors' m is 1 - 0.2 / depth in world units, without discs nearer than 0.2. Here it has no unit, so that
    the penalty is as strong in scenes of any size, and discs near the camera do not outweigh the photos.

    Attributes:
        distortion: weight of the distortion. The authors' weights correspond to 4 / depth^2 in the paper's
            unbounded scenes and to 40 / depth^2 in bounded ones.
        consistency: weight of 1 minus the cosine between the normals of discs and of the depth image.
        distortion_from, consistency_from: fractions of the run before which the penalties are zero.
    """

    distortion: float = 0.1
    consistency: float = 0.05
    distortion_from: float = 3_000 / 30_000
    consistency_from: float = 7_000 / 30_000

    @property
    def outputs(self) -> Mapping[str, Output]:
        """The moments of inverse depth and the normals."""
        return {"layers": LAYERS, "facing": FACING}

    @property
    def after(self) -> float:
        """The fraction of the run before which both penalties are zero."""
        return min(self.distortion_from, self.consistency_from)

    def __call__(self, images: Mapping[str, Any], seen: TrainingView) -> Float[Array, ""]:
        """Returns the sum of the penalties; see `splatax.training.protocols.Geometry`."""
        layers = images["layers"]
        distortion = mean_over(layers.scatter, seen.camera)
        normals = inconsistency(images["facing"], layers.depth, seen.camera)
        return (
            jnp.where(seen.progress >= self.distortion_from, self.distortion, 0) * distortion
            + jnp.where(seen.progress >= self.consistency_from, self.consistency, 0) * normals
        )
