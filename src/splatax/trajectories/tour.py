"""A trajectory past the cameras of a capture."""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from splatax.cameras import Camera
from splatax.trajectories.interpolation import Keyframe, Size, interpolate

TURN = 1.0  # radians of rotation that count as much as the spread of the cameras
STATIONS = 24  # most cameras that a tour passes: more make a video restless


def tour(cameras: Sequence[Camera], frames: int, size: Size) -> list[Camera]:
    """Returns a smooth trajectory past the cameras at constant speed, in the order of a short tour.

    Args:
        cameras: cameras of the capture, one or more. The trajectory passes at most 24 of them, evenly
            chosen along the tour.
        frames: number of cameras to return.
        size: width and height of the frames, pixels.
    """
    keys = [Keyframe.of(camera, size) for camera in cameras]
    between = distances(keys)
    order = short_way(between)
    chosen = np.unique(np.round(np.linspace(0, len(order) - 1, min(len(order), STATIONS))).astype(int))
    stations = [order[i] for i in chosen]
    kept = [stations[0]]
    for station in stations[1:]:
        if between[kept[-1], station] > 1e-6:  # two photos from one place are one station
            kept.append(station)
    gaps = [between[a, b] for a, b in itertools.pairwise(kept)]
    times = np.concatenate([[0], np.cumsum(gaps)])
    moments = np.linspace(0, times[-1], frames)
    return [key.camera(size) for key in interpolate([keys[i] for i in kept], times, moments)]


def distances(keys: Sequence[Keyframe]) -> Float[np.ndarray, "n n"]:
    """Returns the distances between keyframes: of positions, in units of their spread, plus angles."""
    positions = np.stack([key.position for key in keys])
    spread = np.linalg.norm(positions - positions.mean(axis=0), axis=1).mean() or 1.0
    apart = np.linalg.norm(positions[:, None] - positions[None], axis=2)
    quats = np.stack([key.rotation.as_quat() for key in keys])
    angles = 2 * np.arccos(np.clip(np.abs(quats @ quats.T), 0, 1))
    np.fill_diagonal(angles, 0)
    return apart / spread + angles / TURN


def short_way(between: Float[np.ndarray, "n n"]) -> list[int]:
    """Returns a short open tour through all points, as a list of indices.

    The tour starts at the point with the largest sum of distances, goes to the nearest unvisited point
    each time, and is then improved by 2-opt until no exchange shortens it.
    """
    count = len(between)
    way = [int(np.argmax(between.sum(axis=1)))]
    left = set(range(count)) - set(way)
    while left:
        nearest = min(left, key=lambda i: (between[way[-1], i], i))
        way.append(nearest)
        left.remove(nearest)
    shorter = True
    while shorter:
        shorter = False
        for i in range(count - 1):
            order = np.array(way)
            # Reversing i..j replaces the steps into i and out of j; at an end there is only one.
            j = np.arange(i + 1, count)
            into = between[order[i - 1], order[j]] - between[order[i - 1], order[i]] if i else 0.0
            after = order[np.minimum(j + 1, count - 1)]
            out = np.where(j + 1 < count, between[order[i], after] - between[order[j], after], 0.0)
            change = into + out
            best = int(np.argmin(change))
            if change[best] < -1e-9:
                way[i : j[best] + 1] = way[i : j[best] + 1][::-1]
                shorter = True
    return way
