"""The size of the coarse run, whose errors limit all blocks."""

import pytest

from splatax.blocks.planning import Work


@pytest.mark.parametrize(("steps", "coarse"), [(600, 600), (2_000, 2_000), (6_000, 2_000), (30_000, 6_000)])
def test_a_coarse_run_is_shorter_than_one_of_the_whole_only_if_that_is_long(steps, coarse):
    assert Work(gaussians=16_000, steps=steps).coarse(blocks=4).steps == coarse


@pytest.mark.parametrize(("blocks", "gaussians"), [(2, 4_000), (4, 4_000), (16, 1_000), (32_000, 32_000)])
def test_a_coarse_scene_is_a_quarter_and_no_larger_than_a_block_and_has_a_gaussian_for_each(
    blocks, gaussians
):
    assert Work(gaussians=16_000, steps=600).coarse(blocks).gaussians == gaussians
