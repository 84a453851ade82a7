"""`splatax eval`: scores of a scene on photos."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from rich.table import Column, Table

import splatax as sx
from splatax import lpips
from splatax.adjustment import AdjustedScores, evaluate_adjusted
from splatax.cli.options import (
    BackendName,
    BackgroundOption,
    DownscaleOption,
    HoldOutOption,
    LowPassOption,
    OrderOption,
    PathOption,
    Split,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
    shown_as,
)
from splatax.cli.output import cell, say, show
from splatax.errors import InputError
from splatax.geometry_scores import GeometryScores, as_json, evaluate_geometry
from splatax.runs.records import write_json
from splatax.runs.results import adjusted_as_json, measures_of, protocol, scores_as_json

LABELS = {"psnr": "PSNR, dB", "ssim": "SSIM", "corrected_psnr": "corrected, dB", "lpips": "LPIPS"}
DECIMALS = {"psnr": 3, "ssim": 4, "corrected_psnr": 3, "lpips": 4}


@dataclass(frozen=True)
class Evaluate:
    """Score a scene on held-out photos of its capture: PSNR, SSIM, LPIPS, and errors of depth and normals.

    Scores are of 8-bit images; masked pixels do not count. PSNR is also given after an affine colour
    correction, to compensate for exposure and white-balance differences. Depth and normals are compared with
    the true ones in CAPTURE/truth; without these, depth is compared with the points of structure from motion
    that the photos observe. Size, background and low-pass default to the settings of the run.
    """

    model: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="MODEL")]
    """A splat file, or the folder of a run of splatax, INRIA's 3DGS or gsplat."""
    scene: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="CAPTURE")]
    """Folder of the capture, or a zip file of it."""
    split: Split = "test"
    """Photos to score: those that were held out from training, the others, or all."""
    hold_out: HoldOutOption = None
    """Held-out photos, as for splatax train. By default as in training, else as the capture lists, else every
    8th by name from the 5th."""
    out: PathOption = None
    """JSON file for the scores. By default eval.json beside the model."""
    lpips: PathOption = None
    """Also compute LPIPS, with the weights in this .npz file (docs/evaluation.md says how to make it)."""
    adjust_poses: Annotated[bool, shown_as()] = False
    """Also score each photo with the pose that fits it best, found from the given pose on the finished scene.
    The difference is what errors of the given poses cost. These are not scores of new views: each pose has
    seen its photo. By default off."""
    downscale: DownscaleOption = None
    """Divide the width and height of photos by this number. "auto": the smallest factor that brings the long
    side down to 1600 pixels. By default as in training, else "auto"."""
    background: BackgroundOption = None
    """Colour behind the scene. By default as in training, else black."""
    low_pass: LowPassOption = None
    """Anti-aliasing filter. By default the one that the file names."""
    order: OrderOption = None
    """Order in which splats are drawn. By default the one that the file names, else depth."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""

    def run(self) -> None:
        perceptual = lpips.read(self.lpips) if self.lpips else None
        model = read_model(self.model, self.low_pass, self.order)
        dataset = load_scene(self.scene, self.downscale, model, self.hold_out)
        trained_on = model.options.get("scene")
        if trained_on and Path(trained_on).name != self.scene.absolute().name:
            say(f"note    {model.name} was trained on {trained_on}, and is scored on photos of {self.scene}")
        background = background_of(model.options, self.background)
        views = views_of(dataset, self.split, self.scene)
        renderer = sx.Renderer(background, backend=resolve_backend(self.backend))
        scores = sx.evaluate(model.gaussians, views, renderer=renderer, lpips=perceptual)
        geometry = evaluate_geometry(model.gaussians, views, renderer=renderer)
        fitted = None
        if self.adjust_poses:
            fitted = evaluate_adjusted(model.gaussians, views, renderer=renderer, lpips=perceptual)
        how = protocol(background, dataset) | ({"lpips": perceptual.protocol} if perceptual else {})
        show(table_of(scores))
        say(f"worst   {scores.worst.name}, {scores.worst.psnr:.3f} dB")
        if fitted:
            show(table_of(fitted.scores, "view, pose adjusted"))
            say(adjusted_in_words(scores, fitted))
        masked = sum(view.mask is not None for view in views)
        for name in [*measures_of(scores), *(["masks"] if masked else [])]:
            show(cell(f"{LABELS.get(name, name)}: {how[name]}", "dim"))
        if geometry:
            for line in words_of(geometry):
                say(line)
            for kind, text in as_json(geometry)["protocol"].items():
                show(cell(f"{kind}: {text}", "dim"))
        out = self.out or model.path.parent / "eval.json"
        contents: dict[str, Any] = {
            "model": model.path,
            "scene": self.scene,
            "split": self.split,
            "protocol": how,
        }
        contents["adjusted_poses"] = adjusted_as_json(fitted) if fitted else None
        contents["geometry"] = as_json(geometry) if geometry else None
        write_json(out, contents | scores_as_json(scores))
        say(f"scores  {out}")


def table_of(scores: sx.Scores, title: str = "view") -> Table:
    """Returns a table with a row for each view, and one for the means."""
    measured = measures_of(scores)
    table = Table(title, *(Column(LABELS[name], justify="right") for name in measured))

    def add(label: str, measures: dict[str, float]) -> None:
        table.add_row(cell(label), *(f"{value:.{DECIMALS[name]}f}" for name, value in measures.items()))

    for view in scores.views:
        add(view.name, measures_of(view))
    table.add_section()
    add("mean", measured)
    return table


def adjusted_in_words(given: sx.Scores, fitted: AdjustedScores) -> str:
    """Returns what adjusting the poses of the photos changed, in one line."""
    gain = fitted.scores.psnr - given.psnr
    return (
        f"with each photo's pose adjusted to it on the finished scene: {fitted.scores.psnr:.3f} dB "
        f"({gain:+.3f}), moved by {fitted.motion:.2f} px (median)"
    )


def words_of(scores: GeometryScores) -> list[str]:
    """Returns the mean errors of geometry in words, one line for each kind."""
    mean = scores.mean
    source = "the truth" if scores.reference == "truth" else "the capture's points"
    lines = [
        f"{output}: {error.median:.4g} off {source} ({100 * error.relative:.2g} %), bias {error.bias:+.2g}"
        for output, error in mean.depths.items()
    ]
    lines.append(f"coverage: {100 * mean.coverage:.0f} %")
    if mean.normals is not None:
        lines.append(f"normals: {mean.normals:.1f} degrees off {source}")
    return lines


def views_of(dataset: sx.Dataset, split: str, scene: Path) -> tuple[sx.View, ...]:
    """Returns the views of a split.

    Raises:
        InputError: if there are none.
    """
    views = {"test": dataset.test, "train": dataset.train, "all": dataset.views}[split]
    if not views:
        raise InputError(f"{scene}: no photo is held out. Use --split train.")
    return views
