"""The commands on a tiny capture: the files that they write, and that these agree with each other."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace

import docstring_parser
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image
from test_refusals import refused

import splatax as sx
from splatax import backends, cli, lpips
from splatax.cli import render
from splatax.cli.blocks import PlanBlocks
from splatax.cli.commands import COMMANDS
from splatax.cli.reconstruct import FindingCameras, Reconstruct
from splatax.cli.settings import Settings
from splatax.training.backgrounds import Solid
from splatax.training.geometry import Surfaces
from splatax.training.initialize import InFrusta, WithSky
from splatax.training.recipes import PRESETS, room_for

SPLIT = ("photo04.png",)  # every 8th of nine, from the 5th


def read_json(path):
    return json.loads(path.read_text())


def test_train_writes_the_scene_its_measures_and_its_report(trained):
    names = {path.name for path in trained.iterdir()}
    assert names == {
        "scene.ply",
        "metrics.json",
        "config.json",
        "held_out.json",
        "report.html",
        "progress.gif",
    }
    metrics = read_json(trained / "metrics.json")
    assert metrics["steps"] == 6
    assert metrics["gaussians"] == len(sx.load(trained / "scene.ply")) == 30
    assert [view["name"] for view in metrics["test"]["views"]] == list(SPLIT)
    assert [evaluation["step"] for evaluation in metrics["evaluations"]] == [3, 6]
    assert metrics["evaluations"][-1]["psnr"] == metrics["test"]["psnr"]
    assert metrics["train_seconds"] > 0
    assert metrics["peak_rss_bytes"] > 1e8
    assert "11x11" in metrics["protocol"]["ssim"]


def test_the_animation_ends_with_the_last_step(trained):
    with Image.open(trained / "progress.gif") as animation:
        assert animation.n_frames == 6
        assert animation.width == 64


def test_config_holds_all_that_repeats_a_run(trained, capture):
    config = read_json(trained / "config.json")
    assert config["options"]["scene"] == str(capture)
    assert config["options"]["seed"] == 0
    assert config["recipe"]["drawing"]["backend"] == backends.resolve("auto").name
    assert set(config["versions"]) >= {"splatax", "jax", "jaxlib", "numpy", "python"}


def test_options_decide_over_the_recipe_and_nothing_else_does(capture):
    dataset = sx.load_dataset(capture)
    plain = Settings(capture).to_recipe(dataset)
    assert plain == PRESETS["default"].build(30_000, room_for(dataset)).on(plain.drawing.backend)
    chosen = Settings(capture, recipe="mcmc", max_gaussians=70, init="random", background="white")
    recipe = chosen.to_recipe(dataset)
    assert recipe.density.max_gaussians == 70
    assert recipe.initialization == InFrusta(opacity=0.5, scale=0.1)
    assert recipe.drawing.background == Solid((1.0, 1.0, 1.0))
    surfaces = Settings(capture, geometry=True).to_recipe(dataset)
    assert surfaces == replace(plain, objective=replace(plain.objective, geometry=Surfaces()))
    later = Settings(capture, geometry=True, geometry_after=0.4).to_recipe(dataset)
    assert later == replace(plain, objective=replace(plain.objective, geometry=Surfaces(after=0.4)))
    from_the_start = Settings(capture, geometry=True, geometry_after=0.0).to_recipe(dataset)
    assert from_the_start == replace(plain, objective=replace(plain.objective, geometry=Surfaces(after=0.0)))
    Settings(capture, geometry_after=0.0).check()  # older runs without --geometry recorded it
    sky = Settings(capture, sky=True).to_recipe(dataset)
    assert sky == replace(plain, initialization=WithSky(plain.initialization))
    classic = Settings(capture, recipe="classic").to_recipe(dataset)
    assert classic == PRESETS["classic"].build().on(plain.drawing.backend)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--geometry", "--geometry-after", "1"), "--geometry-after: from 0 to below 1, not 1.0"),
        (("--geometry", "--geometry-after", "nan"), "--geometry-after: from 0 to below 1, not nan"),
        (("--geometry-after", "0.4"), "--geometry-after is about --geometry: give that too"),
    ],
)
def test_a_start_of_geometry_that_makes_no_sense_is_refused(options, message, capture, tmp_path, capsys):
    assert message in refused(capsys, "train", capture, "--out", tmp_path / "run", *options)


def test_the_preset_says_whether_photos_are_weighed_by_default(capture, monkeypatch):
    monkeypatch.setattr("splatax.cli.settings.FEWEST_TO_WEIGH", 1)
    dataset = sx.load_dataset(capture)
    assert Settings(capture).weighing(dataset) == "robust"
    assert Settings(capture, photo_weights="equal").weighing(dataset) == "equal"
    assert Settings(capture, recipe="mcmc").weighing(dataset) == "equal"
    monkeypatch.setitem(PRESETS, "mcmc", replace(PRESETS["mcmc"], weighs_photos=True))
    assert Settings(capture, recipe="mcmc").weighing(dataset) == "robust"


def test_eval_on_another_capture_is_said(trained, capture, tmp_path, capsys):
    other = tmp_path / "other"
    shutil.copytree(capture, other)
    cli.main(["eval", str(trained), str(other), "--out", str(tmp_path / "scores.json")])
    said = "".join(capsys.readouterr().out.split())  # long lines are broken
    assert f"was trained on {capture}, and is scored on photos of {other}".replace(" ", "") in said


def test_eval_of_the_run_repeats_its_scores(trained, capture, tmp_path, capsys):
    cli.main(["eval", str(trained), str(capture), "--out", str(tmp_path / "scores.json")])
    scores, metrics = read_json(tmp_path / "scores.json"), read_json(trained / "metrics.json")
    # The file stores what was trained bit for bit, so pictures, and their scores, are the same.
    assert scores["psnr"] == metrics["test"]["psnr"]
    assert scores["views"] == metrics["test"]["views"]
    printed = capsys.readouterr().out
    assert all(name in printed for name in SPLIT)
    assert f"{scores['psnr']:.3f}" in printed


def test_scores_state_the_worst_view_and_the_protocol_in_words(trained, capture, tmp_path, capsys):
    metrics = read_json(trained / "metrics.json")
    worst = min(metrics["test"]["views"], key=lambda view: view["psnr"])
    assert metrics["test"]["worst"] == {"name": worst["name"], "psnr": worst["psnr"]}
    assert all(view["corrected_psnr"] >= view["psnr"] for view in metrics["test"]["views"])
    assert "affine" in metrics["protocol"]["corrected_psnr"]
    assert "mask" in metrics["protocol"]["masks"]
    cli.main(["eval", str(trained), str(capture), "--out", str(tmp_path / "scores.json")])
    printed = capsys.readouterr().out
    assert f"worst   {worst['name']}" in printed
    assert f"{metrics['test']['corrected_psnr']:.3f}" in printed
    assert max(map(len, printed.split("scores  ")[0].splitlines())) <= 80


def test_eval_measures_lpips_with_the_weights_it_is_given(trained, capture, tmp_path, capsys):
    weights = tmp_path / "weights.npz"
    rng = np.random.default_rng(0)
    np.savez(weights, **{name: rng.uniform(size=shape) * 0.01 for name, shape in lpips.ALEX.shapes.items()})
    out = tmp_path / "scores.json"
    cli.main(["eval", str(trained), str(capture), "--lpips", str(weights), "--out", str(out)])
    scores = read_json(out)
    assert "AlexNet" in scores["protocol"]["lpips"]
    assert scores["lpips"] == pytest.approx(np.mean([view["lpips"] for view in scores["views"]]))
    assert f"{scores['lpips']:.4f}" in capsys.readouterr().out


def test_eval_scores_adjusted_poses_beside_the_given_ones(trained, capture, tmp_path, capsys):
    out = tmp_path / "scores.json"
    cli.main(["eval", str(trained), str(capture), "--adjust-poses", "--out", str(out)])
    scores, metrics = read_json(out), read_json(trained / "metrics.json")
    assert scores["views"] == metrics["test"]["views"]  # with given poses, as without the option
    adjusted = scores["adjusted_poses"]
    assert adjusted["psnr"] >= scores["psnr"] - 0.01
    assert [view["name"] for view in adjusted["views"]] == [view["name"] for view in scores["views"]]
    assert all(view["motion"] >= 0 for view in adjusted["views"])
    assert "adjusted to that photo" in adjusted["protocol"]["poses"]
    printed = capsys.readouterr().out
    assert f"{adjusted['psnr']:.3f} dB" in printed
    assert metrics["adjusted_poses"] is None  # nothing was done to training poses


def test_render_writes_colour_and_depth_of_the_split(trained, capture, tmp_path):
    out = tmp_path / "pictures"
    cli.main(["render", str(trained), str(capture), "--out", str(out), "--depth", "median_depth"])
    assert sorted(path.name for path in (out / "rgb").iterdir()) == list(SPLIT)
    gaussians, view = sx.load(trained / "scene.ply"), sx.load_dataset(capture).test[0]
    drawn = sx.render(gaussians, view.camera, outputs=("rgb", "median_depth"))
    expected = np.round(255 * np.clip(np.asarray(drawn.rgb), 0, 1))
    assert_array_equal(np.asarray(Image.open(out / "rgb" / SPLIT[0])), expected)
    assert_array_equal(np.load(out / "depth" / "photo04.npy"), drawn.median_depth)
    assert Image.open(out / "depth" / SPLIT[0]).size == (64, 48)


def test_render_keeps_pictures_unless_told(trained, capture, tmp_path, capsys):
    arguments = ["render", str(trained), str(capture), "--out", str(tmp_path)]
    cli.main(arguments)
    with pytest.raises(SystemExit) as exit:
        cli.main(arguments)
    assert exit.value.code == 2
    assert "--overwrite" in capsys.readouterr().err
    cli.main([*arguments, "--overwrite", "--split", "all"])
    assert len(list((tmp_path / "rgb").iterdir())) == 9


def test_render_writes_nowhere_but_into_its_folder(trained, capture, tmp_path, monkeypatch, capsys):
    family = tmp_path / "family"
    family.mkdir()
    (family / "mum.png").write_bytes(b"a photo")
    dataset = sx.load_dataset(capture)
    for name in ("../../family/mum.png", str(family / "mum.png")):
        views = (replace(dataset.test[0], name=name),)
        monkeypatch.setattr(render, "load_scene", lambda *_, views=views: replace(dataset, test=views))
        error = refused(capsys, "render", trained, capture, "--out", tmp_path / "out", "--split", "test")
        assert f"{name}: a view of this name would be written outside" in error
    assert [path.name for path in family.iterdir()] == ["mum.png"]
    assert (family / "mum.png").read_bytes() == b"a photo"


def test_photos_that_differ_by_their_suffix_alone_have_a_picture_each(capture, tmp_path):
    view = sx.load_dataset(capture).test[0]
    views = [replace(view, name=name) for name in ("a.jpg", "a.png", "b.png")]
    assert [files.color.name for files in render.files_of(views, tmp_path)] == [
        "a.jpg.png",
        "a.png.png",
        "b.png",
    ]


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    ["--init random --background white", "--backend reference --low-pass antialiasing --background white"],
)
def test_eval_finds_the_options_of_the_run(capture, tmp_path, options):
    out = tmp_path / "run"
    cli.main(["train", str(capture), "--out", str(out), "--steps", "1", *options.split()])
    cli.main(["eval", str(out), str(capture)])
    scores, metrics = read_json(out / "eval.json"), read_json(out / "metrics.json")
    # Backends agree to float32 rounding, which may tip an 8-bit level here and there.
    assert scores["psnr"] == pytest.approx(metrics["test"]["psnr"], abs=0.01)


@pytest.mark.slow
def test_bench_times_every_operation_of_every_backend(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("splatax.bench.operations.VIEWS", 2)  # 64 take the reference minutes
    monkeypatch.setattr("splatax.bench.operations.SMALL", (16, 12))
    out = tmp_path / "bench"
    cli.main(f"bench --scenes 300 --sizes 40x30 --backends xla reference --rounds 2 --out {out}".split())
    (result,) = read_json(out / "bench.json")["results"]
    times = {(row["operation"], row["backend"]): row for row in result["operations"]}
    rasterizing = {"rasterize", "rasterize F+B"}
    names = {"project", "project F+B", "loss F+B", "Adam", "render", "training step"} | rasterizing
    new = ("1 features", "16 features", "64 features", "2 views")
    names |= {*new, *(f"{name} F+B" for name in new), "Jacobian in the pose"}
    assert set(times) == {(name, backend) for name in names for backend in ("xla", "reference")}
    assert all(0 < row["minimum"] <= row["median"] for row in times.values())
    assert "300 procedural" in capsys.readouterr().out
    assert Image.open(out / "bench.png").width > 100


@pytest.mark.parametrize(
    ("command", "options"),
    [(["reconstruct"], (FindingCameras, Reconstruct)), (["blocks", "plan"], (PlanBlocks,))],
)
def test_help_is_wrapped_for_the_terminal_and_not_as_in_its_source(monkeypatch, capsys, command, options):
    monkeypatch.setenv("COLUMNS", "500")
    with pytest.raises(SystemExit):
        cli.main([*command, "--help"])
    said = capsys.readouterr().out
    for option in options:
        for described in docstring_parser.parse_from_object(option).params:
            assert " ".join(described.description.split()) in said


LISTED = """
import sys
from splatax.cli import main
try:
    main(["--help"])
finally:
    print("loaded:", *{"jax", "pycolmap", "matplotlib"} & sys.modules.keys(), file=sys.stderr)
"""


def test_the_list_of_commands_is_shown_without_importing_any():
    done = subprocess.run([sys.executable, "-c", LISTED], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "loaded:\n")
    assert all(name in done.stdout for name in COMMANDS)


def test_the_list_describes_each_command_by_the_first_line_of_its_help():
    for command in COMMANDS.values():
        assert command.load().__doc__.splitlines()[0] == command.summary


def test_an_option_of_another_command_is_found_for_the_user(capsys):
    with pytest.raises(SystemExit):
        cli.main(["eval", "run", "capture", "--steps", "6"])
    error = capsys.readouterr().err
    assert "--steps" in error
    assert "train" in error


def test_a_value_that_cannot_be_understood_is_reported_once(capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", "capture", "--steps", "many"])
    assert capsys.readouterr().err.count("Value error") == 1


def test_python_m_splatax_is_the_command():
    done = subprocess.run([sys.executable, "-m", "splatax", "--help"], capture_output=True, text=True)
    assert done.returncode == 0
    assert done.stdout.startswith("usage: splatax ")
