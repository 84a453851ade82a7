"""The report: correct pictures, in a page that refers to no other file."""

import base64
import io
import re

import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image, ImageSequence

import splatax as sx
from report.galleries import gallery_of
from splatax.evaluation import Scores, ViewScore
from splatax.report.curves import smoothed, training_curves
from splatax.report.gallery import Gallery
from splatax.report.page import Account, report
from splatax.report.pictures import (
    LABEL_HEIGHT,
    LARGEST_ERROR,
    animation,
    data_uri,
    depth_map,
    depth_range,
    error_map,
    normal_map,
)
from splatax.runs.history import Evaluation, History
from splatax.runs.results import Comparison

GRAY = np.full((6, 8, 3), 100, np.uint8)


def test_no_error_is_black_and_the_largest_is_brightest():
    image = GRAY.copy()
    image[0, 0] += np.uint8(np.ceil(255 * LARGEST_ERROR))
    image[0, 1] += 10
    errors = error_map(image, GRAY).astype(int).sum(axis=2)
    assert errors[1:].max() < 10
    assert errors[0, 0] > errors[0, 1] > errors[1, 0]


def test_near_is_bright_and_nothing_is_black():
    depth = np.linspace(1, 9, 48, dtype=np.float32).reshape(6, 8)
    alpha = np.ones_like(depth)
    alpha[2] = 0
    shades = depth_map(depth, alpha).astype(int).sum(axis=2)
    assert shades[0, 0] > shades[3, 0] > shades[5, 7]
    assert_array_equal(shades[2], 0)
    assert_array_equal(depth_map(depth, np.zeros_like(depth)), 0)
    unknown = np.where(depth > 8, 0, depth)
    assert_array_equal(depth_map(unknown, np.ones_like(depth))[unknown == 0], 0)
    assert depth_range(unknown, np.ones_like(depth))[0] > 1


def test_normals_are_red_to_the_right_green_up_and_blue_towards_the_camera():
    right, down, forward = [0, 1, 0], [0, 0, -1], [-1, 0, 0]  # axes of the camera in the world
    pose = jnp.eye(4).at[:3, :3].set(jnp.array([right, down, forward], jnp.float32))
    camera = sx.Camera.simple_pinhole(5.0, pose, 4, 1)
    normals = np.float32([[[0, 1, 0], [0, 0, 1], [1, 0, 0], [1, 0, 0]]])
    shown = normal_map(normals, np.float32([[1, 1, 1, 0.5]]), camera)
    assert_array_equal(shown[0], [[255, 128, 128], [128, 255, 128], [128, 128, 255], [0, 0, 0]])
    assert_array_equal(normal_map(0 * normals, np.ones((1, 4), np.float32), camera), 0)


def test_animation_shows_all_frames_and_rests_on_the_last():
    frames = [(f"step {i}", np.full((24, 32, 3), 60 * i, np.uint8)) for i in range(4)]
    with Image.open(io.BytesIO(animation(frames))) as gif:
        shown = [
            (frame.info["duration"], frame.convert("RGB").getpixel((16, 8))[0])
            for frame in ImageSequence.Iterator(gif)
        ]
    assert [duration for duration, _ in shown] == [250, 250, 250, 2500]
    assert [level for _, level in shown] == [0, 60, 120, 180]


def test_large_pictures_are_shrunk_in_proportion():
    picture = np.zeros((900, 1800, 3), np.uint8)
    with Image.open(io.BytesIO(base64.b64decode(data_uri(picture).split(",")[1]))) as image:
        assert image.size == (720, 360)
    with Image.open(io.BytesIO(animation([("step 1", picture)]))) as gif:
        assert gif.size == (720, 360 + LABEL_HEIGHT)


def test_smoothing_keeps_a_line_a_line():
    steps = np.arange(1, 201)
    x, y = smoothed(steps, steps * 2.0)
    assert len(x) == 151
    assert np.ptp(y - 2 * x) == pytest.approx(0, abs=1e-9)


@pytest.fixture
def page():
    history = History(losses=[0.5, 0.4, 0.3], counts=[10, 10, 12], train_seconds=1.5)
    history.evaluations.append(Evaluation(3, 1.5, Scores((ViewScore("a", 20.0, 0.5, 21.0),))))
    comparisons = [
        Comparison(ViewScore(name, psnr, 0.9, psnr + 1), GRAY, GRAY)
        for name, psnr in (("good.png", 30.0), ("worst.png", 10.0), ("fair.png", 20.0))
    ]
    return report(
        "A & <b>", Account({"Gaussians": "12"}, ["9 photos"]), history, gallery_of(comparisons), b"GIF89a"
    )


def test_the_page_needs_nothing_else(page):
    assert set(re.findall(r'src="(.{5})', page)) == {"data:"}
    assert not re.findall(r'<(?:script|link)|url\(["\']?http|href="http', page)


@pytest.mark.parametrize(("count", "plots"), [(0, 2), (1, 2), (2, 3)])
def test_test_psnr_has_a_plot_if_it_has_a_curve(count, plots):
    history = History(losses=[0.5, 0.4], counts=[10, 12])
    scores = Scores((ViewScore("a", 20.0, 0.5, 21.0),))
    history.evaluations.extend(Evaluation(step, 1.5, scores) for step in range(1, count + 1))
    assert len(re.findall(r'<g id="axes_\d+">', training_curves(history))) == plots


def test_worst_views_come_first(page):
    assert re.findall(r"<b>(\w+).png</b>", page) == ["worst", "fair", "good"]


def test_a_report_shows_the_worst_views_and_the_best_and_lists_all():
    psnrs = np.random.default_rng(0).permutation(60) + 10.0
    gallery = gallery_of(
        [Comparison(ViewScore(f"{psnr:.0f}.png", psnr, 0.9, psnr), GRAY, GRAY) for psnr in psnrs], most=4
    )
    page = report("many", Account({}), History(losses=[0.5], counts=[10]), gallery, b"")
    assert re.findall(r"<b>(\d+).png</b>", page) == ["10", "11", "12", "13"]
    assert gallery.best.score.name == "69.png"
    assert re.findall(r"<td>(\d+).png</td>", page) == [str(number) for number in range(10, 70)]


def test_pictures_of_a_report_end_where_their_room_ends():
    comparisons = [Comparison(ViewScore(str(i), 10.0 + i, 0.9, 10.0), GRAY, GRAY) for i in range(5)]
    size = gallery_of(comparisons).worst[0].size
    assert [exhibit.score.name for exhibit in gallery_of(comparisons, room=2 * size).worst] == ["0", "1"]


def test_the_worst_view_is_marked_and_colour_corrected_psnr_shown(page):
    assert page.count("<mark>worst</mark>") == 1
    assert page.index("worst.png") < page.index("<mark>worst</mark>") < page.index("fair.png")
    assert "colour-corrected 11.00 dB" in page


def test_errors_outside_the_mask_are_not_shown():
    mask = np.zeros((6, 8), bool)
    mask[:, :4] = True
    errors = error_map(GRAY + np.uint8(90), GRAY, mask)
    assert_array_equal(errors[:, 4:], error_map(GRAY, GRAY)[:, 4:])
    assert errors[:, :4].astype(int).sum(axis=2).min() > 600


def test_text_is_escaped(page):
    assert "<h1>A &amp; &lt;b&gt;</h1>" in page


def test_a_run_of_one_step_without_test_views_has_a_page_too():
    page = report("one", Account({}), History(losses=[0.5], counts=[10]), Gallery(), b"")
    assert "Training progress" not in page
