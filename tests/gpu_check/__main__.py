"""Runs all checks in turn, prints a table and writes gpu-check.json. Exit code 1 if a check fails."""

import json
import os
import sys
import time
import traceback
from argparse import ArgumentParser
from collections.abc import Callable
from pathlib import Path
from typing import Any

# Checks start processes that use the same GPU, so JAX must not reserve most of its memory here or there.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax

from gpu_check import correctness, others, speed, training
from gpu_check.plan import ON_GPU, REHEARSAL, Plan, emulate

CHECKS: dict[str, Callable[[Plan], dict[str, Any]]] = {
    "device": correctness.device,
    "contracts": correctness.contracts,
    "parity": correctness.parity,
    "same bits": correctness.same_bits,
    "sanitizers": correctness.sanitizers,
    "other programs": others.others,  # before the large scenes, whose memory JAX keeps
    "copy bandwidth": speed.bandwidth,
    "scenes": speed.scenes,
    "training": training.training,
}


def checked(check: Callable[[Plan], dict[str, Any]], plan: Plan) -> dict[str, Any]:
    """Returns what a check found, or how it failed: the checks after it run all the same."""
    began = time.perf_counter()
    try:
        found = {"passed": True, **check(plan)}
    except Exception:
        found = {"passed": False, "error": traceback.format_exc()}
    return found | {"check took, s": time.perf_counter() - began}


def lines(found: Any, indent: int = 2) -> list[str]:
    """Returns nested results as a table: one line for each name, unless its results are nested themselves."""
    text = []
    for name, value in found.items():
        if isinstance(value, dict) and any(isinstance(part, dict) for part in value.values()):
            text += [f"{' ' * indent}{name}", *lines(value, indent + 2)]
            continue
        parts = value.items() if isinstance(value, dict) else [("", value)]
        text.append(
            f"{' ' * indent}{name:<28}" + "".join(f" {part} {shown(number)}" for part, number in parts)
        )
    return text


def shown(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def main() -> None:
    parser = ArgumentParser(prog="make gpu-check")
    parser.add_argument("--out", type=Path, default=Path("runs/gpu-check"))
    options = parser.parse_args(sys.argv[1:])
    plan = ON_GPU if jax.default_backend() == "gpu" else REHEARSAL
    if plan.emulated:
        print("There is no GPU: this is a rehearsal on an emulated one, and its times mean nothing.")
        emulate()
    results: dict[str, Any] = {"emulated": plan.emulated}
    options.out.mkdir(parents=True, exist_ok=True)
    for name, check in CHECKS.items():
        results[name] = checked(check, plan)
        print(f"{name}: {'passed' if results[name]['passed'] else 'FAILED'}", flush=True)
        print("\n".join(lines(results[name])), flush=True)
        (options.out / "gpu-check.json").write_text(json.dumps(results, indent=1))
    print(f"results {options.out / 'gpu-check.json'}")
    sys.exit(0 if all(results[name]["passed"] for name in CHECKS) else 1)


if __name__ == "__main__":
    main()
