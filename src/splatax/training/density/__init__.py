"""Density control: the strategies that add, move and remove Gaussians during training."""

from splatax.training.density.classic import Classic
from splatax.training.density.growth import ByFactor, ByStep
from splatax.training.density.mcmc import Mcmc
from splatax.training.density.none import NoDensityControl
from splatax.training.density.splitting import Splitting

STRATEGIES = {"classic": Classic, "none": NoDensityControl, "mcmc": Mcmc, "splitting": Splitting}

__all__ = ["STRATEGIES", "ByFactor", "ByStep", "Classic", "Mcmc", "NoDensityControl", "Splitting"]
