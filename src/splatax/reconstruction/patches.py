"""Matched features located more precisely, by least-squares matching of their surroundings (Grün 1985).

The patch around a feature in one photo is fitted to those around the same point in the other photos. Patches
are sampled as a pinhole would see them, through the lenses found so far: a lens bends a patch, and the bend
would be taken for a shift. The map between two patches is affine. It is found by Gauss-Newton with the
gradients of the first patch (Baker and Matthews 2004), after brightness and contrast have been removed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from splatax.reconstruction import mapping

if TYPE_CHECKING:
    import pycolmap

HALF = 7  # pixels: half the width of a patch
WINDOW = 3.0  # pixels: standard deviation of the weights of a patch
STEPS = 12  # of Gauss-Newton, at most
SMALL = 0.002  # pixels: length of a step that is the last
FARTHEST = 1.0  # pixels: farther from the feature, a patch shows something else
SIMILAR = 0.9  # least correlation of two patches of one point
WIDEST = 2.0  # slope from the axis beyond which a pinhole would stretch patches too much
OUTSIDE = 0.02  # of the weights of a patch that may lie outside of its photo
FAINTEST = 0.5  # levels of 255: standard deviation of a patch up to which it is noise

_side = np.arange(-HALF, HALF + 1, dtype=np.float64)
OFFSETS = np.stack(np.meshgrid(_side, _side), axis=-1).reshape(-1, 2)
WEIGHTS = np.exp(-np.sum(OFFSETS**2, axis=1) / (2 * WINDOW**2))
WEIGHTS = WEIGHTS / WEIGHTS.sum()


class Observations(NamedTuple):
    """Observations of points in all photos.

    Attributes:
        images: number of the image of each.
        features: its feature in the image.
        points: number of its point.
        places: of its feature, as a pinhole would see it, pixels.
        shapes: of its feature: turn and size.
    """

    images: Int[np.ndarray, " n"]
    features: Int[np.ndarray, " n"]
    points: Int[np.ndarray, " n"]
    places: Float[np.ndarray, "n 2"]
    shapes: Float[np.ndarray, "n 2 2"]


@dataclass(frozen=True)
class Photo:
    """A photo whose brightness can be sampled between its pixels.

    Attributes:
        splines: coefficients of cubic splines through the brightness of the pixels.
        camera: COLMAP's camera of the photo.
    """

    splines: Float[np.ndarray, "h w"]
    camera: "pycolmap.Camera"

    @classmethod
    def read(cls, path: Path, camera: "pycolmap.Camera") -> "Photo":
        """Reads a photo."""
        from PIL import Image
        from scipy import ndimage

        with Image.open(path) as image:
            brightness = np.asarray(image.convert("RGB"), np.float64).mean(axis=2)
        return cls(ndimage.spline_filter(brightness, mode="mirror"), camera)

    def patches(
        self, places: Float[np.ndarray, "n 2"], maps: Float[np.ndarray, "n 2 2"]
    ) -> Float[np.ndarray, "n k"]:
        """Returns patches without their mean and contrast; NaN for those that reach out of the photo.

        Args:
            places: of their middles, as a pinhole sees them.
            maps: from offsets in a patch to offsets of places.
        """
        from scipy import ndimage

        around = places[:, None] + np.einsum("nij,kj->nki", maps, OFFSETS)
        pixels = bent(self.camera, around.reshape(-1, 2))
        values = ndimage.map_coordinates(
            self.splines, [pixels[:, 1] - 0.5, pixels[:, 0] - 0.5], mode="mirror", prefilter=False
        ).reshape(len(places), len(OFFSETS))
        size = np.array(self.splines.shape[::-1])
        beyond = ~np.all((pixels >= 0) & (pixels <= size), axis=1).reshape(values.shape)
        values = values - (values @ WEIGHTS)[:, None]
        contrast = np.sqrt((values * values) @ WEIGHTS)
        known = (beyond @ WEIGHTS <= OUTSIDE) & (contrast > FAINTEST)
        return np.where(known[:, None], values / np.where(known, contrast, 1)[:, None], np.nan)


def straightened(camera: "pycolmap.Camera", pixels: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Returns where a pinhole would see what a photo shows at some pixels."""
    return camera.mean_focal_length() * np.asarray(camera.cam_from_img(pixels), np.float64)


