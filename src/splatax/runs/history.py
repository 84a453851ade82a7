"""The record of a run, which grows while it is trained."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from splatax.evaluation import Scores, ViewScore

Picture = UInt8[np.ndarray, "_ _ 3"]
WIDTH = 720  # pixels: the largest of kept pictures, which is also that of pictures in a report


@dataclass(frozen=True)
class Evaluation:
    """Scores of the held-out views, in the middle of a run or at its end."""

    step: int
    seconds: float  # of training before it
    scores: Scores


@dataclass
class History:
    """The record of a run, which grows with it.

    Attributes:
        losses: of each step; numbers, or scalars on a device that are read at the end.
        counts: Gaussians after each step.
        evaluations: of the held-out views.
        frames: pictures of one view during the run, as (label, picture).
        train_seconds: spent on steps, compilation included, evaluation and pictures not.
        changes: of the planned number of steps: after which step, and to how many.
        interrupted: whether the user stopped it early.
        bad_steps: steps whose loss was not finite; they have changed nothing.
        broken: Gaussians that were not finite; they were removed.
    """

    losses: list[Any] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)
    evaluations: list[Evaluation] = field(default_factory=list)
    frames: list[tuple[str, Picture]] = field(default_factory=list)
    train_seconds: float = 0.0
    changes: list[tuple[int, int]] = field(default_factory=list)
    interrupted: bool = False
    bad_steps: int = 0
    broken: int = 0

    @property
    def steps(self) -> int:
        """The number of steps that were made."""
        return len(self.losses)

    @property
    def psnr(self) -> float | None:
        """PSNR of the last evaluation, dB; None before any."""
        return self.evaluations[-1].scores.psnr if self.evaluations else None


def packed(history: History) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Returns a history as JSON values and arrays. Its losses are plain numbers from then on."""
    history.losses[:] = [float(loss) for loss in history.losses]
    arrays: dict[str, np.ndarray] = {
        "history/losses": np.array(history.losses, np.float32),
        "history/counts": np.array(history.counts, np.int64),
    }
    arrays |= {f"history/frame{i}": picture for i, (_, picture) in enumerate(history.frames)}
    header: dict[str, Any] = {
        "seconds": history.train_seconds,
        "evaluations": [asdict(evaluation) for evaluation in history.evaluations],
        "frames": [label for label, _ in history.frames],
        "changes": history.changes,
    }
    return header, arrays


def unpacked(header: dict[str, Any], arrays: dict[str, np.ndarray]) -> History:
    """Returns the history that was packed."""
    return History(
        losses=arrays["history/losses"].tolist(),
        counts=arrays["history/counts"].tolist(),
        evaluations=[
            Evaluation(e["step"], e["seconds"], Scores(tuple(ViewScore(**v) for v in e["scores"]["views"])))
            for e in header["evaluations"]
        ],
        frames=[(label, arrays[f"history/frame{i}"]) for i, label in enumerate(header["frames"])],
        train_seconds=header["seconds"],
        changes=[(step, total) for step, total in header["changes"]],
    )


def shrunk(picture: Picture) -> Picture:
    """Returns a picture no wider than `WIDTH`."""
    height, width = picture.shape[:2]
    if width <= WIDTH:
        return picture
    size = WIDTH, max(round(height * WIDTH / width), 1)
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))
