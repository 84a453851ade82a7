"""Checkpoints of gsplat's trainer (`ckpt_29999_rank0.pt`), read without PyTorch. They can only be read.

    {"step": int, "splats": {"means", "scales", "quats", "opacities", "sh0", "shN"}}

Scales are logarithms, opacities are logits, rotations are (w, x, y, z), SH is coefficient-major. A file of
torch.save is a zip file with a pickle (`data.pkl`) and the bytes of each storage (`data/0`, ...), which are
not compressed. A pickle can call any function, so the reader here knows four: those that make an ordered
dictionary, a tensor, and the two kinds of references to a storage. A scene that was trained on several GPUs
has one file for each (`_rank0`, `_rank1`, ...); all files of the step are read.
(github.com/nerfstudio-project/gsplat: examples/simple_trainer.py; pytorch.org/docs: notes/serialization)
"""

import math
import pickle
import re
import zipfile
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np

from splatax.errors import FormatError, shown
from splatax.gaussians import Gaussians

LARGEST_PICKLE = 16 << 20  # bytes; a checkpoint's has some thousand
RANK = re.compile(r"(.*_rank)\d+(\.pt)")
DTYPES = {
    "DoubleStorage": "<f8",
    "FloatStorage": "<f4",
    "HalfStorage": "<f2",
    "LongStorage": "<i8",
    "IntStorage": "<i4",
    "ShortStorage": "<i2",
    "CharStorage": "i1",
    "ByteStorage": "u1",
    "BoolStorage": "?",
}
UNUSED = {  # instructions that files of tensors do not need, by their codes
    code[0]
    for code in (pickle.BYTEARRAY8, pickle.NEXT_BUFFER, pickle.EXT1, pickle.EXT2, pickle.EXT4)
    + (pickle.INST, pickle.OBJ, pickle.NEWOBJ, pickle.NEWOBJ_EX)
}
SPLATS = ("means", "scales", "quats", "opacities", "sh0", "shN")


def load(path: Path) -> Gaussians:
    """Reads a checkpoint, and those of the other GPUs beside it.

    Raises:
        FormatError: if the file is not a checkpoint of gsplat, asks for a function that is not known, or is
            damaged.
    """
    parts = [splats_of(file) for file in ranks(path)]
    columns = {name: np.concatenate([part[name] for part in parts]) for name in SPLATS}
    return Gaussians(
        means=jnp.asarray(columns["means"]),
        quats=jnp.asarray(columns["quats"]),
        log_scales=jnp.asarray(columns["scales"]),
        opacity_logits=jnp.asarray(columns["opacities"]),
        sh=jnp.asarray(np.concatenate([columns["sh0"], columns["shN"]], axis=1)),
    )


def comments(path: Path) -> tuple[str, ...]:
    """Returns no lines: a checkpoint does not tell how its scene is rendered."""
    return ()


def ranks(path: Path) -> list[Path]:
    """Returns the files of all GPUs of a step."""
    if not (match := RANK.fullmatch(path.name)):
        return [path]
    beside = [file for file in path.parent.iterdir() if (m := RANK.fullmatch(file.name)) and m[1] == match[1]]
    return sorted(beside, key=lambda file: (len(file.name), file.name))


def splats_of(path: Path) -> dict[str, np.ndarray]:
    """Returns the arrays of the Gaussians in one file, as 32-bit floating-point numbers.

    Raises:
        FormatError: if an array is missing or has the wrong shape; see `load`.
    """
    contents = unpickled(path)
    splats = contents.get("splats") if isinstance(contents, dict) else None
    if not isinstance(splats, dict) or not all(isinstance(splats.get(n), np.ndarray) for n in SPLATS):
        raise FormatError(
            f"{path}: not a checkpoint of gsplat with {', '.join(SPLATS)}. Give a splat file, or a "
            "checkpoint that was trained without appearance features."
        )
    count = len(splats["means"])
    shapes = {"means": (3,), "scales": (3,), "quats": (4,), "opacities": (), "sh0": (1, 3)}
    for name in SPLATS:
        expected = shapes.get(name, (splats[name].shape[1] if splats[name].ndim == 3 else 0, 3))
        if splats[name].shape != (count, *expected):
            raise FormatError(f"{path}: damaged: {name} has the shape {splats[name].shape}. Copy it again.")
    return {name: splats[name].astype(np.float32) for name in SPLATS}


