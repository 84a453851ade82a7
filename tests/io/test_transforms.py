"""transforms.json of nerfstudio, instant-ngp and Blender: small ones, then broken in every usual way."""

import json
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import splatax as sx
from captures import POINTS, POSES, SIZE, frame, write_blender, write_capture, write_photos, write_transforms
from splatax.cameras.lenses import Equirectangular, Fisheye, Orthographic
from splatax.errors import DatasetError

APPLIED = [[1, 0, 0, 0.5], [0, 0, 1, 0.25], [0, -1, 0, -1]]  # a turn, as nerfstudio's, and a shift


@pytest.fixture
def capture(tmp_path):
    return write_transforms(tmp_path / "capture")


def rewrite(capture, name="transforms.json", **entries):
    path = capture / name
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def same_cameras(a, b):
    for x, y in zip(a.views, b.views, strict=True):
        assert x.name == y.name
        for p, q in zip(jax.tree.leaves(x.camera), jax.tree.leaves(y.camera), strict=True):
            assert_allclose(p, q, atol=2e-6, rtol=1e-5)


def test_the_same_cameras_as_from_colmap(capture, tmp_path):
    colmap, transforms = sx.load_dataset(write_capture(tmp_path / "colmap")), sx.load_dataset(capture)
    same_cameras(colmap, transforms)
    assert [v.name for v in transforms.test] == [v.name for v in colmap.test]


def test_intrinsics_of_another_size_follow_the_photos(tmp_path):
    capture = write_transforms(tmp_path / "capture", photo_size=(32, 24))
    camera = sx.load_dataset(capture).train[0].camera
    assert (camera.width, camera.height) == (32, 24)
    assert_allclose([camera.fx, camera.fy, camera.cx, camera.cy], [30, 30.5, 15, 12.5])


def test_a_frame_may_have_a_lens_of_its_own(capture):
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    frames[1] |= {"fl_x": 70, "cx": 33}
    rewrite(capture, frames=frames)
    first, second = (sx.load_dataset(capture).views[i].camera for i in (0, 1))
    assert_allclose([first.fx, first.fy, first.cx], [60, 61, 30])
    assert_allclose([second.fx, second.fy, second.cx], [70, 61, 33])


def test_field_of_view_stands_in_for_focal_length(tmp_path):
    capture = write_blender(tmp_path / "capture")
    camera = sx.load_dataset(capture).train[0].camera
    assert_allclose(camera.fx, 0.5 * 64 / math.tan(0.4), rtol=1e-6)
    assert_allclose([camera.fy, camera.cx, camera.cy], [camera.fx, 32, 24])


def test_what_was_applied_to_poses_and_points_is_undone(capture, tmp_path):
    world = np.vstack([APPLIED, [0, 0, 0, 1]])
    names = [f"images/photo{i:02}.png" for i in range(9)]
    moved = [frame(name, pose @ np.linalg.inv(world)) for name, pose in zip(names, POSES, strict=True)]
    rows = POINTS @ world[:3, :3].T + world[:3, 3]
    header = "ply\nformat ascii 1.0\nelement vertex 30\n"
    header += "".join(f"property float {c}\n" for c in "xyz")
    header += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    lines = [" ".join([*map(repr, row.tolist()), "10 20 255"]) for row in rows]
    (capture / "sparse_pc.ply").write_text(header + "\n".join(lines) + "\n")
    rewrite(capture, frames=moved, applied_transform=APPLIED, ply_file_path="sparse_pc.ply")
    dataset = sx.load_dataset(capture)
    same_cameras(dataset, sx.load_dataset(write_transforms(tmp_path / "original")))
    assert_allclose(dataset.points.positions, POINTS, atol=1e-5)
    assert_allclose(dataset.points.colors[0], np.array([10, 20, 255]) / 255, rtol=1e-6)


