"""`splatax export`: every format from every other, edits, measurements, and refusals."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from scenes import random_gaussians
from splatax import cli
from splatax.io import formats


@pytest.fixture
def model(tmp_path):
    """A splat file of degree 2."""
    path = tmp_path / "model.ply"
    sx.save(path, replace(random_gaussians(n=50, degree=2), low_pass=sx.Antialiasing()))
    return path


def export(*arguments):
    cli.main(["export", *map(str, arguments)])


def refused(capsys, *arguments):
    with pytest.raises(SystemExit) as exit:
        export(*arguments)
    assert exit.value.code == 2
    error = capsys.readouterr().err
    assert "Traceback" not in error
    return error


@pytest.mark.parametrize("suffix", formats.WRITTEN)
def test_each_format_is_written_with_its_size_and_losses(model, tmp_path, suffix, capsys):
    out = tmp_path / "new folder" / f"scene{suffix}"
    export(model, out)
    said = capsys.readouterr().out
    assert "50 Gaussians" in said
    assert ("x smaller" if formats.size_of(out) <= model.stat().st_size else "x larger") in said
    assert formats.FORMATS[suffix].LOSES in said
    assert len(sx.load(out)) == 50
    assert (formats.MIP in formats.comments(out)) == (suffix != ".splat")


def test_a_run_is_measured_before_and_after(trained, capture, tmp_path, capsys):
    export(trained, tmp_path / "a.ply", "--scene", capture)
    same = capsys.readouterr().out.splitlines()[-1]
    assert same.startswith("PSNR of 1 test views: ")
    before, after = (float(word) for word in same.replace(",", "").split() if word.count(".") == 1)
    assert before == after
    export(
        trained,
        tmp_path / "a.spz",
        "--scene",
        capture,
        "--rotate",
        20,
        30,
        -50,
        "--scale",
        2,
        "--move",
        1,
        2,
        3,
    )
    moved = capsys.readouterr().out.splitlines()[-1]
    _, after = (float(word) for word in moved.replace(",", "").split() if word.count(".") == 1)
    assert_allclose(after, before, atol=0.2)


def test_edits_are_made(model, tmp_path, capsys):
    original = sx.load(model)
    other = replace(random_gaussians(1, n=30, degree=1), low_pass=sx.Antialiasing())
    sx.save(tmp_path / "other.ply", other)
    out = tmp_path / "out.ply"
    export(model, out, "--merge", tmp_path / "other.ply", "--sh-degree", 1)
    assert sx.load(out).sh.shape == (80, 4, 3)
    export(model, out, "--simplify", 20, "--overwrite")
    assert len(sx.load(out)) == 20
    export(model, out, "--crop-sphere", 0, 0, 0, 0.8, "--move", 5, 0, 0, "--overwrite")
    inside = np.linalg.norm(original.means, axis=1) <= 0.8
    assert_allclose(sx.load(out).means, np.asarray(original.means)[inside] + [5, 0, 0], atol=1e-6)
    export(model, out, "--crop-box", -1, -1, 0, 1, 1, 1, "--clean", "--overwrite")
    assert np.asarray(sx.load(out).means)[:, 2].min() >= 0
    assert "cleaned: 0 not finite" in capsys.readouterr().out


def test_up_puts_a_run_upright(trained, capture, tmp_path):
    out = tmp_path / "a.ply"
    export(trained, out, "--scene", capture, "--up", "auto")
    assert len(sx.load(out)) == len(sx.load(trained / "scene.ply"))


def test_a_fraction_is_kept_and_tuned_on_the_capture(trained, capture, tmp_path, capsys):
    count = len(sx.load(trained / "scene.ply"))
    pruned, tuned = tmp_path / "pruned.ply", tmp_path / "tuned.ply"
    export(trained, pruned, "--scene", capture, "--simplify", 0.5, "--tune", 0)
    assert "tuning" not in capsys.readouterr().out
    export(trained, tuned, "--scene", capture, "--simplify", 0.5, "--tune", 3)
    assert f"tuning {round(count / 2):,} Gaussians on " in capsys.readouterr().out
    assert len(sx.load(pruned)) == len(sx.load(tuned)) == round(count / 2)
    assert not np.array_equal(sx.load(pruned).means, sx.load(tuned).means)


def test_what_cannot_be_done_is_refused_and_nothing_written(model, tmp_path, capsys):
    taken = tmp_path / "taken.spz"
    taken.write_bytes(b"earlier")
    for arguments, named in (
        ((model, taken), "--overwrite"),
        ((model, tmp_path / "a.obj"), "unknown format '.obj'"),
        ((model, tmp_path / "a.ksplat"), "can only be read"),
        ((model, tmp_path / "a.ply", "--up", "auto"), "--scene"),
        ((model, tmp_path / "a.ply", "--spz-version", 4), "not an .spz file"),
        ((model, tmp_path / "a.ply", "--simplify", 0), "--simplify"),
        ((model, tmp_path / "a.ply", "--simplify", 1.5), "a fraction between 0 and 1"),
        ((model, tmp_path / "a.ply", "--simplify", 5, "--tune", -1), "--tune"),
        ((model, tmp_path / "a.ply", "--scale", 0), "--scale"),
        ((model, tmp_path / "a.ply", "--rotate", "nan", 0, 0), "--rotate"),
        ((model, tmp_path / "a.ply", "--crop-sphere", 9, 9, 9, 1), "no Gaussian would be left"),
        ((tmp_path / "missing.ply", tmp_path / "a.ply"), "no such file"),
    ):
        assert named in refused(capsys, *arguments)
    assert taken.read_bytes() == b"earlier"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.ply", "taken.spz"]


def test_a_degree_that_the_format_cannot_hold_is_refused_with_the_way_out(tmp_path, capsys):
    sx.save(tmp_path / "four.ply", random_gaussians(n=5, degree=4))
    assert "--sh-degree 3" in refused(capsys, tmp_path / "four.ply", tmp_path / "a.sog")
    export(tmp_path / "four.ply", tmp_path / "a.sog", "--sh-degree", 3)
    assert sx.load(tmp_path / "a.sog").sh_degree == 3
