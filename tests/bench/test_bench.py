"""The stopwatch, and the scenes that it times."""

import numpy as np
import pytest

import splatax as sx
from scenes import random_gaussians
from splatax.bench import timing
from splatax.bench.scenes import framed, procedural


def test_operations_are_timed_in_turn():
    calls = []
    operations = {name: (lambda name=name: calls.append(name)) for name in "ab"}
    *_, _last = timing.interleaved(operations, rounds=2)
    assert "".join(calls) == "ababab"


def test_medians_and_minima_leave_the_first_call_out(monkeypatch):
    durations = iter([100.0, 3.0, 1.0, 8.0])
    monkeypatch.setattr(timing, "timed", lambda operation: next(durations))
    *_, last = timing.interleaved({"a": lambda: None}, rounds=3)
    assert last["a"] == timing.Timing(median=3.0, minimum=1.0, first=100.0)


@pytest.mark.parametrize("count", [2_000, 20_000])
def test_procedural_scenes_fill_the_image_with_as_many_layers(count):
    scene = procedural(count, (84, 63))
    assert len(scene.gaussians) == count
    splats = sx.project(scene.gaussians, scene.camera)
    assert float((splats.extents[:, 0] > 0).mean()) > 0.85
    assert float(sx.render(scene.gaussians, scene.camera).alpha.mean()) > 0.9
    area = np.pi / 9 * float((splats.extents[:, 0] * splats.extents[:, 1]).sum())  # of 1-sigma boxes
    assert 3 < area / (84 * 63) < 40


def test_a_whole_scene_is_in_view():
    gaussians = random_gaussians(n=500, degree=0)
    scene = framed("cloud", gaussians, 1.0, (64, 48))
    splats = sx.project(gaussians, scene.camera)
    assert float((splats.extents[:, 0] > 0).mean()) > 0.95
    assert np.all(np.asarray(splats.means2d).mean(axis=0) == pytest.approx((32, 24), abs=4))
