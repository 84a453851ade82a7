"""Motion of a page's splats: the bones of a clip, and the bones of each splat, as Spark takes them."""

import base64
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt16

from splatax.errors import FormatError
from splatax.scene.clips import Clip
from splatax.scene.skin import Rig
from splatax.transforms import Similarity

FPS = 60  # poses that are stored for each second; the page blends between them
MOST_BONES = 256  # of Spark, which has 8 bits for the index of a bone and 8 for its weight
INFLUENCES = 4  # bones of a splat
TO_VIEWER = np.diag([1.0, -1.0, -1.0, 1.0])  # y down, z forward -> y up, z back


@dataclass(frozen=True)
class Motion:
    """A clip that Gaussians of a page play in a loop.

    Attributes:
        rig: the skeleton, and the weights of each of these Gaussians.
        clip: the motion.
    """

    rig: Rig
    clip: Clip

    def described(self, place: Similarity, order: Int[np.ndarray, " n"], name: str) -> dict[str, Any]:
        """Returns what the page needs of the motion, with the fields of web/src/animation.js.

        Args:
            place: transform from the coordinates of the skeleton to those of the page's file.
            order: rows of the Gaussians in the order of the page's file.
            name: of the page, for messages.

        Raises:
            FormatError: if more bones carry Gaussians than the viewer has.
        """
        indices, weights = (np.asarray(rows)[order] for rows in (self.rig.indices, self.rig.weights))
        used = np.unique(indices[weights > 0])
        if len(used) > MOST_BONES:
            raise FormatError(
                f"{name}: {len(used)} joints carry Gaussians; a page has at most {MOST_BONES}. Write a video."
            )
        bones = self._bones(place, used)
        return {
            "joints": len(used),
            "bones": base64.b64encode(bones.astype("<f4").tobytes()).decode(),
            "skin": base64.b64encode(packed(np.searchsorted(used, indices), weights).tobytes()).decode(),
        }

    def _bones(self, place: Similarity, used: Int[np.ndarray, " b"]) -> Float[np.ndarray, "f b 12"]:
        """Returns the columns of each bone's transform, for each stored pose."""
        skeleton = self.rig.skeleton
        there = TO_VIEWER @ place.matrix
        back, inverse = np.linalg.inv(there), np.asarray(skeleton.inverse_binds, np.float64)
        frames = []
        for frame in range(int(np.ceil(self.clip.seconds * FPS)) + 1):
            worlds = skeleton.worlds(self.clip.pose(skeleton.rest, frame / FPS))
            moves = there @ (np.asarray(worlds, np.float64) @ inverse)[used] @ back
            frames.append(moves[:, :3].transpose(0, 2, 1).reshape(len(used), 12))
        return np.stack(frames)


def packed(indices: Int[np.ndarray, "n k"], weights: Float[np.ndarray, "n k"]) -> UInt16[np.ndarray, "n 4"]:
    """Returns weights of 8 bits with the index of their bone in the upper byte.

    The weights of a splat sum to exactly 255: with any other sum the splat would be scaled.
    """
    missing = max(INFLUENCES - indices.shape[1], 0)
    indices, weights = (np.pad(rows, [(0, 0), (0, missing)]) for rows in (indices, weights))
    strongest = np.argsort(-weights, axis=1, kind="stable")[:, :INFLUENCES]
    indices, weights = (np.take_along_axis(rows, strongest, axis=1) for rows in (indices, weights))
    exact = 255 * weights / weights.sum(axis=1, keepdims=True)
    levels = np.floor(exact).astype(np.int64)
    spare = 255 - levels.sum(axis=1, keepdims=True)  # go to the largest remainders
    ranks = np.argsort(np.argsort(levels - exact, axis=1, kind="stable"), axis=1)
    levels += ranks < spare
    return (levels + (np.where(levels > 0, indices, 0) << 8)).astype("<u2")
