"""New Gaussians are placed beside parents with large gradients, and the image hardly changes."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from refined import refine as refined_by

from scenes import camera_at, random_gaussians, with_slots
from splatax.rendering import project, render
from splatax.training.capacity import pad
from splatax.training.density import ByFactor, Splitting
from splatax.training.density.splitting import Observed, without_replacement
from splatax.training.optimizer import ViewDepth
from splatax.training.refining import Due

KEY = jax.random.key(0)
DOUBLES = Splitting(growth=ByFactor(2.0))


def refine(gaussians, pulls, strategy=DOUBLES, key=KEY, depth=jnp.inf):
    """Refines after one view in which the Gaussians were pulled so strongly, at a depth."""
    rows = len(gaussians) - len(pulls)
    seen = jnp.ones(len(gaussians))
    state = Observed(jnp.pad(jnp.float32(pulls), (0, rows)), seen, jnp.full_like(seen, depth))
    return refined_by(strategy, state, gaussians, len(pulls), Due(600, 1.0, key))


def test_children_lie_on_both_sides_of_their_parent_along_its_longest_axis():
    parent = replace(random_gaussians(n=1), quats=jnp.float32([[1, 0, 0, 0]]))
    parent = replace(parent, log_scales=jnp.log(jnp.float32([[0.1, 0.4, 0.2]])))
    refined = refine(pad(parent, 1024), [1.0])
    assert refined.count == 2
    first, second = np.asarray(refined.gaussians.means[:2] - parent.means)
    assert_allclose(first, -second, atol=1e-6)
    assert_allclose(np.abs(first), [0, 0.4, 0], atol=1e-6)
    assert np.all(refined.gaussians.log_scales[:2] < parent.log_scales)
    assert np.all(refined.newborn)


def test_a_split_hardly_changes_the_picture():
    gaussians = with_slots([0.3] * 40)
    refined = refine(gaussians, [1.0] * 40)
    assert refined.count == 80
    before, after = (render(g, camera_at(), backend="xla").rgb for g in (gaussians, refined.gaussians))
    assert_allclose(jnp.sum(after), jnp.sum(before), rtol=0.1)
    assert float(jnp.mean((before - after) ** 2)) < 0.06 * float(jnp.mean(before**2))


def test_a_gaussian_that_is_large_compared_with_its_depth_is_cut_to_half_of_it_on_each_axis():
    gaussians = replace(random_gaussians(n=2), log_scales=jnp.log(jnp.float32([[9, 2, 0.1], [9, 2, 0.1]])))
    refined = refine(gaussians, [0, 0], Splitting(growth=ByFactor(1.0)), depth=jnp.float32([8, jnp.inf]))
    assert_allclose(refined.gaussians.scales, [[4, 2, 0.1], [9, 2, 0.1]], rtol=1e-6)
    assert not refined.newborn[:2].any()


@pytest.mark.parametrize("largest", [0.0, -1.0, float("nan")])
def test_a_limit_of_sizes_that_would_spoil_the_scene_is_refused(largest):
    with pytest.raises(ValueError, match="largest must be above 0"):
        Splitting(largest=largest)


def test_the_least_depth_is_that_of_the_photos_with_the_centre_in_them():
    strategy, camera = Splitting(), camera_at((0.0, 0.0, -4.0))
    means = jnp.float32([[0, 0, 0], [3, 0, -3.9]])  # the second is seen beside the camera, as it is large
    gaussians = replace(random_gaussians(n=2), means=means, log_scales=jnp.log(jnp.full((2, 3), 2.0)))
    gaussians = replace(gaussians, opacity_logits=jnp.full(2, 3.0))
    splats = strategy.watch(project(gaussians, camera, backend="xla"))
    assert np.all(np.asarray(splats.extents) > 0)
    state = strategy.init(2)
    for depths in (splats.depths, splats.depths + 1):
        state = strategy.observe(state, replace(splats, depths=depths), jax.tree.map(jnp.zeros_like, splats))
    assert_allclose(state.nearest, [4, jnp.inf], rtol=1e-6)


def test_the_dead_are_moved_first_and_never_become_parents():
    opacities = [0.5, 0.001, 0.5, 0.002, 0.5, 0.5]
    refined = refine(with_slots(opacities), [1.0, 9.0, 1.0, 9.0, 1.0, 1.0], Splitting(growth=ByFactor(1.0)))
    assert refined.count == 6
    assert set(np.asarray(refined.parents)[[1, 3]]) <= {0, 2, 4, 5}
    assert np.all(np.asarray(refined.gaussians.opacities)[:6] > 0.3)


def test_nothing_is_split_that_no_pixel_pulls():
    refined = refine(with_slots([0.5] * 6), [0, 2, 0, 3, 0, 0])
    assert refined.count == 8
    assert sorted(np.asarray(refined.parents)[6:8]) == [1, 3]
    assert_array_equal(np.flatnonzero(~np.asarray(refined.newborn)), [0, 2, 4, 5])


def test_a_scene_that_no_view_has_seen_is_left_alone():
    gaussians = with_slots([0.5, 0.001, 0.5])
    refined = refine(gaussians, [0.0, 0.0, 0.0])
    assert refined.count == 3
    assert_array_equal(refined.gaussians.means[:3], gaussians.means[:3])
    assert not np.any(refined.newborn[:3])


def test_a_parent_is_split_once_and_the_maximum_is_kept():
    assert refine(with_slots([0.5] * 10), [1.0] * 10, Splitting(growth=ByFactor(9.0))).count == 20
    assert (
        refine(with_slots([0.5] * 10), [1.0] * 10, Splitting(growth=ByFactor(2.0), max_gaussians=13)).count
        == 13
    )


@pytest.mark.parametrize("draws", [1, 2, 9])
def test_draws_are_different_and_follow_the_weights(draws):
    weights = np.array([1.0, 0.0, 3.0, 6.0])
    found = [without_replacement(weights, draws, jax.random.key(i)) for i in range(2000)]
    assert all(len(set(one)) == len(one) == min(draws, 3) and 1 not in one for one in found)
    firsts = np.bincount([one[0] for one in found], minlength=4) / 2000
    assert_allclose(firsts, weights / weights.sum(), atol=0.04)


def test_steps_by_depth_are_as_many_pixels_for_all_gaussians():
    camera = camera_at((0, 0, -4.0))
    gaussians = replace(random_gaussians(n=3), means=jnp.float32([[0, 0, -2], [0.1, 0, 0], [0, 0, 36]]))
    depths = project(gaussians, camera).depths
    step = 0.01 * ViewDepth(0.5)(depths, jnp.float32(2.0))
    moved = replace(gaussians, means=gaussians.means.at[:, 1].add(step))
    pixels = project(moved, camera).means2d - project(gaussians, camera).means2d
    assert_allclose(pixels[:, 1], 0.005 * camera.fy, rtol=1e-4)
    assert_allclose(ViewDepth(0.5, 0.1, 5.0)(jnp.float32([-3, 0.01, 99]), jnp.float32(2.0)), [0.1, 0.1, 5])
