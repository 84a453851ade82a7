"""`splatax page`, and `splatax export` to a page."""

import json
import re

import numpy as np
import pytest

import splatax as sx
from splatax import cli
from splatax.web import page


@pytest.fixture(autouse=True)
def stub(tmp_path_factory, monkeypatch):
    """A viewer that is none."""
    path = tmp_path_factory.mktemp("viewer") / "viewer.js"
    path.write_text("")
    monkeypatch.setattr(page, "VIEWER", path)


def test_a_run_becomes_a_page_with_its_cameras(trained, capture, tmp_path, capsys):
    out = tmp_path / "new" / "page.html"
    cli.main(["page", str(trained), str(out), "--scene", str(capture)])
    assert "9 cameras" in capsys.readouterr().out
    text = out.read_text()
    assert f"<h1>{trained.name}</h1>" in text
    assert text.count(">photo") == 9


def test_it_has_the_title_that_is_given_and_needs_no_capture(trained, tmp_path):
    cli.main(["page", str(trained / "scene.ply"), str(tmp_path / "page.html"), "--title", "A & B"])
    assert "<h1>A &amp; B</h1>" in (tmp_path / "page.html").read_text()


def test_other_suffixes_and_existing_files_are_refused(trained, tmp_path, capsys):
    (tmp_path / "page.html").write_text("mine")
    for name, way_out in (("page.txt", r".html"), ("page.html", "--overwrite")):
        with pytest.raises(SystemExit) as exit:
            cli.main(["page", str(trained), str(tmp_path / name)])
        assert exit.value.code == 2
        assert way_out in capsys.readouterr().err
    assert (tmp_path / "page.html").read_text() == "mine"


def told(path):
    """What the viewer is told."""
    return json.loads(re.search(r'id="page">(.*?)</script>', path.read_text())[1])


@pytest.mark.parametrize("options", [(), ("--background", "white", "--title", "A & B")])
def test_export_makes_the_same_page(trained, capture, tmp_path, capsys, options):
    for command in ("page", "export"):
        cli.main(
            [command, str(trained), str(tmp_path / f"{command}.html"), "--scene", str(capture), *options]
        )
        assert "loses: positions are rounded" in capsys.readouterr().out
    assert (tmp_path / "export.html").read_bytes() == (tmp_path / "page.html").read_bytes()


def test_cameras_of_a_page_go_where_export_moves_the_scene(trained, capture, tmp_path):
    """Pages are scaled by their cameras, so a scene that is moved with them looks the same."""
    scene, edits = ("--scene", str(capture)), ("--scale", "3", "--move", "1", "2", "3", "--sh-degree", "0")
    cli.main(["export", str(trained), str(tmp_path / "a.html"), *scene])
    cli.main(["export", str(trained), str(tmp_path / "b.html"), *scene, *edits])
    first, second = told(tmp_path / "a.html"), told(tmp_path / "b.html")
    assert len(first["cameras"]) == len(second["cameras"]) == 9
    for before, after in zip(first["cameras"], second["cameras"], strict=True):
        np.testing.assert_allclose(before["position"], after["position"], atol=1e-4)
    assert (tmp_path / "b.html").stat().st_size < (tmp_path / "a.html").stat().st_size


def test_options_of_pages_are_refused_for_other_files(trained, tmp_path, capsys):
    with pytest.raises(SystemExit) as exit:
        cli.main(["export", str(trained), str(tmp_path / "a.ply"), "--title", "A"])
    assert exit.value.code == 2
    assert "--title, --background: only for pages" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_export_wants_the_viewer_before_it_computes(trained, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(page, "VIEWER", tmp_path / "viewer.js")
    monkeypatch.setattr(sx, "load", None)
    with pytest.raises(SystemExit):
        cli.main(["export", str(trained), str(tmp_path / "a.html")])
    assert "make page" in capsys.readouterr().err
