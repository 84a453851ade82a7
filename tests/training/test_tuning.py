"""A scene that lost Gaussians is tuned without changing their number."""

from dataclasses import replace

import numpy as np
import pytest

import splatax as sx
from splatax import editing
from splatax.training.recipes import default
from splatax.training.tuning import tune, tuning


@pytest.mark.slow
def test_tuning_regains_what_simplifying_lost_and_keeps_number_and_original():
    dataset = sx.demo_dataset(photos=4, width=48, height=36)
    scene = sx.fit(dataset, default(steps=80, max_gaussians=3_000))
    few = editing.simplify(scene, 1_000)
    before = np.asarray(few.means).copy()
    lost, regained = sx.evaluate(few, dataset.train).psnr, None
    for progress in tune(few, dataset, tuning(few, 60)):
        assert progress.count == 1_000
    regained = sx.evaluate(progress.gaussians, dataset.train).psnr
    assert regained > lost + 2
    assert progress.gaussians.sh.shape == few.sh.shape
    assert (np.asarray(few.means) == before).all()  # not donated to the first step


def test_tuning_keeps_harmonics_filter_and_order_of_the_scene():
    dataset = sx.demo_dataset(photos=2, width=48, height=36)
    scene = default(steps=10).initialization(dataset, 1, 0)
    filtered = replace(scene, low_pass=sx.Antialiasing(), order="distance")
    *_, last = tune(filtered, dataset, tuning(filtered, 3))
    assert last.gaussians.low_pass == sx.Antialiasing()
    assert last.gaussians.order == "distance"
    assert last.gaussians.sh.shape[1] == 4
