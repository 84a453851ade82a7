"""360-degree photos: recognised by their metadata, cut into faces, placed as rigs, and one photo each."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

import papered_room
import splatax as sx
from papered_room import COUNT, GPANO, SIZE, WHOLE, positions, rays
from scenes import camera_at
from splatax.cameras.lenses import Equirectangular, Pinhole
from splatax.dataset import View, photos_in, without
from splatax.errors import DatasetError, InputError
from splatax.evaluation import ViewScore, scores_of
from splatax.inspection.examination import examine
from splatax.reconstruction import diagnosis, pipeline, reconstruct
from splatax.reconstruction.panoramas import (
    FACES,
    SEARCHED,
    SHOWN,
    faces_of,
    focal_of_faces,
    pixels_in_faces,
    rays_of,
    size_of_faces,
)
from splatax.reconstruction.photos import photos_in as photos_of_folder
from splatax.splits import Every, Listed, Nothing
from splatax.training.feed import rows_for, sources

CAMERA = camera_at((0.0, 0.0, -4.0))
PART = GPANO.format(
    'GPano:ProjectionType="equirectangular" GPano:CroppedAreaImageWidthPixels="512" '
    'GPano:FullPanoWidthPixels="1024"'
)


@pytest.fixture(scope="module", autouse=True)
def normal_features():
    """They are enough for the room, in a fourth of the time."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(pipeline, "VERY_FEW", 0)
        yield


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room") / "photos"
    folder.mkdir()
    papered_room.write(folder)
    return folder


@pytest.fixture(scope="module")
def outcome(photos, tmp_path_factory):
    """A capture with the panoramas as they are."""
    out = tmp_path_factory.mktemp("room") / "capture"
    return out, reconstruct(photos, out, faces=False)


@pytest.fixture(scope="module")
def in_faces(photos, tmp_path_factory):
    """A capture with the faces of the panoramas."""
    out = tmp_path_factory.mktemp("room") / "capture"
    return out, reconstruct(photos, out)


def spread(places):
    """Distances between all pairs, in units of their mean: the same after any similarity."""
    apart = np.linalg.norm(places[:, None] - places[None, :], axis=-1)
    return apart / apart.mean()


@pytest.mark.slow
def test_panoramas_are_placed_where_they_were_taken_and_kept_as_they_are(photos, outcome):
    out, result = outcome
    dataset = sx.load_dataset(out)
    assert len(result.registered) == result.panoramas == COUNT
    assert [view.name for view in dataset.views] == [f"room {i}.jpg" for i in range(COUNT)]
    assert all(isinstance(view.camera.lens, Equirectangular) for view in dataset.views)
    found = np.stack([np.asarray(view.camera.position) for view in dataset.views])
    assert_allclose(spread(found), spread(positions()), atol=0.05)
    first, second = (np.asarray(view.camera.rotation, np.float64) for view in dataset.views[:2])
    assert_allclose(np.trace(second @ first.T), 1 + 2 * math.cos(0.7), atol=0.01)
    for name in result.registered:
        assert (out / "images" / name).read_bytes() == (photos / name).read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["outcome", "in_faces"])
def test_features_of_faces_are_observations_of_the_written_photos(kind, request):
    outcome = request.getfixturevalue(kind)
    dataset = sx.load_dataset(outcome[0])
    errors = np.concatenate(list(dataset.survey.errors.values()))
    assert len(errors) > 1000
    assert np.median(errors) < 0.5  # pixels
    assert outcome[1].error < 1
    seen = np.concatenate([view.landmarks() - np.asarray(view.camera.position) for view in dataset.views])
    sides = {(axis, side) for axis in range(3) for side in (-1, 1) if (side * seen[:, axis] > 0.1).any()}
    assert len(sides) == 6


@pytest.mark.slow
def test_faces_of_a_panorama_have_one_place_and_turn_by_exact_rotations(in_faces):
    out, result = in_faces
    dataset = sx.load_dataset(out)
    assert (len(result.registered), result.panoramas, photos_in(dataset.views)) == (COUNT, COUNT, COUNT)
    assert len(dataset.views) == 6 * COUNT
    for number in range(COUNT):
        faces = {view.name: view.camera for view in dataset.views if view.photo == f"room {number}.jpg"}
        front = faces[f"room {number}.jpg-front.png"]
        for face in FACES:
            camera = faces[f"room {number}.jpg-{face.name}.png"]
            assert isinstance(camera.lens, Pinhole)
            assert float(2 * camera.fx) == camera.width == camera.height == size_of_faces(SIZE[0], SHOWN)
            assert_allclose(camera.position, front.position, atol=1e-5)
            turn = np.asarray(camera.rotation) @ np.asarray(front.rotation).T
            assert_allclose(turn, np.array(face.rotation), atol=1e-6)  # float32
    notes = " ".join(dataset.notes)
    assert "6 of 6 photos registered" in notes
    assert "6 photos of 360 degrees, in 36 faces" in notes


