"""The pages of a run: progress.gif and report.html."""

from collections.abc import Mapping, Sequence

from splatax.evaluation import Scores
from splatax.report.page import report
from splatax.report.pictures import animation
from splatax.runs.budget import duration
from splatax.runs.machine import device, peak_memory
from splatax.runs.results import Comparison, Results


def pages(results: Results, comparisons: Sequence[Comparison]) -> Mapping[str, bytes]:
    """Returns the animation and the report of a run by the names of their files, the report last."""
    gif = animation(results.history.frames) if results.history.frames else b""
    facts = summary(results, Scores(tuple(comparison.score for comparison in comparisons)))
    page = report(results.title, facts, results.dataset.notes, results.history, comparisons, gif)
    return {"progress.gif": gif, "report.html": page.encode()}


def summary(results: Results, scores: Scores) -> dict[str, str]:
    """Returns the main results as label and value, for the top of the report."""
    kind = "test" if results.dataset.test else "training"
    used = peak_memory()
    return {
        f"PSNR of {len(scores.views)} {kind} views": f"{scores.psnr:.2f} dB",
        "SSIM": f"{scores.ssim:.4f}",
        "colour-corrected PSNR": f"{scores.corrected_psnr:.2f} dB",
        f"worst view, {scores.worst.name}": f"{scores.worst.psnr:.2f} dB",
        "Gaussians": f"{len(results.gaussians):,}",
        "steps" + (", then interrupted" if results.history.interrupted else ""): f"{results.history.steps:,}",
        "training": duration(results.history.train_seconds),
        "peak memory": f"{used / 1e9:.2f} GB" if used else "unknown",
        "device": device(),
    }
