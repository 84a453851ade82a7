"""Photos with another exposure do not change the colours of the scene."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

import splatax as sx
from splatax.outputs import over
from splatax.training.appearance import Exposure, NoAppearance
from splatax.training.density import NoDensityControl
from splatax.training.loop import optimize
from splatax.training.protocols import Source
from splatax.training.recipes import ShSchedule
from training.test_training import RECIPE, capture

GAINS = (1.15, 0.7, 1.3, 0.85, 1.0)  # of the five training photos, unlike those of neighbours; mean 1


def exposed(dataset):
    def photo(view, gain):
        pixels = np.clip(view.pixels() * gain, 0, 255).round().astype(np.uint8)
        return replace(view, pixels=lambda: pixels)

    return replace(dataset, train=tuple(photo(v, g) for v, g in zip(dataset.train, GAINS, strict=True)))


def run(dataset, appearance):
    recipe = replace(
        RECIPE.on(sx.backends.resolve("auto")),
        steps=300,
        density=NoDensityControl(),
        appearance=appearance,
        sh=ShSchedule(0),
    )
    for progress in optimize(dataset, recipe):
        pass
    return progress


@pytest.mark.slow
def test_exposure_is_learned_and_the_scene_keeps_neutral_colours():
    dataset = exposed(capture())
    plain, learned = run(dataset, NoAppearance()), run(dataset, Exposure(rate=0.02, rate_final=0.002))
    values = learned.state.train.appearance.values
    assert_allclose(jnp.mean(values, axis=0), 0, atol=1e-6)
    grey = np.asarray(values).reshape(5, 3, 4) @ np.array([0.5, 0.5, 0.5, 1.0])
    gains = 1 + grey.mean(axis=1) / 0.5
    assert np.corrcoef(gains, GAINS)[0, 1] > 0.9
    scores = [sx.evaluate(progress.gaussians, dataset.test).psnr for progress in (plain, learned)]
    assert scores[1] > scores[0] + 0.5, (gains, scores)


def test_a_map_changes_the_scene_and_leaves_the_background():
    change = jnp.zeros((3, 4)).at[0, 0].set(0.5).at[1, 3].set(0.1).at[2, 0].set(-0.25)
    color, alpha, background = jnp.array([0.4, 0.2, 0.8]), jnp.full((1, 1), 0.25), jnp.array([1.0, 0.5, 0.0])
    sums = alpha[..., None] * color[None, None, :]
    seen = over(Exposure()(change.reshape(12), sums, alpha), alpha, background)[0, 0]
    expected = 0.25 * np.array([0.6, 0.3, 0.7]) + 0.75 * background
    assert_allclose(seen, expected, atol=1e-6)


def test_a_lone_photo_has_the_colours_of_the_scene():
    exposure, source = Exposure(), Source(np.int32(0), np.int32(0))
    state = exposure.update(exposure.init(1), source, jnp.ones(12), jnp.float32(0), jnp.float32(9))
    assert_allclose(exposure.for_photo(state, source), 0)
