"""COLMAP captures: a small one written by pycolmap itself, then broken in every usual way."""

import shutil
from dataclasses import replace as dataclass_replace

import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import splatax as sx
from captures import POINTS, SIZE, model_of, pinhole, radial, write_capture
from splatax.cameras.lenses import Pinhole
from splatax.errors import DatasetError, InputError
from splatax.splits import Last, Listed, Nothing


@pytest.fixture
def capture(tmp_path):
    return write_capture(tmp_path / "capture")


def test_a_known_point_projects_to_its_known_pixel(capture):
    view = sx.load_dataset(capture).views[1]
    rotation = pycolmap.Rotation3d(np.array([0, 0.04, 0, 1]) / np.hypot(0.04, 1)).matrix()
    x, y, z = rotation @ (POINTS[3] + [0, 0, 5]) + [0.2, 0, 0]
    expected = [60 * x / z + 30, 61 * y / z + 25]
    assert view.name == "photo01.png"
    point = jnp.asarray(POINTS[3] + [0, 0, 5], jnp.float32)
    assert_allclose(view.camera.to_pixel(view.camera.to_camera(point)), expected, rtol=1e-5)


def test_the_landmarks_of_a_photo_are_the_points_that_were_observed_in_it(tmp_path):
    folder = write_capture(tmp_path)
    model = pycolmap.Reconstruction(folder / "sparse" / "0")
    model.delete_observation(next(i for i in model.images if model.image(i).name == "photo02.png"), 1)
    model.write_binary(folder / "sparse" / "0")
    views = {view.name: view for view in sx.load_dataset(folder).views}
    points = np.asarray(POINTS, np.float32) + np.float32([0, 0, 5])
    assert_allclose(views["photo01.png"].landmarks(), points, atol=1e-6)
    assert_allclose(views["photo02.png"].landmarks(), np.delete(points, 1, axis=0), atol=1e-6)


def test_every_eighth_photo_by_name_is_held_out_but_neither_the_first_nor_the_last(capture):
    dataset = sx.load_dataset(capture)
    assert [view.name for view in dataset.test] == ["photo04.png"]
    assert len(dataset.train) == 8


@pytest.mark.parametrize("place", ["test.txt", "sparse/0/test.txt"])
def test_a_list_of_test_photos_in_the_capture_is_kept_to(capture, place):
    (capture / place).write_text("photo08.png\nphoto00\nphoto without a pose.png\n")
    dataset = sx.load_dataset(capture)
    assert [view.name for view in dataset.test] == ["photo00.png", "photo08.png"]
    assert "2 of 9 photos held out for testing: the photos that test.txt names" in dataset.notes
    refused = capture / place
    refused.write_text("shopping list")
    refuse(capture, match="names none of the photos with a pose", names="test.txt")


def test_the_photos_to_hold_out_can_be_chosen(capture):
    (capture / "test.txt").write_text("photo08.png\n")
    dataset = sx.load_dataset(capture, hold_out=Nothing())
    assert not dataset.test
    assert len(dataset.train) == 9
    assert dataset.notes[-1] == "no photo is held out, so all are trained on"
    with pytest.raises(InputError, match=r"^the list names photo99, but the capture has no such photo"):
        sx.load_dataset(capture, hold_out=Listed(("photo01", "photo99")))
    with pytest.raises(InputError, match="leaves none of 9 photos to train on"):
        sx.load_dataset(capture, hold_out=Last(9))


def test_a_capture_too_small_to_hold_photos_out_says_so(tmp_path):
    dataset = sx.load_dataset(write_capture(tmp_path / "capture", count=5))
    assert not dataset.test
    assert dataset.notes[-1] == "no photo is held out: 5 photos are too few, so all are trained on"


def test_notes_tell_what_was_found(capture):
    (capture / "images" / "unused.jpg").write_bytes((capture / "images" / "photo00.png").read_bytes())
    notes = " / ".join(sx.load_dataset(capture).notes)
    assert "9 of 10 photos registered" in notes
    assert "30 points; photos 64 x 48 from images/" in notes
    assert "median reprojection error 0.00 px (270 observations)" in notes


def test_reprojection_error_is_that_of_the_observations(tmp_path):
    capture = write_capture(tmp_path / "capture")
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + [3, 4]
    model.write_binary(capture / "sparse" / "0")
    assert "median reprojection error 5.00 px" in " ".join(sx.load_dataset(capture).notes)


