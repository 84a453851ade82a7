"""`splatax rig`: Gaussians that follow a skeleton, trained from photos in known poses."""

import hashlib
import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

import splatax as sx
from splatax.cli.display import Display
from splatax.cli.interruption import Interruption
from splatax.cli.options import BackgroundName, BackgroundOption, OverwriteFlag, flag, given, shown_as
from splatax.cli.output import say
from splatax.cli.settings import as_started
from splatax.cli.train_options import Count
from splatax.dataset import mask_of
from splatax.errors import InputError
from splatax.gaussians import Gaussians
from splatax.io.files import write_whole
from splatax.io.rigs import read_body, save_rigged
from splatax.io.rigs.poses import Posing, along_clip, read_poses, write_poses
from splatax.rendering import Color
from splatax.report.rigged import posed_comparisons, rig_report, seen_by
from splatax.runs.checkpoints import Checkpoints
from splatax.runs.claim import claimed_for_run
from splatax.runs.history import History
from splatax.runs.records import understood
from splatax.runs.resume import OTHER, Earlier, facts, find
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
MAY_CHANGE = {"checkpoint_every", "checkpoint_steps"}  # on resuming
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
    seed: int = 0
    checkpoint_every: float = 120.0
    checkpoint_steps: int = 0

    def check(self) -> None:
        """Raises InputError if a value makes no sense."""
        for name, least in LOWEST.items():
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{flag(name)}: at least {least}, not {value}.")

    def absolute(self) -> "RigSettings":
        """Returns the settings with absolute paths: a run may be resumed from elsewhere."""
        poses = str(Path(self.poses).absolute()) if self.poses.endswith(".json") else self.poses
        return replace(self, scene=self.scene.absolute(), skeleton=self.skeleton.absolute(), poses=poses)


NAMES = {field.name for field in fields(RigSettings)}


