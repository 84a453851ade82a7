"""Installed packages: a wheel with the native library, or one without if it cannot be built."""

import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

ROOT = Path(__file__).parents[1]
COMPILERS = ("c++", "g++", "clang++", "cc", "gcc", "clang", "cl")
OLDEST = re.search(r'"jaxlib==([0-9.]+)"', (ROOT / "pyproject.toml").read_text())[1]
SINGLE_PRECISION = {"rtol": 1e-5, "atol": 1e-5}  # XLA may add in another order around the same kernels
pytestmark = pytest.mark.slow


def run(*command, **environment):
    done = subprocess.run(
        [str(part) for part in command],
        env=os.environ | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def pip(*arguments, **environment):
    """Skips where the registry cannot be reached, except in continuous integration, which must reach it."""
    try:
        return run(sys.executable, "-m", "pip", *arguments, **environment)
    except AssertionError as error:
        offline = re.search(r"NewConnectionError|NameResolutionError|ProxyError|Read timed out", str(error))
        if offline and not os.environ.get("CI"):
            pytest.skip(f"pip cannot reach a package registry: {offline[0]}")
        raise


def path_without_compilers(folder) -> str:
    """A PATH with links to all programs but compilers."""
    folder.mkdir()
    for place in os.environ["PATH"].split(os.pathsep):
        for program in Path(place).glob("*") if Path(place).is_dir() else ():
            stem = program.name.rsplit("-", 1)[0] if program.name[-1].isdigit() else program.name
            known = any(stem == name or stem.endswith(f"-{name}") for name in COMPILERS)
            if not known and not (folder / program.name).exists() and os.access(program, os.X_OK):
                (folder / program.name).symlink_to(program)
    return str(folder)


def build_wheel(folder, *options, **environment) -> Path:
    pip("wheel", ROOT, "--no-deps", "--wheel-dir", folder, *options, **environment)
    (wheel,) = folder.glob("*.whl")
    return wheel


def environment_with(folder, *packages, **environment) -> Path:
    """A virtual environment with these packages alone; returns its folder of programs."""
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    programs = folder / "bin"
    pip("--python", programs / "python", "install", "--quiet", "--no-compile", *packages, **environment)
    return programs


def libraries_in(wheel) -> list[str]:
    return [
        name
        for name in zipfile.ZipFile(wheel).namelist()
        if name.startswith("splatax/backends/cpu/libsplatax")
    ]


def files_for_cuda(wheel) -> set[str]:
    folder = "splatax/backends/cuda/"
    names = zipfile.ZipFile(wheel).namelist()
    return {name.removeprefix(folder) for name in names if name.startswith(folder)}


@pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler to build the wheel with")
def test_one_wheel_runs_without_a_compiler_and_on_the_oldest_and_the_newest_jax(tmp_path):
    # For one instruction set and with little optimization, to build a fifth as long.
    quickly = ("SPLATAX_BUILDS=baseline", "CMAKE_CXX_FLAGS_RELEASE=-O1")
    wheel = build_wheel(tmp_path / "wheel", *(f"--config-settings=cmake.define.{each}" for each in quickly))
    assert "-py3-none-" in wheel.name
    assert {Path(name).stem for name in libraries_in(wheel)} == {
        "libsplatax_baseline",
        "libsplatax_instructions",
    }
    if sys.platform == "linux":
        assert {"libsplatax_cuda.so", "kernels/kernels.cu", "kernels/blending.cuh"} <= files_for_cuda(wheel)

    quick = {"JAX_PLATFORMS": "cpu", "JAX_DISABLE_MOST_OPTIMIZATIONS": "1", "PYTHONPATH": ""}
    path = path_without_compilers(tmp_path / "programs")
    complete = environment_with(tmp_path / "complete", wheel, PATH=path)
    printed = run(complete / "splatax", "doctor", PATH=path, **quick)
    assert " available" in next(line for line in printed.splitlines() if " cpu-baseline " in line)

    oldest = environment_with(
        tmp_path / "oldest", f"jax=={OLDEST}", f"jaxlib=={OLDEST}", "optax", "jaxtyping", "numpy"
    )
    pip("--python", oldest / "python", "install", "--quiet", "--no-deps", wheel)
    results = []
    for programs, *word in ((oldest,), (complete, "complete")):  # pip has given the latter the newest jax
        arrays = tmp_path / f"{len(results)}.npz"
        run(programs / "python", Path(__file__).with_name("minimal.py"), arrays, *word, **quick)
        results.append(list(np.load(arrays).values()))
    for oldest, newest in zip(*results, strict=True):
        assert_allclose(oldest, newest, **SINGLE_PRECISION)


def test_an_install_without_a_compiler_succeeds_without_the_library(tmp_path):
    path = path_without_compilers(tmp_path / "programs")
    wheel = build_wheel(tmp_path / "wheel", PATH=path, CC="", CXX="")
    assert wheel.name.endswith("-py3-none-any.whl")
    assert not libraries_in(wheel)
