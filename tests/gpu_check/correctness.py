"""Is the backend right on this device? Each check returns what it found, and raises AssertionError if not."""

import platform
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import jax
import numpy as np

from gpu_check.picture import largest_difference, picture
from gpu_check.plan import ROOT, TESTS, Plan, environment
from splatax.backends.cuda import nvidia, nvrtc, programs

TOLERANCE = 1e-4  # of the largest value: float32 sums in another order


def device(plan: Plan) -> dict[str, Any]:
    """Names the device and versions, and times the compilation of the kernels."""
    found = {
        "device": jax.devices()[0].device_kind,
        "jax": jax.__version__,
        "python": platform.python_version(),
    }
    if not plan.emulated:
        found["platform"] = nvidia.platform_version()
        found["available"] = nvidia.why_unavailable() or "yes"
        found["kernels"] = nvidia.describe()
    path = nvrtc.find()
    if path is None:
        assert plan.emulated, f"NVRTC is not installed: pip install {nvrtc.WHEELS[12]}"
        return found | {"NVRTC": "not installed"}
    compiler = nvrtc.load(path)
    capability = 90 if plan.emulated else nvidia.capability_of(jax.devices()[0])
    with tempfile.TemporaryDirectory() as folder:
        began = time.perf_counter()
        binary = programs.program(compiler, capability, Path(folder))
        took = time.perf_counter() - began
    return found | {"compiled": f"{len(binary)} bytes in {took:.1f} s by NVRTC {compiler.version}"}


def contracts(plan: Plan) -> dict[str, Any]:
    """Runs the contract suites on the backend."""
    command = [
        sys.executable,
        "-m",
        "pytest",
        str(TESTS / "contracts"),
        "-k",
        plan.contracts,
        "-p",
        "no:cacheprovider",
    ]
    done = subprocess.run(command, cwd=ROOT, env=environment(), capture_output=True, text=True, check=False)
    lines = done.stdout.strip().splitlines()
    assert done.returncode == 0, "\n".join(lines[-30:]) + done.stderr[-1000:]
    return {"pytest": lines[-1]}


def parity(plan: Plan) -> dict[str, Any]:
    """Compares image and gradients with the portable backend here, and with the CPU backend."""
    count, size = plan.compared
    own = picture("cuda", count, size)
    found = {
        "largest difference from xla": max(largest_difference(own, picture("xla", count, size)).values()),
        "largest difference from cpu": max(
            largest_difference(own, elsewhere("cpu", plan, JAX_PLATFORMS="cpu")).values()
        ),
    }
    assert max(found.values()) <= TOLERANCE, found
    return found


def same_bits(plan: Plan) -> dict[str, Any]:
    """Asks for the same image and gradients again and again, and in another process."""
    count, size = plan.compared
    first = picture("cuda", count, size)
    for _ in range(plan.repeats - 1):
        again = picture("cuda", count, size)
        assert all(np.array_equal(again[name], array) for name, array in first.items())
    other = elsewhere("cuda", plan)
    different = [name for name, array in first.items() if not np.array_equal(other[name], array)]
    assert not different, f"another process computes other bits of {different}"
    return {"times": plan.repeats, "processes": 2}


def sanitizers(plan: Plan) -> dict[str, Any]:
    """Runs a tiny scene under NVIDIA's compute-sanitizer, where it is installed."""
    tool = shutil.which("compute-sanitizer")
    if tool is None or plan.emulated:
        return {"compute-sanitizer": "not installed" if tool is None else "it needs a GPU"}
    found = {}
    for kind in ("memcheck", "racecheck"):
        with tempfile.TemporaryDirectory() as folder:
            program = [
                sys.executable,
                "-m",
                "gpu_check.picture",
                f"{folder}/picture.npz",
                "cuda",
                "300",
                "64",
                "48",
            ]
            command = [tool, "--tool", kind, "--error-exitcode", "9", *program]
            done = subprocess.run(
                command, env=environment(), capture_output=True, text=True, timeout=120, check=False
            )
        assert done.returncode == 0, f"{kind}: {done.stdout[-2000:]}{done.stderr[-1000:]}"
        found[kind] = "no error"
    return found


def elsewhere(backend: str, plan: Plan, **variables: str) -> dict[str, np.ndarray]:
    """Returns the picture that another process computes."""
    count, size = plan.compared
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "picture.npz"
        command = [sys.executable, "-m", "gpu_check.picture", path, backend, *(count, *size)]
        command += ["--emulated"] if plan.emulated and backend == "cuda" else []
        subprocess.run([str(part) for part in command], env=environment(**variables), check=True)
        with np.load(path) as arrays:
            return dict(arrays)
