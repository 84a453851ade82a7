"""Bad input: one sentence with the path and a fix, exit code 2, no traceback, no lost files."""

import shutil

import pytest
from PIL import Image

import splatax as sx
from captures import write_capture
from scenes import random_gaussians
from splatax import cli
from splatax.runs import claim
from splatax.training.recipes import PRESETS


def refused(capsys, *arguments) -> str:
    """The sentence that a command ends with."""
    with pytest.raises(SystemExit) as exit:
        cli.main([str(argument) for argument in arguments])
    assert exit.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("splatax: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    return error


@pytest.mark.parametrize("command", ["train", "create"])
def test_an_unknown_recipe_is_refused_with_the_recipes_in_their_order(command, capsys):
    with pytest.raises(SystemExit) as exit:
        cli.main([command, "capture", "--recipe", "unknown"])
    assert exit.value.code == 2
    error = " ".join(capsys.readouterr().err.replace("│", " ").split())
    assert f"Expected one of {tuple(PRESETS)}" in error


def test_photos_too_small_for_a_score_are_refused_before_training(tmp_path, capsys):
    capture = write_capture(tmp_path / "capture")
    message = refused(capsys, "train", capture, "--out", tmp_path / "run", "--steps", 2, "--downscale", 8)
    assert "photo04.png: 8 x 6 pixels are too few for a score, which needs at least 11 x 11" in message
    assert "See --downscale, --hold-out" in message
    assert not (tmp_path / "run").exists()


def test_a_disk_without_space_for_the_results_is_refused_before_training(tmp_path, capsys, monkeypatch):
    capture = write_capture(tmp_path / "capture")
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(claim.shutil, "disk_usage", lambda _: usage._replace(free=10**6))
    message = refused(capsys, "train", capture, "--out", tmp_path / "run", "--steps", 2)
    assert "the results need about 6," in message
    assert "1,000,000 bytes free" in message
    assert "See --out" in message
    assert not (tmp_path / "run" / "scene.ply").exists()


def test_a_damaged_held_out_photo_is_refused_before_training(tmp_path, capsys):
    capture = write_capture(tmp_path / "capture")
    path = capture / "images" / "photo04.png"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    message = refused(capsys, "train", capture, "--out", tmp_path / "run", "--steps", 2)
    assert f"{path}: the photo is damaged" in message
    assert "Training is saved" not in message


def test_a_held_out_photo_whose_mask_is_black_is_refused_before_training(tmp_path, capsys):
    capture = write_capture(tmp_path / "capture")
    (capture / "masks").mkdir()
    Image.new("L", (64, 48)).save(capture / "masks" / "photo04.png")
    message = refused(capsys, "train", capture, "--out", tmp_path / "run", "--steps", 2)
    assert "photo04.png: its mask is entirely black" in message
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize(
    "command",
    [
        ("render", "{scene}", "--path", "orbit", "--out", "{out}.gif"),
        ("export", "{scene}", "{out}.spz"),
        ("page", "{scene}", "{out}.html"),
        ("mesh", "{scene}", "{out}.ply", "--scene", "{capture}"),
        ("eval", "{scene}", "{capture}"),
    ],
)
def test_a_scene_without_gaussians_is_refused_by_its_name(command, tmp_path, capsys):
    scene, capture = tmp_path / "empty.ply", write_capture(tmp_path / "capture")
    sx.save(scene, random_gaussians(n=0))
    places = {"scene": scene, "capture": capture, "out": tmp_path / "out"}
    message = refused(capsys, *(part.format(**places) for part in command))
    assert f"{scene}: a scene without Gaussians" in message
    assert not list(tmp_path.glob("out*"))


def test_a_home_in_an_option_is_the_users_folder(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("USERPROFILE", str(tmp_path))
    capture = write_capture(tmp_path / "capture")
    monkeypatch.chdir(tmp_path)
    cli.main(["train", str(capture), "--steps", "1", "--out=~/run"])
    assert (tmp_path / "run" / "scene.ply").exists()
    assert not (tmp_path / "~").exists()


def without_model(capture):
    shutil.rmtree(capture / "sparse")
    return f"{capture}"


def with_half_a_file(capture):
    path = capture / "sparse" / "0" / "images.bin"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    return f"{path}: damaged"


def without_a_photo(capture):
    (capture / "images" / "photo03.png").unlink()
    return f"{capture / 'images' / 'photo03.png'}: the photo is missing"


def with_a_cropped_photo(capture):
    Image.new("RGB", (64, 20)).save(capture / "images" / "photo03.png")
    return f"{capture / 'images' / 'photo03.png'}: 64 x 20 pixels"


def without_itself(capture):
    shutil.rmtree(capture)
    return f"{capture}: no such folder"


@pytest.mark.parametrize(
    "damage",
    [without_itself, without_model, with_half_a_file, without_a_photo, with_a_cropped_photo],
)
def test_a_broken_capture_is_refused_and_the_run_left_alone(damage, tmp_path, capsys):
    capture = write_capture(tmp_path / "capture")
    run = tmp_path / "run"
    run.mkdir()
    (run / "scene.ply").write_bytes(b"earlier")
    expected = damage(capture)
    assert expected in refused(capsys, "train", capture, "--out", run, "--overwrite", "--steps", 1)
    assert [path.name for path in run.iterdir()] == ["scene.ply"]
    assert (run / "scene.ply").read_bytes() == b"earlier"


def test_a_run_is_not_replaced_unless_told(capture, tmp_path, capsys):
    (tmp_path / "scene.ply").write_bytes(b"earlier")
    assert "--overwrite" in refused(capsys, "train", capture, "--out", tmp_path, "--steps", 1)
    assert "--overwrite" in refused(capsys, "demo", "--out", tmp_path)
    assert (tmp_path / "scene.ply").read_bytes() == b"earlier"


def test_a_model_that_is_no_splat_file(capture, tmp_path, capsys):
    mesh = tmp_path / "mesh.ply"
    mesh.write_text("ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nend_header\n0\n")
    assert str(mesh) in refused(capsys, "eval", mesh, capture)
    assert str(mesh) in refused(capsys, "render", mesh, capture, "--out", tmp_path / "pictures")
    assert not (tmp_path / "pictures").exists()


def test_a_folder_without_a_model(capture, tmp_path, capsys):
    assert f"{tmp_path}: no scene.ply" in refused(capsys, "eval", tmp_path, capture)
    assert "missing.ply" in refused(capsys, "eval", tmp_path / "missing.ply", capture)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ("--steps 0", "--steps"),
        ("--max-gaussians 0", "--max-gaussians"),
        ("--downscale 0", "--downscale"),
        ("--low-pass mip", "--low-pass: no filter 'mip'. There are dilation, antialiasing, along-rays"),
        ("--low-pass dilation:0", "--low-pass: '0' is no variance in square pixels above 0"),
        ("--low-pass dilation:wide", "--low-pass: 'wide' is no variance in square pixels above 0"),
    ],
)
def test_options_out_of_range(capture, tmp_path, capsys, options, named):
    assert named in refused(capsys, "train", capture, "--out", tmp_path / "run", *options.split())
    assert not (tmp_path / "run").exists()


