"""The wrapper of all readers, which turns every exception that a damaged file causes into one error."""

import errno
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatax.errors import InputError, shown
from splatax.packages import MissingPackageError, required_by


@contextmanager
def blamed_on(path: Path, what: str, way_out: str, kind: type[InputError]) -> Iterator[None]:
    """Turns exceptions into an error that names the file.

    Three kinds of exceptions pass unchanged: an error of the requested kind, whose message is more specific,
    the error about a package that is not installed, and an `OSError` of the file system, which is not the
    file's fault. The last gets the file's name if it has none.

    Args:
        path: file that is read.
        what: sentence about the file, such as "the photo is damaged". The reason follows in parentheses.
        way_out: a sentence, such as "Copy it again."
        kind: the error to raise.

    Raises:
        InputError: of the given kind.
        MissingPackageError: if the file needs a package that is not installed.
    """
    try:
        with required_by(f"reading {path}"):
            yield
    except (kind, MissingPackageError):
        raise
    except OSError as error:
        if _of_the_file_system(error):
            error.filename = error.filename or str(path)
            raise
        raise kind(f"{path}: {what} ({reason_of(error)}). {way_out}") from error
    except Exception as error:
        raise kind(f"{path}: {what} ({reason_of(error)}). {way_out}") from error


def reason_of(error: Exception) -> str:
    """Returns an exception's message as one short line, with its type if the message alone is unclear."""
    first = next((line for line in str(error).splitlines() if line.strip()), "").strip().rstrip(".")
    tells = isinstance(error, OSError | ValueError | RuntimeError | MemoryError) and first
    return shown(first if tells else f"{type(error).__name__}: {first}".removesuffix(": "))


def _of_the_file_system(error: OSError) -> bool:
    """Returns whether the file system failed. EINVAL means that offsets in the file lead before its start."""
    return error.errno not in (None, errno.EINVAL)
