"""`splatax create`: from photos to a page, in one command."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from splatax import web
from splatax.cli.checkpoints import files
from splatax.cli.page import Page
from splatax.cli.reconstruct import Reconstruct
from splatax.cli.train import Train
from splatax.errors import InputError
from splatax.io.datasets import is_capture


@dataclass(frozen=True)
class Create:
    """Make a page that anyone can open, from photos, a video, or a capture.

    Finds out where the photos were taken (OUT/capture), trains a scene on them (OUT/run), and writes
    OUT/scene.html. Stopped and started again, it goes on where it was.
    """

    photos: tyro.conf.Positional[Path]
    """Folder of photos, a video, or a capture, whose cameras are known already."""
    out: Path
    """Folder for all that is made."""
    budget: str = "10min"
    """Time to train for, such as 90s, 10min or 1h."""
    title: str | None = None
    """Of the page. Without it: the name of OUT."""

    def run(self) -> None:
        web.require_viewer()  # before an hour of work, not after it
        if not self.photos.exists():
            raise InputError(f"{self.photos}: no such folder or file.")
        capture = self.photos if is_capture(self.photos) else self.reconstructed()
        run, page = self.out / "run", self.out / "scene.html"
        train(capture, run, self.budget)
        if files(run):
            print("stopped. To go on: the same command again")
            return
        Page(run, page, scene=capture, title=self.title or self.out.resolve().name, overwrite=True).run()
        print(f"open it with a double click: {page}")

    def reconstructed(self) -> Path:
        """The capture of the photos, made if it is not there yet."""
        capture = self.out / "capture"
        if not is_capture(capture):
            Reconstruct(self.photos, capture).run()
        return capture


def train(capture: Path, run: Path, budget: str) -> None:
    """Trains a scene, or goes on with it, if that is not done yet."""
    if files(run):
        Train(resume=run).run()
    elif not (run / "scene.ply").exists():
        Train(capture, out=run, budget=budget).run()
