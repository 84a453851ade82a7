"""`make gpu-check` is complete: all of its checks pass on an emulated GPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

import emulated

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(emulated.why_unavailable() is not None, reason=str(emulated.why_unavailable())),
]


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
    assert {"render", "rasterize F+B", "training step"} <= set(scene)
    assert {"blend_3", "project_gradient"} <= set(scene["kernels of a training step"])
    assert "counted" not in scene["render"]  # what is counted for a GPU is not compared with an emulation
