"""`splatax render`: pictures and depth of a scene from the cameras of its capture."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import tyro
from rich.progress import track

import splatax as sx
from splatax.cli.evaluate import views_of
from splatax.cli.options import (
    BackendName,
    BackgroundName,
    Downscale,
    LowPassName,
    load_scene,
    read_model,
    resolve_backend,
)
from splatax.errors import InputError
from splatax.io.images import write
from splatax.metrics import to_8bit
from splatax.report.pictures import depth_map
from splatax.training.backgrounds import BACKGROUNDS


@dataclass(frozen=True)
class Render:
    """Draw a scene from the cameras of its capture.

    Writes rgb/NAME.png, depth/NAME.npy (float32, world units along the optical axis, 0 where
    nothing is) and depth/NAME.png to look at.
    """

    model: tyro.conf.Positional[Path]
    """A splat file, or the folder of a run."""
    scene: tyro.conf.Positional[Path]
    """Folder of the capture."""
    out: Path
    """Folder for the pictures."""
    split: Literal["test", "train", "all"] = "test"
    """Which cameras: every 8th by name is for testing."""
    downscale: Downscale | None = None
    """Divide the size of pictures by this. "auto": the least that brings them to 1600 pixels."""
    background: BackgroundName | None = None
    """Behind the scene. Without it: as trained, else black."""
    low_pass: LowPassName | None = None
    """Without it: as the file says."""
    backend: BackendName = "auto"
    """Rasterizer."""
    overwrite: bool = False
    """Replace pictures of an earlier call in the same folder."""

    def run(self) -> None:
        model = read_model(self.model, self.low_pass)
        dataset = load_scene(self.scene, self.downscale, model)
        background = BACKGROUNDS[self.background or model.options.get("background") or "black"].rgb
        backend = resolve_backend(self.backend)
        views = views_of(dataset, self.split, self.scene)
        if (self.out / "rgb").exists() and not self.overwrite:
            raise InputError(
                f"{self.out}: holds pictures. Choose another --out, or replace them: --overwrite."
            )
        for view in track(views, description="rendering"):
            drawn = sx.render(
                model.gaussians,
                view.camera,
                background=np.array(background, np.float32),
                low_pass=model.low_pass,
                backend=backend,
            )
            self.save(Path(view.name).with_suffix(""), drawn)
        print(f"{len(views)} views in {self.out}")

    def save(self, name: Path, drawn: sx.Rendering) -> None:
        """Writes the files of one view."""
        picture, depth = self.out / "rgb" / f"{name}.png", self.out / "depth" / f"{name}.npy"
        for path in (picture, depth):
            path.parent.mkdir(parents=True, exist_ok=True)
        write(picture, to_8bit(np.asarray(drawn.rgb)))
        write(
            depth.with_name(f"{depth.stem}.png"), depth_map(np.asarray(drawn.depth), np.asarray(drawn.alpha))
        )
        np.save(depth, np.asarray(drawn.depth))
