"""`splatax create`, from photos or a capture to a page."""

import pytest
from test_refusals import refused

from splatax import cli
from splatax.cli import create
from splatax.web import page


@pytest.fixture
def stub(tmp_path_factory, monkeypatch):
    """A viewer that is none."""
    path = tmp_path_factory.mktemp("viewer") / "viewer.js"
    path.write_text("")
    monkeypatch.setattr(page, "VIEWER", path)


@pytest.mark.slow
def test_a_capture_becomes_a_page_within_a_budget_and_is_not_trained_twice(
    stub, capture, tmp_path, capsys, monkeypatch
):
    out = tmp_path / "out"
    cli.main(["create", str(capture), "--out", str(out), "--budget", "3s"])
    assert "<h1>out</h1>" in (out / "run" / "report.html").read_text()
    assert "<h1>out</h1>" in (out / "scene.html").read_text()
    assert str(out / "scene.html") in capsys.readouterr().out

    (out / "scene.html").unlink()
    monkeypatch.setattr(create.Train, "run", lambda self: pytest.fail("trained again"))
    cli.main(["create", str(capture), "--out", str(out), "--budget", "3s"])
    assert (out / "scene.html").exists()


def test_without_a_viewer_nothing_is_begun(capture, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(page, "VIEWER", tmp_path / "none.js")
    with pytest.raises(SystemExit) as exit:
        cli.main(["create", str(capture), "--out", str(tmp_path / "out")])
    assert exit.value.code == 2
    assert "make page" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_photos_that_are_not_there_are_refused(stub, tmp_path, capsys):
    with pytest.raises(SystemExit):
        cli.main(["create", str(tmp_path / "photos"), "--out", str(tmp_path / "out")])
    assert "no such folder" in capsys.readouterr().err


@pytest.fixture
def stages(stub, monkeypatch):
    """Stages that take no time, and are listed when they come to an end; `stop` names one that does not."""

    class Stages(list):
        stop = None

        def do(self, stage, *written):
            if stage == self.stop:
                raise KeyboardInterrupt
            for path in written:
                path.parent.mkdir(parents=True, exist_ok=True)
                path.touch()
            self.append(stage)

    done = Stages()
    monkeypatch.setattr(create, "is_capture", lambda path: (path / "sparse").exists())
    monkeypatch.setattr(
        create.Reconstruct,
        "run",
        lambda self: done.do("reconstruct", self.out / "sparse", self.out / "images"),
    )
    monkeypatch.setattr(create.Train, "run", lambda self: done.do("train", self.out / "report.html"))
    monkeypatch.setattr(create.Page, "run", lambda self: done.do("page", self.out))
    return done


@pytest.fixture
def photos(tmp_path):
    (tmp_path / "photos").mkdir()
    return tmp_path / "photos"


@pytest.mark.parametrize("stage", ["reconstruct", "train", "page"])
def test_stopped_in_any_stage_the_same_command_goes_on_with_it(stages, photos, tmp_path, capsys, stage):
    command = ["create", str(photos), "--out", str(tmp_path / "out")]
    stages.stop = stage
    with pytest.raises(SystemExit) as exit:
        cli.main(command)
    assert exit.value.code == 130
    assert capsys.readouterr().err == "splatax: stopped. Run the same command again to resume\n"
    stages.stop = None
    cli.main(command)
    assert stages == ["reconstruct", "train", "page"]
    assert str(tmp_path / "out" / "scene.html") in capsys.readouterr().out


def test_a_run_that_was_killed_before_its_report_is_made_again(stages, photos, tmp_path):
    (tmp_path / "out" / "run").mkdir(parents=True)
    (tmp_path / "out" / "run" / "scene.ply").touch()
    cli.main(["create", str(photos), "--out", str(tmp_path / "out")])
    assert "train" in stages


def test_what_was_made_of_other_photos_or_for_another_time_is_replaced_only_when_told(
    stages, photos, tmp_path, capsys
):
    command = ["create", photos, "--out", tmp_path / "out"]
    cli.main([*map(str, command), "--budget", "60s"])
    cli.main([*map(str, command), "--budget", "1min"])
    assert stages == ["reconstruct", "train", "page", "page"]
    error = refused(capsys, *command, "--budget", "2min")
    assert "60 s, not 120 s" in error
    assert f"splatax create {tmp_path / 'out' / 'capture'} --out OTHER" in error
    (tmp_path / "others").mkdir()
    error = refused(capsys, "create", tmp_path / "others", "--out", tmp_path / "out", "--budget", "60s")
    assert f"made from {photos}" in error
    del stages[:]
    cli.main([*map(str, command), "--budget", "2min", "--overwrite"])
    assert stages == ["reconstruct", "train", "page"]


def test_nothing_is_begun_that_cannot_end_well(stages, photos, tmp_path, capsys):
    out = tmp_path / "out"
    assert "--budget: a time such as" in refused(capsys, "create", photos, "--out", out, "--budget", "soon")
    assert "lies among the photos" in refused(capsys, "create", photos, "--out", photos / "out")
    (tmp_path / "file").touch()
    assert "a file, not a folder" in refused(capsys, "create", photos, "--out", tmp_path / "file")
    assert not stages
    assert not out.exists()
