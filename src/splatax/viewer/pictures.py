"""What a window shows: colour, depth or alpha of the scene, or of the part in a box."""

from dataclasses import dataclass, replace
from typing import Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, UInt8

from splatax.backends.protocol import Kernels
from splatax.camera import Camera
from splatax.gaussians import Gaussians
from splatax.metrics import to_8bit
from splatax.projection import Dilation, LowPass
from splatax.rendering import render
from splatax.report.pictures import depth_map

Mode = Literal["colour", "depth", "alpha"]
MODES: tuple[Mode, ...] = ("colour", "depth", "alpha")
Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Look:
    """How to draw.

    Attributes:
        mode: what of the scene.
        box: lowest and highest x, y, z of what is drawn; None for all.
        background: RGB behind colour.
        low_pass: the one that the scene was trained with.
        backend: rasterizer.
    """

    mode: Mode = "colour"
    box: tuple[Corner, Corner] | None = None
    background: tuple[float, float, float] = (0.0, 0.0, 0.0)
    low_pass: LowPass = Dilation()
    backend: str | Kernels = "auto"

    def picture(self, gaussians: Gaussians, camera: Camera) -> UInt8[np.ndarray, "h w 3"]:
        """Draws what a camera sees, 8-bit RGB."""
        if self.box:
            gaussians = within(gaussians, *(jnp.array(corner, jnp.float32) for corner in self.box))
        drawn = render(
            gaussians,
            camera,
            background=np.array(self.background, np.float32),
            low_pass=self.low_pass,
            backend=self.backend,
        )
        if self.mode == "depth":
            return depth_map(np.asarray(drawn.depth), np.asarray(drawn.alpha))
        if self.mode == "alpha":
            return np.repeat(to_8bit(np.asarray(drawn.alpha)[..., None]), 3, axis=2)
        return to_8bit(np.asarray(drawn.rgb))


@jax.jit
def within(gaussians: Gaussians, low: Float[Array, "3"], high: Float[Array, "3"]) -> Gaussians:
    """The scene with empty slots in place of all whose centre is outside a box: its shape, and with it
    the compiled program, stays."""
    inside = jnp.all((gaussians.means >= low[None]) & (gaussians.means <= high[None]), axis=1)
    return replace(gaussians, opacity_logits=jnp.where(inside, gaussians.opacity_logits, -jnp.inf))
