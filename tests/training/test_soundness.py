"""Values that are not finite do not spread, are removed, and are counted."""

from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import splatax as sx
from shortened import shortened
from splatax.gaussians import broken
from splatax.losses import Photometric
from splatax.training.capacity import pad
from splatax.training.loop import RunState, first_state
from splatax.training.recipes import PRESETS, Objective
from training.test_training import capture


@dataclass(frozen=True)
class Touchy(Photometric):
    """A loss that is not finite for black photos."""

    def __call__(self, image, photo, mask, kernel):
        return jnp.where(photo.max() > 0, super().__call__(image, photo, mask, kernel), jnp.nan)


def with_a_black_photo(dataset):
    black = replace(dataset.train[0], pixels=lambda: np.zeros_like(dataset.train[1].pixels()))
    return replace(dataset, train=(black, *dataset.train[1:]))


def finite(gaussians):
    """Whether no number is NaN or infinite, apart from those that have a meaning; see `is_sound`."""
    return not broken(gaussians).any()


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_a_step_without_a_finite_loss_changes_no_gaussian_and_is_counted(name):
    dataset = with_a_black_photo(capture())
    recipe = replace(shortened(name), objective=Objective(loss=Touchy()))
    before, bad = None, 0
    for progress in sx.optimize(dataset, recipe):
        now, refined = progress.gaussians, recipe.density.due(progress.step)
        if not jnp.isfinite(progress.loss):
            bad += 1
            if before is not None and not refined:
                for old, new in zip(jax.tree.leaves(before), jax.tree.leaves(now), strict=True):
                    np.testing.assert_allclose(new, old, rtol=5e-7)  # quaternions are normalized again
        before = now
    assert 0 < bad < progress.step
    assert int(progress.faults.steps) == bad
    assert finite(progress.gaussians)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "field"),
    # What is not finite is found by the step, which all recipes share; density control takes it away.
    [
        *(("default", field) for field in ("means", "log_scales", "sh")),
        *((n, "opacity_logits") for n in PRESETS),
    ],
)
def test_a_gaussian_that_is_not_finite_is_removed_and_the_rest_learns_on(name, field):
    dataset, recipe = capture(), shortened(name)
    recipe = recipe.on(sx.backends.resolve("auto"))
    gaussians = recipe.initialization(dataset, recipe.sh.degree, recipe.seed)
    broken = replace(gaussians, **{field: getattr(gaussians, field).at[3].set(jnp.nan)})
    start = first_state(pad(broken, 1024), recipe, dataset.extent, len(dataset.train))
    losses = []
    for progress in sx.optimize(dataset, recipe, RunState(start, len(gaussians))):
        losses.append(float(progress.loss))
    assert int(progress.faults.gaussians) == 1
    assert np.isfinite(losses).all()
    assert finite(progress.gaussians)
