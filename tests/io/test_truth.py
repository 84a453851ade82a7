"""True geometry beside the photos of a capture."""

import numpy as np
import pycolmap
import pytest
from PIL import Image

import captures
import splatax as sx
from splatax.errors import DatasetError


@pytest.fixture
def capture(tmp_path):
    return captures.write_capture(tmp_path / "capture", count=3)


def write(capture, kind, name, values):
    path = capture / "truth" / kind / name
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, values)
    return path


def first_view(capture, **options):
    return sx.load_dataset(capture, **options).views[0]


def test_depth_and_normals_are_read_in_world_units_and_as_unit_vectors(capture):
    depth = np.linspace(0, 2, 48 * 64, dtype=np.float32).reshape(48, 64)
    depth[0, :3] = -1, np.nan, np.inf
    normals = np.zeros((48, 64, 3), np.float16)
    normals[..., 1] = 0.9
    normals[0] = 0
    write(capture, "depth", "photo00.npy", depth)
    write(capture, "normals", "photo00.npy", normals)
    dataset = sx.load_dataset(capture)
    assert dataset.views[1].truth is None
    assert "true depth of 1 photo, for evaluation" in dataset.notes
    truth = dataset.views[0].truth()
    np.testing.assert_array_equal(truth.depth[1:], depth[1:])
    assert (truth.depth[0, :3] == 0).all()  # unknown
    assert (truth.normals[1:] == [0, 1, 0]).all()
    assert (truth.normals[0] == 0).all()


def test_depth_in_a_picture_is_in_thousandths(capture):
    folder = capture / "truth" / "depth"
    folder.mkdir(parents=True)
    Image.fromarray(np.full((24, 32), 1500, np.uint16)).save(folder / "photo00.png.png")
    truth = first_view(capture).truth()
    assert (truth.depth == 1.5).all()
    assert truth.normals is None


@pytest.mark.parametrize(
    ("kind", "values", "message"),
    [
        ("depth", np.zeros((4, 4, 2)), "not a depth map"),
        ("normals", np.zeros((48, 64)), "not a map of normals, but float64 numbers of shape"),
        ("normals", np.zeros((48, 64, 3), int), "not a map of normals"),
        ("normals", np.ones((4, 4, 3)), "another size than photo00.npy"),
    ],
)
def test_damaged_truth_is_refused_by_name(capture, kind, values, message):
    write(capture, "depth", "photo00.npy", np.ones((48, 64)))
    path = write(capture, kind, "photo00.npy", values)
    with pytest.raises(DatasetError, match=message) as refused:
        first_view(capture).truth()
    assert str(path) in str(refused.value)


def test_normals_that_are_no_array_are_refused_by_name(capture):
    write(capture, "depth", "photo00.npy", np.ones((48, 64)))
    path = write(capture, "normals", "photo00.npy", np.ones((48, 64, 3)))
    path.write_bytes(path.read_bytes()[:300])
    with pytest.raises(DatasetError, match=r"normals/photo00\.npy: not a map of normals that can be read"):
        first_view(capture).truth()


def test_truth_of_no_photo_is_refused(capture):
    write(capture, "depth", "other.npy", np.ones((48, 64)))
    with pytest.raises(DatasetError, match="none of its files has the name of a registered photo"):
        sx.load_dataset(capture)


def test_undistorted_photos_have_no_truth_and_the_capture_says_so(tmp_path):
    bent = pycolmap.Camera(model="SIMPLE_RADIAL", width=64, height=48, params=[60, 32, 24, 0.05], camera_id=1)
    capture = captures.write_capture(tmp_path / "bent", count=3, camera=bent)
    write(capture, "depth", "photo00.npy", np.ones((48, 64)))
    assert first_view(capture).truth is not None
    dataset = sx.load_dataset(capture, undistort=True)
    assert dataset.views[0].truth is None
    assert "true depth of 1 photo is not used, because they are undistorted" in dataset.notes
