"""The files that a run writes: scene.ply, metrics.json, config.json, and the pages of reports."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np

from splatax.adjustment import PROTOCOL as ADJUSTED_PROTOCOL
from splatax.adjustment import AdjustedScores, evaluate_adjusted
from splatax.dataset import Dataset, Mask, View
from splatax.errors import InputError
from splatax.evaluation import PROTOCOL, Scores, ViewScore, compared, scores_of
from splatax.gaussians import Gaussians
from splatax.geometry_scores import as_json as as_json_of_geometry
from splatax.geometry_scores import evaluate_geometry
from splatax.io import formats
from splatax.io.datasets import colmap_writing, motions
from splatax.io.files import explained, write_whole
from splatax.rendering import Color
from splatax.runs.checkpoints import Checkpoints, files
from splatax.runs.finished import FinishedRun
from splatax.runs.history import Evaluation, History, Picture
from splatax.runs.machine import device, peak_memory, versions
from splatax.runs.records import as_json, write_json
from splatax.training.appearance import NoAppearance
from splatax.training.camera_refinement import FixedCameras, refined
from splatax.training.loop import RunState
from splatax.training.recipes import Recipe

SHOWN = 12  # training photos that a report shows where none are held out


@dataclass(frozen=True)
class Comparison:
    """A photo, and the scene from the same camera.

    Attributes:
        score: of the picture.
        photo: over the background where it is transparent.
        image: the scene.
        mask: which pixels count; None for all.
    """

    score: ViewScore
    photo: Picture
    image: Picture
    mask: Mask | None = None


@dataclass(frozen=True)
class Results:
    """A run after its last step, and the folder for its files.

    Attributes:
        title: for people.
        dataset: the capture.
        recipe: all settings of the training.
        history: the record of the run.
        last: the run after its last step.
        options: options that the run was started with, for config.json.
        out: the folder.
        judge: another run of the capture, with held-out photos, whose scores the report gives.
    """

    title: str
    dataset: Dataset
    recipe: Recipe
    history: History
    last: RunState
    options: Mapping[str, Any]
    out: Path
    judge: FinishedRun | None = None

    @cached_property
    def gaussians(self) -> Gaussians:
        """The scene, without empty slots."""
        state = self.last
        gaussians = jax.tree.map(lambda leaf: jnp.array(leaf[: state.count]), state.train.gaussians)
        return self.recipe.drawing.of(gaussians)

    @cached_property
    def shown(self) -> Gaussians:
        """The scene as photos show it: that of a block with what surrounds it."""
        return self.dataset.in_context(self.gaussians)

    @property
    def refines_cameras(self) -> bool:
        """True if the training cameras were refined, so that there is a model of them."""
        return not isinstance(self.recipe.camera_refinement, FixedCameras)

    @cached_property
    def adjusted(self) -> AdjustedScores | None:
        """Scores of the held-out views with adjusted poses; None unless the run changed training cameras."""
        if not (self.dataset.test and (self.refines_cameras or self.options.get("cameras"))):
            return None
        return evaluate_adjusted(self.shown, self.dataset.test, renderer=self.recipe.renderer)

    @cached_property
    def doubted(self) -> dict[str, float]:
        """Weights at the end of the photos that counted less than others, by name."""
        photos = dict.fromkeys(view.photo for view in self.dataset.train)
        state = self.last.train
        weights = self.recipe.objective.weights.of_photos(
            state.weights, len(photos), state.step / state.total
        )
        return {
            name: float(weight)
            for name, weight in zip(photos, np.asarray(weights), strict=False)
            if weight < 1
        }

    @property
    def compensates(self) -> bool:
        """True if the exposure of each training photo was learned, so held-out ones may differ in theirs."""
        return not isinstance(self.recipe.appearance, NoAppearance)

    def write(self, audience: "Audience") -> Scores | None:
        """Writes all files, the scene first.

        Views are compared with their photos one after another, so memory holds a few at a time.

        Args:
            audience: sees each view, and makes further files, written last.

        Returns:
            Scores of the held-out views; None if there are none.
        """
        formats.save(self.out / "scene.ply", self.gaussians)
        if self.refines_cameras:
            self._write_cameras()
        scores = []
        for comparison in self._comparisons(self.dataset.test or examples(self.dataset.train)):
            scores.append(comparison.score)
            audience.see(comparison)
        test = scores_of(self.dataset.test, scores) if self.dataset.test else None
        if test:
            self.history.evaluations.append(Evaluation(self.history.steps, self.history.train_seconds, test))
        write_json(self.out / "metrics.json", self.metrics(test) | {"geometry": self.geometry()})
        write_json(self.out / "config.json", self.repeatable())
        for name, contents in audience.files(self).items():
            write_whole(self.out / name, contents)
        return test

    def metrics(self, test: Scores | None) -> dict[str, Any]:
        """Returns what was measured and how, for metrics.json."""
        return {
            "test": scores_as_json(test) if test else None,
            "adjusted_poses": adjusted_as_json(self.adjusted) if self.adjusted else None,
            "masked_test_views": sum(view.mask is not None for view in self.dataset.test),
            "train_seconds": self.history.train_seconds,
            "steps": self.history.steps,
            "interrupted": self.history.interrupted,
            "gaussians": len(self.gaussians),
            "bad_steps": self.history.bad_steps,
            "broken_gaussians": self.history.broken,
            "photo_weights": self.doubted,
            "final_loss": float(self.history.losses[-1]),
            "peak_rss_bytes": peak_memory(),
            "evaluations": [
                {"step": e.step, "seconds": e.seconds} | measures_of(e.scores)
                for e in self.history.evaluations
            ],
            "judged_by": self.judge and {"run": str(self.judge.folder), "test": self.judge.metrics["test"]},
            "protocol": protocol(self.recipe.drawing.background.rgb, self.dataset)
            | {"train_seconds": "wall time of all steps, compilation included, evaluation and pictures not"},
        }

    def geometry(self) -> dict[str, Any] | None:
        """Returns the errors of depth and normals in the held-out views; None if there is no reference."""
        scores = evaluate_geometry(self.shown, self.dataset.test, renderer=self.recipe.renderer)
        return as_json_of_geometry(scores) if scores else None

    def repeatable(self) -> dict[str, Any]:
        """Returns everything that is needed to repeat the run, for config.json."""
        return {
            "options": as_json(self.options),
            "recipe": as_json(self.recipe),
            "changes": self.history.changes,
            "capture": list(self.dataset.notes),
            "device": device(),
            "versions": versions(),
        }

    def _comparisons(self, views: Sequence[View]) -> Iterator[Comparison]:
        for score, photo, image, mask in compared(self.shown, views, self.recipe.renderer):
            yield Comparison(score, photo, image, mask)

    def _write_cameras(self) -> None:
        """Writes the cameras as a COLMAP model, those of held-out photos as they were given.

        Motions during the exposure, which COLMAP's cameras do not have, go to a file beside it.
        """
        state = self.last.train
        found = refined(self.recipe.camera_refinement, state.cameras, self.dataset.train, state.extent)
        colmap_writing.save(self.out / "refined", (*found, *self.dataset.test), self.dataset.points)
        if moved := motions.contents_for((*found, *self.dataset.test)):
            write_json(self.out / "refined" / motions.FILE, moved)


@runtime_checkable
class Audience(Protocol):
    """Looks at the views of a finished run one after another, and makes files of them."""

    def see(self, comparison: Comparison) -> None:
        """Notes one view. Views come in the order of their names, and are not kept."""

    def files(self, results: Results) -> Mapping[str, bytes]:
        """Returns the contents of files by name, once all views have been seen."""


class NoPages:
    """An audience that makes no files."""

    def see(self, comparison: Comparison) -> None:
        """Ignores the view."""

    def files(self, results: Results) -> Mapping[str, bytes]:
        """Returns no files."""
        return {}


def conclude(results: Results, checkpoints: Checkpoints, audience: Audience | None = None) -> Scores | None:
    """Writes the results of a run, and removes its checkpoints if it has made all of its steps.

    Until everything is written the checkpoints stay, so that a run which fails here can be concluded again
    from the last of them.

    Args:
        results: of the run.
        checkpoints: of the run.
        audience: makes further files, such as `splatax.report.training.Pages`; None for no one.

    Returns:
        Scores of the held-out views; None if there are none.

    Raises:
        InputError: if a photo cannot be read, or a file cannot be written.
    """
    try:
        scores = results.write(audience or NoPages())
    except (OSError, InputError) as error:
        why = explained(error) if isinstance(error, OSError) else str(error)
        helps = error.options if isinstance(error, InputError) else ()
        if not files(results.out):
            raise InputError(why, options=helps) from error
        raise InputError(
            f"{why} Training is saved. Resume the run once that is fixed: only the results will be written.",
            options=(*helps, f"resume {results.out}"),
        ) from error
    if not results.history.interrupted:
        checkpoints.discard()
    return scores


def examples(views: Sequence[View]) -> Sequence[View]:
    """Returns at most `SHOWN` of the views, evenly spaced, with their photos as they were taken."""
    return [view.as_taken() for view in views[:: -(-len(views) // SHOWN) or 1]]


def protocol(background: Color, dataset: Dataset) -> dict[str, str]:
    """Returns how the scores of a capture's held-out photos are made, in words."""
    split = f"held out: {dataset.split or 'as given'}"
    return {"split": split, **PROTOCOL, "background": str(tuple(float(value) for value in background))}


def scores_as_json(scores: Scores) -> dict[str, Any]:
    """Returns the means, the worst view, and each view, as JSON values."""
    worst = {"name": scores.worst.name, "psnr": scores.worst.psnr}
    views = [{"name": view.name} | measures_of(view) for view in scores.views]
    return measures_of(scores) | {"worst": worst, "views": views}


def adjusted_as_json(adjusted: AdjustedScores) -> dict[str, Any]:
    """Returns the scores with adjusted poses, and how far each picture moved, as JSON values."""
    scores = scores_as_json(adjusted.scores)
    for view, motion in zip(scores["views"], adjusted.motions, strict=True):
        view["motion"] = motion
    how = {"poses": ADJUSTED_PROTOCOL, "motion": "median over the Gaussians in the picture, pixels"}
    return scores | {"motion": adjusted.motion, "protocol": how}


def measures_of(scores: Scores | ViewScore) -> dict[str, float]:
    """Returns all measures of one view, or the means of several; LPIPS where it was asked for."""
    measures = {"psnr": scores.psnr, "ssim": scores.ssim, "corrected_psnr": scores.corrected_psnr}
    return measures if scores.lpips is None else measures | {"lpips": scores.lpips}
