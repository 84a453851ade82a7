"""The timing of operations, and the scenes that it times."""

import numpy as np
import pytest

import splatax as sx
from scenes import random_gaussians
from splatax.bench import operations, roofline, timing
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


def test_images_of_many_features_that_would_not_fit_in_memory_are_not_timed():
    assert operations.widths_for((504, 378)) == operations.widths_for((3840, 2160)) == (1, 16, 64)
    assert operations.widths_for((7680, 4320)) == (1, 16)


def test_a_whole_scene_is_in_view():
    gaussians = random_gaussians(n=500, degree=0)
    scene = framed("cloud", gaussians, 1.0, (64, 48))
    splats = sx.project(gaussians, scene.camera)
    assert float((splats.extents[:, 0] > 0).mean()) > 0.95
    assert np.all(np.asarray(splats.means2d).mean(axis=0) == pytest.approx((32, 24), abs=4))


def test_a_scene_without_harmonics_is_timed_with_as_many_numbers_as_in_training():
    gaussians = random_gaussians(n=50, degree=0)
    scene = framed("cloud", gaussians, 1.0, (64, 48))
    assert scene.gaussians.sh_degree == 3
    assert np.array_equal(
        sx.render(scene.gaussians, scene.camera).rgb, sx.render(gaussians, scene.camera).rgb
    )


def test_drawn_slots_are_those_of_the_blending_rule():
    scene = procedural(300, (40, 30))
    splats = sx.project(scene.gaussians, scene.camera)
    counted = roofline.slots(splats)
    if counted is None:
        pytest.skip("no native library here")
    y, x = np.mgrid[:30, :40] + 0.5
    transmittance, alive, drawn = np.ones((30, 40)), np.ones((30, 40), bool), 0
    for i in np.argsort(np.asarray(splats.depths), kind="stable"):
        if splats.extents[i, 0] <= 0:
            continue
        u, v, w = np.asarray(splats.sqrt_conics[i])
        dx, dy = x - float(splats.means2d[i, 0]), y - float(splats.means2d[i, 1])
        raw = float(splats.opacities[i]) * np.exp(-((u * dx + v * dy) ** 2 + (w * dy) ** 2) / 2)
        seen, left = alive & (raw >= 1 / 255), transmittance * (1 - np.minimum(raw, 0.99))
        alive &= ~(seen & (left < 1e-4))
        drawn += int((seen & alive).sum())
        transmittance = np.where(seen & alive, left, transmittance)
    assert counted.drawn == pytest.approx(drawn, rel=1e-3)
    assert counted.evaluated >= counted.drawn
    assert roofline.shortest("rasterize", counted, 33.0) == pytest.approx(counted.evaluated * 1e3)


def test_the_measured_peak_is_one_that_a_processor_can_have():
    flops = roofline.peak_flops()
    if flops is None:
        pytest.skip("no native library here")
    assert 1e8 < flops < 1e14  # a build with sanitizers is far from the processor's own peak
