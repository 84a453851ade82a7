"""Draws test PSNR over seconds of training, for runs of one capture that were evaluated during training.

    splatax train fern --recipe classic --steps 3000 --eval-every 200 --out runs/classic
    ...
    python docs/make_curves.py runs/default runs/classic runs/absgrad runs/mcmc

The script writes docs/images/curves.png. Each run has the name of its folder.
"""

import json
import sys
from pathlib import Path

from matplotlib.figure import Figure

OUT = Path(__file__).parent / "images" / "curves.png"


def main(folders: list[str]) -> None:
    figure = Figure(figsize=(6, 3.6), layout="constrained")
    axes = figure.subplots()
    for folder in map(Path, folders):
        metrics = json.loads((folder / "metrics.json").read_text())
        seconds, psnr = zip(*((e["seconds"], e["psnr"]) for e in metrics["evaluations"]), strict=True)
        axes.plot(seconds, psnr, ".-", label=f"{folder.name}, {metrics['gaussians']:,} Gaussians")
        print(f"{folder.name}: {psnr[-1]:.2f} dB after {seconds[-1]:.0f} s, {metrics['steps']:,} steps")
    axes.set(xlabel="seconds of training", ylabel="test PSNR, dB", ylim=(16, None))
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(OUT, dpi=110)


if __name__ == "__main__":
    main(sys.argv[1:])
