"""The controls beside the picture: display options, viewpoints, and the progress of training."""

import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float

from splatax.dataset import View
from splatax.trajectories import Keyframe, keyframes
from splatax.viewer.pictures import MODES, Look
from splatax.viewer.poses import Pose, pose_of

STATUS_SECONDS = 0.5  # between updates of numbers
CURVE_SECONDS = 2.0  # between updates of the curve
CURVE_POINTS = 300
HEIGHTS = (270, 360, 540, 720, 1080, 1440, 2160)
ANYWHERE = "anywhere"


class Panels:
    """The controls, which all connected browsers share. viser calls their handlers in its own threads.

    Attributes:
        look: the chosen display options.
        largest: maximum height of a frame when the camera is still, pixels.
        paused: whether training is paused.
    """

    def __init__(self, server: Any, views: tuple[View, ...], look: Look, changed: Callable[[], None]):
        self.look, self.largest, self.paused = look, 1080, False
        self._gui, self._changed = server.gui, changed
        self._views = {view.name: view.camera for view in views}
        self._path: list[Keyframe] = []
        self._frames: list[tuple[float, float]] = []  # time of drawing, and its seconds
        self._told, self._drawn_curve = 0.0, 0.0
        self._curve: Any = None
        self._gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._status = self._gui.add_markdown("")
        self._training_status = self._gui.add_markdown("", visible=False)
        self._pause = self._gui.add_button("Pause training", visible=False)
        self._pause.on_click(self._toggle_pause)
        self._add_drawing()
        if views:
            self._add_views()
        self._add_path()

    def frame(self, size: tuple[int, int], seconds: float) -> None:
        """Shows the size of a frame, and the mean time of the last frames."""
        now = time.monotonic()
        self._frames = [*self._frames[-19:], (now, seconds)]
        if now - self._told > STATUS_SECONDS:
            self._told = now
            cost = np.mean([seconds for _, seconds in self._frames])
            self._status.content = f"{size[0]} x {size[1]}, {1000 * cost:.0f} ms per frame"

    def scene(self, count: int) -> None:
        """Shows the number of Gaussians of a finished scene."""
        self._training_status.visible = True
        self._training_status.content = f"{count:,} Gaussians"

    def training(self, step: int, steps: int, count: int, loss: float, psnr: float | None) -> None:
        """Shows the progress of training.

        Args:
            step: current step.
            steps: number of all steps.
            count: number of Gaussians.
            loss: loss of the current step.
            psnr: PSNR of the test views at the last evaluation, dB; None before the first one.
        """
        tested = f", test {psnr:.2f} dB" if psnr is not None else ""
        self._training_status.visible = self._pause.visible = True
        self._training_status.content = (
            f"step {step:,} of {steps:,}, {count:,} Gaussians, loss {loss:.4f}{tested}"
        )

    @property
    def curve_due(self) -> bool:
        """True if it is time to redraw the loss curve."""
        return time.monotonic() - self._drawn_curve > CURVE_SECONDS

    def curve(self, losses: Float[np.ndarray, " n"]) -> None:
        """Draws the losses of all steps so far, averaged to at most 300 points."""
        self._drawn_curve = time.monotonic()
        parts = np.array_split(losses, min(CURVE_POINTS, len(losses)))
        ends = np.cumsum([len(part) for part in parts]).astype(np.float64)
        data = ends, np.array([part.mean() for part in parts], np.float64)
        if self._curve is None:
            series = ({"label": "step"}, {"label": "loss", "stroke": "#4dabf7", "width": 2})
            self._curve = self._gui.add_uplot(data, series, aspect=1.8, scales={"x": {"time": False}})
        else:
            self._curve.data = data

    def _add_drawing(self) -> None:
        mode = self._gui.add_dropdown("Show", MODES, initial_value=self.look.mode)
        largest = self._gui.add_dropdown(
            "Resolution when still", tuple(map(str, HEIGHTS)), initial_value=str(self.largest)
        )
        with self._gui.add_folder("Crop box", expand_by_default=False):
            cropped = self._gui.add_checkbox("Show only the inside", initial_value=False)
            low = self._gui.add_vector3("Lowest", (-1.0, -1.0, -1.0), step=0.05)
            high = self._gui.add_vector3("Highest", (1.0, 1.0, 1.0), step=0.05)
            text = self._gui.add_markdown("")

        def choose(_: Any) -> None:
            box = (tuple(low.value), tuple(high.value)) if cropped.value else None
            numbers = " ".join(f"{x:g}" for x in (*low.value, *high.value))
            text.content = f"`splatax export --crop-box {numbers}`" if box else ""
            self.look = replace(self.look, mode=mode.value, box=box)
            self.largest = int(largest.value)
            self._changed()

        for control in (mode, largest, cropped, low, high):
            control.on_update(choose)

    def _add_views(self) -> None:
        names = tuple(self._views)
        chosen = self._gui.add_dropdown("Photo", (ANYWHERE, *names), initial_value=ANYWHERE)
        step = self._gui.add_button_group("", ("previous", "next"))

        @chosen.on_update
        def _(event: Any) -> None:
            if event.client is not None and chosen.value in self._views:
                self.jump(event.client, chosen.value)

        @step.on_click
        def _(event: Any) -> None:
            forward = step.value == "next"
            here = names.index(chosen.value) if chosen.value in self._views else (-1 if forward else 0)
            chosen.value = names[(here + (1 if forward else -1)) % len(names)]
            if event.client is not None:
                self.jump(event.client, chosen.value)

    def jump(self, client: Any, name: str) -> None:
        """Moves the camera of a browser to the camera of a photo."""
        window = client.camera.image_width, client.camera.image_height
        pose = pose_of(self._views[name], window)
        with client.atomic():
            client.camera.up_direction = pose.key.rotation.apply([0, -1, 0])
            client.camera.position = pose.position
            client.camera.wxyz = pose.wxyz
            client.camera.fov = pose.fov

    def _add_path(self) -> None:
        with self._gui.add_folder("Camera path", expand_by_default=False):
            count = self._gui.add_markdown("no keyframes")
            edit = self._gui.add_button_group("", ("add", "remove last"))
            save = self._gui.add_button("Save path.json")

        @edit.on_click
        def _(event: Any) -> None:
            if edit.value == "add" and event.client is not None:
                camera = event.client.camera
                window = (camera.image_width, camera.image_height)
                self._path.append(Pose(camera.wxyz, camera.position, camera.fov, window).key)
            elif self._path:
                self._path.pop()
            count.content = f"{len(self._path)} keyframes"

        @save.on_click
        def _(event: Any) -> None:
            if event.client is not None and self._path:
                event.client.send_file_download("path.json", keyframes.write(self._path))

    def _toggle_pause(self, _: Any) -> None:
        self.paused = not self.paused
        self._pause.label = "Resume training" if self.paused else "Pause training"
        self._changed()
