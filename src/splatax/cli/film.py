"""Videos of a scene: the camera paths and the frames of `splatax render --path`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import splatax as sx
from splatax import trajectories
from splatax.cli.options import Model
from splatax.errors import InputError
from splatax.io import video
from splatax.metrics import to_8bit
from splatax.rendering import Color
from splatax.report.pictures import depth_range, shaded
from splatax.trajectories.shapes import focus_of

SAMPLES = 8  # frames that determine the range of depth, so that its colors mean the same in all
SHAPES = ("orbit", "spiral", "interpolate")
DEFAULT_SIZE = (960, 540)  # if no capture gives another


@dataclass(frozen=True)
class Film:
    """A camera path, and how to show the scene along it.

    Attributes:
        path: one of SHAPES, or a file of keyframes.
        size: width and height of the colour image, pixels; None for that of the capture's photos.
        fps: frames per second.
        seconds: duration.
        depth: whether to show depth, in colours, to the right.
        background: RGB.
        backend: name of the backend.
    """

    path: str | Path
    size: tuple[int, int] | None
    fps: int
    seconds: float
    depth: bool
    background: Color = (0.0, 0.0, 0.0)
    backend: str = "auto"

    def cameras(self, model: Model, dataset: sx.Dataset | None) -> list[sx.Camera]:
        """Returns one camera for each frame.

        Raises:
            InputError: if there is no such path through this capture.
        """
        means = np.asarray(model.gaussians.means)
        size, frames = self.size or default_size(dataset), max(round(self.fps * self.seconds), 1)
        if isinstance(self.path, Path):
            return trajectories.read(self.path, frames, size)
        if dataset is None:
            if self.path != "orbit":
                raise InputError(f"--path {self.path}: needs the cameras of a capture. Name its folder.")
            return trajectories.orbit(
                [trajectories.overview(means, size)], frames, size, np.median(means, axis=0)
            )
        cameras = [view.camera for view in dataset.standpoints]
        if self.path == "orbit":
            return trajectories.orbit(cameras, frames, size, focus_of(cameras))
        if self.path == "spiral":
            points = dataset.points.positions if len(dataset.points) else means
            return trajectories.spiral(cameras, frames, size, points)
        return trajectories.tour(cameras, frames, size)

    def write(self, out: Path, model: Model, cameras: list[sx.Camera]) -> None:
        """Renders all frames into a file or folder, with a progress bar."""
        width, height = cameras[0].width, cameras[0].height
        limits = self._limits(model, cameras) if self.depth else None
        columns = (BarColumn(bar_width=None), MofNCompleteColumn(), TextColumn("ETA"), TimeRemainingColumn())
        with (
            video.writing(out, (width * (1 + self.depth), height), self.fps) as add,
            Progress(TextColumn("{task.description}"), *columns, expand=True) as bar,
        ):
            for camera in bar.track(cameras, description="rendering"):
                drawn = self._draw(model, camera)
                picture = to_8bit(np.asarray(drawn.rgb))
                if self.depth:
                    depth = shaded(np.asarray(drawn.depth), np.asarray(drawn.alpha), limits)
                    picture = np.concatenate([picture, depth], axis=1)
                add(picture)

    def _draw(self, model: Model, camera: sx.Camera) -> sx.Rendering:
        return sx.Renderer(self.background, backend=self.backend)(model.gaussians, camera)

    def _limits(self, model: Model, cameras: list[sx.Camera]) -> tuple[float, float] | None:
        width, height = (max(side // 4, 1) for side in (cameras[0].width, cameras[0].height))
        chosen = np.unique(np.round(np.linspace(0, len(cameras) - 1, SAMPLES)).astype(int))
        drawn = [self._draw(model, cameras[i].resized(width, height)) for i in chosen]
        return depth_range(
            np.stack([np.asarray(frame.depth) for frame in drawn]),
            np.stack([np.asarray(frame.alpha) for frame in drawn]),
        )


def default_size(dataset: sx.Dataset | None) -> tuple[int, int]:
    """Returns the size of the first photo, less a row or column where a number is odd."""
    if dataset is None:
        return DEFAULT_SIZE
    camera = dataset.views[0].camera
    return max(camera.width // 2 * 2, 2), max(camera.height // 2 * 2, 2)
