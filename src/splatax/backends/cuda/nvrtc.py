"""NVRTC, NVIDIA's run-time compiler for CUDA C++, through ctypes. It compiles for any GPU and needs none."""

import ctypes
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

MAJORS = (13, 12)  # of NVRTC, newest first
WHEELS = {12: "nvidia-cuda-nvrtc-cu12", 13: "nvidia-cuda-nvrtc"}
FOLDERS = {12: "cuda_nvrtc/lib", 13: "cu13/lib"}  # in the package `nvidia`, where those wheels put it


class CompileError(RuntimeError):
    """Kernels that NVRTC does not compile."""


@dataclass(frozen=True)
class Compiled:
    """A program for one kind of GPU.

    Attributes:
        binary: a cubin, or PTX with a zero at its end.
        log: output of the compiler.
    """

    binary: bytes
    log: str


class Nvrtc:
    """A loaded NVRTC.

    Attributes:
        version: major and minor.
        capabilities: compute capabilities that it compiles for, ascending; 90 is 9.0.
    """

    def __init__(self, path: Path | str) -> None:
        self._library = ctypes.CDLL(str(path))
        self._library.nvrtcGetErrorString.restype = ctypes.c_char_p
        major, minor, count = ctypes.c_int(), ctypes.c_int(), ctypes.c_int()
        self._check(self._library.nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
        self.version = (major.value, minor.value)
        self._check(self._library.nvrtcGetNumSupportedArchs(ctypes.byref(count)))
        numbers = (ctypes.c_int * count.value)()
        self._check(self._library.nvrtcGetSupportedArchs(numbers))
        self.capabilities = tuple(sorted(numbers))

    def compile(self, sources: Mapping[str, str], main: str, options: tuple[str, ...]) -> Compiled:
        """Compiles a program.

        Args:
            sources: text of each file, by the name under which others include it.
            main: name of the file to compile.
            options: of the compiler. The architecture decides the result: a cubin for sm_90, PTX for
                compute_90.

        Raises:
            CompileError: with what the compiler printed.
        """
        headers = {name.encode(): text.encode() for name, text in sources.items() if name != main}
        program, count = ctypes.c_void_p(), len(headers)
        self._check(
            self._library.nvrtcCreateProgram(
                ctypes.byref(program),
                sources[main].encode(),
                main.encode(),
                count,
                (ctypes.c_char_p * count)(*headers.values()),
                (ctypes.c_char_p * count)(*headers),
            )
        )
        try:
            texts = (ctypes.c_char_p * len(options))(*(option.encode() for option in options))
            code = self._library.nvrtcCompileProgram(program, len(options), texts)
            log = self._get(program, "ProgramLog").rstrip(b"\0").decode(errors="replace")
            self._check(code, log)
            kind = "PTX" if any("compute_" in option for option in options) else "CUBIN"
            return Compiled(self._get(program, kind), log)
        finally:
            self._library.nvrtcDestroyProgram(ctypes.byref(program))

    def _get(self, program: ctypes.c_void_p, what: str) -> bytes:
        size = ctypes.c_size_t()
        self._check(getattr(self._library, f"nvrtcGet{what}Size")(program, ctypes.byref(size)))
        buffer = ctypes.create_string_buffer(size.value)
        self._check(getattr(self._library, f"nvrtcGet{what}")(program, buffer))
        return buffer.raw

    def _check(self, code: int, log: str = "") -> None:
        if code:
            reason = self._library.nvrtcGetErrorString(code).decode()
            raise CompileError(f"NVRTC reports {reason}. {log}".rstrip())


def find(major: int | None = None) -> Path | str | None:
    """Returns a path or name with which NVRTC loads, or None if it is not installed.

    Args:
        major: version of CUDA that JAX runs on; an NVRTC of another version is not taken. None for any.
    """
    for version in MAJORS if major is None else (major,):
        name = f"libnvrtc.so.{version}"
        if version not in FOLDERS:
            return name if _loads(name) else None
        spec = importlib.util.find_spec("nvidia")
        for root in (spec.submodule_search_locations or ()) if spec else ():
            path = Path(root) / FOLDERS[version] / name
            if path.exists():
                return path
        if _loads(name):
            return name
    return None


@cache
def load(path: Path | str) -> Nvrtc:
    """Loads NVRTC from a path or name that `find` has returned."""
    return Nvrtc(path)


def _loads(name: str) -> bool:
    try:
        ctypes.CDLL(name)
    except OSError:
        return False
    return True
