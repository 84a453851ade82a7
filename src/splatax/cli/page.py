"""`splatax page`: a scene as one HTML file that opens with a double click."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import tyro

from splatax import web
from splatax.camera import Camera
from splatax.cli.options import BackgroundName, LowPassName, Model, background_of, load_scene, read_model
from splatax.cli.output import say
from splatax.errors import InputError

SUFFIXES = (".html", ".htm")


@dataclass(frozen=True)
class Page:
    """Write a page that shows a scene in any browser.

    One HTML file, which needs no server and no network: double-click it, mail it, or put it on a web
    site.
    """

    model: tyro.conf.Positional[Path]
    """A splat file, or the folder of a run."""
    out: tyro.conf.Positional[Path]
    """The page to write, .html."""
    scene: Path | None = None
    """Folder of the capture: its cameras become places to look from. Without it, one looks from outside."""
    title: str | None = None
    """Of the page. Without it: the name of the model's folder or file."""
    background: BackgroundName | None = None
    """Behind the scene. Without it: as trained, else black."""
    low_pass: LowPassName | None = None
    """Without it: as the file says."""
    overwrite: bool = False
    """Replace the file if there is one."""

    def run(self) -> None:
        if not is_page(self.out):
            raise InputError(f"{self.out}: browsers open .html files. Give the page such a name.")
        if self.out.exists() and not self.overwrite:
            raise InputError(f"{self.out}: exists. Choose another name, or replace it: --overwrite.")
        model = read_model(self.model, self.low_pass)
        views = load_scene(self.scene, None, model).views if self.scene else ()
        cameras = {view.name: view.camera for view in views}
        write_page(self.out, model, cameras, self.title, self.background)


def is_page(path: Path) -> bool:
    """Whether the name is that of a page."""
    return path.suffix.lower() in SUFFIXES


def write_page(
    out: Path, model: Model, cameras: Mapping[str, Camera], title: str | None, background: str | None
) -> None:
    """Writes the page of a model, and says how large it is.

    Args:
        out: the page.
        model: with the Gaussians to show.
        cameras: in the same coordinates, by name; may be empty.
        title: without one, the name of the model's folder or file.
        background: without one, as the model was trained.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    web.save(
        out,
        model.gaussians,
        title=title or _name(model.path),
        cameras=cameras,
        background=background_of(model.options, background),
        low_pass=model.low_pass,
    )
    size = out.stat().st_size / 1e6
    say(f"{out}: {len(model.gaussians):,} Gaussians, {len(cameras)} cameras, {size:.1f} MB")


def _name(path: Path) -> str:
    path = path.resolve()
    return path.parent.name if path.name == "scene.ply" else path.name.split(".")[0]
