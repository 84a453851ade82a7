"""Pictures of the live viewer: colour, depth or alpha of the scene, or of its part inside a box."""

from dataclasses import dataclass, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.metrics import to_8bit
from splatax.rendering import Renderer
from splatax.report.pictures import depth_map

Mode = Literal["colour", "depth", "alpha"]
MODES: tuple[Mode, ...] = ("colour", "depth", "alpha")
Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Look:
    """Display options.

    Attributes:
        mode: the quantity to show.
        box: lowest and highest x, y, z of the crop box, world units; None to show everything.
        background: RGB behind colour, in [0, 1].
    """

    mode: Mode = "colour"
    box: tuple[Corner, Corner] | None = None
    renderer: Renderer = Renderer()

    def picture(self, gaussians: Gaussians, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
        """Draws the view of a camera as 8-bit RGB."""
        if self.box:
            gaussians = within(gaussians, *(jnp.array(corner, jnp.float32) for corner in self.box))
        drawn = self.renderer(gaussians, camera)
        if self.mode == "depth":
            return depth_map(np.asarray(drawn.depth), np.asarray(drawn.alpha))
        if self.mode == "alpha":
            return np.repeat(to_8bit(np.asarray(drawn.alpha)[..., None]), 3, axis=2)
        return to_8bit(np.asarray(drawn.rgb))


@jax.jit
def within(gaussians: Gaussians, low: Float[Array, "3"], high: Float[Array, "3"]) -> Gaussians:
    """Replaces the Gaussians whose centre is outside a box by empty slots.

    The shapes of the arrays stay the same, so no new program is compiled.
    """
    inside = jnp.all((gaussians.means >= low[None]) & (gaussians.means <= high[None]), axis=1)
    return replace(gaussians, opacity_logits=jnp.where(inside, gaussians.opacity_logits, -jnp.inf))
