"""`splatax rig`, `bind` and `animate`: from photos of a body in known poses to a video."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from test_refusals import refused

import splatax as sx
from splatax import cli
from splatax.cli import rigging
from splatax.demo.posed_capture import write_arm_capture
from splatax.io.formats.marks import metres_mark
from splatax.io.rigs import load_rigged
from splatax.runs import claim
from splatax.sensors.metres import metres_of
from splatax.training.rigged import optimize_rig


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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_rig_is_drawn_with_the_filter_and_in_the_order_that_it_was_trained_with(arm, tmp_path, monkeypatch):
    recipes = []

    def recorded(dataset, recipe, *arguments):
        recipes.append(recipe)
        return optimize_rig(dataset, recipe, *arguments)

    monkeypatch.setattr(rigging, "optimize_rig", recorded)
    poses = ["--skeleton", f"{arm}/body.glb", "--poses", f"{arm}/poses.json", "--out", str(tmp_path)]
    sizes = ["--steps", "1", "--max-gaussians", "100"]
    cli.main(["rig", str(arm), *poses, *sizes, "--low-pass", "antialiasing:0.1", "--order", "depth"])
    assert [recipe.drawing.low_pass for recipe in recipes] == [sx.Antialiasing(0.1)]
    assert (
        [recipe.drawing.order for recipe in recipes] == [sx.load(tmp_path / "scene.ply").order] == ["depth"]
    )
    assert load_rigged(tmp_path / "rigged.glb").gaussians.low_pass == sx.Antialiasing(0.1)
    assert sx.load(tmp_path / "scene.ply").low_pass == sx.Antialiasing(0.1)


class PowerCut(Exception):
    """Ends a run where it is."""


def stopping_at(step):
    """Trains a rig until the power fails after a step."""

    def optimize(*arguments):
        for progress in optimize_rig(*arguments):
            if progress.step == step:
                raise PowerCut
            yield progress

    return optimize


@pytest.mark.slow
def test_a_run_that_was_stopped_again_and_again_ends_with_the_same_bytes(capsys, arm, tmp_path, monkeypatch):
    def start(out):
        files = ["--skeleton", f"{arm}/body.glb", "--poses", f"{arm}/poses.json", "--out", str(out)]
        learned = ["--refine", "poses+weights", "--checkpoint-steps", "4"]
        cli.main(["rig", str(arm), *files, *learned, "--steps", "20", "--max-gaussians", "200"])

    start(tmp_path / "whole")
    run = tmp_path / "run"
    monkeypatch.setattr(rigging, "optimize_rig", stopping_at(7))
    with pytest.raises(PowerCut):
        start(run)
    monkeypatch.setattr(rigging, "optimize_rig", stopping_at(18))
    with pytest.raises(PowerCut):
        cli.main(["rig", "--resume", str(run)])
    assert sorted(path.name for path in (run / "checkpoints").iterdir()) == ["00000012.npz", "00000016.npz"]
    monkeypatch.setattr(rigging, "optimize_rig", optimize_rig)
    assert "run of splatax rig, not of splatax train" in refused(capsys, "train", "--resume", str(run))
    assert "--seed 3: the run was started with 0" in refused(
        capsys, "rig", "--resume", str(run), "--seed", "3"
    )
    cli.main(["rig", "--resume", str(run)])
    assert "resuming after step 16 of 20" in capsys.readouterr().out
    for name in ("rigged.glb", "scene.ply", "poses.json", "metrics.json"):
        assert (run / name).read_bytes() == (tmp_path / "whole" / name).read_bytes(), name
    assert json.loads((run / "metrics.json").read_text())["gaussians"] > 100  # it has grown on the way
    assert not (run / "checkpoints").exists()
    assert "already finished" in refused(capsys, "rig", "--resume", str(run))


def test_a_run_goes_on_only_with_the_body_and_the_poses_that_it_had(capsys, arm, tmp_path, monkeypatch):
    capture, run = shutil.copytree(arm, tmp_path / "arm"), tmp_path / "run"
    files = ["--skeleton", f"{capture}/body.glb", "--poses", f"{capture}/poses.json", "--out", str(run)]
    monkeypatch.setattr(rigging, "optimize_rig", stopping_at(2))
    with pytest.raises(PowerCut):
        cli.main(["rig", str(capture), *files, "--steps", "3", "--checkpoint-steps", "1"])
    poses = json.loads((capture / "poses.json").read_text())
    (capture / "poses.json").write_text(json.dumps(poses, indent=3))
    assert "the capture of the run changed: poses was" in refused(capsys, "rig", "--resume", str(run))


def test_a_new_run_needs_a_capture_a_body_poses_and_a_folder(capsys):
    said = refused(capsys, "rig")
    assert "Missing: the folder of a capture, --skeleton, --poses, --out." in said


def test_a_film_shows_the_poses_of_the_clip(run, tmp_path):
    cli.main(["animate", str(run), str(tmp_path / "film"), "--clip", "Wave", "--size", "32x24", "--fps", "2"])
    frames = sorted((tmp_path / "film").iterdir())
    assert len(frames) == 4  # of 2 seconds
    first, second = (np.asarray(Image.open(frame), int) for frame in frames[:2])
    assert first.max() > 60  # something is seen
    assert np.abs(first - second).max() > 20  # and moves


def test_a_file_keeps_the_one_clip_that_was_asked_for(run, tmp_path, capsys):
    cli.main(["animate", str(run), str(tmp_path / "a.glb"), "--clip", "Wave"])
    assert "loses: only rounding" in capsys.readouterr().out
    assert list(load_rigged(tmp_path / "a.glb").clips) == ["Wave"]


def test_a_scan_is_bound_to_a_body(capsys, run, arm, tmp_path):
    cli.main(["bind", str(run / "scene.ply"), f"{arm}/body.glb", "--out", str(tmp_path / "bound.glb")])
    assert "loses: only rounding" in capsys.readouterr().out
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
    assert "pose3-0.png: its mask is entirely black" in said
    assert not (tmp_path / "run").exists()


def test_a_disk_without_space_for_the_results_is_refused_before_training(capsys, arm, tmp_path, monkeypatch):
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(claim.shutil, "disk_usage", lambda _: usage._replace(free=10**6))
    body = ["--skeleton", f"{arm}/body.glb", "--poses", f"{arm}/poses.json"]
    said = refused(capsys, "rig", str(arm), *body, "--out", str(tmp_path / "run"), "--steps", "1")
    assert "the results need about" in said
    assert not (tmp_path / "run").exists()


def test_a_bound_scan_keeps_its_scale_in_metres(run, arm, tmp_path):
    scan = tmp_path / "scan.ply"
    sx.save(scan, sx.load(run / "scene.ply"), comments=(metres_mark(0.25),))
    cli.main(["bind", str(scan), f"{arm}/body.glb", "--out", str(tmp_path / "bound.glb")])
    cli.main(["animate", str(tmp_path / "bound.glb"), str(tmp_path / "wave.glb")])
    for name in ("bound.glb", "wave.glb"):
        assert metres_of(tmp_path / name) == 0.25
