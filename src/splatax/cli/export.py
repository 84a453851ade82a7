"""`splatax export`: a scene in another format, optionally cleaned, cropped, moved or simplified."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

import splatax as sx
from splatax import editing, sensors, web
from splatax.cli.display import Display
from splatax.cli.evaluate import views_of
from splatax.cli.options import (
    BackendName,
    BackgroundOption,
    DownscaleOption,
    Model,
    OverwriteFlag,
    TextOption,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
    shown_as,
)
from splatax.cli.output import say
from splatax.cli.page import is_page, tell_losses, write_page
from splatax.errors import InputError
from splatax.io import formats
from splatax.io.datasets.photos import counted
from splatax.io.formats import sog_streamed
from splatax.training.backgrounds import Solid
from splatax.training.tuning import STEPS, tune, tuning
from splatax.transforms import Similarity

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Edits:
    """Gaussians to keep, and what to keep of them."""

    merge: Annotated[tuple[Path, ...], shown_as("FILE [FILE ...]")] = ()
    """Other splat files to merge in, in the same coordinate system."""
    clean: Annotated[bool, shown_as()] = False
    """Remove invalid, nearly transparent and isolated Gaussians and, with --scene, those that no camera
    sees."""
    crop_box: Annotated[tuple[float, float, float, float, float, float] | None, shown_as("X Y Z X Y Z")] = (
        None
    )
    """Keep the inside of a box: its lowest x y z, then its highest."""
    crop_sphere: Annotated[tuple[float, float, float, float] | None, shown_as("X Y Z RADIUS")] = None
    """Keep the inside of a sphere: its centre and radius."""
    simplify: Annotated[int | float | None, shown_as("{N,FRACTION}")] = None
    """Reduce to this many Gaussians, or to this fraction of them, such as 0.5. Keeps the most important ones.
    With --scene: keeps the most visible ones, and tunes them on the capture's training photos."""
    tune: Annotated[int, tyro.conf.arg(metavar="STEPS")] = STEPS
    """Number of steps for which --simplify with --scene tunes what it keeps. 0: none."""
    sh_degree: Annotated[Literal[0, 1, 2, 3, 4] | None, shown_as()] = None
    """Reduce view dependence to this degree of spherical harmonics."""

    def check(self) -> None:
        """Raises InputError for numbers that make no sense."""
        size = self.simplify
        if size is not None and not 0 < size < 1 and (isinstance(size, float) or size < 1):
            raise InputError(f"--simplify: a fraction between 0 and 1, or a whole number from 1, not {size}.")
        if self.tune < 0:
            raise InputError(f"--tune: a whole number of steps from 0, not {self.tune}.")

    def kept(self, count: int) -> int:
        """Returns how many of so many Gaussians --simplify keeps, at least one."""
        if self.simplify is None:
            return count
        return max(round(self.simplify * count), 1) if self.simplify < 1 else int(self.simplify)


@dataclass(frozen=True)
class Placement:
    """Placement of the scene. --rotate, --scale and --move are about the origin, in this order."""

    up: Annotated[Literal["auto"] | None, shown_as()] = None
    """Level the scene by the orientation of the cameras of --scene."""
    rotate: Annotated[Triple, shown_as("X Y Z")] = (0.0, 0.0, 0.0)
    """Rotate about the x, then the y, then the z axis, in degrees."""
    scale: Annotated[float, shown_as("FACTOR")] = 1.0
    """Scale by this factor."""
    move: Annotated[Triple, shown_as("X Y Z")] = (0.0, 0.0, 0.0)
    """Translate by x y z (applied last)."""

    def check(self, scene: Path | None) -> None:
        """Raises InputError for numbers that make no sense, or if there are no cameras to level by."""
        if self.up and not scene:
            raise InputError("--up auto: needs the cameras of a capture: --scene FOLDER.")
        if not (0 < self.scale < np.inf and np.isfinite([*self.rotate, *self.move]).all()):
            raise InputError("--scale, --rotate, --move: must be finite numbers, and the scale above zero.")

    def place(self, dataset: sx.Dataset | None) -> Similarity | None:
        """Returns the similarity to apply to the scene; None to leave every bit as it is."""
        if not self.up and (self.rotate, self.scale, self.move) == ((0, 0, 0), 1, (0, 0, 0)):
            return None
        place = Similarity.of(degrees=self.rotate, scale=self.scale, move=self.move)
        if self.up and dataset:
            place = place.after(editing.level([view.camera for view in dataset.views]))
        return place


