"""The live viewer: a server for browsers, and who is looking. Frames are drawn by the caller's thread."""

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

from splatax.camera import Camera
from splatax.dataset import View
from splatax.errors import InputError
from splatax.gaussians import Gaussians
from splatax.trajectories.shapes import up_of
from splatax.viewer.pacing import Pacing
from splatax.viewer.panels import Panels
from splatax.viewer.pictures import Look
from splatax.viewer.poses import Pose, pose_of

PORT = 8080
LOCAL = ("127.0.0.1", "localhost", "::1")
REST_SECONDS = 0.25  # without a move, after which a frame is drawn in full
MOVING_QUALITY, RESTING_QUALITY = 70, 92  # of JPEGs
POLL_SECONDS = 0.01
WINDOW = (1280, 720)  # until a browser tells its own


@dataclass
class Seat:
    """Someone who looks.

    Attributes:
        client: viser's handle.
        pacing: how large frames may be.
        moved: when the camera last did, seconds.
        shown: what the last frame was of: moves, changes of the scene and the controls, and its size.
        drawn: the sizes that have been drawn, and so compiled.
    """

    client: Any
    pacing: Pacing = field(default_factory=Pacing)
    moves: int = 0
    moved: float = 0.0
    shown: tuple[object, ...] = ()
    drawn: set[object] = field(default_factory=set)

    def move(self, now: float) -> None:
        self.moves, self.moved = self.moves + 1, now

    def pose(self) -> Pose:
        camera = self.client.camera
        window = max(int(camera.image_width), 1), max(int(camera.image_height), 1)
        return Pose(np.array(camera.wxyz), np.array(camera.position), float(camera.fov), window)


class Viewer:
    """A window into a scene. A context manager: leaving it stops the server.

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
        """Starts to listen, on the next free port if that one is taken.

        Args:
            views: to jump to; may be none.
            start: the camera to begin with.
            middle: of the scene: the mouse turns the camera around a point as far ahead.
            look: how to draw at first.
            host: the address to listen on.
            port: where.

        Raises:
            InputError: if viser is not installed, or nothing can listen there.
        """
        self._seats: dict[int, Seat] = {}
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
        self._server.on_client_connect(self._sit)
        self._server.on_client_disconnect(self._leave)

    def __enter__(self) -> "Viewer":
        return self

    def __exit__(self, *_: object) -> None:
        with redirect_stdout(io.StringIO()):
            self._server.stop()

    @property
    def address(self) -> str:
        """For a browser."""
        return f"http://{self._server.get_host()}:{self._server.get_port()}"

    @property
    def watched(self) -> bool:
        """Whether anyone looks."""
        return bool(self._seats)

    @property
    def moving(self) -> bool:
        """Whether anyone's camera moves."""
        now = time.monotonic()
        return any(now - seat.moved < REST_SECONDS for seat in list(self._seats.values()))

    def changed(self) -> None:
        """The scene is another one now."""
        self._version += 1

    def draw(self, gaussians: Gaussians) -> bool:
        """Draws one frame for each who waits for one; whether there was any."""
        drawn = [self._draw(seat, gaussians) for seat in list(self._seats.values())]
        return any(drawn)

    def serve(self, gaussians: Gaussians, stopped: Callable[[], bool]) -> None:
        """Shows a scene until it is told to stop."""
        while not stopped():
            if not self.draw(gaussians):
                # A pause that ends by itself: the last frame of a movement is drawn again in full.
                self._wake.wait(REST_SECONDS / 5 if self.moving else REST_SECONDS)
                self._wake.clear()

    def _draw(self, seat: Seat, gaussians: Gaussians) -> bool:
        start = time.monotonic()
        moving = start - seat.moved < REST_SECONDS
        pose, look = seat.pose(), self.panels.look
        size = seat.pacing.size(pose.window, self.panels.largest, moving=moving, now=start)
        shown = (seat.moves, self._version, look)
        if shown == seat.shown[:-1] and (moving or seat.shown[-1] == size):
            return False
        picture = look.picture(gaussians, pose.camera(size))
        seat.client.scene.set_background_image(
            picture, "jpeg", jpeg_quality=MOVING_QUALITY if moving else RESTING_QUALITY
        )
        end = time.monotonic()
        program = (size, look.mode, look.box is None, len(gaussians))
        if program in seat.drawn:  # the first time is that of compiling
            seat.pacing.observe(size, end - start, end)
            self.panels.frame(size, end - start)
        seat.drawn.add(program)
        seat.shown = (*shown, size)
        return True

    def _sit(self, client: Any) -> None:
        seat = Seat(client)
        seat.move(time.monotonic())
        self._seats[client.client_id] = seat

        @client.camera.on_update
        def _(_: Any) -> None:
            seat.move(time.monotonic())
            self._wake.set()

        self._wake.set()

    def _leave(self, client: Any) -> None:
        self._seats.pop(client.client_id, None)
        self._wake.set()


def _listen(host: str, port: int) -> Any:
    """viser's server. It takes the next port where one is taken."""
    try:
        import viser
    except ImportError:
        raise InputError("The live viewer needs viser. Install it: pip install 'splatax[viewer]'.") from None
    if not 1024 <= port < 65536:
        raise InputError(f"--port: 1024 to 65535, not {port}.")
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise InputError(
            f"--host {host}: nothing can listen there ({error.strerror}). This machine alone: 127.0.0.1; "
            "all who can reach it: 0.0.0.0."
        ) from error
    logging.getLogger("websockets").setLevel(logging.CRITICAL)  # browsers that go away are no error
    with redirect_stdout(io.StringIO()):  # the command line says where to look itself
        return viser.ViserServer(host=host, port=port, verbose=False)


def _ahead(start: Camera, middle: Float[np.ndarray, "3"]) -> float:
    """How far before a camera its axis is nearest to a point; how far that is if it lies behind."""
    to_middle = middle - np.asarray(start.position, np.float64)
    ahead = float(to_middle @ np.asarray(start.rotation, np.float64)[2])
    return ahead if ahead > 0 else float(np.linalg.norm(to_middle)) or 1.0
