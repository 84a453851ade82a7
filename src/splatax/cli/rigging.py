"""A run of `splatax rig`, from a capture, a body and its poses to its results."""

import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np

import splatax as sx
from splatax.cli.display import Display
from splatax.cli.interruption import Interruption
from splatax.cli.options import BackgroundName, flag, parsed
from splatax.cli.output import say
from splatax.dataset import Dataset
from splatax.digests import file_digest
from splatax.errors import InputError
from splatax.evaluation import require_scorable
from splatax.gaussians import Gaussians
from splatax.io.files import write_whole
from splatax.io.rigs import read_body, save_rigged
from splatax.io.rigs.poses import Posing, along_clip, read_poses, write_poses
from splatax.low_pass import low_pass_of
from splatax.order import Order
from splatax.rendering import Color
from splatax.report.rigged import posed_comparisons, rig_report, seen_by
from splatax.runs.checkpoints import Checkpoints
from splatax.runs.claim import claimed_for_run, require_space
from splatax.runs.history import History
from splatax.runs.resume import Earlier, facts
from splatax.scene.binding import covering
from splatax.scene.body import Body
from splatax.scene.rigged import RiggedScene
from splatax.scene.skin import Rig
from splatax.training import checkpoint
from splatax.training.backgrounds import BACKGROUNDS
from splatax.training.recipes import Recipe, room_for
from splatax.training.rigged import (
    REFINED,
    RigProgress,
    RigRun,
    optimize_rig,
    recipe_for,
    result_of,
    state_shapes,
)

RIGGED, POSES = "rigged.glb", "poses.json"
Refine = Literal[*REFINED]  # type: ignore[valid-type]
COMMAND = "rig"
LOWEST = {"steps": 1, "max_gaussians": 1, "seed": 0, "checkpoint_every": 0, "checkpoint_steps": 0}


@dataclass(frozen=True)
class RigSettings:
    """Options of a run with all defaults filled in: what its checkpoints record."""

    scene: Path
    skeleton: Path
    poses: str
    steps: int = 1_500
    max_gaussians: int | None = None
    refine: Refine = "none"
    background: BackgroundName | None = None
    low_pass: str | None = None
    order: Order | None = None
    seed: int = 0
    checkpoint_every: float = 120.0
    checkpoint_steps: int = 0

    def check(self) -> None:
        """Raises InputError if a value makes no sense."""
        for name, least in LOWEST.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{flag(name)}: at least {least}, not {value}.")
        if self.low_pass:
            parsed("low_pass", self.low_pass, low_pass_of)

    def absolute(self) -> "RigSettings":
        """Returns the settings with absolute paths: a run may be resumed from elsewhere."""
        poses = str(Path(self.poses).absolute()) if self.poses.endswith(".json") else self.poses
        return replace(self, scene=self.scene.absolute(), skeleton=self.skeleton.absolute(), poses=poses)

    def most(self, dataset: Dataset) -> int:
        """Returns the number of Gaussians at the end."""
        return self.max_gaussians or room_for(dataset)

    def to_recipe(self, dataset: Dataset) -> Recipe:
        """Returns the recipe that the options describe, for a capture."""
        recipe = recipe_for(self.steps, self.most(dataset), self.seed)
        drawing = recipe.drawing
        if background := self.background or dataset.background:
            drawing = replace(drawing, background=BACKGROUNDS[background])
        if self.low_pass:
            drawing = replace(drawing, low_pass=low_pass_of(self.low_pass))
        if self.order:
            drawing = drawing.in_order(self.order)
        return replace(recipe, drawing=drawing)


NAMES = {field.name for field in fields(RigSettings)}


@dataclass(frozen=True)
class Subject:
    """The photos of a run, the body that they show, and its poses."""

    dataset: Dataset
    body: Body
    posing: Posing


