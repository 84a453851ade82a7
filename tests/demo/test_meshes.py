"""Photos of meshes, compared with analytic geometry."""

import jax.numpy as jnp
import numpy as np
import pytest

from scenes import camera_at
from splatax.demo.meshes import photograph_mesh

CAMERA = camera_at(position=(0.0, 0.0, -4.0), size=(48, 40), focal=40.0)
SQUARE = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]])
TRIANGLES = np.array([[0, 1, 2], [0, 2, 3]])


def own(places, colors):
    return colors


def photo(vertices, triangles, colors):
    return photograph_mesh(CAMERA, vertices, triangles, vertices, colors, own).astype(float) / 255


def test_a_square_covers_the_pixels_that_it_projects_to():
    alpha = photo(SQUARE, TRIANGLES, np.ones((4, 3)))[..., 3]
    corners = np.array([CAMERA.to_pixel(CAMERA.to_camera(jnp.asarray(v, jnp.float32))) for v in SQUARE])
    area = np.prod(corners.max(axis=0) - corners.min(axis=0))
    np.testing.assert_allclose(alpha.sum(), area, rtol=0.02)
    y, x = np.nonzero(alpha > 0.99)
    assert x.min() >= np.floor(corners[:, 0].min())
    assert y.max() <= np.ceil(corners[:, 1].max())


def test_the_nearer_of_two_squares_is_seen_whatever_their_order():
    near, red, blue = SQUARE * 0.5 - [0, 0, 1], [1.0, 0, 0], [0, 0, 1.0]
    for order in (1, -1):
        parts = [(SQUARE, red), (near, blue)][::order]
        vertices, colors = np.concatenate([p for p, _ in parts]), np.repeat([c for _, c in parts], 4, axis=0)
        middle = photo(vertices, np.concatenate([TRIANGLES, TRIANGLES + 4]), colors)[20, 24]
        np.testing.assert_array_equal(middle, [0, 0, 1, 1])


def test_textures_are_linear_in_space_not_on_the_image():
    tilted = SQUARE + np.array([0, 0, 1]) * SQUARE[:, :1]  # its right side is farther away
    shades = photo(tilted, TRIANGLES, (tilted[:, :1] + 1) / 2 * np.ones(3))
    place = np.array([0.5, 0.0, 0.5])
    x, y = np.floor(np.asarray(CAMERA.to_pixel(CAMERA.to_camera(jnp.asarray(place, jnp.float32))))).astype(
        int
    )
    assert abs(shades[y, x, 0] - 0.75) < 0.04  # within a pixel; linear on the image: 0.83


def test_a_vertex_behind_the_camera_is_refused():
    with pytest.raises(ValueError, match="behind the camera"):
        photo(SQUARE - [0, 0, 5], TRIANGLES, np.ones((4, 3)))
