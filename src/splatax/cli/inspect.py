"""`splatax inspect`: problems of a capture, before training."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.table import Table
from rich.text import Text

from splatax.cli.options import Downscale, PathOption, load_scene
from splatax.cli.output import cell, say, show
from splatax.errors import InputError
from splatax.inspection import examine, forecasted, problems_of
from splatax.io.datasets import folder_of, reader_of
from splatax.io.files import write_whole
from splatax.reconstruction.photos import files_of
from splatax.reconstruction.work import refuse_without_photos
from splatax.report.capture import capture_page, facts_of, verdict

COLORS = {"error": "red", "warning": "yellow"}


@dataclass(frozen=True)
class Inspect:
    """Check a capture before training: list its contents, find problems and suggest fixes.

    Forecasts the memory and the time that training would take on this machine. Writes an HTML page that lists
    every photo, with a plot of cameras and points. Without poses, only the photos themselves are checked. The
    exit code is 1 if a problem would prevent training or ruin the result.
    """

    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """Folder of the capture or of photos, or a zip file of a capture."""
    out: PathOption = None
    """HTML file for the page. By default runs/NAME/inspect.html, with the name of the folder."""
    downscale: Annotated[Downscale, tyro.conf.arg(metavar="{auto,N}")] = "auto"
    """Divide the width and height of photos by this number. "auto": the smallest factor that brings the long
    side down to 1600 pixels."""

    def run(self) -> None:
        folder = folder_of(self.scene)
        known = reader_of(folder) is not None
        if not known:
            photos, others = files_of(folder)
            if others and not photos:
                refuse_without_photos(folder, list(others))
            if not photos:
                load_scene(self.scene, self.downscale)  # says what it looked for
        dataset = load_scene(self.scene, self.downscale) if known else None
        found = examine(self.scene if known else folder, dataset)
        if dataset is not None:
            say("measuring the speed of this machine ...")
            found = forecasted(found)
        problems = problems_of(found)
        table = Table(box=None, show_header=False, pad_edge=False)
        for label, value in facts_of(found):
            table.add_row(label, cell(value))
        show(table)
        say("")
        show(cell(verdict(problems), "bold"))
        for problem in problems:
            color = COLORS[problem.severity]
            show(Text.assemble((problem.severity, color), "  ", cell(problem.what)))
            show(cell(f"   -> {problem.fix}"))
        if dataset is None:
            say(f"to find the poses: splatax reconstruct {self.scene} --out SCENE")
        out = self.out or Path("runs") / self.scene.resolve().name / "inspect.html"
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            write_whole(out, capture_page(found, problems).encode())
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({error.strerror}). Choose another --out.") from error
        say(f"page    {out}")
        if any(problem.severity == "error" for problem in problems):
            sys.exit(1)