def train_rig(
    settings: RigSettings, out: Path, *, replace_earlier: bool, earlier: Earlier | None = None
) -> None:
    """Trains a rigged scene, and writes the results.

    Args:
        settings: of the run.
        out: folder of the run.
        replace_earlier: whether what an earlier run has written there may be replaced.
        earlier: the run to resume.

    Raises:
        InputError: if a setting makes no sense, a file cannot be read or written, or a run cannot be resumed.
    """
    settings.check()
    settings = settings.absolute()
    subject = loaded(settings)
    dataset, posing = subject.dataset, subject.posing
    recipe = settings.to_recipe(dataset)
    about = facts_of_rig(settings, recipe, dataset)
    start: tuple[Gaussians, Rig] | RigRun
    start = covering(subject.body, max(settings.most(dataset) // 2, 1), seed=settings.seed)
    if earlier:
        start = resumed(earlier, about, recipe, start[1], len(posing.poses))
    with claimed_for_run(out, replace_earlier):
        require_space(out, settings.most(dataset))
        history = earlier.history if earlier else History()
        checkpoints = Checkpoints(
            out,
            about,
            seconds=settings.checkpoint_every,
            steps=settings.checkpoint_steps,
            earlier=earlier.path if earlier else None,
        )
        with checkpoints:
            last = trained(subject, recipe, start, settings, history, checkpoints)
            scene = RiggedScene(last.gaussians, last.rig, subject.body.clips)
            found = Posing(last.poses, posing.pose_of)
            write(out, scene, found, dataset, recipe.drawing.background.rgb, history)
            if history.interrupted:
                say(f"stopped at step {last.step:,}. Resume it: splatax rig --resume {out}")
            else:
                checkpoints.discard()


def loaded(settings: RigSettings) -> Subject:
    """Returns the photos, the body and its poses; prints the notes on their files."""
    body = read_body(settings.skeleton)
    dataset = sx.load_dataset(settings.scene)
    for note in (*body.notes, *dataset.notes):
        say(f"note    {note}")
    require_scorable(dataset.test)
    return Subject(dataset, body, posing_of(settings, body, dataset))


def facts_of_rig(settings: RigSettings, recipe: Recipe, dataset: Dataset) -> dict[str, Any]:
    """Returns what a run is made of; see `runs.resume.facts`."""
    about = facts({**asdict(settings), "command": COMMAND}, recipe, dataset)
    about["capture"] |= {"skeleton": file_digest(settings.skeleton)}
    if settings.poses.endswith(".json"):
        about["capture"] |= {"poses": file_digest(Path(settings.poses))}
    return about


def trained(
    subject: Subject,
    recipe: Recipe,
    start: tuple[Gaussians, Rig] | RigRun,
    settings: RigSettings,
    history: History,
    checkpoints: Checkpoints,
) -> RigProgress:
    """Makes the steps that are left, and returns the last one; the history grows with them."""
    dataset, posing = subject.dataset, subject.posing
    if isinstance(start, RigRun):
        if int(start.train.step) >= settings.steps:
            say(f"writing the results after step {settings.steps:,}")
            return result_of(start, recipe, posing.poses, history.losses[-1])
        say(f"resuming after step {history.steps:,} of {settings.steps:,}")
    learned = REFINED[settings.refine]
    steps = optimize_rig(dataset, recipe, start, posing.poses, posing.pose_of, learned)
    return followed(steps, settings.steps, history, checkpoints)


def followed(
    run: Iterator[RigProgress], total: int, history: History, checkpoints: Checkpoints
) -> RigProgress:
    """Makes the steps of a run with a progress bar, saves it now and then, and returns its last step.

    Ctrl-C ends training after the current step.
    """
    began = time.perf_counter() - history.train_seconds
    last = None
    with Display(total) as display, Interruption() as interruption:
        display.announce("compiling the first step")
        for last in run:
            history.losses.append(last.loss)
            history.counts.append(last.count)
            history.interrupted = interruption.requested and last.step < total
            if checkpoints.due(last.step) or history.interrupted or last.step == total:
                last.loss.block_until_ready()
                history.train_seconds = time.perf_counter() - began
                checkpoints.save(last.run, history)
            display.step(last.step, last.loss, last.count)
            if history.interrupted:
                break
    assert last
    history.train_seconds = time.perf_counter() - began
    return last


def resumed(earlier: Earlier, now: Mapping[str, Any], recipe: Recipe, rig: Rig, poses: int) -> RigRun:
    """Returns the run that a checkpoint holds.

    Raises:
        InputError: if capture, body, poses or recipe are not those of the run.
    """

    def restore() -> RigRun:
        rows = checkpoint.rows_of(checkpoint.stored_in(earlier.checkpoint))
        state, count = checkpoint.restored(earlier.checkpoint, state_shapes(rows, rig, recipe, poses))
        return RigRun(state, count, rig)

    return earlier.restored(now, restore)


def posing_of(settings: RigSettings, body: Body, dataset: Dataset) -> Posing:
    """Returns the poses of the photos, from the file or the clip.

    Raises:
        InputError: if it is neither.
    """
    if settings.poses in body.clips:
        names = [view.name for view in dataset.views]
        return along_clip(body.clips[settings.poses], body.skeleton.rest, names)
    if not settings.poses.endswith(".json"):
        clips = ", ".join(body.clips) or "none"
        raise InputError(
            f"--poses {settings.poses}: neither a .json file nor a clip of {settings.skeleton}, "
            f"which has: {clips}."
        )
    return read_poses(Path(settings.poses), body.skeleton, body.clips)


def write(
    out: Path,
    scene: RiggedScene,
    posing: Posing,
    dataset: Dataset,
    background: Color,
    history: History,
) -> None:
    """Writes the files of a run, and prints its scores and where they are."""
    save_rigged(out / RIGGED, scene)
    sx.save(out / "scene.ply", scene.gaussians)
    write_poses(out / POSES, posing, scene.rig.skeleton)
    galleries = {
        kind: seen_by(posed_comparisons(scene, posing, views, background))
        for kind, views in (("held-out", dataset.test), ("training", dataset.train))
    }
    scores = {
        name: {score.name: score.psnr for score in galleries[kind].scores}
        for name, kind in (("train", "training"), ("test", "held-out"))
    }
    found = {name: float(np.mean(list(values.values()))) for name, values in scores.items() if values}
    written = {"steps": history.steps, "gaussians": len(scene.gaussians), "psnr": found, "photos": scores}
    write_whole(out / "metrics.json", json.dumps(written, indent=1).encode())
    title = out.resolve().name
    write_whole(out / "report.html", rig_report(title, galleries, history, dataset.notes))
    for name, value in found.items():
        say(f"{name:5} PSNR {value:.2f} dB over {len(scores[name])} photos")
    say(f"scene   {out / RIGGED}")
    say(f"report  {out / 'report.html'}")
