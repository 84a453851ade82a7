"""A recipe: everything that decides how a scene is trained, as one value."""

from collections.abc import Callable
from dataclasses import dataclass

from splatax.losses import Photometric
from splatax.projection import Dilation, LowPass
from splatax.training.backgrounds import Background, Solid
from splatax.training.density import Classic, DensityStrategy
from splatax.training.initialize import FromPoints, InFrusta
from splatax.training.optimizer import LearningRates


@dataclass(frozen=True)
class Recipe:
    """Composed of objects that can each be replaced. Hashable: it is static under `jit`."""

    steps: int = 30_000
    initialization: FromPoints | InFrusta = FromPoints()
    loss: Photometric = Photometric()
    learning_rates: LearningRates = LearningRates()
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


RECIPES: dict[str, Callable[..., Recipe]] = {"classic": classic}
