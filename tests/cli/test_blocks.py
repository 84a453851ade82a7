"""`splatax blocks`: a plan, runs of its blocks, and their merging."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import splatax as sx
from captures import write_capture
from splatax import cli
from splatax.blocks.boxes import block_of, places_of
from splatax.blocks.plan import read_plan
from splatax.cli.blocks import PlanBlocks, TrainBlock
from splatax.cli.failures import names_of
from splatax.cli.train import Train
from splatax.runs import session
from splatax.runs.forecast import memory


def blocks(*arguments):
    cli.main(["blocks", *map(str, arguments)])


def plan(capture, city, *options):
    blocks("plan", capture, "--out", city, "--steps", 10, "--max-gaussians", 60, *options)


def refused(capsys, *arguments) -> str:
    capsys.readouterr()
    with pytest.raises(SystemExit) as exit:
        blocks(*arguments)
    assert exit.value.code == 2
    error = capsys.readouterr().err
    assert error.startswith("splatax: ")
    assert error.count("\n") == 1
    return error


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    """A capture with a plan of two blocks, both trained."""
    folder = tmp_path_factory.mktemp("blocks")
    capture = write_capture(folder / "noise")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cli, "keep_compiled_programs", lambda: None)
        plan(capture, folder / "city", "--blocks", 2)
        for block in (0, 1):
            blocks("train", folder / "city", block)
    return folder


@pytest.fixture
def city(original, tmp_path):
    """A copy of the trained plan."""
    return shutil.copytree(original / "city", tmp_path / "city")


@pytest.mark.slow
def test_merging_keeps_what_is_inside_each_box_once(city, capsys):
    blocks("merge", city, city / "scene.ply")
    assert "of 2 blocks" in capsys.readouterr().out
    made, whole = read_plan(city), sx.load(city / "scene.ply")
    expected = []
    for number in (0, 1):
        means = np.asarray(sx.load(city / f"block-{number:03}" / "scene.ply").means)
        expected.append(means[block_of(places_of(means, made.axes), made.boxes) == number])
    assert all(len(part) for part in expected)
    np.testing.assert_array_equal(whole.means, np.concatenate(expected))


def test_a_plan_says_what_each_block_has_to_do_and_how_to_start_the_jobs(original, tmp_path, capsys):
    given = original / "city" / "coarse"
    plan(original / "noise", tmp_path / "city", "--gaussians-per-block", 30, "--coarse", given)
    out = capsys.readouterr().out
    assert f"for block in $(seq 0 1); do splatax blocks train {tmp_path / 'city'} $block; done" in out
    assert f"CITY={tmp_path / 'city'} sbatch --array=0-1 docs/jobs/blocks.sh" in out
    assert "for block in $(seq 0 1); do sky jobs launch -y -d --env BLOCK=$block docs/jobs/blocks.yaml" in out
    contents = json.loads((tmp_path / "city" / "blocks.json").read_text())
    assert contents["coarse"] == str(given / "scene.ply")
    for block in contents["blocks"]:
        assert 0 < len(block["photos"]) <= 8
        assert block["steps"] == round(10 * len(block["photos"]) / 8)
        assert 20 <= block["gaussians"] <= 50
    assert not (tmp_path / "city" / "block-000").exists(), "jobs are printed, not executed"


def test_a_block_that_was_stopped_goes_on_and_ends_with_the_same_bytes(city, monkeypatch, capsys):
    whole = (city / "block-001" / "scene.ply").read_bytes()
    shutil.rmtree(city / "block-001")

    def optimize(*arguments):
        for progress in sx.training.loop.optimize(*arguments):
            if progress.step == 5:
                raise MemoryError
            yield progress

    monkeypatch.setattr(session, "optimize", optimize)
    with pytest.raises(MemoryError):
        blocks("train", city, 1, "--checkpoint-steps", 3)
    error = refused(capsys, "merge", city, city / "scene.ply")
    assert "block 1 is not trained to the end" in error
    monkeypatch.setattr(session, "optimize", sx.training.loop.optimize)
    blocks("train", city, 1, "--memory", "2GB")  # may change, and changes no bit
    assert "resuming after step 3" in capsys.readouterr().out
    assert (city / "block-001" / "scene.ply").read_bytes() == whole


def test_a_block_that_is_done_is_left_alone_unless_told(city, capsys):
    before = (city / "block-000" / "scene.ply").stat().st_mtime_ns
    blocks("train", city, 0)
    assert "holds the finished run" in capsys.readouterr().out
    assert (city / "block-000" / "scene.ply").stat().st_mtime_ns == before


# --- what is refused ---


def test_blocks_that_are_missing_are_named(city, capsys):
    shutil.rmtree(city / "block-000")
    shutil.rmtree(city / "block-001")
    error = refused(capsys, "merge", city, city / "scene.ply")
    assert "blocks 0, 1 are not trained to the end. Train each: splatax blocks train" in error
    assert not (city / "scene.ply").exists()


def test_a_coarse_run_of_other_options_is_not_taken_for_that_of_the_plan(city, original, capsys):
    (city / "blocks.json").unlink()  # as if the command had been stopped after the coarse run
    plan(original / "noise", city, "--blocks", 2)
    assert "coarse scene:" not in capsys.readouterr().out, "it is not trained again"
    (city / "blocks.json").unlink()
    error = refused(
        capsys, "plan", original / "noise", "--out", city, "--blocks", 2, "--steps", 10,
        "--max-gaussians", 60, "--seed", 4,
    )  # fmt: skip
    assert "--seed 4: the run was started with 0" in error


def test_what_exists_is_not_replaced_unless_told(city, original, capsys):
    (city / "scene.ply").write_bytes(b"mine")
    assert "--overwrite" in refused(capsys, "merge", city, city / "scene.ply")
    assert (city / "scene.ply").read_bytes() == b"mine"
    blocks("merge", city, city / "scene.ply", "--overwrite")
    assert len(sx.load(city / "scene.ply"))
    error = refused(capsys, "plan", original / "noise", "--out", city, "--blocks", 2)
    assert re.search("blocks.json: exists. .*--out, --overwrite", error)


def test_blocks_of_another_plan_are_not_merged(city, original, capsys):
    plan(original / "noise", city, "--blocks", 2, "--coarse", city / "coarse", "--overwrite", "--seed", 4)
    error = refused(capsys, "merge", city, city / "scene.ply")
    assert "blocks 0, 1 are trained for another plan" in error
    assert "another plan" in refused(capsys, "train", city, 0)


def test_a_block_that_does_not_fit_in_the_memory_is_refused_with_the_numbers(city, capsys):
    shutil.rmtree(city / "block-000")
    error = refused(capsys, "train", city, 0, "--memory", "300MB")
    assert re.search(r"start alone takes about 0\.\d\d GB, with \d+ Gaussians of the block, \d+ fixed", error)
    assert "plan smaller blocks. See --memory." in error
    least = memory(0, 64, 48, around=1) + 10_000_000  # has room for the start of 60 Gaussians, and few more
    plan = json.loads((city / "blocks.json").read_text())
    plan["blocks"][0]["gaussians"] = 1_000_000
    (city / "blocks.json").write_text(json.dumps(plan))
    error = refused(capsys, "train", city, 0, "--memory", str(least))
    assert re.search(
        r"Block 0 grows to 1,000,000 Gaussians, with \d+ fixed ones around them: --memory", error
    )
    assert not (city / "block-000").exists()


def test_a_limit_of_memory_that_a_block_fits_in_changes_no_bit(city, capsys):
    whole = (city / "block-000" / "scene.ply").read_bytes()
    blocks("train", city, 0, "--memory", "2GB", "--overwrite")
    assert "within 2.00 GB: room for" in capsys.readouterr().out
    assert (city / "block-000" / "scene.ply").read_bytes() == whole


def test_options_of_train_that_blocks_do_not_have_are_listed():
    missing = names_of(Train) - names_of(PlanBlocks) - names_of(TrainBlock) - {"scene"}
    page = (Path(__file__).parents[2] / "docs" / "scale.md").read_text(encoding="utf-8")
    listed = page[page.index("Blocks do not have the other options") :].partition("\n\n")[0]
    groups = {"limits", "devices", "saving", "rerun", "live"}
    assert {name for name in missing - groups if f"`--{name.replace('_', '-')}`" not in listed} == set()


@pytest.mark.parametrize("number", [-1, 2, 99])
def test_numbers_out_of_range_are_refused(city, capsys, number):
    words = ["train", city, "--", number] if number < 0 else ["train", city, number]
    assert f"has no block {number}. Its blocks are 0 to 1" in refused(capsys, *words)


def test_a_capture_that_has_changed_is_refused(original, tmp_path, capsys):
    capture = shutil.copytree(original / "noise", tmp_path / "noise")
    plan(capture, tmp_path / "city", "--blocks", 2, "--coarse", original / "city" / "coarse")
    shutil.rmtree(capture)
    write_capture(capture, count=8)
    error = refused(capsys, "train", tmp_path / "city", 0)
    assert "the capture has changed since the blocks were planned: photos was 8 to train on" in error
    assert not (tmp_path / "city" / "block-000").exists()


@pytest.mark.parametrize(
    ("damage", "says"),
    [
        (
            lambda city: (city / "blocks.json").unlink(),
            "no blocks.json in it. Plan the blocks first",
        ),
        (lambda city: (city / "blocks.json").write_text("{}"), "damaged (no 'blocks' in it)"),
        (lambda city: (city / "context.npy").unlink(), "context.npy: missing"),
        (lambda city: (city / "context.npy").write_bytes(b"x"), "context.npy: not that of the plan"),
        (lambda city: (city / "coarse" / "scene.ply").unlink(), "the coarse scene of the plan is missing"),
        (lambda city: sx.save(city / "coarse" / "scene.ply", moved(city)), "the coarse scene has changed"),
    ],
)
def test_a_damaged_plan_is_named(city, capsys, damage, says):
    shutil.rmtree(city / "block-000")
    damage(city)
    assert says in refused(capsys, "train", city, 0)


def moved(city):
    scene = sx.load(city / "coarse" / "scene.ply")
    return replace(scene, means=scene.means + 1)


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ((), "Give the number of blocks"),
        (("--blocks", 2, "--gaussians-per-block", 9), "Give the number of blocks"),
        (("--blocks", 1), "--blocks: at least 2, not 1"),
        (("--blocks", 2, "--refine", "poses"), "--refine: each block"),
        (("--blocks", 2, "--steps", 0), "--steps: at least 1"),
    ],
)
def test_plans_that_make_no_sense_are_refused(original, tmp_path, capsys, options, says):
    assert says in refused(capsys, "plan", original / "noise", "--out", tmp_path / "city", *options)
    assert not (tmp_path / "city").exists()