def test_distorted_photos_become_a_pinholes(tmp_path):
    """A spot drawn where OpenCV's lens puts a point is where the loaded pinhole puts it."""
    k1, k2, p1, p2 = 0.08, -0.03, 0.004, -0.003
    capture = write_transforms(tmp_path / "capture", k1=k1, k2=k2, p1=p1, p2=p2)
    x, y = slope = np.array([0.2, -0.15])
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2 * r2
    bent = [
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    ]
    u, v = np.array(bent) * [60, 61] + [30, 25]
    rows, columns = np.mgrid[:48, :64] + 0.5
    spot = 255 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 8)
    Image.fromarray(np.repeat(spot[..., None], 3, 2).astype(np.uint8)).save(
        capture / "images" / "photo01.png"
    )
    view = sx.load_dataset(capture).views[1]
    pixels = view.pixels()[..., 0].astype(float)
    rows, columns = np.mgrid[: view.camera.height, : view.camera.width] + 0.5
    centre = np.array([np.sum(pixels * columns), np.sum(pixels * rows)]) / pixels.sum()
    point = jnp.asarray([*slope, 1], jnp.float32)
    assert_allclose(centre, view.camera.to_pixel(point), atol=0.1)  # half a pixel off is a wrong convention


def test_fisheye_has_either_name(tmp_path):
    named = write_transforms(tmp_path / "named", camera_model="OPENCV_FISHEYE", k1=0.02)
    flagged = write_transforms(tmp_path / "flagged", is_fisheye=True, k1=0.02)
    a, b = sx.load_dataset(named), sx.load_dataset(flagged)
    assert "OPENCV_FISHEYE" in a.survey.lenses["photo00.png"]
    same_cameras(a, b)
    assert a.train[0].pixels().shape[:2] == (a.train[0].camera.height, a.train[0].camera.width)
    assert isinstance(a.train[0].camera.lens, Fisheye)


def test_panoramas_and_orthophotos_have_their_lenses(tmp_path):
    whole = sx.load_dataset(write_transforms(tmp_path / "whole", camera_model="EQUIRECTANGULAR"))
    camera = whole.train[0].camera
    assert isinstance(camera.lens, Equirectangular)
    assert_allclose([camera.fx * 2 * np.pi, camera.fy * np.pi], [64, 48], rtol=1e-6)
    flat = sx.load_dataset(write_transforms(tmp_path / "flat", camera_model="ORTHOPHOTO")).train[0].camera
    assert isinstance(flat.lens, Orthographic)
    assert_allclose(
        flat.to_pixel(jnp.array([0.1, 0.2, 7.0])), [36, 37.2], rtol=1e-6
    )  # 60 and 61 pixels a unit


def test_frames_without_a_photo_are_left_out_and_said(capture):
    for i in (2, 4):
        (capture / "images" / f"photo0{i}.png").unlink()
    dataset = sx.load_dataset(capture)
    assert len(dataset.views) == 7
    assert "2 of 9 frames have no photo: images/photo02.png, images/photo04.png" in dataset.notes


def test_masks_that_frames_name_are_used(capture):
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    frames[1]["mask_path"] = "holes/one.png"
    rewrite(capture, frames=frames)
    (capture / "holes").mkdir()
    half = np.zeros((48, 64), np.uint8)
    half[:, :32] = 255
    Image.fromarray(half).save(capture / "holes" / "one.png")
    view = sx.load_dataset(capture).views[1]
    assert_array_equal(view.mask(), half > 0)


def test_the_capture_may_say_itself_what_is_held_out(capture):
    rewrite(capture, test_filenames=["images/photo03.png", "./images/photo05.png"])
    assert [view.name for view in sx.load_dataset(capture).test] == ["photo03.png", "photo05.png"]
    rewrite(capture, test_filenames=None, train_filenames=[f"images/photo0{i}.png" for i in range(7)])
    assert [view.name for view in sx.load_dataset(capture).test] == ["photo07.png", "photo08.png"]


def test_blender_scenes_hold_out_their_test_photos_and_are_seen_over_white(tmp_path):
    dataset = sx.load_dataset(write_blender(tmp_path / "capture"))
    assert [view.name for view in dataset.train] == ["train/r_0.png", "train/r_1.png", "train/r_2.png"]
    assert [view.name for view in dataset.test] == ["test/r_0.png", "test/r_1.png", "test/r_2.png"]
    assert dataset.background == "white"
    assert dataset.train[0].pixels().shape == (48, 64, 4)


def test_blender_scenes_with_a_train_file_alone_hold_out_every_eighth(tmp_path):
    dataset = sx.load_dataset(write_blender(tmp_path / "capture", splits=("train",), count=9))
    assert [view.name for view in dataset.test] == ["r_4.png"]


