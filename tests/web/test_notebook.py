"""A scene as the result of a notebook's cell."""

import subprocess
import sys
from html.parser import HTMLParser

import jax.numpy as jnp
import numpy as np
import pytest

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.web import page

NASTY = "\"></iframe><script>alert(1)</script> & <b>'"
SCENE = random_gaussians(n=200, degree=1)
VIEWS = [
    sx.View("photo 0", camera_at((0, 0, -4)), lambda: None),
    sx.View("photo 1", camera_at(), lambda: None),
]


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """A viewer that is none."""
    path = tmp_path / "viewer.js"
    path.write_text("")
    monkeypatch.setattr(page, "VIEWER", path)


class Frames(HTMLParser):
    """All tags of some HTML, with their attributes."""

    def __init__(self, text):
        super().__init__()
        self.tags = []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))


def test_it_is_one_frame_that_holds_the_page_whatever_is_in_it(stub):
    shown = sx.view(SCENE, VIEWS, title=NASTY, background=sx.WHITE, height=300)
    ((tag, attributes),) = Frames(shown._repr_html_()).tags
    assert tag == "iframe"
    assert attributes["srcdoc"] == shown.page
    assert (attributes["title"], attributes["height"]) == (NASTY, "300")
    assert "src" not in attributes
    assert shown.page.count(">photo ") == 2
    assert '"background": [1.0, 1.0, 1.0]' in shown.page


ORANGE = (1.0, 0.5, 0.25)


@pytest.mark.parametrize("background", [ORANGE, np.array(ORANGE, np.float32), jnp.array(ORANGE)])
def test_a_background_is_a_colour_in_any_form_that_render_takes(stub, background):
    assert '"background": [1.0, 0.5, 0.25]' in sx.view(SCENE, background=background).page
    rendered = sx.render(SCENE, camera_at((0, 0, 400.0)), background=background).rgb[0, 0]
    np.testing.assert_allclose(rendered, ORANGE, atol=1e-6)


def test_as_text_it_is_short(stub):
    assert len(repr(sx.view(SCENE))) < 100


def test_what_cannot_be_shown_is_refused(stub):
    with pytest.raises(sx.FormatError, match=r"fern: .*degree 4"):
        sx.view(random_gaussians(degree=4), title="fern")


def test_the_library_is_imported_without_it():
    told = "import sys, splatax; print(*(name for name in ('splatax.web', 'jinja2') if name in sys.modules))"
    loaded = subprocess.run([sys.executable, "-c", told], capture_output=True, text=True, check=True)
    assert loaded.stdout.strip() == ""


@pytest.mark.slow
def test_a_notebook_draws_it_and_asks_the_network_for_nothing(open_page, tmp_path, viewer):
    """As Jupyter does: the HTML is put into a page that is there already."""
    path = tmp_path / "notebook.html"
    path.write_text(f"<!doctype html><title>notebook</title>{sx.view(SCENE, VIEWS)._repr_html_()}")
    tab = open_page(path)
    frame = tab.tab.frames[1]
    tab.tell = frame.evaluate
    tab.settle()
    assert frame.evaluate("document.getElementById('loading').hidden")
    assert tab.tell("viewer.shown") in (0, 1)
    assert tab.errors == []
    assert {url for url in tab.requests if not url.startswith("blob:")} <= {path.as_uri(), "about:srcdoc"}
