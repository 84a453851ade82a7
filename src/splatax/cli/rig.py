"""`splatax rig`: Gaussians that follow a skeleton, trained from photos in known poses."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from splatax.cli.options import (
    BackgroundOption,
    LowPassOption,
    OrderOption,
    OverwriteFlag,
    flag,
    given,
    shown_as,
)
from splatax.cli.rigging import COMMAND, NAMES, Refine, RigSettings, train_rig
from splatax.cli.settings import as_started
from splatax.cli.train_options import Count
from splatax.errors import InputError
from splatax.runs.records import understood
from splatax.runs.resume import OTHER, find

MAY_CHANGE = {"checkpoint_every", "checkpoint_steps"}  # on resuming


@dataclass(frozen=True)
class Saving:
    """Checkpoints during training."""

    checkpoint_every: Annotated[float | None, shown_as("SECONDS")] = None
    """Seconds between checkpoints. The last two are kept until the run has finished. By default 120; 0: only
    when the run is interrupted, and at its end."""
    checkpoint_steps: Count = None
    """Additionally save a checkpoint every N steps. By default 0: off."""


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
    low_pass: LowPassOption = None
    """Anti-aliasing filter. "dilation": as in 3DGS; "antialiasing": as in Mip-Splatting, keeps the brightness
    correct when zoomed out; "along-rays": exact in perspective, as in 2DGS. A number after a colon is its
    variance in square pixels. By default "dilation"."""
    order: OrderOption = None
    """Order in which splats are drawn. "distance": from the camera, which keeps large Gaussians beside the
    picture from covering it; some steps draw by depth, so that viewers that know only that order can show the
    scene. "depth": as in 3DGS. By default "distance"."""
    seed: Count = None
    """Random seed. By default 0."""
    resume: Annotated[Path | None, shown_as("RUN")] = None
    """Resume an interrupted run, given its folder or one of its checkpoint files. All other options are
    those of the earlier run."""
    overwrite: OverwriteFlag = False
    """Replace the results of an earlier run in the output folder."""
    saving: Saving = Saving()

    def run(self) -> None:
        chosen = {name: value for name, value in given(self).items() if name in NAMES}
        if self.resume is not None:
            if self.out is not None:
                raise InputError("--out: a run is resumed in its own folder. Leave the option out.")
            earlier = find(self.resume, COMMAND)
            with understood(earlier.path, OTHER):
                settings = as_started(RigSettings, earlier.options, chosen, MAY_CHANGE)
            train_rig(settings, earlier.run, replace_earlier=True, earlier=earlier)
            return
        needed = {"skeleton": self.skeleton, "poses": self.poses, "out": self.out}
        missing = [flag(name) for name, value in needed.items() if value is None]
        if self.scene is None:
            missing.insert(0, "the folder of a capture")
        if missing or self.out is None:
            raise InputError(f"Missing: {', '.join(missing)}. Give them, or a run to resume: --resume RUN.")
        train_rig(RigSettings(**chosen), self.out, replace_earlier=self.overwrite)
