"""The parts of a coarse scene and of a capture that belong to one block."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Lock

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, UInt8

from splatax import backends
from splatax.backends.protocol import Kernels
from splatax.blocks.boxes import places_of
from splatax.blocks.plan import PLAN, check_number, read_coarse, read_context, read_plan
from splatax.blocks.visibility import SIDE, own_pixels
from splatax.cameras import Camera
from splatax.cameras.canvases import Size, canvases_for
from splatax.dataset import Block, Dataset, Edited, Pixels, View
from splatax.digests import contents, digest
from splatax.errors import InputError
from splatax.evaluation import MOST_SIZES
from splatax.gaussians import Gaussians
from splatax.metrics import to_8bit
from splatax.rendering import render
from splatax.resampling import resize_mask
from splatax.runs.resume import differences, told
from splatax.training.fingerprints import fingerprint
from splatax.training.photo_cache import with_alpha

DRAWING = Lock()  # one photo at a time, which leaves the device's memory to it


def some(gaussians: Gaussians, rows: Bool[np.ndarray, " n"]) -> Gaussians:
    """Returns some rows of a scene, as arrays of JAX."""
    return jax.tree.map(lambda leaf: jnp.asarray(np.asarray(leaf)[rows]), gaussians)


def part_of(dataset: Dataset, city: Path, number: int) -> Dataset:
    """Returns the capture of one block: its views, its Gaussians to start from, and those around them.

    Its training photos show the coarse scene where the block is not seen; see `among`.

    Args:
        dataset: the whole capture, loaded with the options of the plan.
        city: folder of the plan.
        number: of the block, from 0.

    Raises:
        InputError: if the plan or its files are missing or damaged, there is no such block, or the capture
            has changed since the blocks were planned.
    """
    plan = read_plan(city)
    check_number(plan, city, number)
    if changes := told(differences(dict(plan.capture), fingerprint(dataset))):
        raise InputError(
            f"{city / PLAN}: the capture has changed since the blocks were planned: {changes}. Put it back "
            "as it was, or plan the blocks again."
        )
    block, coarse = plan.blocks[number], read_coarse(plan)
    own = block.box.trains(places_of(np.asarray(coarse.means), plan.axes))
    start, context = some(coarse, own), some(coarse, read_context(city, number, len(coarse)))
    train, test = named(dataset.train, block.photos), named(dataset.test, block.held_out)
    train = among(train, coarse, ~own, plan.options["backend"])
    note = (
        f"block {number} of {len(plan.blocks)}: {len(train)} of {len(dataset.train)} photos, {len(start):,} "
        f"Gaussians to start from, {len(context):,} fixed ones around them"
    )
    trained = Block(start, context, len(start) / len(coarse), dataset.extent)
    return replace(dataset, train=train, test=test, notes=(*dataset.notes, note), block=trained)


def named(views: Sequence[View], names: Sequence[str]) -> tuple[View, ...]:
    """Returns the views with these names, in their order."""
    wanted = set(names)
    return tuple(view for view in views if view.name in wanted)


def among(
    views: Sequence[View], coarse: Gaussians, outside: Bool[np.ndarray, " n"], backend: str | Kernels
) -> tuple[View, ...]:
    """Returns views whose photos show the coarse scene in pixels that are not the block's own.

    See `visibility.own_pixels`. Its surroundings are coarse and fixed: compared with the photos, they would
    be wrong, and the block would grow Gaussians that correct them and that no other block knows of.

    Args:
        views: training views of the block.
        coarse: the coarse scene.
        outside: which of its Gaussians the block does not train.
        backend: backend that draws the scene.
    """
    canvases, found = canvases_for([view.camera for view in views], MOST_SIZES), []
    scene = digest(backends.resolve(backend).name.encode(), *contents(coarse))
    for view, canvas in zip(views, canvases, strict=True):
        bits = np.packbits(own_pixels(coarse, outside, view.camera, backend))
        change = Surrounded(bits, coarse, view.camera, canvas, backend)
        identity = digest(f"{scene} {canvas}".encode(), *contents((bits, view.camera)))
        found.append(replace(view, pixels=Edited(view.pixels, change, identity)))
    return tuple(found)


@dataclass(frozen=True)
class Surrounded:
    """Draws the coarse scene over the pixels of a photo that are not the block's own.

    Attributes:
        bits: the block's own pixels in a small picture, packed.
        coarse: the coarse scene.
        camera: of the view.
        canvas: size that the scene is drawn at; None for that of the view.
        backend: backend that draws it.
    """

    bits: UInt8[np.ndarray, " k"]
    coarse: Gaussians
    camera: Camera
    canvas: Size | None
    backend: str | Kernels

    def __call__(self, photo: Pixels) -> Pixels:
        """Returns the photo as RGBA; elsewhere, alpha is that of the coarse scene."""
        height, width = photo.shape[:2]
        small = np.unpackbits(self.bits, count=SIDE**2).reshape(SIDE, SIDE).astype(bool)
        own = resize_mask(small, width, height)
        camera = self.camera if self.canvas is None else self.camera.on_canvas(*self.canvas)
        with DRAWING:
            drawn = render(self.coarse, camera, backend=self.backend)
        rgb, alpha = (np.asarray(image)[:height, :width] for image in (drawn.rgb, drawn.alpha))
        straight = rgb / np.maximum(alpha, 1 / 255)[..., None]
        around = to_8bit(np.dstack([straight, alpha]))
        return np.where(own[..., None], with_alpha(photo), around)
