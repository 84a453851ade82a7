"""The GPUs of this machine: whether the backend can run on them, and what it loads there."""

import ctypes
import re
import sys
from functools import cache

import jax
import jaxlib

from splatax.backends.cuda import nvrtc, programs
from splatax.backends.cuda.library import FOLDER, Library, check, register

DRIVER = "libcuda.so.1"


def prepare(handlers: ctypes.CDLL) -> None:
    """Gives the driver and the kernels for each kind of GPU to the handlers.

    It does nothing where JAX runs on no NVIDIA GPU: programs can be lowered and exported for one, not run.

    Raises:
        OSError: if there is no driver, no NVRTC, or the driver does not take the kernels.
        ValueError: if a GPU is too old.
    """
    if not _runs_on_cuda():
        return
    check(handlers.splatax_cuda_open(DRIVER.encode()))
    compiler = _compiler()
    if compiler is None:
        raise OSError(_how_to_install())
    for capability in sorted({capability_of(device) for device in jax.local_devices()}):
        check(handlers.splatax_cuda_load(capability, programs.program(compiler, capability)))


LIBRARY = Library(FOLDER / "libsplatax_cuda.so", "CUDA", prepare)


def why_unavailable() -> str | None:
    """Returns the reason why the backend cannot run here and the way out, or None if it can."""
    if jax.default_backend() != "gpu":
        return f"it runs on NVIDIA GPUs, and JAX runs on {jax.default_backend()} here"
    if not _runs_on_cuda():
        return f"it runs on NVIDIA GPUs, and JAX runs on {platform_version()} here"
    if not LIBRARY.path.exists():
        reason = (
            "it is built on Linux"
            if sys.platform != "linux"
            else "install a C++ compiler, then splatax again"
        )
        return f"this installation has no library for CUDA; {reason}"
    if _compiler() is None:
        return _how_to_install()
    return _why_refused()


def describe() -> str:
    """Returns the compiler and the compute capabilities of the GPUs, for a user to report."""
    compiler = _compiler()
    major, minor = compiler.version if compiler else (0, 0)
    kinds = sorted({capability_of(device) for device in jax.local_devices()})
    names = ", ".join(f"{kind // 10}.{kind % 10}" for kind in kinds)
    return f"NVRTC {major}.{minor}; compute capability {names}; kernels are kept in {programs.user_folder()}"


def platform_version() -> str:
    """Returns what XLA says of its platform, such as "cuda 12090" or "rocm 60300"."""
    return jax.local_devices()[0].client.platform_version


def capability_of(device: jax.Device) -> int:
    """Returns the compute capability of a GPU; 90 is 9.0."""
    major, minor = device.compute_capability.split(".")
    return 10 * int(major) + int(minor)


def _runs_on_cuda() -> bool:
    return jax.default_backend() == "gpu" and "cuda" in platform_version().lower()


def _cuda_major() -> int | None:
    """Returns the major version of the CUDA that XLA was built for, or None if it does not tell."""
    found = re.search(r"cuda (\d+)\d{3}\b", platform_version().lower())
    return int(found[1]) if found else None


def _compiler() -> nvrtc.Nvrtc | None:
    path = nvrtc.find(_cuda_major())
    return None if path is None else nvrtc.load(path)


def _how_to_install() -> str:
    wheel = nvrtc.WHEELS.get(_cuda_major() or nvrtc.MAJORS[-1], nvrtc.WHEELS[nvrtc.MAJORS[0]])
    return f"NVRTC, which compiles its kernels, is not installed: run pip install {wheel}"


@cache
def _why_refused() -> str | None:
    """Returns why the driver or XLA does not accept the backend; None if they do."""
    try:
        register(LIBRARY)
    except jax.errors.JaxRuntimeError as error:
        return (
            f"jaxlib {jaxlib.__version__} does not accept the library, which was built with the headers of a "
            f"newer one. Update jax. The reason that JAX gives: {error}"
        )
    except (OSError, ValueError, nvrtc.CompileError) as error:
        return str(error)
    return None