def bent(camera: "pycolmap.Camera", places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    """Returns the pixels of a photo that show what a pinhole would see at some places."""
    points = np.column_stack([places / camera.mean_focal_length(), np.ones(len(places))])
    return np.asarray(camera.img_from_cam(points), np.float64)


def locate(model: "pycolmap.Reconstruction", work: Path, database: Path) -> set[tuple[int, int]]:
    """Moves observations of a model to where their patches agree, and returns those that were found.

    The observation of middle size of each point stays, and is the pattern for the others. Observations whose
    patches do not agree stay where they are. Photos are read one after the other, twice.

    Args:
        model: with cameras that are accurate to a pixel.
        work: folder with the photos in "photos".
        database: of the features.

    Returns:
        Numbers of images and features: of the observations that were found, and of their patterns.
    """
    seen = observations_of(model, database)
    pattern = patterns_of(seen)
    own = np.flatnonzero(pattern == np.arange(len(pattern)))
    patches = np.full((len(own), len(OFFSETS)), np.nan, np.float32)
    for photo, rows in _photos(model, work, seen, own):
        straight = np.tile(np.eye(2), (len(rows), 1, 1))
        patches[np.searchsorted(own, rows)] = photo.patches(seen.places[rows], straight)
    known: list[Int[np.ndarray, " n"]] = [np.zeros(0, np.int64)]
    for photo, rows in _photos(model, work, seen, np.flatnonzero(pattern != np.arange(len(pattern)))):
        maps = seen.shapes[rows] @ np.linalg.inv(seen.shapes[pattern[rows]])
        ideal = patches[np.searchsorted(own, pattern[rows])].astype(np.float64)
        places, found = fitted(photo, ideal, seen.places[rows], maps)
        for row, pixel in zip(rows[found], bent(photo.camera, places[found]), strict=True):
            model.images[int(seen.images[row])].points2D[int(seen.features[row])].xy = pixel
        known += [rows[found], pattern[rows[found]]]
    return {(int(seen.images[i]), int(seen.features[i])) for i in np.unique(np.concatenate(known))}


def observations_of(model: "pycolmap.Reconstruction", database: Path) -> Observations:
    """Returns the observations of the points of a model that a pinhole could see too."""
    every: list[Observations] = []
    with mapping.opened(database) as opened:
        for number, image in sorted(model.images.items()):
            camera = model.cameras[image.camera_id]
            features = [i for i, point in enumerate(image.points2D) if point.has_point3D()]
            if not features:
                continue
            points = np.array([image.points2D[i].point3D_id for i in features], np.int64)
            places = straightened(camera, np.array([image.points2D[i].xy for i in features]))
            usable = np.max(np.abs(places), axis=1) < WIDEST * camera.mean_focal_length()  # NaN is not
            shapes = shapes_of(opened.read_keypoints(number)[features])
            columns = np.full(len(features), number), np.array(features), points, places, shapes
            every.append(Observations(*(column[usable] for column in columns)))
    return Observations(*(np.concatenate(columns) for columns in zip(*every, strict=True)))


def shapes_of(keypoints: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n 2 2"]:
    """Returns the affine shapes of features, which are stored as such or as scales and orientations."""
    if keypoints.shape[1] >= 6:
        return keypoints[:, 2:6].astype(np.float64).reshape(-1, 2, 2)
    scale, angle = keypoints[:, 2:4].astype(np.float64).T
    cos, sin = scale * np.cos(angle), scale * np.sin(angle)
    return np.stack([cos, -sin, sin, cos], axis=1).reshape(-1, 2, 2)


def patterns_of(seen: Observations) -> Int[np.ndarray, " n"]:
    """Returns the observation of middle size of the point of each observation."""
    sizes = np.abs(np.linalg.det(seen.shapes))
    order = np.lexsort((sizes, seen.points))
    points, first, count = np.unique(seen.points[order], return_index=True, return_counts=True)
    middle = order[first + count // 2]
    return middle[np.searchsorted(points, seen.points)]


def _photos(
    model: "pycolmap.Reconstruction", work: Path, seen: Observations, rows: Int[np.ndarray, " m"]
) -> Iterator[tuple[Photo, Int[np.ndarray, " r"]]]:
    """Yields one photo after the other, with those of the rows that are observed in it."""
    for number in np.unique(seen.images[rows]):
        image = model.images[int(number)]
        photo = Photo.read(work / "photos" / image.name, model.cameras[image.camera_id])
        yield photo, rows[seen.images[rows] == number]


def fitted(
    photo: Photo,
    pattern: Float[np.ndarray, "m k"],
    start: Float[np.ndarray, "m 2"],
    maps: Float[np.ndarray, "m 2 2"],
) -> tuple[Float[np.ndarray, "m 2"], Bool[np.ndarray, " m"]]:
    """Returns where the patches of a photo agree with patterns, as a pinhole sees it, and whether they do.

    Args:
        photo: in which they are searched for.
        pattern: patches of other photos.
        start: first places.
        maps: first maps from offsets in the pattern to offsets of places.
    """
    slopes, solve = _linearized(pattern)
    places, maps, apart = start.copy(), maps.copy(), np.full(len(start), np.inf)
    active = np.isfinite(solve).all((1, 2))
    for _ in range(STEPS):
        rows = np.flatnonzero(active)
        if not len(rows):
            break
        difference = photo.patches(places[rows], maps[rows]) - pattern[rows]
        step = np.einsum("nij,njk,nk->ni", solve[rows], slopes[rows], difference * WEIGHTS)
        change = np.eye(2) + step[:, 2:].reshape(-1, 2, 2)
        kept = np.isfinite(step).all(axis=1) & (np.linalg.norm(step[:, 2:], axis=1) < 0.5)
        active[rows[~kept]], apart[rows[~kept]] = False, np.inf
        rows, difference = rows[kept], difference[kept]
        apart[rows] = (difference * difference) @ WEIGHTS
        maps[rows] = maps[rows] @ np.linalg.inv(change[kept])
        moved = np.einsum("nij,nj->ni", maps[rows], step[kept, :2])
        places[rows] -= moved
        active[rows] = np.linalg.norm(moved, axis=1) > SMALL
    near = np.linalg.norm(places - start, axis=1) < FARTHEST
    return places, near & ~active & (1 - apart / 2 > SIMILAR)  # the correlation of patches of contrast 1


def _linearized(
    pattern: Float[np.ndarray, "m k"],
) -> tuple[Float[np.ndarray, "m 6 k"], Float[np.ndarray, "m 6 6"]]:
    """Returns the change of patterns with shift and affine map, and the inverse of their normal equations.

    Changes of brightness and contrast are left out. What cannot be solved is NaN.
    """
    grid = pattern.reshape(-1, 2 * HALF + 1, 2 * HALF + 1)
    down, across = np.gradient(grid, axis=(1, 2))
    dx, dy = (slope.reshape(len(pattern), -1) for slope in (across, down))
    x, y = OFFSETS.T
    slopes = np.stack([dx, dy, dx * x, dx * y, dy * x, dy * y], axis=1)
    slopes -= np.einsum("nik,k->ni", slopes, WEIGHTS)[..., None]
    slopes -= np.einsum("nik,nk->ni", slopes, pattern * WEIGHTS)[..., None] * pattern[:, None]
    normal = np.einsum("nik,njk,k->nij", slopes, slopes, WEIGHTS)
    scale = np.sqrt(np.einsum("nii->ni", normal))
    scaled = normal / (scale[:, :, None] * scale[:, None, :])
    good = np.isfinite(scaled).all((1, 2))
    good[good] = np.linalg.cond(scaled[good]) < 1e4
    inverse = np.full_like(normal, np.nan)
    inverse[good] = np.linalg.inv(normal[good])
    return slopes, inverse
