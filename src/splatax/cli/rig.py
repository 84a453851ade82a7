"""`splatax rig`: Gaussians that follow a skeleton, trained from photos in known poses."""

import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

import splatax as sx
from splatax.cli.display import Display
from splatax.cli.interruption import Interruption
from splatax.cli.options import BackgroundOption, OverwriteFlag, shown_as
from splatax.cli.output import say
from splatax.dataset import mask_of
from splatax.errors import InputError
from splatax.io.files import write_whole
from splatax.io.rigs import read_body, save_rigged
from splatax.io.rigs.poses import Posing, along_clip, read_poses, write_poses
from splatax.report.rigged import posed_comparisons, rig_report, seen_by
from splatax.runs.claim import claimed_for_run
from splatax.runs.history import History
from splatax.scene.binding import covering
from splatax.scene.body import Body
from splatax.scene.rigged import RiggedScene
from splatax.training.backgrounds import BACKGROUNDS
from splatax.training.recipes import room_for
from splatax.training.rigged import REFINED, RigProgress, optimize_rig, recipe_for

RIGGED, POSES = "rigged.glb", "poses.json"
Refine = Literal[*REFINED]  # type: ignore[valid-type]


@dataclass(frozen=True)
class RigCommand:
    """Train Gaussians that follow a skeleton, from photos of it in known poses.

    Writes rigged.glb (splats with a skin, the skeleton and its clips), scene.ply (the splats in the bound
    pose), poses.json (the poses, refined if requested), metrics.json and report.html.
    """

    scene: Annotated[Path, tyro.conf.Positional, shown_as("CAPTURE")]
    """Folder of the capture, with cameras in the coordinates of the body."""
    skeleton: Annotated[Path, tyro.conf.arg(metavar="BODY.glb")] = field(kw_only=True)
    """glTF file of the body: a mesh with its skeleton and clips. Training starts from Gaussians on its
    surface."""
    poses: Annotated[str, tyro.conf.arg(metavar="{CLIP,FILE.json}")] = field(kw_only=True)
    """Pose in each photo: a .json file (docs/rigs.md describes the format), or the name of a clip, whose
    duration is divided evenly among the photos in the order of their names."""
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")] = field(kw_only=True)
    """Output folder."""
    steps: Annotated[int, tyro.conf.arg(metavar="N")] = 1_500
    """Number of training steps; each step uses one photo."""
    max_gaussians: Annotated[int | None, shown_as("N")] = None
    """Number of Gaussians at the end. By default one for every 8 pixels of a photo, times the square root of
    the number of photos."""
    refine: Refine = "none"
    """Learn the weights, the rotations of the joints in each pose, or both, together with the Gaussians. Use
    it only if the given ones are inaccurate."""
    background: BackgroundOption = None
    """Color behind photos with alpha. By default as the capture defines it, else random in training."""
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0
    """Random seed."""
    overwrite: OverwriteFlag = False
    """Replace the results of an earlier run in the output folder."""

    def run(self) -> None:
        if self.steps < 1:
            raise InputError(f"--steps: at least 1, not {self.steps}.")
        if self.max_gaussians is not None and self.max_gaussians < 1:
            raise InputError(f"--max-gaussians: at least 1, not {self.max_gaussians}.")
        body = read_body(self.skeleton)
        dataset = sx.load_dataset(self.scene)
        for note in (*body.notes, *dataset.notes):
            say(f"note    {note}")
        for view in dataset.test:  # those of training are checked as they are read
            mask_of(view)
        posing = self._posing(body, dataset)
        most = self.max_gaussians or room_for(dataset)
        recipe = recipe_for(self.steps, most, self.seed)
        behind = self.background or dataset.background
        if behind:
            recipe = replace(recipe, drawing=replace(recipe.drawing, background=BACKGROUNDS[behind]))
        start = covering(body, max(most // 2, 1), seed=self.seed)
        with claimed_for_run(self.out, self.overwrite):
            last, history, began = None, History(), time.perf_counter()
            with Display(self.steps) as display, Interruption() as interruption:
                display.announce("compiling the first step")
                learned = REFINED[self.refine]
                for last in optimize_rig(dataset, recipe, start, posing.poses, posing.pose_of, learned):
                    display.step(last.step, last.loss, last.count)
                    history.losses.append(last.loss)
                    history.counts.append(last.count)
                    if interruption.requested:
                        history.interrupted = True
                        break
            assert last
            history.train_seconds = time.perf_counter() - began
            self._write(body, dataset, posing, last, recipe.drawing.background.rgb, history)

    def _posing(self, body: Body, dataset: sx.Dataset) -> Posing:
        """Returns the poses of the photos, from the file or the clip.

        Raises:
            InputError: if it is neither.
        """
        if self.poses in body.clips:
            names = [view.name for view in dataset.views]
            return along_clip(body.clips[self.poses], body.skeleton.rest, names)
        if not self.poses.endswith(".json"):
            clips = ", ".join(body.clips) or "none"
            raise InputError(
                f"--poses {self.poses}: neither a .json file nor a clip of {self.skeleton}, "
                f"which has: {clips}."
            )
        return read_poses(Path(self.poses), body.skeleton, body.clips)

    def _write(
        self,
        body: Body,
        dataset: sx.Dataset,
        posing: Posing,
        last: RigProgress,
        background: tuple[float, float, float],
        history: History,
    ) -> None:
        scene = RiggedScene(last.gaussians, last.rig, body.clips)
        save_rigged(self.out / RIGGED, scene)
        sx.save(self.out / "scene.ply", scene.gaussians)
        posing = Posing(last.poses, posing.pose_of)
        write_poses(self.out / POSES, posing, body.skeleton)
        galleries = {
            kind: seen_by(posed_comparisons(scene, posing, views, background))
            for kind, views in (("held-out", dataset.test), ("training", dataset.train))
        }
        scores = {
            name: {score.name: score.psnr for score in galleries[kind].scores}
            for name, kind in (("train", "training"), ("test", "held-out"))
        }
        found = {name: float(np.mean(list(values.values()))) for name, values in scores.items() if values}
        written = {"steps": last.step, "gaussians": last.count, "psnr": found, "photos": scores}
        write_whole(self.out / "metrics.json", json.dumps(written, indent=1).encode())
        title = self.out.resolve().name
        write_whole(self.out / "report.html", rig_report(title, galleries, history, dataset.notes))
        for name, value in found.items():
            say(f"{name:5} PSNR {value:.2f} dB over {len(scores[name])} photos")
        say(f"scene   {self.out / RIGGED}")
        say(f"report  {self.out / 'report.html'}")
