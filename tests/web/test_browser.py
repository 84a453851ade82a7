"""The page in a browser: it draws the images of splatax, and its controls work."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from screenshots import picture, psnr

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import web

pytestmark = pytest.mark.slow
SIZE = (320, 240)
EYES = ((0.4, -0.6, -4.0), (3.0, -1.0, 1.5), (-2.5, 0.8, 2.5), (-3.5, -0.5, -1.0))
CAMERAS = {f"photo {i}": camera_at(eye, size=SIZE, focal=280.0) for i, eye in enumerate(EYES)}
SCENE = random_gaussians(n=4000, scale=(0.001, 0.03), spread=0.7)
LIKE = 30.0  # dB; SH of another sign, frame or degree, gamma or another low-pass stay below


@pytest.fixture(scope="module")
def page(tmp_path_factory, viewer):
    path = tmp_path_factory.mktemp("page") / "scene & <all>.html"
    web.save(path, SCENE, title="Random & <b>dense</b>", cameras=CAMERAS)
    return path


@pytest.mark.parametrize(
    "low_pass", [sx.Dilation(), sx.Antialiasing()], ids=lambda filter: type(filter).__name__
)
def test_cameras_see_what_our_renderer_draws(open_page, tmp_path, viewer, low_pass):
    path, gray = tmp_path / "scene.html", (0.2, 0.3, 0.4)
    scene = replace(SCENE, low_pass=low_pass)
    web.save(path, scene, title="scene", cameras=CAMERAS, background=gray)
    tab = open_page(path, SIZE)
    other = {sx.Dilation: sx.Antialiasing(), sx.Antialiasing: sx.Dilation()}[type(low_pass)]
    for index, camera in enumerate(list(CAMERAS.values())[:3]):
        tab.settle()
        tab.tell(f"viewer.show({index})")
        tab.settle()
        shown = picture(tab)
        expected, wrong = (
            np.clip(sx.render(SCENE, camera, low_pass=f, background=np.float32(gray)).rgb, 0, 1)
            for f in (low_pass, other)
        )
        assert psnr(shown, expected) > LIKE
        assert psnr(shown, expected) > psnr(shown, wrong) + 3


@pytest.mark.parametrize("order", ["depth", "distance"])
def test_splats_are_sorted_as_the_scene_says(open_page, tmp_path, viewer, order):
    """Large opaque Gaussians, seen at a wide angle: the two orders differ much."""
    path, wide = tmp_path / "scene.html", camera_at((0.4, -0.6, -1.5), size=SIZE, focal=90.0)
    scene = replace(random_gaussians(n=300, scale=(0.1, 0.4), spread=0.8), order=order)
    scene = replace(scene, opacity_logits=scene.opacity_logits + 3)
    web.save(path, scene, title="scene", cameras={"wide": wide})
    tab = open_page(path, SIZE)
    tab.settle()
    tab.tell("viewer.show(0)")
    tab.settle()
    right, wrong = (
        np.clip(sx.render(replace(scene, order=each), wide).rgb, 0, 1)
        for each in sorted(("depth", "distance"), key=lambda each: each != order)
    )
    shown = picture(tab)
    assert psnr(shown, right) > LIKE - 1 > psnr(shown, wrong) + 2


def test_discs_are_shown_as_thin_ellipses(open_page, tmp_path, viewer):
    """The page cannot draw along rays: it leaves out the slant of each disc, and has another filter."""
    path, solid = tmp_path / "discs.html", random_gaussians(n=1500, scale=(0.01, 0.08), spread=0.7)
    solid = replace(solid, low_pass=sx.AlongRays())
    discs = replace(solid, log_scales=solid.log_scales.at[:, 2].set(-np.inf))
    web.save(path, discs, title="discs", cameras=CAMERAS)
    tab = open_page(path, SIZE)
    for index, camera in enumerate(list(CAMERAS.values())[:3]):
        tab.settle()
        tab.tell(f"viewer.show({index})")
        tab.settle()
        shown = picture(tab)
        exact, wrong = (np.clip(sx.render(scene, camera).rgb, 0, 1) for scene in (discs, solid))
        assert psnr(shown, exact) > LIKE
        assert psnr(shown, exact) > psnr(shown, wrong) + 6


def test_it_opens_without_errors_and_asks_the_network_for_nothing(open_page, page):
    tab = open_page(page)
    tab.settle()
    tab.tell("viewer.play()")
    tab.wait_for("viewer.motion && viewer.motion.seconds > 0.3")
    assert tab.errors == []
    assert [url for url in tab.requests if not url.startswith("blob:")] == [page.as_uri()]


def test_names_are_text_not_markup(open_page, page):
    tab = open_page(page)
    assert tab.tab.title() == tab.tell("document.querySelector('h1').textContent") == "Random & <b>dense</b>"
    assert tab.tell("[...document.querySelectorAll('#cameras option')].slice(1).map(o => o.label)") == list(
        CAMERAS
    )


def test_it_begins_at_a_camera_of_the_capture(open_page, page):
    tab = open_page(page)
    tab.settle()
    shown = int(tab.tell("document.getElementById('cameras').value"))
    start = tab.position
    tab.tell(f"viewer.show({shown})")
    tab.settle()
    np.testing.assert_allclose(tab.position, start)


def test_dragging_turns_around_the_middle_and_flying_turns_on_the_spot(open_page, page):
    tab = open_page(page)
    tab.settle()
    start, pivot = tab.position, tab.tell("viewer.pose.pivot.toArray()")

    def drag(to):
        before = tab.orientation
        tab.tab.mouse.move(320, 240)
        tab.tab.mouse.down()
        tab.tab.mouse.move(*to, steps=4)
        tab.tab.mouse.up()
        tab.settle()
        assert not np.allclose(tab.orientation, before, atol=0.05)

    drag((420, 280))
    assert not np.allclose(tab.position, start, atol=0.1)
    np.testing.assert_allclose(tab.tell("viewer.pose.pivot.toArray()"), pivot, atol=1e-4)
    there = tab.position
    tab.tab.keyboard.press("o")
    drag((220, 200))
    np.testing.assert_allclose(tab.position, there, atol=1e-6)


def test_what_is_dragged_follows_the_pointer(open_page, page):
    """Along x: what is in front moves with the pointer in both modes."""
    for mode in ("orbit", "fly"):
        tab = open_page(page)
        tab.settle()
        tab.tell(f"viewer.setMode('{mode}')")
        nearer = (
            "viewer.pose.forward.multiplyScalar(viewer.pose.focus / 2).add(viewer.pose.position).toArray()"
        )
        point = tab.tell(nearer)
        tab.tab.mouse.move(300, 240)
        tab.tab.mouse.down()
        tab.tab.mouse.move(340, 240, steps=3)
        tab.tab.mouse.up()
        tab.settle()
        offset = np.subtract(point, tab.position) @ np.array(tab.tell("viewer.pose.right.toArray()"))
        assert offset > 0.01


def test_the_wheel_comes_closer_and_keys_walk(open_page, page):
    tab = open_page(page)
    tab.settle()
    focus = tab.tell("viewer.pose.focus")
    tab.tab.mouse.move(320, 240)
    tab.tab.mouse.wheel(0, -300)
    tab.wait_for(f"viewer.pose.focus < {0.8 * focus}")
    tab.settle()
    for key, axis, sign in (("w", "forward", 1), ("s", "forward", -1), ("d", "right", 1), ("q", "up", -1)):
        before, along = np.array(tab.position), np.array(tab.tell(f"viewer.pose.{axis}.toArray()"))
        tab.tab.keyboard.down(key)
        tab.tab.wait_for_timeout(150)
        tab.tab.keyboard.up(key)
        tab.settle()
        step = np.array(tab.position) - before
        assert sign * (step @ along) > 0.9 * np.linalg.norm(step) > 0.01


def test_fingers_turn_and_pinch(open_page, page):
    tab = open_page(page, (390, 844), has_touch=True, is_mobile=True, device_scale_factor=2)
    tab.settle()
    touch = tab.tab.context.new_cdp_session(tab.tab)

    def send(kind, *points):
        at = [{"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)]
        touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

    before, focus = tab.orientation, tab.tell("viewer.pose.focus")
    send("touchStart", (150, 400))
    for x in (170, 190, 230):
        send("touchMove", (x, 410))
    send("touchEnd")
    tab.settle()
    assert not np.allclose(tab.orientation, before, atol=0.05)
    assert tab.tell("viewer.pose.focus") == pytest.approx(focus)
    send("touchStart", (180, 400), (210, 400))
    for apart in (20, 40, 60):
        send("touchMove", (195 - apart, 400), (195 + apart, 400))
    send("touchEnd")
    tab.settle()
    assert tab.tell("viewer.pose.focus") < 0.5 * focus


def test_buttons_and_keys_choose_cameras_play_and_go_back(open_page, page):
    tab = open_page(page)
    tab.settle()
    start, shown = tab.position, tab.tell("viewer.shown")
    tab.tab.click("#next")
    tab.settle()
    assert tab.tell("document.getElementById('cameras').value") == str((shown + 1) % len(CAMERAS))
    assert not np.allclose(tab.position, start, atol=0.1)
    tab.tab.keyboard.press(",")
    tab.settle()
    np.testing.assert_allclose(tab.position, start)
    tab.tab.select_option("#cameras", index=1)
    tab.settle()
    tab.tab.locator("#view").focus()
    tab.tab.keyboard.press(" ")
    tab.wait_for("viewer.playing && viewer.motion.seconds > 0.5")
    assert tab.tell("document.getElementById('play').getAttribute('aria-pressed')") == "true"
    tab.tab.mouse.move(320, 100)
    tab.tab.mouse.down()  # who takes hold stops it
    tab.tab.mouse.up()
    assert not tab.tell("viewer.playing")
    tab.tab.click("#reset")
    tab.settle()
    np.testing.assert_allclose(tab.position, start)


def test_help_opens_and_closes_with_the_keyboard(open_page, page):
    tab = open_page(page)
    tab.settle()
    is_open = "document.getElementById('help-text').open"
    tab.tab.keyboard.press("?")
    assert tab.tell(is_open)
    tab.tab.keyboard.press("Escape")
    assert not tab.tell(is_open)


@pytest.mark.parametrize(("size", "phone"), [((1280, 800), False), ((390, 844), True), ((740, 360), True)])
def test_all_buttons_are_in_reach_in_windows_of_any_shape(open_page, page, size, phone):
    tab = open_page(page, size, has_touch=phone, is_mobile=phone)
    tab.settle()
    boxes = [
        button.bounding_box() for button in tab.tab.locator("nav button:visible, nav select:visible").all()
    ]
    assert len(boxes) >= 7
    for box in boxes:
        assert box["width"] >= 34
        assert box["height"] >= 34
        assert 0 <= box["x"] <= size[0] - box["width"]
        assert 0 <= box["y"] <= size[1] - box["height"]
    assert all(a["x"] + a["width"] <= b["x"] + 1 for a, b in pairwise(boxes))
    assert np.ptp(picture(tab)) > 0.5


def test_fewer_pixels_are_drawn_where_asked(open_page, page):
    tab = open_page(page)
    tab.settle()
    tab.tab.keyboard.press("?")
    tab.tab.select_option("#quality", "low")
    tab.wait_for("document.getElementById('view').width < 0.5 * innerWidth")


def test_a_browser_without_webgl_says_so(browser, page):
    context = browser.new_context()
    context.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    tab = context.new_page()
    tab.goto(page.as_uri())
    assert "WebGL" in tab.inner_text("#loading.failure")
    context.close()
