"""The page of a product: every combination of its variants is what `render` draws of the chosen scene."""

import itertools
import re

import jax.numpy as jnp
import numpy as np
import pytest
from car import PAINT, PARTS, WHEELS
from screenshots import picture, psnr

import splatax as sx
from scenes import camera_at
from splatax import web
from splatax.scene import ColorMap, Option, chosen

SIZE = (320, 240)
CAMERA = camera_at((0.4, -0.8, -4.0), size=SIZE, focal=280.0)
SCENE = sx.Scene(PARTS)
SWAP = ColorMap(np.eye(3, dtype=np.float32)[[1, 2, 0]] * 0.7, np.array([0.2, 0.0, 0.1], np.float32))
VARIANTS = {
    "paint": PAINT | {"<swapped>": Option(colors={"body": SWAP})},
    "wheels": WHEELS | {"both": Option(shows=("wheel", "sport"))},
}
NOTES = (web.Hotspot((0.0, 0.0, 0.0), "The middle & more"), web.Hotspot((0.8, 0.4, -0.4), "Sport", "sport"))
LIKE = 34.0  # dB


@pytest.fixture(scope="module")
def page(tmp_path_factory, viewer):
    path = tmp_path_factory.mktemp("variants") / "car.html"
    offered = web.Presentation(VARIANTS, NOTES, start=CAMERA, path=[CAMERA, camera_at((3.0, -1.0, 1.5))])
    web.save(path, SCENE, title="car", presentation=offered)
    return path


def test_a_file_that_parts_share_is_in_the_page_once(page):
    names = set(re.findall(r'part\("([^"]*)", "', page.read_text()))
    assert names == {"viewer", "part-0", "part-1"}


@pytest.mark.slow
def test_every_choice_is_drawn_as_by_our_renderer(open_page, page):
    tab = open_page(page, SIZE)
    tab.settle()
    seen = []
    for paint, wheels in itertools.product(*VARIANTS.values()):
        tab.tell(f"(viewer.choose('paint', '{paint}'), viewer.choose('wheels', '{wheels}'))")
        tab.tell("viewer.settled = false")
        tab.settle()
        scene = chosen(SCENE, VARIANTS, {"paint": paint, "wheels": wheels})
        seen.append(picture(tab))
        expected = np.clip(sx.render(scene, CAMERA).rgb, 0, 1)
        assert psnr(seen[-1], expected) > LIKE, (paint, wheels)
    assert min(np.abs(a - b).max() for a, b in itertools.combinations(seen, 2)) > 0.1
    assert tab.errors == []
    assert [url for url in tab.requests if not url.startswith("blob:")] == [page.as_uri()]


@pytest.mark.slow
def test_a_switch_costs_the_page_less_than_a_tenth_of_a_second(open_page, page):
    """The CPU time of the page's main thread from a choice until its picture is final. Drawing is not in it:
    Chromium draws in another process, and here in software."""
    tab = open_page(page, (96, 72))
    tab.settle()
    session = tab.tab.context.new_cdp_session(tab.tab)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})

    def busy() -> float:
        found = session.send("Performance.getMetrics")["metrics"]
        return next(row["value"] for row in found if row["name"] == "TaskDuration")

    spent = []
    for paint, wheels in itertools.product(*VARIANTS.values()):
        before = busy()
        tab.tell(f"(viewer.choose('paint', '{paint}'), viewer.choose('wheels', '{wheels}'))")
        tab.tell("viewer.settled = false")
        tab.settle()
        spent.append(busy() - before)
    print("seconds of the main thread for each switch:", [round(seconds, 4) for seconds in spent])
    assert 0 < np.median(spent) < 0.1, spent


@pytest.mark.slow
def test_buttons_have_names_and_tell_what_is_chosen(open_page, page):
    tab = open_page(page)
    tab.settle()
    group = tab.tab.get_by_role("group", name="paint")
    swapped = group.get_by_role("button", name="<swapped>")
    assert group.get_by_role("button", name="plain").get_attribute("aria-pressed") == "true"
    swapped.focus()
    tab.tab.keyboard.press("Enter")
    assert swapped.get_attribute("aria-pressed") == "true"
    assert group.get_by_role("button", name="plain").get_attribute("aria-pressed") == "false"
    assert tab.tell("viewer.variants.chosen") == {"paint": "<swapped>", "wheels": "city"}


@pytest.mark.slow
def test_notes_follow_their_places_open_when_pressed_and_hide_with_their_part(open_page, page):
    tab = open_page(page, SIZE)
    tab.settle()
    note = tab.tab.get_by_role("button", name="The middle & more")
    box = note.bounding_box()
    where = CAMERA.to_pixel(CAMERA.to_camera(jnp.zeros(3)))
    np.testing.assert_allclose([box["x"] + 15, box["y"] + 15], where, atol=1.5)
    note.click()
    assert note.get_attribute("aria-expanded") == "true"
    assert note.locator("span").inner_text() == "The middle & more"
    sport = tab.tab.get_by_role("button", name="Sport", exact=True).first
    assert not tab.tab.locator(".hotspot", has_text="Sport").is_visible()
    tab.tell("viewer.choose('wheels', 'sport')")
    tab.settle()
    tab.wait_for("!document.querySelectorAll('.hotspot')[1].hidden")
    assert sport.is_visible()


