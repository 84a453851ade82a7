"""Damaged captures and scenes that caused a traceback: each gives one sentence that names the file."""

import gzip
import json
import struct
import time
import zipfile
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest

import splatax as sx
from captures import frame, write_capture, write_llff, write_transforms, zipped
from scenes import camera_at, random_gaussians
from splatax import backends
from splatax.errors import DatasetError, FormatError, InputError
from splatax.io.damage import blamed_on
from splatax.io.datasets.colmap_files import check_whole

SECOND = 2.0  # of the processor, and twice that: shapes are checked in tests


def refuse(path, match):
    with pytest.raises(InputError, match=match) as error:
        sx.load_dataset(path) if path.is_dir() or path.suffix == ".zip" else sx.load(path)
    assert str(path) in str(error.value)
    assert str(error.value).isprintable()


def edit(capture, **entries):
    path = capture / "transforms.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | entries))


def edit_frame(capture, **entries):
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    edit(capture, frames=[frames[0] | entries, *frames[1:]])


# --- the wrapper ---


@pytest.mark.parametrize(
    "error", [IndexError(), KeyError("x"), SyntaxError("bad"), MemoryError(), OSError(22, "Invalid")]
)
def test_whatever_a_reader_raises_names_the_file(tmp_path, error):
    with (
        pytest.raises(DatasetError, match=rf"{tmp_path}/a: damaged \(.+\)\. Copy it again\."),
        blamed_on(tmp_path / "a", "damaged", "Copy it again.", DatasetError),
    ):
        raise error


def test_errors_of_the_file_system_stay_what_they_are_and_name_the_file(tmp_path):
    with (
        pytest.raises(OSError, match="Input/output") as error,
        blamed_on(tmp_path / "a", "damaged", "Copy it again.", DatasetError),
    ):
        raise OSError(5, "Input/output error")
    assert error.value.filename == str(tmp_path / "a")


# --- cameras ---


@pytest.mark.parametrize("text", [False, True])
def test_a_camera_without_pixels(tmp_path, text):
    capture = write_capture(tmp_path / "capture", text=text)
    path = capture / "sparse" / "0" / ("cameras.txt" if text else "cameras.bin")
    contents = path.read_bytes()
    old, new = (b" 64 48 ", b" 0 48 ") if text else (struct.pack("<QQ", 64, 48), struct.pack("<QQ", 0, 48))
    path.write_bytes(contents.replace(old, new))
    refuse(capture, "its camera is 0 x 48 pixels")


@pytest.mark.parametrize("focal", [np.nan, np.inf, 0.0, -60.0, 1e300, 1e-300])
def test_a_focal_length_that_no_lens_has(tmp_path, focal):
    capture = write_capture(tmp_path / "capture")
    path = capture / "sparse" / "0" / "cameras.bin"
    path.write_bytes(path.read_bytes().replace(struct.pack("<d", 60), struct.pack("<d", focal)))
    refuse(capture, "its camera is 64 x 48 pixels with the parameters .* which no photo has")


def test_a_pose_of_colmap_that_is_not_finite(tmp_path):
    capture = write_capture(tmp_path / "capture")
    for name in ("rigs.bin", "frames.bin"):  # of newer versions, which keep the poses there
        (capture / "sparse" / "0" / name).unlink()
    path = capture / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes().replace(struct.pack("<d", 0.1), struct.pack("<d", np.nan), 1))
    refuse(capture, "its pose has numbers that are not finite")


@pytest.mark.parametrize("size", [0, 0.2, 1e300, np.nan])
def test_sizes_of_llff_that_no_photo_has(tmp_path, size):
    capture = write_llff(tmp_path / "capture")
    rows = np.load(capture / "poses_bounds.npy")
    rows[2, 9] = size  # the width
    np.save(capture / "poses_bounds.npy", rows)
    refuse(capture, "row 2 is no pose")


@pytest.mark.parametrize(
    "header",
    [
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (9, 17",  # SyntaxError or TokenError
        b"{'descr': '<f8', 'fortran_order': False, 'shape': (4294967296, 17), }",  # 544 GiB
        b"{'descr': '|O', 'fortran_order': False, 'shape': (9, 17), }",  # a pickle
        b"{'descr': '<f8', 'fortran_order': " + b"(" * 200 + b", 'shape': (9, 17), }",
    ],
)
def test_headers_of_npy_files(tmp_path, header):
    capture = write_llff(tmp_path / "capture")
    body = (capture / "poses_bounds.npy").read_bytes()[128:]
    padded = header.ljust(500) + b"\n"
    contents = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(padded)) + padded + body
    (capture / "poses_bounds.npy").write_bytes(contents)
    refuse(capture, r"poses_bounds.npy: not an array that NumPy can read \(.+\). Copy it again")


