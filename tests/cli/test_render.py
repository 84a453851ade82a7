"""`splatax render` without a path: which depth it writes and why, and normals."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from PIL import Image

import splatax as sx
from scenes import random_gaussians
from splatax import cli
from splatax.cameras.geometry import rays
from splatax.geometry_scores import best_depth
from splatax.metrics import to_8bit

NAME = "photo03"


def rendered(wall, out, *options):
    scene, capture = wall
    cli.main(["render", str(scene), str(capture), "--split", "train", "--out", str(out), *options])
    return out


def camera_of(capture):
    (camera,) = (view.camera for view in sx.load_dataset(capture).views if view.name == f"{NAME}.png")
    return camera


@pytest.mark.parametrize("low_pass", ["dilation", "along-rays"])  # of ellipses and of discs
def test_depth_and_normals_are_those_of_the_wall_that_the_camera_sees(wall, tmp_path, low_pass):
    options = ("--depth", "surface_depth", "--normals", "--low-pass", low_pass)
    out = rendered(wall, tmp_path / "out", *options)
    camera = camera_of(wall[1])
    depth, normals = (np.load(out / kind / f"{NAME}.npy") for kind in ("depth", "normals"))
    assert depth.dtype == normals.dtype == np.float32
    along, axis = np.asarray(rays(camera)), np.asarray(camera.rotation)[2]  # in the world
    expected = (5 - float(camera.position[2])) / along[..., 2] * (along @ axis)
    assert_allclose(depth, expected, rtol=1e-4)
    assert_allclose(normals, np.broadcast_to([0, 0, -1], normals.shape), atol=1e-4)
    shown = np.asarray(Image.open(out / "normals" / f"{NAME}.png"))
    right, down, forward = np.asarray(camera.rotation) @ [0, 0, -1]
    color = np.round(255 * (0.5 + 0.5 * np.array([right, -down, -forward])))
    assert np.abs(shown - color).max() <= 1  # a component near a level of 8 bits
    assert np.asarray(Image.open(out / "depth" / f"{NAME}.png")).any(axis=2).all()


def test_a_scene_is_drawn_in_the_order_that_the_user_asks_for(wall, tmp_path):
    camera, path = camera_of(wall[1]), tmp_path / "cloud.ply"
    cloud = random_gaussians(n=400, spread=0.8, scale=(0.1, 0.4))
    ahead = np.asarray(camera.position) + 3 * np.asarray(camera.rotation)[2]
    cloud = replace(cloud, means=cloud.means + ahead[None], order="distance")
    sx.save(path, cloud)
    pictures = {}
    for order, options in (("distance", ()), ("depth", ("--order", "depth"))):
        out = rendered((path, wall[1]), tmp_path / order, *options)
        pictures[order] = np.asarray(Image.open(out / "rgb" / f"{NAME}.png"))
        expected = sx.render(replace(sx.load(path), order=order), camera).rgb
        assert_array_equal(pictures[order], to_8bit(np.asarray(expected)))
    assert (pictures["distance"] != pictures["depth"]).any()


def test_the_depth_that_agrees_best_with_the_points_is_written_and_a_line_says_so(wall, tmp_path, capsys):
    out = rendered(wall, tmp_path / "auto")
    best = best_depth(sx.load(wall[0]), sx.load_dataset(wall[1]).train)
    assert (
        f"depth   {best}: agrees best with the known points of the training photos" in capsys.readouterr().out
    )
    drawn = sx.render(sx.load(wall[0]), camera_of(wall[1]), outputs=(best,))
    assert_array_equal(np.load(out / "depth" / f"{NAME}.npy"), drawn.images[best])


def test_colours_do_not_depend_on_what_else_is_written(wall, tmp_path):
    few = rendered(wall, tmp_path / "few", "--depth", "median_depth")
    more = rendered(wall, tmp_path / "more", "--depth", "median_surface_depth", "--normals")
    assert not (few / "normals").exists()
    files = [folder / "rgb" / f"{NAME}.png" for folder in (few, more)]
    assert files[0].read_bytes() == files[1].read_bytes()
