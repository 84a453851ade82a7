"""Labels of Gaussians from label images of photos."""

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, plane_of_gaussians
from splatax import editing, sensors
from splatax.errors import InputError

NORMAL = np.array([0.0, 0.0, -1.0])
PLANE = plane_of_gaussians(NORMAL, n=800, half=1.5, sigma=0.06)
BESIDE = np.where(np.asarray(PLANE.means)[:, 0] > 0, 2, 1)  # label of each Gaussian: right or left of x = 0
FROM = {"train": [(0.3, 0.2, -3.0), (-0.5, 0.0, -2.6)], "test": [(0.1, -0.4, -2.8)]}


def seen(position):
    """A camera and its true label image: 1 left of x = 0, 2 right of it."""
    camera = camera_at(position, size=(48, 36), focal=40.0)
    x = np.asarray(sensors.observe(PLANE, camera, {"p": sensors.PointCloud(frame="world")})["p"])[..., 0]
    return camera, np.where(np.isnan(x), 0, np.where(x > 0, 2, 1)).astype(np.int32)


@pytest.mark.slow
def test_labels_of_two_photos_hold_in_a_third():
    votes = editing.votes(PLANE, [seen(place) for place in FROM["train"]], 3)
    labels = editing.labels_of(votes)
    voted = votes.sum(axis=1) > 1
    assert voted.sum() > 600
    assert (labels == BESIDE)[voted].mean() > 0.97  # some lie across the border
    camera, truth = seen(FROM["test"][0])
    shown = sensors.observe(PLANE, camera, {"l": sensors.Labels(jnp.asarray(labels), 3)})["l"]
    ratios = editing.intersection_over_union(np.maximum(shown, 0), truth, 3)
    assert np.nanmean(ratios) > 0.9
    parts = editing.split_by_label(PLANE, labels, ("background", "left", "right"))
    assert {"left", "right"} <= set(parts.names)
    assert len(parts) == len(PLANE)
    drawn = sensors.observe(parts, camera, {"l": sensors.Labels()})["l"]
    kept = np.flatnonzero(np.bincount(labels, minlength=3))
    assert_array_equal(np.where(drawn < 0, -1, kept[np.maximum(drawn, 0)]), shown)


def test_votes_are_the_pixels_that_a_gaussian_fills_and_silent_pixels_do_not_vote():
    camera, truth = seen(FROM["test"][0])
    votes = editing.votes(PLANE, [(camera, truth)], 3)
    assert_allclose(votes.sum(), np.asarray(sx.render(PLANE, camera).alpha).sum(), rtol=1e-4)
    silent = np.where(truth == 2, -1, truth)
    fewer = editing.votes(PLANE, [(camera, silent)], 3)
    assert_allclose(fewer[:, :2], votes[:, :2], atol=1e-5)
    assert_array_equal(fewer[:, 2], 0)


def test_gaussians_without_votes_are_background():
    assert_array_equal(editing.labels_of(np.array([[0.0, 0, 0], [0.1, 0, 3]])), [0, 2])


def test_intersection_over_union_counts_pixels_and_leaves_out_silent_ones():
    found, truth = np.array([0, 0, 1, 1, 1]), np.array([0, 1, 1, 1, -1])
    assert_allclose(editing.intersection_over_union(found, truth, 3), [1 / 2, 2 / 3, np.nan])


def test_labels_that_do_not_fit_are_refused():
    camera, truth = seen(FROM["test"][0])
    with pytest.raises(InputError, match="a label image of 47 x 36 pixels for a camera of 48 x 36"):
        editing.votes(PLANE, [(camera, truth[:, 1:])], 3)
    with pytest.raises(InputError, match="has the label 2, which is not from 0 to 1"):
        editing.votes(PLANE, [(camera, truth)], 2)
    with pytest.raises(InputError, match="two labels have one name"):
        editing.split_by_label(PLANE, BESIDE, ("a", "b", "b"))
