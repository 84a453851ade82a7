"""Mutated files of every kind that is read give a consistent value or an `InputError`, and nothing else.

About a second for each kind; `make fuzz` sets SPLATAX_FUZZ_SECONDS for more. Inputs follow from a number,
which a failure names, so that they can be made again.
"""

import gzip
import io
import os
import random
import resource
import shutil
import signal
import struct
import time
import warnings
import zipfile
from contextlib import contextmanager

import foreign
import jax
import numpy as np
import pytest
from mutations import damaged, damaged_json
from PIL import Image

import splatax as sx
from captures import write_blender, write_capture, write_llff, write_transforms, zipped
from scenes import random_gaussians
from splatax.errors import LONGEST_MESSAGE, InputError, is_shown
from splatax.io import formats, images
from splatax.io.datasets import archives
from torch_files import write_checkpoint

SECONDS = float(os.environ.get("SPLATAX_FUZZ_SECONDS", "1"))  # for each kind of file
LONGEST = 20  # seconds for one input, on a busy machine
MOST_MEMORY = 2 << 30  # bytes that one input may ask for
SPLATS = [".ply", ".compressed.ply", ".splat", ".spz", ".sog", ".glb", ".ksplat", ".pt"]


@contextmanager
def bounded():
    """Ends what takes too long, and refuses gigabytes in place of the machine."""

    def too_long(*_):
        raise TimeoutError("takes too long")

    with open("/proc/self/statm") as file:
        used = int(file.read().split()[0]) * resource.getpagesize()
    limits = resource.getrlimit(resource.RLIMIT_AS)
    handler = signal.signal(signal.SIGALRM, too_long)
    signal.setitimer(signal.ITIMER_REAL, LONGEST)
    resource.setrlimit(resource.RLIMIT_AS, (used + MOST_MEMORY, limits[1]))
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, handler)
        resource.setrlimit(resource.RLIMIT_AS, limits)


def fuzz(kind, attempt):
    """Calls `attempt(rng)` with one random generator after the other, until the time is up."""
    end, number = time.monotonic() + SECONDS, 0
    while number < 5 or time.monotonic() < end:
        try:
            with bounded(), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                attempt(random.Random(f"{kind} {number}"))
        except InputError as error:
            message = str(error)
            if not all(map(is_shown, message)) or len(message) > LONGEST_MESSAGE:
                pytest.fail(f"{kind} {number}: {message!r}")
            if isinstance(error.__cause__, MemoryError | TimeoutError):
                pytest.fail(f"{kind} {number}: {message}")
        except Exception as error:
            raise AssertionError(f"{kind} {number}: {type(error).__name__}: {error}") from error
        number += 1


def consistent(gaussians):
    """The arrays of a scene have one number of rows and can be computed with."""
    rows = {leaf.shape[0] for leaf in jax.tree.leaves(gaussians)}
    assert rows == {len(gaussians)}
    assert gaussians.sh.shape[1:] == ((gaussians.sh_degree + 1) ** 2, 3)


# --- splat files ---


def splat_files(folder, suffix):
    """Good files of one format: of several SH degrees, versions and layouts."""
    scenes = [random_gaussians(n=12, degree=degree) for degree in (0, 1, 3)]
    if suffix == ".ksplat":
        return [ksplat(level, degree) for level in (0, 1, 2) for degree in (0, 1)]
    if suffix == ".pt":
        return [write_checkpoint(folder / f"{i}.pt", s).read_bytes() for i, s in enumerate(scenes)]
    for i, scene in enumerate(scenes):
        formats.save(folder / f"{i}{suffix}", scene)
    if suffix == ".spz":
        formats.save(folder / f"v4{suffix}", scenes[1], version=4)
        (folder / f"v1{suffix}").write_bytes(old_spz(1, 1))
        (folder / f"v2{suffix}").write_bytes(old_spz(2, 3))
    if suffix == ".ply":
        (folder / f"ascii{suffix}").write_bytes(other_ply("ascii"))
        (folder / f"big{suffix}").write_bytes(other_ply("binary_big_endian"))
    return [path.read_bytes() for path in sorted(folder.iterdir())]


def old_spz(version, degree, n=12):
    rng = np.random.default_rng(0)
    position = 6 if version == 1 else 9
    rest = 3 * ((degree + 1) ** 2 - 1)
    header = struct.pack("<4sIIBBBB", b"NGSP", version, n, degree, 12, 0, 0)
    return gzip.compress(header + rng.integers(0, 60, n * (position + 10 + rest), np.uint8).tobytes())


