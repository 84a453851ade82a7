"""Density control: the strategies that add, move and remove Gaussians during training."""

from splatax.training.density.classic import Classic
from splatax.training.density.mcmc import ByFactor, ByStep, Mcmc
from splatax.training.density.none import NoDensityControl

STRATEGIES = {"classic": Classic, "none": NoDensityControl, "mcmc": Mcmc}

__all__ = ["STRATEGIES", "ByFactor", "ByStep", "Classic", "Mcmc", "NoDensityControl"]
