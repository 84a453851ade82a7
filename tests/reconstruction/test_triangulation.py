"""Points for captures whose cameras are known: the corner of a room, photographed by exact cameras."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import corner
from splatax.cameras import Camera
from splatax.cameras.lenses import Pinhole
from splatax.dataset import View
from splatax.reconstruction import pipeline, triangulated, triangulation

PHOTOS = 5


@pytest.fixture(autouse=True)
def normal_features(monkeypatch):
    """They are enough for the corner, in a fourth of the time."""
    monkeypatch.setattr(pipeline, "VERY_FEW", 0)
    monkeypatch.setattr(triangulation, "SMALL", 0)


@pytest.fixture(scope="module")
def views():
    paper = corner.wallpaper()
    return [view(i, position, paper) for i, position in enumerate(corner.positions()[:PHOTOS])]


def view(number, position, paper, lens=Pinhole()):
    angle = np.arctan2(-position[0], 6)
    rotation = np.array(
        [[np.cos(angle), 0, -np.sin(angle)], [0, 1, 0], [np.sin(angle), 0, np.cos(angle)]], np.float32
    )
    pose = np.eye(4, dtype=np.float32)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ position.astype(np.float32)
    photo = corner.photograph(position, paper, lens).astype(np.uint8)
    camera = replace(Camera.simple_pinhole(corner.FOCAL, jnp.asarray(pose), *corner.SIZE), lens=lens)
    return View(f"{number}.jpg", camera, lambda: photo)


def depth_of_the_wall(points):
    return 6 - 0.8 * np.abs(points[:, 0])


def test_points_lie_on_the_walls_in_the_world_of_the_cameras(views):
    told = []
    points = triangulated(views, watch=lambda *stage: told.append(stage))
    assert len(points) > 150
    off = np.abs(points.positions[:, 2] - depth_of_the_wall(points.positions))
    assert np.median(off) < 0.05  # of a distance of about 6
    assert 0.3 < points.colors.mean() < 0.7  # the paper's mean grey
    assert list(dict.fromkeys(stage for stage, _, _ in told)) == list(triangulation.STAGES)


def test_masked_and_transparent_pixels_have_no_points(views):
    def left_of_the_corner(each):
        photo = each.pixels()
        half = np.arange(photo.shape[1]) < photo.shape[1] // 2
        return replace(each, mask=lambda: np.broadcast_to(half, photo.shape[:2]))

    def upper_part(each):
        alpha = np.where(np.arange(corner.SIZE[1]) < corner.SIZE[1] // 2, 255, 0).astype(np.uint8)
        photo = np.dstack([each.pixels(), np.broadcast_to(alpha[:, None], corner.SIZE[::-1])])
        return replace(each, pixels=lambda: photo)

    points = triangulated([upper_part(left_of_the_corner(each)) for each in views[:3]])
    assert len(points)
    local = points.positions - corner.positions()[0]
    assert (local[:, 1] < 0.5).mean() > 0.95  # y points down


def test_without_views_that_match_there_are_no_points(views):
    assert not len(triangulated(views[:1]))
    plain = [
        replace(each, pixels=lambda: np.full((*corner.SIZE[::-1], 3), 90, np.uint8)) for each in views[:2]
    ]
    assert not len(triangulated(plain))
