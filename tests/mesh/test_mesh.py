"""Meshes of exact depth of surfaces that are known."""

import errno
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from analytic import CENTRE, DIRECTIONS, RADIUS, ball_views
from numpy.testing import assert_allclose

from splatax import mesh
from splatax.cameras.lenses import Equirectangular
from splatax.errors import InputError
from splatax.io import files as files_of_io
from splatax.mesh.extraction import simplified
from splatax.mesh.files import WRITERS, linear
from splatax.mesh.fusion import Fusion, fuse
from splatax.mesh.needed import needed
from splatax.mesh.record import Mesh, components_of, largest_components
from splatax.mesh.surface import surface_of
from splatax.mesh.views import Picture, sampled
from splatax.mesh.volume import BYTES, blocks_around, coordinates_of, keys_of

VOXEL = 0.08


@pytest.fixture(scope="module")
def views():
    return ball_views()


@pytest.fixture(scope="module")
def ball(views):
    return mesh.extract(views, VOXEL)


def heights(vertices):
    """Distances in front of the ball."""
    return np.linalg.norm(vertices - CENTRE, axis=1) - RADIUS


def as_trimesh(found):
    return trimesh.Trimesh(found.vertices, found.faces, process=False)


def squares(*corners, side=1.0):
    """A mesh of separate squares of two faces."""
    corner = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float) * side
    vertices = np.concatenate([corner + c for c in corners])
    faces = np.concatenate([np.array([[0, 1, 2], [0, 2, 3]]) + 4 * i for i in range(len(corners))])
    return Mesh(vertices, faces, np.full(vertices.shape, 9, np.uint8))


def test_exact_depth_of_a_ball_gives_a_closed_ball_that_looks_outwards(ball):
    assert as_trimesh(ball).is_watertight  # also across the borders of chunks
    assert np.median(np.abs(heights(ball.vertices))) < 0.2 * VOXEL
    assert np.abs(heights(ball.vertices)).max() < VOXEL
    assert np.sum(ball.normals * (ball.vertices - CENTRE), axis=1).min() > 0
    assert as_trimesh(ball).volume == pytest.approx(4 / 3 * np.pi, rel=0.05)


def test_a_finer_voxel_is_nearer_to_the_truth(ball, views):
    fine = mesh.extract(views, VOXEL / 2)
    assert np.mean(np.abs(heights(fine.vertices))) < 0.7 * np.mean(np.abs(heights(ball.vertices)))


def test_panoramas_agree_on_the_surface():
    """Their depth is a distance, and the ball is before and behind them."""
    found = mesh.extract(ball_views(DIRECTIONS[6:], lens=Equirectangular(), focal=1.0, side=160), VOXEL)
    assert np.median(np.abs(heights(found.vertices))) < 0.3 * VOXEL


def test_a_plane_at_a_slant_is_exact_and_ends_where_it_was_seen():
    """Depth of the plane z = 0.2 x under cameras that look at it from above."""
    views = []
    for view in ball_views(np.array([[0.2, 0.1, 1], [-0.3, 0.1, 1], [0.1, -0.4, 1]])):
        directions = np.asarray(mesh_rays(view.camera))
        position = np.asarray(view.camera.position)
        normal = np.array([-0.2, 0, 1]) / np.hypot(0.2, 1)
        along = -(position @ normal) / (directions @ normal)
        forward = directions @ np.asarray(view.camera.rotation)[2]
        picture = Picture((along * forward).astype(np.float32), np.zeros((*along.shape, 3), np.float32))
        views.append(mesh.DepthView(view.camera, lambda picture=picture: picture))
    found = mesh.extract(views, 0.05)
    x, _, z = found.vertices.T
    assert np.median(np.abs(z - 0.2 * x)) < 2e-4
    assert np.abs(z - 0.2 * x).max() < 5e-3
    assert not as_trimesh(found).is_watertight
    assert np.abs(found.vertices).max() < 4


def mesh_rays(camera):
    from splatax.cameras.geometry import rays

    return rays(camera)


def test_vertices_have_the_colours_that_the_views_see(ball):
    assert_allclose(ball.colors, np.broadcast_to([255, 128, 0], ball.colors.shape), atol=1)


def test_a_surface_that_one_view_alone_sees_is_left_out(views):
    stray = replace(views[0], read=lambda: Picture(*(0.4 * part for part in views[0].read())))
    found = mesh.extract([*views, stray], VOXEL)
    assert np.abs(heights(found.vertices)).max() < 0.5


