"""`splatax inspect`: the data doctor."""

import sys
from dataclasses import dataclass, replace
from pathlib import Path

import tyro
from rich.table import Table
from rich.text import Text

from splatax.cli.options import Downscale, load_scene
from splatax.cli.output import cell, say, show
from splatax.errors import InputError
from splatax.inspection import examine, problems_of, seconds_to_train
from splatax.io import images
from splatax.io.datasets import DATASETS, folder_of
from splatax.io.files import write_whole
from splatax.report.capture import capture_page, facts_of, verdict

COLORS = {"error": "red", "warning": "yellow"}


@dataclass(frozen=True)
class Inspect:
    """Look at a capture before training: what there is, what is wrong with it, and how to repair that.

    Forecasts the memory and the time that training would take here. Writes a page with all photos, and
    cameras and points in a picture. Photos that have no poses yet are judged alone. Exit code 1 if a
    problem stops training or will spoil the scene.
    """

    scene: tyro.conf.Positional[Path]
    """Folder of the capture or of photos, or a zip file of a capture."""
    out: Path | None = None
    """HTML file for the page. Without it: runs/NAME/inspect.html, with the name of the folder."""
    downscale: Downscale = "auto"
    """Divide the size of photos by this. "auto": the least that brings them to 1600 pixels."""

    def run(self) -> None:
        folder = folder_of(self.scene)
        known = any(loader.recognise(folder) for loader in DATASETS)
        if not known and not any(images.is_image(path) for path in folder.rglob("*")):
            load_scene(self.scene, self.downscale)  # says what it looked for
        dataset = load_scene(self.scene, self.downscale) if known else None
        found = examine(self.scene if known else folder, dataset)
        if dataset is not None:
            say("measuring the speed of this machine ...")
            found = replace(found, seconds=seconds_to_train(dataset, found.gaussians))
        problems = problems_of(found)
        table = Table(box=None, show_header=False, pad_edge=False)
        for label, value in facts_of(found):
            table.add_row(label, cell(value))
        show(table)
        show(cell(f"\n{verdict(problems)}", "bold"))
        for problem in problems:
            color = COLORS[problem.severity]
            show(Text.assemble((problem.severity, color), "  ", cell(problem.what)))
            show(cell(f"   -> {problem.fix}"))
        out = self.out or Path("runs") / self.scene.resolve().name / "inspect.html"
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
            write_whole(out, capture_page(found, problems).encode())
        except OSError as error:
            raise InputError(f"{out}: cannot be written ({error.strerror}). Choose another --out.") from error
        say(f"page    {out}")
        if any(problem.severity == "error" for problem in problems):
            sys.exit(1)
