"""From photos to poses: the corner of a room whose cameras are known, and photos that cannot be used."""

import shutil
import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import corner
import splatax as sx
from splatax.errors import DatasetError, InputError
from splatax.reconstruction import diagnosis, pipeline, reconstruct, work
from splatax.reconstruction.pairs import Exhaustive, Sequential
from splatax.reconstruction.photos import copy

FEW = pipeline.VERY_FEW
CHANCE = 0.01  # of the points: a few matches come and go with the matcher's threads


@pytest.fixture(scope="module", autouse=True)
def normal_features():
    """They are enough for the corner, in a fourth of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "VERY_FEW", 0)
        yield


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    return corner.write_photos(tmp_path_factory.mktemp("corner") / "photos")


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def outcome(photos, tmp_path_factory, told):
    out = tmp_path_factory.mktemp("corner") / "capture"
    return out, reconstruct(photos, out, watch=lambda *stage: told.append(stage))


def aligned(found, true):
    """Positions after the similarity that brings them closest to the true ones (Umeyama 1991)."""
    a, b = found - found.mean(0), true - true.mean(0)
    u, s, vt = np.linalg.svd(b.T @ a)
    flip = np.diag([1, 1, np.sign(np.linalg.det(u @ vt))])
    return a @ (u @ flip @ vt).T * (s @ np.diag(flip)) / np.sum(a * a) + true.mean(0)


def test_cameras_are_where_the_photos_were_taken(outcome):
    out, result = outcome
    dataset = sx.load_dataset(out)
    assert len(dataset.views) == len(result.registered) == corner.COUNT
    assert not result.rejected
    positions = np.stack([np.asarray(view.camera.position) for view in dataset.views])
    assert_allclose(aligned(positions, corner.positions()), corner.positions(), atol=0.03)  # of a span of 2.4
    assert_allclose(dataset.views[0].camera.fx, corner.FOCAL, rtol=0.05)


def test_the_capture_has_the_photos_as_they_are_and_their_lens(photos, outcome):
    out, result = outcome
    assert {path.name for path in out.iterdir()} == {"images", "sparse"}
    dataset = sx.load_dataset(out)
    assert [view.name for view in dataset.views] == [f"wall {i}.jpg" for i in range(corner.COUNT)]
    for view in dataset.views:
        assert (out / "images" / view.name).read_bytes() == (photos / view.name).read_bytes()
    assert all(lens.startswith("SIMPLE_RADIAL") for lens in dataset.survey.lenses.values())
    errors = np.concatenate(list(dataset.survey.errors.values()))
    assert np.median(errors) < 0.5  # pixels
    assert len(dataset.points) == result.points > 200


def test_undistorted_photos_have_a_pinhole_and_the_points_move_along(photos, tmp_path):
    reconstruct(photos, tmp_path, undistort=True)
    dataset = sx.load_dataset(tmp_path)
    assert all(lens.startswith("PINHOLE") for lens in dataset.survey.lenses.values())
    errors = np.concatenate(list(dataset.survey.errors.values()))
    assert np.median(errors) < 0.5  # pixels


@pytest.mark.parametrize(("suffix", "turn"), [(".jpg", 3), (".bmp", 1)])
def test_photos_that_are_turned_or_of_a_rare_format_are_written_anew(tmp_path, suffix, turn):
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:20] = 200  # bright above
    tags = Image.Exif()
    tags[0x0112] = turn
    stored = Image.fromarray(pixels if turn == 1 else pixels[::-1, ::-1])
    stored.save(tmp_path / f"a{suffix}", **({} if suffix == ".bmp" else {"exif": tags, "quality": 95}))
    (photo,), _ = pipeline.photos_in(tmp_path)
    copy(photo, tmp_path / "out" / photo.name)
    written = Image.open(tmp_path / "out" / photo.name)
    assert written.getexif().get(0x0112, 1) == 1
    assert_allclose(np.asarray(written.convert("RGB"))[[2, -2], 5], [[200] * 3, [0] * 3], atol=3)


def test_each_stage_tells_how_far_it_is(outcome, told):
    stages = list(dict.fromkeys(stage for stage, _, _ in told))
    assert stages == list(pipeline.STAGES)
    assert all(0 <= done <= total for _, done, total in told)
    assert [(done, total) for stage, done, total in told if stage == "writing"][-1] == (8, 8)


def stop_at(stage):
    """Interrupts a call when it comes to a stage."""

    def watch(begun, done, total):
        if begun == stage:
            raise KeyboardInterrupt

    return watch


def test_what_was_done_before_an_interruption_is_kept(photos, tmp_path, outcome, monkeypatch):
    out = tmp_path / "capture"
    with pytest.raises(KeyboardInterrupt):
        reconstruct(photos, out, watch=stop_at("poses"))
    assert not (out / "sparse").exists()
    monkeypatch.setattr(pycolmap, "extract_features", None)  # not needed again
    monkeypatch.setattr(pycolmap, "match_image_pairs", None)
    again = reconstruct(photos, out)
    assert again.registered == outcome[1].registered
    assert again.points == outcome[1].points  # the same seed, the same order of photos


@pytest.mark.slow
def test_poses_that_were_found_are_kept_until_there_are_more_matches(photos, tmp_path, outcome, monkeypatch):
    few = Sequential(overlap=2, doublings=0, neighbours=1)
    for out in (tmp_path / "same", tmp_path / "more"):
        with pytest.raises(KeyboardInterrupt):
            reconstruct(photos, out, pairing=few, watch=stop_at("writing"))
    more = reconstruct(photos, tmp_path / "more", pairing=Exhaustive())
    assert more.points == pytest.approx(outcome[1].points, rel=CHANCE)
    monkeypatch.setattr(pycolmap, "incremental_mapping", None)  # not needed again
    same = reconstruct(photos, tmp_path / "same", pairing=few)
    assert same.registered == more.registered
    assert same.points != pytest.approx(more.points, rel=CHANCE)


def test_half_a_reconstruction_is_not_gone_on_with_otherwise(photos, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        reconstruct(photos, tmp_path, watch=stop_at("features"))
    with pytest.raises(InputError, match="unfinished reconstruction with other settings"):
        reconstruct(photos, tmp_path, seed=1)


@pytest.mark.slow
def test_photos_that_came_after_an_interruption_are_used(photos, tmp_path, outcome):
    some = shutil.copytree(photos, tmp_path / "photos")
    (some / "wall 0.jpg").unlink()  # so that all others get another number
    with pytest.raises(KeyboardInterrupt):
        reconstruct(some, tmp_path / "capture", watch=stop_at("matches"))
    shutil.copy(photos / "wall 0.jpg", some)
    again = reconstruct(some, tmp_path / "capture")
    assert again.registered == outcome[1].registered
    assert again.points == outcome[1].points


def test_a_folder_that_was_the_wrong_one_is_not_in_the_way_of_the_right_one(photos, tmp_path):
    (tmp_path / "one").mkdir()
    shutil.copy(photos / "wall 0.jpg", tmp_path / "one")
    with pytest.raises(DatasetError, match="1 photo to use"):
        reconstruct(tmp_path / "one", tmp_path / "capture")
    with pytest.raises(KeyboardInterrupt):
        reconstruct(photos, tmp_path / "capture", watch=stop_at("features"))


def test_an_interruption_between_the_two_moves_at_the_end(photos, tmp_path, outcome, monkeypatch):
    move = Path.rename

    def images_alone(path, target):
        if path.name == "sparse":
            raise KeyboardInterrupt
        return move(path, target)

    monkeypatch.setattr(Path, "rename", images_alone)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(photos, tmp_path)
    monkeypatch.setattr(Path, "rename", move)
    assert (tmp_path / "images").exists()
    assert not (tmp_path / "sparse").exists()
    assert reconstruct(photos, tmp_path).registered == outcome[1].registered


@pytest.mark.slow
def test_photos_that_do_not_fit_are_named_with_the_reason(photos, tmp_path):
    mixed = shutil.copytree(photos, tmp_path / "mixed")
    elsewhere = corner.photograph((0, 0, 0), corner.wallpaper(seed=4))
    Image.fromarray(elsewhere.astype(np.uint8)).save(mixed / "elsewhere.png")
    Image.new("RGB", (400, 300), "gray").save(mixed / "wall.png")
    (mixed / "broken.jpg").write_bytes((photos / "wall 0.jpg").read_bytes()[:5000])
    (mixed / "text.jpg").write_text("no photo")
    result = reconstruct(mixed, tmp_path / "capture")
    assert len(result.registered) == corner.COUNT
    assert result.rejected.keys() == {"elsewhere.png", "wall.png", "broken.jpg", "text.jpg"}
    assert result.rejected["elsewhere.png"] == diagnosis.ALONE
    assert result.rejected["wall.png"] == diagnosis.FEATURELESS
    assert "is damaged" in result.rejected["broken.jpg"]
    assert "not a photo" in result.rejected["text.jpg"]


def test_photos_without_overlap_are_refused_with_advice(tmp_path):
    rng = np.random.default_rng(0)
    (tmp_path / "photos").mkdir()
    for i in range(4):
        noise = rng.integers(0, 255, (60, 80, 3), np.uint8)
        Image.fromarray(noise).resize((400, 300)).save(tmp_path / "photos" / f"{i}.png")
    with pytest.raises(DatasetError, match=r"only 0 of 4 photos fit together.*in smaller steps"):
        reconstruct(tmp_path / "photos", tmp_path / "capture")
    assert not (tmp_path / "capture" / "sparse").exists()

    with pytest.raises(DatasetError, match="only 0 of 4 photos"):  # other settings may be tried
        reconstruct(tmp_path / "photos", tmp_path / "capture", seed=1)
    with pytest.raises(KeyboardInterrupt):
        reconstruct(tmp_path / "photos", tmp_path / "capture", seed=1, watch=stop_at("poses"))
    with pytest.raises(InputError, match="unfinished"):  # but they replace no work that was interrupted
        reconstruct(tmp_path / "photos", tmp_path / "capture", seed=2)


def chunk(kind, contents):
    body = kind + contents
    return struct.pack(">I", len(contents)) + body + struct.pack(">I", zlib.crc32(body))


def png_of(width, height):
    """A PNG whose header says so, and whose pixels are missing."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + header + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.parametrize(
    ("size", "why"), [((64, 48), "is damaged"), ((60_000, 60_000), "decoding its 60000 x 60000 pixels takes")]
)
def test_pngs_without_pixels_are_left_out_with_the_reason(tmp_path, size, why):
    (tmp_path / "broken.png").write_bytes(png_of(*size))
    found, damaged = pipeline.photos_in(tmp_path)
    assert not found
    assert why in damaged["broken.png"]


