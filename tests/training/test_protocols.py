"""A part that a user writes needs the methods of its protocol and nothing else of splatax."""

from dataclasses import dataclass, fields, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import splatax as sx
from splatax.training import protocols
from splatax.training.drawing import Drawing
from splatax.training.optimizer import LearningRates, Optimizer
from splatax.training.protocols import DensityPlan
from splatax.training.recipes import Objective, ShSchedule
from training.test_training import capture, run


@dataclass(frozen=True)
class OnAGrid:
    """Starts from a regular grid of grey Gaussians."""

    side: int = 4

    def number(self, dataset):
        return self.side**3

    def __call__(self, dataset, sh_degree, seed):
        axis = np.linspace(-0.8, 0.8, self.side, dtype=np.float32)
        n = self.side**3
        return sx.Gaussians(
            jnp.asarray(np.stack(np.meshgrid(axis, axis, axis), -1).reshape(n, 3)),
            jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (n, 1)),
            jnp.full((n, 3), -1.5),
            jnp.zeros(n),
            jnp.zeros((n, (sh_degree + 1) ** 2, 3)),
        )


@dataclass(frozen=True)
class SquaredError:
    def __call__(self, image, photo, mask, kernel):
        return jnp.mean((image - photo) ** 2)


@dataclass(frozen=True)
class SmallHarmonics:
    weight: float = 1e4  # harmonics begin at zero, so a small weight would change nothing in 8 steps

    def __call__(self, gaussians, extent, living):
        return self.weight * jnp.mean(gaussians.sh[:, 1:] ** 2)


@dataclass(frozen=True)
class Arm:
    length: float = 0.5

    def __call__(self, depths, extent):
        return jnp.full_like(depths, self.length)


@dataclass(frozen=True)
class Shake:
    """Moves all centres, and remembers nothing."""

    def __call__(self, gaussians, rate, extent, key):
        shift = rate[:, None] * jax.random.normal(key, gaussians.means.shape)
        return replace(gaussians, means=gaussians.means + shift)


@dataclass(frozen=True)
class DropFaintest:
    """Counts views, and removes the faintest Gaussian at step 4."""

    def init(self, capacity):
        return jnp.int32(0)

    def watch(self, splats):
        return splats

    def observe(self, state, splats, d_splats):
        return state + 1

    def due(self, step):
        return step == 4

    def columns(self, state, gaussians):
        return gaussians.opacity_logits

    def plan(self, columns, step, extent, key):
        parents = np.argsort(-columns)[:-1]
        return DensityPlan(parents, np.zeros(len(parents), bool))

    def reborn(self, gaussians, state, given):
        assert state.shape == ()  # it is not by row
        return gaussians


@dataclass(frozen=True)
class Gain:
    """Learns the brightness of each photo by plain gradient descent."""

    def init(self, photos):
        return jnp.zeros(photos)

    def for_photo(self, state, source):
        return state[source.view]

    def __call__(self, parameters, sums, alpha):
        return sums * jnp.exp(parameters)

    def update(self, state, source, gradient, progress, steps):
        return state.at[source.view].add(-0.1 * gradient)


@dataclass(frozen=True)
class Shift:
    """Learns a common translation of the cameras."""

    def init(self, photos):
        return jnp.zeros(3)

    def for_photo(self, state, source):
        return state

    def __call__(self, parameters, camera, extent):
        moved = camera.cam_from_world.at[:3, 3].add(extent * parameters)
        return replace(camera, cam_from_world=moved)

    def update(self, state, source, gradient, progress, steps):
        return state - 1e-3 * gradient


@dataclass(frozen=True)
class Near:
    """Pulls what is seen to a distance of 4."""

    @property
    def outputs(self):
        return {"distance": sx.outputs.OUTPUTS["distance"]}

    @property
    def after(self):
        return 0.0

    def __call__(self, images, seen):
        return 0.1 * jnp.mean(jnp.square(images["distance"] - 4))


