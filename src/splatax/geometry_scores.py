"""Errors of rendered depth and normals, compared with the truth or with landmarks of the photos."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from splatax.cameras.geometry import seen_at
from splatax.dataset import View, mask_of
from splatax.errors import DatasetError
from splatax.gaussians import Gaussians
from splatax.rendering import Renderer

DEPTH = "median_depth"  # which meshes are made from if there is nothing to choose the best by
ROBUST_DEPTH = "median_surface_depth"  # the best or close to it in scenes of all recipes: docs/geometry.md
OF_PLANES = ("surface_depth", "median_surface_depth")
DEPTHS = (DEPTH, *OF_PLANES)  # outputs that are compared
NORMALS = "normals"
ENOUGH = 8  # views from which the best depth is chosen
HALF = 0.5  # least alpha of a pixel whose depth counts
CAP = 0.05  # most that one depth adds to the mean of relative errors
DEPTH_MEASURES = ("error", "bias", "relative_error", "capped_error")  # fields of `DepthError` in files
Reference = Literal["truth", "points"]
PROTOCOL = {  # how errors of geometry are computed, in words
    "truth": "pixels that have a true depth and are at least half opaque in the rendering; medians over the "
    "pixels of each view, then means over the views",
    "points": "points of structure from motion that a view observed, or of its measured depth, at their "
    "places in the view, if that pixel is at least half opaque in the rendering; these points are sparse, "
    "lie where there is texture, and have errors of their own; medians over the points of each view, then "
    "means over the views",
    "depth": "by output; world units along the depth of the lens; the bias is positive where the scene is "
    "behind the reference",
    "capped_error": "mean over the pixels or points of a view of the relative error, of which each counts "
    f"at most {CAP:.0%}; then mean over the views",
    "normals": f"angle between the output {NORMALS} and the true normal, degrees",
}


class DepthError(NamedTuple):
    """Errors of one depth output in one view, or means over several; NaN where nothing was compared.

    Attributes:
        median: median of the absolute error, world units.
        bias: median of the error, world units; positive where the scene is too far.
        relative: median of the absolute error divided by the depth.
        capped: mean of the absolute error divided by the depth, where each depth counts at most 5 %. Unlike
            the medians, it sees thin parts, which are a small fraction of the depths.
    """

    median: float
    bias: float
    relative: float
    capped: float


@dataclass(frozen=True)
class GeometryScore:
    """Errors of one view, or means over several.

    Attributes:
        name: of the view.
        depths: errors of depth by output.
        coverage: fraction of the reference where the scene is at least half opaque.
        normals: median angle between normals, degrees; None if the reference has none.
    """

    name: str
    depths: dict[str, DepthError]
    coverage: float
    normals: float | None = None


@dataclass(frozen=True)
class GeometryScores:
    """Errors of the geometry of several views.

    Attributes:
        reference: "truth", or "points": landmarks of the photos, mostly of structure from motion.
        views: at least one.
    """

    reference: Reference
    views: tuple[GeometryScore, ...]

    @property
    def mean(self) -> GeometryScore:
        """Means over the views, each over those that have the measure."""
        depths = {
            output: DepthError(*(_mean(values) for values in zip(*errors, strict=True)))
            for output in DEPTHS
            if (errors := [view.depths[output] for view in self.views])
        }
        angles = [view.normals for view in self.views if view.normals is not None]
        coverage = _mean([view.coverage for view in self.views])
        return GeometryScore("mean", depths, coverage, _mean(angles) if angles else None)

    @property
    def best(self) -> str:
        """The output from which meshes are best made.

        The median of the error decides whether it is the depth of centres or one of planes, and the capped
        mean between those of planes: thin parts, which one of them loses, are a small fraction of a view.
        """
        errors = self.mean.depths
        closest = min(errors, key=lambda output: np.nan_to_num(errors[output].median, nan=np.inf))
        if closest not in OF_PLANES:
            return closest
        return min(OF_PLANES, key=lambda output: np.nan_to_num(errors[output].capped, nan=np.inf))


def best_depth(gaussians: Gaussians, views: Sequence[View], renderer: Renderer = Renderer()) -> str | None:
    """Returns the output whose depth agrees best with the landmarks of some views; None if they have none.

    Scenes that were trained only on colours have the best depth in "median_depth"; those that were trained
    for surfaces have it in the depths of surfaces: "median_surface_depth" if they have thin parts or many
    edges, else "surface_depth".
    """
    chosen = views[:: -(-len(views) // ENOUGH) or 1]
    scores = against_landmarks(gaussians, chosen, renderer)
    return scores.best if scores else None


def evaluate_geometry(
    gaussians: Gaussians, views: Iterable[View], *, renderer: Renderer = Renderer()
) -> GeometryScores | None:
    """Compares rendered depth and normals with the truth of the views that have it.

    If none of the views does, the depths of their landmarks are compared instead: points of structure from
    motion that the photos observed, or measured depth.

    Args:
        gaussians: the scene.
        views: views to render.
        renderer: with the low-pass filter that the scene was trained with.

    Returns:
        The errors; None if there is nothing to compare with.

    Raises:
        DatasetError: if the truth cannot be read, or has other proportions than its view.
    """
    chosen = list(views)
    if any(view.truth for view in chosen):
        return GeometryScores(
            "truth", tuple(against_truth(gaussians, view, renderer) for view in chosen if view.truth)
        )
    return against_landmarks(gaussians, chosen, renderer)


def against_landmarks(
    gaussians: Gaussians, views: Iterable[View], renderer: Renderer = Renderer()
) -> GeometryScores | None:
    """Compares rendered depth with that of the landmarks of views; None if they have none."""
    landmarks = ((view, view.landmarks()) for view in views if view.landmarks)
    found = [against_points(gaussians, view, points, renderer) for view, points in landmarks if len(points)]
    return GeometryScores("points", tuple(found)) if found else None


def against_truth(gaussians: Gaussians, view: View, renderer: Renderer = Renderer()) -> GeometryScore:
    """Compares rendered depth and normals with the true ones, inside the view's mask if it has one.

    Raises:
        DatasetError: if the view has no truth, or one of other proportions.
    """
    if view.truth is None:
        raise DatasetError(f"{view.name}: its true geometry is not known.")
    truth, camera = view.truth(), view.camera
    height, width = truth.depth.shape
    if abs(width * camera.height / camera.width - height) > 1.5 * max(width / camera.width, 1):
        raise DatasetError(
            f"{view.name}: its true depth has {width} x {height} pixels, its camera {camera.width} x "
            f"{camera.height}: other proportions. Make it again for the photo as it is."
        )
    rows = ((np.arange(camera.height) + 0.5) * height / camera.height).astype(int)
    columns = ((np.arange(camera.width) + 0.5) * width / camera.width).astype(int)
    depth = truth.depth[rows][:, columns]
    mask = mask_of(view)
    known = (depth > 0) & (True if mask is None else mask)
    outputs = ("alpha", *DEPTHS) if truth.normals is None else ("alpha", *DEPTHS, NORMALS)
    drawn = {name: np.asarray(image) for name, image in renderer(gaussians, camera, outputs).images.items()}
    opaque = drawn["alpha"] >= HALF
    normals = None
    if truth.normals is not None:
        normals = median_angle(drawn[NORMALS], truth.normals[rows][:, columns], known & opaque)
    return _score(view.name, {name: image[known] for name, image in drawn.items()}, depth[known], normals)


def against_points(
    gaussians: Gaussians, view: View, points: Float[np.ndarray, "n 3"], renderer: Renderer = Renderer()
) -> GeometryScore:
    """Compares rendered depth with that of points that a view observed.

    Args:
        gaussians: the scene.
        view: the view; points outside its mask do not count.
        points: world points on surfaces that the view sees.
        renderer: with the low-pass filter that the scene was trained with.
    """
    camera = view.camera
    pixels, depths = seen_at(camera, points.astype(np.float64))
    inside = np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
    x, y = pixels[inside].astype(int).T
    mask = mask_of(view)
    counted = np.ones(len(x), bool) if mask is None else mask[y, x]
    x, y, depths = x[counted], y[counted], depths[inside][counted]
    images = renderer(gaussians, camera, ("alpha", *DEPTHS)).images
    return _score(view.name, {name: np.asarray(image)[y, x] for name, image in images.items()}, depths)


def _score(
    name: str,
    drawn: dict[str, Float[np.ndarray, " n"]],
    expected: Float[np.ndarray, " n"],
    normals: float | None = None,
) -> GeometryScore:
    opaque = drawn["alpha"] >= HALF
    depths = {output: depth_error(drawn[output][opaque], expected[opaque]) for output in DEPTHS}
    return GeometryScore(name, depths, float(opaque.mean()) if len(opaque) else np.nan, normals)


def depth_error(found: Float[np.ndarray, " n"], expected: Float[np.ndarray, " n"]) -> DepthError:
    """Returns the errors of depths; those that are 0 were not found and do not count."""
    known = found > 0
    if not known.any():
        return DepthError(np.nan, np.nan, np.nan, np.nan)
    error = found[known].astype(np.float64) - expected[known]
    relative = np.abs(error) / expected[known]
    median, bias, middle = (float(np.median(values)) for values in (np.abs(error), error, relative))
    return DepthError(median, bias, middle, float(np.mean(np.minimum(relative, CAP))))


def _mean(values: Iterable[float]) -> float:
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else np.nan


def median_angle(
    found: Float[np.ndarray, "h w 3"], expected: Float[np.ndarray, "h w 3"], seen: Bool[np.ndarray, "h w"]
) -> float | None:
    """Returns the median angle between normals, degrees, where both are known; None if that is nowhere."""
    both = seen & (found != 0).any(axis=2) & (expected != 0).any(axis=2)
    if not both.any():
        return None
    a, b = found[both].astype(np.float64), expected[both].astype(np.float64)
    angles = np.arctan2(np.linalg.norm(np.cross(a, b), axis=1), np.sum(a * b, axis=1))
    return float(np.degrees(np.median(angles)))


def measures_of(score: GeometryScore) -> dict[str, Any]:
    """Returns the measures of a view, or of the means, as JSON values; normals where they were compared."""
    depths = {
        output: dict(zip(DEPTH_MEASURES, map(_number, e), strict=True)) for output, e in score.depths.items()
    }
    measures = {"depth": depths, "coverage": _number(score.coverage)}
    return measures if score.normals is None else measures | {"normal_error": score.normals}


def _number(value: float) -> float | None:
    return None if np.isnan(value) else value


def as_json(scores: GeometryScores) -> dict[str, Any]:
    """Returns the means and the errors of each view, and how they were made, as JSON values."""
    kinds = (scores.reference, "depth", *(["normals"] if scores.mean.normals is not None else []))
    return {
        "reference": scores.reference,
        **measures_of(scores.mean),
        "views": [{"name": view.name} | measures_of(view) for view in scores.views],
        "protocol": {kind: PROTOCOL[kind] for kind in kinds},
    }
