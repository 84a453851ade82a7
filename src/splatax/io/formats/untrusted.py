"""Reads untrusted bytes: sizes in a file are checked before memory is allocated."""

import zlib
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatax.errors import FormatError
from splatax.io.damage import blamed_on

MAX_EXPANSION = 1024  # times the file's size; about the maximum of deflate
ALWAYS_ALLOWED = 64 << 20  # bytes that even a tiny file may unpack to


@dataclass
class Cursor:
    """Position in the bytes of a file, from which arrays are taken one after the other."""

    path: Path
    contents: bytes
    at: int = 0

    def take(self, what: str, dtype: str, *shape: int) -> np.ndarray:
        """Returns the next array, a view of the bytes.

        Args:
            what: name of the array for the error message.
            dtype: NumPy's type code, with its byte order.
            shape: shape of the array.

        Raises:
            FormatError: if the file ends before the array does.
        """
        count = int(np.prod([int(n) for n in shape], dtype=object))
        missing = self.at + count * np.dtype(dtype).itemsize - len(self.contents)
        if missing > 0 or count < 0:
            raise FormatError(
                f"{self.path}: truncated: {missing:,} bytes of its {what} are missing. Copy the file again."
            )
        values = np.frombuffer(self.contents, dtype, count, self.at).reshape(shape)
        self.at += values.nbytes
        return values


def check_expansion(path: Path, unpacked: int, stored: int) -> None:
    """Refuses a file that would unpack to far more bytes than any real scene has.

    Raises:
        FormatError: if the expansion is too large.
    """
    if unpacked > max(ALWAYS_ALLOWED, MAX_EXPANSION * stored):
        raise FormatError(
            f"{path}: damaged: {stored:,} bytes claim to hold {unpacked:,}. Get the file again."
        )


def inflate(path: Path, contents: bytes, limit: int) -> bytes:
    """Unpacks a gzip stream, at most `limit` bytes of it.

    Raises:
        FormatError: if the stream is damaged or truncated.
    """
    stream = zlib.decompressobj(zlib.MAX_WBITS | 16)
    try:
        unpacked = stream.decompress(contents, limit)
    except zlib.error as error:
        raise FormatError(f"{path}: damaged ({error}). Copy the file again.") from error
    if len(unpacked) < limit and not stream.eof:
        raise FormatError(
            f"{path}: truncated: its gzip stream ends after {len(unpacked):,} bytes. Copy the file again."
        )
    return unpacked


def structured(path: Path, kind: str) -> AbstractContextManager[None]:
    """Turns any exception that a reader raises on a damaged file into a `FormatError`."""
    return blamed_on(path, f"not a valid {kind} file", "Get the file again.", FormatError)
