"""`splatax doctor`: a self-test of this installation."""

import os
import sys
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from rich.table import Table

import splatax as sx
from splatax import backends
from splatax.backends.cpu import library
from splatax.backends.cuda import nvidia
from splatax.bench.scenes import procedural
from splatax.cli.output import complain, say, show
from splatax.runs.machine import device, versions

GAUSSIANS, SIZE = 500, (64, 48)  # of the self-test
TOLERANCE = 1e-4  # of the largest value: float32 sums over pixels in another order


@dataclass(frozen=True)
class Doctor:
    """Show devices, backends and versions, and test each backend on a small scene.

    The test compares image and gradients with the reference. The exit code is 1 if any differs.
    """

    def run(self) -> None:
        say(f"device        {device()}; JAX runs on {jax.default_backend()}")
        say(f"threads       {usable_threads()} usable by this process")
        if library.why_unavailable(None) is None:
            say(f"instructions  {library.best_instructions()}")
        if backends.why_unavailable("cuda") is None:
            say(f"cuda          {nvidia.describe()}")
        say("versions      " + ", ".join(f"{name} {version}" for name, version in versions().items()))
        table = Table("backend", "state", "largest difference from the reference")
        chosen, sound = backends.resolve().name, True
        expected = image_and_gradient("reference")
        for name in backends.BACKENDS:
            reason = backends.why_unavailable(name)
            if reason is not None:
                table.add_row(name, f"not available: {reason}", "")
                continue
            error = difference(image_and_gradient(name), expected)
            sound &= error <= TOLERANCE
            state = "chosen by auto" if name == chosen else "available"
            table.add_row(name, state, f"{error:.1e}" + ("" if error <= TOLERANCE else "  WRONG"))
        show(table)
        if not sound:
            complain(
                "a backend gives wrong results on this machine. Please report this with all output above."
            )
            sys.exit(1)


def usable_threads() -> int:
    """Returns the number of threads that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def image_and_gradient(backend: str) -> list[np.ndarray]:
    """Returns the image of a small scene, and gradients of a sum over it with respect to scene and camera."""
    scene = procedural(GAUSSIANS, SIZE)
    weights = jnp.asarray(np.random.default_rng(0).normal(size=(SIZE[1], SIZE[0], 3)), jnp.float32)

    def objective(gaussians, camera):
        image = sx.render(gaussians, camera, backend=backend).rgb
        return jnp.sum(image * weights), image

    (_, image), gradient = jax.value_and_grad(objective, (0, 1), has_aux=True)(scene.gaussians, scene.camera)
    return [np.asarray(array) for array in (image, *jax.tree.leaves(gradient))]


def difference(actual: list[np.ndarray], expected: list[np.ndarray]) -> float:
    """Returns the largest relative difference; infinite if a value is not finite."""
    errors = [
        np.abs(a - e).max() / max(np.abs(e).max(), 1e-12) for a, e in zip(actual, expected, strict=True)
    ]
    return float(max(errors)) if np.isfinite(errors).all() else float("inf")