def ksplat(level, degree, n=8):
    rng = np.random.default_rng(0)
    header, section = bytearray(4096), bytearray(1024)
    header[1] = 1
    struct.pack_into("<IIII", header, 4, 1, 1, n, n)
    struct.pack_into("<H", header, 20, level)
    struct.pack_into("<IIIIfH", section, 0, n, n, 256, 1, 5.0, 12)
    struct.pack_into("<II", section, 32, 0, 1)
    struct.pack_into("<H", section, 40, degree)
    rest = 3 * ((degree + 1) ** 2 - 1)
    row = (44 + 4 * rest, 24 + 2 * rest, 24 + rest)[level]
    body = rng.integers(0, 60, row * n, np.uint8).tobytes()
    return bytes(header) + bytes(section) + struct.pack("<I3f", n, 0, 0, 0) + body


def other_ply(form, n=6):
    names = ["x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", *(f"f_rest_{i}" for i in range(9)), "opacity"]
    names += [*(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    values = np.random.default_rng(0).normal(size=(n, len(names))).astype(np.float32)
    header = f"ply\nformat {form} 1.0\nelement vertex {n}\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    if form == "ascii":
        return (header + "\n".join(" ".join(map(str, row)) for row in values) + "\n").encode()
    return header.encode() + values.astype(">f4").tobytes()


def damaged_splats(rng, contents, others, suffix):
    """Returns a damaged file; of three in four the damage is inside what is packed."""
    if rng.random() < 0.25:
        return damaged(rng, contents, others)
    if suffix == ".spz" and contents[:2] == b"\x1f\x8b":
        inside = gzip.decompress(contents)
        return gzip.compress(damaged(rng, inside, [inside]), 1)
    if suffix == ".glb":
        length = struct.unpack_from("<I", contents, 12)[0]
        text, rest = damaged_json(rng, contents[20 : 20 + length]), contents[20 + length :]
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sII", b"glTF", 2, 20 + len(text) + len(rest))
        return head + struct.pack("<I4s", len(text), b"JSON") + text + rest
    if suffix in (".sog", ".pt"):
        with zipfile.ZipFile(io.BytesIO(contents)) as archive:
            files = {name: archive.read(name) for name in archive.namelist()}
        name = rng.choice(["meta.json" if suffix == ".sog" else "archive/data.pkl", *files])
        files[name] = (
            damaged_json(rng, files[name]) if name == "meta.json" else damaged(rng, files[name], others)
        )
        packed = io.BytesIO()
        with zipfile.ZipFile(packed, "w") as archive:
            for name, inside in files.items():
                archive.writestr(name, inside)
        return packed.getvalue()
    return damaged(rng, contents, others)


@pytest.mark.slow
@pytest.mark.parametrize("suffix", SPLATS)
def test_splat_files(suffix, tmp_path):
    (tmp_path / "seeds").mkdir()
    seeds = splat_files(tmp_path / "seeds", suffix)
    path = tmp_path / f"scene{suffix}"

    def attempt(rng):
        path.write_bytes(damaged_splats(rng, rng.choice(seeds), seeds, suffix))
        consistent(sx.load(path))
        formats.comments(path)

    for seed in seeds:
        path.write_bytes(seed)
        consistent(sx.load(path))
    fuzz(suffix, attempt)


# --- captures ---


def check(dataset):
    """The views of a capture are consistent, and one of them can be decoded."""
    for view in dataset.views:
        numbers = [*jax.tree.leaves(view.camera)]
        assert all(np.isfinite(number).all() for number in numbers), view.name
        assert view.camera.fx > 0
        assert min(view.camera.width, view.camera.height) > 0
        assert view.name.isprintable()
        assert ".." not in view.name.split("/")
    assert np.isfinite(dataset.points.positions).all()
    assert len({view.name for view in dataset.views}) == len(dataset.views)
    if max(dataset.views[0].camera.width, dataset.views[0].camera.height) < 5000:
        assert dataset.views[0].pixels().shape[:2] == (
            dataset.views[0].camera.height,
            dataset.views[0].camera.width,
        )


def captures_of(kind, folder):
    """A good capture, and those of its files to damage."""
    if kind in ("colmap", "colmap text"):
        capture = write_capture(folder, count=3, text=kind == "colmap text")
        return capture, sorted((capture / "sparse" / "0").iterdir())
    if kind == "llff":
        return write_llff(folder, count=3), [folder / "poses_bounds.npy"]
    if kind == "blender":
        return write_blender(folder), [folder / "transforms_train.json", folder / "transforms_test.json"]
    points = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(f"property float {c}\n" for c in "xyz")
    points += "".join(f"property uchar {c}\n" for c in ("red", "green", "blue")) + "end_header\n"
    write_transforms(folder, count=3, k1=0.1, ply_file_path="p.ply", camera_model="OPENCV", test_filenames=[])
    (folder / "p.ply").write_text(points + "0 0 0 1 2 3\n1 1 1 4 5 6\n")
    return folder, [folder / "transforms.json", folder / "transforms.json", folder / "p.ply"]


@pytest.mark.parametrize("kind", ["colmap", "colmap text", "transforms", "blender", "llff"])
def test_captures(kind, tmp_path):
    capture, files = captures_of(kind, tmp_path / "capture")
    good = {path: path.read_bytes() for path in files}
    check(sx.load_dataset(capture))

    def attempt(rng):
        path = rng.choice(files)
        contents = good[path]
        for other in files:
            other.write_bytes(good[other])
        as_json = path.suffix == ".json" and rng.random() < 0.8
        path.write_bytes(
            damaged_json(rng, contents) if as_json else damaged(rng, contents, list(good.values()))
        )
        check(sx.load_dataset(capture))

    fuzz(kind, attempt)


def test_captures_of_other_programs(tmp_path):
    """All formats in turn, so that together they take the time of one kind of file."""
    captures = []
    for writer, files in foreign.FILES.items():
        writer(folder := tmp_path / writer.__name__)
        captures.append((folder, {folder / file: (folder / file).read_bytes() for file in files}))

    def attempt(rng):
        folder, good = rng.choice(captures)
        path = rng.choice(list(good))
        for other, contents in good.items():
            other.write_bytes(contents)
        as_json = path.suffix == ".json" and rng.random() < 0.8
        damage = damaged_json(rng, good[path]) if as_json else damaged(rng, good[path], list(good.values()))
        path.write_bytes(damage)
        check(sx.load_dataset(folder))

    fuzz("importers", attempt)


def test_zip_files_of_captures(tmp_path):
    small = write_transforms(tmp_path / "capture", count=2)
    seeds = [zipped(small, tmp_path / "a.zip").read_bytes()]
    path, folder = tmp_path / "capture.zip", tmp_path / "outside" / "unpacked"
    folder.parent.mkdir()

    def attempt(rng):
        contents = rng.choice(seeds)
        path.write_bytes(
            damaged(rng, contents[-2000:], seeds) if rng.random() < 0.2 else damaged(rng, contents, seeds)
        )
        shutil.rmtree(folder, ignore_errors=True)
        try:
            archives.unpack(path, folder)
        finally:
            assert list(folder.parent.iterdir()) == [folder]

    fuzz("zip", attempt)


# --- photos ---


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp", ".tif", ".bmp"])
def test_photos(suffix, tmp_path):
    rng = np.random.default_rng(0)
    photo = Image.fromarray(rng.integers(0, 256, (24, 32, 3), dtype=np.uint8))
    exif = Image.Exif()
    exif[0x0112] = 6
    modes = {
        ".png": ("RGB", "RGBA", "L", "P", "I;16"),
        ".tif": ("RGB", "CMYK", "I;16", "F"),
        ".jpg": ("RGB", "CMYK"),
    }
    for mode in modes.get(suffix, ("RGB",)):
        extra = {} if suffix == ".bmp" else {"exif": exif}
        converted = photo.convert("L").convert(mode) if mode in ("I;16", "F") else photo.convert(mode)
        converted.save(tmp_path / f"{mode.replace(';', '')}{suffix}", **extra)
    seeds = [path.read_bytes() for path in sorted(tmp_path.iterdir())]
    path = tmp_path / f"photo{suffix}"

    def attempt(rng):
        path.write_bytes(damaged(rng, rng.choice(seeds), seeds))
        size = images.size_of(path, upright=True)
        if max(size) < 5000:
            assert images.read(path, upright=True).shape[1::-1] == size
            images.read_mask(path)

    fuzz(suffix, attempt)


def test_the_same_number_makes_the_same_input():
    contents = [damaged(random.Random("a 3"), bytes(range(200)), [b"other"]) for _ in range(2)]
    assert contents[0] == contents[1]
