"""Other rasterizers on the same scenes, where they are installed. None of them can fail the check."""

import importlib.util
import json
import subprocess
import sys
from typing import Any

from gpu_check.plan import Plan, environment

NEEDS = {"gsplat": ("torch", "gsplat"), "splax": ("splax",)}
ON_CPU = {"gsplat": {"JAX_PLATFORMS": "cpu"}}  # where torch is to have the GPU's memory for itself
MOST_SECONDS = 90  # for one program; building its kernels may take longer
SHOWN = 300  # characters of an error


def others(plan: Plan) -> dict[str, Any]:
    """Times each program on the scenes of `speed.scenes`; tells in a line why one has no times."""
    return {name: "it needs a GPU" if plan.emulated else measured(name, plan) for name in NEEDS}


def measured(name: str, plan: Plan) -> Any:
    """Returns what `gpu_check.rivals` measures in a process of its own, or why it does not."""
    missing = [package for package in NEEDS[name] if importlib.util.find_spec(package) is None]
    if missing:
        return f"not installed: {', '.join(missing)}"
    numbers = (*plan.size, plan.rounds, *plan.counts)
    command = [sys.executable, "-m", "gpu_check.rivals", name, *map(str, numbers)]
    variables = environment(**ON_CPU.get(name, {}))
    try:
        done = subprocess.run(
            command, env=variables, capture_output=True, text=True, timeout=MOST_SECONDS, check=False
        )
        said, error = done.stdout, done.stderr.strip()
        ended = f"ended with {done.returncode}" if done.returncode else ""
    except subprocess.TimeoutExpired as stopped:
        said, error = (stopped.stdout or b"").decode(), ""
        ended = f"stopped after {MOST_SECONDS} s"
    found: dict[str, Any] = {}
    for line in said.splitlines():
        if line.startswith("{"):  # packages print lines of their own
            found |= json.loads(line)
    if ended:
        found["not measured"] = " ".join(f"{ended}: {error[-SHOWN:]}".split())
    return found