def test_a_held_out_panorama_is_held_out_with_all_of_its_faces(in_faces):
    for rule in (None, Every(2, 2), Listed(("room 3.jpg",)), Listed(("room 3",)), Listed(("room 3.jpg-up",))):
        dataset = sx.load_dataset(in_faces[0], hold_out=rule)
        unseen, seen = ({view.photo for view in views} for views in (dataset.test, dataset.train))
        assert unseen
        assert not unseen & seen
        assert len(dataset.test) == 6 * len(unseen)
    assert unseen == {"room 3.jpg"}
    (in_faces[0] / "test.txt").write_text("room 1.jpg\n")
    listed = sx.load_dataset(in_faces[0])
    (in_faces[0] / "test.txt").unlink()
    assert {view.photo for view in listed.test} == {"room 1.jpg"}
    assert "1 of 6 photos held out" in " ".join(listed.notes)


def test_a_panorama_is_left_out_with_all_of_its_faces(in_faces):
    dataset = sx.load_dataset(in_faces[0], hold_out=Nothing())
    kept = without(dataset, {"room 2.jpg"})
    assert len(kept.train) == 6 * (COUNT - 1)
    looks = examine(in_faces[0], dataset)
    assert list(looks.looks) == list(looks.photos) == list(looks.panoramas)
    assert len(looks.views) == len(looks.errors) == COUNT


def test_faces_of_a_panorama_share_what_is_learned_of_a_photo(in_faces):
    views = sx.load_dataset(in_faces[0], hold_out=Nothing()).train
    rows = [int(source.view) for source in sources(views)]
    assert rows == [number for number in range(COUNT) for _ in range(6)]
    assert rows_for(views) == COUNT


def test_the_score_of_a_panorama_is_that_of_all_of_its_pixels():
    views = [View(f"a-{i}", CAMERA, lambda: None, face_of="a" if i < 2 else None) for i in range(3)]
    scores = [
        ViewScore("a-0", 20.0, 0.5, 30.0),
        ViewScore("a-1", 30.0, 0.7, 30.0),
        ViewScore("a-2", 1.0, 1.0, 1.0),
    ]
    panorama, photo = scores_of(views, scores).views
    assert panorama.name == "a"
    assert panorama.psnr == pytest.approx(-10 * math.log10((1e-2 + 1e-3) / 2))
    assert (panorama.ssim, panorama.corrected_psnr) == (pytest.approx(0.6), pytest.approx(30.0))
    assert photo is scores[2]


@pytest.mark.parametrize("field", [SEARCHED, SHOWN])
def test_a_face_shows_what_the_panorama_shows_there(field):
    colors = np.round(127.5 + 127.5 * rays()).astype(np.uint8)  # the direction itself
    size = size_of_faces(SIZE[0], field)
    for face, shown in zip(FACES, faces_of(colors, size, field), strict=True):
        pixels = np.array([[0.5, 0.5], [size / 2, size / 2], [size - 0.5, 10.5]])
        local = np.column_stack([(pixels - size / 2) / focal_of_faces(size, field), np.ones(3)])
        directions = local / np.linalg.norm(local, axis=1, keepdims=True) @ np.array(face.rotation, float)
        x, y = pixels.astype(int).T
        assert_allclose(shown[y, x] / 127.5 - 1, directions, atol=0.02)  # a pixel is 0.012 wide


