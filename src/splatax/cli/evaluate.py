"""`splatax eval`: how well a scene predicts photos."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from rich.table import Column, Table

import splatax as sx
from splatax import lpips
from splatax.cli.options import (
    BackendName,
    BackgroundName,
    Downscale,
    LowPassName,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
)
from splatax.cli.output import cell, say, show
from splatax.errors import InputError
from splatax.runs.records import write_json
from splatax.runs.results import measures_of, protocol, scores_as_json

LABELS = {"psnr": "PSNR, dB", "ssim": "SSIM", "corrected_psnr": "corrected, dB", "lpips": "LPIPS"}
DECIMALS = {"psnr": 3, "ssim": 4, "corrected_psnr": 3, "lpips": 4}


@dataclass(frozen=True)
class Evaluate:
    """Measure a scene against photos of its capture, on 8-bit images: PSNR, SSIM, LPIPS.

    Masked pixels do not count. PSNR is also given after correcting colours by an affine map, which
    is fair to photos whose exposure or white balance the scene cannot know.

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
    lpips: Path | None = None
    """Also measure LPIPS, with the weights in this .npz file (docs/evaluation.md says how to make it)."""
    downscale: Downscale | None = None
    """Divide the size of photos by this. "auto": the least that brings them to 1600 pixels."""
    background: BackgroundName | None = None
    """Behind the scene. Without it: as trained, else black."""
    low_pass: LowPassName | None = None
    """Without it: as the file says."""
    backend: BackendName = "auto"
    """Rasterizer."""

    def run(self) -> None:
        perceptual = lpips.read(self.lpips) if self.lpips else None
        model = read_model(self.model, self.low_pass)
        dataset = load_scene(self.scene, self.downscale, model)
        background = background_of(model.options, self.background)
        views = views_of(dataset, self.split, self.scene)
        scores = sx.evaluate(
            model.gaussians,
            views,
            background=background,
            low_pass=model.low_pass,
            backend=resolve_backend(self.backend),
            lpips=perceptual,
        )
        how = protocol(background) | ({"lpips": perceptual.protocol} if perceptual else {})
        show(table_of(scores))
        say(f"worst   {scores.worst.name}, {scores.worst.psnr:.3f} dB")
        masked = sum(view.mask is not None for view in views)
        for name in [*measures_of(scores), *(["masks"] if masked else [])]:
            show(cell(f"{LABELS.get(name, name)}: {how[name]}", "dim"))
        out = self.out or model.path.parent / "eval.json"
        contents = {"model": model.path, "scene": self.scene, "split": self.split, "protocol": how}
        write_json(out, contents | scores_as_json(scores))
        say(f"scores  {out}")


def table_of(scores: sx.Scores) -> Table:
    """A row for each view, and one of means."""
    measured = measures_of(scores)
    table = Table("view", *(Column(LABELS[name], justify="right") for name in measured))

    def add(label: str, measures: dict[str, float]) -> None:
        table.add_row(cell(label), *(f"{value:.{DECIMALS[name]}f}" for name, value in measures.items()))

    for view in scores.views:
        add(view.name, measures_of(view))
    table.add_section()
    add("mean", measured)
    return table


def views_of(dataset: sx.Dataset, split: str, scene: Path) -> tuple[sx.View, ...]:
    """The views of a split.

    Raises:
        InputError: if there are none.
    """
    views = {"test": dataset.test, "train": dataset.train, "all": dataset.views}[split]
    if not views:
        raise InputError(f"{scene}: a single photo, so none is held out. Ask for --split train.")
    return views
