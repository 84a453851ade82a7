"""Loss, test PSNR and the number of Gaussians over steps; test PSNR over time."""

import io
from collections.abc import Sequence
from typing import Any

import numpy as np

from splatax.runs.history import History

SMOOTHING = 50  # steps over which the loss is averaged


def training_curves(history: History) -> str:
    """Plots loss, test PSNR (if there are two evaluations) and Gaussians side by side, as SVG."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(11, 2.8), layout="constrained")
    loss_axes, *psnr_axes, count_axes = figure.subplots(1, 3 if len(history.evaluations) > 1 else 2)
    steps = np.arange(1, history.steps + 1)
    losses = np.array([float(loss) for loss in history.losses])
    loss_axes.semilogy(steps, losses, color="0.85", linewidth=0.6)
    loss_axes.semilogy(*smoothed(steps, losses), color="C0")
    loss_axes.set_title("training loss")
    for axes in psnr_axes:
        evaluated = [(e.step, e.scores.psnr) for e in history.evaluations]
        axes.plot(*zip(*evaluated, strict=True), "o-", color="C2", markersize=4)
        axes.set_title("test PSNR, dB")
    count_axes.plot(steps, history.counts, color="C1")
    count_axes.set_title("Gaussians")
    for axes in figure.axes:
        axes.set_xlabel("step")
        axes.set_xlim(0, history.steps)
        axes.grid(alpha=0.3)
    return svg(figure)


def psnr_over_time(curves: Sequence[tuple[Sequence[float], Sequence[float]]], colors: Sequence[str]) -> str:
    """Returns a plot of test PSNR over seconds of training, with a curve for each run, as SVG."""
    from matplotlib.figure import Figure  # slow to import

    figure = Figure(figsize=(7, 3.2), layout="constrained")
    axes = figure.subplots()
    for (seconds, psnr), color in zip(curves, colors, strict=True):
        axes.plot(seconds, psnr, "o-", color=color, markersize=4)
    axes.set_xlabel("training, s")
    axes.set_ylabel("test PSNR, dB")
    axes.set_xlim(left=0)
    axes.grid(alpha=0.3)
    return svg(figure)


def svg(figure: Any) -> str:
    """Returns a matplotlib figure as an SVG element."""
    buffer = io.StringIO()
    figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()[buffer.getvalue().index("<svg") :]


def smoothed(steps: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smooths values by means over windows that lie inside."""
    window = min(SMOOTHING, len(values))
    means = np.convolve(values, np.full(window, 1 / window), mode="valid")
    return steps[window // 2 : window // 2 + len(means)], means
