"""Captures of other programs: a known point is where their own formulas say, in the undistorted photo."""

import json
from functools import partial

import foreign
import jax.numpy as jnp
import numpy as np
import pytest
from foreign import DEPTH, EYES, FILES, NAMED, NAMES, POINTS, world_from_cam
from numpy.testing import assert_allclose
from PIL import Image

import splatax as sx
from captures import frame, write_photos, write_transforms
from splatax.errors import DatasetError

FORMATS = {
    "metashape": foreign.metashape,
    "metashape fisheye": partial(foreign.metashape, kind="fisheye"),
    "realitycapture": foreign.realitycapture,
    "polycam": foreign.polycam,
    "record3d": foreign.record3d,
    "bundler": foreign.bundler,
    "nvm": foreign.nvm,
    "opensfm brown": foreign.opensfm,
    "opensfm fisheye": partial(foreign.opensfm, kind="fisheye"),
    "openmvg": foreign.openmvg,
    "openmvg pinhole": partial(foreign.openmvg, kind="pinhole"),
}


def seen(camera, point):
    """Pixel of a point, and its depth."""
    local = camera.to_camera(jnp.asarray(point, jnp.float32))
    return np.asarray(camera.to_pixel(local), float), float(local[2])


def centroid(picture, u, v, reach=5):
    """Centre of the light around a place, in pixels from the corner."""
    rows, columns = (slice(int(place) - reach, int(place) + reach + 1) for place in (v, u))
    light = picture[rows, columns].astype(float)
    y, x = np.mgrid[rows, columns] + 0.5
    return np.array([(light * x).sum(), (light * y).sum()]) / light.sum()


@pytest.mark.parametrize("undistort", [False, True], ids=["as they are", "undistorted"])
@pytest.mark.parametrize("name", FORMATS)
def test_known_points_are_at_the_right_pixels(name, undistort, tmp_path):
    FORMATS[name](tmp_path)
    dataset = sx.load_dataset(tmp_path, undistort=undistort)
    assert len(dataset.views) == len(EYES)
    for i, view in enumerate(dataset.views):
        assert_allclose(np.asarray(view.camera.position), EYES[i], atol=1e-5)
        picture = view.pixels()[..., 0]
        for point in POINTS:
            expected, _ = seen(view.camera, point)
            # Undistorting moves the light of a dot by far less than a pixel; a wrong sign of the weakest
            # coefficient moves it by more than half of one.
            assert_allclose(centroid(picture, *expected), expected, atol=0.15)


@pytest.mark.parametrize("name", ["metashape", "bundler", "nvm", "opensfm brown"])
def test_sparse_points_come_along_with_their_colors(name, tmp_path):
    FORMATS[name](tmp_path)
    points = sx.load_dataset(tmp_path).points
    assert_allclose(points.positions, POINTS, atol=1e-6)
    assert_allclose(points.colors, np.tile([[10, 20, 30]], (len(POINTS), 1)) / 255, atol=1e-6)


def test_points_without_colors_are_grey(tmp_path):
    foreign.openmvg(tmp_path)
    points = sx.load_dataset(tmp_path).points
    assert_allclose(points.positions, POINTS, atol=1e-6)
    assert (points.colors == 0.5).all()


@pytest.mark.parametrize(
    ("write", "note"),
    [
        (foreign.metashape, "1 cameras of cameras.xml are not aligned or switched off"),
        (foreign.bundler, "1 photos of the list are not registered"),
        (foreign.openmvg, "1 photos of sfm_data.json have no pose"),
        (foreign.opensfm, "2 reconstructions; using the largest"),
    ],
)
def test_photos_that_are_left_out_are_counted(write, note, tmp_path):
    write(tmp_path)
    assert note in sx.load_dataset(tmp_path).notes


