"""Bundle adjustment of given cameras over feature matches, before training.

The given cameras are the start. Every fifth track is held out: its error shows whether the adjusted cameras
agree with the photos better than the given ones. If not, the given ones are used.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from splatax.dataset import View
from splatax.packages import required_by
from splatax.reconstruction.adjusting import (
    adjust,
    adjust_to_patches,
    error_of,
    features_of,
    loosely_triangulated,
    motion,
    move_back,
    with_cameras_of,
    without_points,
)
from splatax.reconstruction.calibration import (
    DISTORTION,
    Correction,
    Free,
    adjustable,
    alike,
    corrected,
    correction_to,
)
from splatax.reconstruction.pipeline import Watch
from splatax.reconstruction.triangulation import matchable, matched

STAGES = ("reading", "features", "matches", "cameras")
ASIDE = 5  # every fifth track is kept aside
FEWEST_TRACKS = 100  # that are adjusted, and a fifth of them kept aside
BETTER = 0.97  # of the error of tracks kept aside, at most, for adjusted cameras to be taken
ROUNDS = 5  # of triangulation and adjustment of lenses, at most
MORE = 1.01  # factor on the number of observations, below which a round is the last


@dataclass(frozen=True)
class Adjustment:
    """Cameras after bundle adjustment, or the given ones where it did not help.

    Attributes:
        given: the views as they were given.
        views: the views with the cameras to use.
        lenses: corrections of lenses, by the names of views; empty if only poses were adjusted.
        before: median reprojection error of the held-out tracks with the given cameras, pixels.
        after: the same with the adjusted cameras.
        motion: median distance by which the tracks move in the photos from given to adjusted cameras, pixels.
        observations: number of matched features that the cameras were adjusted to; 0 if there are too few.
    """

    given: tuple[View, ...]
    views: tuple[View, ...]
    lenses: Mapping[str, Correction]
    before: float = 0.0
    after: float = 0.0
    motion: float = 0.0
    observations: int = 0

    @property
    def helps(self) -> bool:
        """True if the views have adjusted cameras."""
        return self.observations > 0 and self.after <= BETTER * self.before

    def lenses_of(self, others: Sequence[View]) -> dict[str, Correction]:
        """Returns the corrections for other views of the capture that were taken through the same lenses."""
        return alike(self.given, self.lenses, others)

    def __str__(self) -> str:
        if not self.observations:
            return (
                "given cameras kept: too few features match between the photos to adjust them, or COLMAP has "
                "no such lens"
            )
        errors = f"{self.before:.2f} to {self.after:.2f} px (median of points kept aside)"
        if not self.helps:
            return f"given cameras kept, as adjusting them does not help: reprojection error {errors}"
        return (
            f"cameras adjusted to {self.observations:,} matched features: reprojection error {errors}, "
            f"photos moved by {self.motion:.2f} px (median){self._lenses_in_words()}"
        )

    def _lenses_in_words(self) -> str:
        found = list(dict.fromkeys(self.lenses.values()))
        if not found:
            return ""
        if len(found) > 1:
            factors = [lens.focal[0] for lens in found]
            return f"; {len(found)} lenses, focal lengths times {min(factors):.4f} to {max(factors):.4f}"
        numbers = "".join(f" {number:.4g}" for number in found[0].coefficients)
        return f"; focal length times {found[0].focal[0]:.4f}, {found[0].model}{numbers}"


@required_by("splatax.reconstruction")
def adjusted_cameras(
    views: Sequence[View],
    free: Free = "poses",
    *,
    seed: int = 0,
    watch: Watch = lambda stage, done, total: None,
) -> Adjustment:
    """Adjusts the cameras of views to matched features, and keeps the given ones if that does not help.

    The coordinate system stays the same: the adjusted model is moved, turned and scaled so that its cameras
    are, on average, where the given ones are. Principal points stay as given. Pass training views only, so
    that held-out photos are not used.

    Args:
        views: views with cameras that are accurate to several pixels, apart from what is free.
        free: the parameters to adjust: "poses"; "poses+focal", also the focal lengths of each lens;
            "poses+distortion", also its distortion; or "poses+lens", all of these. A pinhole, or a lens of
            OpenCV's, gets k1 and k2, and p1 and p2 if they or the difference of its focal lengths are not
            zero.
        seed: random seed.
        watch: function that is called with the progress of each of `STAGES`.
    """
    nothing = Adjustment(tuple(views), tuple(views), {})
    if not matchable(views):
        return nothing
    with matched(views, seed, watch, partial(adjustable, free=free)) as (model, work):
        watch("cameras", 0, 1)
        given = copy.deepcopy(loosely_triangulated(model, work, seed))
        numbers = sorted(given.points3D)
        aside = set(numbers[::ASIDE])
        if len(numbers) - len(aside) < FEWEST_TRACKS:
            return nothing
        control, found = without_points(given, set(numbers) - aside), without_points(given, aside)
        hidden = {e for n in aside for e in features_of(given, n)}
        part = adjust(found, free, work)
        for _ in range(0 if free == "poses" else ROUNDS - 1):
            seen = found.compute_num_observations()
            move_back(found, given, part)
            more = loosely_triangulated(found, work, seed)
            found = without_points(more, {n for n in more.points3D if hidden & set(features_of(more, n))})
            part = adjust(found, free, work)
            if found.compute_num_observations() < MORE * seen:
                break
        if free in DISTORTION:
            adjust_to_patches(found, part, free, work)
        move_back(found, given, part)
        observations = found.compute_num_observations()
        before = error_of(control)
        after = error_of(with_cameras_of(control, found, part))
        moved_by = motion(given, found, part)
        outcome = Adjustment(tuple(views), tuple(views), {}, before, after, moved_by, observations)
        watch("cameras", 1, 1)
        if not outcome.helps:
            return outcome
        poses = {number: found.images[number].cam_from_world().matrix() for number in part.photos}
        lenses = {
            view.name: correction_to(given.cameras[lens], found.cameras[lens])
            for number, view in enumerate(views, start=1)
            if (lens := given.images[number].camera_id) in part.lenses
        }
    moved = tuple(
        _with_pose(view, poses[number]) if number in poses else view
        for number, view in enumerate(views, start=1)
    )
    return replace(outcome, views=corrected(moved, lenses), lenses=lenses)


def _with_pose(view: View, pose: Float[np.ndarray, "3 4"]) -> View:
    matrix = jnp.asarray(np.vstack([pose, [0, 0, 0, 1]]), view.camera.cam_from_world.dtype)
    return replace(view, camera=replace(view.camera, cam_from_world=matrix))
