"""The outputs of `render`, by name. A new output is one line of `OUTPUTS`.

An output is made of sums over the splats at a pixel (`channels`), of the splats that decide the pixel
(`selected`), or of both. Sums that no requested output needs are not computed.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatax.backends.protocol import MOST_SELECTED
from splatax.drawn import BackgroundArray as BackgroundArray
from splatax.drawn import Drawn as Drawn
from splatax.drawn import Seen as Seen
from splatax.drawn import scene_of, selection_of
from splatax.pytrees import pytree
from splatax.surface_outputs import (
    median_surface_depth,
    normal_channels,
    normals,
    surface_channels,
    surface_depth,
)


class Contributors(NamedTuple):
    """The Gaussians that contribute most to each pixel, largest weight first.

    Attributes:
        indices: rows of the scene; -1 where fewer Gaussians are drawn. `Scene.part_of` finds their parts.
        weights: the fractions of the pixel that they fill; 0 where fewer are drawn. Without a gradient.
    """

    indices: Int[Array, "h w k"]
    weights: Float[Array, "h w k"]


@dataclass(frozen=True)
class Output:
    """One output of `render`: what it needs, and how it is computed from that.

    Attributes:
        finish: computes the output.
        channels: returns what to blend, one row for each splat; None to blend nothing.
        selected: the number of contributors to find for each pixel, 0 for the median only; None for neither.
    """

    finish: Callable[[Drawn], Any]
    channels: Callable[[Seen], Float[Array, "n c"]] | None = None
    selected: int | None = None


@cache  # equal outputs share a compiled program
def contributors(count: int) -> Output:
    """Returns the output "contributors" for another number of Gaussians, from 1 to 64.

    Raises:
        ValueError: if the number is out of range.
    """
    if not 1 <= count <= MOST_SELECTED:
        raise ValueError(f"contributors: {count} Gaussians for each pixel. Ask for 1 to {MOST_SELECTED}.")
    return Output(lambda drawn: Contributors(*selection_of(drawn)[:2]), selected=count)


def over(
    premultiplied: Float[Array, "h w 3"], alpha: Float[Array, "h w"], background: BackgroundArray
) -> Float[Array, "h w 3"]:
    """Returns colour that is already weighted by alpha, over a background."""
    behind = background[None, None, :] if background.ndim == 1 else background
    return premultiplied + (1 - alpha)[..., None] * behind


def mean(drawn: Drawn) -> Float[Array, "h w"]:
    """Returns the mean over the splats that cover a pixel; 0 where none does."""
    assert drawn.sums is not None
    assert drawn.alpha is not None
    covered = drawn.alpha > 0
    return jnp.where(covered, drawn.sums[..., 0] / jnp.where(covered, drawn.alpha, 1), 0)


def median_depth(drawn: Drawn) -> Float[Array, "h w"]:
    """Returns the depth of the splat that makes a pixel half opaque; 0 where none does."""
    median = selection_of(drawn).median
    depths = jnp.append(drawn.splats.depths, 0)  # so that index -1 is no splat
    return depths[median]


def distances(seen: Seen) -> Float[Array, "n 1"]:
    """Returns the distances from the optical centre to the Gaussians, world units; 0 for culled ones.

    Raises:
        ValueError: if there are only splats, which do not have them.
    """
    gaussians, camera = scene_of(seen, "distance")
    shown = jnp.all(seen.splats.extents > 0, axis=1)
    offset = jnp.where(shown[:, None], gaussians.means - camera.position[None], 0)
    squared = jnp.sum(jnp.square(offset), axis=1)
    apart = squared > 0
    return jnp.where(apart, jnp.sqrt(jnp.where(apart, squared, 1)), 0)[:, None]


def part_rows(seen: Seen) -> Float[Array, "n p"]:
    """Returns 1 for each Gaussian in the column of its part, else 0. It refuses splats without a scene."""
    if seen.sizes is None:
        raise ValueError("output 'parts' needs the scene: use render instead of rasterize.")
    part = np.repeat(np.arange(len(seen.sizes)), seen.sizes)
    copies = seen.splats.depths.shape[0] // max(len(part), 1)  # 2 where splats are on both sides of a seam
    part = np.tile(part, copies)
    return jnp.asarray(part[:, None] == np.arange(len(seen.sizes))[None], seen.splats.depths.dtype)


def _rgb(drawn: Drawn) -> Float[Array, "h w 3"]:
    assert drawn.sums is not None
    assert drawn.alpha is not None
    return over(drawn.sums, drawn.alpha, drawn.background)


OUTPUTS: dict[str, Output] = {
    "rgb": Output(_rgb, lambda seen: seen.splats.colors),
    "alpha": Output(lambda drawn: drawn.alpha, lambda seen: seen.splats.colors[:, :0]),
    "depth": Output(mean, lambda seen: seen.splats.depths[:, None]),
    "distance": Output(mean, distances),
    "median_depth": Output(median_depth, selected=0),
    "surface_depth": Output(surface_depth, surface_channels),
    "median_surface_depth": Output(median_surface_depth, selected=0),
    "normals": Output(normals, normal_channels),
    "parts": Output(lambda drawn: drawn.sums, part_rows),
    "contributors": Output(contributors(8).finish, selected=8),
}
STANDARD = ("rgb", "alpha", "depth")

Outputs = Sequence[str] | Mapping[str, Output]


def resolve(outputs: Outputs) -> tuple[tuple[str, Output], ...]:
    """Returns the requested outputs with their names.

    Args:
        outputs: names in `OUTPUTS`, or a mapping from names to outputs of your own.

    Raises:
        ValueError: if there is no output of a name.
    """
    if isinstance(outputs, Mapping):
        return tuple(outputs.items())
    if isinstance(outputs, str):
        raise ValueError(f"outputs is the text {outputs!r}. Give a tuple of names: ({outputs!r},).")
    for name in outputs:
        if name not in OUTPUTS:
            raise ValueError(f"no output {name!r}: choose from {', '.join(OUTPUTS)}.")
    return tuple((name, OUTPUTS[name]) for name in dict.fromkeys(outputs))


@pytree
@dataclass(frozen=True)
class Rendering:
    """Rendered images of one view, one for each requested output; see `splatax.outputs.OUTPUTS`.

    Each output is an attribute:

        rgb           [h w 3]  display-referred colour over the background, at least 0; may exceed 1
        alpha         [h w]    coverage of the pixel, in [0, 1]
        depth         [h w]    mean depth of the splats that cover the pixel, world units; 0 if none
        distance      [h w]    mean distance from the optical centre to these, world units; 0 if none
        median_depth  [h w]    depth of the splat that makes the pixel half opaque; 0 if none does
        surface_depth [h w]    depth of the blended planes of the Gaussians at the pixel; 0 if none
        median_surface_depth   [h w]: depth of the plane of the Gaussian that makes it half opaque; 0 if none
        normals       [h w 3]  mean normal of the Gaussians, unit vectors in the world; 0 if none
        parts         [h w p]  fraction of the pixel that each part of a `Scene` fills; their sum is alpha
        contributors           `Contributors`: the Gaussians with the largest weights, and the weights

    Attributes:
        images: the outputs by name.
        features: the features by name, weighted like colour, without a background.
    """

    images: dict[str, Any]
    features: dict[str, Float[Array, "h w f"]]

    def __getattr__(self, name: str) -> Any:
        """Returns an output by its name.

        Raises:
            AttributeError: if it was not requested.
        """
        if name.startswith("_") or name in ("images", "features"):  # while a copy is being made
            raise AttributeError(name)
        if name in self.images:
            return self.images[name]
        asked = ", ".join(repr(output) for output in self.images)
        if name in OUTPUTS:
            raise AttributeError(
                f"this rendering has no {name!r}: it was made with outputs=({asked}). Request {name!r} too."
            )
        raise AttributeError(f"a rendering has no {name!r}; this one has {asked}.")
