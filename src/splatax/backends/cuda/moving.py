"""A training step of the rows of a scene on the GPU; see `splatax.moving` for what it computes."""

import jax
import numpy as np

from splatax.backends.cuda.library import Library
from splatax.backends.packed_steps import PLACES, inputs
from splatax.gaussians import Gaussians
from splatax.moving import Moments, Rule, Step, checked


def move(
    gaussians: Gaussians,
    gradients: Gaussians,
    moments: Moments,
    step: Step,
    rule: Rule,
    block: int,
    library: Library,
) -> tuple[Gaussians, Moments]:
    """Makes one step with all rows, in place if the caller donates the arrays.

    Numbers at rest are not written. Numbers below 2^-126 are not flushed to zero.

    Raises:
        ValueError: if arrays do not fit together.
    """
    checked(gaussians, gradients, moments, step, block)
    moved = library.call(
        "splatax_cuda_move",
        [leaf.shape for leaf in jax.tree.leaves((gaussians, moments))],
        [*jax.tree.leaves((gaussians, gradients, moments)), *inputs(step, rule)],
        PLACES,
        block=np.int64(block),
    )
    return jax.tree.unflatten(jax.tree.structure((gaussians, moments)), moved)
