"""Pictures of the live viewer: colour, depth, normals or alpha of a scene, or of its part inside a box."""

from dataclasses import dataclass, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.geometry_scores import NORMALS, ROBUST_DEPTH
from splatax.low_pass import AlongRays
from splatax.metrics import to_8bit
from splatax.rendering import Renderer
from splatax.report.pictures import depth_map, normal_map

Mode = Literal["colour", "depth", "normals", "alpha"]
MODES: tuple[Mode, ...] = ("colour", "depth", "normals", "alpha")
DISC_DEPTH = "surface_depth"  # of scenes drawn along rays: no native kernel finds the median of their discs
Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Look:
    """Display options.

    Attributes:
        mode: the quantity to show.
        box: lowest and highest x, y, z of the crop box, world units; None to show everything.
        renderer: with background, low-pass filter and backend.
    """

    mode: Mode = "colour"
    box: tuple[Corner, Corner] | None = None
    renderer: Renderer = Renderer()

    def picture(self, gaussians: Gaussians, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
        """Draws the view of a camera as 8-bit RGB."""
        if self.box:
            gaussians = within(gaussians, *(jnp.array(corner, jnp.float32) for corner in self.box))
        if self.mode == "colour":
            return to_8bit(np.asarray(self.renderer(gaussians, camera, ("rgb",)).rgb))
        if self.mode == "alpha":
            alpha = np.asarray(self.renderer(gaussians, camera, ("alpha",)).alpha)
            return np.repeat(to_8bit(alpha[..., None]), 3, axis=2)
        output = NORMALS if self.mode == "normals" else self.depth_of(gaussians)
        drawn = self.renderer(gaussians, camera, ("alpha", output))
        values, alpha = np.asarray(drawn.images[output]), np.asarray(drawn.alpha)
        return normal_map(values, alpha, camera) if self.mode == "normals" else depth_map(values, alpha)

    def depth_of(self, gaussians: Gaussians) -> str:
        """Returns the name of the output that shows the depth of a scene."""
        low_pass = self.renderer.low_pass or gaussians.low_pass
        return DISC_DEPTH if isinstance(low_pass, AlongRays) else ROBUST_DEPTH


@jax.jit
def within(gaussians: Gaussians, low: Float[Array, "3"], high: Float[Array, "3"]) -> Gaussians:
    """Replaces the Gaussians whose centre is outside a box by empty slots.

    The shapes of the arrays stay the same, so no new program is compiled.
    """
    inside = jnp.all((gaussians.means >= low[None]) & (gaussians.means <= high[None]), axis=1)
    return replace(gaussians, opacity_logits=jnp.where(inside, gaussians.opacity_logits, -jnp.inf))
