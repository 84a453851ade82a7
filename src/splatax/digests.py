"""Digests that tell whether arrays, settings or files are the same: the first 64 bits of SHA-256."""

import hashlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np

DIGITS = 16  # of a digest, hexadecimal


def digest(*parts: bytes) -> str:
    """Returns the digest of bytes, in which the borders of the parts do not count."""
    found = hashlib.sha256()
    for part in parts:
        found.update(part)
    return found.hexdigest()[:DIGITS]


def file_digest(path: Path) -> str:
    """Returns the digest of the contents of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:DIGITS]


def contents(tree: Any) -> Iterator[bytes]:
    """Yields the structure of a pytree of arrays, with the fields that are not arrays, and each array."""
    leaves, structure = jax.tree.flatten(tree)
    yield str(structure).encode()
    for leaf in leaves:
        yield np.asarray(leaf).tobytes()
