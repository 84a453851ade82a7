"""A recipe: everything that decides how a scene is trained, as one value."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from splatax.dataset import Dataset
from splatax.losses import Photometric
from splatax.projection import Dilation, LowPass
from splatax.training.backgrounds import Background, Random, Solid
from splatax.training.density import ByStep, Classic, DensityStrategy, Mcmc
from splatax.training.initialize import FromPoints, InFrusta
from splatax.training.noise import Langevin, Noise, Still
from splatax.training.optimizer import LearningRates
from splatax.training.priors import Indifferent, Prior, Sparsity


@dataclass(frozen=True)
class Recipe:
    """Composed of objects that can each be replaced. Hashable: it is static under `jit`."""

    steps: int = 30_000
    initialization: FromPoints | InFrusta = FromPoints()
    loss: Photometric = Photometric()
    prior: Prior = Indifferent()
    learning_rates: LearningRates = LearningRates()
    noise: Noise = Still()
    density: DensityStrategy = Classic()
    sh_degree: int = 3  # 0 to 4
    sh_every: int = 1_000  # steps after which the next band of spherical harmonics is free
    background: Background = Solid()
    low_pass: LowPass = Dilation()
    backend: str = "auto"  # of the rasterizer
    seed: int = 0


def classic(steps: int = 30_000, max_gaussians: int = 5_000_000) -> Recipe:
    """Kerbl et al. 2023. Density control ends halfway, at 15,000 of 30,000 steps."""
    return Recipe(steps=steps, density=Classic(until=min(15_000, steps // 2), max_gaussians=max_gaussians))


def mcmc(steps: int = 30_000, max_gaussians: int = 1_000_000) -> Recipe:
    """Kheradmand et al. 2024. Growth ends at five sixths, at 25,000 of 30,000 steps."""
    return Recipe(
        steps=steps,
        initialization=FromPoints(opacity=0.5, scale=0.1),
        prior=Sparsity(),
        noise=Langevin(),
        density=Mcmc(until=min(25_000, steps * 5 // 6), max_gaussians=max_gaussians),
    )


def default(steps: int = 30_000, max_gaussians: int = 1_000_000) -> Recipe:
    """The best known for a given number of steps: all settings are in proportion to it."""
    return Recipe(
        steps=steps,
        initialization=FromPoints(opacity=0.5, scale=0.1),
        prior=Sparsity(),
        learning_rates=LearningRates(
            means=1.28e-3, means_final=1.28e-5, sh_dc=5e-3, sh_rest=2.5e-4, log_scales=1.5e-2, quats=4e-3
        ),
        noise=Langevin(1.25e5),
        density=Mcmc(
            every=50,
            start=100,
            until=steps * 85 // 100,
            growth=ByStep(full=steps // 3),
            max_gaussians=max_gaussians,
        ),
        sh_every=max(steps // 20, 1),
        background=Random(),
    )


PIXELS_PER_GAUSSIAN = 8  # of one photo
MOST = 1_000_000


def room_for(dataset: Dataset) -> int:
    """How many Gaussians a capture has detail for, at most a million.

    What one photo shows takes one for some pixels of it. More photos show more, but in large part the
    same again: detail is taken to grow with the square root of their number.
    """
    pixels = sum(view.camera.width * view.camera.height for view in dataset.train)
    return min(round(pixels / math.sqrt(len(dataset.train)) / PIXELS_PER_GAUSSIAN), MOST)


RECIPES: dict[str, Callable[..., Recipe]] = {"classic": classic, "mcmc": mcmc, "default": default}