def test_photos_in_unknown_formats_are_named_unless_a_copy_can_be_read(tmp_path):
    for name in ("a.GIF", "raw/b.dng", "c.jpg", "c.CR2", "notes.txt", ".hidden.gif"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    Image.new("RGB", (64, 48)).save(tmp_path / "c.jpg")
    found, rejected = pipeline.photos_in(tmp_path)
    assert [photo.name for photo in found] == ["c.jpg"]
    assert list(rejected) == ["a.GIF", "raw/b.dng"]
    assert all("Save it as JPEG or PNG" in reason for reason in rejected.values())


def test_a_folder_of_photos_in_unknown_formats_says_so(tmp_path):
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "a.dng").write_bytes(b"x")
    with pytest.raises(DatasetError, match=r"1 photo in formats .*: a.dng. Save them as JPEG or PNG"):
        reconstruct(tmp_path / "photos", tmp_path / "capture")


def test_videos_among_photos_are_named_unless_they_belong_to_a_photo(tmp_path):
    for name in ("walk.MP4", "live.mov", "live.jpg", "._walk.mp4"):
        (tmp_path / name).write_bytes(b"x")
    Image.new("RGB", (64, 48)).save(tmp_path / "live.jpg")
    found, rejected = pipeline.photos_in(tmp_path)
    assert [photo.name for photo in found] == ["live.jpg"]
    assert list(rejected) == ["walk.MP4"]
    assert "Give the video itself" in rejected["walk.MP4"]


