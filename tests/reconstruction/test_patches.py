"""Features are located by their patches to a hundredth of a pixel, and distortion to a percent from them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import ndimage
from test_triangulation import view

import corner
from splatax.cameras.lenses import opencv
from splatax.reconstruction.bundle import adjusted_cameras
from splatax.reconstruction.patches import HALF, Observations, Photo, fitted, patterns_of, shapes_of

SIZE = (90, 70)
TURN = np.array([[1.1, 0.15], [-0.1, 0.95]])  # from the pattern to the photo


def camera_of(pycolmap, *k):
    return pycolmap.Camera(
        model="RADIAL", width=SIZE[0], height=SIZE[1], params=[80.0, 45.0, 35.0, *(k or (0.0, 0.0))]
    )


def scenery(x, y):
    """Brightness of a smooth pattern at places on the plane of a pinhole, pixels from the axis."""
    rng = np.random.default_rng(0)
    waves = zip(rng.normal(size=(40, 2)) * 0.6, rng.uniform(0, 2 * np.pi, 40), strict=True)
    return 128 + sum(8 * np.cos(wave[0] * x + wave[1] * y + phase) for wave, phase in waves)


def photo_of(camera, map_=np.eye(2), shift=(0.0, 0.0), noise=0.0):
    """A photo through a lens of the pattern under an affine map, offset = MAP pattern + SHIFT."""
    x, y = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    straight = np.asarray(camera.cam_from_img(np.column_stack([x.ravel(), y.ravel()]))) * 80.0
    u, v = np.linalg.solve(map_, (straight - shift).T)
    brightness = scenery(u, v) + noise * np.random.default_rng(1).normal(size=u.shape)
    return Photo(ndimage.spline_filter(brightness.reshape(SIZE[::-1]), mode="mirror"), camera)


@pytest.mark.parametrize(
    ("k", "noise", "limit"), [((), 0.0, 0.003), ((-0.3, 0.1), 0.0, 0.003), ((), 1.0, 0.03)]
)
def test_a_patch_is_found_where_an_affine_map_puts_it_through_any_lens(k, noise, limit):
    pycolmap = pytest.importorskip("pycolmap")
    at = np.array([[-12.0, 6.0], [4.0, -9.0], [15.0, 12.0]])
    pattern = photo_of(camera_of(pycolmap)).patches(at, np.tile(np.eye(2), (3, 1, 1)))
    photo = photo_of(camera_of(pycolmap, *k), TURN, (1.3, -0.7), noise)
    truth = at @ TURN.T + [1.3, -0.7]
    start = truth + [[0.4, -0.3], [-0.5, 0.2], [0.1, 0.5]]
    found, good = fitted(photo, pattern, start, np.tile(np.eye(2), (3, 1, 1)))
    assert good.all()
    assert np.linalg.norm(found - truth, axis=1).max() < limit


def test_patches_do_not_depend_on_brightness_and_contrast():
    pycolmap = pytest.importorskip("pycolmap")
    photo = photo_of(camera_of(pycolmap))
    darker = Photo(0.3 * photo.splines + 20, photo.camera)
    places, maps = np.array([[3.0, -4.0]]), np.eye(2)[None]
    np.testing.assert_allclose(darker.patches(places, maps), photo.patches(places, maps), atol=1e-9)


def test_patches_of_something_else_without_contrast_or_beyond_the_photo_are_not_found():
    pycolmap = pytest.importorskip("pycolmap")
    camera, maps = camera_of(pycolmap), np.tile(np.eye(2), (3, 1, 1))
    at = np.array([[0.0, 0.0], [5.0, 5.0], [-8.0, 3.0]])
    photo = photo_of(camera)
    pattern = photo.patches(at, maps)
    assert fitted(photo, pattern, at, maps)[1].all()
    assert not fitted(photo, pattern, at + [15.0, -9.0], maps)[1].any()
    beside = np.array([[SIZE[0] / 2 - HALF / 2, 0.0]])
    assert np.isnan(photo.patches(beside, maps[:1])).all()
    flat = Photo(np.full(SIZE[::-1], 90.0), camera)
    assert np.isnan(flat.patches(at, maps)).all()
    assert not fitted(flat, pattern, at, maps)[1].any()


def test_the_observation_of_middle_size_is_the_pattern_of_its_point():
    sizes = np.array([3.0, 1.0, 2.0, 5.0, 4.0])
    points = np.array([7, 7, 7, 2, 2])
    seen = Observations(
        np.arange(5), np.arange(5), points, np.zeros((5, 2)), np.eye(2) * sizes[:, None, None]
    )
    np.testing.assert_array_equal(patterns_of(seen), [2, 2, 2, 3, 3])
    turned = shapes_of(np.array([[0.0, 0.0, 2.0, np.pi / 2]], np.float32))
    np.testing.assert_allclose(turned, [[[0, -2], [2, 0]]], atol=1e-6)


def rounded(photo, seed):
    """Eight bits of a photo: cut off, or rounded up at random, in proportion to what would be cut off."""
    if seed == 0:
        return photo.astype(np.uint8)
    dither = np.random.default_rng(seed).uniform(size=photo.shape)
    return np.clip(np.floor(photo + dither), 0, 255).astype(np.uint8)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "free"), [(0, "poses+distortion"), (3, "poses+lens")])
def test_distortion_that_was_set_to_zero_comes_back_to_a_percent_however_photos_are_rounded(seed, free):
    pytest.importorskip("pycolmap")
    paper, lens = corner.wallpaper(), opencv(-0.2, 0.05)
    wrong = []
    for i, at in enumerate(corner.positions()):
        given = view(i, at, paper, lens)
        photo = rounded(corner.photograph(at, paper, lens), seed)
        camera = replace(given.camera, lens=opencv())
        wrong.append(replace(given, camera=camera, pixels=lambda photo=photo: photo))
    found = adjusted_cameras(wrong, free)
    assert found.helps
    for each in found.views:
        np.testing.assert_allclose(each.camera.lens.radials[:2], [-0.2, 0.05], rtol=0.01)
        np.testing.assert_allclose(each.camera.fx, corner.FOCAL, rtol=0.002)
