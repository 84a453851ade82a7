"""The layout of .ply files, checked byte by byte, because a round trip accepts any order."""

import struct
import warnings
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import random_gaussians
from splatax.errors import FormatError
from splatax.io.formats import ply_table


def header_and_rows(path):
    header, body = path.read_bytes().split(b"end_header\n", 1)
    names = [line.split()[2] for line in header.decode().splitlines() if line.startswith("property float")]
    return header.decode().splitlines(), names, np.frombuffer(body, "<f4").reshape(-1, len(names))


def inria_names(rest):
    return [
        *("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"),
        *(f"f_rest_{i}" for i in range(rest)),
        *("opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"),
    ]


def assert_same(actual, expected):
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        assert_array_equal(a, b)


@pytest.mark.parametrize("degree", range(5))
def test_columns_are_inrias_in_name_order_and_meaning(tmp_path, degree):
    gaussians = random_gaussians(n=7, degree=degree)
    sx.save(tmp_path / "scene.ply", gaussians)
    lines, names, rows = header_and_rows(tmp_path / "scene.ply")
    coefficients = (degree + 1) ** 2 - 1
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert "element vertex 7" in lines
    assert names == inria_names(3 * coefficients)
    columns = dict(zip(names, rows.T, strict=True))
    for i, axis in enumerate("xyz"):
        assert_array_equal(columns[axis], gaussians.means[:, i])
        assert_array_equal(columns[f"n{axis}"], 0)
        assert_array_equal(columns[f"scale_{i}"], gaussians.log_scales[:, i])
        assert_array_equal(columns[f"f_dc_{i}"], gaussians.sh[:, 0, i])
    assert_array_equal(columns["opacity"], gaussians.opacity_logits)
    for i in range(4):
        assert_array_equal(columns[f"rot_{i}"], gaussians.quats[:, i])
    for channel in range(3):  # all of red first, then green, then blue
        for k in range(coefficients):
            assert_array_equal(
                columns[f"f_rest_{channel * coefficients + k}"], gaussians.sh[:, 1 + k, channel]
            )


def test_round_trip_is_exact(tmp_path):
    gaussians = random_gaussians()
    sx.save(tmp_path / "scene.ply", gaussians)
    assert_same(sx.load(tmp_path / "scene.ply"), gaussians)


def test_reading_goes_by_name(tmp_path):
    """Shuffled columns, a column more, no normals, doubles: the same scene."""
    gaussians = random_gaussians(n=5, degree=1)
    sx.save(tmp_path / "scene.ply", gaussians)
    _, names, rows = header_and_rows(tmp_path / "scene.ply")
    order = np.random.default_rng(0).permutation([i for i, name in enumerate(names) if name[0] != "n"])
    header = ["ply", "format binary_little_endian 1.0", "comment hello", "element vertex 5"]
    header += [f"property double {names[i]}" for i in order] + ["property double other", "end_header", ""]
    body = np.concatenate([rows[:, order], np.ones((5, 1))], axis=1).astype("<f8").tobytes()
    (tmp_path / "shuffled.ply").write_bytes("\n".join(header).encode() + body)
    assert_same(sx.load(tmp_path / "shuffled.ply"), gaussians)


def test_text_and_big_endian_files_are_read(tmp_path):
    gaussians = random_gaussians(n=3, degree=0)
    sx.save(tmp_path / "scene.ply", gaussians)
    lines, _, rows = header_and_rows(tmp_path / "scene.ply")
    for form, body in (
        ("ascii", "\n".join(" ".join(map(repr, row.tolist())) for row in rows).encode()),
        ("binary_big_endian", rows.astype(">f4").tobytes()),
    ):
        header = [line.replace("binary_little_endian", form) for line in lines]
        (tmp_path / "other.ply").write_bytes("\n".join([*header, "end_header\n"]).encode() + body)
        assert_same(sx.load(tmp_path / "other.ply"), gaussians)


