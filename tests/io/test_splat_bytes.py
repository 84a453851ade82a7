"""Bytes of formats, written by hand or by other software, because a round trip accepts any layout."""

import gzip
import itertools
import json
import struct
import zipfile
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
import zstandard
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image
from scipy.spatial import cKDTree

import splatax as sx
from scenes import random_gaussians
from splatax.errors import FormatError
from splatax.math import harmonics

C0 = 0.28209479177387814


def one(mean=(1.0, -2.0, 3.0), quat=(0.8, 0.6, 0.0, 0.0), scales=(0.1, 0.2, 0.4), opacity=0.8, sh=None):
    sh = [[0.5, 0.0, -0.5]] if sh is None else sh
    return sx.Gaussians(
        jnp.array([mean]),
        jnp.array([quat]),
        jnp.log(jnp.array([scales])),
        jnp.array([np.log(opacity / (1 - opacity))], jnp.float32),
        jnp.array([sh]),
    )


# --- .splat ---


def test_splat_rows(tmp_path):
    sx.save(tmp_path / "a.splat", one())
    row = (tmp_path / "a.splat").read_bytes()
    assert_allclose(struct.unpack_from("<6f", row), [1, -2, 3, 0.1, 0.2, 0.4], rtol=1e-6)
    assert list(row[24:28]) == [round((0.5 + C0 * 0.5) * 255), 128, round((0.5 - C0 * 0.5) * 255), 204]
    assert list(row[28:]) == [round(128 + 128 * 0.8), round(128 + 128 * 0.6), 128, 128]


def test_splat_begins_with_the_most_important(tmp_path):
    small, large = one(scales=(0.01, 0.01, 0.01)), one(mean=(9.0, 9.0, 9.0), scales=(1.0, 1.0, 1.0))
    sx.save(
        tmp_path / "a.splat",
        sx.Gaussians(*map(jnp.concatenate, zip(leaves(small), leaves(large), strict=True))),
    )
    assert_array_equal(sx.load(tmp_path / "a.splat").means[0], [9, 9, 9])


def leaves(gaussians):
    return [gaussians.means, gaussians.quats, gaussians.log_scales, gaussians.opacity_logits, gaussians.sh]


def test_splat_with_numbers_that_cannot_be_is_refused(tmp_path):
    for values in ([np.nan, 0, 0, 1, 1, 1], [0, 0, 0, -1, 1, 1], [0, 0, 0, np.inf, 1, 1]):
        (tmp_path / "a.splat").write_bytes(struct.pack("<6f", *values) + bytes(8))
        with pytest.raises(FormatError, match=r"not a \.splat file"):
            sx.load(tmp_path / "a.splat")


# --- .spz ---


def check_spz_streams(streams, rest):
    """Of `one()`: the frame is right-up-back, so y and z change their signs."""
    position, alpha, color, scale, rotation, sh = streams
    fixed = [int.from_bytes(position[i : i + 3], "little", signed=True) for i in (0, 3, 6)]
    assert fixed == [1 * 4096, 2 * 4096, -3 * 4096]
    assert list(alpha) == [204]
    assert list(color) == [round(255 * (0.15 * v + 0.5)) for v in (0.5, 1e-9, -0.5)]
    assert list(scale) == [round(16 * (np.log(s) + 10)) for s in (0.1, 0.2, 0.4)]
    (word,) = struct.unpack("<I", rotation)
    assert word >> 30 == 3  # w, in the order x y z w
    assert [word >> shift & 511 for shift in (20, 10, 0)] == [round(511 * 0.6 / np.sqrt(0.5)), 0, 0]
    assert list(sh) == rest


