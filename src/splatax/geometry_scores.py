"""Errors of rendered depth and normals, compared with the truth or with landmarks of the photos."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Float

from splatax.cameras.geometry import seen_at
from splatax.dataset import View, mask_of
from splatax.errors import DatasetError
from splatax.gaussians import Gaussians
from splatax.rendering import Renderer

DEPTH = "median_depth"  # output that is compared, and that meshes are made from
NORMALS = "normals"
HALF = 0.5  # least alpha of a pixel whose depth counts
Reference = Literal["truth", "points"]
PROTOCOL = {  # how errors of geometry are computed, in words
    "truth": "pixels that have a true depth and are at least half opaque in the rendering; medians over the "
    "pixels of each view, then means over the views",
    "points": "points of structure from motion that a view observed, or of its measured depth, at their "
    "places in the view, if that pixel is at least half opaque in the rendering; these points are sparse, "
    "lie where there is texture, and have errors of their own; medians over the points of each view, then "
    "means over the views",
    "depth": f"output {DEPTH}, world units along the depth of the lens; the bias is positive where the scene "
    "is behind the reference",
    "normals": f"angle between the output {NORMALS} and the true normal, degrees",
}


@dataclass(frozen=True)
class GeometryScore:
    """Errors of one view, or means over several.

    Attributes:
        name: of the view.
        depth: median of the absolute error of depth, world units.
        bias: median of the error of depth, world units; positive where the scene is too far.
        relative: median of the absolute error of depth divided by the depth.
        coverage: fraction of the reference where the scene is at least half opaque.
        normals: median angle between normals, degrees; None if the reference has none.
    """

    name: str
    depth: float
    bias: float
    relative: float
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

        def mean(measure: str) -> float:
            values = [value for view in self.views if (value := getattr(view, measure)) is not None]
            return float(np.nanmean(values)) if np.isfinite(values).any() else np.nan

        normals = mean("normals")
        measures = (mean(name) for name in ("depth", "bias", "relative", "coverage"))
        return GeometryScore("mean", *measures, None if np.isnan(normals) else normals)


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
    landmarks = ((view, view.landmarks()) for view in chosen if view.landmarks)
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
    outputs = ("alpha", DEPTH) if truth.normals is None else ("alpha", DEPTH, NORMALS)
    drawn = renderer(gaussians, camera, outputs=outputs).images
    seen = known & (np.asarray(drawn["alpha"]) >= HALF) & (np.asarray(drawn[DEPTH]) > 0)
    normals = None
    if truth.normals is not None:
        normals = median_angle(np.asarray(drawn[NORMALS]), truth.normals[rows][:, columns], seen)
    return depth_score(view.name, np.asarray(drawn[DEPTH])[known], depth[known], seen[known], normals)


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
    drawn = renderer(gaussians, camera, outputs=("alpha", DEPTH)).images
    found = np.asarray(drawn[DEPTH])[y, x]
    return depth_score(view.name, found, depths, (np.asarray(drawn["alpha"])[y, x] >= HALF) & (found > 0))


def depth_score(
    name: str,
    found: Float[np.ndarray, " n"],
    expected: Float[np.ndarray, " n"],
    seen: Bool[np.ndarray, " n"],
    normals: float | None = None,
) -> GeometryScore:
    """Returns the errors of depths, of which those that are not seen count for the coverage alone.

    Errors are NaN if nothing is seen.
    """
    coverage = float(seen.mean()) if len(seen) else np.nan
    error = found[seen].astype(np.float64) - expected[seen]
    if not len(error):
        return GeometryScore(name, np.nan, np.nan, np.nan, coverage, normals)
    relative = np.abs(error) / expected[seen]
    medians = (float(np.median(values)) for values in (np.abs(error), error, relative))
    return GeometryScore(name, *medians, coverage, normals)


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


def measures_of(score: GeometryScore) -> dict[str, float | None]:
    """Returns the measures of a view, or of the means, by name.

    Measures of nothing are None. Normals are there if they were compared.
    """
    measures = {
        "depth_error": score.depth,
        "depth_bias": score.bias,
        "relative_depth_error": score.relative,
        "coverage": score.coverage,
    }
    known = {name: None if np.isnan(value) else value for name, value in measures.items()}
    return known if score.normals is None else known | {"normal_error": score.normals}


def as_json(scores: GeometryScores) -> dict[str, Any]:
    """Returns the means and the errors of each view, and how they were made, as JSON values."""
    kinds = (scores.reference, "depth", *(["normals"] if scores.mean.normals is not None else []))
    return {
        "reference": scores.reference,
        **measures_of(scores.mean),
        "views": [{"name": view.name} | measures_of(view) for view in scores.views],
        "protocol": {kind: PROTOCOL[kind] for kind in kinds},
    }
