"""Commands on the run folders of other programs."""

import json
import shutil

import pytest

import splatax as sx
from splatax import cli
from torch_files import write_checkpoint

CFG_ARGS = "Namespace(eval=False, resolution=-1, source_path='{}', white_background=True, antialiasing=True)"


@pytest.fixture
def inria(trained, capture, tmp_path):
    """The scene of a short run as INRIA's trainer stores it."""
    run = tmp_path / "garden"
    for step in (7000, 30_000):
        folder = run / "point_cloud" / f"iteration_{step}"
        folder.mkdir(parents=True)
        shutil.copy(trained / "scene.ply", folder / "point_cloud.ply")
    (run / "cfg_args").write_text(CFG_ARGS.format(capture))
    return run


def test_a_run_of_inria_is_scored_as_it_was_trained(inria, trained, capture, tmp_path, capsys):
    cli.main(["eval", str(inria), str(capture), "--out", str(tmp_path / "theirs.json")])
    assert "trained on all photos" in capsys.readouterr().out
    same = [str(trained), str(capture), "--background", "white", "--low-pass", "antialiasing"]
    cli.main(["eval", *same, "--hold-out", "every:8:1", "--out", str(tmp_path / "ours.json")])
    theirs, ours = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("theirs", "ours"))
    assert theirs["model"].endswith("iteration_30000/point_cloud.ply")
    assert theirs["views"] == ours["views"]


def test_a_checkpoint_of_gsplat_is_exported(trained, tmp_path):
    scene = sx.load(trained / "scene.ply")
    write_checkpoint(tmp_path / "garden" / "ckpts" / "ckpt_29999_rank0.pt", scene)
    cli.main(["export", str(tmp_path / "garden"), str(tmp_path / "out.ply")])
    assert len(sx.load(tmp_path / "out.ply")) == len(scene)
