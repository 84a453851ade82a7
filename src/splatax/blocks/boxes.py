"""Boxes on the ground plane that divide a scene: every point is in exactly one of them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from splatax.errors import InputError

MARGIN = 0.1  # of a box's sides, on each: a block trains the Gaussians there too, and the merger drops them
MOST_MORE = 0.2  # of the points in a box: the most that its margin may hold, else it is narrower
SPREAD = (0.05, 0.95)  # quantiles of coordinates that say how wide points lie, a few far ones aside

Coordinates = Float[np.ndarray, "n 2"]  # on the ground plane, world units


@dataclass(frozen=True)
class Box:
    """Half-open rectangle on the ground plane: its low borders belong to it, its high ones do not.

    Attributes:
        low: smallest coordinates, world units; minus infinity where the box has no border.
        high: coordinates from which points are outside; infinity where the box has no border.
        margin: width of the strip around the box in which its block trains Gaussians too.
    """

    low: tuple[float, float]
    high: tuple[float, float]
    margin: tuple[float, float] = (0.0, 0.0)

    def contains(self, places: Coordinates) -> Bool[np.ndarray, " n"]:
        """Returns a mask of the points inside."""
        return np.all((places >= self.low) & (places < self.high), axis=1)

    def trains(self, places: Coordinates) -> Bool[np.ndarray, " n"]:
        """Returns a mask of the points inside or in the margin."""
        low, high = np.subtract(self.low, self.margin), np.add(self.high, self.margin)
        return np.all((places >= low) & (places < high), axis=1)

    def distance(self, places: Coordinates) -> Float[np.ndarray, " n"]:
        """Returns the distances of points inside to the nearest border, world units."""
        return np.minimum(places - self.low, np.subtract(self.high, places)).min(axis=1)


def ground_axes(points: Float[np.ndarray, "n 3"], up: Float[np.ndarray, "3"]) -> Float[np.ndarray, "2 3"]:
    """Returns the two axes of the ground plane: unit vectors along the length and the width of the points.

    Args:
        points: of the scene, world units.
        up: unit vector that points up.
    """
    flat = np.eye(3) - np.outer(up, up)
    centred = (points.astype(np.float64) - np.median(points, axis=0)) @ flat
    # The longest tenth does not decide: far points are few, and lie anywhere.
    lengths = np.linalg.norm(centred, axis=1)
    near = centred[lengths <= np.quantile(lengths, 0.9)]
    _, vectors = np.linalg.eigh(near.T @ near - (1 + np.sum(near**2)) * np.outer(up, up))
    return vectors[:, :0:-1].T


def places_of(points: Float[np.ndarray, "n 3"], axes: Float[np.ndarray, "2 3"]) -> Coordinates:
    """Returns coordinates on the ground plane, in float64."""
    return points.astype(np.float64) @ axes.T


def cut(places: Coordinates, count: int) -> tuple[Box, ...]:
    """Returns boxes that cover the plane and hold about as many of the points each.

    A box is cut across its longer side, again and again.

    Raises:
        InputError: if a box would hold no point.
    """
    boxes = _cut(places, Box((-np.inf,) * 2, (np.inf,) * 2), count)
    if len(boxes) < count:
        raise InputError(f"{len(places):,} Gaussians cannot be cut into {count:,} blocks. Ask for fewer.")
    return tuple(_with_margin(places, box) for box in boxes)


def block_of(places: Coordinates, boxes: Sequence[Box]) -> Int[np.ndarray, " n"]:
    """Returns the number of the box that each point is in."""
    masks = np.stack([box.contains(places) for box in boxes])
    assert np.all(masks.sum(axis=0) == 1), "the boxes do not share out the plane"
    return np.argmax(masks, axis=0)


def _cut(places: Coordinates, box: Box, count: int) -> list[Box]:
    inside = places[box.contains(places)]
    if not len(inside):
        return []
    if count == 1:
        return [box]
    axis = int(np.argmax(_widths(inside)))
    first = count // 2
    border = float(np.quantile(inside[:, axis], first / count))
    low, high = list(box.low), list(box.high)
    low[axis] = high[axis] = border
    return [
        *_cut(places, Box(box.low, (high[0], high[1])), first),
        *_cut(places, Box((low[0], low[1]), box.high), count - first),
    ]


def _widths(places: Coordinates) -> Float[np.ndarray, "2"]:
    first, last = np.quantile(places, SPREAD, axis=0)
    return last - first


def _with_margin(places: Coordinates, box: Box) -> Box:
    inside = box.contains(places)
    sides = np.maximum(_widths(places[inside]), np.finfo(np.float32).tiny)
    beyond = np.maximum(np.subtract(box.low, places), places - box.high)
    distances = np.sort(np.max(beyond / sides, axis=1)[~inside])  # in sides
    most = int(MOST_MORE * inside.sum())
    width = sides * (min(MARGIN, distances[most]) if most < len(distances) else MARGIN)
    return Box(box.low, box.high, (float(width[0]), float(width[1])))
