"""`splatax demo`: a synthetic scene, to see that everything works."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatax import web
from splatax.cli.options import OverwriteFlag, shown_as
from splatax.cli.output import say
from splatax.cli.page import Page
from splatax.cli.train import Train
from splatax.cli.train_options import Drawing, Limits, Method, Saving
from splatax.demo.capture import write_capture
from splatax.demo.scene import SIZE
from splatax.demo.scenes import DEFAULT, SCENES
from splatax.errors import InputError
from splatax.runs.claim import claimed_for_run

TITLE = "splatax demo"
SceneName = Literal[*SCENES]  # type: ignore[valid-type]


@dataclass(frozen=True)
class Demo:
    """Render a synthetic scene, train on it and build its page.

    Needs no data. OUT/capture holds the capture in COLMAP's layout; the other files are those of `splatax
    train`.
    """

    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = Path("runs/demo")
    """Output folder for the capture and the results."""
    scene: Annotated[SceneName, shown_as()] = DEFAULT
    """Scene to draw. "still-life": objects on a table; "room": a room seen all around from inside; "object":
    a toy on transparent ground; "outdoor": a monument under an open sky; "thin": rods and wires; "glossy":
    chrome and lacquer."""
    steps: Annotated[int, tyro.conf.arg(metavar="N")] = 2_000
    """Number of training steps; each step uses one photo."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    overwrite: OverwriteFlag = False
    """Replace the results of an earlier run in the output folder."""

    def run(self) -> None:
        capture, scene = self.out / "capture", SCENES[self.scene]
        title = TITLE if self.scene == DEFAULT else f"{TITLE}, {self.scene}"
        with claimed_for_run(self.out, self.overwrite):
            say(f"rendering {scene.photos} photos of {SIZE[0]} x {SIZE[1]} pixels into {capture}")
            write_capture(capture, scene)
        Train(
            capture,
            self.out,
            title=title,
            overwrite=True,
            limits=Limits(steps=self.steps),
            method=Method(seed=self.seed),
            drawing=Drawing(background=scene.background),
            saving=Saving(eval_every=max(self.steps // 8, 1)),
        ).run()
        try:
            web.require_viewer()
        except InputError as error:
            say(f"no page of the scene: {error}")
            return
        page = self.out / "scene.html"
        Page(self.out, page, scene=capture, title=title, overwrite=True).run()
        say(f"Done. Double-click {page} to open it.")
