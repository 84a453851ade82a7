"""Decision which photos are blurred: by what they show of the same points, not by what they show."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import ndimage

import splatax as sx
from splatax.inspection.blur import blurred, relative_details
from splatax.inspection.detail import RADIUS, seen_points
from splatax.inspection.looks import Look, joined, look_of

WIDTH, HEIGHT, SPACING, DISTANCE = 96, 72, 12, 100.0  # pixels, pixels, pixels between photos, world units
PHOTOS, PLAIN_FROM = 14, 140  # photos from left to right along a wall, which is plain from this pixel on
NAMES = [f"{i:02}" for i in range(PHOTOS)]
PLAIN = "13"


def camera_before(start):
    """A camera that shows a wall in the plane z = 0 from this pixel on: one unit is one pixel."""
    pose = jnp.eye(4).at[:3, 3].set(jnp.array([-start - WIDTH / 2, -HEIGHT / 2, DISTANCE]))
    return sx.Camera.simple_pinhole(DISTANCE, pose, WIDTH, HEIGHT)


def wall(contrast=15.0):
    """A picture of a wall with much detail on its left, and little on its right."""
    rough = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(HEIGHT, 260)), 0.7)
    return 128 + np.where(np.arange(260) < PLAIN_FROM, 120.0, contrast) * rough


def looks(wall, change=lambda photo: photo, changed=PLAIN):
    """Looks of photos along a wall, one of them changed."""
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform((0, 0), (260, HEIGHT), (2000, 2)), np.zeros(2000)])
    found = {}
    for i, name in enumerate(NAMES):
        photo = wall[:, i * SPACING : i * SPACING + WIDTH]
        levels = np.clip(np.round(change(photo) if name == changed else photo), 0, 255).astype(np.uint8)
        seen = seen_points(points, camera_before(i * SPACING), WIDTH, HEIGHT)
        found[name] = look_of(np.repeat(levels[..., None], 3, axis=2), seen)
    return found


def without_points(looks):
    return {name: replace(look, detail=None) for name, look in looks.items()}


def motion(pixels):
    return lambda photo: ndimage.uniform_filter1d(photo, pixels, axis=1)


def gaussian(pixels):
    return lambda photo: ndimage.gaussian_filter(photo, pixels)


def test_a_sharp_photo_of_a_plain_wall_is_not_blurred():
    sharp = looks(wall())
    assert PLAIN in blurred(without_points(sharp))  # as a whole, it has much less detail than the others
    assert blurred(sharp) == []
    assert relative_details(sharp)[PLAIN] == pytest.approx(0, abs=0.1)  # it shows the same pixels as others


@pytest.mark.parametrize("name", [PLAIN, "03"])
@pytest.mark.parametrize("change", [gaussian(1.5), gaussian(3), motion(5), motion(9)])
def test_a_blurred_photo_of_the_same_things_is_blurred(name, change):
    assert blurred(looks(wall(), change, name)) == [name]


def test_detail_at_points_does_not_depend_on_exposure():
    dark = looks(wall(), lambda photo: 0.5 * photo, "03")
    assert relative_details(dark)["03"] == pytest.approx(0, abs=0.1)
    assert blurred(dark) == []


def test_a_photo_that_shares_too_few_points_with_detail_is_not_called_blurred():
    flat = looks(wall(contrast=0.0))
    assert np.isnan(relative_details(flat)[PLAIN])
    assert blurred(flat) == []
    assert PLAIN in blurred(without_points(flat))


def test_a_point_seen_from_far_nearer_is_not_compared():
    sharp = looks(wall())
    detail = sharp["03"].detail
    nearer = {**sharp, "03": replace(sharp["03"], detail=replace(detail, scales=detail.scales + 1))}
    assert np.isnan(relative_details(nearer)["03"])
    assert np.isfinite(relative_details(sharp)["03"])


def test_without_points_only_photos_with_a_quarter_of_the_usual_sharpness_are_blurred():
    sharpness = {f"{i:02}": 100.0 + i for i in range(12)} | {"12": 40.0, "13": 15.0, "14": 3.0}
    assert blurred({name: Look(sharpness=level) for name, level in sharpness.items()}) == ["14", "13"]


def test_the_faces_of_a_photo_are_compared_as_one():
    sharp = looks(wall())
    left, right = sharp["02"], sharp["10"]
    both = joined([left, right]).detail
    seen = [np.isfinite(look.detail.contrasts) for look in (left, right)]
    np.testing.assert_array_equal(np.isfinite(both.contrasts), seen[0] | seen[1])
    np.testing.assert_array_equal(both.scales[seen[0]], left.detail.scales[seen[0]])
    np.testing.assert_array_equal(both.shades[~seen[0]], right.detail.shades[~seen[0]])


def test_points_in_white_parts_at_the_border_and_behind_others_are_not_measured():
    camera, white = camera_before(0), np.full((HEIGHT, WIDTH, 3), 255, np.uint8)
    points = np.array([[50.0, 30, 0], [2.0, 30, 0], [52.0, 24, 90], [20.0, 10, -10], [-5.0, 30, 0]])
    seen = seen_points(points, camera, WIDTH, HEIGHT)
    assert seen.indices.tolist() == [0, 1, 3]  # the third is behind the first, the last beside the photo
    assert seen.columns.tolist() == [50, 2, int(48 + (20 - 48) / 0.9)]
    grey = np.random.default_rng(0).integers(60, 200, white.shape, np.uint8)
    assert np.isfinite(look_of(grey, seen).detail.contrasts).tolist() == [True, False, False, True, False]
    assert RADIUS > 2
    assert np.isnan(look_of(white, seen).detail.contrasts).all()
    assert not len(seen_points(points, camera, HEIGHT, WIDTH).indices)  # a photo that was turned


@pytest.mark.slow
def test_no_photo_of_the_drawn_room_is_blurred_though_some_show_plain_walls():
    dataset = sx.demo_dataset(scene="room")

    def look(view, pixels):
        points, camera = dataset.points.positions, view.camera
        return look_of(pixels, seen_points(points, camera, camera.width, camera.height))

    found = {view.name: look(view, view.pixels()) for view in dataset.views}
    assert blurred(found) == []
    soft = dataset.views[5]
    pixels = ndimage.gaussian_filter(soft.pixels().astype(np.float32), (2, 2, 0))
    assert blurred({**found, soft.name: look(soft, np.round(pixels).astype(np.uint8))}) == [soft.name]


def test_photos_that_cannot_be_read_are_not_called_blurred():
    sharp = {f"{i:02}": Look(sharpness=100.0 + i) for i in range(12)}
    assert blurred(sharp | {"12": Look(sharpness=3.0), "13": Look(unreadable="damaged")}) == ["12"]
