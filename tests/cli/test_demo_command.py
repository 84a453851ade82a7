"""`splatax demo`: a page without any data."""

import pytest

from splatax import cli
from splatax.cli import demo
from splatax.web import page


@pytest.fixture
def short(monkeypatch):
    """Without the time that drawing and training take."""

    def train(self):
        (self.out / "scene.ply").touch()

    monkeypatch.setattr(demo, "write_capture", lambda folder, scene: folder.mkdir())
    monkeypatch.setattr(demo.Train, "run", train)


def test_it_ends_with_a_page_and_where_that_is(short, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(page, "VIEWER", tmp_path / "viewer.js")
    (tmp_path / "viewer.js").touch()
    monkeypatch.setattr(demo.Page, "run", lambda self: self.out.touch())
    cli.main(["demo", "--out", str(tmp_path / "out")])
    assert (tmp_path / "out" / "scene.html").exists()
    page_path = tmp_path / "out" / "scene.html"
    assert capsys.readouterr().out.splitlines()[-1] == f"Done. Double-click {page_path} to open it."


def test_without_a_viewer_it_says_why_there_is_no_page(short, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(page, "VIEWER", tmp_path / "none.js")
    cli.main(["demo", "--out", str(tmp_path / "out")])
    assert "make page" in capsys.readouterr().out.splitlines()[-1]
