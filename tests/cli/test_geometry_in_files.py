"""Errors of geometry in the files of `splatax eval` and `splatax train`, on a wall whose place is known."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

import splatax as sx
from scenes import plane_of_gaussians
from splatax import cli
from splatax.cameras.geometry import rays
from splatax.geometry_scores import DEPTHS, OF_PLANES, as_json, evaluate_geometry

PLACE, FACING = 5.0, np.array([0.0, 0.0, -1.0])
BEHIND = 0.25  # distance of the wall behind the truth, along the cameras' axes


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    """The splat file of a wall that fills all photos."""
    plane = plane_of_gaussians(FACING, n=4000, half=6.0, sigma=0.25)
    path = tmp_path_factory.mktemp("wall") / "wall.ply"
    sx.save(path, replace(plane, means=plane.means.at[:, 2].set(PLACE)))
    return path


@pytest.fixture(scope="module")
def with_truth(capture, tmp_path_factory):
    """The capture, with a truth that lies before the wall."""
    folder = tmp_path_factory.mktemp("captures") / "truth"
    shutil.copytree(capture, folder)
    for kind in ("depth", "normals"):
        (folder / "truth" / kind).mkdir(parents=True)
    for view in sx.load_dataset(capture).views:
        along = np.asarray(rays(view.camera), np.float64)
        origin, axis = np.asarray(view.camera.position), np.asarray(view.camera.rotation[2])
        depth = (PLACE - origin[2]) / along[..., 2] * (along @ axis)
        normals = np.broadcast_to(FACING, along.shape)
        np.save((folder / "truth" / "depth" / view.name).with_suffix(".npy"), np.float32(depth - BEHIND))
        np.save((folder / "truth" / "normals" / view.name).with_suffix(".npy"), np.float32(normals))
    return folder


def read(path):
    return json.loads(path.read_text())


def evaluated(model, capture, out):
    cli.main(["eval", str(model), str(capture), "--out", str(out)])
    return read(out)["geometry"]


def test_eval_compares_depth_and_normals_with_the_truth(wall, with_truth, tmp_path, capsys):
    found = evaluated(wall, with_truth, tmp_path / "scores.json")
    assert found["reference"] == "truth"
    assert found["depth"].keys() == set(DEPTHS)
    for output in OF_PLANES:
        errors = found["depth"][output]
        assert errors["error"] == errors["bias"] == pytest.approx(BEHIND, abs=1e-3)
        assert 0.045 < errors["capped_error"] <= 0.05  # depths are about 5
    assert found["normal_error"] < 0.1
    assert found["coverage"] == 1
    assert [view["name"] for view in found["views"]] == ["photo04.png"]
    printed = capsys.readouterr().out
    assert "surface_depth: 0.25 off the truth" in printed
    assert "normals: 0.0 degrees off the truth" in printed


def test_eval_compares_depth_with_the_points_where_there_is_no_truth(wall, capture, tmp_path, capsys):
    found = evaluated(wall, capture, tmp_path / "scores.json")
    expected = as_json(evaluate_geometry(sx.load(wall), sx.load_dataset(capture).test))
    assert found == json.loads(json.dumps(expected))
    assert found["reference"] == "points"
    assert "normal_error" not in found
    # The points are evenly spread from one unit before the wall to one behind it.
    assert 0.3 < found["depth"]["surface_depth"]["error"] < 0.7
    assert "off the capture's points" in capsys.readouterr().out


def test_train_writes_what_eval_finds_with_points_and_with_truth(trained, capture, with_truth, tmp_path):
    out = tmp_path / "run"
    cli.main(["train", str(with_truth), "--out", str(out), "--steps", "6"])
    for run, scene, reference in ((trained, capture, "points"), (out, with_truth, "truth")):
        found = read(run / "metrics.json")["geometry"]
        assert found["reference"] == reference
        assert found["depth"].keys() == set(DEPTHS)
        assert found == evaluated(run, scene, tmp_path / "scores.json")
