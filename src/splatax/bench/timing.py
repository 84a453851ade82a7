"""Interleaved timing for busy machines: all operations in turn, round after round, in one process.

A disturbance then affects all operations alike. The median is the time to expect, the minimum the time
that the code can reach, and ratios within one run show which operation is faster.
"""

import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import jax
import numpy as np

from splatax.bench.operations import Operation


@dataclass(frozen=True)
class Timing:
    """Times of one operation, milliseconds."""

    median: float
    minimum: float
    first: float  # the first call, which compiles


def interleaved(operations: Mapping[str, Operation], rounds: int) -> Iterator[dict[str, Timing]]:
    """Times all operations once in each round, after a first call of each.

    Args:
        operations: functions to time, by name.
        rounds: number of rounds, at least 1.

    Yields:
        All timings so far, after each round; the last one is the result.
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
    """Returns the milliseconds until the results of one call are ready."""
    began = time.perf_counter()
    jax.block_until_ready(operation())
    return (time.perf_counter() - began) * 1e3