# --- transforms.json ---


def test_a_mark_of_byte_order_is_accepted(tmp_path):
    capture = write_transforms(tmp_path / "capture")
    file = capture / "transforms.json"
    file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes())
    assert len(sx.load_dataset(capture).views) == 9


@pytest.mark.parametrize("key", ["w", "fl_x", "k1", "cx"])
def test_numbers_too_large_for_any_float(tmp_path, key):
    capture = write_transforms(tmp_path / "capture")
    edit(capture, **{key: 10**400})
    refuse(capture, f"{key} should be a finite number, not a huge number")


@pytest.mark.parametrize("width", [1e300, 1e9, 0.3])
def test_a_width_that_no_photo_has(tmp_path, width):
    capture = write_transforms(tmp_path / "capture")
    edit(capture, w=width)
    refuse(capture, "w should be a number of pixels")


def test_a_pose_of_huge_numbers(tmp_path):
    capture = write_transforms(tmp_path / "capture")
    edit_frame(capture, transform_matrix=[[10**400] * 4] * 4)
    refuse(capture, "frame 0: transform_matrix should be a 4 x 4 matrix of finite numbers")


@pytest.mark.parametrize("name", [".", "./", "\ud800.png", "images/\x1b[2J.png"])
def test_file_paths_that_are_not_names(tmp_path, name):
    capture = write_transforms(tmp_path / "capture")
    edit_frame(capture, file_path=name)
    refuse(capture, "frame 0: .*(not the name of a file|control characters)")


def test_poses_of_both_forms_in_one_file(tmp_path):
    capture = write_transforms(tmp_path / "capture")
    expected = sx.load_dataset(capture)
    frames = json.loads((capture / "transforms.json").read_text())["frames"]
    edit_frame(capture, transform_matrix=frames[0]["transform_matrix"][:3])
    for a, b in zip(sx.load_dataset(capture).views, expected.views, strict=True):
        assert (a.camera.cam_from_world == b.camera.cam_from_world).all()


def test_a_million_frames_are_refused_at_once(tmp_path):
    one = json.dumps(frame("images/a.png", np.eye(4))).encode()
    (tmp_path / "transforms.json").write_bytes(b'{"frames": [' + b",".join([one] * 1_000_000) + b"]}")
    began = time.process_time()
    refuse(tmp_path, "1,000,001 frames, and at most 200,000 are read")
    assert time.process_time() - began < SECOND


# --- zip files ---


def test_a_damaged_directory_of_a_zip_is_the_files_fault(tmp_path):
    """Its offsets lead before the beginning of the file: errno 22, but no fault of the file system."""
    path = zipped(write_transforms(tmp_path / "capture"), tmp_path / "capture.zip")
    contents = path.read_bytes()
    end = contents.rindex(b"PK\x05\x06")
    offset = struct.unpack_from("<I", contents, end + 16)[0]
    path.write_bytes(contents[: end + 16] + struct.pack("<I", offset + 10**6) + contents[end + 20 :])
    refuse(path, "not a zip file that can be unpacked")


@pytest.mark.parametrize("name", ["images/\x1b[31m.png", "images/a\nb.png"])
def test_names_in_zips_have_no_control_characters(tmp_path, name):
    with zipfile.ZipFile(tmp_path / "capture.zip", "w") as archive:
        archive.writestr(name, "x")
    refuse(tmp_path / "capture.zip", "control characters")


def test_folders_in_zips_may_be_named_as_windows_does(tmp_path):
    folder = write_transforms(tmp_path / "capture")
    path = tmp_path / "capture.zip"
    with zipfile.ZipFile(path, "w") as archive:
        for file in sorted(p for p in folder.rglob("*") if p.is_file()):
            entry = zipfile.ZipInfo("x")
            entry.filename = str(file.relative_to(folder)).replace("/", "\\")
            archive.writestr(entry, file.read_bytes())
    assert len(sx.load_dataset(path).views) == 9


# --- splat files ---


