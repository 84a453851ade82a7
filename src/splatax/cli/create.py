"""`splatax create`: from photos to a page, in one command."""

import time
import webbrowser
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Annotated

import tyro

from splatax import web
from splatax.cli.interruption import resumable
from splatax.cli.options import OverwriteFlag, TextOption, given, load_scene, parsed, shown_as
from splatax.cli.orders import Order, refuse_other_options, refuse_place_of_capture
from splatax.cli.output import say
from splatax.cli.page import Page
from splatax.cli.preparing import POINTS, found_points
from splatax.cli.reconstruct import FindingCameras, Reconstruct
from splatax.cli.settings import NAMES, Settings
from splatax.cli.train import Train, limited
from splatax.cli.train_options import Devices, Drawing, Limits, Live, Method, Photos, Rerun, Saving
from splatax.dataset import Dataset, photos_in
from splatax.errors import InputError
from splatax.io.datasets import is_capture
from splatax.io.datasets.photos import counted
from splatax.reconstruction.work import refuse_among, refuse_overlap
from splatax.runs.budget import duration, parse_seconds
from splatax.runs.checkpoints import files
from splatax.runs.claim import claimed
from splatax.runs.records import as_json, read_record, typed_fields, understood, write_json
from splatax.training.recipes import PRESETS, steps_for

ORDER = "create.json"  # in OUT, once there is a capture: the input of the remaining stages
BUDGET = "10min"  # by default
TRIAL = 1 / 6  # fraction of the training time that a trial run takes, by whose score the scene is judged
PAGE_SECONDS = 10.0  # to write the page, of the time of a whole command
NOT_ORDERED = {"images", "out", "title", "overwrite", "open", "view", "host", "port"}  # change no result