@dataclass(frozen=True)
class RigCommand:
    """Train Gaussians that follow a skeleton, from photos of it in known poses.

    Writes rigged.glb (splats with a skin, the skeleton and its clips), scene.ply (the splats in the bound
    pose), poses.json (the poses, refined if requested), metrics.json and report.html. Ctrl-C ends training
    early and saves the current result; --resume continues from there, or from the last checkpoint of a run
    that crashed, and produces the same scene as an uninterrupted run.
    """

    scene: Annotated[Path | None, tyro.conf.Positional, shown_as("CAPTURE")] = None
    """Folder of the capture, with cameras in the coordinates of the body."""
    skeleton: Annotated[Path | None, shown_as("BODY.glb")] = None
    """glTF file of the body: a mesh with its skeleton and clips. Training starts from Gaussians on its
    surface. Required, except with --resume."""
    poses: Annotated[str | None, shown_as("{CLIP,FILE.json}")] = None
    """Pose in each photo: a .json file (docs/rigs.md describes the format), or the name of a clip, whose
    duration is divided evenly among the photos in the order of their names. Required, except with
    --resume."""
    out: Annotated[Path | None, shown_as("FOLDER")] = None
    """Output folder. Required, except with --resume."""
    steps: Count = None
    """Number of training steps; each step uses one photo. By default 1500."""
    max_gaussians: Count = None
    """Number of Gaussians at the end. By default one for every 8 pixels of a photo, times the square root of
    the number of photos."""
    refine: Annotated[Refine | None, shown_as()] = None
    """Learn the weights, the rotations of the joints in each pose, or both, together with the Gaussians. Use
    it only if the given ones are inaccurate. By default none."""
    background: BackgroundOption = None
    """Colour behind photos with alpha. By default as the capture defines it, else random in training."""
    seed: Count = None
    """Random seed. By default 0."""
    checkpoint_every: Annotated[float | None, shown_as("SECONDS")] = None
    """Seconds between checkpoints. The last two are kept until the run has finished. By default 120; 0: only
    when the run is interrupted, and at its end."""
    checkpoint_steps: Count = None
    """Additionally save a checkpoint every N steps. By default 0: off."""
    resume: Annotated[Path | None, shown_as("RUN")] = None
    """Resume an interrupted run, given its folder or one of its checkpoint files. All other options are
    those of the earlier run."""
    overwrite: OverwriteFlag = False
    """Replace the results of an earlier run in the output folder."""

    def run(self) -> None:
        chosen = {name: value for name, value in given(self).items() if name in NAMES}
        if self.resume is not None:
            if self.out is not None:
                raise InputError("--out: a run is resumed in its own folder. Leave the option out.")
            earlier = find(self.resume, COMMAND)
            with understood(earlier.path, OTHER):
                settings = as_started(RigSettings, earlier.options, chosen, MAY_CHANGE)
            self._train(settings, earlier.run, earlier)
            return
        needed = {"skeleton": self.skeleton, "poses": self.poses, "out": self.out}
        missing = [flag(name) for name, value in needed.items() if value is None]
        if self.scene is None:
            missing.insert(0, "the folder of a capture")
        if missing or self.out is None:
            raise InputError(f"Missing: {', '.join(missing)}. Give them, or a run to resume: --resume RUN.")
        self._train(RigSettings(**chosen), self.out, None)

    def _train(self, settings: RigSettings, out: Path, earlier: Earlier | None) -> None:
        settings.check()
        settings = settings.absolute()
        body = read_body(settings.skeleton)
        dataset = sx.load_dataset(settings.scene)
        for note in (*body.notes, *dataset.notes):
            say(f"note    {note}")
        for view in dataset.test:  # those of training are checked as they are read
            mask_of(view)
        posing = posing_of(settings, body, dataset)
        most = settings.max_gaussians or room_for(dataset)
        recipe = recipe_for(settings.steps, most, settings.seed)
        behind = settings.background or dataset.background
        if behind:
            recipe = replace(recipe, drawing=replace(recipe.drawing, background=BACKGROUNDS[behind]))
        covered = covering(body, max(most // 2, 1), seed=settings.seed)
        start: tuple[Gaussians, Rig] | RigRun = covered
        about = facts({**asdict(settings), "command": COMMAND}, recipe, dataset)
        about["capture"] |= {"skeleton": digest_of(settings.skeleton)}
        if settings.poses.endswith(".json"):
            about["capture"] |= {"poses": digest_of(Path(settings.poses))}
        if earlier is not None:
            start = resumed(earlier, about, recipe, covered[1], len(posing.poses))
        with claimed_for_run(out, self.overwrite or earlier is not None):
            every, steps = settings.checkpoint_every, settings.checkpoint_steps
            path = earlier.path if earlier else None
            checkpoints = Checkpoints(out, about, seconds=every, steps=steps, earlier=path)
            history = earlier.history if earlier else History()
            with checkpoints:
                learned = REFINED[settings.refine]
                if isinstance(start, RigRun) and int(start.train.step) >= settings.steps:
                    say(f"writing the results after step {settings.steps:,}")
                    last = result_of(start, recipe, posing.poses, history.losses[-1])
                else:
                    if earlier:
                        say(f"resuming after step {history.steps:,} of {settings.steps:,}")
                    run = optimize_rig(dataset, recipe, start, posing.poses, posing.pose_of, learned)
                    last = followed(run, settings.steps, history, checkpoints)
                scene = RiggedScene(last.gaussians, last.rig, body.clips)
                learnt = Posing(last.poses, posing.pose_of)
                write(out, scene, learnt, dataset, recipe.drawing.background.rgb, history)
                if history.interrupted:
                    say(f"stopped at step {last.step:,}. Resume it: splatax rig --resume {out}")
                else:
                    checkpoints.discard()


def followed(
    run: Iterator[RigProgress], steps: int, history: History, checkpoints: Checkpoints
) -> RigProgress:
    """Makes the steps of a run with a progress bar, saves it now and then, and returns its last step.

    Ctrl-C ends training after the current step.
    """
    began = time.perf_counter() - history.train_seconds
    last = None
    with Display(steps) as display, Interruption() as interruption:
        display.announce("compiling the first step")
        for last in run:
            history.losses.append(last.loss)
            history.counts.append(last.count)
            history.interrupted = interruption.requested and last.step < steps
            if checkpoints.due(last.step) or history.interrupted or last.step == steps:
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


def digest_of(path: Path) -> str:
    """Returns a digest of the bytes of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16]


def posing_of(settings: RigSettings, body: Body, dataset: sx.Dataset) -> Posing:
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
    dataset: sx.Dataset,
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
