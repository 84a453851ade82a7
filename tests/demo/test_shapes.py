"""Intersections of rays with surfaces, compared with the equations of the surfaces."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from splatax.demo.shapes import Cylinder, Rectangle, Sphere, box

CYLINDER = Cylinder((0.2, -0.1, 0.0), (0.5, 0.3, 1.2), 0.3)


def axis_coordinates(cylinder, points):
    """Height along the axis, and distance from it."""
    axis = np.subtract(cylinder.top, cylinder.base)
    length = np.linalg.norm(axis)
    offset = points - np.array(cylinder.base)
    height = offset @ (axis / length)
    return height / length, np.linalg.norm(offset - height[..., None] * axis / length, axis=-1)


def inside_sphere(points):
    return np.linalg.norm(points - [0.1, 0.2, 0.3], axis=-1) < 0.7


def inside_cylinder(points):
    height, distance = axis_coordinates(CYLINDER, points)
    return (height > 0) & (height < 1) & (distance < CYLINDER.radius)


def inside_box(points):
    return np.all((points > [-0.4, -0.5, -0.6]) & (points < [0.4, 0.5, 0.6]), axis=-1)


SOLIDS = {
    "sphere": ([Sphere((0.1, 0.2, 0.3), 0.7)], inside_sphere),
    "cylinder": ([CYLINDER], inside_cylinder),
    "box": (box((-0.4, -0.5, -0.6), (0.8, 0, 0), (0, 1, 0), (0, 0, 1.2)), inside_box),
}


@pytest.mark.parametrize("name", SOLIDS)
def test_a_ray_enters_a_solid_where_points_on_it_first_lie_inside(name):
    surfaces, inside = SOLIDS[name]
    rng = np.random.default_rng(0)
    origins = rng.normal(size=(200, 3))
    origins *= 3 / np.linalg.norm(origins, axis=1, keepdims=True)
    directions = rng.uniform(-0.8, 0.8, (200, 3)) - origins
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    rays = (jnp.asarray(origins, jnp.float32), jnp.asarray(directions, jnp.float32))
    distances = np.min([jax.vmap(surface.distance)(*rays) for surface in surfaces], axis=0)
    along = np.linspace(0, 6, 6001)
    march = inside(origins[:, None] + along[None, :, None] * directions[:, None])
    expected = np.where(march.any(axis=1), along[march.argmax(axis=1)], np.inf)
    assert 0.2 < np.isfinite(expected).mean() < 1
    grazing = np.isfinite(expected) != np.isfinite(distances)  # shorter inside than a step of the march
    assert grazing.mean() < 0.02
    hit = np.isfinite(expected) & ~grazing
    assert_allclose(distances[hit], expected[hit], atol=1.1e-3)  # the march's step


@pytest.mark.parametrize("name", SOLIDS)
def test_normals_point_out_of_the_solid(name):
    surfaces, inside = SOLIDS[name]
    for surface in surfaces:
        for start in np.random.default_rng(1).normal(size=(20, 3)) * 3:
            direction = -start / np.linalg.norm(start)
            start, direction = jnp.asarray(start, jnp.float32), jnp.asarray(direction, jnp.float32)
            distance = surface.distance(start, direction)
            if np.isfinite(distance):
                point = start + distance * direction
                normal = np.asarray(surface.normal(point))
                assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-5)
                assert not inside(np.asarray(point) + 3e-3 * normal)
                assert inside(np.asarray(point) - 3e-3 * normal)


def test_a_ray_from_a_surface_does_not_meet_it_again():
    sphere = Sphere((0.0, 0.0, 0.0), 1.0)
    assert sphere.distance(jnp.array([0.0, 0.0, 1.0]), jnp.array([0.0, 0.6, 0.8])) == np.inf


def test_a_rectangle_ends_at_its_edges():
    rectangle = Rectangle((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), (0.0, 1.0, 0.0))
    down = jnp.array([0.0, 0.0, -1.0])
    assert rectangle.distance(jnp.array([1.9, 0.9, 3.0]), down) == 3
    assert rectangle.distance(jnp.array([2.1, 0.9, 3.0]), down) == np.inf
