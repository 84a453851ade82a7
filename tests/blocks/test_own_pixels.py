"""Photos of a block show the coarse scene in pixels that the surroundings of the block fill."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import splatax as sx
from captures import pinhole, write_capture
from splatax.blocks import parts
from splatax.blocks.boxes import Box
from splatax.blocks.parts import among, part_of
from splatax.blocks.plan import BlockPlan, Plan, write_plan
from splatax.blocks.visibility import SIDE, own_pixels
from splatax.dataset import Dataset, PointCloud, View
from splatax.digests import file_digest
from splatax.gaussians import joined
from splatax.io.photo_store import PhotoStore, kept_on_disk
from splatax.runs.results import examples
from splatax.training.fingerprints import fingerprint


def ball(x, z=0.0, opacity=0.99):
    """A round grey Gaussian, whose picture is more than half opaque up to 0.35 units from its centre."""
    return sx.Gaussians(
        jnp.array([[x, 0.0, z]]),
        jnp.array([[1.0, 0, 0, 0]]),
        jnp.full((1, 3), np.log(0.3)),
        jnp.array([np.log(opacity / (1 - opacity))]),
        jnp.zeros((1, 1, 3)),
    )


def camera(x=0.0):
    eye = jnp.array((x, 0.0, -4.0))
    pose = sx.look_at(eye, jnp.zeros(3), jnp.array((0.0, -1.0, 0.0)))
    return sx.Camera.simple_pinhole(36.0, pose, 32, 24)


def own(block, surroundings):
    scene = joined([block, surroundings])
    return own_pixels(scene, np.arange(len(scene)) >= len(block), camera(), "auto")


def at(picture, x):
    """The pixel of a picture at which the camera sees (x, 0, 0)."""
    height, width = picture.shape[:2]
    return picture[height // 2, int(width / 2 + 36 * x / 4 * width / 32)]


def test_pixels_filled_by_the_surroundings_are_not_the_blocks_own_and_empty_ones_are():
    mask = own(ball(-1.0), ball(1.0))
    assert mask.shape == (SIDE, SIDE)
    assert at(mask, -1.0)
    assert at(mask, 0.0)
    assert not at(mask, 1.0)
    # A disc of 0.35 units has a radius of 3.2 of the 32 x 24 pixels.
    assert (~mask).mean() == pytest.approx(np.pi * 3.2**2 / (32 * 24), rel=0.1)


def test_the_nearer_of_two_surfaces_decides():
    assert at(own(ball(0.0, z=-0.8), ball(0.0, z=0.8)), 0.0)
    assert not at(own(ball(0.0, z=0.8), ball(0.0, z=-0.8)), 0.0)


def test_faint_surroundings_leave_all_pixels_to_the_block():
    assert own(ball(-1.0), ball(1.0, opacity=0.4)).all()


def small_capture(folder):
    """Two photos on disk of the size of `camera()`."""
    return sx.load_dataset(write_capture(folder / "capture", 2, pinhole(size=(32, 24)), size=(32, 24)))


@pytest.fixture
def planned(tmp_path):
    """A capture of white photos of two grey balls, and a plan of two blocks with a ball each."""
    coarse = joined([ball(-1.0), ball(1.0)])
    sx.save(tmp_path / "coarse.ply", coarse)
    photo = np.full((24, 32, 3), 255, np.uint8)
    views = tuple(View(f"{i}.png", camera(x), lambda: photo) for i, x in enumerate((-2.0, 0, 2, 4)))
    none = PointCloud(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.float32))
    dataset = Dataset(views[:3], views[3:], none)
    boxes = Box((-np.inf, -np.inf), (0.0, np.inf)), Box((0.0, -np.inf), (np.inf, np.inf))
    blocks = tuple(BlockPlan(box, ("0.png", "1.png"), ("3.png",), 10, 5) for box in boxes)
    path = tmp_path / "coarse.ply"
    axes = np.array([[1.0, 0, 0], [0, 0, 1]])
    plan = Plan({"backend": "auto"}, fingerprint(dataset), path, file_digest(path), axes, blocks)
    write_plan(tmp_path, plan, [np.array([False, True]), np.array([True, False])])
    return dataset, tmp_path


@pytest.mark.parametrize(("number", "inside", "outside"), [(0, -1.0, 1.0), (1, 1.0, -1.0)])
def test_training_photos_show_the_coarse_scene_beside_the_block(planned, number, inside, outside):
    dataset, city = planned
    part = part_of(dataset, city, number)
    middle = part.train[1].pixels()
    assert middle.shape == (24, 32, 4)
    assert at(middle, inside).tolist() == [255] * 4
    assert at(middle, 0.0).tolist() == [255] * 4
    # Half grey; alpha is 0.99 in the centre of the ball, and less where pixel centres are beside it.
    *color, alpha = at(middle, outside).tolist()
    assert color == pytest.approx([128] * 3, abs=1)
    assert 240 <= alpha <= 253
    np.testing.assert_array_equal(part.test[0].pixels(), dataset.test[0].pixels())


def test_photos_keep_their_alpha_in_the_blocks_own_pixels(planned):
    dataset, _ = planned
    photo = np.full((24, 32, 4), 70, np.uint8)
    scene = joined([ball(-1.0), ball(1.0)])
    (view,) = among([replace(dataset.train[1], pixels=lambda: photo)], scene, np.array([True, False]), "auto")
    assert at(view.pixels(), 1.0).tolist() == [70] * 4
    assert at(view.pixels(), -1.0).tolist() != [70] * 4


def test_photos_of_many_sizes_are_drawn_on_canvases_with_the_same_result():
    scene, outside = joined([ball(-1.0), ball(1.0)]), np.array([True, False])

    def sized(width):
        photo = np.full((width * 3 // 4, width, 3), 255, np.uint8)
        return View(f"{width}.png", camera().resized(width, width * 3 // 4), lambda: photo)

    views = [sized(width) for width in (24, 28, 32, 36, 40)]
    together = among(views, scene, outside, "auto")
    assert any(view.pixels.change.canvas for view in together)
    for view, shared in zip(views, together, strict=True):
        (alone,) = among([view], scene, outside, "auto")
        np.testing.assert_allclose(shared.pixels().astype(int), alone.pixels().astype(int), atol=1)


def test_the_coarse_scene_is_drawn_once_in_each_photo_that_is_kept_on_disk(tmp_path, monkeypatch):
    views = [replace(view, camera=camera()) for view in small_capture(tmp_path).views]
    scene, outside = joined([ball(-1.0), ball(1.0)]), np.array([True, False])
    store = PhotoStore(tmp_path / "store", 10**9)

    def kept(coarse):
        return kept_on_disk(among(views, coarse, outside, "auto"), store)[0]

    first = [view.pixels() for view in kept(scene)]
    other = kept(joined([ball(-1.0), ball(0.8)]))
    same = kept(scene)
    monkeypatch.setattr(parts, "render", None)
    for view, expected in zip(same, first, strict=True):
        np.testing.assert_array_equal(view.pixels(), expected)
    with pytest.raises(TypeError):  # another coarse scene is drawn anew
        other[0].pixels()


def test_the_report_of_a_block_shows_photos_as_they_were_taken(tmp_path):
    views = [replace(view, camera=camera()) for view in small_capture(tmp_path).views]
    changed = among(views, joined([ball(-1.0), ball(1.0)]), np.array([True, False]), "auto")
    kept, _ = kept_on_disk(changed, PhotoStore(tmp_path / "store", 10**9))
    for some in (changed, kept):
        for view, taken in zip(examples(some), views, strict=True):
            np.testing.assert_array_equal(view.pixels(), taken.pixels())


def test_a_block_is_a_part_of_a_scene_of_the_size_of_the_whole(planned):
    dataset, city = planned
    part = part_of(dataset, city, 0)
    assert part.block.fraction == 0.5
    assert part.extent == dataset.extent
    assert replace(part, block=None).extent != dataset.extent