@pytest.mark.parametrize("version", [3, 4])
def test_spz_bytes(tmp_path, version):
    path = tmp_path / "a.spz"
    coefficients = [[0.5, 0.0, -0.5], [0.25, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 0.25]]
    gaussians = one(sh=coefficients)
    sx.save(path, gaussians, version=version)
    sizes = [9, 1, 3, 3, 4, 9]
    if version == 3:
        contents = gzip.decompress(path.read_bytes())
        assert struct.unpack_from("<4sIIBBBB", contents) == (b"NGSP", 3, 1, 1, 12, 0, 0)
        starts = 16 + np.cumsum([0, *sizes])
        streams = [contents[a:b] for a, b in itertools.pairwise(starts)]
        assert len(contents) == 16 + sum(sizes)
    else:
        contents = path.read_bytes()
        assert struct.unpack_from("<4sIIBBBBI", contents) == (b"NGSP", 4, 1, 1, 12, 0, 6, 32)
        table = struct.unpack_from("<12Q", contents, 32)
        assert list(table[1::2]) == sizes
        starts = 32 + 96 + np.cumsum([0, *table[::2]])
        parts = [contents[a:b] for a, b in itertools.pairwise(starts)]
        streams = [zstandard.decompress(part) for part in parts]
        assert starts[-1] == len(contents)
    # Y(-1), Y(0), Y(1) of degree 1 go with -y, z, -x: of the turned axes two change their signs.
    check_spz_streams(streams, [96, 128, 128, 128, 96, 128, 128, 128, 160])
    loaded = sx.load(path)
    assert_allclose(loaded.sh[0, 1:], gaussians.sh[0, 1:], atol=1e-6)
    assert_allclose(loaded.means, gaussians.means)


@pytest.mark.parametrize("name", ["minimal-raw.spz", "minimal-v2.spz", "minimal-v3.spz", "minimal-v4.spz"])
def test_spz_of_all_versions_is_read(data, name):
    """Four round Gaussians of one size in the corners of a square, without harmonics."""
    gaussians = sx.load(data / "splats" / name)
    assert len(gaussians) == 4
    assert_allclose(np.abs(gaussians.means[:, 0]), [1, 0, 1, 0])
    assert_array_equal(gaussians.means[:, 1], 0)
    assert_allclose(np.abs(gaussians.means[:, 2]), [1, 1, 0, 0])
    assert_allclose(gaussians.scales, 0.1, rtol=0.04)
    assert_allclose(gaussians.opacities, 230 / 255, rtol=1e-5)
    assert_allclose(np.abs(gaussians.quats[:, 0]), 1, atol=1e-4)


def test_spz_of_version_1_has_float16_positions(tmp_path):
    header = struct.pack("<4sIIBBBB", b"NGSP", 1, 1, 0, 0, 0, 0)
    body = np.array([1, 2, 3], "<f2").tobytes() + bytes([128]) + bytes([128] * 3) + bytes([160] * 3)
    body += bytes([255, 128, 128])  # a turn of x by 180 degrees
    (tmp_path / "a.spz").write_bytes(gzip.compress(header + body))
    gaussians = sx.load(tmp_path / "a.spz")
    assert_allclose(gaussians.means[0], [1, -2, -3])
    assert_allclose(np.abs(gaussians.quats[0]), [0, 1, 0, 0], atol=0.01)


def test_spz_and_compressed_ply_of_one_scene_agree(data):
    """Written by other software: positions, sizes, colours, opacities and rotations in our frame."""
    spz, ply = (sx.load(data / "splats" / f"biker{suffix}") for suffix in (".spz", ".compressed.ply"))
    assert len(spz) == len(ply) == 152_746
    distances, rows = cKDTree(np.asarray(spz.means)).query(np.asarray(ply.means), 4)
    assert distances[:, 0].max() < 3e-4
    # Of neighbours at the same distance within rounding, the one that looks the same.
    colors = np.asarray(spz.sh[:, 0])[rows] - np.asarray(ply.sh[:, 0])[:, None]
    scales = np.asarray(spz.log_scales)[rows] - np.asarray(ply.log_scales)[:, None]
    best = np.argmin(np.abs(colors).sum(2) + np.abs(scales).sum(2) + 1e3 * distances, axis=1)
    mine = rows[np.arange(len(rows)), best]
    assert np.quantile(np.abs(colors[np.arange(len(rows)), best]), 0.99) < 0.05
    assert np.quantile(np.abs(scales[np.arange(len(rows)), best]), 0.99) < 0.06
    assert np.quantile(np.abs(spz.opacities[mine] - ply.opacities), 0.99) < 0.01
    covariances = [
        np.asarray(g.covariances) for g in (sx.Gaussians(*(leaf[mine] for leaf in leaves(spz))), ply)
    ]
    size = np.linalg.norm(covariances[1], axis=(1, 2))
    assert np.quantile(np.linalg.norm(covariances[0] - covariances[1], axis=(1, 2)) / size, 0.99) < 0.2


def test_spz_makes_room_for_far_positions_and_says_when_there_is_none(tmp_path):
    far = random_gaussians(n=9, spread=1.0)
    for factor in (1e4, 1e6):
        moved = replace(far, means=far.means * factor)
        sx.save(tmp_path / "a.spz", moved)
        assert_allclose(sx.load(tmp_path / "a.spz").means, moved.means, atol=factor * 1e-6)
    with pytest.raises(FormatError, match="no number for a position"):
        sx.save(tmp_path / "a.spz", replace(far, means=far.means * 1e8))


