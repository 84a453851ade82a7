"""What users install: a wheel with the native library, or one without where nothing can build it."""

import os
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
COMPILERS = ("c++", "g++", "clang++", "cc", "gcc", "clang", "cl")
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


def build_wheel(folder, **environment) -> Path:
    run(sys.executable, "-m", "pip", "wheel", ROOT, "--no-deps", "--wheel-dir", folder, **environment)
    (wheel,) = folder.glob("*.whl")
    return wheel


def libraries_in(wheel) -> list[str]:
    return [name for name in zipfile.ZipFile(wheel).namelist() if name.startswith("splatax/backends/cpu/lib")]


@pytest.mark.skipif(shutil.which("c++") is None, reason="no C++ compiler to build the wheel with")
def test_a_wheel_runs_where_there_is_no_compiler(tmp_path):
    wheel = build_wheel(tmp_path / "wheel")
    assert "-py3-none-" in wheel.name
    assert any("baseline" in name for name in libraries_in(wheel))
    run(sys.executable, "-m", "venv", tmp_path / "venv")
    python = tmp_path / "venv" / "bin" / "python"
    path = path_without_compilers(tmp_path / "programs")
    run(python, "-m", "pip", "install", "--quiet", wheel, PATH=path)
    printed = run(tmp_path / "venv" / "bin" / "splatax", "doctor", PATH=path, JAX_PLATFORMS="cpu")
    assert "chosen by auto" in next(line for line in printed.splitlines() if " cpu " in line)


def test_an_install_without_a_compiler_succeeds_without_the_library(tmp_path):
    path = path_without_compilers(tmp_path / "programs")
    wheel = build_wheel(tmp_path / "wheel", PATH=path, CC="", CXX="")
    assert wheel.name.endswith("-py3-none-any.whl")
    assert not libraries_in(wheel)