def unpickled(path: Path) -> Any:
    """Returns the contents of a file of torch.save, with tensors as arrays.

    Raises:
        FormatError: if the file asks for a function that is not known; see `load`.
    """
    if not zipfile.is_zipfile(path):
        raise FormatError(f"{path}: not a file of torch.save since version 1.6. Save the checkpoint again.")
    with zipfile.ZipFile(path) as archive:
        entries = archive.infolist()
        # Bytes that two files share would be read twice.
        together = sum(entry.file_size for entry in entries)
        if any(e.compress_type != zipfile.ZIP_STORED for e in entries) or together > path.stat().st_size:
            raise FormatError(f"{path}: damaged: torch.save does not compress. Copy it again.")
        names = [name for name in archive.namelist() if name.endswith("/data.pkl")]
        if len(names) != 1 or archive.getinfo(names[0]).file_size > LARGEST_PICKLE:
            raise FormatError(f"{path}: damaged: it has no data.pkl of a checkpoint. Copy it again.")
        prefix = names[0].removesuffix("data.pkl")
        order = f"{prefix}byteorder"
        if order in archive.namelist() and archive.read(order) != b"little":
            raise FormatError(f"{path}: written on a big-endian machine. Save it on another.")

        def storage(key: str) -> bytes:
            return archive.read(f"{prefix}data/{key}")

        return Restricted(path, archive.read(names[0]), storage).load()


@dataclass(frozen=True)
class Kind:
    """A type of numbers in a storage."""

    dtype: np.dtype


class Restricted(pickle._Unpickler):
    """Unpickler that knows only what tensors need.

    It is Python's own rather than the one in C, whose table of objects a file can make arbitrarily large.
    """

    dispatch: ClassVar = {c: step for c, step in pickle._Unpickler.dispatch.items() if c not in UNUSED}

    def __init__(self, path: Path, contents: bytes, storage: Callable[[str], bytes]):
        super().__init__(BytesIO(contents))
        self.path, self.storage = path, storage
        self.storages: dict[str, bytes] = {}

    def find_class(self, module: str, name: str) -> Any:
        """Returns what a name stands for.

        Raises:
            FormatError: if it is not among the few that are known.
        """
        if (module, name) == ("collections", "OrderedDict"):
            return OrderedDict
        if (module, name) == ("torch._utils", "_rebuild_tensor_v2"):
            return lambda *arguments: self.tensor(*arguments)
        if module == "torch" and name in DTYPES:
            return Kind(np.dtype(DTYPES[name]))
        raise FormatError(
            f"{self.path}: refused, because loading it would run {shown(f'{module}.{name}')}. Save a "
            "checkpoint of tensors alone."
        )

    def persistent_load(self, reference: Any) -> np.ndarray:
        """Returns the numbers of a storage."""
        what, kind, key, _, count = reference
        if what != "storage" or not isinstance(kind, Kind) or not isinstance(key, str):
            raise ValueError("a reference to no storage")
        if key not in self.storages:
            self.storages[key] = self.storage(key)
        return np.frombuffer(self.storages[key], kind.dtype, count) if count else np.zeros(0, kind.dtype)

    def tensor(self, storage: np.ndarray, offset: int, shape: tuple, strides: tuple, *_: Any) -> np.ndarray:
        """Returns a tensor as an array, a view of its storage."""
        count, step = math.prod(shape), 1
        for side, stride in zip(reversed(shape), reversed(strides), strict=True):
            if count and side > 1 and stride != step:
                raise ValueError("a tensor that is not contiguous")
            step *= side
        if not 0 <= offset <= offset + count <= len(storage):
            raise ValueError("a tensor outside of its storage")
        return storage[offset : offset + count].reshape(shape)
