"""The examples of the documentation, at a tiny size."""

import runpy
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mujoco")
DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.slow
def test_a_controller_that_sees_pictures_alone_brings_the_arm_near_its_goal():
    example = runpy.run_path(str(DOCS / "servo_twin.py"))
    first, *_, last = example["servo"](size=32, count=500, steps=12)
    apart = [np.abs(step.joints - example["GOAL"]).max() for step in (first, last)]
    assert apart[1] < 0.3 * apart[0]
    assert last.image_error < 0.5 * first.image_error
