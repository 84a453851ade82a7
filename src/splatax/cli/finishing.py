"""Writes the results of a run, and prints its scores and the paths of its files."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from splatax.cli.output import complain, say
from splatax.io.datasets.colmap_writing import PLACE
from splatax.io.datasets.photos import counted
from splatax.report.training import Pages
from splatax.runs.checkpoints import Checkpoints
from splatax.runs.results import Results, conclude


def written(results: Results, checkpoints: Checkpoints) -> None:
    """Writes the results of a run and prints their paths; if the user stops it, prints how to resume."""
    with told_how_to_finish(results.out):
        _write(results, checkpoints)


@contextmanager
def told_how_to_finish(out: Path) -> Iterator[None]:
    """Prints how to write the results of a run if the user stops that."""
    try:
        yield
    except KeyboardInterrupt:
        complain(f"stopped while the results were written. To write them: splatax train --resume {out}")
        raise


def _write(results: Results, checkpoints: Checkpoints) -> None:
    """Writes the results of a run and prints where they are."""
    scores, history, out = conclude(results, checkpoints, Pages()), results.history, results.out
    if results.refines_cameras:
        say(f"cameras {out / 'refined' / PLACE}")
    if history.bad_steps or history.broken:
        say(
            f"{history.bad_steps:,} steps had no finite loss and changed nothing; {history.broken:,} "
            "Gaussians that were not finite were removed"
        )
    for name, weight in results.doubted.items():
        say(
            f"{name} does not fit the other photos, so its weight was {weight:.2g} at the end. "
            "Weigh all equally: --photo-weights equal"
        )
    if scores:
        corrected = f" ({scores.corrected_psnr:.2f} dB colour-corrected)" if results.compensates else ""
        count = counted(len(scores.views), "held-out photo")
        say(f"test PSNR {scores.psnr:.2f} dB{corrected}, SSIM {scores.ssim:.4f} over {count}")
    say(f"scene   {out / 'scene.ply'}")
    say(f"report  {out / 'report.html'}")
