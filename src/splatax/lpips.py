"""Learned perceptual image patch similarity, LPIPS (Zhang et al. 2018), version 0.1.

Both images pass through a convolutional network that was trained to classify images. With the features f
of layer l, scaled to unit length at each position, and the learned channel weights w,

    LPIPS = sum_l  mean over positions of  w_l . (f_l(image) - f_l(photo))^2                (Eq. 1)

The weights of the network are not included; `docs/evaluation.md` describes the file that holds them.
"""

import zipfile
import zlib
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float, UInt8

from splatax.errors import FormatError, InputError

SHIFT, SCALE = (
    (-0.030, -0.088, -0.188),
    (0.458, 0.448, 0.450),
)  # statistics of ImageNet's colours, for values in [-1, 1]
UNIT_EPSILON = 1e-10  # added to the length of a feature, as in the authors' code


@dataclass(frozen=True)
class Convolution:
    """A convolution, followed by a ReLU."""

    index: int  # position in torchvision's `features`, which is part of the names of its weights
    channels: int
    size: int = 3
    stride: int = 1
    padding: int = 1


@dataclass(frozen=True)
class MaxPool:
    """A maximum over windows that lie inside the image, at every second pixel."""

    size: int


@dataclass(frozen=True)
class Network:
    """A convolutional network in blocks of layers; the features after each block are compared."""

    name: str
    blocks: tuple[tuple[Convolution | MaxPool, ...], ...]

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Names and shapes of the weights."""
        shapes: dict[str, tuple[int, ...]] = {}
        channels = 3
        for i, block in enumerate(self.blocks):
            for layer in block:
                if isinstance(layer, Convolution):
                    kernel = (layer.channels, channels, layer.size, layer.size)
                    shapes[f"features.{layer.index}.weight"] = kernel
                    shapes[f"features.{layer.index}.bias"] = (layer.channels,)
                    channels = layer.channels
            shapes[f"lin{i}.model.1.weight"] = (1, channels, 1, 1)
        return shapes


ALEX = Network(  # Krizhevsky 2014, as in torchvision
    "AlexNet",
    (
        (Convolution(0, 64, size=11, stride=4, padding=2),),
        (MaxPool(3), Convolution(3, 192, size=5, padding=2)),
        (MaxPool(3), Convolution(6, 384)),
        (Convolution(8, 256),),
        (Convolution(10, 256),),
    ),
)
VGG = Network(  # Simonyan and Zisserman 2015, configuration D
    "VGG-16",
    (
        (Convolution(0, 64), Convolution(2, 64)),
        (MaxPool(2), Convolution(5, 128), Convolution(7, 128)),
        (MaxPool(2), Convolution(10, 256), Convolution(12, 256), Convolution(14, 256)),
        (MaxPool(2), Convolution(17, 512), Convolution(19, 512), Convolution(21, 512)),
        (MaxPool(2), Convolution(24, 512), Convolution(26, 512), Convolution(28, 512)),
    ),
)
SMALLEST = 32  # pixels; the last features of an image with a shorter side have no position
UNREADABLE = (ValueError, OSError, TypeError, EOFError, zipfile.BadZipFile, zlib.error)
Weights = dict[str, Float[Array, "..."]]


@dataclass(frozen=True)
class Lpips:
    """The metric: a network with its weights. Call it with two images.

    Attributes:
        network: the architecture.
        weights: arrays by the names of `network.shapes`.
    """

    network: Network
    weights: Weights

    @property
    def protocol(self) -> str:
        """A description of how the metric is computed."""
        return f"version 0.1, {self.network.name}, 8-bit images scaled to [-1, 1], mean over views"

    def __call__(
        self,
        image: UInt8[np.ndarray, "h w 3"],
        photo: UInt8[np.ndarray, "h w 3"],
        mask: Bool[np.ndarray, "h w"] | None = None,
    ) -> float:
        """Returns the distance of two images, 0 if they are equal.

        Pixels outside a mask are set to black in both, and the distance is divided by the fraction inside.

        Raises:
            InputError: if the images are too small for the network.
        """
        if min(image.shape[:2]) < SMALLEST:
            height, width = image.shape[:2]
            raise InputError(f"LPIPS needs at least {SMALLEST} x {SMALLEST} pixels, not {width} x {height}")
        fraction = 1.0
        if mask is not None:
            image, photo = (np.where(mask[..., None], picture, np.uint8(0)) for picture in (image, photo))
            fraction = float(mask.mean())
        return float(distance(self.network, self.weights, image, photo)) / fraction


def read(path: Path) -> Lpips:
    """Reads a file of weights. The shape of its first layer tells which network it is for.

    Raises:
        FormatError: if it is not an .npz file, or an array is missing or has a wrong shape.
    """
    how = "docs/evaluation.md of splatax shows how to make it"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except FileNotFoundError:
        raise FormatError(f"{path}: no such file of LPIPS weights; {how}.") from None
    except UNREADABLE as error:
        raise FormatError(f"{path}: not an .npz file of LPIPS weights ({error}); {how}.") from error
    first = arrays.get("features.0.weight", np.empty(0)).shape
    network = VGG if first == VGG.shapes["features.0.weight"] else ALEX
    for name, shape in network.shapes.items():
        found = arrays[name].shape if name in arrays else "missing"
        if found != shape:
            raise FormatError(
                f"{path}: LPIPS with {network.name} needs the array {name!r} of shape {shape}, which is "
                f"{found} here; {how}."
            )
    return Lpips(network, {name: jnp.asarray(arrays[name], jnp.float32) for name in network.shapes})


@partial(jax.jit, static_argnums=0)
def distance(
    network: Network, weights: Weights, image: UInt8[Array, "h w 3"], photo: UInt8[Array, "h w 3"]
) -> Float[Array, ""]:
    """Returns the distance of two images (Eq. 1)."""
    pair = jnp.moveaxis(jnp.stack([image, photo]), 3, 1).astype(jnp.float32) / 127.5 - 1
    shift, scale = (jnp.array(values)[None, :, None, None] for values in (SHIFT, SCALE))
    values = (pair - shift) / scale
    total = jnp.float32(0)
    for i, block in enumerate(network.blocks):
        for layer in block:
            values = (
                pooled(values, layer) if isinstance(layer, MaxPool) else convolved(values, layer, weights)
            )
        length = jnp.sqrt(jnp.sum(values * values, axis=1, keepdims=True))
        ours, theirs = values / (length + UNIT_EPSILON)
        channels = weights[f"lin{i}.model.1.weight"].reshape(-1)
        total += jnp.mean(jnp.einsum("chw,c->hw", (ours - theirs) ** 2, channels, precision="highest"))
    return total


def convolved(
    values: Float[Array, "n c h w"], layer: Convolution, weights: Weights
) -> Float[Array, "n c2 h2 w2"]:
    """Convolves, with zeros beyond the border, and applies the ReLU."""
    kernel, bias = (weights[f"features.{layer.index}.{part}"] for part in ("weight", "bias"))
    padding = [(layer.padding, layer.padding)] * 2
    sums = lax.conv_general_dilated(values, kernel, (layer.stride,) * 2, padding, precision="highest")
    return jnp.maximum(sums + bias[None, :, None, None], 0)


def pooled(values: Float[Array, "n c h w"], layer: MaxPool) -> Float[Array, "n c h2 w2"]:
    """Returns the maxima of windows, at every second pixel."""
    window = (1, 1, layer.size, layer.size)
    return lax.reduce_window(values, -jnp.inf, lax.max, window, (1, 1, 2, 2), "VALID")
