"""Pictures of the live viewer: what each mode shows and computes, and crop boxes."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.low_pass import AlongRays
from splatax.metrics import to_8bit
from splatax.viewer.pictures import Look


def test_colours_are_those_of_the_renderer():
    gaussians, camera = random_gaussians(), camera_at()
    look = Look(renderer=sx.Renderer((0.2, 0.4, 0.6)))
    expected = sx.render(gaussians, camera, background=np.array([0.2, 0.4, 0.6], np.float32)).rgb
    assert_array_equal(look.picture(gaussians, camera), to_8bit(np.asarray(expected)))


def test_alpha_is_grey_and_depth_brighter_where_nearer():
    gaussians, camera = random_gaussians(), camera_at()
    drawn = sx.render(gaussians, camera, outputs=("alpha", "median_surface_depth"))
    alpha = Look(mode="alpha").picture(gaussians, camera)
    assert_array_equal(alpha[..., 0], to_8bit(np.asarray(drawn.alpha)[..., None])[..., 0])
    depth = Look(mode="depth").picture(gaussians, camera).astype(int).sum(axis=2)
    covered = np.asarray(drawn.alpha) > 0.5
    z = np.asarray(drawn.median_surface_depth)
    nearest, farthest = (z == z[covered].min()) & covered, (z == z[covered].max()) & covered
    assert depth[nearest].min() > depth[farthest].max()
    assert (depth[~covered] == 0).all()


def test_normals_of_a_wall_that_faces_the_camera_are_light_blue():
    camera = camera_at()
    wall, toward = facing(random_gaussians(), camera), -np.asarray(camera.rotation)[2]
    picture = Look(mode="normals").picture(wall, camera)
    covered = np.asarray(sx.render(wall, camera).alpha) > 0.5
    assert covered.any()
    drawn = np.asarray(sx.render(wall, camera, outputs=("normals",)).normals)[covered]
    assert_allclose(drawn, np.broadcast_to(toward, drawn.shape), atol=1e-5)
    assert_array_equal(picture[covered], np.broadcast_to([128, 128, 255], drawn.shape))
    assert (picture[~covered] == 0).all()


def facing(gaussians, camera):
    """The same Gaussians, flattened along the axis of a camera."""
    quat = Rotation.from_matrix(np.asarray(camera.rotation).T).as_quat(scalar_first=True)
    quats = jnp.broadcast_to(jnp.asarray(quat, jnp.float32), (len(gaussians), 4))
    flat = jnp.broadcast_to(jnp.log(jnp.array([0.3, 0.3, 0.001])), (len(gaussians), 3))
    return replace(gaussians, log_scales=flat, quats=quats)


@pytest.mark.parametrize(
    ("mode", "filter", "outputs"),
    [
        ("colour", None, ("rgb",)),
        ("alpha", None, ("alpha",)),
        ("normals", None, ("alpha", "normals")),
        ("depth", None, ("alpha", "median_surface_depth")),
        ("depth", AlongRays(), ("alpha", "surface_depth")),
    ],
)
def test_a_mode_computes_what_it_shows_and_depth_is_that_of_surfaces(mode, filter, outputs, monkeypatch):
    asked, draw = [], sx.Renderer.__call__

    def recorded(renderer, scene, camera, outputs):
        asked.append(outputs)
        return draw(renderer, scene, camera, outputs)

    monkeypatch.setattr(sx.Renderer, "__call__", recorded)
    look = Look(mode=mode, renderer=sx.Renderer(low_pass=filter))
    assert look.picture(random_gaussians(), camera_at()).any()
    assert asked == [outputs]


def test_a_box_shows_what_a_scene_of_the_rest_alone_would():
    gaussians, camera = random_gaussians(), camera_at()
    low, high = (-0.5, -1.0, -1.0), (1.0, 0.4, 1.0)
    means = np.asarray(gaussians.means)
    keep = ((means >= low) & (means <= high)).all(axis=1)
    assert 0 < keep.sum() < len(keep)
    rest = sx.Gaussians(
        *(leaf[keep] for leaf in (gaussians.means, gaussians.quats, gaussians.log_scales)),
        gaussians.opacity_logits[keep],
        gaussians.sh[keep],
    )
    boxed = Look(box=(low, high)).picture(gaussians, camera)
    assert np.abs(boxed.astype(int) - Look().picture(rest, camera)).max() <= 1  # float32 rounding at a level
