"""Commands that read a damaged record print one sentence that names it."""

import json
import shutil

import pytest
from test_refusals import refused

import splatax as sx
from shortened import shortened
from splatax.cli.options import read_model
from splatax.errors import FormatError
from splatax.runs.checkpoints import Checkpoints, files
from splatax.runs.history import History, packed
from splatax.runs.resume import facts, find
from splatax.training import checkpoint
from splatax.training.checkpoint import Checkpoint
from splatax.web import page
from training.test_training import capture as made


@pytest.fixture
def run(trained, tmp_path):
    return shutil.copytree(trained, tmp_path / "run")


def edited(path, edit):
    contents = json.loads(path.read_text())
    edit(contents)
    path.write_text(json.dumps(contents))


def options(**changes):
    return lambda config: config["options"].update(changes)


DAMAGES = [
    lambda config: config.update(options=[]),
    lambda config: config.update(options=None),
    options(background="plaid"),
    options(background=3),
    options(background=[]),
    options(downscale="large"),
    options(downscale=0),
    options(downscale={}),
    options(scene=5),
    options(scene=None),
]


@pytest.mark.parametrize("command", ["eval", "render", "view", "page", "compare"])
@pytest.mark.parametrize("contents", ["", "{", "[]", "null"])
def test_a_config_that_is_no_object_is_refused(command, contents, run, trained, capture, tmp_path, capsys):
    (run / "config.json").write_text(contents)
    others = {
        "render": [capture, "--out", tmp_path / "x"],
        "page": [tmp_path / "x.html"],
        "compare": [trained],
    }
    error = refused(capsys, command, run, *others.get(command, [capture]))
    assert f"{run / 'config.json'}: damaged (" in error


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_config_with_senseless_options_is_refused(damage, run, trained, capture, capsys):
    edited(run / "config.json", damage)
    for command in (("eval", run, capture), ("compare", trained, run)):
        assert f"{run / 'config.json'}: damaged (" in refused(capsys, *command)


def test_a_config_of_another_program_tells_nothing_and_is_no_damage(run):
    (run / "config.json").write_text('{"sh_degree": 3}')
    assert read_model(run).options == {}


@pytest.mark.parametrize(
    "damage",
    [
        lambda metrics: metrics.update(test=[1]),
        lambda metrics: metrics.update(test={}),
        lambda metrics: metrics["test"].update(psnr="high"),
        lambda metrics: metrics["test"].update(views=3),
        lambda metrics: metrics["test"]["views"][0].pop("psnr"),
        lambda metrics: metrics["test"]["views"][0].update(name=None),
        lambda metrics: metrics.update(evaluations=[{}]),
        lambda metrics: metrics.update(evaluations=[{"psnr": 1, "seconds": "long"}]),
        lambda metrics: metrics.update(gaussians="many"),
        lambda metrics: metrics.update(peak_rss_bytes="1"),
        lambda metrics: metrics.update(protocol=3),
    ],
)
def test_metrics_that_make_no_sense_are_refused(damage, run, trained, capsys):
    edited(run / "metrics.json", damage)
    assert f"{run / 'metrics.json'}: damaged (" in refused(capsys, "compare", trained, run)


@pytest.mark.parametrize(
    "damage",
    [
        options(steps="many"),
        options(seed=None),
        options(scene=5),
        options(recipe="best"),
        lambda config: config.update(changes=[[1]]),
        lambda config: config.update(changes=[["a", "b"]]),
        lambda config: config.update(changes=3),
    ],
)
def test_a_config_that_cannot_be_repeated_is_refused(damage, run, tmp_path, capsys):
    edited(run / "config.json", damage)
    error = refused(capsys, "train", "--repeat", run, "--out", tmp_path / "again")
    assert str(run) in error
    assert "damaged (" in error
    assert not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    "contents", ["", "{", "[]", "{}", '{"photos": 3, "seconds": 60}', '{"photos": "x", "seconds": "60"}', "3"]
)
def test_a_damaged_order_of_create_is_refused(contents, capture, tmp_path, capsys, monkeypatch):
    (tmp_path / "viewer.js").touch()
    monkeypatch.setattr(page, "VIEWER", tmp_path / "viewer.js")
    out = tmp_path / "out"
    out.mkdir()
    (out / "create.json").write_text(contents)
    error = refused(capsys, "create", capture, "--out", out)
    assert f"{out / 'create.json'}: damaged (" in error
    assert "--overwrite" in error


@pytest.fixture(scope="module")
def saved():
    """A checkpoint of a run after its first step."""
    dataset, recipe = made(), shortened("classic")
    state = next(sx.optimize(dataset, recipe)).state
    header, arrays = packed(History(losses=[0.5], counts=[state.count]))
    return checkpoint.take(state, {"run": facts({"scene": "x"}, recipe, dataset), **header}, arrays)


@pytest.mark.parametrize(
    "damage",
    [
        {"run": []},
        {"run": None},
        {"run": {}},
        {"step": "1"},
        {"count": None},
        {"count": [1]},
        {"seconds": "long", "evaluations": 3},
        {"evaluations": [{}]},
        {"evaluations": [{"step": 1, "seconds": 1, "scores": {"views": [{"x": 1}]}}]},
        {"frames": ["a label without a picture"]},
        {"changes": [3]},
    ],
)
def test_a_checkpoint_with_sound_checksums_and_a_senseless_header_is_refused(damage, saved, tmp_path):
    Checkpoints(tmp_path, {})
    (tmp_path / "checkpoints").mkdir()
    path = tmp_path / "checkpoints" / "00000001.npz"
    with path.open("wb") as file:
        checkpoint.write(file, Checkpoint({**saved.header, **damage}, saved.arrays))
    assert files(tmp_path) == [path]
    with pytest.raises(FormatError, match="damaged") as refusal:
        find(tmp_path)
    assert str(refusal.value).startswith(f"{path}: ")
    assert str(refusal.value).endswith("Start the run again.")


def test_the_checkpoint_itself_is_sound(saved, tmp_path):
    """So that the tests above see the damage that they made."""
    (tmp_path / "checkpoints").mkdir()
    with (tmp_path / "checkpoints" / "00000001.npz").open("wb") as file:
        checkpoint.write(file, saved)
    assert find(tmp_path).history.losses == [0.5]