def test_memory_grows_with_the_surface_and_not_with_the_space_around_it(views):
    coarse, fine = (fuse(views[:2], Fusion(voxel)) for voxel in (0.1, 0.05))
    assert 2.5 < len(fine.keys) / len(coarse.keys) < 5.5  # a dense grid has 8 times as many
    far = replace(views[0], camera=replace(views[0].camera, cam_from_world=shifted(views[0].camera, 500)))
    two = fuse([views[0], far], Fusion(0.1))
    assert len(two.keys) < 2.5 * len(fuse(views[:1], Fusion(0.1)).keys)


def shifted(camera, by):
    pose = np.array(camera.cam_from_world)
    pose[:3, 3] -= pose[:3, :3] @ np.array([by, 0, 0], np.float32)
    return pose


def test_a_volume_that_needs_more_memory_than_it_may_is_refused(views):
    with pytest.raises(InputError, match=r"voxels of 0\.05 needs .* GB.*Use larger voxels") as refused:
        mesh.extract(views[:2], 0.05, memory=10 * BYTES)
    assert refused.value.options == ("voxel",)


def test_blocks_around_points_hold_all_voxels_within_the_truncation():
    rng = np.random.default_rng(0)
    points = rng.uniform(-3, 3, (20, 3))
    keys = blocks_around(points, 0.1)
    near = (points[:, None] + rng.uniform(-0.4, 0.4, (20, 50, 3))).reshape(-1, 3)
    assert np.isin(keys_of(np.floor(near / 0.8).astype(int)), keys).all()
    blocks = rng.integers(-1000, 1000, (50, 3))
    assert (coordinates_of(keys_of(blocks)) == blocks).all()


def test_voxels_too_small_for_the_scene_are_refused():
    with pytest.raises(InputError, match="too small for a scene that reaches 1e\\+06"):
        blocks_around(np.array([[1e6, 0, 0]]), 1e-4)


def test_depth_between_pixels_is_exact_on_a_plane_and_not_mixed_across_an_edge():
    x = np.arange(8) + 0.5
    plane = np.broadcast_to(1 / (0.2 + 0.01 * x), (8, 8)).astype(np.float32)
    at = np.array([[2.2, 3.9], [5.0, 4.4], [8.5, 1.0]], np.float32)
    found = np.asarray(sampled(plane, at))
    assert_allclose(found[:2], 1 / (0.2 + 0.01 * at[:2, 0]), rtol=1e-6)
    assert found[2] == 0  # beside the image
    edge = np.where(x < 4, np.float32(2), np.float32(5)) * np.ones((8, 1), np.float32)
    assert np.isin(np.asarray(sampled(edge, at[:2])), [2, 5]).all()


def test_small_components_are_removed():
    both = squares((0, 0, 0), (5, 0, 0))
    assert components_of(both).tolist() == [0, 0, 1, 1]
    small = squares((9, 9, 9), side=0.05)
    joined = Mesh(
        np.concatenate([both.vertices, small.vertices]),
        np.concatenate([both.faces, small.faces + 8]),
        np.concatenate([both.colors, small.colors]),
    )
    kept = largest_components(joined, 0.01)
    assert len(kept.faces) == 4
    assert kept.areas.sum() == pytest.approx(2)


def test_a_simplified_mesh_has_the_faces_asked_for_and_keeps_its_shape(ball):
    few = simplified(ball, 400)
    assert 300 < len(few.faces) <= 400
    assert np.median(np.abs(heights(few.vertices))) < 0.4 * VOXEL
    assert (few.colors[:, 0] > 250).all()
    assert simplified(ball, 10**6) is ball


def test_a_sheet_full_of_holes_is_simplified_as_far_as_its_borders_allow():
    at = np.arange(40)
    inside = (at[:, None] % 4 > 0) | (at[None, :] % 4 > 0)
    sheet = squares(*[(x, y, 0) for x in at for y in at if inside[x, y]])
    joined = as_trimesh(sheet)
    joined.merge_vertices()
    whole = Mesh(joined.vertices, joined.faces, np.full(joined.vertices.shape, 9, np.uint8))
    once = needed().simplify(whole.vertices, whole.faces.astype(np.int32), target_count=100)[1]
    few = simplified(whole, 100)
    assert len(few.faces) < 0.7 * len(once)
    assert as_trimesh(few).extents == pytest.approx(joined.extents, abs=0.5)


def test_the_collision_mesh_of_a_ball_is_a_solid_ball(views):
    found = as_trimesh(mesh.collision_mesh(views, 0.1, faces=500))
    assert found.is_watertight
    assert found.body_count == 1  # without the surface of the cavity
    assert len(found.faces) <= 500
    assert found.volume == pytest.approx(4 / 3 * np.pi, rel=0.1)


