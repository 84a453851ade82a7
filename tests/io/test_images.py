"""Photos keep their stored brightness, are decoded within the memory limit, and have a known format."""

import struct
import tracemalloc
import warnings
import zlib

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image, ImageOps, JpegImagePlugin

import splatax as sx
from captures import write_capture, write_transforms
from splatax.errors import DatasetError
from splatax.inspection.looks import look
from splatax.io import images
from splatax.io.memory import MEMORY_DIVISOR, machine_memory


@pytest.fixture
def limit():
    yield images.limit_memory
    images.limit_memory(None)


def refuse(path, match):
    with pytest.raises(DatasetError, match=match) as error:
        images.read(path)
    assert str(path) in str(error.value)


# --- brightness ---


@pytest.mark.parametrize("suffix", [".png", ".tif"])
def test_grey_of_16_bits_is_scaled(tmp_path, suffix):
    levels = np.linspace(0, 65535, 64 * 48).astype(np.uint16).reshape(48, 64)
    Image.fromarray(levels).save(tmp_path / f"a{suffix}")
    pixels = images.read(tmp_path / f"a{suffix}")
    assert_allclose(pixels, np.repeat(levels[..., None] / 257.0, 3, axis=2), atol=0.5)
    assert look(tmp_path / f"a{suffix}").luminance == pytest.approx(0.5, abs=0.01)


def test_grey_of_16_bits_with_a_transparent_level_has_alpha(tmp_path):
    levels = np.full((48, 64), 40_000, np.uint16)
    levels[:, :32] = 300
    Image.fromarray(levels).save(tmp_path / "a.png", transparency=300)
    pixels = images.read(tmp_path / "a.png")
    assert_array_equal(pixels[0, [0, 63]], [[1, 1, 1, 0], [156, 156, 156, 255]])


@pytest.mark.parametrize("dtype", [np.float32, np.int32])
def test_numbers_without_a_white_level_are_refused(tmp_path, dtype):
    Image.fromarray(np.ones((48, 64), dtype)).save(tmp_path / "a.tif")
    refuse(tmp_path / "a.tif", "do not say what is white. Save the photo with 8 or 16 bits")


def test_decoding_in_strips_is_what_pillow_decodes(tmp_path):
    rng = np.random.default_rng(0)
    photo = Image.fromarray(rng.integers(0, 256, (600, 20, 3), dtype=np.uint8))
    for mode in ("L", "P", "RGB", "RGBA", "CMYK"):
        path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
        photo.convert(mode).save(path)
        with Image.open(path) as image:
            expected = np.array(image.convert("RGBA" if image.has_transparency_data else "RGB"))
        assert_array_equal(images.read(path), expected)


@pytest.mark.parametrize("suffix", [".png", ".tif"])  # Pillow turns a TIFF by itself
@pytest.mark.parametrize("orientation", range(10))
def test_photos_are_turned_as_exif_says(tmp_path, orientation, suffix):
    rng = np.random.default_rng(0)
    exif = Image.Exif()
    exif[0x0112] = orientation
    path = tmp_path / f"a{suffix}"
    Image.fromarray(rng.integers(0, 256, (4, 6, 3), dtype=np.uint8)).save(path, exif=exif)
    with Image.open(path) as image:
        expected = np.array(ImageOps.exif_transpose(image).convert("RGB"))
    assert_array_equal(images.read(path, upright=True), expected)
    assert images.size_of(path, upright=True) == expected.shape[1::-1]


@pytest.mark.parametrize("mode", ["L", "CMYK", "RGB"])
def test_an_uncompressed_tiff_is_turned_and_not_scrambled(tmp_path, mode):
    exif = Image.Exif()
    exif[0x0112] = 6
    rows = np.tile(np.arange(0, 240, 10, dtype=np.uint8)[:, None, None], (1, 32, 3))
    Image.fromarray(rows).convert(mode).save(tmp_path / "a.tif", exif=exif)
    pixels = images.read(tmp_path / "a.tif", upright=True)
    assert pixels.shape == (32, 24, 3)
    assert images.size_of(tmp_path / "a.tif", upright=True) == (24, 32)
    assert_array_equal(pixels, np.rot90(rows, -1))


