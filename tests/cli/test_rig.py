"""`splatax rig`, `bind` and `animate`: from photos of a body in known poses to a film."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from test_refusals import refused

import splatax as sx
from splatax import cli
from splatax.demo.posed_capture import write_arm_capture
from splatax.io.formats.marks import metres_mark
from splatax.io.rigs import load_rigged
from splatax.sensors.metres import metres_of


@pytest.fixture(scope="module")
def arm(tmp_path_factory):
    folder = tmp_path_factory.mktemp("arm")
    write_arm_capture(folder, size=24, poses=4, views=2)
    return folder


@pytest.fixture(scope="module")
def run(arm, tmp_path_factory):
    out = tmp_path_factory.mktemp("runs") / "arm"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "keep_compiled_programs", lambda: None)
        poses = ["--skeleton", f"{arm}/body.glb", "--poses", f"{arm}/poses.json"]
        cli.main(["rig", str(arm), *poses, "--out", str(out), "--steps", "3", "--max-gaussians", "200"])
    return out


def test_a_run_holds_the_scene_its_poses_and_its_scores(run, arm):
    scores = json.loads((run / "metrics.json").read_text())
    assert set(scores["photos"]["test"]) == {"pose3-0.png", "pose3-1.png"}
    scene = load_rigged(run / "rigged.glb")
    assert len(scene.gaussians) == scores["gaussians"]
    assert list(scene.clips) == ["Wave"]
    np.testing.assert_allclose(sx.load(run / "scene.ply").means, scene.gaussians.means, atol=1e-6)
    report = (run / "report.html").read_text()
    assert "PSNR of 2 held-out photos" in report
    assert report.count('alt="render"') == 2
    given, kept = (json.loads((folder / "poses.json").read_text()) for folder in (arm, run))
    assert kept["photos"] == given["photos"]


def test_a_film_shows_the_poses_of_the_clip(run, tmp_path):
    cli.main(["animate", str(run), str(tmp_path / "film"), "--clip", "Wave", "--size", "32x24", "--fps", "2"])
    frames = sorted((tmp_path / "film").iterdir())
    assert len(frames) == 4  # of 2 seconds
    first, second = (np.asarray(Image.open(frame), int) for frame in frames[:2])
    assert first.max() > 60  # something is seen
    assert np.abs(first - second).max() > 20  # and moves


def test_a_file_keeps_the_one_clip_that_was_asked_for(run, tmp_path):
    cli.main(["animate", str(run), str(tmp_path / "a.glb"), "--clip", "Wave"])
    assert list(load_rigged(tmp_path / "a.glb").clips) == ["Wave"]


def test_a_scan_is_bound_to_a_body(capsys, run, arm, tmp_path):
    cli.main(["bind", str(run / "scene.ply"), f"{arm}/body.glb", "--out", str(tmp_path / "bound.glb")])
    bound = load_rigged(tmp_path / "bound.glb")
    np.testing.assert_allclose(
        bound.gaussians.means, load_rigged(run / "rigged.glb").gaussians.means, atol=1e-6
    )
    assert "--overwrite" in refused(
        capsys, "bind", str(run), f"{arm}/body.glb", "--out", str(tmp_path / "bound.glb")
    )


def test_what_does_not_exist_is_refused_with_what_does(capsys, run, arm, tmp_path):
    assert "the clips are Wave" in refused(
        capsys, "animate", str(run), str(tmp_path / "a.glb"), "--clip", "Jump"
    )
    assert "splats with a skin" in refused(capsys, "animate", str(arm / "body.glb"), str(tmp_path / "a.glb"))
    body = ["--skeleton", f"{arm}/body.glb", "--out", str(tmp_path / "run")]
    assert "has: Wave" in refused(capsys, "rig", str(arm), *body, "--poses", "Jump")
    none = ["--poses", f"{arm}/poses.json", "--max-gaussians", "0"]
    assert "--max-gaussians: at least 1, not 0" in refused(capsys, "rig", str(arm), *body, *none)


def test_a_held_out_photo_whose_mask_is_black_all_over_is_refused_before_training(capsys, arm, tmp_path):
    capture = shutil.copytree(arm, tmp_path / "arm")
    (capture / "masks").mkdir()
    Image.new("L", (24, 24)).save(capture / "masks" / "pose3-0.png")
    body = ["--skeleton", f"{arm}/body.glb", "--poses", f"{arm}/poses.json"]
    said = refused(capsys, "rig", str(capture), *body, "--out", str(tmp_path / "run"), "--steps", "1")
    assert "pose3-0.png: its mask is black all over" in said
    assert not (tmp_path / "run").exists()


def test_a_bound_scan_keeps_its_scale_in_metres(run, arm, tmp_path):
    scan = tmp_path / "scan.ply"
    sx.save(scan, sx.load(run / "scene.ply"), comments=(metres_mark(0.25),))
    cli.main(["bind", str(scan), f"{arm}/body.glb", "--out", str(tmp_path / "bound.glb")])
    cli.main(["animate", str(tmp_path / "bound.glb"), str(tmp_path / "wave.glb")])
    for name in ("bound.glb", "wave.glb"):
        assert metres_of(tmp_path / name) == 0.25
