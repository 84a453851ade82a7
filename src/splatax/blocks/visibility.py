"""The blocks that photos show, and the Gaussians around a block that its photos show."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from splatax import backends
from splatax.backends.protocol import Kernels
from splatax.cameras import Camera
from splatax.gaussians import Gaussians
from splatax.pipeline import composite, project

SIDE = 256  # pixels of the pictures, whose proportions do not matter, so that all views are one program
SHOWN = 0.02  # fraction of a picture that a block must fill for the view to be one of its views
FEWEST = 4  # views of a block; those that show it best, if fewer show so much of it
SEEN = 0.02  # pixels that a Gaussian must fill in one view of a block to be in its context
FILLED = 0.5  # fraction of a pixel; if the surroundings of a block fill more, it is not the block's own


def weights_in(gaussians: Gaussians, camera: Camera, backend: str | Kernels) -> Float[np.ndarray, " n"]:
    """Returns the pixels that each Gaussian fills in a small picture: its blending weights, added up.

    Gaussians that are hidden behind others have small weights.
    """
    return np.asarray(_weights(gaussians, camera.resized(SIDE, SIDE), backends.resolve(backend)))


@partial(jax.jit, static_argnames="kernels")
def _weights(gaussians: Gaussians, camera: Camera, kernels: Kernels) -> Float[Array, " n"]:
    splats = project(gaussians, camera, None, kernels)

    def total(channel):
        return jnp.sum(composite(splats, channel, kernels)[0])

    # The image of a channel is the sum of weight times channel, so its gradient is the weight.
    return jax.grad(total)(jnp.zeros((len(gaussians), 1), gaussians.means.dtype))[:, 0]


def own_pixels(
    gaussians: Gaussians, outside: Bool[np.ndarray, " n"], camera: Camera, backend: str | Kernels
) -> Bool[np.ndarray, "s s"]:
    """Returns which pixels of a small picture are a block's own: all but those that its surroundings fill.

    Pixels that nothing fills belong to all blocks.

    Args:
        gaussians: the coarse scene.
        outside: which of them the block does not train.
        camera: the view.
        backend: backend that draws the scene.
    """
    filled = _filled(gaussians, jnp.asarray(outside), camera.resized(SIDE, SIDE), backends.resolve(backend))
    return np.asarray(filled) <= FILLED


@partial(jax.jit, static_argnames="kernels")
def _filled(
    gaussians: Gaussians, rows: Bool[Array, " n"], camera: Camera, kernels: Kernels
) -> Float[Array, "h w"]:
    """Returns the sum of the blending weights of some Gaussians at each pixel."""
    splats = project(gaussians, camera, None, kernels)
    channel = rows[:, None].astype(splats.means2d.dtype)
    return composite(splats, channel, kernels)[0][..., 0]


@dataclass(frozen=True)
class Outlook:
    """The photos that show one block, and what they show.

    Attributes:
        train: indices of training views, in order; empty if none shows the block.
        test: indices of held-out views, in order.
        seen: mask of the Gaussians of the coarse scene that at least one of these views shows.
    """

    train: Int[np.ndarray, " k"]
    test: Int[np.ndarray, " l"]
    seen: Bool[np.ndarray, " n"]


def outlooks(
    gaussians: Gaussians,
    views: tuple[Sequence[Camera], Sequence[Camera]],
    blocks: Int[np.ndarray, " n"],
    backend: str | Kernels,
    watch: Callable[[int, int], None] = lambda done, total: None,
) -> list[Outlook]:
    """Returns which views show each block: it fills at least `SHOWN` of their pictures.

    A block has at least `FEWEST` training views: if it needs more, those that show it best.

    Args:
        gaussians: the coarse scene.
        views: the cameras of the training views, and of the held-out ones.
        blocks: the block of each Gaussian, from 0, each at least once.
        backend: backend that draws the scene.
        watch: called with the number of views that are done, and of all.
    """
    train, test = views
    cameras, count = [*train, *test], int(blocks.max()) + 1
    fractions, seen = np.zeros((len(cameras), count)), np.zeros((count, len(gaussians)), bool)
    for index, camera in enumerate(cameras):
        weights = weights_in(gaussians, camera, backend)
        fractions[index] = np.bincount(blocks, weights, count) / SIDE**2
        seen[fractions[index] >= SHOWN] |= weights >= SEEN
        watch(index + 1, len(cameras))
    found = []
    for block, fraction in enumerate(fractions.T):
        own, held_out = fraction[: len(train)], fraction[len(train) :]
        chosen = np.flatnonzero(own >= SHOWN)
        if len(chosen) < FEWEST:
            best = np.argsort(-own, kind="stable")[:FEWEST]
            chosen = np.sort(best[own[best] > 0])
            for view in chosen:
                seen[block] |= weights_in(gaussians, cameras[view], backend) >= SEEN
        found.append(Outlook(chosen, np.flatnonzero(held_out >= SHOWN), seen[block]))
    return found
