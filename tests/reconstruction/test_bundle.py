"""Cameras adjusted to matched features: wrong ones are corrected, right ones and the world stay."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_triangulation import view

import corner
from splatax.cameras import from_colmap
from splatax.cameras.geometry import seen_at
from splatax.cameras.lenses import FTheta, OpenCV, Pinhole, opencv
from splatax.io.datasets.colmap_writing import model_of_cameras
from splatax.math import rigid
from splatax.reconstruction import bundle, mapping, pipeline, triangulation
from splatax.reconstruction.adjusting import leave_out_large_features
from splatax.reconstruction.bundle import Adjustment, adjusted_cameras
from splatax.reconstruction.calibration import Correction, adjustable, alike, corrected, correction_to
from splatax.reconstruction.similarity import similarity_of_cameras

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


def with_focals(views, factors):
    return [
        replace(each, camera=replace(each.camera, fx=each.camera.fx * factor, fy=each.camera.fy * factor))
        for each, factor in zip(views, factors, strict=True)
    ]


def assert_same(lens, other):
    assert type(lens) is type(other)
    for a, b in zip(jax.tree.leaves(lens), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b)


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
    outcome = adjusted_cameras(wrong, watch=lambda *stage: told.append(stage))
    assert outcome.helps
    assert apart(wrong, views) > 1
    assert outcome.after < 0.1 * outcome.before
    # Five poses at random say where the world is no better than this.
    assert apart(outcome.views, views) < 0.65 * apart(wrong, views)
    assert 0.5 < outcome.motion < 4
    assert str(outcome).startswith("cameras adjusted to ")
    assert [v.name for v in outcome.views] == [v.name for v in views]
    assert list(dict.fromkeys(stage for stage, _, _ in told)) == list(bundle.STAGES)


def test_right_poses_stay_bit_for_bit(views):
    outcome = adjusted_cameras(views)
    assert not outcome.helps
    assert outcome.observations > 500
    assert all(a is b for a, b in zip(outcome.views, views, strict=True))
    assert "given cameras kept, as adjusting them does not help" in str(outcome)


def test_photos_without_matches_keep_their_poses(views):
    plain = np.full((*corner.SIZE[::-1], 3), 90, np.uint8)
    outcome = adjusted_cameras([replace(each, pixels=lambda: plain) for each in views[:2]])
    assert outcome == Adjustment(outcome.views, outcome.views, {})
    assert "too few features match" in str(outcome)


@pytest.mark.slow
def test_lenses_that_were_set_to_zero_come_back_each_for_its_own_photos():
    paper, lenses = corner.wallpaper(), [opencv(-0.2, 0.05), opencv(0.1)]
    true = [view(i, at, paper, lenses[i % 2]) for i, at in enumerate(corner.positions())]
    # The principal points differ too, or all photos would seem to have one lens.
    zeroed = [
        replace(v, camera=replace(v.camera, lens=opencv(), cx=v.camera.cx + 0.01 * (i % 2)))
        for i, v in enumerate(true)
    ]
    outcome = adjusted_cameras(zeroed, "poses+distortion")
    assert outcome.helps
    assert outcome.after < 0.4 * outcome.before
    for i, k1 in enumerate((-0.2, 0.1)):
        lens = outcome.views[i].camera.lens
        assert isinstance(lens, OpenCV)
        assert_same(lens, outcome.views[i + 2].camera.lens)
        np.testing.assert_allclose(lens.radials[0], k1, atol=0.015)
    assert apart(zeroed, true) > 1.0
    assert apart(outcome.views, true) < 0.5
    for ours, truth in zip(outcome.views, true, strict=True):
        np.testing.assert_allclose(ours.camera.position, truth.camera.position, atol=0.02)
    held_out = replace(zeroed[1], name="held-out.jpg")
    (again,) = corrected([held_out], outcome.lenses_of([held_out]))
    assert_same(again.camera.lens, outcome.views[1].camera.lens)
    np.testing.assert_array_equal(again.camera.cam_from_world, held_out.camera.cam_from_world)
    assert "; 2 lenses, focal lengths times 1.0000 to 1.0000" in str(outcome)


@pytest.mark.parametrize(("small", "left"), [(6, 6), (2, 10)])
def test_large_features_are_left_out_where_a_photo_has_enough_small_ones(views, tmp_path, small, left):
    pycolmap = pytest.importorskip("pycolmap")
    model = model_of_cameras([(v.name, v.camera) for v in views[:2]])
    places = np.random.default_rng(0).uniform(20, 280, (10, 2))
    scales = np.where(np.arange(10) < small, 1.0, 5.0)  # a diagonal of 500 pixels allows 2
    with mapping.opened(tmp_path / triangulation.DATABASE) as database:
        triangulation.register(database, model)
        for number, image in model.images.items():
            keypoints = np.column_stack([places, scales, np.zeros(10)])
            database.write_keypoints(number, keypoints.astype(np.float32))
            image.points2D = pycolmap.Point2DList([pycolmap.Point2D(place) for place in places])
    for i in range(10):
        track = pycolmap.Track([pycolmap.TrackElement(number, i) for number in model.images])
        model.add_point3D(np.array([i, 0.0, 6.0]), track)
    leave_out_large_features(model, tmp_path)
    assert model.compute_num_observations() == 2 * left


def test_each_photo_with_a_lens_of_its_own_gets_its_focal_length(views):
    factors = [0.97, 1.02, 0.99, 1.03, 0.985]
    wrong = with_focals(views, factors)
    outcome = adjusted_cameras(wrong, "poses+focal")
    assert outcome.helps
    found = [float(v.camera.fx) / corner.FOCAL for v in outcome.views]
    # A common factor is hardly seen in five photos of two walls.
    assert np.std(found) < 0.3 * np.std(factors)
    assert all(v.camera.fx == v.camera.fy and isinstance(v.camera.lens, Pinhole) for v in outcome.views)


def test_lenses_that_colmap_does_not_have_stay_as_given(views):
    lens = FTheta(jnp.array([1.0, 0, 0, 0]), jnp.float32(1.0))
    strange = [replace(v, camera=replace(v.camera, lens=lens)) for v in views]
    assert adjusted_cameras(strange).views == tuple(strange)


@pytest.mark.parametrize(
    ("lens", "fy", "focal_model", "lens_model"),
    [
        (Pinhole(), 380, "SIMPLE_PINHOLE", "RADIAL"),
        (Pinhole(), 381, "PINHOLE", "OPENCV"),
        (opencv(), 380, "SIMPLE_PINHOLE", "RADIAL"),
        (opencv(0.1), 380, "RADIAL", "RADIAL"),
        (opencv(0.1), 381, "OPENCV", "OPENCV"),
        (opencv(0.1, 0.0, 0.01), 380, "OPENCV", "OPENCV"),
        (opencv(0.1, 0.0, 0.0, 0.0, 0.02), 380, "FULL_OPENCV", "FULL_OPENCV"),
    ],
)
def test_a_lens_is_adjusted_in_the_smallest_model_that_holds_it(views, lens, fy, focal_model, lens_model):
    camera = replace(views[0].camera, lens=lens, fy=jnp.float32(fy))
    for free, model in (("poses+focal", focal_model), ("poses+lens", lens_model)):
        colmap = adjustable(camera, free)
        assert colmap.model.name == model
        again = correction_to(colmap, colmap)(camera)
        assert (again.fx, again.fy, again.cx, again.cy) == (camera.fx, camera.fy, camera.cx, camera.cy)
        before, after = (seen_at(c, corner_points())[0] for c in (camera, again))
        np.testing.assert_allclose(after, before, atol=1e-4)


def corner_points():
    return np.array([[0, 0, 6.0], [1, 0.5, 5], [-1, -0.7, 5.2]])


def test_a_correction_holds_for_photos_of_any_size(views):
    found = Correction((1.02, 1.02), "RADIAL", (-0.2, 0.05))
    camera = views[0].camera
    large, small = found(camera), found(camera.resized(200, 150))
    points = corner_points()
    np.testing.assert_allclose(seen_at(large, points)[0], 2 * seen_at(small, points)[0], rtol=1e-5)
    fisheye = Correction((1.0, 1.0), "OPENCV_FISHEYE", (0.1, 0.2, 0.3, 0.4))(camera)
    truth = from_colmap(
        "OPENCV_FISHEYE", [380.0, 380.0, 200.0, 150.0, 0.1, 0.2, 0.3, 0.4], 400, 300, jnp.eye(4)
    )
    assert_same(fisheye.lens, truth.lens)


def test_only_views_through_the_same_lens_are_corrected_alike(views):
    found = {views[0].name: Correction((1.02, 1.02), "PINHOLE", ())}
    other = with_focals(views[1:2], [1.5])
    assert alike(views[:1], found, [views[2], *other]) == {views[2].name: found[views[0].name]}


def test_a_world_that_was_moved_turned_and_scaled_comes_back_though_some_cameras_are_wrong():
    rng = np.random.default_rng(0)

    def poses(twists):
        moves = jax.vmap(rigid.exponential)(jnp.asarray(twists, jnp.float32))
        return np.asarray(moves, np.float64)[:, :3]

    source = poses(rng.normal(size=(20, 6)) * [1, 1, 1, 3, 2, 1])
    turn, scale, move = poses([[0.2, -0.4, 0.3, 0, 0, 0]])[0, :, :3], 1.7, np.array([1, -2, 0.5])
    centres = -np.einsum("nji,nj->ni", source[..., :3], source[..., 3])
    rotations = source[..., :3] @ turn.T
    translations = -np.einsum("nij,nj->ni", rotations, scale * centres @ turn.T + move)
    target = np.concatenate([rotations, translations[..., None]], axis=2)
    target[:3] = poses(rng.normal(size=(3, 6)))
    found = similarity_of_cameras(source, target)
    for ours, truth in zip(found, (scale, turn, move), strict=True):
        np.testing.assert_allclose(ours, truth, atol=0.02)
    scale, rotation, translation = similarity_of_cameras(source[:1], source[:1])
    np.testing.assert_allclose(scale, 1.0)
    np.testing.assert_allclose(np.column_stack([rotation, translation]), np.eye(4)[:3], atol=1e-5)
