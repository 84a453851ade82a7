"""`splatax render`: images and depth of a scene from the cameras of its capture, or a video."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from rich.progress import track

import splatax as sx
from splatax.cli.evaluate import views_of
from splatax.cli.film import SHAPES, Film
from splatax.cli.options import (
    BackendName,
    BackgroundOption,
    DownscaleOption,
    LowPassOption,
    OverwriteFlag,
    Split,
    background_of,
    load_scene,
    parse_size,
    read_model,
    resolve_backend,
    scene_of,
    shown_as,
)
from splatax.cli.output import say
from splatax.errors import InputError
from splatax.io import video
from splatax.io.files import path_inside, replacing
from splatax.io.images import write
from splatax.metrics import to_8bit
from splatax.report.pictures import depth_map
from splatax.runs.claim import claimed


@dataclass(frozen=True)
class Render:
    """Render images from the capture's cameras or, with --path, a video.

    Images: writes rgb/NAME.png, depth/NAME.npy (float32, world units along the optical axis, 0 where the
    scene is empty) and depth/NAME.png, the depth in colours.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run of splatax, INRIA's 3DGS or gsplat."""
    scene: Annotated[Path | None, tyro.conf.Positional, shown_as("CAPTURE")] = None
    """Folder of the capture. By default the one that the run was trained on. Not needed for --path orbit or a
    keyframe file."""
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")] = field(kw_only=True)
    """Output folder; for videos also a file: .mp4, .webm or .gif."""
    path: Annotated[str | None, shown_as("{orbit,spiral,interpolate,FILE}")] = None
    """Video: camera path. "orbit": around the point that the cameras look at; "spiral": for forward-facing
    captures; "interpolate": through the cameras; or a .json file of keyframes."""
    size: Annotated[str | None, shown_as("WIDTHxHEIGHT")] = None
    """Video: size in pixels. By default that of the photos, else 960x540."""
    fps: Annotated[int | None, shown_as("N")] = None
    """Video: frames per second. By default 30."""
    seconds: Annotated[float | None, shown_as("SECONDS")] = None
    """Video: duration. By default 10."""
    depth: Annotated[bool, shown_as()] = False
    """Video: show depth beside colour."""
    split: Split = "test"
    """Images: cameras to render from. "test": those of the photos that were held out from training."""
    downscale: DownscaleOption = None
    """Divide the width and height of images by this number. "auto": the smallest factor that brings the long
    side down to 1600 pixels. By default as in training, else "auto"."""
    background: BackgroundOption = None
    """Colour behind the scene. By default as in training, else black."""
    low_pass: LowPassOption = None
    """Anti-aliasing filter. By default the one that the file names."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""
    overwrite: OverwriteFlag = False
    """Replace the output of an earlier call."""

    def run(self) -> None:
        film = self._film()
        model = read_model(self.model, self.low_pass)
        scene = self.scene or scene_of(model)
        dataset = load_scene(scene, self.downscale, model) if scene else None
        background = background_of(model.options, self.background)
        if film:
            self._refuse_to_replace(film=True)
            film = replace(film, background=background, backend=resolve_backend(self.backend))
            cameras = film.cameras(model, dataset)
            film.write(self.out, model, cameras)
            say(f"{len(cameras)} frames in {self.out}")
            return
        if dataset is None or scene is None:
            raise InputError(f"{self.model}: needs cameras: give the capture folder, or use --path.")
        renderer = sx.Renderer(background, backend=resolve_backend(self.backend))
        views = views_of(dataset, self.split, scene)
        self._refuse_to_replace(film=False)
        files = files_of(views, self.out)
        with claimed(self.out):
            for view, paths in zip(track(views, description="rendering"), files, strict=True):
                _save(paths, renderer(model.gaussians, view.camera))
        say(f"{len(views)} views in {self.out}")

    def _film(self) -> Film | None:
        """Returns the video that the options describe; None if they ask for images.

        Raises:
            InputError: if they are out of range, or do not go together.
        """
        for name in ("fps", "seconds"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise InputError(f"--{name}: more than 0, not {value}.")
        size = parse_size("--size", self.size) if self.size else None
        if self.path is None:
            given = [name for name in ("size", "fps", "seconds", "depth") if getattr(self, name)]
            if given or self.out.suffix.lower() in video.SUFFIXES:
                what = f"--{given[0]}" if given else self.out
                raise InputError(f"{what}: only for videos. Choose a camera path, for example --path orbit.")
            return None
        path = self.path if self.path in SHAPES else Path(self.path)
        fps = 30 if self.fps is None else self.fps
        return Film(path, size, fps, 10.0 if self.seconds is None else self.seconds, self.depth)

    def _refuse_to_replace(self, film: bool) -> None:
        """Raises InputError if the output exists already."""
        taken = self.out / "rgb"
        if film:
            taken = self.out / "frame00000.png" if self.out.is_dir() else self.out
        if taken.exists() and not self.overwrite:
            raise InputError(f"{taken}: exists. Choose another --out, or replace it: --overwrite.")


class Files(NamedTuple):
    """Paths of the files that show one view."""

    color: Path
    depth: Path  # numbers
    depth_map: Path  # the same to look at


def files_of(views: Sequence[sx.View], out: Path) -> "list[Files]":
    """Returns where the files of each view go: under its name, without the suffix of its photo.

    Photos whose names differ only in their suffix keep it, so that no image replaces another.

    Raises:
        InputError: if a view's name leads out of the output folder.
    """
    colors = [path_inside(out / "rgb", view.name) for view in views]
    depths = [path_inside(out / "depth", view.name) for view in views]
    count = Counter(color.with_suffix("") for color in colors)

    def renamed(path: Path, suffix: str, color: Path) -> Path:
        single = count[color.with_suffix("")] == 1
        return path.with_suffix(suffix) if single else path.with_name(path.name + suffix)

    return [
        Files(renamed(color, ".png", color), renamed(depth, ".npy", color), renamed(depth, ".png", color))
        for color, depth in zip(colors, depths, strict=True)
    ]


def _save(paths: Files, drawn: sx.Rendering) -> None:
    for path in paths:
        path.parent.mkdir(parents=True, exist_ok=True)
    depth = np.asarray(drawn.depth)
    write(paths.color, to_8bit(np.asarray(drawn.rgb)))
    write(paths.depth_map, depth_map(depth, np.asarray(drawn.alpha)))
    with replacing(paths.depth) as file:
        np.lib.format.write_array(file, depth, allow_pickle=False)