def test_spz_keeps_tiny_scenes_apart(tmp_path):
    """12 fractional bits would put all of them on a few points."""
    tiny = random_gaussians(n=50, spread=1e-3, scale=(1e-4, 2e-4))
    sx.save(tmp_path / "a.spz", tiny)
    assert_allclose(sx.load(tmp_path / "a.spz").means, tiny.means, atol=1e-5)


def test_spz_bombs_are_refused(tmp_path):
    """A gigabyte of zeros in a megabyte, and a count that asks for it."""
    body = struct.pack("<4sIIBBBB", b"NGSP", 3, 50_000_000, 0, 12, 0, 0) + bytes(1 << 20)
    (tmp_path / "a.spz").write_bytes(gzip.compress(body))
    with pytest.raises(FormatError, match="claim to hold"):
        sx.load(tmp_path / "a.spz")
    few = struct.pack("<4sIIBBBB", b"NGSP", 3, 1, 0, 12, 0, 0)
    (tmp_path / "a.spz").write_bytes(gzip.compress(few + bytes(1 << 28)))
    with pytest.raises(FormatError, match="more data than its 1 Gaussians"):
        sx.load(tmp_path / "a.spz")


# --- .glb ---


def test_glb_follows_the_extension(tmp_path):
    path = tmp_path / "a.glb"
    sx.save(path, one(sh=[[0.5, 0.0, -0.5], [0.1, 0.2, 0.3], [0.4, 0.5, 0.6], [0.7, 0.8, 0.9]]))
    contents = path.read_bytes()
    assert struct.unpack_from("<4sII", contents) == (b"glTF", 2, len(contents))
    length, kind = struct.unpack_from("<I4s", contents, 12)
    gltf = json.loads(contents[20 : 20 + length])
    assert (kind, length % 4, gltf["extensionsUsed"]) == (b"JSON", 0, ["KHR_gaussian_splatting"])
    (primitive,) = gltf["meshes"][0]["primitives"]
    assert primitive["mode"] == 0
    extension = primitive["extensions"]["KHR_gaussian_splatting"]
    assert (extension["kernel"], extension["colorSpace"]) == ("ellipse", "srgb_rec709_display")
    buffer = contents[20 + length + 8 :]

    def values(name):
        accessor = gltf["accessors"][primitive["attributes"][name]]
        view = gltf["bufferViews"][accessor["bufferView"]]
        kind = {5126: "<f4", 5121: "u1"}[accessor["componentType"]]
        return np.frombuffer(buffer[view["byteOffset"] :][: view["byteLength"]], kind)

    # Left-up-forward: x and y change their signs.
    assert_allclose(values("POSITION"), [-1, 2, 3])
    assert_allclose(values("KHR_gaussian_splatting:ROTATION"), [-0.6, 0, 0, 0.8], atol=1e-6)
    assert_allclose(values("KHR_gaussian_splatting:SCALE"), [0.1, 0.2, 0.4], rtol=1e-6)
    assert_allclose(values("KHR_gaussian_splatting:OPACITY"), [0.8], rtol=1e-6)
    assert_allclose(values("KHR_gaussian_splatting:SH_DEGREE_0_COEF_0"), [0.5, 0, -0.5])
    assert_allclose(values("KHR_gaussian_splatting:SH_DEGREE_1_COEF_0"), [-0.1, -0.2, -0.3])  # with y
    assert_allclose(values("KHR_gaussian_splatting:SH_DEGREE_1_COEF_1"), [0.4, 0.5, 0.6])  # with z
    assert_allclose(values("KHR_gaussian_splatting:SH_DEGREE_1_COEF_2"), [-0.7, -0.8, -0.9])  # with x
    assert list(values("COLOR_0")) == [round((0.5 + C0 * 0.5) * 255), 128, round((0.5 - C0 * 0.5) * 255), 204]
    position = gltf["accessors"][primitive["attributes"]["POSITION"]]
    assert (position["min"], position["max"]) == ([-1, 2, 3], [-1, 2, 3])