def test_a_panorama_loses_nothing_in_its_faces():
    """Detail of two pixels a wave, the finest that sampling at its own resolution can keep, keeps 0.9."""
    waves = 127.5 + 100 * np.sin(2 * math.pi * np.arange(SIZE[0]) / 4)
    panorama = np.repeat(np.repeat(waves[None, :, None], SIZE[1], 0), 3, 2).round().astype(np.uint8)
    size = size_of_faces(SIZE[0], SHOWN)
    front = faces_of(panorama, size, SHOWN)[0][size // 2, :, 0].astype(float)
    assert front.max() - front.min() > 0.9 * 200


def test_an_observation_in_any_face_is_at_the_same_direction_in_the_capture():
    rng = np.random.default_rng(0)
    size = size_of_faces(SIZE[0], SHOWN)
    for face in FACES:
        searched = size_of_faces(SIZE[0], SEARCHED)
        rays_there = rays_of(rng.uniform(0, searched, (20, 2)), face, searched)
        chosen, pixels = pixels_in_faces(rays_there, size)
        assert ((pixels >= 0) & (pixels <= size)).all()
        local = np.column_stack([(pixels - size / 2) / focal_of_faces(size, SHOWN), np.ones(20)])
        back = np.einsum("nji,nj->ni", np.array([FACES[i].rotation for i in chosen], float), local)
        lengths = [np.linalg.norm(each, axis=1, keepdims=True) for each in (back, rays_there)]
        assert_allclose(back / lengths[0], rays_there / lengths[1], atol=1e-12)


def test_the_rotations_of_faces_are_rotations():
    for face in FACES:
        matrix = np.array(face.rotation, float)
        assert_allclose(matrix @ matrix.T, np.eye(3))
        assert np.linalg.det(matrix) == pytest.approx(1)


@pytest.mark.parametrize(
    ("xmp", "size", "asked", "panorama", "wide"),
    [
        (WHOLE, SIZE, "auto", True, False),
        (
            WHOLE.replace('="equirectangular"/', ">equirectangular</GPano:ProjectionType"),
            SIZE,
            "auto",
            True,
            False,
        ),
        (WHOLE, SIZE, "none", False, False),
        (WHOLE, (500, 256), "all", False, False),
        (PART, SIZE, "auto", False, True),
        ("", SIZE, "auto", False, True),
        ("", SIZE, "all", True, False),
        ("", (400, 300), "auto", False, False),
    ],
)
def test_a_photo_is_a_panorama_if_its_shape_and_metadata_or_the_user_say_so(
    tmp_path, xmp, size, asked, panorama, wide
):
    Image.new("RGB", size).save(tmp_path / "a.jpg", xmp=xmp.encode())
    (photo,), _ = photos_of_folder(tmp_path, asked)
    assert (photo.panorama, photo.wide) == (panorama, wide)


def test_metadata_of_png_are_read_too(tmp_path):
    from PIL.PngImagePlugin import PngInfo

    told = PngInfo()
    told.add_itxt("XML:com.adobe.xmp", WHOLE)
    Image.new("RGB", SIZE).save(tmp_path / "a.png", pnginfo=told)
    assert photos_of_folder(tmp_path)[0][0].panorama


def test_photos_that_may_be_panoramas_and_do_not_fit_together_are_asked_about(tmp_path):
    (tmp_path / "photos").mkdir()
    rng = np.random.default_rng(0)
    for i in range(3):
        noise = Image.fromarray(rng.integers(0, 255, (30, 60, 3), np.uint8)).resize((120, 60))
        noise.save(tmp_path / "photos" / f"{i}.png")
    with pytest.raises(DatasetError, match="if they show 360 degrees, say so") as caught:
        reconstruct(tmp_path / "photos", tmp_path / "capture")
    assert caught.value.options == ("panoramas all",)


def test_panoramas_that_are_kept_are_not_undistorted(photos, tmp_path):
    with pytest.raises(InputError, match="6 photos of 360 degrees, which no pinhole camera can show"):
        reconstruct(photos, tmp_path, faces=False, undistort=True)


def test_a_panorama_has_the_reason_of_the_face_that_came_closest():
    photos = {"0-front.jpg": "a.jpg", "0-up.jpg": "a.jpg", "1.jpg": "b.jpg"}
    reasons = {"0-front.jpg": diagnosis.APART, "0-up.jpg": diagnosis.FEATURELESS, "1.jpg": diagnosis.ALONE}
    assert diagnosis.by_photo(photos, reasons) == {"a.jpg": diagnosis.APART, "b.jpg": diagnosis.ALONE}


def test_large_faces_are_shrunk_to_the_size_of_feature_extraction(tmp_path):
    Image.new("RGB", (9000, 4500)).save(tmp_path / "a.png")
    (photo,), _ = photos_of_folder(tmp_path, "all")
    assert pipeline.shrunk_size(photo, 1600) == (1600, 1600)
