"""`splatax create`, from a capture to a page."""

import pytest

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
    assert (out / "run" / "report.html").exists()
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
