"""A page in a headset: the button appears, a session starts, and both eyes see the scene.

The headset is emulated: iwer (MIT) gives the browser the WebXR interface of a headset, and shows the pictures
of both eyes side by side on the canvas.
"""

import numpy as np
import pytest
from screenshots import picture, psnr

import splatax as sx
from npm import installed
from scenes import camera_at, random_gaussians
from splatax import web
from splatax.cameras import Camera
from splatax.web.staging import stage

pytestmark = pytest.mark.slow
EMULATOR = "iwer@2.5.0"
SIZE = (480, 240)  # of the window, half of which belongs to each eye
PUT_ON = """
window.headset = new IWER.XRDevice(IWER.metaQuest3, { stereoEnabled: true, ipd: 0.2 });
window.headset.installRuntime({ forceInstall: true });
"""
SCENE = random_gaussians(n=1500, degree=0, scale=(0.02, 0.06), spread=0.7)
FRONT = camera_at((0.0, 0.0, -2.5), size=SIZE, focal=200.0)
EYES = """viewer.stage.renderer.xr.getCamera().cameras.map(eye => ({
    view: eye.matrixWorldInverse.elements,
    projection: eye.projectionMatrix.elements,
    viewport: eye.viewport.toArray(),
}))"""
LIKE = 38.0  # dB; a picture of the other eye stays below 36


@pytest.fixture(scope="module")
def page(tmp_path_factory, viewer):
    path = tmp_path_factory.mktemp("headset") / "scene.html"
    web.save(path, SCENE, title="In a headset", cameras={"front": FRONT})
    return path


@pytest.fixture(scope="module")
def emulator(tmp_path_factory):
    """The program that puts a headset on a page."""
    folder = installed(EMULATOR, tmp_path_factory.mktemp("npm"))
    return (folder / "node_modules" / "iwer" / "build" / "iwer.js").read_text() + PUT_ON


def camera_of(eye):
    """The camera of an eye in the world, from OpenGL's matrices, whose axes y and z point the other way."""
    _, _, width, height = eye["viewport"]
    view, projection = (np.reshape(eye[name], (4, 4)).T for name in ("view", "projection"))
    fx, fy = projection[0, 0] * width / 2, projection[1, 1] * height / 2
    cx, cy = (1 - projection[0, 2]) * width / 2, (1 + projection[1, 2]) * height / 2
    flip = np.diag([1.0, -1, -1, 1])
    numbers = (np.float32(number) for number in (fx, fy, cx, cy))
    camera = Camera(*numbers, np.asarray(flip @ view @ flip, np.float32), width, height)
    return stage(SCENE, {"front": FRONT}).place.inverse().transform_camera(camera)


def test_without_a_headset_there_is_no_button(open_page, page):
    tab = open_page(page, SIZE)
    tab.settle()
    assert tab.tell("document.getElementById('headset').hidden")


def test_the_button_starts_a_session_in_which_each_eye_sees_the_scene(open_page, page, emulator):
    tab = open_page(page, SIZE, script=emulator)
    tab.settle()
    tab.wait_for("!document.getElementById('headset').hidden")
    tab.tab.click("#headset")
    tab.wait_for("viewer.stage.renderer.xr.isPresenting")
    tab.wait_for("viewer.stage.renderer.xr.getCamera().cameras.length === 2")
    tab.wait_for("viewer.stage.renderer.info.render.frame > 30")
    cameras = list(map(camera_of, tab.tell(EYES)))
    left, right = (np.clip(sx.render(SCENE, camera).rgb, 0, 1) for camera in cameras)
    for shown, own, other in zip(
        np.split(picture(tab), 2, axis=1), (left, right), (right, left), strict=True
    ):
        assert psnr(shown, own) > LIKE
        assert psnr(shown, other) < LIKE - 2
    assert tab.errors == []
    tab.tell("viewer.stage.renderer.xr.getSession().end()")
    tab.wait_for("!viewer.stage.renderer.xr.isPresenting")
    tab.settle()  # the page goes on as before
    assert psnr(picture(tab), np.clip(sx.render(SCENE, FRONT).rgb, 0, 1)) > 30
