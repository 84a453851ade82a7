"""360-degree photos: recognised by their metadata, cut into faces, placed as rigs, and kept as they are."""

import math

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image
from scipy import ndimage

import corner
import splatax as sx
from splatax.cameras.lenses import Equirectangular
from splatax.errors import DatasetError, InputError
from splatax.reconstruction import diagnosis, pipeline, reconstruct
from splatax.reconstruction.panoramas import FACES, cut, focal_of_faces, pixels_in_panorama, size_of_faces
from splatax.reconstruction.photos import photos_in

SIZE, COUNT = (512, 256), 6
HALF = np.array([3.0, 1.5, 2.5])  # of a papered room
GPANO = (
    '<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:RDF xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#">'
    '<rdf:Description xmlns:GPano="http://ns.google.com/photos/1.0/panorama/" {}/></rdf:RDF></x:xmpmeta>'
)
WHOLE = GPANO.format('GPano:ProjectionType="equirectangular"')
PART = GPANO.format(
    'GPano:ProjectionType="equirectangular" GPano:CroppedAreaImageWidthPixels="512" '
    'GPano:FullPanoWidthPixels="1024"'
)


def rays():
    """Directions of the pixels of a panorama."""
    longitude = ((np.arange(SIZE[0]) + 0.5) / SIZE[0] - 0.5) * 2 * math.pi
    latitude = ((np.arange(SIZE[1]) + 0.5) / SIZE[1] - 0.5) * math.pi
    longitude, latitude = np.meshgrid(longitude, latitude)
    aside = np.cos(latitude)
    return np.stack([aside * np.sin(longitude), np.sin(latitude), aside * np.cos(longitude)], axis=-1)


def turned(angle):
    """World from camera: a turn about the vertical axis."""
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])


def positions():
    rng = np.random.default_rng(5)
    return np.column_stack([np.linspace(-1, 1, COUNT), *rng.uniform(-0.3, 0.3, (2, COUNT))])


def photograph(position, angle, papers):
    """The room from a place: each wall has its own paper."""
    directions = rays() @ turned(angle).T
    times = (np.copysign(HALF, directions) - position) / directions
    axis, time = times.argmin(axis=-1), times.min(axis=-1)
    hits = position + time[..., None] * directions
    picture = np.zeros((*axis.shape, 3))
    for wall in range(3):
        for side in (0, 1):
            on = (axis == wall) & ((directions[..., wall] > 0) == side)
            u, v = (hits[on][:, (wall + k) % 3] * 90 for k in (1, 2))
            at = [u + 450, v + 700]
            for c in range(3):
                paper = papers[2 * wall + side][..., c]
                picture[on, c] = ndimage.map_coordinates(paper, at, order=1, mode="mirror")
    return picture.astype(np.uint8)


@pytest.fixture(scope="module")
def photos(tmp_path_factory):
    folder = tmp_path_factory.mktemp("room") / "photos"
    folder.mkdir()
    papers = [corner.wallpaper(seed) for seed in range(6)]
    for i, position in enumerate(positions()):
        picture = Image.fromarray(photograph(position, 0.7 * i, papers))
        picture.save(folder / f"room {i}.jpg", quality=95, xmp=WHOLE.encode())
    return folder


@pytest.fixture(scope="module")
def outcome(photos, tmp_path_factory):
    out = tmp_path_factory.mktemp("room") / "capture"
    return out, reconstruct(photos, out)


def spread(places):
    """Distances between all pairs, in units of their mean: the same after any similarity."""
    apart = np.linalg.norm(places[:, None] - places[None, :], axis=-1)
    return apart / apart.mean()


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


def test_features_of_faces_are_observations_of_the_panorama(outcome):
    dataset = sx.load_dataset(outcome[0])
    errors = np.concatenate(list(dataset.survey.errors.values()))
    assert len(errors) > 1000
    assert np.median(errors) < 0.5  # pixels
    assert outcome[1].error < 1
    seen = np.concatenate([view.landmarks() - np.asarray(view.camera.position) for view in dataset.views])
    sides = {(axis, side) for axis in range(3) for side in (-1, 1) if (side * seen[:, axis] > 0.1).any()}
    assert len(sides) == 6


def test_a_face_shows_what_the_panorama_shows_there():
    colors = np.round(127.5 + 127.5 * rays()).astype(np.uint8)  # the direction itself
    size = size_of_faces(SIZE[0], 1600)
    for face in FACES:
        pixels = np.array([[0.5, 0.5], [size / 2, size / 2], [size - 0.5, 10.5]])
        local = np.column_stack([(pixels - size / 2) / focal_of_faces(size), np.ones(3)])
        directions = local / np.linalg.norm(local, axis=1, keepdims=True) @ np.array(face.rotation, float)
        x, y = pixels.astype(int).T
        shown = cut(colors, face, size)[y, x] / 127.5 - 1
        assert_allclose(
            shown, directions, atol=0.03
        )  # of a pixel, which is 0.012 wide, and its interpolation
        columns, rows = np.floor(pixels_in_panorama(pixels, face, size, SIZE)).astype(int).T
        there = colors[np.clip(rows, 0, 255), columns % 512] / 127.5 - 1
        assert_allclose(there, directions, atol=0.03)


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
    (photo,), _ = photos_in(tmp_path, asked)
    assert (photo.panorama, photo.wide) == (panorama, wide)


def test_metadata_of_png_are_read_too(tmp_path):
    from PIL.PngImagePlugin import PngInfo

    told = PngInfo()
    told.add_itxt("XML:com.adobe.xmp", WHOLE)
    Image.new("RGB", SIZE).save(tmp_path / "a.png", pnginfo=told)
    assert photos_in(tmp_path)[0][0].panorama


def test_photos_that_may_be_panoramas_and_do_not_fit_together_are_asked_about(tmp_path):
    (tmp_path / "photos").mkdir()
    rng = np.random.default_rng(0)
    for i in range(3):
        noise = Image.fromarray(rng.integers(0, 255, (30, 60, 3), np.uint8)).resize((120, 60))
        noise.save(tmp_path / "photos" / f"{i}.png")
    with pytest.raises(DatasetError, match="if they show 360 degrees, say so") as caught:
        reconstruct(tmp_path / "photos", tmp_path / "capture")
    assert caught.value.options == ("panoramas all",)


def test_panoramas_are_not_undistorted(photos, tmp_path):
    with pytest.raises(InputError, match="6 photos of 360 degrees, which no pinhole camera can show"):
        reconstruct(photos, tmp_path, undistort=True)


def test_a_panorama_has_the_reason_of_the_face_that_came_closest():
    photos = {"0-front.jpg": "a.jpg", "0-up.jpg": "a.jpg", "1.jpg": "b.jpg"}
    reasons = {"0-front.jpg": diagnosis.APART, "0-up.jpg": diagnosis.FEATURELESS, "1.jpg": diagnosis.ALONE}
    assert diagnosis.by_photo(photos, reasons) == {"a.jpg": diagnosis.APART, "b.jpg": diagnosis.ALONE}


def test_large_faces_are_shrunk_to_the_size_of_feature_extraction(tmp_path):
    Image.new("RGB", (9000, 4500)).save(tmp_path / "a.png")
    (photo,), _ = photos_in(tmp_path, "all")
    assert pipeline.shrunk_size(photo, 1600) == (1600, 1600)
