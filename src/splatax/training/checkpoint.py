"""Files that hold a run between two steps, and resume it bit for bit.

A file is an uncompressed `.npz`: one array for each leaf of the state, named by its path, and a header
in JSON. Every member carries a CRC-32, so a file that was cut short or has a flipped bit is refused.
"""

import json
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO, Protocol, TypeVar, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from splatax.errors import FormatError
from splatax.gaussians import Gaussians
from splatax.math import harmonics
from splatax.training.loop import RunState, first_state
from splatax.training.random_keys import as_integers, is_key
from splatax.training.recipes import Recipe
from splatax.training.step import TrainState

HEADER = "header"  # name of the member that holds it
STATE = "state/"  # prefix of the names of the arrays of the state
BY_ROW = "gaussians", "opt_state", "density_state"  # parts of the state with a row per Gaussian
PER_PHOTO = (  # arrays with a row per photo
    "appearance/values",
    "cameras/values",
    "cameras/0/values",
    "weights/ratios",
)
State = TypeVar("State")


@dataclass(frozen=True)
class Checkpoint:
    """A run in the memory of the host.

    Attributes:
        header: JSON values by name.
        arrays: arrays by name; the names of those of the state start with "state/".
    """

    header: Mapping[str, Any]
    arrays: Mapping[str, np.ndarray]

    @property
    def step(self) -> int:
        """The number of steps that were made."""
        return int(self.header["step"])


@runtime_checkable
class Stoppable(Protocol):
    """A run between two steps, such as `RunState`."""

    @property
    def train(self) -> Any:
        """The pytree that the steps change, with the number of steps as `step`."""
        ...

    @property
    def count(self) -> int:
        """The number of living Gaussians."""
        ...


def take(state: Stoppable, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> Checkpoint:
    """Copies a run to the host, so that training can continue while it is written.

    Args:
        state: of the run.
        header: further JSON values to keep.
        arrays: further arrays to keep, whose names do not start with "state/".
    """
    leaves, _ = jax.tree_util.tree_flatten_with_path(state.train)
    copies = {name_of(path): on_host(as_integers(leaf)) for path, leaf in leaves}
    counts = {"step": int(state.train.step), "count": state.count}
    return Checkpoint({**header, **counts}, {**arrays, **copies})


def on_host(leaf: Any) -> np.ndarray:
    """Returns an array on the host: as it is, or a copy of one on a device.

    A view of a device array would keep the next step from using its memory again.
    """
    return leaf if isinstance(leaf, np.ndarray) else np.array(leaf)


def restore(checkpoint: Checkpoint, recipe: Recipe) -> RunState:
    """Returns the run as it was; see `restored`.

    Raises:
        FormatError: if the checkpoint does not hold the state of a run of this recipe.
    """
    stored = stored_in(checkpoint)
    state, count = restored(checkpoint, _shapes(stored, recipe))
    return RunState(state, count)


def stored_in(checkpoint: Checkpoint) -> dict[str, np.ndarray]:
    """Returns the arrays of the state in a checkpoint, by name."""
    return {name: array for name, array in checkpoint.arrays.items() if name.startswith(STATE)}


def restored(checkpoint: Checkpoint, shapes: State) -> tuple[State, int]:
    """Returns the state in a checkpoint, and its number of living Gaussians.

    Arrays with a row for each Gaussian stay on the host, because no device may have room for all of them. All
    else is on the device.

    Args:
        checkpoint: of the run.
        shapes: the state with the shape and dtype of each array in its place.

    Raises:
        FormatError: if the checkpoint holds another kind of state.
    """
    stored = stored_in(checkpoint)
    expected, tree = jax.tree_util.tree_flatten_with_path(shapes)
    names = [name_of(path) for path, _ in expected]
    if set(names) != set(stored):
        strange = ", ".join(sorted(set(names) ^ set(stored)))
        raise FormatError(f"the state of another kind of run: {strange}")
    leaves = [_as(stored[name], leaf, name) for name, (_, leaf) in zip(names, expected, strict=True)]
    count, room = int(checkpoint.header["count"]), rows_of(stored)
    if not 0 <= count <= room:
        raise FormatError(f"{count} Gaussians in arrays of {room}")
    return jax.tree.unflatten(tree, leaves), count


def rows_of(stored: Mapping[str, np.ndarray], name: str = "gaussians/means") -> int:
    """Returns the number of rows of an array of the state; 0 if there is none."""
    return next((len(array) for path, array in stored.items() if path == STATE + name and array.ndim), 0)


def write(file: BinaryIO, checkpoint: Checkpoint) -> None:
    """Writes a checkpoint to a seekable file."""
    contents = {**checkpoint.header, "arrays": list(checkpoint.arrays)}
    header = np.frombuffer(json.dumps(contents).encode(), np.uint8)
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in {HEADER: header, **checkpoint.arrays}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


def read(path: Path) -> Checkpoint:
    """Reads a checkpoint.

    Raises:
        FormatError: if it is damaged.
        OSError: if the file cannot be opened.
    """
    with path.open("rb") as file:
        try:
            return _read(file)
        except MemoryError:
            raise
        except Exception as error:  # anybody may have made the file: no list of kinds is complete
            raise FormatError(f"{path}: damaged ({str(error).rstrip('.') or 'cut short'}).") from error


def _read(file: BinaryIO) -> Checkpoint:
    with zipfile.ZipFile(file) as archive:
        damaged = archive.testzip()  # first: what reads an array trusts its bytes
    if damaged:
        raise zipfile.BadZipFile(damaged)
    file.seek(0)
    with np.load(file, allow_pickle=False) as archive:
        arrays = {name: archive[name] for name in archive.files}
    header = json.loads(arrays.pop(HEADER).tobytes())
    if header.pop("arrays") != list(arrays):
        raise ValueError("arrays are missing")
    if not (isinstance(header["step"], int) and isinstance(header["count"], int)):
        raise ValueError("its counts are no numbers")
    return Checkpoint(header, arrays)


def name_of(path: tuple[Any, ...]) -> str:
    """Returns the name of a leaf of the state in the file."""
    return STATE + jax.tree_util.keystr(path, simple=True, separator="/")


def _shapes(stored: Mapping[str, np.ndarray], recipe: Recipe) -> TrainState:
    """Returns the shapes of the state of a run of this recipe with as many Gaussians as are stored."""
    rows = rows_of(stored)
    photos = max(rows_of(stored, name) for name in PER_PHOTO)

    def empty(*shape: int):
        return jax.ShapeDtypeStruct((rows, *shape), jnp.float32)

    gaussians = Gaussians(empty(3), empty(4), empty(3), empty(), empty(harmonics.count(recipe.sh.degree), 3))
    return jax.eval_shape(partial(first_state, recipe=recipe, extent=1.0, photos=photos), gaussians)


def _as(array: np.ndarray, expected: jax.ShapeDtypeStruct, name: str) -> jax.Array | np.ndarray:
    if is_key(expected):
        return jax.random.wrap_key_data(jnp.array(array))
    if (array.shape, array.dtype) != (expected.shape, expected.dtype):
        found, wanted = f"{array.dtype}{array.shape}", f"{expected.dtype}{expected.shape}"
        raise FormatError(f"the state of another kind of run: {name} is {found}, not {wanted}")
    of_gaussians = name.removeprefix(STATE).partition("/")[0] in BY_ROW and array.ndim > 0
    return array if of_gaussians else jnp.array(array)
