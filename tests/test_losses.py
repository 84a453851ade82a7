import jax
import jax.numpy as jnp
import numpy as np
from numpy.testing import assert_allclose, assert_array_equal
from scipy.ndimage import correlate1d

from splatax import losses, metrics


def pictures(seed=0, size=(23, 31), dtype=np.float32):
    rng = np.random.default_rng(seed)
    return (jnp.asarray(rng.uniform(size=(*size, 3)), dtype) for _ in range(2))


def test_ssim_of_an_image_with_itself_is_one():
    image, _ = pictures()
    assert_allclose(losses.ssim(image, image), 1, rtol=1e-6)


def test_ssim_is_the_formula_over_zero_padded_windows(x64):
    image, photo = pictures(dtype=np.float64)

    def blur(values):
        for axis in (0, 1):
            values = correlate1d(values, losses.KERNEL, axis=axis, mode="constant")
        return values

    x, y = np.asarray(image), np.asarray(photo)
    mx, my = blur(x), blur(y)
    vx, vy, vxy = blur(x * x) - mx * mx, blur(y * y) - my * my, blur(x * y) - mx * my
    expected = (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    assert_allclose(losses.ssim(image, photo), expected.mean(), rtol=1e-12)


def test_loss_gradient_matches_finite_differences(x64):
    image, photo = pictures(dtype=np.float64)
    loss = jax.jit(losses.Photometric())
    gradient = jax.grad(loss)(image, photo)
    direction = jnp.asarray(np.random.default_rng(1).normal(size=image.shape))
    step = 1e-6
    finite = (loss(image + step * direction, photo) - loss(image - step * direction, photo)) / (2 * step)
    assert_allclose(jnp.sum(gradient * direction), finite, rtol=1e-7)


def test_loss_is_zero_and_flat_for_equal_pictures():
    image, _ = pictures()
    value, gradient = jax.value_and_grad(losses.Photometric())(image, image)
    assert_allclose(value, 0, atol=1e-6)
    assert_allclose(gradient, 0, atol=1e-6)


def test_weight_of_one_or_zero_leaves_a_single_term():
    image, photo = pictures()
    assert_allclose(losses.Photometric(0.0)(image, photo), np.abs(image - photo).mean(), rtol=3e-6)
    assert_allclose(losses.Photometric(1.0)(image, photo), 1 - losses.ssim(image, photo), rtol=1e-6)


def ragged(size=(23, 31)):
    return jnp.asarray(np.random.default_rng(2).uniform(size=size) < 0.6)


def test_masked_loss_gradient_matches_finite_differences(x64):
    image, photo = pictures(dtype=np.float64)
    mask = ragged()
    loss = jax.jit(losses.Photometric())
    gradient = jax.grad(loss)(image, photo, mask)
    direction = jnp.asarray(np.random.default_rng(1).normal(size=image.shape))
    step = 1e-6
    finite = (loss(image + step * direction, photo, mask) - loss(image - step * direction, photo, mask)) / (
        2 * step
    )
    assert_allclose(jnp.sum(gradient * direction), finite, rtol=1e-7)
    assert_array_equal(gradient[~mask], 0)


def test_what_lies_outside_the_mask_changes_neither_loss_nor_gradient():
    image, photo = pictures()
    mask = ragged()
    loss = jax.value_and_grad(losses.Photometric())
    value, gradient = loss(image, photo, mask)
    for pair in (
        (jnp.where(mask[..., None], image, 5), photo),
        (image, jnp.where(mask[..., None], photo, 5)),
    ):
        other, other_gradient = loss(*pair, mask)
        assert other == value
        assert_array_equal(other_gradient, gradient)


def test_a_photo_of_which_nothing_counts_teaches_nothing():
    image, photo = pictures()
    value, gradient = jax.value_and_grad(losses.Photometric())(image, photo, jnp.zeros(image.shape[:2], bool))
    assert value == 0
    assert_array_equal(gradient, 0)


def test_masked_l1_is_the_mean_over_the_pixels_that_count():
    image, photo = pictures()
    mask = ragged()
    expected = np.abs(image - photo)[np.asarray(mask)].mean()
    assert_allclose(losses.Photometric(0.0)(image, photo, mask), expected, rtol=1e-6)
    everything = jnp.ones((23, 31), bool)
    assert_allclose(
        losses.Photometric()(image, photo, everything), losses.Photometric()(image, photo), rtol=1e-6
    )


def test_psnr_is_of_8_bit_images():
    photo = np.full((12, 12, 3), 100, np.uint8)
    assert_allclose(metrics.psnr(photo + 1, photo), 20 * np.log10(255))
    assert metrics.psnr(photo, photo) == np.inf
    # 0.4 of a level rounds away, 0.6 does not.
    assert metrics.psnr(metrics.to_8bit(photo / 255 + 0.4 / 255), photo) == np.inf
    assert_allclose(metrics.psnr(metrics.to_8bit(photo / 255 + 0.6 / 255), photo), 20 * np.log10(255))


def test_8_bit_images_clip_what_is_out_of_range():
    assert_array_equal(metrics.to_8bit(np.array([[[-1.0, 0.5, 2.0]]])), [[[0, 128, 255]]])


def test_evaluation_ssim_is_scikit_images():
    from skimage.metrics import structural_similarity

    rng = np.random.default_rng(0)
    smooth = np.cumsum(rng.normal(size=(40, 51, 3)), axis=1)
    photo = metrics.to_8bit(smooth / 10 + 0.5)
    image = metrics.to_8bit(smooth / 10 + 0.5 + rng.normal(size=smooth.shape) * 0.05)
    expected = structural_similarity(
        image, photo, channel_axis=2, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert_allclose(metrics.ssim(image, photo), expected, atol=1e-6)
    assert metrics.ssim(photo, photo) == 1
