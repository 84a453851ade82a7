"""Bundle adjustment of COLMAP's models, by parts."""

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from splatax.reconstruction import mapping
from splatax.reconstruction.calibration import DISTORTION, FOCAL, Free
from splatax.reconstruction.patches import locate
from splatax.reconstruction.similarity import similarity_of_cameras
from splatax.reconstruction.triangulation import DATABASE

if TYPE_CHECKING:
    import pycolmap

LOOSE = 12.0  # pixels: reprojection error up to which observations count under the given cameras
LOOSE_ANGLE = 4.0  # degrees: the same for angles, twice COLMAP's
FEWEST_OBSERVATIONS = 20  # of a photo, below which it keeps its given pose
FEWEST_OF_LENS = 100  # observations through a lens, below which it stays as given
OUTLIER = 1.0  # pixels: scale of Cauchy's loss
OUTLIER_OF_PATCHES = 0.1  # pixels: the same for observations that patches have located
LARGE = 0.004  # of a photo's diagonal: scale of features from which they are left out where a lens is found
ENOUGH = 0.5  # of a photo's observations that are of smaller features, for it to do without the others


@dataclass(frozen=True)
class Part:
    """Part of a model that was adjusted: the numbers of images whose poses changed, and of cameras."""

    photos: frozenset[int]
    lenses: frozenset[int]