def test_two_scales_are_flat_gaussians(tmp_path):
    names = [name for name in inria_names(0) if name != "scale_2"]
    header = ["ply", "format binary_little_endian 1.0", "element vertex 1"]
    header += [f"property float {name}" for name in names] + ["end_header", ""]
    (tmp_path / "2dgs.ply").write_bytes("\n".join(header).encode() + struct.pack("<16f", *range(16)))
    gaussians = sx.load(tmp_path / "2dgs.ply")
    assert gaussians.log_scales[0, 2] == -np.inf
    assert gaussians.scales[0, 2] == 0
    assert gaussians.low_pass == sx.AlongRays()


def test_discs_have_a_tiny_third_scale_in_the_file_and_are_exactly_flat_again(tmp_path):
    gaussians = random_gaussians(n=4)
    discs = replace(
        gaussians, log_scales=gaussians.log_scales.at[:, 2].set(-jnp.inf), low_pass=sx.AlongRays()
    )
    sx.save(tmp_path / "scene.ply", discs)
    assert_same(sx.load(tmp_path / "scene.ply"), discs)
    assert sx.load(tmp_path / "scene.ply").low_pass == sx.AlongRays()
    stored = ply_table.read(tmp_path / "scene.ply").elements["vertex"]["scale_2"]
    assert np.all(np.isfinite(stored))
    assert np.all(np.exp(stored) < 1e-8)


def test_empty_slots_are_left_out_and_broken_rows_with_a_warning(tmp_path):
    gaussians = random_gaussians(n=6)
    logits = gaussians.opacity_logits.at[1].set(-jnp.inf)
    means = gaussians.means.at[3, 0].set(jnp.nan)
    with pytest.warns(UserWarning, match="left out 1 Gaussians that are not finite"):
        sx.save(tmp_path / "scene.ply", replace(gaussians, opacity_logits=logits, means=means))
    kept = np.array([0, 2, 4, 5])
    assert_same(sx.load(tmp_path / "scene.ply"), jax.tree.map(lambda leaf: leaf[kept], gaussians))


def test_flat_gaussians_are_kept(tmp_path):
    gaussians = random_gaussians(n=4)
    flat = replace(gaussians, log_scales=gaussians.log_scales.at[:, 2].set(-jnp.inf))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sx.save(tmp_path / "scene.ply", flat)
    assert_same(sx.load(tmp_path / "scene.ply"), flat)


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "scene.ply"
    gaussians = random_gaussians()
    sx.save(path, gaussians)
    monkeypatch.setattr("os.fsync", lambda file: (_ for _ in ()).throw(OSError("no space left")))
    with pytest.raises(OSError, match="no space"):
        sx.save(path, random_gaussians(1))
    assert_same(sx.load(path), gaussians)
    assert [p.name for p in tmp_path.iterdir()] == ["scene.ply"]


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (b"", "not a PLY file"),
        (b"PK\x03\x04 something else", "not a PLY file"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 3\n", "its header has no end"),
        (
            b"ply\nformat binary_middle_endian 1.0\nend_header\n",
            "PLY format binary_middle_endian is unknown",
        ),
        (b"ply\nformat ascii 1.0\nelement vertex many\nend_header\n", "not a valid PLY header"),
        (
            b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\n"
            b"element face 1\nproperty list uchar int vertex_indices\nend_header\n0 0 0\n3 0 0 0\n",
            "a point cloud or mesh, not splats: it has no f_dc|a point cloud or mesh, not splats: it has no",
        ),
        (
            b"ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nend_header\n0\n",
            "truncated: 1 of its 2",
        ),
    ],
)
def test_what_is_no_splat_file_is_refused_with_its_name(tmp_path, contents, message):
    path = tmp_path / "bad.ply"
    path.write_bytes(contents)
    with pytest.raises(FormatError, match=message) as error:
        sx.load(path)
    assert str(path) in str(error.value)