def test_an_orientation_that_is_no_number_turns_nothing(tmp_path):
    text = b"\x01\x12\x00\x02\x00\x00\x00\x02a\x00\x00\x00"  # the entry 0x0112: two bytes of text, "a"
    exif = b"MM\x00*\x00\x00\x00\x08\x00\x01" + text + bytes(4)
    Image.new("RGB", (6, 4)).save(tmp_path / "a.png", exif=exif)
    assert images.size_of(tmp_path / "a.png", upright=True) == (6, 4)
    assert images.read(tmp_path / "a.png", upright=True).shape == (4, 6, 3)


# --- formats ---


def test_a_photo_cannot_start_another_program(tmp_path, monkeypatch):
    """Pillow hands PostScript to Ghostscript, whatever the file's suffix."""
    from PIL import EpsImagePlugin

    monkeypatch.setattr(EpsImagePlugin, "Ghostscript", lambda *_, **__: pytest.fail("started Ghostscript"))
    header = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 64 48\n%%EndComments\n%%EOF\n"
    (tmp_path / "photo.png").write_bytes(header)
    refuse(tmp_path / "photo.png", "not a photo that can be read")
    assert "not a photo" in look(tmp_path / "photo.png").unreadable


@pytest.mark.parametrize("format", ["GIF", "PPM", "ICO", "TGA"])
def test_other_formats_are_refused(tmp_path, format):
    Image.new("RGB", (64, 48)).save(tmp_path / "photo.png", format)
    refuse(tmp_path / "photo.png", r"not a photo that can be read. Photos are .*\.jpg")


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp", ".bmp"])
def test_a_truncated_photo_is_named(tmp_path, suffix):
    rng = np.random.default_rng(0)
    capture = write_transforms(tmp_path / "capture")
    photo = (capture / "images" / "photo03.png").with_suffix(suffix)
    (capture / "images" / "photo03.png").unlink()
    Image.fromarray(rng.integers(0, 256, (48, 64, 3), dtype=np.uint8)).save(photo)
    photo.write_bytes(photo.read_bytes()[: photo.stat().st_size // 2])
    file = capture / "transforms.json"
    file.write_text(file.read_text().replace("photo03.png", photo.name))
    with pytest.raises(DatasetError, match=r"damaged|not a photo") as error:
        [view.pixels() for view in sx.load_dataset(capture).views]
    assert str(photo) in str(error.value)


# --- memory ---


def png_of_nothing(path, side):
    """A valid PNG of black pixels: small on disk, large in memory."""

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    header = struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0)
    packer = zlib.compressobj(9)
    body = b"".join(packer.compress(bytes(1 + 3 * side)) for _ in range(side)) + packer.flush()
    chunks = chunk(b"IHDR", header) + chunk(b"IDAT", body) + chunk(b"IEND", b"")
    path.write_bytes(b"\x89PNG\r\n\x1a\n" + chunks)
    return path


def test_a_photo_that_does_not_fit_is_refused_before_it_is_decoded(tmp_path, limit):
    path = png_of_nothing(tmp_path / "bomb.png", 3000)
    assert path.stat().st_size < 100_000
    limit(3000 * 3000 * images.BYTES_PER_PIXEL - 1)
    tracemalloc.start()
    refuse(path, r"decoding its 3000 x 3000 pixels takes 0.1 GB, and 0.1 GB may be used")
    assert "takes 0.1 GB" in look(path).unreadable
    with pytest.raises(DatasetError, match=r"takes 0\.1 GB"):
        images.read_mask(path)
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
    limit(3000 * 3000 * images.BYTES_PER_PIXEL)
    assert images.read(path).shape == (3000, 3000, 3)


def test_the_limit_is_a_fraction_of_the_machine():
    assert images.memory_limit() == machine_memory() // MEMORY_DIVISOR > 1 << 28


def test_photos_of_200_megapixels_are_measured_without_a_warning(tmp_path, limit, monkeypatch):
    """Pillow would refuse them, whatever memory there is. (A header is enough to see that.)"""
    Image.new("RGB", (64, 48)).save(tmp_path / "phone.jpg")
    contents = (tmp_path / "phone.jpg").read_bytes()
    frame = contents.index(b"\xff\xc0") + 5
    size = struct.pack(">HH", 12288, 16384)
    (tmp_path / "phone.jpg").write_bytes(contents[:frame] + size + contents[frame + 4 :])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        limit(16384 * 12288 * images.BYTES_PER_PIXEL)
        assert images.header_of(tmp_path / "phone.jpg") == images.Header((16384, 12288))
        limit(1 << 30)
        assert images.header_of(tmp_path / "phone.jpg") == images.Header((8192, 6144), 2)


@pytest.mark.parametrize("write", [write_capture, write_transforms])
def test_a_jpeg_that_does_not_fit_is_decoded_smaller_and_said(tmp_path, limit, write):
    capture = write(tmp_path / "capture", count=3)
    shade = np.linspace(0, 255, 64).astype(np.uint8)
    for photo in (capture / "images").iterdir():
        Image.fromarray(np.tile(shade[:, None], (48, 1, 3))).save(photo.with_suffix(".jpg"), quality=95)
        photo.unlink()
    for file in capture.glob("*.json"):
        file.write_text(file.read_text().replace(".png", ".jpg"))
    full = sx.load_dataset(capture, downscale=2).train[0]
    limit(64 * 48 * images.BYTES_PER_PIXEL - 1)
    dataset = sx.load_dataset(capture, downscale=1)
    view = dataset.train[0]
    assert (view.camera.width, view.camera.height) == (32, 24)
    assert_allclose([view.camera.fx, view.camera.cy], [full.camera.fx, full.camera.cy])
    assert any("3 photos decoded at half the size or less" in note for note in dataset.notes)
    limit(None)  # what was measured counts, not what is allowed later
    assert_allclose(view.pixels().astype(int), full.pixels(), atol=3)
    assert sx.load_dataset(capture, downscale=2).train[0].camera.width == 32


def area_means(pixels, width, height):
    """Exact means over areas."""

    def along(rows, count):
        sums = np.concatenate([np.zeros((1, *rows.shape[1:])), np.cumsum(rows, axis=0, dtype=np.float64)])
        ends = np.linspace(0, len(rows), count + 1)
        whole = np.minimum(ends.astype(int), len(rows) - 1)
        at_ends = sums[whole] + (ends - whole)[:, None, None] * rows[whole]
        return np.diff(at_ends, axis=0) * count / len(rows)

    return along(along(pixels, height).swapaxes(0, 1), width).swapaxes(0, 1)


@pytest.mark.parametrize(
    ("size", "divisor", "least"),
    [((300, 210), 1, 38), ((160, 112), 1, 55), ((190, 133), 2, 41), ((159, 111), 2, 45), ((60, 42), 8, 50)],
)
def test_a_jpeg_is_shrunk_by_means_over_areas_and_not_decoded_larger_than_needed(
    tmp_path, monkeypatch, size, divisor, least
):
    rng = np.random.default_rng(0)
    smooth = Image.fromarray(rng.integers(0, 256, (42, 60, 3), dtype=np.uint8)).resize((480, 336))
    smooth.save(tmp_path / "a.jpg", quality=97, subsampling=0)
    with Image.open(tmp_path / "a.jpg") as image:
        expected = area_means(np.asarray(image), *size)
    drafts = []
    draft = JpegImagePlugin.JpegImageFile.draft
    monkeypatch.setattr(
        JpegImagePlugin.JpegImageFile,
        "draft",
        lambda self, mode, size: (drafts.append(size), draft(self, mode, size)),
    )
    found = images.read(tmp_path / "a.jpg", size=size)
    assert found.shape == (size[1], size[0], 3)
    assert drafts == ([] if divisor == 1 else [(480 // divisor, 336 // divisor)])
    psnr = -10 * np.log10(np.mean((found / 255 - expected / 255) ** 2))
    assert psnr > least
