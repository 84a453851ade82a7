"""`splatax render`: images, depth and normals of a scene from the cameras of its capture, or a video."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import tyro
from jaxtyping import Float
from rich.progress import track

import splatax as sx
from splatax.cli.depths import DepthName, chosen_depth
from splatax.cli.evaluate import views_of
from splatax.cli.film import Film, VideoOptions
from splatax.cli.options import (
    BackendName,
    BackgroundOption,
    DownscaleOption,
    LowPassOption,
    OrderOption,
    OverwriteFlag,
    Split,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
    scene_of,
    shown_as,
)
from splatax.cli.output import say
from splatax.errors import InputError
from splatax.geometry_scores import NORMALS, ROBUST_DEPTH
from splatax.io.files import path_inside, replacing
from splatax.io.images import write
from splatax.metrics import to_8bit
from splatax.report.pictures import depth_map, normal_map
from splatax.runs.claim import claimed


@dataclass(frozen=True)
class Render:
    """Render images from the capture's cameras or, with --path, a video.

    Images: writes rgb/NAME.png, depth/NAME.npy (float32, world units along the optical axis, or from the
    camera for fisheyes and panoramas; 0 where the scene is empty) and depth/NAME.png, the depth in colours.
    With --normals also normals/NAME.npy (float32, unit vectors in the world, towards the camera; 0 where the
    scene is empty) and normals/NAME.png, where red points right, green up and blue towards the camera.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run of splatax, INRIA's 3DGS or gsplat."""
    scene: Annotated[Path | None, tyro.conf.Positional, shown_as("CAPTURE")] = None
    """Folder of the capture. By default the one that the run was trained on. Not needed for --path orbit or a
    keyframe file."""
    out: Annotated[Path, tyro.conf.arg(metavar="PATH")] = field(kw_only=True)
    """Output folder; for videos also a file: .mp4, .webm or .gif."""
    depth: Annotated[DepthName | None, shown_as()] = None
    """Depth output. Images: the one to write, by default "auto". Videos: the one to show to the right of the
    colours, by default none. "auto": the one that agrees best with the known points of the training photos
    or, if there are none, median_surface_depth."""
    normals: Annotated[bool, shown_as()] = False
    """Images: write normals too. Videos: show them on the right."""
    split: Split = "test"
    """Images: cameras to render from. "test": those of the photos that were held out from training."""
    downscale: DownscaleOption = None
    """Divide the width and height of images by this number. "auto": the smallest factor that brings the long
    side down to 1600 pixels. By default as in training, else "auto"."""
    background: BackgroundOption = None
    """Colour behind the scene. By default as in training, else black."""
    low_pass: LowPassOption = None
    """Anti-aliasing filter. By default the one that the file names."""
    order: OrderOption = None
    """Order in which splats are drawn. By default the one that the file names, else depth."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""
    overwrite: OverwriteFlag = False
    """Replace the output of an earlier call."""
    video: VideoOptions = VideoOptions()

    def run(self) -> None:
        film = self.video.film(self.out)
        model = read_model(self.model, self.low_pass, self.order)
        scene = self.scene or scene_of(model)
        dataset = load_scene(scene, self.downscale, model) if scene else None
        background = background_of(model.options, self.background)
        renderer = sx.Renderer(background, backend=resolve_backend(self.backend))
        train = dataset.train if dataset else ()
        if film:
            self._refuse_to_replace(film)
            cameras = film.cameras(model, dataset)
            beside = self._further_outputs(self.depth, model.gaussians, train, renderer)
            film.write(self.out, model.gaussians, cameras, renderer, beside)
            say(f"{len(cameras)} frames in {self.out}")
            return
        if dataset is None or scene is None:
            raise InputError(f"{self.model}: needs cameras: give the capture folder, or use --path.")
        views = views_of(dataset, self.split, scene)
        self._refuse_to_replace(film)
        files = files_of(views, self.out)
        further = self._further_outputs(self.depth or "auto", model.gaussians, train, renderer)
        with claimed(self.out):
            for view, paths in zip(track(views, description="rendering"), files, strict=True):
                drawn = renderer(model.gaussians, view.camera, ("rgb", "alpha", *further))
                _save(paths, drawn, further, view.camera)
        say(f"{len(views)} views in {self.out}")

    def _further_outputs(
        self,
        depth: DepthName | None,
        gaussians: sx.Gaussians,
        train: Sequence[sx.View],
        renderer: sx.Renderer,
    ) -> tuple[str, ...]:
        """Returns the names of the outputs besides colour: depth, normals, both or neither."""
        outputs = [chosen_depth(depth, gaussians, train, renderer, otherwise=ROBUST_DEPTH)] if depth else []
        return (*outputs, NORMALS) if self.normals else tuple(outputs)

    def _refuse_to_replace(self, film: Film | None) -> None:
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
    normals: Path  # numbers
    normal_map: Path  # the same to look at


def files_of(views: Sequence[sx.View], out: Path) -> "list[Files]":
    """Returns where the files of each view go: under its name, without the suffix of its photo.

    Photos whose names differ only in their suffix keep it, so that no image replaces another.

    Raises:
        InputError: if a view's name leads out of the output folder.
    """
    count = Counter(path_inside(out / "rgb", view.name).with_suffix("") for view in views)

    def file(folder: str, suffix: str, view: sx.View) -> Path:
        path = path_inside(out / folder, view.name)
        single = count[path_inside(out / "rgb", view.name).with_suffix("")] == 1
        return path.with_suffix(suffix) if single else path.with_name(path.name + suffix)

    kinds = (("rgb", ".png"), ("depth", ".npy"), ("depth", ".png"), ("normals", ".npy"), ("normals", ".png"))
    return [Files(*(file(folder, suffix, view) for folder, suffix in kinds)) for view in views]


def _save(paths: Files, drawn: sx.Rendering, further: Sequence[str], camera: sx.Camera) -> None:
    alpha = np.asarray(drawn.alpha)
    paths.color.parent.mkdir(parents=True, exist_ok=True)
    write(paths.color, to_8bit(np.asarray(drawn.rgb)))
    for name in further:
        values = np.asarray(drawn.images[name])
        if name == NORMALS:
            _save_numbers(paths.normals, values)
            write(paths.normal_map, normal_map(values, alpha, camera))
        else:
            _save_numbers(paths.depth, values)
            write(paths.depth_map, depth_map(values, alpha))


def _save_numbers(path: Path, values: Float[np.ndarray, "..."]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        np.lib.format.write_array(file, values, allow_pickle=False)
