"""The similarity that brings the cameras of one model to those of another."""

import numpy as np
from jaxtyping import Float

ROUNDS = 20  # of weighing
NO_TURN = 1e-5  # radians: smaller differences weigh the same
NO_MOVE = 1e-4  # the same for places, as a fraction of the cameras' spread


def similarity_of_cameras(
    source: Float[np.ndarray, "n 3 4"], target: Float[np.ndarray, "n 3 4"]
) -> tuple[float, Float[np.ndarray, "3 3"], Float[np.ndarray, "3"]]:
    """Returns the scale, rotation and translation that bring cameras to where others are.

    Rotations are averaged, then places, both by least sums of distances rather than of their squares
    (Weiszfeld 1937), so a few cameras that are far off count little. Cameras at one place keep the scale.

    Args:
        source, target: world-to-camera matrices of the same cameras in two worlds; there is at least one.
    """
    turns = np.einsum("nji,njk->nik", target[:, :, :3], source[:, :, :3])
    weights = np.ones(len(turns))
    for _ in range(ROUNDS):
        rotation = _nearest_rotation(np.einsum("n,nij->ij", weights, turns))
        # The chord is 2 sqrt(2) times the sine of half the angle.
        angles = np.linalg.norm(turns - rotation, axis=(1, 2)) / np.sqrt(2)
        weights = 1 / np.maximum(angles, NO_TURN)
    a, b = (-np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3]) for poses in (source, target))
    a = a @ rotation.T
    spread = np.linalg.norm(b - np.median(b, axis=0), axis=1).max()
    weights = np.ones(len(a))
    for _ in range(ROUNDS):
        fractions = weights / weights.sum()
        middle_a, middle_b = fractions @ a, fractions @ b
        across = fractions @ np.sum((a - middle_a) ** 2, axis=1)
        scale = fractions @ np.sum((a - middle_a) * (b - middle_b), axis=1) / across if across > 0 else 1.0
        scale = scale if scale > 0 else 1.0
        translation = middle_b - scale * middle_a
        apart = np.linalg.norm(scale * a + translation - b, axis=1)
        weights = 1 / np.maximum(apart, NO_MOVE * spread if spread > 0 else 1.0)
    return float(scale), rotation, translation


def _nearest_rotation(matrix: Float[np.ndarray, "3 3"]) -> Float[np.ndarray, "3 3"]:
    left, _, right = np.linalg.svd(matrix)
    return (left * [1, 1, np.sign(np.linalg.det(left @ right))]) @ right