def test_a_ply_header_of_30000_properties_is_read_at_once(tmp_path):
    names = b"".join(b"property float p%d\n" % i for i in range(30_000))
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n" + names + b"end_header\n"
    (tmp_path / "a.ply").write_bytes(header + bytes(4 * 30_000))
    began = time.process_time()
    refuse(tmp_path / "a.ply", "not splats")
    assert time.process_time() - began < SECOND


def glb(path, counts, repeat=1):
    """A .glb whose attributes have their own number of rows."""
    prefix = "KHR_gaussian_splatting"
    widths = {"POSITION": 3, "ROTATION": 4, "SCALE": 3, "OPACITY": 1, "SH_DEGREE_0_COEF_0": 3}
    accessors, views, body, attributes = [], [], b"", {}
    for i, (name, width) in enumerate(widths.items()):
        values = np.full((counts.get(name, counts["*"]), width), 0.5, "<f4")
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[width]
        accessors.append({"bufferView": i, "count": len(values), "type": kind, "componentType": 5126})
        views.append({"buffer": 0, "byteOffset": len(body), "byteLength": values.nbytes})
        attributes[name if name == "POSITION" else f"{prefix}:{name}"] = i
        body += values.tobytes()
    primitive = {"attributes": attributes, "mode": 0, "extensions": {prefix: {}}}
    gltf = {
        "asset": {"version": "2.0"},
        "scenes": [{"nodes": [0] * repeat}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": len(body)}],
    }
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(body), b"BIN\0") + body
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)


@pytest.mark.parametrize("attribute", ["POSITION", "ROTATION", "SCALE", "OPACITY", "SH_DEGREE_0_COEF_0"])
@pytest.mark.parametrize(("own", "others"), [(1, 3000), (3000, 1), (0, 5)])
def test_attributes_of_a_glb_have_one_count(tmp_path, attribute, own, others):
    glb(tmp_path / "a.glb", {"*": others, attribute: own})
    wrong = rf"{attribute} has {own:,} rows, but POSITION has {others:,}"
    if attribute == "POSITION":
        wrong = rf"ROTATION has {others:,} rows, but POSITION has {own:,}"
    refuse(tmp_path / "a.glb", wrong)


@pytest.mark.slow
def test_a_glb_that_repeats_its_splats_until_no_memory_is_left(tmp_path):
    glb(tmp_path / "a.glb", {"*": 2000}, repeat=5)
    assert len(sx.load(tmp_path / "a.glb")) == 10_000
    glb(tmp_path / "a.glb", {"*": 2000}, repeat=9999)
    refuse(tmp_path / "a.glb", "its nodes ask for 19,998,000 Gaussians")


def test_arrays_that_do_not_fit_together_leave_no_reader(tmp_path, monkeypatch):
    """Whatever a format's own code forgets to compare."""
    good = random_gaussians(n=4)
    bad = replace(good, quats=good.quats[:1])
    sx.save(tmp_path / "a.ply", good)
    monkeypatch.setattr("splatax.io.formats.ply.load", lambda path: bad)
    refuse(tmp_path / "a.ply", r"quats has shape \(1, 4\), but it must have shape \(n, 4\)")


@pytest.mark.parametrize("version", [1, 2, 3])
def test_an_spz_file_of_no_gaussians_is_an_empty_scene(tmp_path, version):
    header = struct.pack("<4sIIBBBB", b"NGSP", version, 0, 1, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(header))
    scene = sx.load(tmp_path / "a.spz")
    assert (len(scene), scene.sh_degree) == (0, 1)


def test_a_ksplat_section_of_no_gaussians_may_claim_harmonics(tmp_path, data):
    contents = bytearray((data / "splats" / "minimal.ksplat").read_bytes())
    empty = bytearray(contents[4096:5120])
    struct.pack_into("<II", empty, 0, 0, 0)  # Gaussians, and room for them
    struct.pack_into("<I", empty, 12, 0)  # buckets
    struct.pack_into("<II", empty, 32, 0, 0)
    struct.pack_into("<H", empty, 40, 1)  # SH degree
    struct.pack_into("<II", contents, 4, 2, 2)  # sections
    (tmp_path / "a.ksplat").write_bytes(bytes(contents[:5120]) + bytes(empty) + bytes(contents[5120:]))
    plain = sx.load(data / "splats" / "minimal.ksplat")
    for a, b in zip(jax.tree.leaves(sx.load(tmp_path / "a.ksplat")), jax.tree.leaves(plain), strict=True):
        assert (a == b).all()


