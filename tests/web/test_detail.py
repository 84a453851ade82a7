"""Large pages: they open with a preview, then draw the whole scene with level of detail."""

import base64
import itertools
import json
import re

import jax
import numpy as np
import pytest
from car import PAINT, PARTS, WHEELS
from screenshots import picture, psnr

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import web
from splatax.scene import chosen
from splatax.transforms import Similarity
from splatax.web import detail, page

SIZE = (320, 240)
CAMERAS = {
    f"photo {i}": camera_at(eye, size=SIZE, focal=280.0)
    for i, eye in enumerate([(0.4, -0.6, -4.0), (3.0, -1.0, 1.5), (-6.0, -4.0, 20.0)])
}
SCENE = random_gaussians(n=4000, scale=(0.001, 0.03), spread=0.7)
ABOVE = 1000  # Gaussians
LIKE = 30.0  # dB, as without level of detail
TINY = random_gaussians(2, n=100, scale=(0.02, 0.08), spread=0.5)
CAR = sx.Scene(PARTS | {"lamp": sx.Part(TINY, Similarity.of(scale=0.3, move=(0.0, -0.8, -0.4)))})
VARIANTS = {"paint": PAINT, "wheels": WHEELS}


@pytest.fixture
def stub(tmp_path, monkeypatch):
    """A viewer that is none."""
    path = tmp_path / "viewer.js"
    path.write_text("")
    monkeypatch.setattr(page, "VIEWER", path)


def embedded(html, folder) -> dict[str, int]:
    """The number of Gaussians in each file of a page, in the order of the files."""
    found = {}
    for name, contents in re.findall(r'part\("([^"]*)", "([^"]*)"\)', html):
        found[name] = found.get(name, b"") + base64.b64decode(contents)
    del found["viewer"]
    counts = {}
    for name, contents in found.items():
        (folder / "scene.spz").write_bytes(contents)
        counts[name] = len(sx.load(folder / "scene.spz"))
    return counts


def test_a_large_page_starts_before_its_whole_scene_with_a_quarter_of_the_gaussians(tmp_path, stub):
    html = web.document(SCENE, title="large", cameras=CAMERAS, lod_above=ABOVE)
    assert embedded(html, tmp_path) == {"preview-scene": 1000, "scene": 4000}
    assert html.index('part("preview-scene"') < html.index("<script>start()") < html.index('part("scene"')
    assert 'id="detail"' in html


def test_a_page_of_at_most_the_threshold_holds_its_scene_only(tmp_path, stub):
    html = web.document(SCENE, title="small", cameras=CAMERAS, lod_above=len(SCENE))
    assert embedded(html, tmp_path) == {"scene": 4000}
    assert 'id="detail"' not in html
    assert html == web.document(SCENE, title="small", cameras=CAMERAS)


@pytest.mark.slow
def test_previews_of_parts_share_their_gaussians_in_proportion_and_tiny_parts_have_none(
    tmp_path, stub, monkeypatch
):
    monkeypatch.setattr(detail, "PREVIEW", 390)
    html = web.document(CAR, title="car", lod_above=ABOVE)
    assert embedded(html, tmp_path) == {
        "preview-part-0": 300,
        "preview-part-1": 80,
        "part-2": 100,
        "part-0": 3000,
        "part-1": 800,
    }
    told = json.loads(re.search(r'id="page">(.*?)</script>', html)[1])
    previews = [part["preview"] for part in told["parts"]]
    assert previews == ["preview-part-0", "preview-part-1", "preview-part-1", None]


def test_broken_gaussians_are_in_neither_preview_nor_scene(tmp_path, stub):
    broken = jax.tree.map(lambda leaf: leaf.at[7].set(np.nan), SCENE)
    html = web.document(broken, title="holed", cameras=CAMERAS, lod_above=ABOVE)
    assert embedded(html, tmp_path) == {"preview-scene": 1000, "scene": 3999}


@pytest.mark.slow
def test_a_large_page_shows_a_preview_then_what_our_renderer_draws(open_page, tmp_path, viewer):
    path = tmp_path / "large.html"
    web.save(path, SCENE, title="large", cameras=CAMERAS, lod_above=ABOVE)
    tab = open_page(path, SIZE)
    count = "viewer.stage.spark.display.numSplats"
    for index, camera in enumerate(CAMERAS.values()):
        tab.settle()
        tab.tell(f"viewer.show({index})")
        tab.settle()
        expected = np.clip(sx.render(SCENE, camera).rgb, 0, 1)
        assert psnr(picture(tab), expected) > LIKE
        assert tab.tell(count) > 3000  # not the preview any more, which has 1,000
    tab.tell("void viewer.pose.position.addScaledVector(viewer.pose.forward, -60)")
    tab.tell("viewer.settled = false")
    tab.settle()
    assert tab.tell(count) < 2000  # from afar, pixels hold many Gaussians
    marks = tab.tell("performance.getEntriesByType('mark').map(mark => mark.name)")
    assert marks == ["viewer", "loaded", "opened", "complete"]
    assert not tab.tab.locator("#detail").is_visible()
    assert tab.errors == []
    assert [url for url in tab.requests if not url.startswith("blob:")] == [path.as_uri()]


@pytest.mark.slow
def test_choices_of_a_large_page_are_drawn_as_by_our_renderer(open_page, tmp_path, viewer):
    path, camera = tmp_path / "car.html", CAMERAS["photo 0"]
    web.save(path, CAR, title="car", presentation=web.Presentation(VARIANTS, start=camera), lod_above=ABOVE)
    tab = open_page(path, SIZE)
    for paint, wheels in itertools.product(*VARIANTS.values()):
        tab.settle()
        tab.tell(f"(viewer.choose('paint', '{paint}'), viewer.choose('wheels', '{wheels}'))")
        tab.tell("viewer.settled = false")
        tab.settle()
        scene = chosen(CAR, VARIANTS, {"paint": paint, "wheels": wheels})
        assert psnr(picture(tab), np.clip(sx.render(scene, camera).rgb, 0, 1)) > LIKE, (paint, wheels)
        assert tab.tell("viewer.stage.parts.whole")
    assert tab.tell("viewer.stage.spark.lodInstances.size") == 3
    assert tab.errors == []
