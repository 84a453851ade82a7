"""The records of a scene of parts: names, order, colour maps, and refusals."""

import re
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax.low_pass import Antialiasing
from splatax.scene import ColorMap
from splatax.transforms import Similarity

CLOUD = random_gaussians(n=30, degree=2)


def test_parts_keep_their_order_through_jax():
    scene = sx.Scene({name: sx.Part(CLOUD) for name in ("wheel", "body", "antenna")})
    assert jax.tree.map(lambda leaf: leaf, scene).names == ("wheel", "body", "antenna")
    assert jax.jit(lambda x: x)(scene).names == ("wheel", "body", "antenna")


def test_a_map_of_colours_maps_the_colour_of_every_direction():
    rng = np.random.default_rng(0)
    change = ColorMap(rng.normal(size=(3, 3)).astype(np.float32), rng.normal(size=3).astype(np.float32))
    before, after = CLOUD, change.transform(CLOUD)
    for direction in rng.normal(size=(5, 3)):
        ray = jnp.asarray(direction / np.linalg.norm(direction), jnp.float32)
        seen = jax.vmap(lambda sh, ray=ray: sx.scene.colors.harmonics.evaluate(sh, ray) + 0.5)
        assert_allclose(seen(after.sh), seen(before.sh) @ change.matrix.T + change.offset[None], atol=2e-5)


def test_a_tint_multiplies_and_a_dye_replaces_the_hue():
    assert_allclose(ColorMap.tint((1.0, 0.5, 0.0)).matrix @ [0.2, 0.4, 0.6], [0.2, 0.2, 0], atol=1e-6)
    dyed = ColorMap.dye((0.8, 0.1, 0.0)).matrix @ np.full(3, 0.5)
    assert_allclose(dyed, [0.4, 0.05, 0], atol=1e-6)


def test_a_pose_known_on_the_host_and_a_traced_one_bake_alike():
    place = Similarity.of(degrees=(20.0, -50.0, 130.0), scale=2.5, move=(3.0, -1.0, 0.5))
    known, traced = place.transform(CLOUD), jax.jit(Similarity.transform)(place.cast(jnp.float32), CLOUD)
    assert_allclose(traced.means, known.means, atol=1e-5)
    assert_allclose(traced.covariances, known.covariances, rtol=1e-3, atol=1e-5)
    assert_allclose(traced.sh, known.sh, atol=1e-5)


def test_poses_of_a_batch_are_not_mistaken_for_wrong_ones():
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf]), Similarity.of(move=(1.0, 2.0, 3.0)))
    assert jax.vmap(lambda place: place.inverse().translation)(batch).shape == (2, 3)


def test_a_pose_and_its_inverse_cancel():
    place = Similarity.of(degrees=(20.0, -50.0, 130.0), scale=2.5, move=(3.0, -1.0, 0.5))
    both = place.inverse().after(place)
    assert_allclose(both.rotation, np.eye(3), atol=1e-12)
    assert_allclose(both.translation, 0, atol=1e-12)
    assert_allclose(both.scale, 1, atol=1e-12)


@pytest.mark.parametrize("degrees", [(0, 0, 0), (180, 0, 0), (0, 180, 0), (0, 0, 180), (20, -50, 130)])
def test_quaternions_of_rotations_rotate_alike(degrees):
    matrix = jnp.asarray(Similarity.of(degrees=tuple(map(float, degrees))).rotation, jnp.float32)
    quats = sx.transforms.quaternions
    assert_allclose(quats.to_rotation(quats.from_rotation(matrix)), matrix, atol=1e-6)
    slope = jax.jacobian(lambda m: quats.to_rotation(quats.from_rotation(m)))(matrix)
    assert np.isfinite(slope).all()