def test_a_folder_of_videos_names_one_to_give(tmp_path):
    (tmp_path / "videos").mkdir()
    (tmp_path / "videos" / "walk.mp4").write_bytes(b"x")
    with pytest.raises(DatasetError, match=r"no photos in this folder, but 1 video.*videos/walk.mp4\.$"):
        reconstruct(tmp_path / "videos", tmp_path / "capture")


def test_two_photos_that_would_get_one_name_are_not_written_over_each_other(tmp_path):
    for name, kind in (("a.tif", "TIFF"), ("a.tif.png", "PNG")):
        Image.new("RGB", (64, 48)).save(tmp_path / name, kind)
    found, rejected = pipeline.photos_in(tmp_path)
    assert [photo.name for photo in found] == ["a.tif.png"]
    assert "saved as a.tif.png, as another photo. Rename one of them" in rejected["a.tif"]


@pytest.mark.parametrize("count", [1, 2])
def test_one_or_two_photos_are_too_few(photos, tmp_path, count):
    (tmp_path / "photos").mkdir()
    for i in range(count):
        shutil.copy(photos / f"wall {i}.jpg", tmp_path / "photos")
    with pytest.raises(DatasetError, match=f"{count} photos? to use, but depth needs at least 3"):
        reconstruct(tmp_path / "photos", tmp_path / "capture")
    assert not (tmp_path / "capture").exists()


