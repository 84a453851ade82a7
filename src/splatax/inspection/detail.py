"""Measures the fine detail of photos at the points of a capture, which other photos show too."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import numpy as np
from jaxtyping import Float, Int

from splatax.cameras import Camera
from splatax.cameras.geometry import seen_at
from splatax.dataset import Dataset

SAMPLES = 3000  # points at which photos are compared
CELLS, SURFACE = 24, 1.1  # columns of the depth grid; how much deeper than the nearest point still is visible
SHADES = (0.04, 0.95)  # luminance outside of which a sample is noise or saturated
RADIUS = 4  # pixels around a point in which detail is measured: a square of 9 x 9
LEAST_RMS = 0.1  # levels, so that the logarithm of no detail is finite


@dataclass(frozen=True)
class SeenPoints:
    """The sampled points that a photo shows.

    Attributes:
        total: number of sampled points, seen or not.
        indices: which of them the photo shows.
        rows: rows of the pixels at which it shows them.
        columns: columns of these pixels.
        scales: log2 of the size, in pixels of the photo, of one world unit at each point.
    """

    total: int
    indices: Int[np.ndarray, " k"]
    rows: Int[np.ndarray, " k"]
    columns: Int[np.ndarray, " k"]
    scales: Float[np.ndarray, " k"]


@dataclass(frozen=True)
class Detail:
    """Fine detail of a photo around each of the sampled points; NaN where the photo does not show it.

    Attributes:
        contrasts: log2 of the root mean square of the Laplacian of luminance in [0, 255].
        shades: log2 of the mean luminance in [0, 255]. Exposure adds the same to both, so that it does not
            change their difference.
        scales: log2 of the size of one world unit, in pixels of the photo.
    """

    contrasts: Float[np.ndarray, " n"]
    shades: Float[np.ndarray, " n"]
    scales: Float[np.ndarray, " n"]

    @property
    def relative(self) -> Float[np.ndarray, " n"]:
        """Contrast in proportion to luminance, log2."""
        return self.contrasts - self.shades


def sampled_points(dataset: Dataset) -> Float[np.ndarray, "n 3"]:
    """Returns at most `SAMPLES` points of a capture, always the same ones."""
    chosen = np.random.default_rng(0).permutation(len(dataset.points))[:SAMPLES]
    return dataset.points.positions[chosen].astype(np.float64)


def seen_points(points: Float[np.ndarray, "n 3"], camera: Camera, width: int, height: int) -> SeenPoints:
    """Returns the points that a photo shows: those that are not far behind others in the same part of it.

    Args:
        points: world points.
        camera: camera of the photo.
        width: width of the photo as it was decoded, pixels. No points are found in a photo whose proportions
            differ from those of its camera.
        height: height of it.
    """
    upright = abs(width * camera.height / camera.width - height) <= 0.05 * height
    pixels, depth = seen_at(camera, points if upright else points[:0])
    x, y = (pixels * [width / camera.width, height / camera.height]).T
    inside = np.flatnonzero((x >= 0) & (x < width) & (y >= 0) & (y < height))  # false for NaN
    row, column, depth = y[inside].astype(int), x[inside].astype(int), depth[inside]
    cell = (row * CELLS // width) * CELLS + column * CELLS // width
    nearest = np.full(cell.max(initial=0) + 1, np.inf)
    np.minimum.at(nearest, cell, depth)
    seen = (depth <= SURFACE * nearest[cell]) & (depth > 0)
    focal = float(np.asarray(camera.fx)) * width / camera.width
    return SeenPoints(len(points), inside[seen], row[seen], column[seen], np.log2(focal / depth[seen]))


def detail_at(
    seen: SeenPoints, luminance: Float[np.ndarray, "h w"], laplacian: Float[np.ndarray, "h-2 w-2"]
) -> Detail:
    """Measures the detail of a photo around the points that it shows.

    Points too near to the border, and those in the dark or in white parts, count as not shown.

    Args:
        seen: the points.
        luminance: of the photo, in [0, 255].
        laplacian: Laplacian of the luminance, without the pixels at the border.
    """
    height, width = luminance.shape
    margin = RADIUS + 1
    row, column = seen.rows, seen.columns
    inner = (row >= margin) & (row < height - margin) & (column >= margin) & (column < width - margin)
    around = np.arange(-RADIUS, RADIUS + 1)
    rows, columns = row[inner, None, None] + around[:, None], column[inner, None, None] + around
    shade = luminance[rows, columns].mean(axis=(1, 2))
    rms = np.sqrt(np.square(laplacian[rows - 1, columns - 1]).mean(axis=(1, 2)))
    usable = (shade > 255 * SHADES[0]) & (shade < 255 * SHADES[1])
    found = np.full((3, seen.total), np.nan, np.float32)
    found[:, seen.indices[inner][usable]] = (
        np.log2(np.maximum(rms, LEAST_RMS))[usable],
        np.log2(shade[usable]),
        seen.scales[inner][usable],
    )
    return Detail(*found)


def joined_detail(faces: Sequence[Detail]) -> Detail:
    """Returns the detail of a 360-degree photo from that of its faces, each of which shows other points."""

    def first_known(values: Sequence[Float[np.ndarray, " n"]]) -> Float[np.ndarray, " n"]:
        return reduce(lambda known, other: np.where(np.isnan(known), other, known), values)

    # A point at the border of two faces takes all of its values from the same face: all are NaN, or none is.
    return Detail(
        first_known([face.contrasts for face in faces]),
        first_known([face.shades for face in faces]),
        first_known([face.scales for face in faces]),
    )