def test_text_and_binary_models_are_the_same_capture(tmp_path):
    binary = sx.load_dataset(write_capture(tmp_path / "binary"))
    text = sx.load_dataset(write_capture(tmp_path / "text", text=True))
    assert_array_equal(binary.points.positions, text.points.positions)
    for a, b in zip(binary.views, text.views, strict=True):
        for x, y in zip(jax.tree.leaves(a.camera), jax.tree.leaves(b.camera), strict=True):
            assert_allclose(x, y, rtol=1e-6)


def test_files_of_older_colmap_without_rigs_and_frames_load(capture):
    for name in ("rigs.bin", "frames.bin"):
        (capture / "sparse" / "0" / name).unlink()
    assert len(sx.load_dataset(capture).views) == 9


def test_the_largest_of_several_models_is_used_and_said(capture):
    smaller = capture / "sparse" / "1"
    smaller.mkdir()
    model_of(["photo00.png", "photo01.png"], pinhole()).write_binary(smaller)
    dataset = sx.load_dataset(capture)
    assert len(dataset.views) == 9
    assert dataset.notes[0] == "2 models (0: 9 photos, 1: 2 photos); using the largest, 0"


@pytest.mark.parametrize("downscale", [None, 2])
def test_intrinsics_follow_the_real_size_of_the_photos(tmp_path, downscale):
    """Photos half as large as the model's, then shrunk again in memory: by area, not by points."""
    capture = write_capture(tmp_path / "capture", size=(32, 24))
    view = sx.load_dataset(capture, downscale=downscale).train[0]
    scale = 0.5 / (downscale or 1)
    assert (view.camera.width, view.camera.height) == (round(64 * scale), round(48 * scale))
    assert_allclose(
        [view.camera.fx, view.camera.fy, view.camera.cx, view.camera.cy], np.array([60, 61, 30, 25]) * scale
    )
    photo = np.asarray(Image.open(capture / "images" / view.name), np.float64)
    if downscale:
        photo = photo.reshape(12, 2, 16, 2, 3).mean((1, 3))
    assert np.abs(view.pixels() - photo).max() <= 1  # rounded after each axis


def test_a_folder_of_shrunk_photos_is_used_where_there_is_one(capture):
    (capture / "images_2").mkdir()
    for photo in (capture / "images").iterdir():
        Image.new("RGB", (32, 24), "red").save(capture / "images_2" / f"{photo.stem}.jpg")
    dataset = sx.load_dataset(capture, downscale=2)
    assert "from images_2/" in dataset.notes[1]
    assert dataset.train[0].pixels()[0, 0].tolist() == [254, 0, 0]


def test_photos_wider_than_1600_pixels_are_shrunk_unless_told(tmp_path):
    capture = write_capture(tmp_path / "capture", count=2, camera=pinhole(size=(1700, 100)), size=(1700, 100))
    assert sx.load_dataset(capture).train[0].pixels().shape == (50, 850, 3)
    assert sx.load_dataset(capture, downscale=1).train[0].pixels().shape == (100, 1700, 3)


def test_alpha_is_kept_and_weighs_colour_when_shrinking(tmp_path):
    capture = write_capture(tmp_path / "capture", mode="RGBA")
    pixels = np.zeros((48, 64, 4), np.uint8)
    pixels[:, ::2] = (200, 100, 50, 255)  # opaque, beside transparent black
    Image.fromarray(pixels).save(capture / "images" / "photo01.png")
    shrunk = sx.load_dataset(capture, downscale=2).views[1].pixels()
    assert_array_equal(shrunk[5, 5], [200, 100, 50, 128])