@dataclass(frozen=True)
class FirstPhotoTwice:
    """Counts the first photo twice."""

    def init(self, photos):
        return ()

    def of_photos(self, state, photos, progress):
        return jnp.ones(photos).at[0].set(2)

    def of_photo(self, state, photo, progress):
        return jnp.where(photo == 0, 2.0, 1.0)

    def update(self, state, photo, loss):
        return state


@dataclass(frozen=True)
class Grey:
    rgb: tuple[float, float, float] = (0.5, 0.5, 0.5)

    def sample(self, key):
        return jnp.full(3, 0.5)


@dataclass(frozen=True)
class HalfSizeAtEvenSteps:
    divisors = (1, 2)

    def divisor(self, step, size):
        return 2 - step % 2


@dataclass(frozen=True)
class RmsProp:
    decay: float = 0.9

    def __call__(self):
        return optax.rmsprop(1.0, self.decay)


PARTS = {
    "initialization": (protocols.Initialization, OnAGrid()),
    "loss": (protocols.Loss, SquaredError()),
    "prior": (protocols.Prior, SmallHarmonics()),
    "geometry": (protocols.Geometry, Near()),
    "weights": (protocols.PhotoWeights, FirstPhotoTwice()),
    "density": (protocols.DensityStrategy, DropFaintest()),
    "appearance": (protocols.Appearance, Gain()),
    "camera_refinement": (protocols.CameraRefinement, Shift()),
    "background": (protocols.Background, Grey()),
    "resolution": (protocols.ResolutionSchedule, HalfSizeAtEvenSteps()),
    "rule": (protocols.UpdateRule, RmsProp()),
    "reach": (protocols.Reach, Arm()),
    "noise": (protocols.Noise, Shake()),
}
RECIPE = sx.Recipe(steps=8, sh=ShSchedule(1, 2))


def with_part(recipe, name, part):
    if name in ("loss", "prior", "geometry", "weights"):
        return replace(recipe, objective=replace(recipe.objective, **{name: part}))
    if name in ("rule", "reach", "noise"):
        return replace(recipe, optimizer=replace(recipe.optimizer, **{name: part}))
    if name == "background":
        return replace(recipe, drawing=replace(recipe.drawing, background=part))
    return replace(recipe, **{name: part})


def test_every_part_of_a_recipe_that_has_a_protocol_is_written_here():
    written = {protocol.__name__ for protocol, _ in PARTS.values()}
    named = {
        str(field.type) for record in (sx.Recipe, Objective, Optimizer, Drawing) for field in fields(record)
    }
    declared = {name for name, value in vars(protocols).items() if getattr(value, "_is_protocol", False)}
    in_recipes = {name for name in declared if any(name in text for text in named)}
    assert in_recipes == written


@pytest.mark.parametrize("name", PARTS)
def test_a_part_that_a_user_writes_trains(name):
    protocol, part = PARTS[name]
    assert isinstance(part, protocol)
    plain, own = (run(capture(), recipe) for recipe in (RECIPE, with_part(RECIPE, name, part)))
    gaussians = own[-1][3].gaussians
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(gaussians))
    assert [loss for _, loss, _, _ in own] != [loss for _, loss, _, _ in plain]
    assert len(gaussians) == {"initialization": 64, "density": 79}.get(name, 80)


def test_all_parts_together_are_the_users_and_the_run_repeats_bit_for_bit():
    recipe = RECIPE
    for name, (_, part) in PARTS.items():
        recipe = with_part(recipe, name, part)
    first, second = (run(capture(), recipe) for _ in range(2))
    assert [loss for _, loss, _, _ in first] == [loss for _, loss, _, _ in second]
    assert first[-1][2] == 63


def test_a_part_of_optax_needs_no_class():
    rule = partial(optax.sgd, 1.0, momentum=0.9)
    recipe = replace(RECIPE, optimizer=Optimizer(rule, LearningRates()))
    assert np.isfinite(run(capture(), recipe)[-1][1])
