"""Names in a capture: none leads out of its folder, and none reaches a terminal unescaped."""

import json
import shutil

import numpy as np
import pycolmap
import pytest
from PIL import Image

import splatax as sx
from captures import model_of, pinhole, write_capture, write_llff, write_photos, write_transforms
from splatax.errors import LONGEST_MESSAGE, DatasetError, InputError, shown
from splatax.io.datasets import names

OUTSIDE = [
    "../family/mum.png",
    "a/../../mum.png",
    "/abs/dad.png",
    "..\\mum.png",
    "C:\\dad.png",
    "\\\\host\\a.png",
]
CONTROL = ["a\x1b[31m.png", "a\nb.png", "a\0b.png", "a\u202eb.png", "a\ud800.png", "\x07.png"]


def colmap_named(folder, name):
    """A COLMAP capture of which the first photo has this name in the model."""
    capture = write_capture(folder, text=True)
    path = capture / "sparse" / "0" / "images.txt"
    path.write_text(path.read_text().replace("photo00.png", name))
    return capture


def transforms_named(folder, name):
    capture = write_transforms(folder)
    contents = json.loads((capture / "transforms.json").read_text())
    contents["frames"][0]["file_path"] = name
    (capture / "transforms.json").write_text(json.dumps(contents))
    return capture


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("write", [colmap_named, transforms_named])
def test_a_name_outside_of_the_capture_is_refused_though_a_photo_is_there(write, name, tmp_path):
    write_photos(tmp_path / "scans" / "family", ["mum.png"])
    write_photos(tmp_path / "family", ["mum.png"])
    capture = write(tmp_path / "scans" / "capture", name)
    with pytest.raises(DatasetError, match="leads out of the capture's folder"):
        sx.load_dataset(capture)


@pytest.mark.parametrize("name", [*OUTSIDE, *CONTROL, "", ".", "./", "x" * 300, "a/" * 600 + "b.png"])
def test_the_rule_refuses(name):
    with pytest.raises(DatasetError, match=r"somewhere: .*\."):
        names.checked(name, "somewhere")


@pytest.mark.parametrize(
    ("name", "same"),
    [
        ("a.png", "a.png"),
        ("./images/a.png", "images/a.png"),
        ("images\\cam 0\\a.png", "images/cam 0/a.png"),
        ("ü 日本.jpg", "ü 日本.jpg"),
        ("12:30:05.jpg", "12:30:05.jpg"),
        ("a..b/c..png", "a..b/c..png"),
    ],
)
def test_the_rule_accepts(name, same):
    assert names.checked(name, "somewhere") == same


@pytest.mark.parametrize("name", [name for name in CONTROL if "\ud800" not in name])
def test_control_characters_are_refused_and_not_printed(name, tmp_path):
    with pytest.raises(DatasetError) as error:
        sx.load_dataset(transforms_named(tmp_path / "capture", name))
    assert str(error.value).isprintable()


def test_a_photo_on_disk_with_control_characters_is_refused_by_llff(tmp_path):
    capture = write_llff(tmp_path / "capture")
    (capture / "images" / "IMG_00.png").rename(capture / "images" / "IMG_00\x1b[31m.png")
    with pytest.raises(DatasetError, match=r"control characters"):
        sx.load_dataset(capture)


def test_names_of_unused_photos_are_shown_without_control_characters(tmp_path):
    capture = write_capture(tmp_path / "capture")
    shutil.copy(capture / "images" / "photo00.png", capture / "images" / "evil\x1b]0;pwn\x07.png")
    dataset = sx.load_dataset(capture)
    assert dataset.survey.unused == (r"evil\x1b]0;pwn\x07.png",)


# --- links ---


def test_a_link_out_of_the_capture_is_refused(tmp_path):
    capture = write_capture(tmp_path / "capture")
    photo = capture / "images" / "photo03.png"
    photo.rename(tmp_path / "elsewhere.png")
    photo.symlink_to(tmp_path / "elsewhere.png")
    with pytest.raises(DatasetError, match=r"photo03.png: a link to a file outside of the capture"):
        sx.load_dataset(capture)


@pytest.mark.parametrize("write", [write_capture, write_transforms, write_llff])
def test_folders_of_photos_and_captures_may_be_links(write, tmp_path):
    capture = write(tmp_path / "capture")
    (capture / "images").rename(tmp_path / "photos")
    (capture / "images").symlink_to(tmp_path / "photos")
    (tmp_path / "link").symlink_to(capture)
    assert len(sx.load_dataset(tmp_path / "link").views) == 9


def test_shrunk_photos_may_be_links_to_others_of_the_capture(tmp_path):
    capture = write_capture(tmp_path / "capture")
    (capture / "images_2").mkdir()
    for photo in (capture / "images").iterdir():
        (capture / "images_2" / photo.name).symlink_to(photo)
    assert "from images_2/" in sx.load_dataset(capture, downscale=2).notes[1]


def test_a_mask_that_is_a_link_out_of_the_capture_is_refused(tmp_path):
    capture = write_capture(tmp_path / "capture")
    (capture / "masks").mkdir()
    Image.new("L", (64, 48), 255).save(tmp_path / "mask.png")
    (capture / "masks" / "photo01.png").symlink_to(tmp_path / "mask.png")
    with pytest.raises(DatasetError, match=r"masks/photo01.png: a link"):
        sx.load_dataset(capture)


# --- COLMAP's names ---


def test_two_images_of_one_name_are_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"two images of the model have the name photo01.png"):
        sx.load_dataset(colmap_named(tmp_path / "capture", "photo01.png"))


@pytest.mark.parametrize("text", [False, True])
def test_a_name_that_is_not_utf8_is_said(text, tmp_path):
    capture = write_capture(tmp_path / "capture", text=text)
    path = capture / "sparse" / "0" / ("images.txt" if text else "images.bin")
    path.write_bytes(path.read_bytes().replace(b"photo00.png", b"\xfchoto00.png"))
    with pytest.raises(DatasetError, match=r"name \\xfchoto00.png is not UTF-8. Rename"):
        sx.load_dataset(capture)


def test_folders_in_names_are_kept(tmp_path):
    capture = tmp_path / "capture"
    listed = [f"left/photo{i}.png" for i in range(4)]
    (capture / "sparse" / "0").mkdir(parents=True)
    model_of(listed, pinhole()).write_binary(capture / "sparse" / "0")
    write_photos(capture / "images", listed)
    assert [view.name for view in sx.load_dataset(capture).views] == listed


# --- messages ---


def test_messages_are_one_bounded_line_of_visible_characters():
    error = InputError("photo \x1b[31m\r\n\u2028 " + "x" * 10**6 + " end")
    assert str(error).isprintable()
    assert len(str(error)) <= LONGEST_MESSAGE
    assert str(error).startswith(r"photo \x1b[31m\r\n\u2028")
    assert str(error).endswith("end")


def test_text_that_is_shown_keeps_letters_of_all_scripts():
    assert shown("ü 日本 naïve.jpg") == "ü 日本 naïve.jpg"


def test_positions_of_points_are_finite(tmp_path):
    capture = write_capture(tmp_path / "capture")
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    model.add_point3D(np.array([np.nan, 0, 0]), pycolmap.Track(), np.zeros(3, np.uint8))
    model.write_binary(capture / "sparse" / "0")
    with pytest.raises(DatasetError, match="coordinates that are not finite"):
        sx.load_dataset(capture)