def test_messages_about_huge_names_stay_short(tmp_path):
    body = (
        b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float " + b"x\x1b" * 10**5 + b" y z\nend_header\n"
    )
    (tmp_path / "a.ply").write_bytes(body)
    refuse(tmp_path / "a.ply", "not a valid PLY header")


# --- opacities ---


@pytest.mark.parametrize("backend", ["reference", "xla", "cpu"])
def test_a_fully_opaque_gaussian_is_drawn_as_one_of_a_large_logit(backend):
    scene, camera = random_gaussians(n=20), camera_at((0.0, 0.0, -4.0), size=(32, 24), focal=30.0)
    if reason := backends.why_unavailable(backend, np.float32):
        pytest.skip(reason)
    large = replace(scene, opacity_logits=scene.opacity_logits.at[:5].set(100.0))
    full = replace(scene, opacity_logits=scene.opacity_logits.at[:5].set(jnp.inf))
    a, b = (np.asarray(sx.render(g, camera, backend=backend).rgb) for g in (large, full))
    assert np.isfinite(b).all()
    assert (a == b).all()


def test_what_is_broken_is_told_from_what_is_flat_opaque_or_empty():
    from splatax.gaussians import broken

    scene = random_gaussians(n=10)
    scene = replace(
        scene,
        means=scene.means.at[0, 0].set(jnp.nan).at[1, 0].set(jnp.inf),
        quats=scene.quats.at[2, 1].set(-jnp.inf),
        log_scales=scene.log_scales.at[3, 0].set(jnp.inf).at[4, 0].set(-jnp.inf).at[5, 1].set(jnp.nan),
        opacity_logits=scene.opacity_logits.at[6].set(jnp.inf).at[7].set(-jnp.inf).at[8].set(jnp.nan),
        sh=scene.sh.at[9, 0, 0].set(jnp.inf),
    )
    assert np.flatnonzero(broken(scene)).tolist() == [0, 1, 2, 3, 5, 8, 9]


def test_a_format_error_inside_a_capture_is_an_error_of_the_capture(tmp_path):
    with (
        pytest.raises(DatasetError, match=r"points.ply: damaged \(cut short\)"),
        blamed_on(tmp_path / "points.ply", "damaged", "Copy it again.", DatasetError),
    ):
        raise FormatError("cut short")


@pytest.mark.parametrize("name", ["rigs.bin", "frames.bin"])
@pytest.mark.parametrize("count", [2**32 - 1, 2**63 - 1])
def test_rigs_and_frames_that_claim_more_than_they_hold(tmp_path, name, count):
    """pycolmap would read on for ever."""
    capture = write_capture(tmp_path / "capture")
    path = capture / "sparse" / "0" / name
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    refuse(capture, f"{name}: damaged: its .* bytes do not hold what it announces")


def test_rigs_of_several_sensors_are_whole(tmp_path):
    model = pycolmap.Reconstruction()
    for i in (1, 2, 3):
        model.add_camera(
            pycolmap.Camera(model="PINHOLE", width=4, height=4, params=[1, 1, 1, 1], camera_id=i)
        )
    rig = pycolmap.Rig()
    rig.rig_id = 1
    sensors = [pycolmap.sensor_t(pycolmap.SensorType.CAMERA, i) for i in (1, 2, 3)]
    rig.add_ref_sensor(sensors[0])
    rig.add_sensor(sensors[1], None)
    rig.add_sensor(sensors[2], pycolmap.Rigid3d())
    model.add_rig(rig)
    model.write_binary(tmp_path)
    check_whole(tmp_path)
    (tmp_path / "rigs.bin").write_bytes((tmp_path / "rigs.bin").read_bytes()[:-1])
    with pytest.raises(DatasetError, match="damaged"):
        check_whole(tmp_path)


def test_cameras_of_every_model_that_pycolmap_writes_are_whole(tmp_path):
    model, names = pycolmap.Reconstruction(), pycolmap.CameraModelId.__members__.keys() - {"INVALID"}
    for i, name in enumerate(sorted(names), start=1):
        model.add_camera(pycolmap.Camera.create_from_model_name(i, name, 100.0, 64, 32))
    model.write_binary(tmp_path)
    check_whole(tmp_path)
