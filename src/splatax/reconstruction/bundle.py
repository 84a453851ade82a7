"""Bundle adjustment of given poses over feature matches, before training.

The given poses are the start. Every fifth track is kept aside: its error tells whether the adjusted poses
agree with the photos better than the given ones, and if not, the given ones stay.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatax.dataset import View
from splatax.packages import required_by
from splatax.reconstruction.pipeline import Watch
from splatax.reconstruction.triangulation import DATABASE, matchable, matched

if TYPE_CHECKING:
    import pycolmap

STAGES = ("reading", "features", "matches", "poses")
LOOSE = 12.0  # pixels: reprojection error up to which observations count under the given poses
LOOSE_ANGLE = 4.0  # degrees: the same for angles, twice COLMAP's
ASIDE = 5  # every fifth track is kept aside
FEWEST_TRACKS = 100  # that are adjusted, and a fifth of them kept aside
FEWEST_OBSERVATIONS = 20  # of a photo, below which it keeps its given pose
OUTLIER = 1.0  # pixels: scale of Cauchy's loss
BETTER = 0.97  # of the error of tracks kept aside, at most, for adjusted poses to be taken


@dataclass(frozen=True)
class Adjustment:
    """Poses after bundle adjustment, or the given ones where it did not help.

    Attributes:
        views: the views with the poses to use.
        before: median reprojection error of the tracks kept aside with the given poses, pixels.
        after: the same with the adjusted poses.
        motion: median distance by which the tracks move in the photos from given to adjusted poses, pixels.
        observations: number of matched features that the poses were adjusted to; 0 if there are too few.
    """

    views: tuple[View, ...]
    before: float
    after: float
    motion: float
    observations: int

    @property
    def helps(self) -> bool:
        """True if the views have adjusted poses."""
        return self.observations > 0 and self.after <= BETTER * self.before

    def __str__(self) -> str:
        if not self.observations:
            return "given poses kept: too few features match between the photos to adjust them"
        errors = f"{self.before:.2f} to {self.after:.2f} px (median of points kept aside)"
        if self.helps:
            return (
                f"poses adjusted to {self.observations:,} matched features: reprojection error {errors}, "
                f"photos moved by {self.motion:.2f} px (median)"
            )
        return f"given poses kept, as adjusting them does not help: reprojection error {errors}"


@required_by("splatax.reconstruction")
def adjusted_poses(
    views: Sequence[View], *, seed: int = 0, watch: Watch = lambda stage, done, total: None
) -> Adjustment:
    """Adjusts the poses of views to matched features, and keeps the given ones if that does not help.

    Lenses stay as they are, and so does the place of the scene: the adjusted model is moved, turned and
    scaled back onto the points that the given poses see. Pass training views only, so that held-out photos
    have no part in it.

    Args:
        views: views with cameras that are accurate to several pixels.
        seed: random seed.
        watch: function that is called with the progress of each of `STAGES`.
    """
    nothing = Adjustment(tuple(views), 0.0, 0.0, 0.0, 0)
    if not matchable(views):
        return nothing
    with matched(views, seed, watch) as (model, work):
        watch("poses", 0, 1)
        given = _loosely_triangulated(model, work, seed)
        numbers = sorted(given.points3D)
        aside = set(numbers[::ASIDE])
        if len(numbers) - len(aside) < FEWEST_TRACKS:
            return nothing
        control, found = _without(given, set(numbers) - aside), _without(given, aside)
        observations = found.compute_num_observations()
        free = {
            number
            for number, image in found.images.items()
            if len(image.get_observation_points2D()) >= FEWEST_OBSERVATIONS
        }
        _adjust(found, free)
        back = _similarity(_positions(found), _positions(given), _distances(given, found))
        adjusted = {number: _pose(found.images[number], back) for number in sorted(free)}
        before = _error(control, {})
        after = _error(control, adjusted)
        motion = _motion(given, adjusted)
        watch("poses", 1, 1)
    outcome = Adjustment(tuple(views), before, after, motion, observations)
    if not outcome.helps:
        return outcome
    moved = tuple(
        _with_pose(view, adjusted[number]) if number in adjusted else view
        for number, view in enumerate(views, start=1)
    )
    return replace(outcome, views=moved)


def _loosely_triangulated(
    model: "pycolmap.Reconstruction", work: Path, seed: int
) -> "pycolmap.Reconstruction":
    """Returns the model with points whose observations agree with the given poses to several pixels."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions()
    options.random_seed = options.triangulation.random_seed = seed
    options.triangulation.ignore_two_view_tracks = False
    for name in ("create_max_angle_error", "continue_max_angle_error"):
        setattr(options.triangulation, name, LOOSE_ANGLE)
    for name in ("complete_max_reproj_error", "merge_max_reproj_error"):
        setattr(options.triangulation, name, LOOSE)
    options.mapper.filter_max_reproj_error = LOOSE
    return pycolmap.triangulate_points(
        model, work / DATABASE, work / "photos", work / "model", options=options
    )


def _without(model: "pycolmap.Reconstruction", points: set[int]) -> "pycolmap.Reconstruction":
    """Returns a copy of a model without some of its points."""
    left = copy.deepcopy(model)
    for number in points:
        left.delete_point3D(number)
    return left