def test_a_list_of_photos_that_is_not_there(capture, tmp_path, capsys):
    error = refused(capsys, "train", capture, "--out", tmp_path, "--hold-out", tmp_path / "missing.txt")
    assert "missing.txt: the list of photos cannot be read (No such file or directory).\n" in error


def test_output_that_cannot_be_written(capture, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    assert "a file, not a folder" in refused(capsys, "train", capture, "--out", tmp_path / "file")
    assert "file" in refused(capsys, "bench", "--scenes", 10, "--out", tmp_path / "file")


@pytest.mark.parametrize(
    ("place", "expected"),
    [
        ("file/scene.spz", "file: a file, where a folder is needed"),
        ("file/folder/scene.spz", "lies below a file, where a folder is needed"),
        ("folder.spz", "folder.spz: a folder, where a file is needed"),
    ],
)
def test_results_that_have_no_place(trained, tmp_path, capsys, place, expected):
    (tmp_path / "file").touch()
    (tmp_path / "folder.spz").mkdir()
    assert expected in refused(capsys, "export", trained, tmp_path / place, "--overwrite")
    assert not list(tmp_path.glob(".*"))


def test_bench_of_what_is_no_scene(tmp_path, capsys):
    assert "--scenes nothing" in refused(capsys, "bench", "--scenes", "nothing", "--out", tmp_path)
    assert "--sizes" in refused(capsys, "bench", "--sizes", "wide", "--out", tmp_path)
