"""Versions of XLA's interface to foreign functions: those that are built and those that are refused."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NEWER = """
import ctypes
from types import SimpleNamespace

import jax.numpy as jnp
from splatax import backends
from splatax.backends.cpu import library as native


class Version(ctypes.Structure):  # these four: xla/ffi/api/c_api.h
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("extension", ctypes.c_void_p),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    ]


class Metadata(ctypes.Structure):
    _fields_ = [("size", ctypes.c_size_t), ("version", Version)]


class Extension(ctypes.Structure):
    _fields_ = [
        ("size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
        ("metadata", ctypes.POINTER(Metadata)),
    ]


class Frame(ctypes.Structure):
    _fields_ = [("size", ctypes.c_size_t), ("extension", ctypes.POINTER(Extension))]


@ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(Frame))
def newer(frame):
    version = frame.contents.extension.contents.metadata.contents.version
    version.major, version.minor = 0, 99


real = native.library
native.library = lambda instructions: SimpleNamespace(
    splatax_best_instructions=real(native.CHOICE).splatax_best_instructions, splatax_rasterize_forward=newer
)
"""


def run(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_a_library_for_a_newer_xla_makes_its_backend_unavailable_and_leaves_jax_alone():
    printed = run(
        NEWER + "print(backends.resolve().name)\n"
        "print(backends.why_unavailable('cpu'))\n"
        "print(jnp.arange(3).sum())\n"
    )
    chosen, reason, total = printed.splitlines()
    assert chosen == "xla"
    assert "does not accept the native library" in reason
    assert "Update jax, or install splatax again" in reason
    assert "(0.99)" in reason
    assert total == "3"


@pytest.mark.slow
def test_a_library_for_a_newer_xla_that_is_called_before_anything_else_leaves_jax_alone():
    printed = run(
        NEWER + "try:\n"
        "    native.register('baseline', 'splatax_rasterize_forward')\n"
        "except Exception as error:\n"
        "    print(type(error).__name__)\n"
        "print(jnp.arange(3).sum())\n"
    )
    assert printed.splitlines() == ["JaxRuntimeError", "3"]


@pytest.mark.skipif(
    not (shutil.which("cmake") and shutil.which("c++")), reason="needs CMake and a C++ compiler"
)
@pytest.mark.parametrize(("version", "options"), [("0.3", []), ("0.99", ["-DSPLATAX_NEWER_JAXLIB=ON"])])
def test_headers_of_a_supported_jaxlib_or_ones_asked_for_are_accepted(tmp_path, version, options):
    assert configure(tmp_path, version, options).returncode == 0


@pytest.mark.skipif(
    not (shutil.which("cmake") and shutil.which("c++")), reason="needs CMake and a C++ compiler"
)
def test_headers_newer_than_the_oldest_supported_jaxlib_are_refused(tmp_path):
    done = configure(tmp_path, "0.99", [])
    assert done.returncode != 0
    said = " ".join(done.stderr.split())
    assert "have version 0.99 of XLA's interface" in said
    assert "SPLATAX_NEWER_JAXLIB=ON" in said


def configure(folder: Path, version: str, options: list[str]) -> subprocess.CompletedProcess:
    """Configures the native library with the headers of a jaxlib that is nothing but a version."""
    header = folder / "jaxlib" / "include" / "xla" / "ffi" / "api" / "c_api.h"
    header.parent.mkdir(parents=True)
    (folder / "jaxlib" / "__init__.py").touch()
    major, minor = version.split(".")
    header.write_text(f"#define XLA_FFI_API_MAJOR {major}\n#define XLA_FFI_API_MINOR {minor}\n")
    return subprocess.run(
        ["cmake", "-S", ROOT, "-B", folder / "build", f"-DPython_EXECUTABLE={sys.executable}", *options],
        env=os.environ | {"PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
