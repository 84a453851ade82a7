"""A run that learns a rolling shutter leaves a capture whose cameras move as it has learned."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image

import splatax as sx
from splatax.runs.checkpoints import Checkpoints
from splatax.runs.results import NoPages, Results
from splatax.runs.session import Session
from splatax.training.camera_refinement import CAMERA_REFINEMENTS, refined
from training.test_training import RECIPE, capture


@pytest.mark.slow
def test_the_motions_that_a_run_has_learned_are_read_with_its_cameras(tmp_path):
    dataset = capture()
    recipe = replace(RECIPE, steps=7, camera_refinement=CAMERA_REFINEMENTS["poses+shutter"])
    with Checkpoints(tmp_path, {}) as checkpoints:
        run = Session(dataset, recipe, checkpoints)
        for _ in run.steps():
            pass
    results = Results("shutter", dataset, recipe, run.history, run.last, {}, tmp_path)
    results.write(NoPages())
    state = run.last.train
    found = {
        view.name: view.camera
        for view in refined(recipe.camera_refinement, state.cameras, dataset.train, state.extent)
    }
    assert all(np.any(camera.motion.twist) for camera in found.values())
    photos = tmp_path / "refined" / "images"
    photos.mkdir()
    for view in dataset.views:
        Image.fromarray(np.asarray(view.pixels())).save(photos / view.name)
    again = {view.name: view.camera for view in sx.load_dataset(tmp_path / "refined").views}
    assert again.keys() == {view.name for view in dataset.views}
    for name, camera in again.items():
        if name in found:
            assert_array_equal(camera.motion.twist, found[name].motion.twist)
        else:  # held-out photos stay as they were given
            assert camera.motion is None