@pytest.mark.parametrize(
    ("write", "model"),
    [
        (partial(foreign.metashape, k4=0.1), "frame with k4 = 0.1"),
        (partial(foreign.metashape, p3=0.1), "frame with p3 = 0.1"),
        (partial(foreign.metashape, b2=4.0), "frame with skew"),
        (partial(foreign.metashape, kind="spherical"), "spherical"),
        (partial(foreign.realitycapture, k4=0.1), "Brown4"),
        (partial(foreign.opensfm, kind="dual"), "dual"),
        (partial(foreign.opensfm, kind="fisheye62"), "fisheye62"),
        (partial(foreign.openmvg, kind="spherical"), "spherical"),
        (partial(foreign.nvm, r=4.0), "NVM with a radial distortion of 4"),
    ],
)
def test_lenses_that_cannot_be_undistorted_are_refused_by_name(write, model, tmp_path):
    write(tmp_path)
    with pytest.raises(DatasetError, match=f"the lens model {model}.*Export undistorted photos"):
        sx.load_dataset(tmp_path)


@pytest.mark.parametrize("write", NAMED, ids=lambda write: write.__name__)
def test_names_that_lead_out_of_the_capture_are_refused(write, tmp_path):
    (tmp_path / "scans").mkdir()
    foreign.write_photos(tmp_path / "scans", lambda i, point: (0, 0), ["mum.png"])
    capture = tmp_path / "scans" / "capture"
    write(capture, names=["../../mum.png", *NAMES[1:]])
    with pytest.raises(DatasetError, match="leads out of the capture's folder"):
        sx.load_dataset(capture)


@pytest.mark.parametrize("write", FILES, ids=lambda write: write.__name__)
def test_a_truncated_file_is_named(write, tmp_path):
    write(tmp_path)
    path = tmp_path / FILES[write][0]
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DatasetError, match=path.name):
        sx.load_dataset(tmp_path)


def test_angles_of_realitycapture_are_those_of_a_compass(tmp_path):
    """At zero the camera looks down with north at the top; a heading turns the top towards the east."""
    foreign.write_photos(tmp_path, lambda i, point: (0, 0), ["a.png", "b.png"])
    rows = ["#name,x,y,alt,heading,pitch,roll,f", "a.png,0,0,10,0,0,0,36", "b.png,0,0,10,90,0,0,36"]
    (tmp_path / "cameras.csv").write_text("\n".join(rows))
    level, turned = (view.camera for view in sx.load_dataset(tmp_path).views)
    north, east = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])
    for camera, top, right in ((level, north, east), (turned, east, -north)):
        assert_allclose(seen(camera, top)[0], [80, 60 - 16], atol=1e-3)
        assert_allclose(seen(camera, right)[0], [80 + 16, 60], atol=1e-3)


def test_cameras_far_from_the_origin_are_moved_near_it(tmp_path):
    """Projected coordinates have six digits before the point, and float32 has seven in all."""
    foreign.realitycapture(tmp_path)
    path = tmp_path / "registration.csv"
    lines = path.read_text().splitlines()
    far = []
    for line in lines[2:]:
        name, x, y, *rest = line.split(",")
        far.append(",".join([name, repr(float(x) + 500_000), repr(float(y) + 4_649_776), *rest]))
    path.write_text("\n".join([*lines[:2], *far]))
    dataset = sx.load_dataset(tmp_path)
    shifts = [np.asarray(view.camera.position) - eye for view, eye in zip(dataset.views, EYES, strict=True)]
    assert_allclose(shifts, np.tile(shifts[0], (len(EYES), 1)), atol=1e-5)
    assert np.abs(shifts[0]).max() < 3
    assert any("moved by -500000.3 -46497" in note for note in dataset.notes)


def test_photos_in_two_folders_with_one_name_are_not_guessed(tmp_path):
    foreign.realitycapture(tmp_path)
    (tmp_path / "images").rename(tmp_path / "left")
    foreign.write_photos(tmp_path / "right", lambda i, point: (0, 0))
    with pytest.raises(DatasetError, match=r"photo0.png may be 2 photos.*left/photo0.png"):
        sx.load_dataset(tmp_path)