def test_what_is_hidden_is_not_baked():
    scene = sx.Scene({"on": sx.Part(CLOUD), "off": sx.Part(CLOUD, visible=False)})
    assert len(scene) == 60
    assert_array_equal(scene.flattened().means, CLOUD.means)
    with pytest.raises(ValueError, match="no part of the scene is visible"):
        scene.shown({"on": False}).flattened()


def test_rows_know_their_part_past_an_empty_one():
    empty = jax.tree.map(lambda leaf: leaf[:0], CLOUD)
    scene = sx.Scene({"a": sx.Part(CLOUD), "none": sx.Part(empty), "b": sx.Part(CLOUD)})
    part, row = scene.part_of(jnp.array([-1, 0, 29, 30, 59]))
    assert_array_equal(part, [-1, 0, 0, 2, 2])
    assert_array_equal(row, [-1, 0, 29, 0, 29])


def test_parts_of_different_filters_are_drawn_and_not_baked():
    smooth = replace(CLOUD, low_pass=Antialiasing())
    scene = sx.Scene({"a": sx.Part(CLOUD), "b": sx.Part(smooth, Similarity.of(move=(0.5, 0.0, 0.0)))})
    assert sx.render(scene, camera_at()).rgb.shape == (24, 32, 3)
    with pytest.raises(ValueError, match="different low-pass filters"):
        scene.flattened()


def test_parts_are_drawn_by_distance_if_all_of_them_are():
    far = replace(CLOUD, order="distance")
    moved = Similarity.of(move=(0.5, 0.0, 0.0), scale=0.5)
    for other, order in ((far, "distance"), (CLOUD, "depth")):
        scene = sx.Scene({"a": sx.Part(far), "b": sx.Part(other, moved)})
        assert scene.flattened().order == order
        drawn, flat = (sx.render(each, camera_at()).rgb for each in (scene, scene.flattened()))
        assert_allclose(drawn, flat, atol=2e-6)
    keys = sx.project(sx.Scene({"a": sx.Part(far), "b": sx.Part(far, moved)}), camera_at()).sort_keys
    places = np.concatenate([CLOUD.means, moved.transform(CLOUD).means])
    assert_allclose(keys, np.linalg.norm(places - [0, 0, -4], axis=1), rtol=1e-5)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: sx.Scene({}), "without parts"),
        (lambda: sx.Scene({"a": sx.Part(CLOUD)}).posed({"b": Similarity.of()}), "no part 'b'"),
        (
            lambda: sx.render(sx.Scene({"a": sx.Part(replace(CLOUD, sh=CLOUD.sh[:3]))}), camera_at()),
            "part 'a'",
        ),
        (lambda: sx.rasterize(sx.project(CLOUD, camera_at()), outputs=("parts",)), "needs the scene"),
    ],
)
def test_what_is_no_scene_is_refused_with_the_part_named(call, message):
    with pytest.raises(ValueError, match=message):
        call()


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: sx.Scene([sx.Part(CLOUD)]), "parts is of the type list. Give them by name"),
        (lambda: sx.Scene({1: sx.Part(CLOUD)}), "the name 1 of a part is of the type int"),
        (lambda: sx.Scene({"a": CLOUD}), "part 'a' is of the type Gaussians. Give Part"),
        (
            lambda: sx.Part(CLOUD, pose=np.eye(4)),
            "the pose of part 'a' is of the type ndarray. Give a Similarity",
        ),
        (
            lambda: sx.Part(CLOUD, color=(1, 0, 0)),
            "the color of part 'a' is of the type tuple. Give a ColorMap",
        ),
        (lambda: sx.Part("a.ply"), "gaussians of part 'a' is the text 'a.ply'. Give Gaussians"),
        (lambda: Similarity(np.eye(4), np.zeros(3)), "have the shapes (4, 4), (3,), ()"),
    ],
)
def test_what_a_scene_cannot_be_made_of_is_named_with_the_way_out(as_users_have_it, call, told):
    with pytest.raises((TypeError, ValueError), match=re.escape(told)):
        sx.render(sx.Scene({"a": call()}), camera_at())
