"""`splatax eval`: how well a scene predicts photos."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.console import Console
from rich.table import Table

import splatax as sx
from splatax.cli.options import (
    BackendName,
    BackgroundName,
    Downscale,
    LowPassName,
    load_scene,
    read_model,
    resolve_backend,
)
from splatax.cli.results import protocol, scores_as_json, write_json
from splatax.errors import InputError
from splatax.training.backgrounds import BACKGROUNDS


@dataclass(frozen=True)
class Evaluate:
    """Measure PSNR and SSIM of a scene against photos of its capture, on 8-bit images.

    What a run was trained with (size, background, low-pass) is taken from its folder unless given.
    """

    model: tyro.conf.Positional[Path]
    """A splat file, or the folder of a run."""
    scene: tyro.conf.Positional[Path]
    """Folder of the capture."""
    split: Literal["test", "train", "all"] = "test"
    """Which photos: every 8th by name is for testing."""
    out: Path | None = None
    """JSON file for the scores. Without it: eval.json beside the model."""
    downscale: Downscale | None = None
    """Divide the size of photos by this. "auto": the least that brings them to 1600 pixels."""
    background: BackgroundName | None = None
    """Behind the scene. Without it: as trained, else black."""
    low_pass: LowPassName | None = None
    """Without it: as the file says."""
    backend: BackendName = "auto"
    """Rasterizer."""

    def run(self) -> None:
        model = read_model(self.model, self.low_pass)
        dataset = load_scene(self.scene, self.downscale, model)
        background = BACKGROUNDS[self.background or model.options.get("background") or "black"].rgb
        scores = sx.evaluate(
            model.gaussians,
            views_of(dataset, self.split, self.scene),
            background=background,
            low_pass=model.low_pass,
            backend=resolve_backend(self.backend),
        )
        table = Table("view", "PSNR, dB", "SSIM")
        for view in scores.views:
            table.add_row(view.name, f"{view.psnr:.3f}", f"{view.ssim:.4f}")
        table.add_section()
        table.add_row("mean", f"{scores.psnr:.3f}", f"{scores.ssim:.4f}")
        Console().print(table)
        how = protocol(background)
        print(f"SSIM: {how['ssim']}")
        out = self.out or model.path.parent / "eval.json"
        contents = {"model": model.path, "scene": self.scene, "split": self.split, "protocol": how}
        write_json(out, contents | scores_as_json(scores))
        print(f"scores  {out}")


def views_of(dataset: sx.Dataset, split: str, scene: Path) -> tuple[sx.View, ...]:
    """The views of a split.

    Raises:
        InputError: if there are none.
    """
    views = {"test": dataset.test, "train": dataset.train, "all": dataset.views}[split]
    if not views:
        raise InputError(f"{scene}: a single photo, so none is held out. Ask for --split train.")
    return views
