"""Training runs of real captures on this device, with their scores."""

import json
import os
import tempfile
import time
from pathlib import Path
from typing import Any

from gpu_check.plan import ROOT, Plan
from splatax import cli

CAPTURES = ("fern", "fox")


def training(plan: Plan) -> dict[str, Any]:
    """Trains on each capture; in a rehearsal on one of noise."""
    if plan.emulated:
        from captures import write_transforms

        with tempfile.TemporaryDirectory() as folder:
            return {"noise": train(write_transforms(Path(folder) / "noise"), plan)}
    data = Path(os.environ.get("SPLATAX_DATA", ROOT.parent / "shared" / "data"))
    captures = [data / name for name in CAPTURES if (data / name).is_dir()]
    if not captures:
        return {"skipped": f"no capture in {data}: set SPLATAX_DATA"}
    return {capture.name: train(capture, plan) for capture in captures}


def train(capture: Path, plan: Plan) -> dict[str, Any]:
    """Returns scores and seconds of one run."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        began = time.perf_counter()
        command = ["train", capture, "--out", out, "--steps", plan.steps, "--backend", "cuda"]
        cli.main([str(part) for part in command])
        took = time.perf_counter() - began
        metrics = json.loads((out / "metrics.json").read_text())
    return {"steps": plan.steps, "seconds": took, "test": {k: metrics["test"][k] for k in ("psnr", "ssim")}}