def test_a_short_file_that_announces_billions_is_refused_before_memory_is_asked_for(tmp_path):
    sx.save(tmp_path / "scene.ply", random_gaussians(n=2))
    contents = (tmp_path / "scene.ply").read_bytes().replace(b"vertex 2", b"vertex 9000000000000")
    (tmp_path / "scene.ply").write_bytes(contents)
    with pytest.raises(FormatError, match="truncated"):
        sx.load(tmp_path / "scene.ply")


def test_a_missing_file_and_an_unknown_suffix_are_refused(tmp_path):
    with pytest.raises(FormatError, match="no such file"):
        sx.load(tmp_path / "scene.ply")
    with pytest.raises(FormatError, match=r"unknown format '.obj'"):
        sx.save(tmp_path / "scene.obj", random_gaussians())


# --- SuperSplat's compressed PLY, which other software wrote ---


def test_compressed_file_of_supersplat_is_decoded(data):
    """64 splats with degree 3; values follow from the packed words by hand."""
    path = data / "splats" / "inria-small.ply"
    gaussians = sx.load(path)
    assert gaussians.sh.shape == (64, 16, 3)
    body = path.read_bytes().split(b"end_header\n", 1)[1]
    chunk = struct.unpack_from("<18f", body)
    position, rotation, scale, color = struct.unpack_from("<4I", body, 72)
    levels = body[72 + 64 * 16 :]

    fractions = [(position >> 21) / 2047, (position >> 11 & 1023) / 1023, (position & 2047) / 2047]
    assert_allclose(gaussians.means[0], lerp(chunk[0:3], chunk[3:6], fractions), rtol=1e-5)
    fractions = [(scale >> 21) / 2047, (scale >> 11 & 1023) / 1023, (scale & 2047) / 2047]
    assert_allclose(gaussians.log_scales[0], lerp(chunk[6:9], chunk[9:12], fractions), rtol=1e-5)
    fractions = [(color >> shift & 255) / 255 for shift in (24, 16, 8)]
    rgb = lerp(chunk[12:15], chunk[15:18], fractions)
    assert_allclose(gaussians.sh[0, 0] * 0.28209479177387814 + 0.5, rgb, rtol=1e-4)
    assert_allclose(gaussians.opacities[0], (color & 255) / 255, rtol=1e-5)
    others = [((rotation >> shift & 1023) / 1023 - 0.5) * 2**0.5 for shift in (20, 10, 0)]
    expected = np.insert(others, rotation >> 30, np.sqrt(1 - np.sum(np.square(others))))
    assert_allclose(gaussians.quats[0], expected, rtol=1e-5)
    green_second = (levels[15 + 1] + 0.5) / 256 * 8 - 4
    assert_allclose(gaussians.sh[0, 2, 1], green_second, rtol=1e-6)


def lerp(low, high, fractions):
    return [a * (1 - f) + b * f for a, b, f in zip(low, high, fractions, strict=True)]


def test_a_trained_scene_of_other_software_is_plausible(data):
    """152,746 unit quaternions, sizes and colours in range: the fields are not mixed up."""
    gaussians = sx.load(data / "splats" / "biker.compressed.ply")
    assert len(gaussians) == 152_746
    assert_allclose(np.linalg.norm(gaussians.quats, axis=1), 1, atol=1e-3)
    assert -12 < np.median(gaussians.log_scales) < -3
    rgb = np.asarray(gaussians.sh[:, 0]) * 0.28209479177387814 + 0.5
    assert rgb.min() > -0.5
    assert rgb.max() < 1.5


def test_truncated_compressed_file_is_refused(data, tmp_path):
    contents = (data / "splats" / "inria-small.ply").read_bytes()
    (tmp_path / "cut.ply").write_bytes(contents[:-100])
    with pytest.raises(FormatError, match="truncated: 100 bytes of its 64 sh rows"):
        sx.load(tmp_path / "cut.ply")
