"""The compiled kernels for a GPU, kept on disk.

A file is named by a hash of everything that decides it: the sources, the compiler's options and version, and
the kind of GPU. It starts with a hash of the rest, so a damaged file is compiled again.
"""

import hashlib
import os
import tempfile
import warnings
from functools import cache
from pathlib import Path

from splatax.backends.cuda.nvrtc import Nvrtc

MAIN = "kernels.cu"
OPTIONS = ("--std=c++17",)
LEAST_CAPABILITY = 75  # Turing; no older GPU is tested, and NVRTC 13 compiles for none
INSTALLED = Path(__file__).parent / "kernels"
IN_REPOSITORY = Path(__file__).parents[4] / "native" / "cuda" / "kernels"
DIGEST_BYTES = hashlib.sha256().digest_size


@cache
def sources() -> dict[str, str]:
    """Returns the text of each file of the kernels, by name."""
    folder = INSTALLED if INSTALLED.is_dir() else IN_REPOSITORY
    return {
        path.name: path.read_text() for path in sorted(folder.iterdir()) if path.suffix in (".cu", ".cuh")
    }


def architecture(capability: int, known: tuple[int, ...]) -> str:
    """Returns what to compile for a GPU: its own binary, or else PTX, which its driver compiles.

    Args:
        capability: compute capability of the GPU; 90 is 9.0.
        known: capabilities that the compiler knows.

    Raises:
        ValueError: if the GPU is too old.
    """
    older = [each for each in known if LEAST_CAPABILITY <= each <= capability]
    if not older:
        raise ValueError(
            f"the GPU has compute capability {capability // 10}.{capability % 10}, and the kernels need "
            f"{LEAST_CAPABILITY // 10}.{LEAST_CAPABILITY % 10} or newer"
        )
    return f"sm_{capability}" if capability in older else f"compute_{max(older)}"


def program(compiler: Nvrtc, capability: int, folder: Path | None = None) -> bytes:
    """Returns the kernels for GPUs of one compute capability, from disk if they were compiled before.

    Args:
        compiler: the compiler.
        capability: see `architecture`.
        folder: of the files; None for that of the user.

    Raises:
        ValueError: if the GPU is too old.
        CompileError: if the kernels do not compile.
    """
    options = (f"--gpu-architecture={architecture(capability, compiler.capabilities)}", *OPTIONS)
    path = (folder or user_folder()) / f"{_digest(compiler, options)}.kernels"
    kept = _read(path)
    if kept is not None:
        return kept
    binary = compiler.compile(sources(), MAIN, options).binary
    _write(path, binary)
    return binary


def user_folder() -> Path:
    """Returns the folder in which compiled kernels are kept."""
    root = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(root) / "splatax" / "cuda"


def _digest(compiler: Nvrtc, options: tuple[str, ...]) -> str:
    digest = hashlib.sha256(repr((compiler.version, options, sorted(sources().items()))).encode())
    return digest.hexdigest()


def _read(path: Path) -> bytes | None:
    """Returns the content of a file; None if there is none, or it is damaged."""
    if not path.is_file():
        return None
    content = path.read_bytes()
    binary = content[DIGEST_BYTES:]
    return binary if hashlib.sha256(binary).digest() == content[:DIGEST_BYTES] else None


def _write(path: Path, binary: bytes) -> None:
    """Writes a file at once, so that no other process reads half of it."""
    try:
        path.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        descriptor, partial = tempfile.mkstemp(dir=path.parent)
        with os.fdopen(descriptor, "wb") as file:
            file.write(hashlib.sha256(binary).digest() + binary)
        os.replace(partial, path)
    except OSError as error:
        warnings.warn(
            f"compiled kernels cannot be kept in {path.parent} ({error}), so every start compiles them "
            "again. Set XDG_CACHE_HOME to a folder that can be written.",
            stacklevel=2,
        )
