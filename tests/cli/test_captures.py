"""Captures of every layout, from the command line."""

import json

import pytest

from captures import write_blender, zipped
from splatax import cli


@pytest.fixture
def blender(tmp_path):
    return write_blender(tmp_path / "blender")


def train(scene, out, *options):
    cli.main(["train", str(scene), "--out", str(out), "--steps", "2", "--init", "random", *options])
    return json.loads((out / "config.json").read_text()), json.loads((out / "metrics.json").read_text())


@pytest.mark.slow
def test_a_zip_of_blenders_photos_is_trained_scored_and_drawn_over_white(blender, tmp_path):
    scene = zipped(blender, tmp_path / "blender.zip")
    config, metrics = train(scene, tmp_path / "run")
    assert config["options"]["background"] == "white"
    assert config["recipe"]["drawing"]["background"]["rgb"] == [1.0, 1.0, 1.0]
    cli.main(["eval", str(tmp_path / "run"), str(scene), "--out", str(tmp_path / "scores.json")])
    scores = json.loads((tmp_path / "scores.json").read_text())
    assert scores["psnr"] == metrics["test"]["psnr"]
    assert "(1.0, 1.0, 1.0)" in scores["protocol"]["background"]
    cli.main(["render", str(tmp_path / "run"), str(scene), "--out", str(tmp_path / "pictures")])
    assert (tmp_path / "pictures" / "rgb" / "test" / "r_0.png").is_file()


def test_another_background_may_be_asked_for(blender, tmp_path):
    config, _ = train(blender, tmp_path / "run", "--background", "black")
    assert config["options"]["background"] == "black"
