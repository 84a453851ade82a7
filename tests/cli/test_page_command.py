"""`splatax page`, from a run to a page."""

import pytest

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
