"""Density control: when and how the number of Gaussians changes."""

from splatax.training.density.classic import Classic
from splatax.training.density.mcmc import ByFactor, ByStep, Mcmc
from splatax.training.density.none import NoDensityControl
from splatax.training.density.protocol import DensityStrategy, DensityUpdate, Lineage

STRATEGIES = {"classic": Classic, "none": NoDensityControl, "mcmc": Mcmc}

__all__ = [
    "STRATEGIES",
    "ByFactor",
    "ByStep",
    "Classic",
    "DensityStrategy",
    "DensityUpdate",
    "Lineage",
    "Mcmc",
    "NoDensityControl",
]
