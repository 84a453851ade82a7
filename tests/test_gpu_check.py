"""`make gpu-check` is complete: all of its checks pass on an emulated GPU, whatever other programs do."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

import emulated
from gpu_check import others, speed
from gpu_check.plan import REHEARSAL

SPLAX = """
import jax.numpy as jnp

def render(means3d, scales, quats, colors, opacities, *, viewmat, background, img_shape, f, c=None):
    n = len(means3d)
    assert (means3d.shape, scales.shape, quats.shape, colors.shape) == ((n, 3), (n, 3), (n, 4), (n, 3))
    assert opacities.shape == {shape} and viewmat.shape == (4, 4) and background.shape == (3,)
    assert isinstance(f[0], float) and isinstance(c[1], float)
    weight = jnp.sum(opacities) + jnp.sum(means3d) + jnp.sum(scales) + jnp.sum(quats)
    return jnp.zeros((*img_shape, 3)) + jnp.sum(colors, axis=0) * weight, None
"""


@pytest.mark.slow
@pytest.mark.skipif(emulated.why_unavailable() is not None, reason=str(emulated.why_unavailable()))
def test_every_check_passes_in_a_rehearsal(tmp_path):
    folder = Path(__file__).parent
    paths = f"{folder.parent / 'src'}:{folder}"
    command = [sys.executable, "-m", "gpu_check", "--out", tmp_path]
    environment = {**os.environ, "PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run(
        [str(part) for part in command], env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout[-4000:] + done.stderr[-2000:]
    results = json.loads((tmp_path / "gpu-check.json").read_text())
    assert results.pop("emulated") is True
    assert len(results) == 9
    assert all(result["passed"] for result in results.values())
    (scene,) = (value for value in results["scenes"].values() if isinstance(value, dict))
    assert set(scene) >= {"render", "rasterize F+B", "Adam", "training step"}
    assert scene["Adam"]["of the copy bandwidth"] > 0
    assert set(scene["kernels of a training step"]) >= {"blend_3", "project_gradient", "move_rows"}
    assert all(part["total"] > 0 for part in scene["parts of a training step"].values())
    assert "counted" not in scene["render"]  # what is counted for a GPU is not compared with an emulation
    assert results["other programs"]["splax"] == results["other programs"]["gsplat"] == "it needs a GPU"


def test_every_kernel_belongs_to_a_part_of_a_training_step():
    entries = (emulated.NATIVE / "emulation" / "entries.inc").read_text()
    names = re.findall(r"ENTRY\((\w+)\)", entries)
    assert len(names) > 20
    totals = speed.parts({name: {"total": 1.0} for name in names})
    assert sum(part["total"] for part in totals.values()) == len(names)
    assert set(totals) == set(speed.PARTS)
    assert totals["projection"] == totals["Adam"] == {"total": 1.0}


def test_a_scene_that_fails_does_not_hide_the_others(monkeypatch):
    def scene(plan, count):
        if count == 2:
            raise MemoryError("too large")
        return {"render": {"median": 1.0}}

    monkeypatch.setattr(speed, "scene", scene)
    found = speed.scenes(replace(REHEARSAL, counts=(1, 2, 3)))
    assert found["passed"] is False
    assert found["1"] == found["3"] == {"render": {"median": 1.0}}
    assert "too large" in found["2"]["error"]


# --- other programs ---


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Makes a package of this name out of a text."""

    def of(name, text):
        (tmp_path / f"{name}.py").write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))

    return of


def test_a_program_that_is_not_installed_is_named():
    if "not installed" not in str(found := others.measured("gsplat", REHEARSAL)):
        pytest.skip("gsplat is installed here")
    assert re.fullmatch("not installed: .*gsplat", found)


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["(n,)", "(n, 1)"])
def test_both_interfaces_of_splax_are_timed(installed, monkeypatch, shape):
    monkeypatch.setattr(others, "MOST_SECONDS", 600)  # on a busy machine
    installed("splax", SPLAX.replace("{shape}", shape))
    found = others.measured("splax", replace(REHEARSAL, counts=(30,)))
    assert set(found) == {"30"}, found
    assert all(times["render"] > 0 and times["render F+B"] > 0 for times in found.values())


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("raise ImportError('no warp')", "ended with 1: .*no warp"),
        pytest.param("render = None", "ended with 1: .*TypeError", marks=pytest.mark.slow),
        pytest.param("import os\nos.abort()", "ended with -6", marks=pytest.mark.slow),
    ],
)
def test_a_broken_program_is_reported_in_a_line_and_fails_nothing(installed, monkeypatch, text, told):
    monkeypatch.setattr(others, "MOST_SECONDS", 600)  # on a busy machine
    installed("splax", text)
    found = others.measured("splax", REHEARSAL)
    assert set(found) == {"not measured"}
    assert re.match(told, found["not measured"])
    assert "\n" not in found["not measured"]


def test_a_program_that_takes_too_long_is_stopped(installed, monkeypatch):
    monkeypatch.setattr(others, "MOST_SECONDS", 1)
    installed("splax", "import time\ntime.sleep(60)")
    assert others.measured("splax", REHEARSAL)["not measured"].startswith("stopped after 1 s")
