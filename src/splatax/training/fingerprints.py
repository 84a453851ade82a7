"""Digests of what a run is made of: its capture, its recipe, and the state from which it starts."""

import re
from typing import Any

import jax
import numpy as np

from splatax.dataset import Dataset
from splatax.digests import digest
from splatax.training.random_keys import as_integers
from splatax.training.recipes import Recipe


def fingerprint(dataset: Dataset) -> dict[str, Any]:
    """Returns digests of a capture as JSON values: of names and sizes of photos, cameras and points.

    The contents of the photos are not read.
    """
    views = dataset.train + dataset.test
    sizes = [(view.name, view.camera.width, view.camera.height, view.mask is not None) for view in views]
    cameras = [np.asarray(leaf) for view in views for leaf in jax.tree.leaves(view.camera)]
    lenses = "".join(type(view.camera.lens).__name__ for view in views)  # some have no numbers
    own = dataset.block
    parts = (own.start, own.context, own.fraction) if own else ()
    block = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(parts)]
    return {
        "photos": f"{len(dataset.train)} to train on and {len(dataset.test)} held out",
        "names, sizes and masks of photos": digest(repr(sizes).encode()),
        "cameras": digest(lenses.encode(), *(array.tobytes() for array in cameras)),
        "points": f"{len(dataset.points)}, "
        + digest(dataset.points.positions.tobytes(), dataset.points.colors.tobytes()),
    } | ({"block": digest(*block)} if block else {})


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
        **{name: str(value) for name, value in fingerprint(dataset).items()},
        "recipe": digest(re.sub(addresses, "", repr(settings)).encode()),
        "state before the first step": digest(*(np.asarray(leaf).tobytes() for leaf in leaves)),
    }