def test_distorted_photos_become_a_pinholes(tmp_path):
    """A grid of the distorted lens is straight after loading: points land where a pinhole sees them."""
    capture = write_capture(tmp_path / "capture", camera=radial())
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    image = model.find_image_with_name("photo01.png")
    canvas = np.zeros((48, 64, 3))
    y, x = np.mgrid[:48, :64] + 0.5
    marked = [p.xy for p in image.points2D if np.all(p.xy > 6) and np.all(p.xy < np.array(SIZE) - 6)][:3]
    for channel, (mx, my) in enumerate(marked):
        canvas[..., channel] = 255 * np.exp(-((x - mx) ** 2 + (y - my) ** 2) / 8)
    Image.fromarray(canvas.astype(np.uint8)).save(capture / "images" / "photo01.png")

    view = sx.load_dataset(capture).views[1]
    pixels = view.pixels().astype(np.float64)
    assert pixels.shape[:2] == (view.camera.height, view.camera.width)
    y, x = np.mgrid[: pixels.shape[0], : pixels.shape[1]] + 0.5
    slopes = model.camera(image.camera_id).cam_from_img(np.array(marked))
    for channel, (sx_, sy) in enumerate(slopes):
        weight = pixels[..., channel] / pixels[..., channel].sum()
        centre = [np.sum(weight * x), np.sum(weight * y)]
        expected = [view.camera.fx * sx_ + view.camera.cx, view.camera.fy * sy + view.camera.cy]
        assert_allclose(centre, expected, atol=0.1)  # half a pixel off would be a wrong convention


@pytest.mark.parametrize(
    ("model", "params"),
    [
        ("SIMPLE_RADIAL", [60, 32, 24, 0.3]),
        ("RADIAL", [60, 32, 24, -0.2, 0.1]),
        ("OPENCV", [60, 60, 32, 24, -0.2, 0, 0.01, 0]),
        ("OPENCV_FISHEYE", [60, 60, 32, 24, 0, 0, 0, 0]),  # its projection bends lines without parameters
    ],
)
def test_no_lens_that_bends_lines_passes_for_a_pinhole(model, params, tmp_path):
    lens = pycolmap.Camera(model=model, width=SIZE[0], height=SIZE[1], params=params, camera_id=1)
    capture = write_capture(tmp_path / "capture", count=2, camera=lens)
    photo = np.zeros((48, 64, 3), np.uint8)
    photo[:10] = 255  # a straight edge, well away from the centre
    Image.fromarray(photo).save(capture / "images" / "photo01.png")
    _, view = sx.load_dataset(capture).train
    assert not isinstance(view.camera.lens, Pinhole)  # the photo as it is, with its lens
    assert np.ptp(view.pixels()[..., 0].sum(axis=0, dtype=np.float64)) == 0
    _, view = sx.load_dataset(capture, undistort=True).train
    assert isinstance(view.camera.lens, Pinhole)
    heights = view.pixels()[..., 0].sum(axis=0, dtype=np.float64) / 255  # of white, pixels
    assert np.ptp(heights) > 0.5


def test_a_photo_turned_by_exif_matches_its_camera(tmp_path):
    capture = write_capture(tmp_path / "capture")
    for photo in (capture / "images").iterdir():
        exif = Image.Exif()
        exif[0x0112] = 6
        image = Image.open(photo).rotate(90, expand=True)
        image.save(photo.with_suffix(".jpg"), exif=exif, quality=95)
        photo.unlink()
    assert sx.load_dataset(capture).train[0].pixels().shape == (48, 64, 3)


# --- bad input: one sentence with the path and the way out ---


def load_all(path):
    return [view.pixels() for view in sx.load_dataset(path).views]


def refuse(path, *, match, names):
    with pytest.raises(DatasetError, match=match) as error:
        load_all(path)
    assert str(names) in str(error.value)


def test_missing_folder_and_file(tmp_path, capture):
    refuse(tmp_path / "nowhere", match="no such folder", names=tmp_path / "nowhere")
    refuse(capture / "images" / "photo00.png", match="a file, not a folder", names="photo00.png")


def test_folder_without_a_model(capture):
    shutil.rmtree(capture / "sparse")
    refuse(capture, match="It looked for COLMAP's cameras, images and points3D", names=capture)


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin"])
@pytest.mark.parametrize("keep", [0, 5, 0.5, -3])
def test_truncated_model(capture, name, keep):
    path = capture / "sparse" / "0" / name
    contents = path.read_bytes()
    path.write_bytes(contents[: int(len(contents) * keep) if isinstance(keep, float) else keep])
    refuse(capture, match="damaged", names=path)


def test_model_of_noise(capture):
    path = capture / "sparse" / "0" / "images.bin"
    path.write_bytes(np.random.default_rng(0).bytes(5000))
    refuse(capture, match="damaged", names=path)


@pytest.mark.parametrize("name", ["cameras.txt", "images.txt"])
def test_truncated_text_model(tmp_path, name):
    capture = write_capture(tmp_path / "capture", text=True)
    path = capture / "sparse" / "0" / name
    path.write_text(path.read_text()[:60])
    refuse(capture, match="damaged", names=path.parent)


