"""`splatax page`: a scene as a single HTML file."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatax import web
from splatax.cameras import Camera
from splatax.cli.options import (
    BackgroundOption,
    LowPassOption,
    Model,
    OrderOption,
    OverwriteFlag,
    TextOption,
    background_of,
    load_scene,
    read_model,
    shown_as,
)
from splatax.cli.output import say
from splatax.errors import InputError
from splatax.io import formats

SUFFIXES = (".html", ".htm")


@dataclass(frozen=True)
class Page:
    """Write a web page that shows a scene in any browser.

    The page is a single HTML file: double-click it, attach it to an email, or put it on any web host.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run of splatax, INRIA's 3DGS or gsplat."""
    out: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE.html")]
    """The page to write."""
    scene: Annotated[Path | None, shown_as("CAPTURE")] = None
    """Folder of the capture, whose cameras become viewpoints. By default the camera starts outside the
    scene."""
    title: TextOption = None
    """Title of the page. By default the name of the model's folder or file."""
    background: BackgroundOption = None
    """Colour behind the scene. By default as in training, else black."""
    low_pass: LowPassOption = None
    """Anti-aliasing filter. By default the one that the file names."""
    order: OrderOption = None
    """Order in which splats are drawn. By default the one that the file names, else depth."""
    lod_above: Annotated[int, shown_as("N")] = web.LOD_ABOVE
    """Number of Gaussians above which the page opens with a preview of the scene, then draws with level of
    detail. By default 300,000."""
    overwrite: OverwriteFlag = False
    """Replace the file if it exists."""

    def run(self) -> None:
        if not is_page(self.out):
            raise InputError(f"{self.out}: browsers open .html files. Give the page such a name.")
        if self.out.exists() and not self.overwrite:
            raise InputError(f"{self.out}: exists. Choose another name, or replace it: --overwrite.")
        model = read_model(self.model, self.low_pass, self.order)
        views = load_scene(self.scene, None, model).standpoints if self.scene else ()
        cameras = {view.photo: view.camera for view in views}
        write_page(self.out, model, cameras, self.title, self.background, self.lod_above)


def is_page(path: Path) -> bool:
    """Returns whether a file name is that of a page."""
    return path.suffix.lower() in SUFFIXES


def tell_losses(path: Path) -> None:
    """Prints which precision a page or a splat file has lost."""
    say(f"loses: {web.LOSES if is_page(path) else formats.format_of(path).LOSES}")


def write_page(
    out: Path,
    model: Model,
    cameras: Mapping[str, Camera],
    title: str | None,
    background: str | None,
    lod_above: int = web.LOD_ABOVE,
) -> None:
    """Writes the page of a model, and prints its size and what it loses.

    Args:
        out: the page.
        model: with the Gaussians to show.
        cameras: in the same coordinates, by name; may be empty.
        title: without one, the name of the model's folder or file.
        background: without one, as the model was trained.
        lod_above: number of Gaussians above which the page has a preview and level of detail.
    """
    out.parent.mkdir(parents=True, exist_ok=True)
    web.save(
        out,
        model.gaussians,
        title=title or model.name,
        cameras=cameras,
        background=background_of(model.options, background),
        lod_above=lod_above,
    )
    size = out.stat().st_size / 1e6
    say(f"{out}: {len(model.gaussians):,} Gaussians, {len(cameras)} cameras, {size:.1f} MB")
    tell_losses(out)
