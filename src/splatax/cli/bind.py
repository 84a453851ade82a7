"""`splatax bind`: a static scan that follows a skeleton."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from splatax.cli.options import LowPassOption, OrderOption, OverwriteFlag, read_model
from splatax.cli.output import say
from splatax.cli.page import tell_losses
from splatax.errors import InputError
from splatax.io.rigs import read_body, save_rigged
from splatax.scene.binding import bind
from splatax.scene.rigged import RiggedScene
from splatax.sensors import kept_metres


@dataclass(frozen=True)
class Bind:
    """Bind a static scan to the skeleton of a body, so that clips can move it.

    Each Gaussian follows the joints of the nearest point on the body's surface. The scan must be in the
    place and the pose in which the body was bound.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """The scan: a splat file, or the folder of a run."""
    body: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="BODY.glb")]
    """glTF file of the body: a mesh with its skeleton and clips."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE.glb")] = field(kw_only=True)
    """The file to write: splats with a skin, the skeleton and its clips."""
    low_pass: LowPassOption = None
    """Anti-aliasing filter. By default the one that the file names."""
    order: OrderOption = None
    """Order in which splats are drawn. By default the one that the file names, else depth."""
    overwrite: OverwriteFlag = False
    """Replace the file if it exists."""

    def run(self) -> None:
        if self.out.suffix.lower() != ".glb":
            raise InputError(f"{self.out}: rigged scenes are .glb files. Give the file such a name.")
        if self.out.exists() and not self.overwrite:
            raise InputError(f"{self.out}: exists. Choose another name, or replace it: --overwrite.")
        model, body = read_model(self.model, self.low_pass, self.order), read_body(self.body)
        for note in body.notes:
            say(f"note    {note}")
        rig = bind(model.gaussians, body)
        self.out.parent.mkdir(parents=True, exist_ok=True)
        scene = RiggedScene(model.gaussians, rig, body.clips)
        save_rigged(self.out, scene, comments=kept_metres(model.path))
        clips = ", ".join(body.clips) or "none"
        say(f"{self.out}: {len(model.gaussians):,} Gaussians on {len(rig.skeleton)} joints, clips: {clips}")
        tell_losses(self.out)