def test_photos_that_are_refused_leave_a_folder_as_it_was(photos, tmp_path):
    (tmp_path / "photos").mkdir()
    shutil.copy(photos / "wall 0.jpg", tmp_path / "photos")
    (tmp_path / "capture").mkdir()
    (tmp_path / "capture" / "notes.txt").write_text("mine")
    with pytest.raises(DatasetError, match="1 photo to use"):
        reconstruct(tmp_path / "photos", tmp_path / "capture")
    assert [path.name for path in (tmp_path / "capture").iterdir()] == ["notes.txt"]


@pytest.mark.slow
def test_photos_are_turned_upright_as_exif_says(photos, tmp_path):
    (tmp_path / "photos").mkdir()
    for path in photos.iterdir():
        tags = Image.open(path).getexif()
        tags[0x0112] = 6
        Image.open(path).rotate(90, expand=True).save(tmp_path / "photos" / path.name, exif=tags, quality=95)
    reconstruct(tmp_path / "photos", tmp_path / "capture")
    view = sx.load_dataset(tmp_path / "capture").views[0]
    assert view.camera.width > view.camera.height
    rows = view.pixels()[20:-20, 20:-20]
    assert rows.shape[1] > rows.shape[0]


def test_photos_of_phones_in_heic_are_read(photos, tmp_path):
    heif = pytest.importorskip("pillow_heif")
    (tmp_path / "photos").mkdir()
    image = Image.open(photos / "wall 0.jpg")
    heif.from_pillow(image).save(tmp_path / "photos" / "IMG_1.HEIC", quality=90)
    (photo,), damaged = pipeline.photos_in(tmp_path / "photos")
    assert not damaged
    assert photo.name == "IMG_1.HEIC.jpg"  # what it is saved as, for tools that read no HEIC
    assert pipeline.read(photo).shape == (300, 400, 3)


def test_heic_without_its_package_names_the_way_to_it(tmp_path, monkeypatch):
    (tmp_path / "IMG_1.HEIC").write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    with pytest.raises(InputError, match=r"IMG_1.HEIC: .*pip install '\.\[heic\]' in the checkout"):
        pipeline.photos_in(tmp_path)


def test_the_photos_themselves_are_never_in_the_way(photos, tmp_path):
    capture = tmp_path / "capture"
    shutil.copytree(photos, capture / "images")
    with pytest.raises(InputError, match="its images/ holds the photos themselves"):
        reconstruct(capture / "images", capture)
    with pytest.raises(InputError, match="its images/ holds the photos themselves"):
        work.clear(capture / "images", capture)
    with pytest.raises(InputError, match="lies among the photos"):
        reconstruct(capture / "images", capture / "images" / "out")
    assert len(list((capture / "images").iterdir())) == corner.COUNT


def test_a_capture_is_not_replaced_unasked(photos, outcome):
    with pytest.raises(InputError, match="holds a capture"):
        reconstruct(photos, outcome[0])


def test_the_focal_length_of_exif_is_by_the_diagonal(data):
    """The fern's phone: 28 mm equivalent; its calibration says 407.57 pixels at 504 x 378."""
    photo = pipeline.photos_in(data / "fern_photos")[0][0]
    assert_allclose(photo.focal, 407.566 * 1512 / 504, rtol=2e-3)
    assert photo.size == (1512, 1134)


@pytest.mark.slow
def test_all_photos_of_the_fern_are_registered(data, tmp_path, monkeypatch):
    monkeypatch.setattr(pipeline, "VERY_FEW", FEW)
    result = reconstruct(data / "fern_photos", tmp_path / "capture")
    assert len(result.registered) == 20
    assert result.points > 7000  # 3,600 of normal features: training from so few loses 0.5 dB
    dataset = sx.load_dataset(tmp_path / "capture")
    found = np.stack([np.asarray(view.camera.position) for view in dataset.views])
    true = np.stack([np.asarray(view.camera.position) for view in sx.load_dataset(data / "fern").views])
    span = np.linalg.norm(true - true.mean(0), axis=1).max()
    assert np.linalg.norm(aligned(found, true) - true, axis=1).max() < 0.03 * span
    assert_array_equal([view.name for view in dataset.views], sorted(result.registered))
