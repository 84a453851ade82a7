"""Packages that only parts of splatax need."""

from collections.abc import Iterator
from contextlib import contextmanager

from splatax.errors import InputError

NAMES = {  # module -> the package that brings it, where their names differ
    "PIL": "pillow",
    "fast_simplification": "fast-simplification",
    "skimage": "scikit-image",
}


class MissingPackageError(InputError, ImportError):
    """A package that this part of splatax needs is not installed."""


@contextmanager
def required_by(part: str, extra: str | None = None) -> Iterator[None]:
    """Says which package to install if an import inside the block does not find its module.

    Args:
        part: name of what needs the package, which begins the message, for example "splatax.load_dataset".
        extra: the optional dependencies of splatax that hold the package, if users need all of them.

    Raises:
        MissingPackageError: if a module of another package is not found.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        module = (error.name or "splatax").partition(".")[0]
        if module == "splatax":
            raise
        package = NAMES.get(module, module)
        install = f"'.[{extra}]' in the checkout of splatax." if extra else package
        raise MissingPackageError(
            f"{part} needs the package {package}, which is not installed: pip install {install}"
        ) from error
