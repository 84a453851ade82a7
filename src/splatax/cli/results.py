"""The files that a run leaves: scene.ply, metrics.json, config.json, progress.gif, report.html."""

import json
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import splatax as sx
from splatax.cli.checkpoints import files
from splatax.cli.display import duration
from splatax.cli.failures import sentence
from splatax.cli.output import complain, say
from splatax.cli.platform import device, peak_memory, versions
from splatax.dataset import mask_of
from splatax.errors import InputError
from splatax.evaluation import PROTOCOL, Scores, ViewScore, photo_of, picture, score
from splatax.io import formats
from splatax.io.datasets import colmap_writing
from splatax.io.files import write_whole
from splatax.projection import Antialiasing
from splatax.report.history import Evaluation, History
from splatax.report.page import Comparison, report
from splatax.report.pictures import animation
from splatax.training.camera_refinement import FixedCameras, refined
from splatax.training.loop import RunState


@dataclass(frozen=True)
class Run:
    """A finished run, and where its files go."""

    title: str
    dataset: sx.Dataset
    recipe: sx.Recipe
    history: History
    last: RunState
    config: Mapping[str, Any]  # the options that it was started with
    out: Path

    @cached_property
    def gaussians(self) -> sx.Gaussians:
        """The scene, without empty slots."""
        return jax.tree.map(lambda leaf: jnp.array(leaf[: self.last.count]), self.last.train.gaussians)

    def write(self) -> Scores | None:
        """Writes all files, the scene first. Returns the scores of the test views, if there are any."""
        mark = formats.mark(isinstance(self.recipe.low_pass, Antialiasing))
        sx.save(self.out / "scene.ply", self.gaussians, comments=(mark,))
        comparisons = [self.compare(view) for view in self.dataset.test or self.dataset.train]
        scores = Scores(tuple(comparison.score for comparison in comparisons))
        test = scores if self.dataset.test else None
        if test:
            self.history.evaluations.append(Evaluation(self.history.steps, self.history.train_seconds, test))
        write_json(self.out / "metrics.json", self.metrics(test))
        write_json(self.out / "config.json", self.repeatable())
        gif = animation(self.history.frames) if self.history.frames else b""
        write_whole(self.out / "progress.gif", gif)
        page = report(self.title, self.summary(scores), self.dataset.notes, self.history, comparisons, gif)
        write_whole(self.out / "report.html", page.encode())
        return test

    def compare(self, view: sx.View) -> Comparison:
        """The photo of a view and the scene from there."""
        background = self.recipe.background.rgb
        photo = photo_of(view, background)
        image = picture(
            self.gaussians,
            view.camera,
            background=background,
            low_pass=self.recipe.low_pass,
            backend=self.recipe.backend,
        )
        mask = mask_of(view)
        return Comparison(score(view.name, image, photo, mask), photo, image, mask)

    def metrics(self, test: Scores | None) -> dict[str, Any]:
        """What was measured, and how."""
        return {
            "test": scores_as_json(test) if test else None,
            "masked_test_views": sum(view.mask is not None for view in self.dataset.test),
            "train_seconds": self.history.train_seconds,
            "steps": self.history.steps,
            "interrupted": self.history.interrupted,
            "gaussians": len(self.gaussians),
            "bad_steps": self.history.bad_steps,
            "broken_gaussians": self.history.broken,
            "final_loss": float(self.history.losses[-1]),
            "peak_rss_bytes": peak_memory(),
            "evaluations": [
                {"step": e.step, "seconds": e.seconds} | measures_of(e.scores)
                for e in self.history.evaluations
            ],
            "protocol": protocol(self.recipe.background.rgb)
            | {"train_seconds": "wall time of all steps, compilation included, evaluation and pictures not"},
        }

    def repeatable(self) -> dict[str, Any]:
        """Everything that is needed to make the run again."""
        return {
            "options": as_json(self.config),
            "recipe": as_json(self.recipe),
            "changes": self.history.changes,
            "capture": list(self.dataset.notes),
            "device": device(),
            "versions": versions(),
        }

    def summary(self, scores: Scores) -> dict[str, str]:
        """For the top of the report."""
        kind = "test" if self.dataset.test else "training"
        used = peak_memory()
        return {
            f"PSNR of {len(scores.views)} {kind} views": f"{scores.psnr:.2f} dB",
            "SSIM": f"{scores.ssim:.4f}",
            "colour-corrected PSNR": f"{scores.corrected_psnr:.2f} dB",
            f"worst view, {scores.worst.name}": f"{scores.worst.psnr:.2f} dB",
            "Gaussians": f"{len(self.gaussians):,}",
            "steps" + (", then interrupted" if self.history.interrupted else ""): f"{self.history.steps:,}",
            "training": duration(self.history.train_seconds),
            "peak memory": f"{used / 1e9:.2f} GB" if used else "unknown",
            "device": device(),
        }

    def keep_cameras(self) -> None:
        """Writes the cameras as a COLMAP model if they were refined, those of held-out photos as given."""
        if isinstance(self.recipe.camera_refinement, FixedCameras):
            return
        state = self.last.train
        found = refined(self.recipe.camera_refinement, state.cameras, self.dataset.train, state.extent)
        colmap_writing.save(self.out / "refined", (*found, *self.dataset.test), self.dataset.points)
        say(f"cameras {self.out / 'refined' / colmap_writing.PLACE}")


