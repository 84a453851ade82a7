"""The native rasterizer: C++ for CPUs, with SIMD for what the machine has.

Results do not depend on the number of threads. Single precision only.
"""

from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from splatax import native
from splatax.camera import Camera
from splatax.gaussians import Gaussians
from splatax.native import Build, photometric, projection
from splatax.splats import Splats

MAX_PULLED_CHANNELS = 4  # GROUP in native/: of more, no pixel's whole gradient is ever known
MAX_PAIRS = 2**22  # (splat, tile) pairs in a round: at most 260 MB, however large the scene


@dataclass(frozen=True)
class Native:
    """The native rasterizer and projection.

    Attributes:
        instructions: the instruction set that it uses; None for the best one here.
        threads: how many of XLA's it uses; 0 for all.
        max_pairs: (splat, tile) pairs that are listed at a time.
    """

    instructions: str | None = None
    threads: int = native.ALL_THREADS
    max_pairs: int = MAX_PAIRS

    DOUBLE_PRECISION = False

    def why_unavailable(self) -> str | None:
        """None if it can run here."""
        return native.why_unavailable(self.instructions)

    @property
    def build(self) -> Build:
        return Build(self.instructions or native.best_instructions(), self.threads)

    def composite(
        self, splats: Splats, channels: Float[Array, "n c"]
    ) -> tuple[Float[Array, "h w c"], Float[Array, "h w"]]:
        """Blends `channels` of the splats, nearest first, into every pixel; see `rasterizers.composite`."""
        if splats.pull is not None and channels.shape[1] > MAX_PULLED_CHANNELS:
            raise ValueError(
                f"the native rasterizer gives the gradient of `pull` for up to {MAX_PULLED_CHANNELS} "
                f"channels, not for {channels.shape[1]}: draw the others apart, or choose the backend 'xla'"
            )
        return _composite(splats, channels, self.build, self.max_pairs)

    def project(self, gaussians: Gaussians, camera: Camera, variance: float, floor: float) -> Splats:
        """See `splatax.native.projection`."""
        return projection.project(gaussians, camera, self.build, variance, floor)

    def photometric(
        self, image: Float[Array, "h w c"], photo: Float[Array, "h w c"], ssim_weight: float
    ) -> Float[Array, ""]:
        """See `splatax.native.photometric`."""
        return photometric.photometric(image, photo, ssim_weight, self.build)


best = Native()
avx512, avx2, baseline = (Native(instructions) for instructions in native.INSTRUCTIONS)


@partial(jax.custom_vjp, nondiff_argnums=(2, 3))
def _composite(splats: Splats, channels: Float[Array, "n c"], build: Build, max_pairs: int):
    return _draw(splats, channels, build, max_pairs, gradient_follows=False)[:2]


def _forward(splats: Splats, channels: Float[Array, "n c"], build: Build, max_pairs: int):
    image = _draw(splats, channels, build, max_pairs, gradient_follows=True)
    return tuple(image[:2]), (splats, channels, *image)


def _draw(
    splats: Splats, channels: Float[Array, "n c"], build: Build, max_pairs: int, gradient_follows: bool
) -> tuple[Array, Array, Array]:
    """Sums, alpha, and a ticket with which the gradient finds the lists of tiles again."""
    size = (splats.height, splats.width)
    of_ticket = jax.ShapeDtypeStruct((), jnp.int32)
    sums, alpha, ticket = build.call(
        "splatax_rasterize",
        [(*size, channels.shape[1]), size, of_ticket],
        _inputs(splats, channels),
        max_pairs=np.int64(max_pairs),
        gradient_follows=np.int64(gradient_follows),
    )
    return sums, alpha, ticket


def _backward(build: Build, max_pairs: int, residuals, cotangents):
    splats, channels, *image = residuals
    shapes = [splats.means2d.shape, splats.sqrt_conics.shape, splats.opacities.shape, channels.shape]
    means2d, sqrt_conics, opacities, d_channels, pull = build.call(
        "splatax_rasterize_gradient",
        [*shapes, (0, 2) if splats.pull is None else splats.pull.shape],  # it is empty where not asked for
        [*_inputs(splats, channels), *image, *cotangents],
        max_pairs=np.int64(max_pairs),
    )
    nothing = jax.tree.map(jnp.zeros_like, splats)
    d_splats = replace(nothing, means2d=means2d, sqrt_conics=sqrt_conics, opacities=opacities)
    return replace(d_splats, pull=None if splats.pull is None else pull), d_channels


_composite.defvjp(_forward, _backward)


def _inputs(splats: Splats, channels: Float[Array, "n c"]) -> list[Array]:
    shape = [splats.means2d, splats.sqrt_conics, splats.depths, splats.extents, splats.opacities]
    return [*shape, channels]