@pytest.mark.slow
def test_on_a_phone_all_choices_are_in_reach(open_page, page):
    tab = open_page(page, (390, 700), has_touch=True, is_mobile=True)
    tab.settle()
    for name in ("plain", "red", "city", "both"):
        button = tab.tab.get_by_role("button", name=name, exact=True)
        button.tap()
        assert button.get_attribute("aria-pressed") == "true"
        assert button.bounding_box()["height"] >= 34


@pytest.mark.slow
def test_a_long_note_is_readable_in_whole_on_a_phone(open_page, tmp_path, viewer):
    path = tmp_path / "notes.html"
    text = "Forged rims of one piece, with a very long explanation " * 3 + "and an end."
    notes = (web.Hotspot((1.2, 0.4, 0.0), text), web.Hotspot((-0.6, 0.0, 0.0), "short"))
    web.save(path, SCENE, title="car", presentation=web.Presentation(hotspots=notes, start=CAMERA))
    tab = open_page(path, (360, 640), has_touch=True, is_mobile=True)
    tab.settle()
    note = tab.tab.get_by_role("button", name=text)
    note.tap()
    tab.wait_for("document.querySelector('.hotspot').offsetHeight > 60")
    tab.wait_for("document.querySelector('.hotspot').getBoundingClientRect().right <= innerWidth")
    box = note.bounding_box()
    assert box["x"] >= 0
    assert box["y"] >= 0
    assert box["y"] + box["height"] <= 640
    inner = note.locator("span")
    assert inner.evaluate("span => span.scrollWidth <= span.clientWidth + 1 || !span.clientWidth")
    words = inner.bounding_box()
    assert words["x"] + words["width"] <= box["x"] + box["width"]


@pytest.mark.slow
def test_an_embedded_page_has_no_buttons_and_plays_unless_less_motion_is_asked_for(
    browser, open_page, tmp_path, viewer
):
    path = tmp_path / "embedded.html"
    offered = web.Presentation(start=CAMERA, play="turntable", autoplay=True, buttons=False)
    web.save(path, SCENE, title="car", presentation=offered)
    calm = open_page(path, SIZE)
    calm.settle()
    assert not calm.tab.locator("nav").is_visible()
    assert not calm.tell("viewer.playing")
    context = browser.new_context(viewport={"width": 320, "height": 240})
    tab = context.new_page()
    tab.goto(path.as_uri())
    for _ in range(400):
        if tab.evaluate("Boolean(window.viewer) && viewer.playing"):
            break
        tab.wait_for_timeout(50)
    assert tab.evaluate("viewer.playing")
    for _ in range(400):
        if tab.evaluate("document.getElementById('loading').hidden"):
            break
        tab.wait_for_timeout(50)
    assert tab.evaluate("document.getElementById('loading').hidden && viewer.playing")
    context.close()


@pytest.mark.slow
@pytest.mark.parametrize("offered", ["true", "false"])
def test_the_headset_button_is_there_if_the_browser_offers_one_and_says_what_failed(browser, page, offered):
    context = browser.new_context(viewport={"width": 640, "height": 480}, reduced_motion="reduce")
    context.add_init_script(
        f"const xr = {{ isSessionSupported: async () => {offered}, "
        "requestSession: async () => { throw new Error('it is asleep'); } };"
        "Object.defineProperty(navigator, 'xr', { value: xr });"
    )
    tab = context.new_page()
    tab.goto(page.as_uri())
    for _ in range(600):
        if tab.evaluate("Boolean(window.viewer) && viewer.settled"):
            break
        tab.wait_for_timeout(50)
    button = tab.locator("#headset")
    assert button.is_visible() == (offered == "true")
    if offered == "true":
        button.click()
        tab.wait_for_timeout(200)
        assert tab.locator("#hint").inner_text() == "The headset did not start: it is asleep"
    context.close()


def test_what_the_scene_has_not_is_refused_with_the_name_of_the_page(viewer):
    def document(**offered):
        web.document(SCENE, title="car", presentation=web.Presentation(**offered), name="car.html")

    with pytest.raises(sx.FormatError, match=r"car\.html: option 'red' of variant 'paint' names part 'hood'"):
        document(variants={"paint": {"red": Option(shows=("hood",))}})
    with pytest.raises(sx.FormatError, match="both colour part 'body'"):
        document(variants={name: {"a": Option(colors={"body": SWAP})} for name in ("paint", "trim")})
    with pytest.raises(sx.FormatError, match="hotspot belongs to part 'hood'"):
        document(hotspots=(web.Hotspot((0.0, 0.0, 0.0), "x", "hood"),))
