"""The names that `import splatax` gives, the time that it takes, and the packages that it needs."""

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

import splatax as sx
from splatax.packages import MissingPackageError, required_by

SOURCE = Path(sx.__file__)
ROOT = SOURCE.parents[2]
MINIMAL = Path(__file__).with_name("minimal.py")
NOT_NEEDED = (
    "PIL",
    "av",
    "jinja2",
    "matplotlib",
    "pycolmap",
    "rich",
    "skimage",
    "tyro",
    "viser",
    "zstandard",
)


def run(*arguments: str | Path) -> str:
    done = subprocess.run(
        [sys.executable, *map(str, arguments)],
        env=os.environ | {"JAX_PLATFORMS": "cpu", "PYTHONPATH": str(ROOT / "src")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_type_checkers_see_the_names_that_exist():
    (block,) = [node for node in ast.parse(SOURCE.read_text()).body if isinstance(node, ast.If)]
    seen = {
        alias.asname: f"{node.module}.{alias.name}"
        for node in ast.walk(ast.Module(block.body, []))
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }
    names = {name: f"splatax.{home}.{name}" for name, home in sx.HOMES.items()}
    modules = {name: f"splatax.{home}" for name, home in sx.SUBMODULES.items()}
    assert seen == names | modules


@pytest.mark.parametrize("name", sorted(sx.HOMES))
def test_a_public_name_is_what_its_module_defines(name):
    assert getattr(sx, name) is getattr(importlib.import_module(f"splatax.{sx.HOMES[name]}"), name)


@pytest.mark.slow
def test_submodules_are_reached_without_importing_them():
    printed = run("-c", "import splatax as sx\nfor name in sx.SUBMODULES: print(getattr(sx, name).__name__)")
    assert printed.split() == [f"splatax.{home}" for home in sx.SUBMODULES.values()]


def test_editors_are_offered_public_names_alone():
    assert set(dir(sx)) == {*sx.HOMES, *sx.SUBMODULES, "__version__"}


def test_a_name_that_does_not_exist_is_an_attribute_error():
    with pytest.raises(AttributeError, match="module 'splatax' has no attribute 'rendr'"):
        _ = sx.rendr
    assert not hasattr(sx, "rendr")


@pytest.mark.slow
def test_importing_takes_under_600_ms_beyond_jax_and_so_does_the_renderer():
    code = (
        "import time, jax\nstart = time.process_time()\nimport splatax as sx\n"
        "sx.render, sx.Gaussians, sx.Camera\nprint(time.process_time() - start)"
    )
    fastest = min(float(run("-c", code)) for _ in range(3))  # of CPU; other processes only ever add
    assert fastest < 0.6


def test_a_missing_package_is_named_by_what_pip_calls_it():
    with (
        pytest.raises(MissingPackageError, match=r"^drawing needs the package pillow.*: pip install pillow$"),
        required_by("drawing"),
    ):
        raise ModuleNotFoundError("No module named 'PIL'", name="PIL.Image")


def test_a_module_of_splatax_that_is_missing_is_no_missing_package():
    with pytest.raises(ModuleNotFoundError), required_by("drawing"):
        raise ModuleNotFoundError("No module named 'splatax.nothing'", name="splatax.nothing")


@pytest.mark.slow
def test_the_renderer_needs_jax_optax_jaxtyping_and_numpy_alone():
    """Other packages are blocked here; tests/test_packaging.py has an environment without them."""
    run(
        "-c",
        f"""
import runpy, sys

class Blocked:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {NOT_NEEDED}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Blocked())
runpy.run_path({str(MINIMAL)!r})
""",
    )
