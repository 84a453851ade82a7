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
from splatax.training.initialize import InFrusta
from splatax.training.recipes import RECIPES, room_for

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
    recipe: RecipeName = "default"
    """How to train. "default": the best known; "classic": Kerbl et al. 2023; "mcmc": Kheradmand et al.
    2024."""
    max_gaussians: Literal["auto"] | int = "auto"
    """The most Gaussians that the scene may grow to; all recipes but "classic" do grow to it. "auto": as
    many as the photos have detail for; with "classic" 5,000,000, which it rarely reaches."""
    init: Literal["sfm", "random"] = "sfm"
    """Start from the capture's points, or at random where the cameras look."""
    background: BackgroundName | None = None
    """Behind the scene, and behind photos with alpha. "random" changes each step, against haze, and is
    black in evaluations. Without it: the recipe's, random for "default", else black."""
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
        self.refuse_what_is_out_of_range()
        dataset = load_scene(self.scene, self.downscale)
        recipe = self.to_recipe(dataset)
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

    def refuse_what_is_out_of_range(self) -> None:
        """Raises InputError if a number makes no sense."""
        for option, number in (("--steps", self.steps), ("--max-gaussians", self.max_gaussians)):
            if number != "auto" and number < 1:
                raise InputError(f"{option}: at least 1, not {number}.")

    def to_recipe(self, dataset: sx.Dataset) -> sx.Recipe:
        """The recipe that the options describe, for a capture.

        Raises:
            InputError: if the backend cannot run here.
        """
        most = {"max_gaussians": self.max_gaussians}
        if self.max_gaussians == "auto":
            most = {} if self.recipe == "classic" else {"max_gaussians": room_for(dataset)}
        recipe = RECIPES[self.recipe](steps=self.steps, **most)
        start = recipe.initialization
        if self.init == "random":
            start = InFrusta(opacity=start.opacity, scale=start.scale)
        return replace(
            recipe,
            initialization=start,
            background=BACKGROUNDS[self.background] if self.background else recipe.background,
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