def test_photo_missing_on_disk(capture):
    (capture / "images" / "photo03.png").unlink()
    refuse(capture, match="the photo is missing, but the COLMAP model has it", names="photo03.png")


def test_several_photos_missing_on_disk(capture):
    for name in ("photo03.png", "photo05.png"):
        (capture / "images" / name).unlink()
    message = (
        r"2 photos are missing \(photo03.png, photo05.png\), .* has them .* Put them back, or remove them"
    )
    refuse(capture, match=message, names="photo03.png")


def test_a_link_to_a_photo_that_is_gone_is_a_missing_photo(capture):
    (capture / "images" / "photo03.png").unlink()
    (capture / "images" / "photo03.png").symlink_to(capture / "gone.png")
    refuse(capture, match="the photo is missing", names="photo03.png")


def test_an_empty_file_is_called_empty(capture):
    (capture / "images" / "photo03.png").write_bytes(b"")
    refuse(capture, match="an empty file, not a photo. Restore it", names="photo03.png")


def test_names_with_spaces_in_a_text_model_are_whole(tmp_path):
    capture = write_capture(tmp_path / "capture", text=True)
    (capture / "images" / "my photos").mkdir()
    path = capture / "sparse" / "0" / "images.txt"
    for number, photo in enumerate(sorted((capture / "images").glob("*.png"))):
        name = f"my photos/no {number}.png"
        photo.rename(capture / "images" / name)
        path.write_text(path.read_text().replace(photo.name, name))
    assert [view.name for view in sx.load_dataset(capture).views] == [
        f"my photos/no {i}.png" for i in range(9)
    ]


@pytest.mark.parametrize("scale", ["0", "1.5"])
def test_a_rotation_that_is_no_unit_quaternion_is_refused(tmp_path, scale):
    capture = write_capture(tmp_path / "capture", text=True)
    path = capture / "sparse" / "0" / "images.txt"
    for name in ("rigs.txt", "frames.txt"):  # which have the poses, if they are there
        (path.parent / name).unlink()
    lines = path.read_text().splitlines()
    row = next(i for i, line in enumerate(lines) if line.endswith("photo01.png"))
    number, w, x, y, z, *rest = lines[row].split()
    lines[row] = " ".join([number, *(str(float(q) * float(scale)) for q in (w, x, y, z)), *rest])
    path.write_text("\n".join(lines) + "\n")
    refuse(capture, match=rf"photo01.png is a quaternion of length {scale}, not 1", names=capture)


def test_names_in_test_txt_without_a_photo_are_said(capture):
    (capture / "test.txt").write_text("photo02.png\nphoto77.png\n")
    notes = " ".join(sx.load_dataset(capture).notes)
    assert "test.txt names 1 photo that has no pose or is not there: photo77.png" in notes


def test_no_folder_of_photos(capture):
    shutil.rmtree(capture / "images")
    refuse(capture, match="no folder of photos", names=capture / "images")


def test_photo_of_other_proportions(capture):
    Image.new("RGB", (64, 40)).save(capture / "images" / "photo03.png")
    refuse(capture, match="64 x 40 pixels, but its camera is 64 x 48", names="photo03.png")


def test_photo_that_is_no_photo_or_damaged(capture):
    path = capture / "images" / "photo03.png"
    whole = path.read_bytes()
    path.write_bytes(b"not a photo")
    refuse(capture, match="not a photo that can be read", names="photo03.png")
    path.write_bytes(whole[: len(whole) // 2])
    refuse(capture, match="the photo is damaged", names="photo03.png")


def test_no_points_is_refused_by_the_start_that_needs_them(tmp_path):
    capture = write_capture(tmp_path / "capture")
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    model.delete_all_points2D_and_points3D()
    model.write_binary(capture / "sparse" / "0")
    dataset = sx.load_dataset(capture)
    with pytest.raises(
        DatasetError, match=r"no points to start from. Find some: .* Or start from random Gaussians"
    ):
        next(sx.optimize(dataset, sx.Recipe(steps=1)))


def test_views_are_the_same_whatever_is_held_out(capture):
    dataset = sx.load_dataset(capture)
    swapped = dataclass_replace(dataset, train=dataset.test, test=dataset.train)
    assert [view.name for view in swapped.views] == [view.name for view in dataset.views]
