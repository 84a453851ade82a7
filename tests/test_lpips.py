"""LPIPS, on random weights, against the formula in plain NumPy and SciPy."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.signal import correlate

from splatax import lpips
from splatax.errors import FormatError, InputError
from splatax.lpips import ALEX, VGG


def random_weights(network, seed=0):
    """He's initialization, so that values keep their size; weights of channels are positive."""
    rng = np.random.default_rng(seed)

    def array(name, shape):
        if name.startswith("lin"):
            return rng.uniform(size=shape)
        return rng.normal(size=shape) * (np.sqrt(2 / np.prod(shape[1:])) if len(shape) == 4 else 0.1)

    return {name: array(name, shape).astype(np.float32) for name, shape in network.shapes.items()}


def write(path, network, seed=0, **changed):
    """A file of weights; an array that is changed to None is left out."""
    arrays = random_weights(network, seed) | changed
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    return path


def pictures(size=(47, 58), seed=0):
    rng = np.random.default_rng(seed)
    return tuple(rng.integers(0, 256, (*size, 3), np.uint8) for _ in range(2))


def convolve(values, weights, index, stride, padding):
    padded = np.pad(values, [(0, 0), (padding, padding), (padding, padding)])
    kernels, biases = weights[f"features.{index}.weight"], weights[f"features.{index}.bias"]
    sums = [
        correlate(padded, kernel, mode="valid")[0] + bias
        for kernel, bias in zip(kernels, biases, strict=True)
    ]
    return np.maximum(np.stack(sums)[:, ::stride, ::stride], 0)


def pool(values, size):
    windows = np.lib.stride_tricks.sliding_window_view(values, (size, size), axis=(1, 2))
    return windows[:, ::2, ::2].max(axis=(3, 4))


# (layer's index, kernel's stride and padding), and sizes of pools: as torchvision prints its models.
ALEXNET = [[(0, 4, 2)], [3, (3, 1, 2)], [3, (6, 1, 1)], [(8, 1, 1)], [(10, 1, 1)]]
VGG16 = [
    [(0, 1, 1), (2, 1, 1)],
    [2, (5, 1, 1), (7, 1, 1)],
    [2, (10, 1, 1), (12, 1, 1), (14, 1, 1)],
    [2, (17, 1, 1), (19, 1, 1), (21, 1, 1)],
    [2, (24, 1, 1), (26, 1, 1), (28, 1, 1)],
]


def features(picture, weights, blocks):
    values = picture.astype(np.float64).transpose(2, 0, 1) / 127.5 - 1
    shift, scale = np.array([-0.030, -0.088, -0.188]), np.array([0.458, 0.448, 0.450])
    values = (values - shift[:, None, None]) / scale[:, None, None]
    for block in blocks:
        for layer in block:
            values = pool(values, layer) if isinstance(layer, int) else convolve(values, weights, *layer)
        yield values / np.linalg.norm(values, axis=0).clip(1e-12)


def expected(image, photo, weights, blocks):
    weights = {name: array.astype(np.float64) for name, array in weights.items()}
    pairs = zip(features(image, weights, blocks), features(photo, weights, blocks), strict=True)
    return sum(
        np.mean(np.tensordot(weights[f"lin{i}.model.1.weight"].ravel(), (ours - theirs) ** 2, 1))
        for i, (ours, theirs) in enumerate(pairs)
    )


@pytest.mark.parametrize(
    ("network", "blocks"),
    [
        pytest.param(ALEX, ALEXNET, id="AlexNet"),
        pytest.param(VGG, VGG16, id="VGG-16", marks=pytest.mark.slow),
    ],
)
def test_distance_is_the_formula(network, blocks, tmp_path):
    image, photo = pictures(size=(33, 37))
    metric = lpips.read(write(tmp_path / "weights.npz", network))
    assert metric.network is network
    assert network.name in metric.protocol
    # Ten to thirteen layers of float32 sums, the longest over 4608 products.
    assert_allclose(metric(image, photo), expected(image, photo, random_weights(network), blocks), rtol=2e-4)


def test_equal_pictures_are_at_distance_zero_and_order_does_not_matter(tmp_path):
    image, photo = pictures()
    metric = lpips.read(write(tmp_path / "weights.npz", ALEX))
    assert metric(image, image) < 1e-12  # sums in another order, squared
    assert_allclose(metric(image, photo), metric(photo, image), rtol=1e-6)


def test_what_lies_outside_the_mask_does_not_matter(tmp_path):
    image, photo = pictures(size=(64, 64))
    metric = lpips.read(write(tmp_path / "weights.npz", ALEX))
    mask = np.zeros((64, 64), bool)
    mask[:, :40] = True
    other = np.where(mask[..., None], image, 255 - image)
    assert metric(other, photo, mask) == metric(image, photo, mask) > 0
    assert metric(image, photo, np.ones_like(mask)) == metric(image, photo)
    assert_allclose(
        metric(image, photo, mask),
        metric(image * mask[..., None], photo * mask[..., None]) * 64 / 40,
        rtol=1e-6,
    )


def test_pictures_too_small_for_the_network_are_refused(tmp_path):
    metric = lpips.read(write(tmp_path / "weights.npz", ALEX))
    with pytest.raises(InputError, match="at least 32 x 32 pixels, not 40 x 20"):
        metric(*pictures(size=(20, 40)))
    assert np.isfinite(metric(*pictures(size=(32, 32))))


@pytest.mark.parametrize(
    ("network", "changed", "complaint"),
    [
        (ALEX, {"lin3.model.1.weight": None}, r"AlexNet.*'lin3.model.1.weight'.*is missing here"),
        (VGG, {"features.28.bias": None}, r"VGG-16.*'features.28.bias'.*is missing here"),
        (
            ALEX,
            {"features.3.weight": np.zeros((192, 64, 3, 3))},
            r"\(192, 64, 5, 5\).*\(192, 64, 3, 3\) here",
        ),
        (ALEX, {"features.0.weight": None}, r"'features.0.weight'.*is missing here"),
    ],
)
def test_a_file_that_lacks_an_array_is_refused_by_name(network, changed, complaint, tmp_path):
    path = write(tmp_path / "weights.npz", network, **changed)
    with pytest.raises(FormatError, match=complaint) as refusal:
        lpips.read(path)
    assert str(path) in str(refusal.value)
    assert "docs/evaluation.md" in str(refusal.value)


@pytest.mark.parametrize("contents", [b"", b"text", b"PK\x03\x04 and then nothing of a zip file"])
def test_what_is_no_file_of_weights_is_refused(contents, tmp_path):
    path = tmp_path / "weights.npz"
    path.write_bytes(contents)
    with pytest.raises(FormatError, match=r"weights.npz: not an .npz file"):
        lpips.read(path)
    with pytest.raises(FormatError, match="no such file"):
        lpips.read(tmp_path / "missing.npz")
    np.save(tmp_path / "lone.npy", np.zeros(3))
    with pytest.raises(FormatError, match=r"not an .npz file"):
        lpips.read(tmp_path / "lone.npy")
