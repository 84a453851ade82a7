"""`splatax export`: a scene in another format, and on the way cleaned, cut, turned or thinned out."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
import tyro

import splatax as sx
from splatax import editing, web
from splatax.cli.evaluate import views_of
from splatax.cli.options import (
    BackendName,
    BackgroundName,
    Downscale,
    Model,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
)
from splatax.cli.output import say
from splatax.cli.page import is_page, write_page
from splatax.errors import InputError
from splatax.io import formats
from splatax.projection import Antialiasing
from splatax.transforms import Similarity

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Export:
    """Write a scene in another format, and edit it on the way.

    Edits happen in this order: --merge, --clean, --crop-box and --crop-sphere (both in the scene's
    own coordinates), --simplify, --sh-degree, --up, then --rotate, --scale and --move.
    """

    model: tyro.conf.Positional[Path]
    """A splat file, or the folder of a run."""
    out: tyro.conf.Positional[Path]
    """The file to write. Its suffix tells the format; .html makes a page, as splatax page does."""
    scene: Path | None = None
    """Folder of the capture: measures PSNR before and after, and tells what its cameras see. On a page,
    they are places to look from."""
    merge: tuple[Path, ...] = ()
    """More splat files, in the same coordinates, to put in."""
    clean: bool = False
    """Leave out what is broken, too faint, floats alone or (with --scene) was never seen."""
    crop_box: tuple[float, float, float, float, float, float] | None = None
    """Keep what is within: lowest x y z, highest x y z."""
    crop_sphere: tuple[float, float, float, float] | None = None
    """Keep what is within: centre x y z, radius."""
    simplify: int | None = None
    """Keep so many Gaussians, those that matter most (with --scene: that its cameras see most of)."""
    sh_degree: Literal[0, 1, 2, 3, 4] | None = None
    """Keep view dependence up to this degree of harmonics."""
    up: Literal["auto"] | None = None
    """Put the scene upright, as the cameras of --scene were held."""
    rotate: Triple = (0.0, 0.0, 0.0)
    """Turn about the x, then the y, then the z axis, degrees."""
    scale: float = 1.0
    """Enlarge by this."""
    move: Triple = (0.0, 0.0, 0.0)
    """Move by x y z, after all else."""
    spz_version: Literal[3, 4] | None = None
    """Of .spz: 3 (without this) is read by most software, 4 loads faster."""
    title: str | None = None
    """Of a page. Without it: the name of the model's folder or file."""
    background: BackgroundName | None = None
    """Behind the scene, on a page. Without it: as trained, else black."""
    downscale: Downscale | None = None
    """Divide the size of photos by this. "auto": the least that brings them to 1600 pixels."""
    backend: BackendName = "auto"
    """Rasterizer."""
    overwrite: bool = False
    """Replace the file if there is one."""

    def run(self) -> None:
        self._check()
        model = read_model(self.model, None)
        dataset = load_scene(self.scene, self.downscale, model) if self.scene else None
        edited = self._selected(model, dataset)
        if self.sh_degree is not None:
            edited = editing.reduce_degree(edited, self.sh_degree)
        place = self._place(dataset)
        if place is not None:
            edited = place.transform(edited)
        if len(edited) == 0:
            raise InputError(f"{self.out}: no Gaussians would be left. Crop or clean less.")
        if is_page(self.out):
            views = moved(dataset.views, place) if dataset else ()
            cameras = {view.name: view.camera for view in views}
            write_page(self.out, replace(model, gaussians=edited), cameras, self.title, self.background)
            say(f"loses: {web.LOSES}")
            return
        self._save(model, edited)
        if dataset:
            self._measure(model, dataset, place)

    def _check(self) -> None:
        """Refuses what cannot work before anything is computed."""
        if is_page(self.out):
            web.require_viewer()
        elif not hasattr(formats.format_of(self.out), "save"):
            raise InputError(f"{self.out}: can only be read. Write {', '.join(formats.suffixes('save'))}.")
        elif self.title is not None or self.background is not None:
            raise InputError(f"--title, --background: of pages alone, and {self.out} is no .html file.")
        if self.out.exists() and not self.overwrite:
            raise InputError(f"{self.out}: exists. Choose another name, or replace it: --overwrite.")
        if self.up and not self.scene:
            raise InputError("--up auto: needs the cameras of a capture: --scene FOLDER.")
        if self.spz_version and not self.out.name.lower().endswith(".spz"):
            raise InputError(f"--spz-version: {self.out} is no .spz file.")
        if self.simplify is not None and self.simplify < 1:
            raise InputError(f"--simplify: a whole number from 1, not {self.simplify}.")
        if not (0 < self.scale < np.inf and np.isfinite([*self.rotate, *self.move]).all()):
            raise InputError("--scale, --rotate, --move: must be finite numbers, and the scale above zero.")

    def _save(self, model: Model, edited: sx.Gaussians) -> None:
        """Writes a splat file. Says how large it is and what is lost."""
        options = {"version": self.spz_version} if self.spz_version else {}
        self.out.parent.mkdir(parents=True, exist_ok=True)
        mark = formats.mark(isinstance(model.low_pass, Antialiasing))
        count = sx.save(self.out, edited, comments=(mark,), **options)
        before, after = model.path.stat().st_size, self.out.stat().st_size
        share = f"{before / after:.1f} x smaller" if after <= before else f"{after / before:.1f} x larger"
        say(f"{self.out}: {count:,} Gaussians, {after / 1e6:.2f} MB ({share})")
        say(f"loses: {formats.format_of(self.out).LOSES}")

    def _selected(self, model: Model, dataset: sx.Dataset | None) -> sx.Gaussians:
        gaussians = model.gaussians
        if self.merge:
            gaussians = editing.merge([gaussians, *map(sx.load, self.merge)])
        if self.clean:
            gaussians, removed = editing.clean(gaussians, weights=self._weights(model, gaussians, dataset))
            say("cleaned: " + ", ".join(f"{count:,} {reason}" for reason, count in removed.items()))
        if self.crop_box:
            gaussians = editing.crop(gaussians, editing.Box(self.crop_box[:3], self.crop_box[3:]))
        if self.crop_sphere:
            gaussians = editing.crop(gaussians, editing.Sphere(self.crop_sphere[:3], self.crop_sphere[3]))
        if self.simplify is not None and self.simplify < len(gaussians):
            weights = self._weights(model, gaussians, dataset)
            gaussians = editing.simplify(gaussians, self.simplify, weights=weights)
        return gaussians

    def _weights(self, model: Model, gaussians: sx.Gaussians, dataset: sx.Dataset | None):
        if dataset is None:
            return None
        cameras = [view.camera for view in dataset.train]
        backend = resolve_backend(self.backend)
        return editing.visible_weights(gaussians, cameras, low_pass=model.low_pass, backend=backend)

    def _place(self, dataset: sx.Dataset | None) -> Similarity | None:
        """Where the scene goes; None if it stays, bit by bit."""
        if not self.up and (self.rotate, self.scale, self.move) == ((0, 0, 0), 1, (0, 0, 0)):
            return None
        place = Similarity.of(degrees=self.rotate, scale=self.scale, move=self.move)
        if self.up and dataset:
            place = place.after(editing.level([view.camera for view in dataset.views]))
        return place

    def _measure(self, model: Model, dataset: sx.Dataset, place: Similarity | None) -> None:
        views = views_of(dataset, "test" if dataset.test else "train", self.scene or Path())
        background = background_of(model.options)
        backend = resolve_backend(self.backend)
        before, after = (
            sx.evaluate(g, v, background=background, low_pass=model.low_pass, backend=backend)
            for g, v in ((model.gaussians, views), (sx.load(self.out), moved(views, place)))
        )
        kind = "test" if dataset.test else "training"
        say(f"PSNR of {len(views)} {kind} views: {before.psnr:.3f} dB before, {after.psnr:.3f} dB after")


def moved(views: tuple[sx.View, ...], place: Similarity | None) -> tuple[sx.View, ...]:
    """Views whose cameras go where the scene goes."""
    if place is None:
        return views
    return tuple(replace(view, camera=place.transform_camera(view.camera)) for view in views)