def edit_glb(path, change):
    contents = path.read_bytes()
    (length,) = struct.unpack_from("<I", contents, 12)
    gltf = json.loads(contents[20 : 20 + length])
    change(gltf)
    text = json.dumps(gltf).encode()
    text += b" " * (-len(text) % 4)
    rest = contents[20 + length :]
    head = struct.pack("<4sIII4s", b"glTF", 2, 20 + len(text) + len(rest), len(text), b"JSON")
    path.write_bytes(head + text + rest)


def test_glb_nodes_place_their_splats(tmp_path):
    path = tmp_path / "a.glb"
    sx.save(path, one())

    def nest(gltf):
        half = np.sqrt(0.5)
        outer = {"children": [1], "translation": [10, 0, 0], "rotation": [0, 0, half, half]}
        gltf["nodes"] = [outer, {"mesh": 0, "scale": [2, 2, 2]}]

    edit_glb(path, nest)
    gaussians = sx.load(path)
    # (-1, 2, 3) * 2 turned by 90 degrees about z is (-4, -2, 6), moved (6, -2, 6), and in our frame:
    assert_allclose(gaussians.means[0], [-6, 2, 6], atol=1e-5)
    assert_allclose(np.sort(gaussians.scales[0]), [0.2, 0.4, 0.8], rtol=1e-5)


def test_glb_whose_nodes_form_a_circle_is_refused(tmp_path):
    sx.save(tmp_path / "a.glb", one())
    edit_glb(tmp_path / "a.glb", lambda gltf: gltf.update(nodes=[{"mesh": 0, "children": [0]}]))
    with pytest.raises(FormatError, match="circle"):
        sx.load(tmp_path / "a.glb")


def test_glb_without_splats_is_refused(tmp_path):
    sx.save(tmp_path / "a.glb", one())
    edit_glb(tmp_path / "a.glb", lambda gltf: gltf["meshes"][0]["primitives"][0].pop("extensions"))
    with pytest.raises(FormatError, match="no splats"):
        sx.load(tmp_path / "a.glb")


# --- .sog ---


