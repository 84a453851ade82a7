"""Recipes: all settings of a training run as one value, and the presets that build them."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from splatax.backends.protocol import Kernels
from splatax.dataset import Dataset, photos_in
from splatax.losses import Photometric
from splatax.low_pass import AlongRays
from splatax.math.harmonics import MAX_DEGREE
from splatax.rendering import Renderer
from splatax.training.appearance import NoAppearance
from splatax.training.backgrounds import Random
from splatax.training.camera_refinement import FixedCameras
from splatax.training.density import ByStep, Classic, Mcmc, Splitting
from splatax.training.disc_geometry import DiscGeometry
from splatax.training.drawing import Drawing as Drawing
from splatax.training.geometry import NoGeometry
from splatax.training.initialize import Discs, FromPoints, InFrusta
from splatax.training.noise import Langevin
from splatax.training.optimizer import Adam, Optimizer, ViewDepth, rates_for
from splatax.training.photo_weights import EqualWeights
from splatax.training.priors import NoPrior, Sparsity, opacity_penalty
from splatax.training.protocols import (
    Appearance,
    CameraRefinement,
    DensityStrategy,
    Geometry,
    Initialization,
    Loss,
    PhotoWeights,
    Prior,
    ResolutionSchedule,
)
from splatax.training.resolution import Resolution


@dataclass(frozen=True)
class ShSchedule:
    """The degree of the spherical harmonics, and the steps after which their bands are learned."""

    degree: int = 3  # 0 to 4
    every: int = 1_000  # steps; band l is learned after l times as many

    def openings(self, steps: int) -> Float[np.ndarray, " bands"]:
        """Returns the fraction of a run of `steps` steps after which each band is learned, in float32.

        They are fractions so that the bands follow a run whose number of steps changes while it is made.
        """
        after = np.arange(MAX_DEGREE + 1, dtype=np.float32) * np.float32(self.every)
        return after / np.float32(steps)


@dataclass(frozen=True)
class Objective:
    """The objective of training: the loss of the photos, penalties on the scene, and weights of photos."""

    loss: Loss = Photometric()
    prior: Prior = NoPrior()
    geometry: Geometry = NoGeometry()
    weights: PhotoWeights = EqualWeights()


@dataclass(frozen=True)
class Recipe:
    """All settings of a training run. Hashable: it is static under `jit`.

    Each part can be replaced by any object with the methods that `splatax.training.protocols` lists.
    """

    steps: int = 30_000
    views: int = 1  # photos that a step learns from; with several, see `with_views`
    initialization: Initialization = FromPoints()
    objective: Objective = Objective()
    optimizer: Optimizer = Optimizer()
    density: DensityStrategy = Classic()
    appearance: Appearance = NoAppearance()
    camera_refinement: CameraRefinement = FixedCameras()
    resolution: ResolutionSchedule = Resolution()
    sh: ShSchedule = ShSchedule()
    drawing: Drawing = Drawing()
    seed: int = 0

    def on(self, backend: str | Kernels) -> "Recipe":
        """Returns the same recipe, drawn by another backend."""
        return replace(self, drawing=replace(self.drawing, backend=backend))

    def at(self, progress: float) -> "Recipe":
        """Returns the recipe of a step at a fraction of the run.

        It has no penalty on geometry before that penalty begins.
        """
        if progress >= self.objective.geometry.after:
            return self
        return replace(self, objective=replace(self.objective, geometry=NoGeometry()))

    @property
    def renderer(self) -> Renderer:
        """Draws the scene as evaluation, reports and viewers show it."""
        drawing = self.drawing
        return Renderer(drawing.background.rgb, drawing.low_pass, drawing.backend)


BATCH_POWER = 0.85  # chosen on training photos of fern and fox that no run had seen; see docs/scale.md


def with_views(recipe: Recipe, views: int) -> Recipe:
    """Returns a recipe whose steps learn from several photos each, for as many photos as one a step sees.

    The mean of k gradients has 1 / k of the variance of one, so steps may be longer: learning rates are
    raised by k^0.85. Adam remembers squares of gradients for as many photos as before: b2 becomes b2^k
    (Grendel-GS, Zhao et al. 2025, who raise rates by k^0.5, and b1 to b1^k too). The number of steps stays: a
    run looks at `views` times as many photos.
    """
    optimizer = recipe.optimizer
    rule = (
        replace(optimizer.rule, b2=optimizer.rule.b2**views)
        if isinstance(optimizer.rule, Adam)
        else optimizer.rule
    )
    optimizer = replace(optimizer, rule=rule, rates=optimizer.rates.times(views**BATCH_POWER))
    return replace(recipe, views=views, optimizer=optimizer)


def classic(steps: int = 30_000, max_gaussians: int = 5_000_000, views: int = 1) -> Recipe:
    """Returns the recipe of Kerbl et al. 2023.

    Density control ends halfway through the run, or after 15,000 steps if that is earlier.
    """
    density = Classic(until=min(15_000, steps // 2), max_gaussians=max_gaussians)
    return with_views(Recipe(steps=steps, density=density), views)


def absgrad(steps: int = 30_000, max_gaussians: int = 5_000_000, views: int = 1) -> Recipe:
    """Returns the recipe of Ye et al. 2024 (AbsGS), with the threshold that gsplat recommends for it.

    It differs from `classic` in that it adds up absolute values of the gradients of pixels.
    """
    until = min(15_000, steps // 2)
    density = Classic(until=until, pull_threshold=8e-4, absolute=True, max_gaussians=max_gaussians)
    return with_views(Recipe(steps=steps, density=density), views)


def mcmc(steps: int = 30_000, max_gaussians: int = 1_000_000, views: int = 1) -> Recipe:
    """Returns the recipe of Kheradmand et al. 2024.

    Growth ends at five sixths of the run, or after 25,000 steps if that is earlier.
    """
    recipe = Recipe(
        steps=steps,
        initialization=FromPoints(opacity=0.5, scale=0.1),
        objective=Objective(prior=Sparsity()),
        optimizer=Optimizer(noise=Langevin()),
        density=Mcmc(until=min(25_000, steps * 5 // 6), max_gaussians=max_gaussians),
    )
    return with_views(recipe, views)


GROWING = 3  # `default` grows for the first 1 / GROWING of a run
COARSE = 2  # and sees photos of half size for the first 1 / COARSE
GROWN = 0.85  # fraction of a run after which relocation ends and the learning rates fall


def default(steps: int = 30_000, max_gaussians: int = 1_000_000, views: int = 1) -> Recipe:
    """Returns the recipe with the best known results for a given number of steps.

    It differs from `mcmc` in that it grows early, to exactly `max_gaussians`, and in that its learning
    rates are higher, and its penalty on opacity lower, the fewer photos it looks at.
    """
    recipe = Recipe(
        steps=steps,
        initialization=FromPoints(opacity=0.5, scale=0.1),
        objective=Objective(prior=Sparsity(opacity=opacity_penalty(steps * views))),
        optimizer=Optimizer(
            rates=replace(rates_for(steps * views), settled=0.05, settling_from=GROWN), reach=ViewDepth()
        ),
        density=Splitting(
            every=min(max(steps // 40, 10), 100),
            start=steps // 20,
            until=int(steps * GROWN),
            growth=ByStep(full=steps // GROWING),
            max_gaussians=max_gaussians,
        ),
        resolution=Resolution(((steps // COARSE, 2),), smallest=100),
        sh=ShSchedule(every=max(steps // 20, 1)),
        drawing=Drawing(background=Random()).in_order("distance"),
    )
    return with_views(recipe, views)


def discs(steps: int = 30_000, max_gaussians: int = 1_000_000, views: int = 1) -> Recipe:
    """Returns `default` with the discs and the regularizers of 2DGS (Huang et al. 2024).

    The Gaussians are exactly flat and drawn along rays. Their initial size is the distance to their
    neighbours, and their size is not penalized: one below the blur of a pixel gets no gradient that would let
    it grow again. They are drawn in the order of depths.
    """
    recipe = default(steps, max_gaussians, views)
    return replace(
        recipe,
        initialization=Discs(FromPoints(opacity=0.5)),
        objective=replace(recipe.objective, prior=Sparsity(scale=0.0), geometry=DiscGeometry()),
        drawing=replace(recipe.drawing.in_order("depth"), low_pass=AlongRays()),
    )


PIXELS_PER_GAUSSIAN = 8  # of one photo
MOST = 1_000_000  # Gaussians of a capture of up to `MANY` photos
MANY = 1_000  # photos
EPOCHS = 30  # times that each photo of a larger capture is seen, where steps are not given


def room_for(dataset: Dataset) -> int:
    """Returns the number of Gaussians for a capture: what it has detail for, up to `most_for`."""
    return min(detail_of(dataset), most_for(dataset))


def detail_of(dataset: Dataset) -> int:
    """Returns the number of Gaussians that a capture has detail for.

    One photo has detail for one Gaussian per 8 pixels. More photos show more, but in large part the
    same again: detail is assumed to grow with the square root of their number. The faces of a 360-degree
    photo show different things, and count as one photo.
    """
    pixels = sum(view.camera.width * view.camera.height for view in dataset.train)
    return round(pixels / math.sqrt(photos_in(dataset.train)) / PIXELS_PER_GAUSSIAN)


def most_for(dataset: Dataset) -> int:
    """Returns the largest default number of Gaussians: a million, and for more photos a thousand for each."""
    return round(MOST * max(len(dataset.train) / MANY, 1))


def steps_for(dataset: Dataset) -> int:
    """Returns the number of steps where neither a number nor a time is given.

    It is 30,000, or `EPOCHS` steps for each training photo if that is more.
    """
    return max(Recipe.steps, EPOCHS * len(dataset.train))


@dataclass(frozen=True)
class Preset:
    """A recipe for any number of steps, with the defaults that go with it.

    Attributes:
        build: returns the recipe, from `steps`, `max_gaussians` and `views`.
        max_gaussians: returns the default for `max_gaussians` on a capture.
        random_start: initialization for captures without points.
        plannable: whether `splatax.runs.budget` can choose the steps for a given time: its model of the time
            that a run takes is for this recipe.
        weighs_photos: whether photos that do not fit the others get a lower weight by default. Density
            control must not reset opacities then: a reset raises the losses of the photos that come next.
    """

    build: Callable[..., Recipe]
    max_gaussians: Callable[[Dataset], int] = room_for
    random_start: InFrusta | Discs = InFrusta()
    plannable: bool = False
    weighs_photos: bool = False


def authors_limit(dataset: Dataset) -> int:
    """Returns 5,000,000 for every capture: `classic` and `absgrad` rarely grow to it."""
    return Classic.max_gaussians


PRESETS = {
    "classic": Preset(classic, authors_limit),
    "absgrad": Preset(absgrad, authors_limit),
    "mcmc": Preset(mcmc, random_start=InFrusta(opacity=0.5, scale=0.1)),
    "2dgs": Preset(discs, random_start=Discs(InFrusta(opacity=0.5))),
    "default": Preset(
        default, random_start=InFrusta(opacity=0.5, scale=0.1), plannable=True, weighs_photos=True
    ),
}