def test_a_photo_is_found_in_any_folder_if_it_is_the_only_one(tmp_path):
    foreign.realitycapture(tmp_path)
    (tmp_path / "images").rename(tmp_path / "DCIM 100")
    assert [view.name for view in sx.load_dataset(tmp_path).views] == NAMES


# --- depth maps ---


@pytest.mark.parametrize("write", [foreign.polycam, foreign.record3d])
def test_points_come_from_depth_maps(write, tmp_path):
    write(tmp_path)
    dataset = sx.load_dataset(tmp_path)
    points = dataset.points.positions
    cameras = [view.camera for view in dataset.views]
    depths = [points @ np.asarray(c.rotation)[2] + np.asarray(c.translation)[2] for c in cameras]
    # Every point is at the depth of the map of some camera.
    assert_allclose(np.abs(np.array(depths) - DEPTH).min(axis=0), 0, atol=1e-4)
    pixels = 3 * 30 * 40 - (
        30 * 20 if write is foreign.polycam else 0
    )  # half of one map is not to be trusted
    assert len(dataset.points) == pixels
    assert "the points are from the depth maps of 3 photos" in dataset.notes


@pytest.mark.parametrize("suffix", [".png", ".npy"])
def test_depth_maps_of_nerfstudio_are_points_where_the_photo_has_their_color(suffix, tmp_path):
    capture = write_transforms(tmp_path, count=3)
    contents = json.loads((capture / "transforms.json").read_text())
    depth = np.zeros((24, 32), np.uint16)
    depth[6, 20] = 3000  # millimetres; zero is unknown
    if suffix == ".png":
        Image.fromarray(depth).save(tmp_path / "depth.png")
    else:
        np.save(tmp_path / "depth.npy", depth.astype(np.float32))
    contents["frames"][1]["depth_file_path"] = f"depth{suffix}"
    (capture / "transforms.json").write_text(json.dumps(contents))
    dataset = sx.load_dataset(capture)
    view = dataset.views[1]
    (point,) = dataset.points.positions
    pixel, depth = seen(view.camera, point)
    assert_allclose(depth, 3, rtol=1e-6)
    assert_allclose(view.landmarks(), [point], rtol=1e-6)
    assert_allclose(pixel, [41, 13], atol=1e-3)
    assert_allclose(dataset.points.colors[0], view.pixels()[13, 41] / 255, atol=1e-6)


def test_depth_maps_do_not_replace_sparse_points(tmp_path):
    capture = write_transforms(tmp_path, count=3, ply_file_path="p.ply")
    foreign.write_ply(tmp_path / "p.ply", POINTS)
    contents = json.loads((capture / "transforms.json").read_text())
    contents["frames"][1]["depth_file_path"] = "depth.png"
    (capture / "transforms.json").write_text(json.dumps(contents))
    foreign.write_depth(tmp_path / "depth.png")
    assert len(sx.load_dataset(capture).points) == len(POINTS)


@pytest.mark.parametrize("damage", ["shape", "colors", "text", "outside"])
def test_a_wrong_depth_map_is_refused(damage, tmp_path):
    capture = tmp_path / "capture"
    write_photos(capture, ["a.png"])
    name = "../depth.npy" if damage == "outside" else "depth.npy"
    frames = [frame("a.png", np.eye(4), depth_file_path=name)]
    (capture / "transforms.json").write_text(json.dumps({"fl_x": 60, "frames": frames}))
    arrays = {"shape": np.ones((10, 50)), "colors": np.ones((48, 64, 3)), "text": np.full((48, 64), "a")}
    np.save(capture / "depth.npy", arrays.get(damage, np.ones((48, 64))))
    with pytest.raises(DatasetError, match="depth"):
        sx.load_dataset(capture)


def test_rotations_of_the_written_captures_are_rotations():
    for i in range(len(EYES)):
        rotation, _ = world_from_cam(i)
        assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
