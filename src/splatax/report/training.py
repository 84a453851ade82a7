"""The pages of a run, progress.gif and report.html, and held_out.json for the reports of other runs."""

import os
from collections.abc import Mapping
from dataclasses import replace

from splatax.dataset import photos_in
from splatax.evaluation import Scores
from splatax.io.datasets.photos import counted
from splatax.report import held_out
from splatax.report.gallery import Gallery, Judged
from splatax.report.page import Account, report
from splatax.report.pictures import animation
from splatax.report.plan import places
from splatax.report.verdict import verdict_of
from splatax.runs.budget import duration
from splatax.runs.finished import FinishedRun, psnr_of
from splatax.runs.machine import device, peak_memory
from splatax.runs.results import Comparison, Results


class Pages:
    """Makes the animation and the report of a run: an `Audience` of its results."""

    def __init__(self) -> None:
        self._gallery = Gallery()

    def see(self, comparison: Comparison) -> None:
        """Notes one view."""
        self._gallery.see(comparison)

    def files(self, results: Results) -> Mapping[str, bytes]:
        """Returns the contents of files by their names, the report last."""
        gallery = self._gallery
        gallery.join_faces(results.dataset.views)
        gif = animation(results.history.frames) if results.history.frames else b""
        facts = summary(results, Scores(tuple(gallery.scores)))
        judged = judged_of(results, gallery.judged)
        unseen = bool(results.dataset.test or results.judge)
        verdict = verdict_of(results.dataset, judged, unseen, results.doubted)
        picture = places(results.dataset, verdict.matched, verdict.spots) if verdict else ""
        account = Account(facts, notes(results), verdict, picture, judged)
        page = report(results.title, account, results.history, gallery, gif)
        kept = {held_out.NAME: held_out.stored(judged)} if results.dataset.test else {}
        return {"progress.gif": gif} | kept | {"report.html": page.encode()}


def judged_of(results: Results, seen: Judged) -> Judged:
    """Returns the photos by which the report judges a run.

    If the exposure of photos was learned, they are judged by their colour-corrected PSNR: the exposure of a
    held-out photo is unknown.

    Args:
        results: of the run.
        seen: the held-out photos of the run, or training photos where it holds out none.

    Raises:
        FormatError: if the trial run has a damaged file.
    """
    judged = _quoted(results, seen)
    return corrected(judged) if results.compensates else judged


def corrected(judged: Judged) -> Judged:
    """Returns photos with their colour-corrected PSNR as PSNR, with a picture of the best if there is one."""
    scores = tuple(replace(score, psnr=score.corrected_psnr) for score in judged.scores)
    best = max(scores, key=lambda score: score.psnr).name if scores else ""
    if judged.best is not None and judged.best.score.name != best:
        judged = replace(judged, best=judged.pictures.get(best))
    shown = sorted(judged.pictures.items(), key=lambda item: item[1].score.corrected_psnr)
    return replace(judged, scores=scores, pictures=dict(shown), corrected=True)


def _quoted(results: Results, seen: Judged) -> Judged:
    """Returns the photos by which the report judges a run, with their PSNR as measured."""
    if results.dataset.test:
        return replace(seen, kind="held-out photos")
    if results.judge is None:
        return replace(seen, kind="photos that it was trained on")
    return replace(
        held_out.quoted(results.judge),
        kind="photos that a trial run held out",
        scene="the scene of the trial run",
    )


def same_size(results: Results, judge: FinishedRun) -> bool:
    """Returns whether another run used photos of the same size."""
    return bool(judge.options.get("downscale") == results.options.get("downscale"))


def summary(results: Results, scores: Scores) -> dict[str, str]:
    """Returns the main results as label and value, for the top of the report."""
    used = peak_memory()
    return {
        **measures(results, scores),
        "Gaussians": f"{len(results.gaussians):,}",
        "steps" + (", then interrupted" if results.history.interrupted else ""): f"{results.history.steps:,}",
        "training": duration(results.history.train_seconds),
        "peak memory": f"{used / 1e9:.2f} GB" if used else "unknown",
        "device": device(),
    }


def measures(results: Results, scores: Scores) -> dict[str, str]:
    """Returns the scores as label and value. Those of photos that were trained on say so, and come last."""
    count, corrected = len(scores.views), {"colour-corrected PSNR": f"{scores.corrected_psnr:.2f} dB"}
    if results.dataset.test:
        psnr = {f"PSNR of {counted(count, 'held-out photo')}": f"{scores.psnr:.2f} dB"}
        return {
            **(corrected | psnr if results.compensates else psnr | corrected),
            **adjusted_measures(results),
            "SSIM": f"{scores.ssim:.4f}",
            f"worst photo, {scores.worst.name}": f"{scores.worst.psnr:.2f} dB",
        }
    seen = {f"PSNR of {counted(count)} that it was trained on": f"{scores.psnr:.2f} dB"}
    if results.judge is None:
        return seen
    test = results.judge.metrics["test"]
    unseen = f"of {counted(len(test['views']))} that a trial run held out"
    measured = [
        (f"PSNR {unseen}", psnr_of(test)),
        (f"colour-corrected PSNR {unseen}", test["corrected_psnr"]),
    ]
    if results.compensates:
        measured.reverse()
    return {label: f"{value:.2f} dB" for label, value in measured} | seen


def adjusted_measures(results: Results) -> dict[str, str]:
    """Returns the PSNR of held-out photos with adjusted poses as label and value; nothing without them."""
    adjusted = results.adjusted
    if adjusted is None:
        return {}
    psnr = adjusted.scores.corrected_psnr if results.compensates else adjusted.scores.psnr
    kind = "colour-corrected PSNR" if results.compensates else "PSNR"
    return {f"{kind} with poses adjusted to these photos": f"{psnr:.2f} dB"}


def notes(results: Results) -> list[str]:
    """Returns lines about the capture, and about what the scores mean."""
    if results.dataset.test:
        return list(results.dataset.notes)
    every, judge = photos_in(results.dataset.train), results.judge
    trained = f"The scene was trained on all {every} photos"
    if judge is None:
        meaning = f"{trained}, so none of them can show how it looks from other viewpoints."
        return [meaning, *results.dataset.notes]
    seconds, unseen = duration(judge.metrics["train_seconds"]), len(judge.metrics["test"]["views"])
    smaller = "" if same_size(results, judge) else ", with smaller photos"
    meaning = (
        f"{trained}. The score at the top is that of a trial run of {seconds}{smaller}, which held out "
        f"{unseen} of them and was compared with these. The scene itself had more time and more photos, so "
        "it is usually better."
    )
    return [
        meaning,
        f"report of the trial run: {os.path.relpath(judge.folder, results.out)}/report.html",
        *results.dataset.notes,
    ]