def test_sog_textures(tmp_path):
    gaussians = random_gaussians(n=200, degree=2)
    sx.save(tmp_path / "a.sog", gaussians)
    with zipfile.ZipFile(tmp_path / "a.sog") as files:
        meta = json.loads(files.read("meta.json"))
        images = {
            name: np.asarray(Image.open(files.open(name)).convert("RGBA")) for name in files.namelist()[1:]
        }
    assert (meta["version"], meta["count"], meta["shN"]["bands"]) == (2, 200, 2)
    assert images["means_l.webp"].shape == (16, 16, 4)
    assert images["shN_centroids.webp"].shape == (meta["shN"]["count"] // 64, 64 * 8, 4)
    low, high = (images[f"means_{end}.webp"].reshape(-1, 4)[:200, :3].astype(int) for end in "lu")
    mins, maxs = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    logs = mins + (maxs - mins) * (low + 256 * high) / 65535
    means = np.sign(logs) * (np.exp(np.abs(logs)) - 1)
    distances, rows = cKDTree(means).query(np.asarray(gaussians.means))
    assert distances.max() < 1e-4
    assert images["quats.webp"].reshape(-1, 4)[:200, 3].min() >= 252
    log_scales = np.array(meta["scales"]["codebook"])[images["scales.webp"].reshape(-1, 4)[rows, :3]]
    assert_allclose(log_scales, gaussians.log_scales, atol=0.02)
    labels = images["shN_labels.webp"].reshape(-1, 4)[rows].astype(int)
    label = labels[:, 0] + 256 * labels[:, 1]
    palette = images["shN_centroids.webp"].reshape(-1, 64, 8, 4)[label // 64, label % 64, :, :3]
    assert_allclose(
        np.array(meta["shN"]["codebook"])[palette], gaussians.sh[:, 1:], atol=0.1
    )  # rare large ones have few codes


def test_sog_in_a_folder_is_read(tmp_path):
    sx.save(tmp_path / "a.sog", random_gaussians(n=50))
    with zipfile.ZipFile(tmp_path / "a.sog") as files:
        files.extractall(tmp_path / "folder")
    from_zip, from_folder = sx.load(tmp_path / "a.sog"), sx.load(tmp_path / "folder" / "meta.json")
    for a, b in zip(leaves(from_zip), leaves(from_folder), strict=True):
        assert_array_equal(a, b)


@pytest.mark.parametrize("name", ["../secret.webp", "/etc/passwd"])
def test_sog_reads_nothing_outside_its_folder(tmp_path, name):
    sx.save(tmp_path / "a.sog", random_gaussians(n=5))
    with zipfile.ZipFile(tmp_path / "a.sog") as files:
        files.extractall(tmp_path / "folder")
    meta = json.loads((tmp_path / "folder" / "meta.json").read_text())
    meta["means"]["files"][0] = name
    (tmp_path / "folder" / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(FormatError, match="outside its folder"):
        sx.load(tmp_path / "folder" / "meta.json")


def test_sog_of_version_1_is_refused_with_the_way_out(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.sog", "w") as files:
        files.writestr("meta.json", json.dumps({"means": {"shape": [3]}}))
    with pytest.raises(FormatError, match=r"splat-transform old\.sog new\.sog"):
        sx.load(tmp_path / "a.sog")


def test_spz_rounds_harmonics_to_both_sides(tmp_path):
    """An error that all coefficients share is a tint; those of rounding cancel out."""
    original = random_gaussians(n=3000, degree=3)
    original = replace(original, sh=jnp.clip(original.sh, -0.9, 0.9))
    sx.save(tmp_path / "a.spz", original)
    error = np.asarray(sx.load(tmp_path / "a.spz").sh)[:, 1:] - np.asarray(original.sh)[:, 1:]
    assert abs(error.mean()) < 5e-4  # a tenth of half a level


# --- .ksplat ---


def ksplat(level, rows, *, count, degree=0, bucket_size=0, sizes=(), centres=()):
    """A file of one section, by the layout in `ksplat.py`; `sizes` are those of the last buckets."""
    header, section = bytearray(4096), bytearray(1024)
    struct.pack_into("<BB2xII4xIH", header, 0, 0, 1, 1, 1, count, level)
    struct.pack_into("<IIIIfH", section, 0, count, count, bucket_size, len(centres), 2.0, 12)
    struct.pack_into("<II", section, 32, len(centres) - len(sizes), len(sizes))
    struct.pack_into("<H", section, 40, degree)
    buckets = np.array(sizes, "<u4").tobytes() + np.array(centres, "<f4").tobytes()
    return bytes(header) + bytes(section) + buckets + rows


def test_ksplat_of_the_other_viewer_is_read(data):
    gaussians = sx.load(data / "splats" / "minimal.ksplat")
    assert_allclose(gaussians.means, [[-1, 0, -1], [0, 0, -1], [-1, 0, 0], [0, 0, 0]])
    assert_allclose(gaussians.scales, 0.1, rtol=1e-6)
    assert_allclose(gaussians.opacities, 230 / 255, rtol=1e-5)


def test_ksplat_without_compression_has_harmonics_by_channel(tmp_path):
    row = np.array([1, 2, 3, 0.1, 0.2, 0.3, 0.8, 0.6, 0, 0], "<f4").tobytes() + bytes([255, 0, 128, 204])
    (tmp_path / "a.ksplat").write_bytes(
        ksplat(0, row + np.arange(24, dtype="<f4").tobytes(), degree=2, count=1)
    )
    gaussians = sx.load(tmp_path / "a.ksplat")
    assert_allclose(gaussians.scales[0], [0.1, 0.2, 0.3], rtol=1e-6)
    assert_allclose(gaussians.quats[0], [0.8, 0.6, 0, 0])
    assert_allclose(harmonics.to_rgb(gaussians.sh[0, 0]), [1, 0, 128 / 255], atol=1e-6)
    assert_array_equal(gaussians.sh[0, 1:4], np.arange(9).reshape(3, 3).T)
    assert_array_equal(gaussians.sh[0, 4:], 9 + np.arange(15).reshape(3, 5).T)


@pytest.mark.parametrize("level", [1, 2])
def test_ksplat_positions_lie_in_full_and_partial_buckets(tmp_path, level):
    """Two in a full bucket, one in another that is not full; blocks of side 2 around the centres."""
    shape = np.array([0.1, 0.2, 0.3, 1, 0, 0, 0], "<f2").tobytes() + bytes([0, 0, 0, 255])
    places = ([32767, 32767, 32767], [65534, 0, 32767], [32767, 65534, 0])
    rows = b"".join(np.array(place, "<u2").tobytes() + shape for place in places)
    centres = [[10, 20, 30], [-1, -2, -3]]
    (tmp_path / "a.ksplat").write_bytes(
        ksplat(level, rows, count=3, bucket_size=2, sizes=[1], centres=centres)
    )
    assert_allclose(
        sx.load(tmp_path / "a.ksplat").means, [[10, 20, 30], [11, 19, 30], [-1, -1, -4]], atol=1e-3
    )
