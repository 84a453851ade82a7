"""What happened in a run, kept while it goes on."""

from dataclasses import dataclass, field
from typing import Any

from splatax.evaluation import Scores
from splatax.report.pictures import Picture


@dataclass(frozen=True)
class Evaluation:
    """Of the test views, in the middle of a run or at its end."""

    step: int
    seconds: float  # of training before it
    scores: Scores


@dataclass
class History:
    """Grows with the run.

    Attributes:
        losses: of each step; numbers, or scalars on a device that are read at the end.
        counts: of Gaussians after each step.
        evaluations: of the test views.
        frames: of one view, as (label, picture).
        train_seconds: spent on steps, compilation included, evaluation and pictures not.
        changes: of the planned number of steps: after which step, and to how many.
        interrupted: whether the user stopped it early.
        bad_steps: whose loss was not finite; they have changed nothing.
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
        return len(self.losses)

    @property
    def psnr(self) -> float | None:
        """Of the last evaluation, dB; None before any."""
        return self.evaluations[-1].scores.psnr if self.evaluations else None