def loosely_triangulated(
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


def without_points(model: "pycolmap.Reconstruction", points: set[int]) -> "pycolmap.Reconstruction":
    """Returns a copy of a model without some of its points."""
    left = copy.deepcopy(model)
    for number in points:
        left.delete_point3D(number)
    return left


def features_of(model: "pycolmap.Reconstruction", point: int) -> list[tuple[int, int]]:
    """Returns the observations of a point, as numbers of images and of features in them."""
    return [(e.image_id, e.point2D_idx) for e in model.point3D(point).track.elements]


def adjust(model: "pycolmap.Reconstruction", free: Free, work: Path) -> Part:
    """Moves the points of a model, and the cameras with enough observations, so that they agree.

    Where the distortion is adjusted, the model loses its observations of large features.
    """
    if free in DISTORTION:
        leave_out_large_features(model, work)
    seen = {number: len(image.get_observation_points2D()) for number, image in model.images.items()}
    through = dict.fromkeys(model.cameras, 0)
    for number, image in model.images.items():
        through[image.camera_id] += seen[number]
    lenses = {
        number
        for number, camera in model.cameras.items()
        if free != "poses" and through[number] >= FEWEST_OF_LENS and not camera.is_spherical()
    }
    photos = {number for number, count in seen.items() if count >= FEWEST_OBSERVATIONS}
    part = Part(frozenset(photos), frozenset(lenses))
    _solve(model, part, free)
    return part


def adjust_to_patches(model: "pycolmap.Reconstruction", part: Part, free: Free, work: Path) -> None:
    """Locates the observations of an adjusted model by their patches, and adjusts the same part to them.

    The centres of features are certain to a twentieth of a pixel, and patches to a hundredth. Photos lose the
    observations that were not located, if those are at most half and enough remain. If fewer than half of all
    observations are located, cameras and points stay as they are.

    Args:
        model: after `adjust`.
        part: that was adjusted.
        free: the parameters to adjust.
        work: folder of the photos and of the database.
    """
    observations = model.compute_num_observations()
    located = locate(model, work, work / DATABASE)
    if len(located) < ENOUGH * observations:
        return
    for number, image in sorted(model.images.items()):
        seen = [i for i, point in enumerate(image.points2D) if point.has_point3D()]
        lost = [i for i in seen if (number, i) not in located]
        least = max(ENOUGH * len(seen), FEWEST_OBSERVATIONS)
        _without_observations(model, number, lost if len(seen) - len(lost) >= least else [])
    _solve(model, part, free, OUTLIER_OF_PATCHES)


def leave_out_large_features(model: "pycolmap.Reconstruction", work: Path) -> None:
    """Removes observations of large features from the photos that have enough small ones.

    A lens bends the surroundings of a feature, so the centre of a large one is not found where the lens shows
    the centre. The error grows with the square of the size, and is taken for distortion.
    """
    with mapping.opened(work / DATABASE) as database:
        scales = {number: _scales(database.read_keypoints(number)) for number in sorted(model.images)}
    for number, image in sorted(model.images.items()):
        camera = model.cameras[image.camera_id]
        large = scales[number] > LARGE * np.hypot(camera.width, camera.height)
        seen = np.array([point.has_point3D() for point in image.points2D], bool)
        if np.sum(seen & ~large) < ENOUGH * np.sum(seen):
            continue
        _without_observations(model, number, np.flatnonzero(seen & large).tolist())


def _without_observations(model: "pycolmap.Reconstruction", number: int, features: Iterable[int]) -> None:
    """Removes observations of an image from a model."""
    image = model.images[number]
    for feature in features:
        if image.points2D[feature].has_point3D():  # the point may be gone with another observation
            model.delete_observation(number, feature)


def _scales(keypoints: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
    """Returns the scales of features: of places and affine shapes, or of places, scales and orientations."""
    if keypoints.shape[1] < 6:
        return keypoints[:, 2]
    a11, a12, a21, a22 = keypoints[:, 2:6].T
    return (np.hypot(a11, a21) + np.hypot(a12, a22)) / 2


def _solve(
    model: "pycolmap.Reconstruction", part: Part, free: Free = "poses", outlier: float = OUTLIER
) -> None:
    """Moves the points of a model, and a part of its cameras, so that they agree with the observations."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.refine_focal_length, options.refine_extra_params = free in FOCAL, free in DISTORTION
    options.refine_principal_point = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = outlier
    options.ceres.solver_options.num_threads = 1  # so that sums have one order
    config = pycolmap.BundleAdjustmentConfig()
    for number, image in sorted(model.images.items()):
        config.add_image(number)
        if number not in part.photos:
            config.set_constant_rig_from_world_pose(image.frame_id)
    for number in model.cameras:
        if number not in part.lenses:
            config.set_constant_cam_intrinsics(number)
    if len(part.photos) == len(model.images):
        config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()


def _place(model: "pycolmap.Reconstruction", like: "pycolmap.Reconstruction", photos: Iterable[int]) -> None:
    """Gives images of a model the poses that they have in another one."""
    for number in photos:
        image = model.images[number]
        model.frame(image.frame_id).set_cam_from_world(image.camera_id, like.images[number].cam_from_world())


def with_cameras_of(
    control: "pycolmap.Reconstruction", found: "pycolmap.Reconstruction", part: Part
) -> "pycolmap.Reconstruction":
    """Returns a copy of a model with the adjusted part of the cameras of another one."""
    model = copy.deepcopy(control)
    _place(model, found, part.photos)
    for number in part.lenses:
        model.cameras[number].params = list(found.cameras[number].params)
    return model


def error_of(control: "pycolmap.Reconstruction") -> float:
    """Returns the median reprojection error of tracks, each with its best point for the cameras, pixels."""
    model = copy.deepcopy(control)
    _solve(model, Part(frozenset(), frozenset()))
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


def move_back(model: "pycolmap.Reconstruction", given: "pycolmap.Reconstruction", part: Part) -> None:
    """Moves, turns and scales a model so that its cameras are, on average, where they were given.

    Images that were not adjusted get exactly their given poses.
    """
    import pycolmap

    numbers = sorted(part.photos)
    ours, theirs = (
        np.array([m.images[n].cam_from_world().matrix() for n in numbers]).reshape(-1, 3, 4)
        for m in (model, given)
    )
    scale, rotation, translation = similarity_of_cameras(ours, theirs)
    model.transform(pycolmap.Sim3d(scale, pycolmap.Rotation3d(rotation), translation))
    _place(model, given, set(model.images) - part.photos)


def motion(given: "pycolmap.Reconstruction", found: "pycolmap.Reconstruction", part: Part) -> float:
    """Returns the median distance by which points move in the photos that observe them, pixels."""
    apart = []
    for number in sorted(part.photos):
        image = given.images[number]
        points = [given.point3D(p.point3D_id).xyz for p in image.get_observation_points2D()]
        for point in points:
            here, there = image.project_point(point), found.images[number].project_point(point)
            if here is not None and there is not None:
                apart.append(np.linalg.norm(here - there))
    return float(np.median(apart)) if apart else 0.0
