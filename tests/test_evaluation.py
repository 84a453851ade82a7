"""Scores: colour correction, masks, and their descriptions."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import splatax as sx
from scenes import camera_at, random_gaussians
from splatax import metrics
from splatax.dataset import mask_of
from splatax.errors import DatasetError, InputError
from splatax.evaluation import Scores, ViewScore, picture, score

SIZE = (40, 32)


def pictures(seed=0):
    """A smooth photo and a noisy rendering of it, away from black and white."""
    rng = np.random.default_rng(seed)
    smooth = np.cumsum(rng.normal(size=(32, 40, 3)), axis=1)
    photo = metrics.to_8bit(0.5 + 0.2 * np.tanh(smooth / 4))
    return metrics.to_8bit(photo / 255 + rng.normal(size=photo.shape) * 0.02), photo


def half():
    mask = np.zeros((32, 40), bool)
    mask[:, :20] = True
    return mask


def changed_outside(image):
    return np.where(half()[..., None], image, 255 - image)


def test_colour_correction_undoes_any_affine_change_of_colours():
    _, photo = pictures()
    matrix = np.array([[0.8, 0.1, 0.0], [0.05, 0.9, -0.1], [0.0, 0.2, 0.7]])
    shifted = metrics.to_8bit(photo / 255 @ matrix.T + [0.05, -0.02, 0.1])
    assert metrics.psnr(shifted, photo) < 30
    # What remains is the rounding of the shifted picture to 8 bits.
    assert metrics.psnr(metrics.color_corrected(shifted, photo), photo) > 55


def test_colour_correction_never_lowers_psnr_and_leaves_equal_pictures_equal():
    image, photo = pictures()
    assert metrics.psnr(metrics.color_corrected(image, photo), photo) >= metrics.psnr(image, photo)
    assert_array_equal(metrics.color_corrected(photo, photo), photo)
    gray = np.full_like(photo, 100)  # a single colour: the fit is not unique, the picture is
    expected = np.broadcast_to(photo.mean((0, 1)), photo.shape)
    assert_allclose(metrics.color_corrected(gray, photo), expected, atol=1e-6)


def test_colour_correction_is_the_least_squares_fit():
    image, photo = pictures()
    colors = np.column_stack([image.reshape(-1, 3), np.ones(image[..., 0].size)])
    expected = colors @ np.linalg.lstsq(colors, photo.reshape(-1, 3).astype(float))[0]
    assert_allclose(metrics.color_corrected(image, photo).reshape(-1, 3), expected, atol=1e-6)


def test_what_lies_outside_the_mask_changes_no_score():
    image, photo = pictures()
    inside = score("a", image, photo, half())
    assert score("a", changed_outside(image), photo, half()) == inside
    assert score("a", image, changed_outside(photo), half()) == inside
    assert score("a", changed_outside(image), photo) != inside


def test_scores_inside_a_rectangular_mask_are_those_of_the_cropped_pictures():
    image, photo = pictures()
    cropped = score("a", image[:, :20], photo[:, :20])
    assert_allclose(
        list(vars(score("a", image, photo, half())).values())[1:4],
        list(vars(cropped).values())[1:4],
        rtol=1e-12,
    )


def test_a_mask_that_is_true_everywhere_changes_no_score():
    image, photo = pictures()
    assert score("a", image, photo, np.ones((32, 40), bool)) == score("a", image, photo)


def test_too_little_to_compare_is_refused_by_the_name_of_the_view():
    image, photo = pictures()
    thin = np.zeros((32, 40), bool)
    thin[:, :10] = True
    with pytest.raises(DatasetError, match=r"a.png: SSIM needs 11 x 11 pixels in one piece"):
        score("a.png", image, photo, thin)
    with pytest.raises(InputError, match="SSIM needs at least 11 x 11 pixels, not 40 x 10"):
        metrics.ssim(image[:10], photo[:10])


def test_means_and_the_worst_view():
    scores = Scores((ViewScore("a", 20.0, 0.5, 22.0, 0.3), ViewScore("b", 10.0, 0.7, 30.0, 0.1)))
    means = (scores.psnr, scores.ssim, scores.corrected_psnr, scores.lpips)
    assert_allclose(means, (15, 0.6, 26, 0.2))
    assert scores.worst.name == "b"
    assert Scores((ViewScore("a", 20.0, 0.5, 22.0),)).lpips is None


def test_evaluate_honours_the_mask_of_each_view():
    gaussians, camera = random_gaussians(degree=0), camera_at(size=SIZE)
    image = picture(gaussians, camera)
    views = [
        sx.View("whole", camera, lambda: changed_outside(image)),
        sx.View("masked", camera, lambda: changed_outside(image), half),
    ]
    whole, masked = sx.evaluate(gaussians, views).views
    assert whole.psnr < 20
    assert masked.psnr == np.inf
    assert masked.ssim == 1


def test_masks_of_another_size_or_without_any_pixel_are_refused():
    def view(mask):
        return sx.View("a.png", camera_at(size=SIZE), lambda: np.zeros((32, 40, 3), np.uint8), lambda: mask)

    with pytest.raises(DatasetError, match=r"a.png: its mask has 32 x 40 pixels, its camera 40 x 32"):
        mask_of(view(np.ones((40, 32), bool)))
    with pytest.raises(DatasetError, match=r"a.png: its mask is entirely black"):
        mask_of(view(np.zeros((32, 40), bool)))
    assert mask_of(sx.View("a", camera_at(), lambda: np.zeros((24, 32, 3), np.uint8))) is None