@dataclass(frozen=True)
class FormatOptions:
    """Options of single formats."""

    levels: Annotated[int | None, shown_as("N")] = None
    """Number of levels of detail of a lod-meta.json, each with a quarter of the Gaussians of the one before.
    By default as many as have more than 20,000 Gaussians. With --scene, the PSNR of each is measured."""
    spz_version: Annotated[Literal[3, 4] | None, shown_as()] = None
    """Version of a .spz file. 3, the default, is read by most software; 4 loads faster."""
    title: TextOption = None
    """Title of a page. By default the name of the model's folder or file."""
    background: BackgroundOption = None
    """Colour behind the scene, on a page. By default as in training, else black."""


@dataclass(frozen=True)
class Export:
    """Convert a scene to another format, and optionally edit it.

    Edits are applied in this order: --merge, --clean, --crop-box and --crop-sphere (both in the scene's
    own coordinates), --simplify, --sh-degree, --up, then --rotate, --scale and --move.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run of splatax, INRIA's 3DGS or gsplat."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """The file to write. Its suffix selects the format; .html makes a page, as splatax page does."""
    scene: Annotated[Path | None, shown_as("CAPTURE")] = None
    """Folder of the capture, to measure PSNR before and after, and to weigh Gaussians by their visibility.
    On a page, its cameras become viewpoints."""
    downscale: DownscaleOption = None
    """Divide the width and height of photos by this number. "auto": the smallest factor that brings the long
    side down to 1600 pixels. By default as in training, else "auto"."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""
    overwrite: OverwriteFlag = False
    """Replace the file if it exists."""
    edit: Edits = Edits()
    placement: Placement = Placement()
    format: FormatOptions = FormatOptions()

    def run(self) -> None:
        self._check()
        model = read_model(self.model)
        dataset = load_scene(self.scene, self.downscale, model) if self.scene else None
        edited = self._selected(model, dataset)
        if self.edit.sh_degree is not None:
            edited = editing.reduce_degree(edited, self.edit.sh_degree)
        place = self.placement.place(dataset)
        if place is not None:
            edited = place.transform(edited)
        if len(edited) == 0:
            raise InputError(f"{self.model}: no Gaussian would be left. Use a larger crop or fewer filters.")
        if is_page(self.out):
            views = moved(dataset.views, place) if dataset else ()
            cameras = {view.name: view.camera for view in views}
            shown = replace(model, gaussians=edited)
            write_page(self.out, shown, cameras, self.format.title, self.format.background)
            return
        coarser = editing.levels_of(edited, self.format.levels)[1:] if self._streamed else ()
        self._save(model, edited, coarser)
        if dataset:
            self._measure(model, dataset, place, coarser)
        elif coarser:
            say("to measure the PSNR of the levels, give --scene CAPTURE")

    def _check(self) -> None:
        """Raises InputError for options that cannot work, before anything is computed."""
        if is_page(self.out):
            web.require_viewer()
        elif formats.format_of(self.out) in formats.READ_ONLY:
            raise InputError(
                f"{self.out}: this format can only be read. Choose one of {', '.join(formats.WRITTEN)}."
            )
        elif self.format.title is not None or self.format.background is not None:
            raise InputError(f"--title, --background: only for pages, and {self.out} is not an .html file.")
        if self.out.exists() and not self.overwrite:
            raise InputError(f"{self.out}: exists. Choose another name, or replace it: --overwrite.")
        if self.format.spz_version and not self.out.name.lower().endswith(".spz"):
            raise InputError(f"--spz-version: {self.out} is not an .spz file.")
        levels = self.format.levels
        if levels is not None and (levels < 1 or is_page(self.out) or not self._streamed):
            raise InputError("--levels: a whole number from 1, for a file that is named lod-meta.json.")
        self.edit.check()
        self.placement.check(self.scene)

    @property
    def _streamed(self) -> bool:
        return formats.format_of(self.out) is sog_streamed

    def _save(self, model: Model, edited: sx.Gaussians, coarser: Sequence[sx.Gaussians]) -> None:
        """Writes a splat file. Prints its size and what is lost."""
        version = self.format.spz_version
        options: dict[str, Any] = {"version": version} if version else {}
        if self._streamed:
            options["coarser"] = coarser
        self.out.parent.mkdir(parents=True, exist_ok=True)
        comments = sensors.kept_metres(model.path, self.placement.scale)
        count = sx.save(self.out, edited, comments=comments, **options)
        before, after = model.path.stat().st_size, formats.size_of(self.out)
        ratio = f"{before / after:.1f} x smaller" if after <= before else f"{after / before:.1f} x larger"
        say(f"{self.out}: {count:,} Gaussians, {after / 1e6:.2f} MB ({ratio})")
        tell_losses(self.out)
        if comments and not set(comments) <= set(formats.comments(self.out)):
            say(f"note    {self.out.suffix} files do not keep the scale in metres")

    def _selected(self, model: Model, dataset: sx.Dataset | None) -> sx.Gaussians:
        gaussians, edit = model.gaussians, self.edit
        if edit.merge:
            gaussians = editing.merge([gaussians, *map(sx.load, edit.merge)])
        if edit.clean:
            gaussians, removed = editing.clean(gaussians, weights=self._weights(model, gaussians, dataset))
            say("cleaned: " + ", ".join(f"{count:,} {reason}" for reason, count in removed.items()))
        if edit.crop_box:
            gaussians = editing.crop(gaussians, editing.Box(edit.crop_box[:3], edit.crop_box[3:]))
        if edit.crop_sphere:
            gaussians = editing.crop(gaussians, editing.Sphere(edit.crop_sphere[:3], edit.crop_sphere[3]))
        count = edit.kept(len(gaussians))
        if count < len(gaussians):
            weights = self._weights(model, gaussians, dataset)
            gaussians = editing.simplify(gaussians, count, weights=weights)
            if dataset and edit.tune and len(gaussians):
                gaussians = self._tuned(model, gaussians, dataset, edit.tune)
        return gaussians

    def _tuned(self, model: Model, gaussians: sx.Gaussians, dataset: sx.Dataset, steps: int) -> sx.Gaussians:
        """Returns the scene after some steps of training on the capture, with a progress bar."""
        say(f"tuning {len(gaussians):,} Gaussians on {counted(len(dataset.train))}, {steps:,} steps")
        recipe = tuning(gaussians, steps, Solid(background_of(model.options)))
        recipe = recipe.on(resolve_backend(self.backend))
        with Display(steps) as display:
            for progress in tune(gaussians, dataset, recipe):
                display.step(progress.step, progress.loss, progress.count)
        return progress.gaussians

    def _weights(self, model: Model, gaussians: sx.Gaussians, dataset: sx.Dataset | None):
        if dataset is None:
            return None
        cameras = [view.camera for view in dataset.train]
        backend = resolve_backend(self.backend)
        return editing.visible_weights(gaussians, cameras, sx.Renderer(backend=backend))

    def _measure(
        self, model: Model, dataset: sx.Dataset, place: Similarity | None, coarser: Sequence[sx.Gaussians]
    ) -> None:
        views = views_of(dataset, "test" if dataset.test else "train", self.scene or Path())
        background = background_of(model.options)
        renderer = sx.Renderer(background, backend=resolve_backend(self.backend))
        before, after = (
            sx.evaluate(g, v, renderer=renderer)
            for g, v in ((model.gaussians, views), (sx.load(self.out), moved(views, place)))
        )
        kind = "test" if dataset.test else "training"
        say(f"PSNR of {len(views)} {kind} views: {before.psnr:.3f} dB before, {after.psnr:.3f} dB after")
        for level, gaussians in enumerate(coarser, start=1):
            scores = sx.evaluate(gaussians, moved(views, place), renderer=renderer)
            say(f"level {level}: {len(gaussians):,} Gaussians, {scores.psnr:.3f} dB")


def moved(views: tuple[sx.View, ...], place: Similarity | None) -> tuple[sx.View, ...]:
    """Returns views whose cameras move with the scene."""
    if place is None:
        return views
    return tuple(replace(view, camera=place.transform_camera(view.camera)) for view in views)
