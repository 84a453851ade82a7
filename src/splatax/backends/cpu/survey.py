"""Colour, parts and the median of each pixel in one native walk over the splats.

A simulated camera asks for colour, for the part that each pixel shows, and for the depth of the Gaussian
that makes the pixel half opaque. One walk over the splats of a tile finds all of it. One addition for each
splat at a pixel serves all parts, because a splat belongs to one.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatax.backends.cpu.composite import Walk, select
from splatax.backends.cpu.drawing import derivative_of_image, drawn_image
from splatax.backends.cpu.library import Build
from splatax.backends.protocol import Composite, Select
from splatax.backends.splat_kernels import inputs_of
from splatax.splats import Splats

MOST_CHANNELS, MOST_PARTS = 4, 32  # GROUP and MOST_PARTS in native/

Found = tuple[Float[Array, "h w c"], Float[Array, "h w"], Int[Array, "h w"]]


@dataclass(frozen=True)
class NativeSurvey:
    """The native kernel; see `splatax.backends.protocol.Survey`.

    Attributes:
        build: the native library.
        max_pairs: see `kernels` of this backend.
        composite, select: kernels of the same backend.
    """

    build: Build
    max_pairs: int
    composite: Composite
    select: Select

    def fits(self, splats: Splats, channels: int, parts: int) -> bool:
        """Returns whether it draws so many channels and parts of such splats."""
        plain = splats.slants is None and splats.pull is None
        return plain and channels <= MOST_CHANNELS and parts <= MOST_PARTS

    def __call__(self, splats: Splats, channels: Float[Array, "n c"], sizes: tuple[int, ...]) -> Found:
        """Returns the sums of channels, alpha, and the median of each pixel."""
        return _survey(splats, channels, sizes, self.build, self.max_pairs)


@partial(jax.custom_jvp, nondiff_argnums=(2, 3, 4))
def _survey(
    splats: Splats, channels: Float[Array, "n c"], sizes: tuple[int, ...], build: Build, max_pairs: int
) -> Found:
    size, own = (splats.height, splats.width), channels.shape[1] - len(sizes)
    sums, alpha, parts, median = build.call(
        "splatax_survey",
        [(*size, own), size, (*size, len(sizes)), jax.ShapeDtypeStruct(size, jnp.int32)],
        inputs_of(splats, channels[:, :own]),
        batches=True,
        max_pairs=np.int64(max_pairs),
        sizes=np.array(sizes, np.int64),
    )
    return jnp.concatenate([sums, parts], axis=2), alpha, median


@_survey.defjvp
def _(sizes: tuple[int, ...], build: Build, max_pairs: int, primals, tangents):
    # A derivative needs the image in the form that the rasterizer keeps for it.
    splats, channels = primals
    drawn = drawn_image(splats, channels, Walk(build, max_pairs))
    median = select(jax.lax.stop_gradient(splats), 0, build, max_pairs).median
    image_tangents = derivative_of_image(Walk(build, max_pairs), primals, drawn, tangents)
    return (*drawn[:2], median), (*image_tangents, np.zeros(median.shape, jax.dtypes.float0))
