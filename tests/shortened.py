"""Recipes of the registry that do within 30 steps what they do in 30,000."""

from dataclasses import replace

from splatax.training.recipes import PRESETS, Recipe, ShSchedule


def shortened(name: str) -> Recipe:
    """Refines every 5 steps, opens a band of spherical harmonics after 10, and grows to 1,400 at most:
    past the first capacity."""
    recipe = PRESETS[name].build(steps=30, max_gaussians=1400)
    density = replace(recipe.density, every=5, start=4, until=28)
    return replace(recipe, density=density, sh=ShSchedule(1, 10))
