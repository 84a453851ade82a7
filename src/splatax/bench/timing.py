"""Times that survive a busy machine: all operations in turn, round after round, in one process.

What disturbs one then disturbs its neighbours too. Medians tell what to expect, minima what the
code can do, ratios within one run what is faster.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import jax
import numpy as np

from splatax.bench.operations import Operation


@dataclass(frozen=True)
class Timing:
    """Of one operation, milliseconds."""

    median: float
    minimum: float
    first: float  # the first call, which compiles


def interleaved(operations: Mapping[str, Operation], rounds: int) -> Iterator[dict[str, Timing]]:
    """Times all operations once in each round, after a first call of each.

    Args:
        operations: by name.
        rounds: how often, at least 1.

    Yields:
        After each round, all timings so far; the last is the result.
    """
    first = {name: timed(operation) for name, operation in operations.items()}
    times: dict[str, list[float]] = {name: [] for name in operations}
    for _ in range(rounds):
        for name, operation in operations.items():
            times[name].append(timed(operation))
        yield {
            name: Timing(float(np.median(taken)), min(taken), first[name]) for name, taken in times.items()
        }


def timed(operation: Operation) -> float:
    """Milliseconds until the results of one call are there."""
    began = time.perf_counter()
    jax.block_until_ready(operation())
    return (time.perf_counter() - began) * 1e3
