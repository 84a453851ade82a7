"""Bytes that anybody may have made: what a file claims is checked before memory is asked for."""

import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatax.errors import FormatError, InputError

MAX_EXPANSION = 1024  # times the file's size; about what deflate can reach
ALWAYS_ALLOWED = 64 << 20  # bytes that even a tiny file may unpack to


@dataclass
class Cursor:
    """Takes arrays from a file's bytes, one after the other."""

    path: Path
    contents: bytes
    at: int = 0

    def take(self, what: str, dtype: str, *shape: int) -> np.ndarray:
        """The next array, a view of the bytes.

        Args:
            what: names it in the error.
            dtype: of NumPy, with its byte order.
            shape: of the array.

        Raises:
            FormatError: if the file ends before it does.
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
    """Refuses what would unpack to far more than any real scene does.

    Raises:
        FormatError: if it would.
    """
    if unpacked > max(ALWAYS_ALLOWED, MAX_EXPANSION * stored):
        raise FormatError(
            f"{path}: damaged: {stored:,} bytes claim to hold {unpacked:,}. Get the file again."
        )


def inflate(path: Path, contents: bytes, limit: int) -> bytes:
    """Unpacks a gzip stream, at most `limit` bytes of it.

    Raises:
        FormatError: if it is damaged, or ends before it should.
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


@contextmanager
def structured(path: Path, kind: str) -> Iterator[None]:
    """Where a file's own structure (JSON, zip, images) is followed, a wrong turn is a `FormatError`."""
    try:
        yield
    except (InputError, MemoryError):
        raise
    except OSError as error:
        if error.errno is not None:  # of the file system: not the file's fault
            raise
        raise FormatError(f"{path}: not a valid {kind} file ({error}).") from error
    except Exception as error:
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        raise FormatError(f"{path}: not a valid {kind} file ({reason}).") from error
