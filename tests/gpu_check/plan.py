"""The sizes of the check: those for a GPU, and tiny ones for the emulated device."""

import os
from dataclasses import dataclass, replace
from pathlib import Path

from splatax.backends import cuda
from splatax.backends.cuda.library import Library

TESTS = Path(__file__).parents[1]
ROOT = TESTS.parent


@dataclass(frozen=True)
class Plan:
    """Sizes and numbers of repetitions.

    Attributes:
        emulated: true if there is no GPU.
        contracts: what pytest selects of the contract suites.
        compared: number of Gaussians and size of the image that is compared with other backends.
        counts: numbers of Gaussians of the scenes that are timed.
        size: width and height of their images, pixels.
        rounds: number of times that each operation is timed.
        repeats: number of times that the same bits are asked for.
        copied: bytes of the array whose copying is timed.
        steps: training steps of each capture.
    """

    emulated: bool
    contracts: str
    compared: tuple[int, tuple[int, int]]
    counts: tuple[int, ...]
    size: tuple[int, int]
    rounds: int
    repeats: int
    copied: int
    steps: int


ON_GPU = Plan(
    emulated=False,
    contracts="cuda and not emulated",
    compared=(100_000, (640, 480)),
    counts=(150_000, 1_000_000, 5_000_000, 10_000_000),
    size=(1920, 1080),
    rounds=20,
    repeats=20,
    copied=2**30,
    steps=3000,
)
REHEARSAL = Plan(
    emulated=True,
    contracts="cuda-emulated and 99_percent",
    compared=(100, (32, 24)),
    counts=(60,),
    size=(32, 24),
    rounds=1,
    repeats=2,
    copied=2**12,
    steps=2,
)


def emulate() -> None:
    """Makes the backend "cuda" of this process the emulated one."""
    import emulated

    assert emulated.why_unavailable() is None, emulated.why_unavailable()
    cuda.KERNELS = replace(emulated.kernels(), name="cuda")


def library() -> Library:
    """Returns the library that the backend "cuda" of this process calls."""
    return cuda.KERNELS.composite.keywords["library"]  # type: ignore[attr-defined]


def environment(**variables: str) -> dict[str, str]:
    """Returns the environment of a process that finds splatax and the tests."""
    paths = [str(ROOT / "src"), str(TESTS), os.environ.get("PYTHONPATH", "")]
    return {**os.environ, "PYTHONPATH": os.pathsep.join(paths), **variables}
