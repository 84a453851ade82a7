"""Labels of Gaussians from label images of the photos, and scenes split by them into parts."""

from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from splatax.cameras import Camera
from splatax.errors import InputError
from splatax.gaussians import Gaussians
from splatax.rendering import Renderer
from splatax.scene import Part, Scene

IGNORED = -1  # label of pixels that say nothing
BACKGROUND = 0  # label of Gaussians that no labelled pixel shows


def votes(
    gaussians: Gaussians,
    views: Iterable[tuple[Camera, Int[np.ndarray, "_ _"]]],
    count: int,
    renderer: Renderer = Renderer(),
) -> Float[np.ndarray, "n count"]:
    """Returns the number of pixels of each label that each Gaussian fills: sums of its blending weights.

    The image of a channel is the sum of weight times channel, so the gradient of the image's sum over the
    pixels of a label, with respect to the channel of that label, is the weight.

    Args:
        gaussians: the scene.
        views: cameras with label images of their size: whole numbers from 0, and -1 for pixels that say
            nothing.
        count: number of labels.
        renderer: with the low-pass filter that the scene was trained with.

    Raises:
        InputError: if a label image has another size than its camera, or a label out of range.
    """

    @jax.jit
    def weights(gaussians: Gaussians, camera: Camera, labels: Int[Array, "h w"]) -> Float[Array, "n count"]:
        chosen = jax.nn.one_hot(labels, count, dtype=gaussians.means.dtype)  # zeros for -1

        def total(channels):
            return jnp.sum(chosen * renderer(gaussians, camera, (), {"label": channels}).features["label"])

        return jax.grad(total)(jnp.zeros((len(gaussians), count), gaussians.means.dtype))

    found = np.zeros((len(gaussians), count))
    for camera, labels in views:
        if labels.shape != (camera.height, camera.width):
            raise InputError(
                f"a label image of {labels.shape[1]} x {labels.shape[0]} pixels for a camera of "
                f"{camera.width} x {camera.height}. Give one of the camera's size."
            )
        if labels.min() < IGNORED or labels.max() >= count:
            wrong = labels.max() if labels.max() >= count else labels.min()
            raise InputError(f"a label image has the label {wrong}, which is not from 0 to {count - 1}.")
        found += np.asarray(weights(gaussians, camera, jnp.asarray(labels)))
    return found


def labels_of(votes: Float[np.ndarray, "n count"]) -> Int[np.ndarray, " n"]:
    """Returns the label of each Gaussian that has most votes; `BACKGROUND` where it has none."""
    return np.where(votes.sum(axis=1) > 0, votes.argmax(axis=1), BACKGROUND).astype(np.int32)


def split_by_label(gaussians: Gaussians, labels: Int[np.ndarray, " n"], names: Sequence[str]) -> Scene:
    """Returns a scene with one part for each label that a Gaussian has, in the order of the labels.

    Args:
        gaussians: the scene.
        labels: label of each Gaussian, from 0.
        names: name of each label, for the part.

    Raises:
        InputError: if two labels have one name, or a label has none.
    """
    if len(set(names)) < len(names):
        raise InputError(f"two labels have one name: {', '.join(names)}. Give each its own.")
    present = np.unique(labels)
    if present.min() < 0 or present.max() >= len(names):
        raise InputError(f"labels from {present.min()} to {present.max()}, but {len(names)} names.")

    def rows(label: int) -> Gaussians:
        return jax.tree.map(lambda leaf: leaf[labels == label], gaussians)

    return Scene({names[label]: Part(rows(label)) for label in map(int, present)})


def intersection_over_union(
    found: Int[np.ndarray, "*n"], truth: Int[np.ndarray, "*n"], count: int
) -> Float[np.ndarray, " count"]:
    """Returns, for each label, how many pixels have it in both of those that have it in either.

    NaN for labels that neither has. Pixels whose true label is -1 are left out.
    """
    counted = truth != IGNORED
    result = np.full(count, np.nan)
    for label in range(count):
        here, there = counted & (found == label), counted & (truth == label)
        if either := np.count_nonzero(here | there):
            result[label] = np.count_nonzero(here & there) / either
    return result
