"""Masks beside the photos of a capture."""

import shutil

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

import splatax as sx
from captures import pinhole, radial, write_capture
from splatax.errors import DatasetError
from splatax.io import images

LEFT = np.arange(64) < 20  # of 64 columns; every row


def write_mask(capture, name, size=(64, 48), left=20, mode="L"):
    """White, `left` of 64 columns wide, then black."""
    path = capture / "masks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    shades = np.zeros((size[1], size[0]), np.uint8)
    shades[:, : left * size[0] // 64] = 255
    Image.fromarray(shades).convert(mode).save(path)


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "capture", count=3)


def view_of(capture, name="photo01.png", **options):
    return next(view for view in sx.load_dataset(capture, **options).views if view.name == name)


@pytest.mark.parametrize("mode", ["L", "1", "RGB", "RGBA", "P"])
@pytest.mark.parametrize("name", ["photo01.png", "photo01.png.png"])
def test_black_does_not_count(capture, name, mode):
    write_mask(capture, name, mode=mode)
    assert_array_equal(view_of(capture).mask(), np.broadcast_to(LEFT, (48, 64)))
    assert view_of(capture, "photo02.png").mask is None


def test_masks_in_folders_are_found_as_their_photos_are(tmp_path):
    capture = write_capture(tmp_path / "capture", count=2)
    write_mask(capture, "photo00.png")
    write_mask(capture, "left/photo01.png.png")
    assert view_of(capture).mask is None
    assert view_of(capture, "photo00.png").mask is not None


def test_any_shade_but_black_counts(capture, tmp_path):
    """As in COLMAP and nerfstudio, so that masks of 0 and 1 mean what they say."""
    for i, values in enumerate((np.uint8([[0, 1, 127, 255]]), np.uint16([[0, 1, 256, 65535]]))):
        path = tmp_path / f"{i}.png"
        Image.fromarray(values).save(path)
        assert images.read_mask(path).tolist() == [[False, True, True, True]]


def test_notes_tell_of_masks(capture):
    assert "mask" not in " ".join(sx.load_dataset(capture).notes)
    write_mask(capture, "photo01.png")
    assert "masks for 1 of 3 photos, from masks/" in sx.load_dataset(capture).notes


@pytest.mark.parametrize("mask_size", [(64, 48), (32, 24), (128, 96)])
def test_masks_follow_the_size_of_the_view(capture, mask_size):
    write_mask(capture, "photo01.png", size=mask_size)
    assert_array_equal(view_of(capture, downscale=2).mask(), np.broadcast_to(LEFT[::2], (24, 32)))


def test_masks_lose_the_distortion_that_their_photos_lose(tmp_path):
    """A photo that is its own mask's picture stays so."""
    lens = radial()
    lens.params = [60, 32, 24, -0.2]
    capture = write_capture(tmp_path / "capture", count=2, camera=lens)
    write_mask(capture, "photo01.png", left=12)
    shutil.copy(capture / "masks" / "photo01.png", capture / "images" / "photo01.png")
    _, view = sx.load_dataset(capture, undistort=True).train
    mask = view.mask()
    assert mask.shape == (view.camera.height, view.camera.width)
    assert_array_equal(mask, view.pixels()[..., 0] > 127)
    assert not np.all(mask == mask[:1])  # the edge is bent


def test_a_mask_of_other_proportions_is_refused(capture):
    write_mask(capture, "photo01.png", size=(48, 64))
    with pytest.raises(DatasetError, match=r"masks/photo01.png: 48 x 64 pixels, but its photo 64 x 48"):
        sx.load_dataset(capture)


def test_masks_that_fit_no_photo_are_refused(capture):
    write_mask(capture, "photo01_mask.png")
    with pytest.raises(DatasetError, match=r"masks: no mask has the name of a registered photo"):
        sx.load_dataset(capture)


def test_a_damaged_mask_is_refused(capture):
    write_mask(capture, "photo01.png")
    path = capture / "masks" / "photo01.png"
    path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(DatasetError, match=r"photo01.png: the mask is damaged"):
        view_of(capture).mask()


def test_a_mask_that_is_no_picture_is_called_a_mask(capture):
    write_mask(capture, "photo01.png")
    (capture / "masks" / "photo01.png").write_text("black")
    with pytest.raises(DatasetError, match=r"masks/photo01.png: not a mask that can be read. Masks are"):
        sx.load_dataset(capture)


def test_masks_of_photos_that_were_shrunk_on_disk_may_be_whole(tmp_path):
    capture = write_capture(tmp_path / "capture", count=2, camera=pinhole())
    (capture / "images").rename(capture / "images_2")
    for photo in (capture / "images_2").iterdir():
        Image.open(photo).resize((32, 24)).save(photo)
    write_mask(capture, "photo01.png")
    assert view_of(capture, downscale=2).mask().shape == (24, 32)
