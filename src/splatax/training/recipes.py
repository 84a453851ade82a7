"""A recipe: everything that decides how a scene is trained, as one value."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

from splatax.backends.protocol import Kernels
from splatax.dataset import Dataset
from splatax.losses import Photometric
from splatax.projection import Dilation, LowPass
from splatax.training.appearance import Appearance, NoAppearance
from splatax.training.backgrounds import Background, Random, Solid
from splatax.training.camera_refinement import CameraRefinement, FixedCameras
from splatax.training.density import ByStep, Classic, DensityStrategy, Mcmc
from splatax.training.initialize import FromPoints, InFrusta
from splatax.training.noise import Langevin, Noise, NoNoise
from splatax.training.optimizer import LearningRates
from splatax.training.priors import NoPrior, Prior, Sparsity
from splatax.training.resolution import Resolution


@dataclass(frozen=True)
class Recipe:
    """Composed of objects that can each be replaced. Hashable: it is static under `jit`."""

    steps: int = 30_000
    initialization: FromPoints | InFrusta = FromPoints()
    loss: Photometric = Photometric()
    prior: Prior = NoPrior()
    learning_rates: LearningRates = LearningRates()
    noise: Noise = NoNoise()
    density: DensityStrategy = Classic()
    appearance: Appearance = NoAppearance()
    camera_refinement: CameraRefinement = FixedCameras()  # of the training cameras
    resolution: Resolution = Resolution()
    sh_degree: int = 3  # 0 to 4
    sh_every: int = 1_000  # steps after which the next band of spherical harmonics is free
    background: Background = Solid()
    low_pass: LowPass = Dilation()
    backend: str | Kernels = "auto"
    seed: int = 0


def classic(steps: int = 30_000, max_gaussians: int = 5_000_000) -> Recipe:
    """Kerbl et al. 2023. Density control ends halfway, at 15,000 of 30,000 steps."""
    return Recipe(steps=steps, density=Classic(until=min(15_000, steps // 2), max_gaussians=max_gaussians))


def absgrad(steps: int = 30_000, max_gaussians: int = 5_000_000) -> Recipe:
    """Ye et al. 2024 (AbsGS): as `classic`, but pixels that pull in opposite directions add up.

    With the threshold that gsplat recommends for it.
    """
    until = min(15_000, steps // 2)
    density = Classic(until=until, pull_threshold=8e-4, absolute=True, max_gaussians=max_gaussians)
    return Recipe(steps=steps, density=density)


def mcmc(steps: int = 30_000, max_gaussians: int = 1_000_000) -> Recipe:
    """Kheradmand et al. 2024. Growth ends at five sixths, at 25,000 of 30,000 steps."""
    return Recipe(
        steps=steps,
        initialization=FromPoints(opacity=0.5, scale=0.1),
        prior=Sparsity(),
        noise=Langevin(),
        density=Mcmc(until=min(25_000, steps * 5 // 6), max_gaussians=max_gaussians),
    )


GROWING = 3  # a run of `default` has all its Gaussians after one of so many parts
COARSE = 2  # and sees photos of half size for one of so many
GROWN = 0.85  # share of a run after which no Gaussian is moved to another place, and all settle


def default(steps: int = 30_000, max_gaussians: int = 1_000_000) -> Recipe:
    """The best known for a given number of steps: all settings follow from it.

    It grows early, to a number that is given, and learns faster than the authors do, the more so
    the fewer steps there are to get anywhere.
    """
    return Recipe(
        steps=steps,
        initialization=FromPoints(opacity=0.5, scale=0.1),
        prior=Sparsity(),
        learning_rates=replace(rates_for(steps), settled=0.05, settling_from=GROWN),
        noise=Langevin(1.25e5),  # of the raised rate: at 2,000 steps, three times the noise of the authors
        density=Mcmc(
            every=min(max(steps // 40, 10), 100),
            start=steps // 20,
            until=int(steps * GROWN),
            growth=ByStep(full=steps // GROWING),
            max_gaussians=max_gaussians,
        ),
        resolution=Resolution(((steps // COARSE, 2),), smallest=100),
        sh_every=max(steps // 20, 1),
        background=Random(),
    )


def rates_for(steps: int) -> LearningRates:
    """Learning rates that suit a short run: the authors', raised by up to 12 times at 2,000 steps.

    How much they are raised falls with the square root of the number of steps, down to the authors'
    own rates, which are for 30,000. Runs of less than 500 steps learn as those of 500.
    """
    authors, haste = LearningRates(), math.sqrt(2_000 / max(steps, 500))

    def raised(rate: float, by: float) -> float:
        return rate * max(by * haste, 1.0)

    return LearningRates(
        means=raised(authors.means, 12.0),
        means_final=raised(authors.means_final, 12.0),
        sh_dc=raised(authors.sh_dc, 3.0),
        sh_rest=raised(authors.sh_rest, 3.0),
        opacity_logits=authors.opacity_logits,
        log_scales=raised(authors.log_scales, 4.5),
        quats=raised(authors.quats, 6.0),
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


RECIPES: dict[str, Callable[..., Recipe]] = {
    "classic": classic,
    "absgrad": absgrad,
    "mcmc": mcmc,
    "default": default,
}
