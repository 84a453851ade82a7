"""`splatax demo`: a scene out of nothing, to see that all works."""

from dataclasses import dataclass
from pathlib import Path

from splatax import web
from splatax.cli.output import say
from splatax.cli.page import Page
from splatax.cli.train import Train
from splatax.cli.train_options import Limits, Method, Saving
from splatax.demo.capture import write_capture
from splatax.demo.dataset import PHOTOS, SIZE
from splatax.errors import InputError
from splatax.runs.claim import claimed_for_run

TITLE = "splatax demo"


@dataclass(frozen=True)
class Demo:
    """Photograph a procedural still life, train on the photos, and write a page that shows the scene.

    Needs no data. The capture is left in OUT/capture, in COLMAP's layout; the rest is as `splatax
    train` writes it.
    """

    out: Path = Path("runs/demo")
    """Folder for the capture and the results."""
    steps: int = 2_000
    """How many photos to learn from, one after the other."""
    seed: int = 0
    """Of all randomness."""
    overwrite: bool = False
    """Replace the results of an earlier run in the same folder."""

    def run(self) -> None:
        capture = self.out / "capture"
        with claimed_for_run(self.out, self.overwrite):
            say(f"drawing {PHOTOS} photos of {SIZE[0]} x {SIZE[1]} pixels into {capture}")
            write_capture(capture)
        Train(
            capture,
            self.out,
            title=TITLE,
            overwrite=True,
            limits=Limits(steps=self.steps),
            method=Method(seed=self.seed),
            saving=Saving(eval_every=max(self.steps // 8, 1)),
        ).run()
        try:
            web.require_viewer()
        except InputError as error:
            say(f"no page of the scene: {error}")
            return
        page = self.out / "scene.html"
        Page(self.out, page, scene=capture, title=TITLE, overwrite=True).run()
        say(f"open it with a double click: {page}")