def conclude(run: Run) -> None:
    """Writes the results and says where they are.

    Whatever keeps it from its end, the run can be concluded again from its last checkpoint.

    Raises:
        InputError: if a photo cannot be read, or a file cannot be written.
    """
    try:
        run.keep_cameras()
        scores = run.write()
    except KeyboardInterrupt:
        complain(f"stopped while the results were written. Write them: splatax train --resume {run.out}")
        raise
    except (OSError, InputError) as error:
        why = sentence(error) if isinstance(error, OSError) else str(error)
        if not files(run.out):
            raise InputError(why) from error
        raise InputError(
            f"{why} Training is saved. Once that is mended, write the results: splatax train --resume "
            f"{run.out}"
        ) from error
    if run.history.bad_steps or run.history.broken:
        say(
            f"{run.history.bad_steps:,} steps had no finite loss and changed nothing; {run.history.broken:,} "
            "Gaussians that were not finite were removed"
        )
    if scores:
        say(
            f"test PSNR {scores.psnr:.2f} dB, SSIM {scores.ssim:.4f} over {len(scores.views)} held-out photos"
        )
    say(f"scene   {run.out / 'scene.ply'}")
    say(f"report  {run.out / 'report.html'}")


def protocol(background: tuple[float, float, float]) -> dict[str, str]:
    """How scores are made."""
    split = "every 8th photo by sorted name, from the first, is held out"
    return {"split": split, **PROTOCOL, "background": str(background)}


def scores_as_json(scores: Scores) -> dict[str, Any]:
    """Means, the worst view, and each view."""
    worst = {"name": scores.worst.name, "psnr": scores.worst.psnr}
    views = [{"name": view.name} | measures_of(view) for view in scores.views]
    return measures_of(scores) | {"worst": worst, "views": views}


def measures_of(scores: Scores | ViewScore) -> dict[str, float]:
    """All measures of one view, or the means of several; LPIPS where it was asked for."""
    measures = {"psnr": scores.psnr, "ssim": scores.ssim, "corrected_psnr": scores.corrected_psnr}
    return measures if scores.lpips is None else measures | {"lpips": scores.lpips}


def as_json(value: Any) -> Any:
    """Plain values; a dataclass becomes its name and fields."""
    if is_dataclass(value) and not isinstance(value, type):
        return {"type": type(value).__name__} | {
            f.name: as_json(getattr(value, f.name)) for f in fields(value)
        }
    if isinstance(value, Mapping):
        return {key: as_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_json(item) for item in value]
    if isinstance(value, Path):
        return str(value)
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def write_json(path: Path, contents: Any) -> None:
    """Writes a JSON file, whole or not at all; numbers that are not finite become null."""
    write_whole(path, (json.dumps(as_json(contents), indent=2) + "\n").encode())