def test_the_collision_mesh_of_what_is_seen_from_one_side_is_a_closed_slab(views):
    found = as_trimesh(mesh.collision_mesh(views[:1], 0.1, faces=10**6))
    assert found.is_watertight
    few = as_trimesh(mesh.collision_mesh(views[:1], 0.1, faces=500))
    assert few.volume == pytest.approx(found.volume, rel=0.1)
    assert 0 < found.volume < 4 / 3 * np.pi / 3


@pytest.mark.parametrize("suffix", WRITERS)
def test_a_file_is_read_back_by_trimesh(suffix, ball, tmp_path):
    rng = np.random.default_rng(0)
    painted = replace(ball, colors=rng.integers(0, 256, ball.colors.shape, np.uint8))
    path = tmp_path / f"ball{suffix}"
    mesh.save(path, painted)
    (found,) = trimesh.load_scene(path, process=False, maintain_order=True).geometry.values()
    turned = [-1, -1, 1] if suffix == ".glb" else [1, 1, 1]
    assert_allclose(found.vertices * turned, painted.vertices, atol=1e-6)
    assert (found.faces == painted.faces).all()
    if suffix == ".glb":  # as the standard has it: linear
        colors = found.visual.vertex_attributes["color"][:, :3]
        assert_allclose(colors / 65535, linear(painted.colors), atol=1e-4)
    else:
        assert_allclose(found.visual.vertex_colors[:, :3], painted.colors, atol=1)


def test_linear_light_of_srgb():
    assert_allclose(linear(np.array([[0, 255, 188]], np.uint8)), [[0, 1, 0.5029]], atol=1e-4)


def test_other_suffixes_and_sizes_are_refused(ball, tmp_path, views):
    with pytest.raises(InputError, match=r"ball\.stl: no format of meshes\. Write \.ply, \.glb, \.obj"):
        mesh.save(tmp_path / "ball.stl", ball)
    with pytest.raises(InputError, match="width of a voxel must be above 0"):
        mesh.extract(views, -1.0)
    with pytest.raises(InputError, match="number of faces must be at least 4"):
        mesh.extract(views, 0.1, faces=3)


def test_a_crash_while_writing_leaves_the_old_file(ball, tmp_path, monkeypatch):
    path = tmp_path / "ball.ply"
    path.write_text("old")

    def fails(*_):
        raise OSError(errno.ENOSPC, "no space")

    monkeypatch.setattr(files_of_io.os, "fsync", fails)
    with pytest.raises(OSError, match="no space"):
        mesh.save(path, ball)
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_the_automatic_voxel_is_the_width_of_a_pixel_or_the_noise(views):
    found = mesh.resolution_of(views)
    assert found.pixel == pytest.approx(2.2 / (1.1 * 64), rel=0.15)  # the ball's face is 2 to 3 away
    assert found.noise < 0.1 * found.pixel
    assert found.voxel == found.pixel
    rng = np.random.default_rng(0)

    def noisy(picture):
        return picture._replace(depth=picture.depth * rng.normal(1, 0.04, picture.depth.shape).astype("f4"))

    shaken = [replace(view, read=lambda view=view: noisy(view.read())) for view in views]
    assert mesh.resolution_of(shaken).voxel > 2 * found.voxel


def test_views_that_see_nothing_are_refused(views):
    blind = replace(views[0], read=lambda: Picture(np.zeros((64, 64), "f4"), np.zeros((64, 64, 3), "f4")))
    with pytest.raises(InputError, match="No camera sees a surface"):
        mesh.extract([blind])
    with pytest.raises(InputError, match="no surface in common"):
        surface_of(fuse([blind], Fusion(0.1)))


def test_the_agreement_with_the_truth_is_that_of_a_known_error(ball, views):
    truth = mesh.samples_of([(view.camera, view.read().depth) for view in views], 0.05)
    assert np.abs(heights(truth.points)).max() < 1e-4
    exact = mesh.compare(ball, truth, 0.05)
    assert exact.median < 0.015
    assert exact.completeness > 0.95
    larger = replace(ball, vertices=CENTRE + 1.2 * (ball.vertices - CENTRE))
    wrong = mesh.compare(larger, truth, 0.05)
    assert wrong.median == pytest.approx(0.2, abs=0.02)
    assert wrong.precision == wrong.completeness == 0
    half = ball.with_faces(ball.vertices[ball.faces].mean(axis=1)[:, 0] > CENTRE[0])
    assert mesh.compare(half, truth, 0.05).completeness == pytest.approx(0.5, abs=0.06)
    assert mesh.compare(half, truth, 0.05).median < 0.015
