"""Videos of a scene: the options, camera paths and frames of `splatax render --path`."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

import splatax as sx
from splatax import trajectories
from splatax.cli.options import Model, parse_size, shown_as
from splatax.errors import InputError
from splatax.geometry_scores import NORMALS
from splatax.io import video
from splatax.metrics import to_8bit
from splatax.report.pictures import depth_range, normal_map, shaded
from splatax.runs.history import Picture
from splatax.trajectories.shapes import focus_of

SAMPLES = 8  # frames that determine the range of depth, so that its colors mean the same in all
SHAPES = ("orbit", "spiral", "interpolate")
DEFAULT_SIZE = (960, 540)  # if no capture gives another


@dataclass(frozen=True)
class VideoOptions:
    """Videos along a camera path."""

    path: Annotated[str | None, shown_as("{orbit,spiral,interpolate,FILE}")] = None
    """Write a video along this camera path. "orbit": around the point that the cameras look at; "spiral": for
    forward-facing captures; "interpolate": through the cameras; or a .json file of keyframes."""
    size: Annotated[str | None, shown_as("WIDTHxHEIGHT")] = None
    """Size in pixels. By default that of the photos, else 960x540."""
    fps: Annotated[int | None, shown_as("N")] = None
    """Frames per second. By default 30."""
    seconds: Annotated[float | None, shown_as("SECONDS")] = None
    """Duration. By default 10."""

    def film(self, out: Path) -> "Film | None":
        """Returns the video that the options describe; None if they ask for images.

        Args:
            out: file or folder to write.

        Raises:
            InputError: if they are out of range, or do not go together.
        """
        for name in ("fps", "seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"--{name}: more than 0, not {value}.")
        size = parse_size("--size", self.size) if self.size else None
        if self.path is None:
            given = [name for name in ("size", "fps", "seconds") if getattr(self, name)]
            if given or out.suffix.lower() in video.SUFFIXES:
                what = f"--{given[0]}" if given else out
                raise InputError(f"{what}: only for videos. Choose a camera path, for example --path orbit.")
            return None
        path = self.path if self.path in SHAPES else Path(self.path)
        return Film(path, size, self.fps or 30, 10.0 if self.seconds is None else self.seconds)


@dataclass(frozen=True)
class Film:
    """A camera path, and the frames along it.

    Attributes:
        path: one of SHAPES, or a file of keyframes.
        size: width and height of the colour image, pixels; None for that of the capture's photos.
        fps: frames per second.
        seconds: duration.
    """

    path: str | Path
    size: tuple[int, int] | None
    fps: int
    seconds: float

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

    def write(
        self,
        out: Path,
        gaussians: sx.Gaussians,
        cameras: list[sx.Camera],
        renderer: sx.Renderer,
        beside: Sequence[str],
    ) -> None:
        """Renders all frames into a file or folder, with a progress bar.

        Args:
            out: the file or folder.
            gaussians: the scene.
            cameras: one for each frame.
            renderer: with background, low-pass filter and backend.
            beside: outputs to show to the right of the colours: of depth, or normals.
        """
        width, height = cameras[0].width, cameras[0].height
        limits = {name: _limits(gaussians, cameras, renderer, name) for name in beside if name != NORMALS}
        columns = (BarColumn(bar_width=None), MofNCompleteColumn(), TextColumn("ETA"), TimeRemainingColumn())
        with (
            video.writing(out, (width * (1 + len(beside)), height), self.fps) as add,
            Progress(TextColumn("{task.description}"), *columns, expand=True) as bar,
        ):
            for camera in bar.track(cameras, description="rendering"):
                drawn = renderer(gaussians, camera, ("rgb", "alpha", *beside))
                pictures = [to_8bit(np.asarray(drawn.rgb))]
                pictures += [_picture(drawn, name, camera, limits.get(name)) for name in beside]
                add(np.concatenate(pictures, axis=1))


def _picture(
    drawn: sx.Rendering, output: str, camera: sx.Camera, limits: tuple[float, float] | None
) -> Picture:
    values, alpha = np.asarray(drawn.images[output]), np.asarray(drawn.alpha)
    return normal_map(values, alpha, camera) if output == NORMALS else shaded(values, alpha, limits)


def _limits(
    gaussians: sx.Gaussians, cameras: list[sx.Camera], renderer: sx.Renderer, depth: str
) -> tuple[float, float] | None:
    """Returns the range of depth over some of the frames, rendered at a quarter of their size."""
    width, height = (max(side // 4, 1) for side in (cameras[0].width, cameras[0].height))
    chosen = np.unique(np.round(np.linspace(0, len(cameras) - 1, SAMPLES)).astype(int))
    drawn = [renderer(gaussians, cameras[i].resized(width, height), ("alpha", depth)) for i in chosen]
    return depth_range(
        np.stack([np.asarray(frame.images[depth]) for frame in drawn]),
        np.stack([np.asarray(frame.alpha) for frame in drawn]),
    )


def default_size(dataset: sx.Dataset | None) -> tuple[int, int]:
    """Returns the size of the first photo, less a row or column where a number is odd."""
    if dataset is None:
        return DEFAULT_SIZE
    camera = dataset.views[0].camera
    return max(camera.width // 2 * 2, 2), max(camera.height // 2 * 2, 2)
