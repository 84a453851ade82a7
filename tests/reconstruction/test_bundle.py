"""Poses adjusted to matched features: wrong ones come back, right ones stay, and the world stays in place."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from test_triangulation import view

import corner
from splatax.cameras.geometry import seen_at
from splatax.math import rigid
from splatax.reconstruction import bundle, pipeline, triangulation
from splatax.reconstruction.bundle import Adjustment, adjusted_poses

PHOTOS = 5


@pytest.fixture(autouse=True, scope="module")
def normal_features():
    """They are enough for the corner, in a fourth of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "VERY_FEW", 0)
        patch.setattr(triangulation, "SMALL", 0)
        yield


@pytest.fixture(scope="module")
def views():
    paper = corner.wallpaper()
    return [view(i, position, paper) for i, position in enumerate(corner.positions()[:PHOTOS])]


def turned(views, pixels, seed=0):
    """Views whose cameras are turned at random about their centres, by about so many pixels."""
    twists = np.random.default_rng(seed).normal(size=(len(views), 3))
    twists -= twists.mean(axis=0)
    twists *= pixels / corner.FOCAL / np.linalg.norm(twists[:, :2], axis=1).mean()
    return [
        replace(
            each,
            camera=replace(
                each.camera,
                cam_from_world=rigid.exponential(jnp.asarray([*twist, 0, 0, 0], jnp.float32))
                @ each.camera.cam_from_world,
            ),
        )
        for each, twist in zip(views, twists, strict=True)
    ]


def apart(views, truth):
    """Median distance between the places of points of the wall in both cameras, pixels."""
    x, y = np.meshgrid(np.linspace(-2, 2, 9), np.linspace(-1.5, 1.5, 7))
    wall = np.column_stack([x.ravel(), y.ravel(), 6 - 0.8 * np.abs(x.ravel())])
    return np.median(
        [
            np.linalg.norm(seen_at(a.camera, wall)[0] - seen_at(b.camera, wall)[0], axis=1)
            for a, b in zip(views, truth, strict=True)
        ]
    )


def test_wrong_poses_come_back_to_where_the_world_is(views):
    wrong, told = turned(views, 2.0), []
    outcome = adjusted_poses(wrong, watch=lambda *stage: told.append(stage))
    assert outcome.helps
    assert apart(wrong, views) > 1
    assert outcome.after < 0.1 * outcome.before
    # Five poses at random say where the world is no better than this.
    assert apart(outcome.views, views) < 0.65 * apart(wrong, views)
    assert 0.5 < outcome.motion < 4
    assert str(outcome).startswith("poses adjusted to ")
    assert [v.name for v in outcome.views] == [v.name for v in views]
    assert list(dict.fromkeys(stage for stage, _, _ in told)) == list(bundle.STAGES)


def test_right_poses_stay_bit_for_bit(views):
    outcome = adjusted_poses(views)
    assert not outcome.helps
    assert outcome.observations > 500
    assert all(a is b for a, b in zip(outcome.views, views, strict=True))
    assert "given poses kept, as adjusting them does not help" in str(outcome)


def test_photos_without_matches_keep_their_poses(views):
    plain = np.full((*corner.SIZE[::-1], 3), 90, np.uint8)
    outcome = adjusted_poses([replace(each, pixels=lambda: plain) for each in views[:2]])
    assert outcome == Adjustment(outcome.views, 0.0, 0.0, 0.0, 0)
    assert "too few features match" in str(outcome)


def test_a_world_that_was_moved_turned_and_scaled_comes_back():
    rng = np.random.default_rng(0)
    source = rng.normal(size=(200, 3)) * [3, 2, 1]
    move = np.eye(4)
    move[:3, :3] = 1.7 * np.asarray(rigid.exponential(jnp.array([0.2, -0.4, 0.3, 0, 0, 0])))[:3, :3]
    move[:3, 3] = 1, -2, 0.5
    target = source @ move[:3, :3].T + move[:3, 3]
    target[:10] += 5  # wrong matches
    rows = range(200)
    found = bundle._similarity(
        dict(zip(rows, source, strict=True)), dict(zip(rows, target, strict=True)), dict.fromkeys(rows, 4.0)
    )
    np.testing.assert_allclose(found, move, atol=0.2)
