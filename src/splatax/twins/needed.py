"""The packages of the extra "twins", which splatax needs for nothing else."""

from collections.abc import Iterator
from contextlib import contextmanager

from splatax.packages import MissingPackageError


@contextmanager
def twins_extra(part: str) -> Iterator[None]:
    """Says how to install the extra if an import inside the block does not find its module.

    Args:
        part: what needs the packages, as the subject of the message.

    Raises:
        MissingPackageError: if a module of another package is not found.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        package = (error.name or "splatax").partition(".")[0]
        if package == "splatax":
            raise
        raise MissingPackageError(
            f"{part} needs the package {package}, which is not installed: pip install '.[twins]' in the "
            "checkout of splatax."
        ) from error
