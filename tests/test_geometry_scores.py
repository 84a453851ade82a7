"""Errors of depth and normals of a wall whose position is known."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import splatax as sx
from splatax.dataset import TrueGeometry
from splatax.errors import DatasetError
from splatax.geometry_scores import (
    DEPTH,
    DEPTHS,
    DepthError,
    GeometryScore,
    GeometryScores,
    against_truth,
    as_json,
    best_depth,
    depth_error,
    evaluate_geometry,
    median_angle,
)

SIDE, WALL = 24, 3.0
CAMERA = sx.Camera.simple_pinhole(30.0, jnp.eye(4), SIDE, SIDE)


@pytest.fixture(scope="module")
def wall():
    """Flat, nearly opaque Gaussians on the plane z = 3, which reach beyond the image."""
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-1.6, 1.6, 33)] * 2))
    n = len(x)
    return sx.Gaussians(
        means=jnp.asarray(np.stack([x, y, np.full(n, WALL)], axis=1), jnp.float32),
        log_scales=jnp.broadcast_to(jnp.log(jnp.array([0.08, 0.08, 1e-4])), (n, 3)),
        quats=jnp.broadcast_to(jnp.array([1.0, 0, 0, 0]), (n, 4)),
        opacity_logits=jnp.full(n, 4.0),
        sh=jnp.zeros((n, 1, 3)),
    )


def view(truth=None, landmarks=None, mask=None):
    blank = np.zeros((SIDE, SIDE, 3), np.uint8)
    return sx.View("wall.png", CAMERA, lambda: blank, mask=mask, landmarks=landmarks, truth=truth)


def known(depth, normal=None, size=SIDE):
    normals = None if normal is None else np.broadcast_to(np.float32(normal), (size, size, 3))
    return lambda: TrueGeometry(np.full((size, size), depth), normals)


def test_depth_and_normals_of_a_wall_are_right(wall):
    scores = evaluate_geometry(wall, [view(known(WALL, (0, 0, -1)))])
    assert scores.reference == "truth"
    assert scores.mean.depths.keys() == set(DEPTHS)
    assert all(error.median < 1e-3 for error in scores.mean.depths.values())
    assert scores.mean.normals < 0.1
    assert scores.mean.coverage == 1


def test_a_scene_behind_the_truth_has_a_positive_bias_and_a_relative_error(wall):
    mean = against_truth(wall, view(known(2.5, (0, 0.6, -0.8), size=2 * SIDE)))
    for error in mean.depths.values():
        assert error == pytest.approx((0.5, 0.5, 0.2, 0.05), abs=1e-3)
    assert mean.normals == pytest.approx(np.degrees(np.arctan2(0.6, 0.8)), abs=0.1)
    assert against_truth(wall, view(known(4.0))).depths[DEPTH].bias == pytest.approx(-1, abs=1e-3)


def test_pixels_without_truth_or_outside_the_mask_do_not_count(wall):
    depth = np.full((SIDE, SIDE), WALL)
    depth[:, :6], depth[:, 6:12] = 0, 9.0
    mask = np.ones((SIDE, SIDE), bool)
    mask[:, 6:12] = False
    found = against_truth(wall, view(lambda: TrueGeometry(depth), mask=lambda: mask))
    assert found.depths[DEPTH].median < 1e-3
    assert found.normals is None


def test_pixels_that_the_scene_leaves_open_lower_the_coverage_alone(wall):
    half = replace(wall, opacity_logits=jnp.where(wall.means[:, 0] < 0, 4.0, -9.0))
    found = against_truth(half, view(known(WALL)))
    assert found.depths[DEPTH].median < 1e-3
    assert found.coverage == pytest.approx(0.5, abs=0.05)


def test_without_truth_the_landmarks_are_compared(wall):
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (40, 2)), np.full(40, 2.9)]).astype(np.float32)
    beside = np.float32([[50, 0, 2], [0, 0, -1]])
    some = evaluate_geometry(
        wall, [view(landmarks=lambda: np.concatenate([points, beside])), view(landmarks=lambda: beside[:0])]
    )
    assert some.reference == "points"
    assert len(some.views) == 1
    assert some.mean.depths[DEPTH].bias == pytest.approx(0.1, abs=1e-3)
    assert set(as_json(some)["protocol"]) == {"points", "depth"}
    assert evaluate_geometry(wall, [view()]) is None


def test_truth_of_other_proportions_is_refused(wall):
    with pytest.raises(DatasetError, match=r"wall\.png: its true depth has 24 x 12 pixels.*proportions"):
        against_truth(wall, view(lambda: TrueGeometry(np.ones((12, 24)))))


def test_means_leave_out_views_without_a_measure_and_json_has_no_nan():
    nothing = depth_error(np.zeros(3), np.ones(3))
    seen = dict.fromkeys(DEPTHS, DepthError(0.2, -0.1, 0.05, 0.03))
    blind = GeometryScore("blind", dict.fromkeys(DEPTHS, nothing), 0.0)
    scores = GeometryScores("truth", (GeometryScore("a", seen, 1.0, 4.0), blind))
    assert scores.mean == GeometryScore("mean", seen, 0.5, 4.0)
    missing = {"error": None, "bias": None, "relative_error": None, "capped_error": None}
    assert as_json(scores)["views"][1] == {
        "name": "blind",
        "depth": dict.fromkeys(DEPTHS, missing),
        "coverage": 0,
    }


def test_a_depth_that_misses_a_thin_part_has_the_better_median_and_the_worse_mean():
    expected = np.full(100, 2.0)
    smooth, sharp = expected * 1.001, expected * 1.004
    smooth[:9] = 3.0  # the wall behind a rod that fills 9 of 100 pixels
    missed, kept = depth_error(smooth, expected), depth_error(sharp, expected)
    assert missed.relative < kept.relative
    assert missed.capped == pytest.approx(0.09 * 0.05 + 0.91 * 0.001)
    assert kept.capped == pytest.approx(0.004)


def scores_of(errors):
    """Scores of a view, from medians and capped means by output."""
    depths = {name: DepthError(median, 0.0, median, capped) for name, (median, capped) in errors.items()}
    return GeometryScores("points", (GeometryScore("a", depths, 1.0),))


def test_the_best_depth_of_a_scene_on_surfaces_keeps_thin_parts(wall):
    smooth, sharp = DEPTHS[1:]
    thin = {DEPTH: (0.3, 0.001), smooth: (0.1, 0.03), sharp: (0.2, 0.02)}
    assert scores_of(thin).best == sharp
    assert scores_of(thin | {smooth: (0.1, 0.01)}).best == smooth
    assert scores_of(thin | {DEPTH: (0.05, 0.05)}).best == DEPTH
    assert scores_of(thin | {smooth: (np.nan, np.nan)}).best == sharp
    assert best_depth(wall, [view()]) is None
    points = np.float32([[0, 0, WALL], [0.2, 0.1, WALL]])
    assert best_depth(wall, [view(landmarks=lambda: points)] * 3) == DEPTH


def test_angles_are_those_between_directions_also_when_small():
    a, b = (np.zeros((1, 2, 3)) for _ in range(2))
    a[0, :], b[0, :] = (0, 0, 1), (0, np.sin(1e-4), np.cos(1e-4))
    assert median_angle(a, b, np.ones((1, 2), bool)) == pytest.approx(np.degrees(1e-4), rel=1e-6)
    assert median_angle(a, 0 * b, np.ones((1, 2), bool)) is None
