"""The server of the live viewer, and its connected browsers. The caller's thread draws the frames."""

import io
import logging
import socket
import threading
import time
from collections.abc import Callable
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera
from splatax.cameras.rig import up_of
from splatax.dataset import View
from splatax.errors import InputError
from splatax.gaussians import Gaussians
from splatax.viewer.pacing import Pacing
from splatax.viewer.panels import Panels
from splatax.viewer.pictures import Look
from splatax.viewer.poses import Pose, pose_of

PORT = 8080
LOCAL = ("127.0.0.1", "localhost", "::1")
REST_SECONDS = 0.25  # without motion, after which a frame is drawn at full size
MOVING_QUALITY, RESTING_QUALITY = 70, 92  # JPEG quality
WINDOW = (1280, 720)  # until a browser reports its own


@dataclass
class Browser:
    """A connected browser.

    Attributes:
        client: viser's handle.
        pacing: choice of the frame size.
        moves: number of camera movements so far.
        moved: time of the last movement, seconds.
        shown: state of the last frame: movements, version of the scene, display options, and size.
        drawn: programs that have been run, and are therefore compiled.
    """

    client: Any
    pacing: Pacing = field(default_factory=Pacing)
    moves: int = 0
    moved: float = 0.0
    shown: tuple[object, ...] = ()
    drawn: set[object] = field(default_factory=set)

    def move(self, now: float) -> None:
        """Records a movement of the camera."""
        self.moves, self.moved = self.moves + 1, now

    def pose(self) -> Pose:
        """Returns the current pose of the browser's camera."""
        camera = self.client.camera
        window = max(int(camera.image_width), 1), max(int(camera.image_height), 1)
        return Pose(np.array(camera.wxyz), np.array(camera.position), float(camera.fov), window)


class Viewer:
    """The live viewer of a scene. It is a context manager; leaving it stops the server.

    Attributes:
        panels: the controls beside the picture.
    """

    def __init__(
        self,
        views: tuple[View, ...],
        start: Camera,
        middle: Float[np.ndarray, "3"],
        look: Look,
        *,
        host: str = LOCAL[0],
        port: int = PORT,
    ):
        """Starts to listen on a port, or on the next free one if it is taken.

        Args:
            views: photos whose cameras the browser can jump to; may be empty.
            start: initial camera.
            middle: centre of the scene; the mouse rotates the camera around a point at its distance.
            look: initial display options.
            host: address to listen on.
            port: port to listen on, 1024 to 65535.

        Raises:
            InputError: if viser is not installed, or the address cannot be listened on.
        """
        self._browsers: dict[int, Browser] = {}
        self._version = 0
        self._wake = threading.Event()
        self._server = _listen(host, port)
        up = up_of([view.camera for view in views] or [start])
        self._server.scene.set_up_direction(up)
        first = pose_of(start, WINDOW)
        initial = self._server.initial_camera
        initial.position, initial.fov = first.position, first.fov
        initial.look_at = first.position + first.key.rotation.apply([0, 0, _ahead(start, middle)])
        initial.up = up
        self.panels = Panels(self._server, views, look, self._wake.set)
        self._server.on_client_connect(self._connect)
        self._server.on_client_disconnect(self._disconnect)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    @property
    def address(self) -> str:
        """URL to open in a browser."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    @property
    def watched(self) -> bool:
        """True if any browser is connected."""
        return bool(self._browsers)

    @property
    def moving(self) -> bool:
        """True if the camera of any browser is moving."""
        now = time.monotonic()
        return any(now - browser.moved < REST_SECONDS for browser in list(self._browsers.values()))

    def changed(self) -> None:
        """Marks the scene as changed, so that every browser gets a new frame."""
        self._version += 1

    def draw(self, gaussians: Gaussians) -> bool:
        """Draws one frame for each browser that needs one. Returns whether any did."""
        drawn = [self._draw(browser, gaussians) for browser in list(self._browsers.values())]
        return any(drawn)

    def serve(self, gaussians: Gaussians, stopped: Callable[[], bool]) -> None:
        """Shows a scene until `stopped` returns True."""
        while not stopped():
            if not self.draw(gaussians):
                # The wait has a limit, so that the last frame of a movement is drawn again at full size.
                self._wake.wait(REST_SECONDS / 5 if self.moving else REST_SECONDS)
                self._wake.clear()

    def _draw(self, browser: Browser, gaussians: Gaussians) -> bool:
        start = time.monotonic()
        moving = start - browser.moved < REST_SECONDS
        pose, look = browser.pose(), self.panels.look
        size = browser.pacing.size(pose.window, self.panels.largest, moving=moving, now=start)
        shown = (browser.moves, self._version, look)
        if shown == browser.shown[:-1] and (moving or browser.shown[-1] == size):
            return False
        picture = look.picture(gaussians, pose.camera(size))
        browser.client.scene.set_background_image(
            picture, "jpeg", jpeg_quality=MOVING_QUALITY if moving else RESTING_QUALITY
        )
        end = time.monotonic()
        program = (size, look.mode, look.box is None, len(gaussians))
        if program in browser.drawn:  # the first frame includes compilation
            browser.pacing.observe(size, end - start, end)
            self.panels.frame(size, end - start)
        browser.drawn.add(program)
        browser.shown = (*shown, size)
        return True

    def _connect(self, client: Any) -> None:
        browser = Browser(client)
        browser.move(time.monotonic())
        self._browsers[client.client_id] = browser

        @client.camera.on_update
        def _(_: Any) -> None:
            browser.move(time.monotonic())
            self._wake.set()

        self._wake.set()

    def _disconnect(self, client: Any) -> None:
        self._browsers.pop(client.client_id, None)
        self._wake.set()


def _listen(host: str, port: int) -> Any:
    """Starts viser's server, which takes the next free port if this one is taken."""
    try:
        import viser
    except ImportError:
        raise InputError(
            "The live viewer needs viser. Install it: pip install '.[viewer]' in the checkout of splatax."
        ) from None
    if not 1024 <= port < 65536:
        raise InputError(f"port {port}: must be from 1024 to 65535.")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise InputError(
            f"host {host}: cannot listen there ({error.strerror}). Use 127.0.0.1 for connections from this "
            "machine, or 0.0.0.0 for connections from the network."
        ) from error
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a browser that disconnects is no error
    with redirect_stdout(io.StringIO()):  # the command prints the address itself
        return viser.ViserServer(host=host, port=port, verbose=False)


def _ahead(start: Camera, middle: Float[np.ndarray, "3"]) -> float:
    """Returns the depth of a point along a camera's axis, or its distance if it is behind the camera."""
    to_middle = middle - np.asarray(start.position, np.float64)
    ahead = float(to_middle @ np.asarray(start.rotation, np.float64)[2])
    return ahead if ahead > 0 else float(np.linalg.norm(to_middle)) or 1.0
