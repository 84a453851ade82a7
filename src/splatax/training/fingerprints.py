"""Digests of what a run is made of: its capture, its recipe, and the state from which it starts."""

import re
from typing import Any

import jax
import numpy as np

from splatax.cameras import Camera
from splatax.dataset import Dataset, View
from splatax.digests import digest
from splatax.training.random_keys import as_integers
from splatax.training.recipes import Recipe


def fingerprint(dataset: Dataset) -> dict[str, Any]:
    """Returns what a capture is made of as JSON values: sizes of photos, and digests of cameras and points.

    The contents of the photos are not read.
    """
    views = dataset.train + dataset.test
    own = dataset.block
    parts = (own.start, own.context, own.fraction) if own else ()
    block = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(parts)]
    return {
        "photos": f"{len(dataset.train)} to train on and {len(dataset.test)} held out",
        "photo": {view.name: size_of(view) for view in views},
        "camera of": {view.name: digest_of(view.camera) for view in views},
        "points": f"{len(dataset.points)}, "
        + digest(dataset.points.positions.tobytes(), dataset.points.colors.tobytes()),
    } | ({"block": digest(*block)} if block else {})


def size_of(view: View) -> str:
    """Returns the size of a photo, and whether it has a mask, in words."""
    masked = ", with a mask" if view.mask is not None else ""
    return f"{view.camera.width} x {view.camera.height}{masked}"


def digest_of(camera: Camera) -> str:
    """Returns a digest of a camera, also of the kind of its lens, because some have no numbers."""
    leaves = (np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(camera))
    return digest(type(camera.lens).__name__.encode(), *leaves)


def facts_of(recipe: Recipe, dataset: Dataset, state: Any) -> dict[str, str]:
    """Returns all that decides the steps of a run, as short texts by what they are about.

    Args:
        recipe: the settings.
        dataset: the capture.
        state: pytree of arrays from which the run starts.
    """
    addresses = r" at 0x[0-9a-f]+"  # of functions: they differ between processes
    backend = recipe.drawing.backend
    settings = recipe.on(backend if isinstance(backend, str) else backend.name)
    leaves = map(as_integers, jax.tree.leaves(state))
    return {
        **{name: brief(value) for name, value in fingerprint(dataset).items()},
        "recipe": digest(re.sub(addresses, "", repr(settings)).encode()),
        "state before the first step": digest(*(np.asarray(leaf).tobytes() for leaf in leaves)),
    }


def brief(value: Any) -> str:
    """Returns a value as a short text: a digest in place of a mapping."""
    return digest(repr(value).encode()) if isinstance(value, dict) else str(value)
