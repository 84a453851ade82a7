"""The page about finding the camera of one photo finds it: pose, focal length and distortion."""

import runpy
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"


@pytest.mark.slow
def test_gauss_newton_on_one_photo_recovers_pose_focal_length_and_distortion():
    """The limits are ten times what rounding the photo to 8 bits leaves."""
    script = runpy.run_path(str(DOCS / "make_tracking.py"))
    names = script["names_of"](DOCS / "tracking.md")
    before, after = (script["errors_of"](names[camera], names) for camera in ("start", "camera"))
    assert before["pixels"] > 3
    assert after["pixels"] < 0.01
    assert after["rotation, mrad"] < 0.5
    assert after["position"] < 1e-3
    assert abs(after["focal length"]) < 1e-3
    assert abs(after["k1"]) < 0.01 * 0.15
    assert abs(after["k2"]) < 0.05 * 0.04
