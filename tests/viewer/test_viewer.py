"""The live viewer without a browser: cameras, sizes of frames, and browsers served."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from types import SimpleNamespace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.errors import InputError
from splatax.training.loop import first_state
from splatax.viewer.pacing import Pacing
from splatax.viewer.pictures import Look
from splatax.viewer.poses import Pose, pose_of

WINDOW = (640, 480)


def centered(size=(32, 24)):
    camera = camera_at((1.0, -2.0, -4.0), size=size)
    return sx.Camera.simple_pinhole(30.0, camera.cam_from_world, *size)


def pixel_of(camera, point):
    return np.asarray(camera.to_pixel(camera.to_camera(jnp.asarray(point, jnp.float32))))


def test_a_pose_turns_camera_axes_to_the_world_and_back():
    camera = centered()
    again = pose_of(camera, WINDOW).camera((32, 24))
    assert_allclose(again.cam_from_world, camera.cam_from_world, atol=1e-6)
    assert_allclose([again.fx, again.fy, again.cx, again.cy], [30, 30, 16, 12], rtol=1e-5)


def test_a_pose_looks_along_z_with_y_down():
    half_turn_about_x = np.array([0.0, 1.0, 0.0, 0.0])
    camera = Pose(half_turn_about_x, np.array([0.0, 0.0, 5.0]), 1.0, WINDOW).camera((64, 48))
    assert_allclose(camera.position, [0, 0, 5], atol=1e-6)
    x, y = pixel_of(
        camera, [0.5, 0.5, 0.0]
    )  # world y is up here, so the point is right of and above the middle
    assert x > 32
    assert y < 24


def test_the_field_of_view_is_that_from_top_to_bottom_of_the_window():
    pose = Pose(np.array([1.0, 0, 0, 0]), np.zeros(3), np.pi / 2, WINDOW)
    camera = pose.camera((64, 48))
    assert_allclose(pixel_of(camera, [0, 1, 1]), [32, 48], atol=1e-4)
    assert_allclose(pixel_of(camera, [4 / 3, 0, 1]), [64, 24], atol=1e-4)
    squeezed = pose.camera((48, 48))  # the browser stretches it to the window
    assert_allclose(pixel_of(squeezed, [4 / 3, 0, 1]), [48, 24], atol=1e-4)


@pytest.mark.parametrize("window", [(640, 480), (1600, 400), (300, 900)])
def test_a_window_of_any_shape_shows_all_of_a_photo(window):
    photo = centered()
    shown = pose_of(photo, window).camera(window)
    for corner in ((-16, -12), (16, 12)):
        seen = jnp.array([corner[0] / 30, corner[1] / 30, 1.0], jnp.float32)
        pixel = np.asarray(shown.to_pixel(seen))
        assert (pixel >= -1e-2).all()
        assert (pixel <= np.array(window) + 1e-2).all()


def seconds_for(size):
    """A machine: 10 ms for any frame, and 1 us a pixel."""
    return 0.01 + 1e-6 * size[0] * size[1]


def test_frames_at_rest_fill_the_window_up_to_the_largest():
    pacing = Pacing()
    assert pacing.size((1280, 720), 1080, moving=False, now=0.0) == (1280, 720)
    assert pacing.size((1280, 720), 360, moving=False, now=0.0) == (640, 360)


def test_frames_while_moving_are_the_largest_that_keep_to_the_budget():
    pacing, now = Pacing(budget=0.05), 0.0
    for _ in range(20):
        size = pacing.size((1280, 720), 1080, moving=True, now=now)
        pacing.observe(size, seconds_for(size), now)
        full = pacing.size((1280, 720), 1080, moving=False, now=now)
        pacing.observe(full, seconds_for(full), now)
        now += 0.1
    assert size == (224, 128)  # 39 ms; the next one, 320 x 180, takes 68
    assert seconds_for((320, 180)) > 0.05


def test_frames_are_not_made_smaller_where_that_saves_little():
    pacing, now = Pacing(budget=0.05), 0.0
    for _ in range(20):
        size = pacing.size((504, 378), 1080, moving=True, now=now)
        pacing.observe(size, 0.07 + 1e-7 * size[0] * size[1], now)
        now += 0.1
    assert size == (512, 378)


def test_an_unknown_machine_starts_small_and_a_fast_one_ends_at_full_size():
    pacing = Pacing()
    size = pacing.size((1280, 720), 1080, moving=True, now=0.0)
    assert size == (160, 90)
    for i in range(12):
        pacing.observe(size, 0.001, i * 0.01)
        size = pacing.size((1280, 720), 1080, moving=True, now=i * 0.01)
    assert size == (1280, 720)


def test_a_size_that_was_slow_once_is_tried_again():
    pacing = Pacing(budget=0.05)
    pacing.observe((160, 90), 0.04, 0.0)
    pacing.observe((224, 128), 0.9, 0.0)
    assert pacing.size((1280, 720), 1080, moving=True, now=1.0) == (160, 90)
    pacing.observe((160, 90), 0.004, 6.0)
    assert pacing.size((1280, 720), 1080, moving=True, now=6.0)[1] > 90


def progress_of(gaussians):
    """In the middle of training."""
    state = first_state(gaussians, sx.recipes.classic(), 1.0, 1)
    return sx.Progress(2, 3, jnp.float32(0.4), len(gaussians), state, sx.Dilation())


class Client:
    """What a browser tells, and what it is sent."""

    def __init__(self, client_id=7):
        self.client_id, self.frames, self.moved = client_id, [], None
        pose = pose_of(centered(), WINDOW)
        self.camera = SimpleNamespace(
            wxyz=pose.wxyz, position=pose.position, fov=pose.fov, image_width=64, image_height=96
        )
        self.camera.on_update = lambda callback: setattr(self, "moved", callback)
        self.scene = SimpleNamespace(
            set_background_image=lambda picture, *_, **__: self.frames.append(picture)
        )


@pytest.fixture
def viewer():
    pytest.importorskip("viser")
    from splatax.viewer.server import Viewer

    with Viewer((), centered(), np.zeros(3), Look(), port=18080) as viewer:
        yield viewer


def test_nobody_who_looks_is_no_work(viewer, monkeypatch):
    from splatax.cli.view import Audience

    audience = Audience(viewer)
    monkeypatch.setattr(Look, "picture", lambda *_: pytest.fail("drawn for nobody"))
    assert not audience.waits
    assert not viewer.draw(random_gaussians())


def test_a_frame_is_sent_when_something_changed_and_in_full_at_rest(viewer):
    gaussians, client = random_gaussians(), Client()
    viewer._connect(client)
    assert viewer.draw(gaussians)
    time.sleep(0.3)
    assert viewer.draw(gaussians)
    assert client.frames[-1].shape == (96, 64, 3)
    assert not viewer.draw(gaussians)
    viewer.changed()
    assert viewer.draw(gaussians)
    client.moved(None)
    assert viewer.draw(gaussians)
    viewer._disconnect(client)
    assert not viewer.watched


def test_drawing_stays_within_its_fraction_of_the_time_of_training(viewer):
    from splatax.cli.view import RESTING_FRACTION, Audience
    from splatax.runs.history import History

    audience, client, history = Audience(viewer), Client(), History(losses=[0.5, 0.4])
    progress = progress_of(random_gaussians())
    viewer._connect(client)
    audience.show(progress, history, lambda: False)
    time.sleep(0.3)
    audience.show(progress, history, lambda: False)  # compiles the size of frames at rest
    audience._spent = 0.1
    ended = audience._ended = time.monotonic()
    assert not audience.waits
    while not audience.waits:
        time.sleep(0.01)
    assert time.monotonic() - ended >= 0.1 * (1 - RESTING_FRACTION) / RESTING_FRACTION


def test_a_pause_ends_when_all_have_left(viewer):
    from splatax.cli.view import Audience
    from splatax.runs.history import History

    audience, client = Audience(viewer), Client()
    progress = progress_of(random_gaussians())
    viewer._connect(client)
    viewer.panels.paused = True
    assert audience.waits
    leaving = threading.Timer(0.5, viewer._disconnect, [client])
    leaving.start()
    start = time.monotonic()
    audience.show(progress, History(losses=[0.4]), lambda: False)
    assert time.monotonic() - start >= 0.4


def test_the_next_port_is_taken_where_one_is_in_use(viewer):
    from splatax.viewer.server import Viewer

    taken = viewer.address
    with Viewer((), centered(), np.zeros(3), Look(), port=int(taken.rsplit(":", 1)[1])) as other:
        assert other.address != taken


def test_addresses_that_are_not_ours_are_refused():
    pytest.importorskip("viser")
    from splatax.viewer.server import Viewer

    with pytest.raises(InputError, match="cannot listen there"):
        Viewer((), centered(), np.zeros(3), Look(), host="203.0.113.1")
    with pytest.raises(InputError, match="port 80: must be"):
        Viewer((), centered(), np.zeros(3), Look(), port=80)


@pytest.mark.slow
def test_ctrl_c_ends_the_viewer_without_a_word(tmp_path):
    pytest.importorskip("viser")
    sx.save(tmp_path / "scene.ply", random_gaussians())
    program = "from splatax.cli import main; main()"
    command = [sys.executable, "-c", program, "view", str(tmp_path), "--port", "18200"]
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=os.environ
    )
    assert process.stdout is not None
    line = process.stdout.readline()
    assert line.startswith("viewer  http://127.0.0.1:182")
    port = int(line.rsplit(":", 1)[1])
    with socket.create_connection(("127.0.0.1", port), timeout=5):
        pass
    process.send_signal(signal.SIGINT)
    rest, _ = process.communicate(timeout=30)
    assert process.returncode == 0, rest
    assert "Traceback" not in rest
