"""`splatax compare`: finished runs side by side."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from rich.progress import Progress
from rich.table import Column, Table

import splatax as sx
from splatax.cli.options import (
    BackendName,
    FolderOption,
    Model,
    background_of,
    load_scene,
    read_model,
    resolve_backend,
    shown_as,
)
from splatax.cli.output import cell, say, show
from splatax.dataset import by_photo, mask_of
from splatax.errors import InputError
from splatax.evaluation import photo_of, picture
from splatax.io.files import write_whole
from splatax.report.gallery import MOST
from splatax.report.side_by_side import Curve, Lineup, Row, joined, side_by_side
from splatax.runs.budget import duration
from splatax.runs.claim import claimed
from splatax.runs.finished import FinishedRun, check_comparable, psnr_of, read_runs

UNKNOWN = "-"
NOT_OF_THE_METHOD = {"scene", "out", "overwrite", "backend", "eval_every"}  # options that change no image


@dataclass(frozen=True)
class Compare:
    """Compare finished runs of one capture: scores, curves and images.

    Prints a table and writes compare.html, a self-contained file.
    """

    runs: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="RUN [RUN ...]")]
    """Folders of two runs or more."""
    out: FolderOption = None
    """Output folder for compare.html. By default "compare" beside the first run."""
    scene: Annotated[Path | None, shown_as("CAPTURE")] = None
    """Folder of the capture. By default where it was when the runs were trained."""
    backend: BackendName = "auto"
    """Rendering backend. If the named one is unavailable, the command fails."""

    def run(self) -> None:
        if len(self.runs) < 2:
            raise InputError("compare: give the folders of two runs or more.")
        runs = read_runs(self.runs)
        check_comparable(runs, scene_given=self.scene is not None)
        models = [read_model(run.folder) for run in runs]
        views = [views_of(run, model, self.scene) for run, model in zip(runs, models, strict=True)]
        check_sizes(runs, views)
        out = self.out or self.runs[0].resolve().parent / "compare"
        rows = rows_of(runs)
        show(table_of(runs, rows))
        backend = resolve_backend(self.backend)
        names, curves = [run.name for run in runs], [curve_of(run) for run in runs]
        psnrs = {name: [run.test_psnr[name] for run in runs] for name in runs[0].test_psnr}
        with Progress(transient=True) as progress:
            task = progress.add_task("rendering", total=min(len(psnrs), MOST))

            def drawn(name: str) -> Lineup:
                progress.advance(task)
                return lineup(runs, models, name, views[0][name], backend)

            page = side_by_side(names, rows, curves, psnrs, drawn)
        with claimed(out):
            write_whole(out / "compare.html", page.encode())
        say(f"compare {out / 'compare.html'}")


def views_of(run: FinishedRun, model: Model, scene: Path | None) -> dict[str, list[sx.View]]:
    """Returns the views of the photos that a run was tested on, by name: all faces of a 360-degree photo.

    Raises:
        InputError: if the capture is not there, or lacks one of them.
    """
    scene = scene or run.scene
    if not scene.exists():
        raise InputError(f"{run.folder}: its capture is no longer at {scene}. Say where it is: --scene.")
    known = load_scene(scene, None, model).views
    views = by_photo(known, {view.name: view for view in known})
    if missing := sorted(run.test_psnr.keys() - views.keys()):
        raise InputError(
            f"{scene}: no photo {missing[0]}, which {run.folder} was tested on. Give the capture as it was: "
            "--scene."
        )
    return {name: views[name] for name in run.test_psnr}


def check_sizes(runs: Sequence[FinishedRun], views: Sequence[dict[str, list[sx.View]]]) -> None:
    """Checks that all runs were measured on photos of one size.

    Raises:
        InputError: if not; it says what differs.
    """
    for run, its_views in zip(runs[1:], views[1:], strict=True):
        for name, (view, *_) in its_views.items():
            ours, theirs = view.camera, views[0][name][0].camera
            if (ours.width, ours.height) != (theirs.width, theirs.height):
                raise InputError(
                    f"{run.folder}: measured on photos of {ours.width} x {ours.height} pixels, but "
                    f"{runs[0].folder} on {theirs.width} x {theirs.height}. Compare runs of one --downscale."
                )


def lineup(
    runs: Sequence[FinishedRun], models: Sequence[Model], name: str, views: Sequence[sx.View], backend: str
) -> Lineup:
    """Returns a test photo as each run shows it; the faces of a 360-degree photo are joined in one picture.

    Raises:
        InputError: if the photo is transparent, and the runs saw it over different backgrounds.
    """
    backgrounds = [background_of(run.options) for run in runs]
    photos = [photo_of(view, backgrounds[0]) for view in views]
    for run, background in zip(runs, backgrounds, strict=True):
        for view, photo in zip(views, photos, strict=True):
            if background != backgrounds[0] and np.any(photo_of(view, background) != photo):
                raise InputError(
                    f"{run.folder}: {view.name}, which is transparent, was evaluated over a different "
                    f"background than in {runs[0].folder}. Use the same --background for both."
                )
    images = tuple(
        joined(
            [
                picture(model.gaussians, view.camera, sx.Renderer(background, backend=backend))
                for view in views
            ]
        )
        for model, background in zip(models, backgrounds, strict=True)
    )
    masks = [mask_of(view) for view in views]
    counts = [
        np.ones(photo.shape[:2], bool) if mask is None else mask
        for mask, photo in zip(masks, photos, strict=True)
    ]
    mask = None if all(mask is None for mask in masks) else joined(counts)
    return Lineup(name, joined(photos), images, tuple(run.test_psnr[name] for run in runs), mask)


def curve_of(run: FinishedRun) -> Curve:
    """Returns test PSNR over training time."""
    evaluations = run.metrics["evaluations"]
    return Curve(tuple(e["seconds"] for e in evaluations), tuple(psnr_of(e) for e in evaluations))


def rows_of(runs: Sequence[FinishedRun]) -> list[Row]:
    """Returns the rows of the table: the scores, and the options in which the runs differ."""
    tests = [run.metrics["test"] for run in runs]
    rows = [
        row("test PSNR, dB", [psnr_of(test) for test in tests], "{:.3f}".format, best=max),
        row("SSIM", [test["ssim"] for test in tests], "{:.4f}".format, best=max),
        row("corrected PSNR, dB", [t.get("corrected_psnr") for t in tests], "{:.3f}".format, best=max),
        row("Gaussians", [run.metrics["gaussians"] for run in runs], "{:,}".format),
        row("training", [run.metrics["train_seconds"] for run in runs], duration),
        row("steps", [run.metrics["steps"] for run in runs], "{:,}".format),
        row("peak memory", [run.metrics["peak_rss_bytes"] for run in runs], megabytes),
        row("scene.ply", [(run.folder / "scene.ply").stat().st_size for run in runs], megabytes),
        row("recipe", [run.options["recipe"] for run in runs], str),
    ]
    shown = {"recipe", "steps", *NOT_OF_THE_METHOD}
    for name in sorted({name for run in runs for name in run.options} - shown):
        values = [run.options.get(name) for run in runs]
        if any(value != values[0] for value in values):
            rows.append(row(f"--{name.replace('_', '-')}", values, str))
    return rows


def row(
    label: str,
    values: Sequence[Any],
    words: Callable[[Any], str],
    best: Callable[[Sequence[Any]], Any] | None = None,
) -> Row:
    """Returns a row of the table; missing values are shown as unknown."""
    known = [value for value in values if value is not None]
    chosen = best(known) if best and known and any(value != known[0] for value in known) else None
    return Row(
        label,
        tuple(UNKNOWN if value is None else words(value) for value in values),
        tuple(chosen is not None and value == chosen for value in values),
    )


def megabytes(size: int) -> str:
    """Returns a size in words, such as "12.3 MB"."""
    return f"{size / 1e6:,.1f} MB"


def table_of(runs: Sequence[FinishedRun], rows: Sequence[Row]) -> Table:
    """Returns the table, with a column for each run."""
    table = Table("", *(Column(cell(run.name), justify="right", overflow="fold") for run in runs))
    for entry in rows:
        cells = zip(entry.cells, entry.best, strict=True)
        table.add_row(entry.label, *(cell(text, "bold" if best else "") for text, best in cells))
    return table
