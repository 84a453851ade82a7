"""The CUDA backend on the CPU: its own handlers and kernels, with a driver that emulates a GPU.

What is built is kept in `build/emulation`, by a hash of the sources and the compiler's options.
"""

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

import jaxlib

from splatax.backends import cuda
from splatax.backends.cuda.library import Library, check
from splatax.backends.protocol import Kernels, runs_everywhere

NAME = "cuda-emulated"
NATIVE = Path(__file__).parents[1] / "native"
FOLDERS = [NATIVE / name for name in ("cuda/kernels", "cuda/host", "emulation")]
HEADERS = Path(jaxlib.__file__).parent / "include"
COMPILER = shutil.which(os.environ.get("CXX", "g++"))
# The emulation jumps between stacks, which fortified longjmp refuses. Products are not contracted into sums
# that CUDA might keep apart.
OPTIONS = [
    "-std=c++17",
    "-fPIC",
    "-Wall",
    "-Wextra",
    "-Wno-unknown-pragmas",
    "-Wno-unused-function",
    "-U_FORTIFY_SOURCE",
    "-ffp-contract=off",
]
HANDLERS, DRIVER = "libhandlers.so", "libdriver.so"
MAX_PAIRS = 2**13  # enough for the scenes of tests, where each block of threads takes time


def why_unavailable() -> str | None:
    """The reason why nothing can be built here, or None."""
    if os.name != "posix" or not COMPILER:
        return "the emulation of a GPU needs Linux and a C++ compiler"
    return None


def compile(sources: list[Path], output: Path, *options: str, kernels: Path = FOLDERS[0]) -> None:
    """Compiles a program or a library."""
    folders = [f"-I{folder}" for folder in (kernels, *FOLDERS[1:])]
    command = [COMPILER, *OPTIONS, *folders, "-isystem", str(HEADERS), *options]
    command += ["-x", "c++", *map(str, sources), "-ldl", "-o", str(output)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr[-4000:]


@cache
def built() -> Path:
    """The folder with the handlers and the driver, which are built if they are not there."""
    sources = [path for folder in FOLDERS for path in sorted(folder.iterdir())]
    sources.append(NATIVE / "cpu" / "ffi.h")
    digest = hashlib.sha256(" ".join((*OPTIONS, jaxlib.__version__)).encode())
    for path in sources:
        digest.update(path.name.encode() + path.read_bytes())
    folder = NATIVE.parent / "build" / "emulation" / digest.hexdigest()[:16]
    import fcntl  # where there is no emulation, there may be no such module

    folder.parent.mkdir(parents=True, exist_ok=True)
    # Other processes wait for the one that builds. One that is killed leaves nothing behind that counts.
    with (folder.parent / "lock").open("w") as lock, tempfile.TemporaryDirectory(dir=folder.parent) as place:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not folder.exists():
            partial = Path(place) / "built"
            partial.mkdir()
            handlers = sorted((NATIVE / "cuda" / "host").glob("*.cc"))
            compile(handlers, partial / HANDLERS, "-O1", "-shared", "-DSPLATAX_EMULATION")
            compile([NATIVE / "emulation" / "driver.cc"], partial / DRIVER, "-O2", "-shared")
            partial.rename(folder)
    return folder


def set_order(seed: int) -> None:
    """Chooses the order in which emulated threads and blocks take turns; 0 is the order of their numbers."""
    ctypes.CDLL(str(built() / DRIVER)).emulation_set_order(ctypes.c_ulonglong(seed))


def prepare(handlers: ctypes.CDLL) -> None:
    check(handlers.splatax_cuda_open(str(built() / DRIVER).encode()))
    check(handlers.splatax_cuda_load(90, b""))


@cache
def kernels(max_pairs: int = MAX_PAIRS) -> Kernels:
    """The kernels of the CUDA backend, emulated."""
    library = Library(built() / HANDLERS, "cpu", prepare)
    return cuda.kernels(library, NAME, max_pairs, runs_everywhere)