def _adjust(model: "pycolmap.Reconstruction", free: set[int]) -> None:
    """Moves the points of a model and the poses of some of its images, so that they agree."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length = options.refine_principal_point = options.refine_extra_params = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = OUTLIER
    options.ceres.solver_options.num_threads = 1  # so that sums have one order
    config = pycolmap.BundleAdjustmentConfig()
    for number, image in sorted(model.images.items()):
        config.add_image(number)
        if number not in free:
            config.set_constant_rig_from_world_pose(image.frame_id)
    if len(free) == len(model.images):
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _error(control: "pycolmap.Reconstruction", poses: Mapping[int, Float[np.ndarray, "3 4"]]) -> float:
    """Returns the median reprojection error of tracks, each with its best point for these poses, pixels."""
    import pycolmap

    model = copy.deepcopy(control)
    for number, pose in poses.items():
        model.frame(model.images[number].frame_id).set_cam_from_world(
            model.images[number].camera_id, pycolmap.Rigid3d(pose)
        )
    _adjust(model, set())
    return float(np.median(np.concatenate([_residuals(model, number) for number in sorted(model.images)])))


def _residuals(model: "pycolmap.Reconstruction", number: int) -> Float[np.ndarray, " n"]:
    """Returns the distances between the observations of an image and the places of their points, pixels."""
    image = model.images[number]
    seen = [p for p in image.get_observation_points2D() if model.exists_point3D(p.point3D_id)]
    places = [image.project_point(model.point3D(p.point3D_id).xyz) for p in seen]
    apart = [
        np.inf if place is None else np.linalg.norm(place - p.xy)
        for p, place in zip(seen, places, strict=True)
    ]
    return np.array(apart, np.float64)


def _positions(model: "pycolmap.Reconstruction") -> dict[int, Float[np.ndarray, "3"]]:
    return {number: np.array(point.xyz) for number, point in model.points3D.items()}


def _distances(given: "pycolmap.Reconstruction", found: "pycolmap.Reconstruction") -> dict[int, float]:
    """Returns the mean distance of each point of `found` from the cameras that observe it, world units."""
    centres = {number: image.projection_center() for number, image in given.images.items()}
    return {
        number: float(
            np.mean(
                [
                    np.linalg.norm(given.point3D(number).xyz - centres[element.image_id])
                    for element in point.track.elements
                ]
            )
        )
        for number, point in found.points3D.items()
    }


def _similarity(
    source: Mapping[int, Float[np.ndarray, "3"]],
    target: Mapping[int, Float[np.ndarray, "3"]],
    distances: Mapping[int, float],
) -> Float[np.ndarray, "4 4"]:
    """Returns the similarity that brings points nearest to others (Umeyama 1991), as a 4 x 4 matrix.

    Points count by the inverse square of their distance, as they do in pictures. The fit is repeated without
    the tenth of them that fits worst.
    """
    numbers = sorted(source)
    a, b = np.array([source[n] for n in numbers]), np.array([target[n] for n in numbers])
    far = np.array([distances[n] for n in numbers])
    kept = np.isfinite(a).all(1) & np.isfinite(b).all(1) & (far > 0)
    found = np.eye(4)
    for _ in range(2):
        found = _umeyama(a[kept], b[kept], 1 / far[kept] ** 2)
        apart = np.linalg.norm(a @ found[:3, :3].T + found[:3, 3] - b, axis=1) / far
        kept &= apart <= np.quantile(apart[kept], 0.9)
    return found


def _umeyama(
    a: Float[np.ndarray, "n 3"], b: Float[np.ndarray, "n 3"], weights: Float[np.ndarray, " n"]
) -> Float[np.ndarray, "4 4"]:
    weights = weights / weights.sum()
    mean_a, mean_b = weights @ a, weights @ b
    a, b = a - mean_a, b - mean_b
    left, singular, right = np.linalg.svd((b * weights[:, None]).T @ a)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    rotation = (left * signs) @ right
    scale = (singular * signs).sum() / (weights @ np.sum(a * a, axis=1))
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = scale * rotation, mean_b - scale * rotation @ mean_a
    return found


def _pose(image: "pycolmap.Image", back: Float[np.ndarray, "4 4"]) -> Float[np.ndarray, "3 4"]:
    """Returns the pose of an image after its world has been moved by a similarity."""
    pose = image.cam_from_world().matrix()
    scale = np.cbrt(np.linalg.det(back[:3, :3]))
    rotation = pose[:, :3] @ (back[:3, :3] / scale).T
    centre = back[:3, :3] @ image.projection_center() + back[:3, 3]
    return np.column_stack([rotation, -rotation @ centre])


def _motion(model: "pycolmap.Reconstruction", poses: Mapping[int, Float[np.ndarray, "3 4"]]) -> float:
    """Returns the median distance by which points move in the photos that observe them, pixels."""
    apart = []
    for number, pose in poses.items():
        image, camera = model.images[number], model.cameras[model.images[number].camera_id]
        points = np.array([model.point3D(p.point3D_id).xyz for p in image.get_observation_points2D()])
        local = points @ pose[:, :3].T + pose[:, 3]
        ahead = local[:, 2] > 0
        there = np.array([image.project_point(point) for point in points[ahead]], float)
        apart.append(np.linalg.norm(camera.img_from_cam(local[ahead]) - there, axis=1))
    moved = np.concatenate(apart) if apart else np.zeros(0)
    return float(np.nanmedian(moved)) if len(moved) else 0.0


def _with_pose(view: View, pose: Float[np.ndarray, "3 4"]) -> View:
    matrix = jnp.asarray(np.vstack([pose, [0, 0, 0, 1]]), view.camera.cam_from_world.dtype)
    return replace(view, camera=replace(view.camera, cam_from_world=matrix))