@dataclass(frozen=True)
class Create:
    """Make a web page from photos, a video, or a capture.

    Estimates the camera poses (OUT/capture), trains a scene on all photos (OUT/run), and writes
    OUT/scene.html. Before that, a trial run (OUT/trial) takes a sixth of the training time and holds out some
    of the photos; the report gives its score on them. If interrupted, run the same command again to resume.
    """

    images: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="PHOTOS")]
    """Folder of photos, a video, or a capture (photos with camera poses)."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")]
    """Output folder."""
    title: TextOption = None
    """Title of the page and the report. By default the name of the output folder."""
    open: Annotated[bool, shown_as()] = False
    """Open the page in the browser at the end."""
    overwrite: OverwriteFlag = False
    """Start over and overwrite existing results in the output folder."""
    cameras: FindingCameras = FindingCameras()
    photos: Photos = Photos()
    limits: Limits = Limits()
    devices: Devices = Devices()
    method: Method = Method()
    drawing: Drawing = Drawing()
    saving: Saving = Saving()
    live: Live = Live()

    def run(self) -> None:
        began = time.monotonic()
        web.require_viewer()  # checked first: the work may take an hour
        self.refuse_what_cannot_be_made()
        with claimed(self.out):
            self.refuse_what_was_made_otherwise()
            self.make(began)

    def make(self, began: float) -> None:
        """Runs the stages that are not done yet.

        Args:
            began: time at which the command began, of the monotonic clock.
        """
        run, page = self.out / "run", self.out / "scene.html"
        with resumable():
            capture = self.images if is_capture(self.images) else self.reconstructed()
            write_json(self.out / ORDER, asdict(self.order()))
            if not self.trained(run):
                self.train(capture, run, began)
            Page(run, page, scene=capture, title=self.named(), overwrite=True).run()
        say(f"Done. Double-click {page} to open it.")
        if self.open:
            webbrowser.open(page.resolve().as_uri())

    def train(self, capture: Path, out: Path, began: float) -> None:
        """Trains on all photos, after a trial run that measures how good such a scene is."""
        if files(out) and not self.overwrite:
            self.finish(out)
            return
        if self.settings().budget and not self.limits.budget:
            say(f"training for {BUDGET} in all. Choose another time: --budget, or a number of steps: --steps")
        photos, method = self.start(capture)
        run = Train(
            capture,
            out=out,
            title=self.named(),
            overwrite=True,
            photos=photos,
            limits=self.limits,
            devices=self.devices,
            method=method,
            drawing=self.drawing,
            saving=self.saving,
            live=self.live,
        )
        judge, had_trial = photos.judged_by, False
        if photos.hold_out is None:
            if judge is None:
                judge = self.tried(run, capture, began)
                had_trial = judge is not None
            run = replace(run, photos=replace(photos, hold_out="none", judged_by=judge))
        replace(run, limits=self.left(began, 1.0, had_trial)).run()
        self.stop_if_stopped(out)

    def tried(self, run: Train, capture: Path, began: float) -> Path | None:
        """Returns the folder of a trial run with held-out photos, trained if it is not there yet.

        None if the capture is too small to hold photos out.
        """
        trial = self.out / "trial"
        if self.trained(trial):
            return trial
        if files(trial) and not self.overwrite:
            self.finish(trial)
            return trial
        dataset = load_scene(capture, self.limits.downscale)
        if not dataset.test:
            every = photos_in(dataset.views)
            are = "is" if every == 1 else "are"
            say(f"{counted(every)} {are} too few to hold some out, so the scene has no score")
            return None
        unseen = f"{photos_in(dataset.test)} of {counted(photos_in(dataset.views))}"
        say(f"trial run without {unseen}, which tell how good a scene of these photos is")
        title, limits = f"{self.named()}, trial run", self.left(began, TRIAL)
        if self.steps_by_default:
            limits = replace(limits, steps=self.trial_steps(dataset))
            say(f"{limits.steps:,} steps, a sixth of those of the scene. Choose another number: --steps")
        replace(run, out=trial, title=title, limits=limits, live=Live()).run()
        self.stop_if_stopped(trial)
        return trial

    def left(self, began: float, fraction: float, had_trial: bool = False) -> Limits:
        """Returns the limits of one run.

        Args:
            began: time at which the command began.
            fraction: of the time that is left, for a limit of the whole command; of the training time for a
                trial run.
            had_trial: whether a trial run has taken its part of the training time.
        """
        limits, part = self.limits, (1 - TRIAL if had_trial else fraction)
        if limits.within is not None:
            end = began + parsed("within", limits.within, parse_seconds) - PAGE_SECONDS
            return replace(limits, within=f"{max(fraction * (end - time.monotonic()), 1.0):.0f}s")
        if limits.steps is not None:
            return replace(limits, steps=max(round(limits.steps * fraction), 1))
        if self.steps_by_default:
            return limits
        seconds = parsed("budget", limits.budget or BUDGET, parse_seconds)
        return replace(limits, budget=f"{part * seconds:g}s")

    def trial_steps(self, dataset: Dataset) -> int:
        """Returns the number of steps of a trial run where none is given.

        Args:
            dataset: the capture, of which the scene is trained on all photos.
        """
        steps = -(-steps_for(replace(dataset, train=dataset.views)) // (self.devices.views or 1))
        return max(round(TRIAL * steps), 1)

    def finish(self, run: Path) -> None:
        """Resumes a run that was stopped.

        Raises:
            KeyboardInterrupt: if the user stops it again.
        """
        Train(rerun=Rerun(resume=run)).run()
        self.stop_if_stopped(run)

    def stop_if_stopped(self, run: Path) -> None:
        """Raises KeyboardInterrupt if a run has steps left: training has handled that, and saved the run."""
        if files(run):
            raise KeyboardInterrupt

    def trained(self, run: Path) -> bool:
        """Returns whether a run is there already. The report is the last file that training writes."""
        there = (run / "report.html").exists() and not files(run) and not self.overwrite
        if there:
            say(f"trained already: {run / 'scene.ply'}")
        return there

    def start(self, capture: Path) -> tuple[Photos, Method]:
        """Returns the options of both runs, with points to start from.

        If the capture has no points, they are found once, in all photos; if that fails, both runs start at
        random.
        """
        path = self.out / POINTS
        if self.photos.points is not None or self.method.init is not None:
            return self.photos, self.method
        if self.overwrite or not path.exists():
            dataset = load_scene(capture, self.limits.downscale)
            if len(dataset.points):
                return self.photos, self.method
            if found_points(capture, dataset.views, self.out, self.method.seed or 0) is None:
                return self.photos, replace(self.method, init="random")
        return replace(self.photos, points=path.absolute()), self.method

    def refuse_what_cannot_be_made(self) -> None:
        """Raises InputError before any work is done."""
        if not self.images.exists():
            raise InputError(f"{self.images}: no such folder or file.")
        if not is_capture(self.images):
            refuse_among(self.images, self.out)
            refuse_overlap(self.images, self.out / "capture")
        elif self.out.resolve().is_relative_to(self.images.resolve()):
            refuse_place_of_capture(self.out, self.images, load_scene(self.images, self.limits.downscale))
        if self.devices.hosts is not None:
            raise InputError(
                "--hosts: the stages of splatax create run in one process. Make the capture with splatax "
                "reconstruct, train it with splatax train --hosts, and write the page with splatax page."
            )
        self.cameras.check()
        limited(self.settings(), self.limits, 0.0)
        self.settings().check()
        if self.out.exists() and not self.out.is_dir():
            raise InputError(f"{self.out}: a file, not a folder. Choose another --out.")

    def refuse_what_was_made_otherwise(self) -> None:
        """Raises InputError if the folder holds the results of other photos or of other options."""
        if self.overwrite or not (self.out / ORDER).exists():
            return
        way_out = "Replace what is there: --overwrite, or choose another --out."
        with understood(self.out / ORDER, way_out):
            earlier, now = Order(**typed_fields(Order, read_record(self.out / ORDER, way_out))), self.order()
        if earlier.photos != now.photos:
            raise InputError(
                f"{self.out}: made from {earlier.photos}. Choose another --out, or replace it: --overwrite."
            )
        capture = self.images if is_capture(self.images) else self.out / "capture"
        refuse_other_options(self.out, earlier, now, self.images, capture)

    def named(self) -> str:
        """Returns the title of the page and the report."""
        return self.title or self.out.resolve().name

    @property
    def plannable(self) -> bool:
        """True if the steps of the recipe can be planned for a time."""
        return (self.devices.views or 1) == 1 and PRESETS[self.method.recipe or Settings.recipe].plannable

    @property
    def steps_by_default(self) -> bool:
        """True if `train` chooses the number of steps by the number of photos."""
        return not self.plannable and self.limits.steps is None

    def settings(self) -> Settings:
        """Returns the settings of a run with the given options.

        Raises:
            InputError: if an option makes no sense.
        """
        options = {name: value for name, value in given(self).items() if name in NAMES - NOT_ORDERED}
        if self.plannable and self.limits.steps is None and self.limits.within is None:
            options.setdefault("budget", BUDGET)
        return Settings(**options)

    def order(self) -> Order:
        """Returns the input that the options describe."""
        options = {name: value for name, value in given(self).items() if name not in NOT_ORDERED}
        if self.plannable and not options.keys() & {"steps", "within"}:
            options.setdefault("budget", BUDGET)
        for name in options.keys() & {"budget", "within"}:
            options[name] = duration(parsed(name, options[name], parse_seconds))
        return Order(str(self.images.resolve()), as_json(options))

    def reconstructed(self) -> Path:
        """Returns the capture of the photos, and makes it if it does not exist yet."""
        capture = self.out / "capture"
        if self.overwrite or not is_capture(capture):
            Reconstruct(
                self.images,
                capture,
                self.cameras,
                undistort=self.photos.undistort,
                seed=self.method.seed or 0,
                overwrite=self.overwrite,
            ).run()
        return capture
