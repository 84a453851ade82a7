"""Density control: when and how the number of Gaussians changes."""

from splatax.training.density.classic import Classic
from splatax.training.density.fixed import Fixed
from splatax.training.density.mcmc import ByFactor, ByStep, Mcmc
from splatax.training.density.protocol import DensityStrategy, Lineage, Refinement

STRATEGIES = {"classic": Classic, "fixed": Fixed, "mcmc": Mcmc}

__all__ = [
    "STRATEGIES",
    "ByFactor",
    "ByStep",
    "Classic",
    "DensityStrategy",
    "Fixed",
    "Lineage",
    "Mcmc",
    "Refinement",
]
