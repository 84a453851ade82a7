"""`splatax create`: from photos to a page, in one command."""

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatax import web
from splatax.cli.interruption import resumable
from splatax.cli.options import OverwriteFlag, TextOption, parsed
from splatax.cli.output import say
from splatax.cli.page import Page
from splatax.cli.reconstruct import Reconstruct
from splatax.cli.train import Train
from splatax.cli.train_options import Limits, Rerun
from splatax.errors import InputError
from splatax.io.datasets import is_capture
from splatax.reconstruction.work import refuse_overlap
from splatax.runs.budget import parse_seconds
from splatax.runs.checkpoints import files
from splatax.runs.claim import claimed
from splatax.runs.records import read_record, typed_fields, understood, write_json

ORDER = "create.json"  # in OUT, once there is a capture: the input of the remaining stages


@dataclass(frozen=True)
class Order:
    """The input of an output folder of `create`.

    Attributes:
        photos: absolute path of the photos, video or capture.
        seconds: time of training.
    """

    photos: str
    seconds: float


@dataclass(frozen=True)
class Create:
    """Make a web page from photos, a video, or a capture.

    Estimates the camera poses (OUT/capture), trains a scene (OUT/run), and writes OUT/scene.html. If
    interrupted, run the same command again to resume.
    """

    photos: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photos, a video, or a capture, whose cameras are known already."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Output folder."""
    budget: Annotated[str, tyro.conf.arg(metavar="TIME")] = "10min"
    """Training time, for example 90s, 10min or 1h. Estimating the cameras takes additional time."""
    title: TextOption = None
    """Title of the page and the report. By default the name of the output folder."""
    overwrite: OverwriteFlag = False
    """Start over and overwrite existing results in the output folder."""

    def run(self) -> None:
        web.require_viewer()  # before an hour of work, not after it
        self.refuse_what_cannot_be_made()
        with claimed(self.out):
            self.refuse_what_was_made_otherwise()
            self.make()

    def make(self) -> None:
        """Runs the stages that are not done yet."""
        run, page = self.out / "run", self.out / "scene.html"
        with resumable():
            capture = self.photos if is_capture(self.photos) else self.reconstructed()
            write_json(self.out / ORDER, asdict(self.order()))
            self.train(capture, run)
            if files(run):
                raise KeyboardInterrupt  # training has handled it, and saved the run
            Page(run, page, scene=capture, title=self.named(), overwrite=True).run()
        say(f"Done. Double-click {page} to open it.")

    def refuse_what_cannot_be_made(self) -> None:
        """Raises InputError before any work is done."""
        if not self.photos.exists():
            raise InputError(f"{self.photos}: no such folder or file.")
        if not is_capture(self.photos):
            refuse_overlap(self.photos, self.out / "capture")
        parsed("budget", self.budget, parse_seconds)
        if self.out.exists() and not self.out.is_dir():
            raise InputError(f"{self.out}: a file, not a folder. Choose another --out.")

    def refuse_what_was_made_otherwise(self) -> None:
        """Raises InputError if the folder holds the results of other photos or of another budget."""
        if self.overwrite or not (self.out / ORDER).exists():
            return
        way_out = "Replace what is there: --overwrite, or choose another --out."
        with understood(self.out / ORDER, way_out):
            earlier, now = Order(**typed_fields(Order, read_record(self.out / ORDER, way_out))), self.order()
        replacing = "or replace it: --overwrite"
        if earlier.photos != now.photos:
            raise InputError(f"{self.out}: made from {earlier.photos}. Choose another --out, {replacing}.")
        if earlier.seconds != now.seconds:
            capture = self.photos if is_capture(self.photos) else self.out / "capture"
            raise InputError(
                f"{self.out}: trained for {earlier.seconds:g} s, not {now.seconds:g} s. Train with the "
                f"same cameras in another folder: splatax create {capture} --out OTHER, {replacing}."
            )

    def named(self) -> str:
        """Returns the title of the page and the report."""
        return self.title or self.out.resolve().name

    def order(self) -> "Order":
        """Returns the input that the options describe."""
        return Order(str(self.photos.resolve()), parsed("budget", self.budget, parse_seconds))

    def reconstructed(self) -> Path:
        """Returns the capture of the photos, and makes it if it does not exist yet."""
        capture = self.out / "capture"
        if self.overwrite or not is_capture(capture):
            Reconstruct(self.photos, capture, overwrite=self.overwrite).run()
        return capture

    def train(self, capture: Path, run: Path) -> None:
        """Trains a scene, or resumes that. The report is the last file that training writes."""
        if files(run) and not self.overwrite:
            Train(rerun=Rerun(resume=run)).run()
        elif (run / "report.html").exists() and not self.overwrite:
            say(f"trained already: {run / 'scene.ply'}")
        else:
            Train(
                capture, out=run, title=self.named(), overwrite=True, limits=Limits(budget=self.budget)
            ).run()
