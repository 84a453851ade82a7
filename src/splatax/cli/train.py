"""`splatax train`: from a capture to a scene."""

from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Literal

import tyro

import splatax as sx
from splatax.cli.options import (
    BackendName,
    BackgroundName,
    Downscale,
    LowPassName,
    load_scene,
    resolve_backend,
)
from splatax.cli.results import Run
from splatax.cli.session import claim, train
from splatax.errors import InputError
from splatax.projection import LOW_PASSES
from splatax.training.backgrounds import BACKGROUNDS
from splatax.training.initialize import FromPoints, InFrusta
from splatax.training.recipes import RECIPES

RecipeName = Literal[*RECIPES]  # type: ignore[valid-type]


@dataclass(frozen=True)
class Train:
    """Train a scene on a capture.

    Writes scene.ply, metrics.json, config.json, report.html and progress.gif. Ctrl-C ends training
    early and writes what has been reached.
    """

    scene: tyro.conf.Positional[Path]
    """Folder of the capture: photos and a COLMAP model (images/ and sparse/0/)."""
    out: Path | None = None
    """Folder for the results. Without it: runs/NAME, with the name of the capture's folder."""
    steps: int = 30_000
    """How many photos to learn from, one after the other."""
    downscale: Downscale = "auto"
    """Divide the size of photos by this. "auto": the least that brings them to 1600 pixels."""
    recipe: RecipeName = "classic"
    """How to train. "classic": Kerbl et al. 2023."""
    max_gaussians: int = 5_000_000
    """The most Gaussians that the scene may grow to."""
    init: Literal["sfm", "random"] = "sfm"
    """Start from the capture's points, or at random where the cameras look."""
    background: BackgroundName = "black"
    """Behind the scene, and behind photos with alpha. "random" changes each step, against haze."""
    low_pass: LowPassName = "dilation"
    """What keeps thin Gaussians visible. "antialiasing" also keeps their brightness from afar."""
    backend: BackendName = "auto"
    """Rasterizer. One asked for by name is never replaced by another."""
    seed: int = 0
    """Of all randomness: the same seed gives the same scene on the same machine."""
    eval_every: int = 0
    """Steps between evaluations of the held-out photos. 0: at the end alone."""
    overwrite: bool = False
    """Replace the results of an earlier run in the same folder."""

    def run(self) -> None:
        recipe = self.to_recipe()
        dataset = load_scene(self.scene, self.downscale)
        for note in dataset.notes:
            print(note)
        if self.init == "sfm" and not len(dataset.points):
            raise InputError(
                f"{self.scene}: the capture has no points to start from. Start at random: --init random."
            )
        out = self.out or Path("runs") / self.scene.resolve().name
        claim(out, self.overwrite)
        history, gaussians = train(dataset, recipe, self.eval_every)
        run = Run(self.scene.resolve().name, dataset, recipe, history, gaussians, asdict(self), out)
        conclude(run)

    def to_recipe(self) -> sx.Recipe:
        """The recipe that the options describe.

        Raises:
            InputError: if an option is out of range, or the backend cannot run here.
        """
        for option in ("steps", "max_gaussians"):
            if getattr(self, option) < 1:
                raise InputError(f"--{option.replace('_', '-')}: at least 1, not {getattr(self, option)}.")
        return replace(
            RECIPES[self.recipe](steps=self.steps, max_gaussians=self.max_gaussians),
            initialization=FromPoints() if self.init == "sfm" else InFrusta(),
            background=BACKGROUNDS[self.background],
            low_pass=LOW_PASSES[self.low_pass],
            backend=resolve_backend(self.backend),
            seed=self.seed,
        )


def conclude(run: Run) -> None:
    """Writes the results and says where they are."""
    scores = run.write()
    if scores:
        print(
            f"test PSNR {scores.psnr:.2f} dB, SSIM {scores.ssim:.4f} over {len(scores.views)} held-out photos"
        )
    print(f"scene   {run.out / 'scene.ply'}\nreport  {run.out / 'report.html'}")