def test_photos_beside_them_are_surveyed(capture):
    write_photos(capture / "images", ["extra.png"])
    survey = sx.load_dataset(capture).survey
    assert survey.unused == ("extra.png",)
    assert survey.files["photo00.png"] == capture / "images" / "photo00.png"
    assert survey.lenses["photo00.png"].startswith(f"OPENCV {SIZE[0]} x {SIZE[1]}, fx=60 fy=61 cx=30 cy=25")


# --- bad input: one sentence with the file and the way out ---


def refuse(capture, match):
    with pytest.raises(DatasetError, match=match) as error:
        sx.load_dataset(capture)
    assert str(capture) in str(error.value)


@pytest.mark.parametrize(
    "contents", ["", "{", "[]", "{}", '{"frames": []}', '{"frames": [1]}', "\x00", "[" * 10**5]
)
def test_a_file_without_frames(capture, contents):
    (capture / "transforms.json").write_text(contents)
    refuse(capture, "not valid JSON|no list of")


NAN = float("nan")
SKEWED = np.eye(4).tolist()
SKEWED[0][1] = 0.5
BAD_MATRICES = [
    [[NAN] * 4] * 4, "pose", 3, [[1, 2], [3]], np.eye(3).tolist(), (2 * np.eye(4)).tolist(), SKEWED,
    np.diag([1.0, 1, -1, 1]).tolist(), {}, [["1"] * 4] * 4,
]  # fmt: skip


@pytest.mark.parametrize("matrix", BAD_MATRICES)
def test_a_pose_that_is_none(capture, matrix):
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    frames[2]["transform_matrix"] = matrix
    rewrite(capture, frames=frames)
    refuse(capture, r"frame 2: transform_matrix should be")


@pytest.mark.parametrize("key", ["file_path", "transform_matrix"])
def test_a_frame_without_photo_or_pose(capture, key):
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    del frames[3][key]
    rewrite(capture, frames=frames)
    refuse(capture, f"frame 3: it has no {key}")


@pytest.mark.parametrize(
    "name", ["/etc/passwd", "../secret.png", "images/../../x.png", "..\\x.png", "C:\\x.png", "", 7]
)
@pytest.mark.parametrize("key", ["file_path", "mask_path"])
def test_a_path_that_leaves_the_capture(capture, key, name):
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    frames[0][key] = name
    rewrite(capture, frames=frames)
    refuse(capture, "leads out of the capture's folder|should be text")


@pytest.mark.parametrize(
    ("entries", "match"),
    [
        ({"fl_x": "60"}, "fl_x should be a finite number"),
        ({"fl_x": -60}, "fl_x should be a number above zero"),
        ({"fl_x": NAN}, "fl_x should be a finite number"),
        ({"fl_x": None, "fl_y": None}, "no focal length"),
        ({"w": 0}, "w should be a number above zero"),
        ({"w": 100}, "other proportions"),
        ({"k1": [1]}, "k1 should be a finite number"),
        ({"k4": 0.1}, "k4 should be zero"),
        ({"camera_model": "VR180"}, "camera_model should be one of"),
        ({"applied_transform": [[1, 2, 3]]}, "applied_transform should be a 4 x 4 matrix"),
        ({"ply_file_path": "points.ply"}, "points.ply: no such file, but transforms.json names it"),
        ({"ply_file_path": "../points.ply"}, "leads out of the capture"),
        ({"test_filenames": ["other.png"]}, "test_filenames names other.png, which no frame has"),
        ({"test_filenames": "all"}, "test_filenames should be a list of photos"),
        ({"test_filenames": [f"images/photo0{i}.png" for i in range(9)]}, "all photos that are"),
    ],
)  # fmt: skip
def test_wrong_entries(capture, entries, match):
    rewrite(capture, **entries)
    refuse(capture, match)


def test_photos_that_are_not_there(capture):
    for photo in (capture / "images").iterdir():
        photo.unlink()
    refuse(capture, "none of its 9 photos is there; the first should be .*photo00.png")


def test_a_photo_of_two_frames(capture):
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    rewrite(capture, frames=[*frames, frames[0]])
    refuse(capture, "images/photo00.png is the photo of two frames")


def test_a_damaged_ply(capture):
    (capture / "points.ply").write_bytes(b"ply\nformat binary_little_endian 1.0\nelement vertex 9\n")
    rewrite(capture, ply_file_path="points.ply")
    refuse(capture, "points.ply: no coloured points can be read from it")
