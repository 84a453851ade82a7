"""Turns a capture of any format into a data set of views."""

import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from splatax.dataset import Dataset, PointCloud, View, photos_in
from splatax.errors import DatasetError
from splatax.io.datasets import depths, masks, motions, photos, truth
from splatax.io.datasets.capture import Capture, Frame
from splatax.io.datasets.undistortion import is_pinhole

FAR = 1000  # times the size of the set of cameras: farther from the origin, float32 loses detail


def dataset_of(capture: Capture, downscale: int | None, undistort: bool) -> Dataset:
    """Returns the data set of a capture; see `load_dataset`.

    All views are for training unless the capture's own files define held-out ones.

    Raises:
        DatasetError: if no photo is there, a photo or a camera cannot be used, or all photos are held out.
    """
    present, missing = parted_by_presence(capture)
    moved: tuple[str, ...] = ()
    if capture.errors is None:  # those of COLMAP's points are measured in its own world
        capture, present, moved = near_origin(capture, present)
    folder = capture.photos or Path(os.path.commonpath([frame.path.parent for frame in present]))
    named = names_of(capture, present, folder)
    beside = {} if any(frame.mask for frame in present) else masks.masks_of(capture.home, named)
    sources = sources_of(capture, named, beside)
    factor = photos.shrink_factor(sources, capture.already, downscale)
    views = views_of(capture, sources, named, factor, undistort)
    bent = {s.name for s in sources if not is_pinhole(s.camera) and (undistort or not s.known)}
    views, known = with_truth(capture, views, bent)
    views, exposed = motions.moving(views, motions.read(capture.home), bent)
    train, test = (tuple(views), ()) if capture.held_out is None else parted(capture, views, named)
    points, measured = points_of(capture, sources, named)
    unused = photos.unused(folder, [source.path for source in sources]) if folder != capture.home else ()
    errors = capture.errors({view.name: view.camera for view in views}) if capture.errors else {}
    notes = (
        *capture.notes,
        f"{photos_in(views)} of {photos_in(views) + len(unused)} photos registered",
        *faces(views),
        *absent(missing, len(capture.frames)),
        f"{f'{len(points):,}' if len(points) else 'no'} points; photos {photos.sizes_of(views)} "
        f"from {folder.name}/{photos.scaling(factor)}",
        *measured,
        *known,
        *exposed,
        *moved,
        *photos.limited(sources),
        *resampled(sources, undistort),
        *masked(sources, beside=bool(beside)),
        *reprojected(errors),
    )
    survey = photos.survey(sources, unused, errors)
    split = "" if capture.held_out is None else "as the capture's own files define"
    return Dataset(train, test, points, notes, capture.background, survey, split)


def sources_of(
    capture: Capture, named: Mapping[str, Frame], beside: Mapping[str, Path]
) -> list[photos.Source]:
    """Returns the photos with their cameras and masks, sorted by name.

    Args:
        capture: the capture.
        named: frames by the names of their photos.
        beside: files of masks by the names of the photos, if the frames name none.
    """
    return [
        photos.source_of(
            name,
            frame.path,
            frame.lens(frame.path),
            frame.cam_from_world,
            capture.home,
            frame.mask or beside.get(name),
            frame.parallel,
        )
        for name, frame in sorted(named.items())
    ]


def views_of(
    capture: Capture,
    sources: Iterable[photos.Source],
    named: Mapping[str, Frame],
    factor: float,
    undistort: bool,
) -> list[View]:
    """Returns the views of photos that are shrunk by a factor, with the surface points that each sees."""
    return [
        replace(
            source.view(factor, undistort),
            landmarks=landmarks_of(source, named[source.name], capture.home),
            face_of=named[source.name].face_of,
        )
        for source in sources
    ]


def points_of(
    capture: Capture, sources: list[photos.Source], named: Mapping[str, Frame]
) -> tuple[PointCloud, tuple[str, ...]]:
    """Returns the points of a capture, or those of its depth maps if it has none, and notes about these."""
    if len(capture.points):
        return capture.points, ()
    maps = {name: frame.depth for name, frame in named.items() if frame.depth}
    return depths.points_of(sources, maps, capture.home)


def masked(sources: list[photos.Source], *, beside: bool) -> list[str]:
    """Returns a list with a note about masks, some of a folder beside the photos, or an empty list."""
    count = sum(source.mask is not None for source in sources)
    where = f", from {masks.FOLDER}/" if beside else ""
    return [f"masks for {count} of {len(sources)} photos{where}"] if count else []


def reprojected(errors: Mapping[str, Float[np.ndarray, " n"]]) -> list[str]:
    """Returns a list with a note about the reprojection errors of the views, or an empty list."""
    if not errors:
        return []
    every = np.concatenate(list(errors.values()))
    return [f"median reprojection error {np.median(every):.2f} px ({len(every):,} observations)"]


def faces(views: list[View]) -> list[str]:
    """Returns a list with a note about 360-degree photos that are in faces, or an empty list."""
    each = [view for view in views if view.face_of]
    return [f"{photos.counted(photos_in(each))} of 360 degrees, in {len(each)} faces"] if each else []


def landmarks_of(
    source: photos.Source, frame: Frame, home: Path
) -> Callable[[], Float[np.ndarray, "_ 3"]] | None:
    """Returns the function that reads the known surface points of a photo; None if none are known."""
    if frame.depth and frame.depth.path.is_file():
        return partial(depths.landmarks_in, source, frame.depth, home)
    return frame.landmarks


def resampled(sources: list[photos.Source], undistort: bool) -> list[str]:
    """Returns a list with a note about photos with other lenses than a pinhole, or an empty list."""
    bent = [source for source in sources if not is_pinhole(source.camera)]
    resampled = [source for source in bent if undistort or not source.known]
    kinds = sorted({source.camera.model.name for source in resampled or bent})
    if resampled:
        return [f"{photos.counted(len(resampled))} undistorted ({', '.join(kinds)})"]
    return [f"photos as they are, through their lenses ({', '.join(kinds)})"] if bent else []


def parted_by_presence(capture: Capture) -> tuple[list[Frame], list[Frame]]:
    """Returns the frames whose photo is on the disk, and the others.

    Raises:
        DatasetError: if there is no photo at all.
    """
    present: list[Frame] = []
    missing: list[Frame] = []
    for frame in capture.frames:
        (present if os.path.isfile(frame.path) else missing).append(frame)
    if not capture.frames:
        raise DatasetError(f"{capture.source}: no photo in it has a pose. Export the capture again.")
    if not present:
        raise DatasetError(
            f"{capture.source}: none of its {len(missing)} photos is there; the first should be "
            f"{missing[0].path}. Put them where the file says."
        )
    return present, missing


def with_truth(capture: Capture, views: list[View], bent: set[str]) -> tuple[list[View], tuple[str, ...]]:
    """Returns views with their true geometry, and a note if there is any.

    Undistorted photos, whose names are in `bent`, have none: its pixels are those of the photo as it is.

    Raises:
        DatasetError: if there is true geometry, but of no photo.
    """
    found = truth.truths_of(capture.home, [view.name for view in views])
    usable = {name: files for name, files in found.items() if name not in bent}
    notes = [f"true depth of {photos.counted(len(usable))}, for evaluation"] if usable else []
    if unusable := len(found) - len(usable):
        notes.append(f"true depth of {photos.counted(unusable)} is not used, because they are undistorted")
    known = [replace(v, truth=usable[v.name].read) if v.name in usable else v for v in views]
    return known, tuple(notes)


def absent(missing: list[Frame], total: int) -> Iterable[str]:
    """Returns a line about the frames without a photo, if there are any."""
    names = photos.listed(frame.name for frame in missing)
    return [f"{len(missing)} of {total} frames have no photo: {names}"] if missing else []


def names_of(capture: Capture, present: list[Frame], folder: Path) -> dict[str, Frame]:
    """Returns the frames by the names of their views.

    Raises:
        DatasetError: if two frames have one photo.
    """
    named: dict[str, Frame] = {}
    for frame in present:
        name = frame.name if capture.photos else frame.path.relative_to(folder).as_posix()
        if name in named:
            raise DatasetError(f"{capture.source}: {name} is the photo of two frames. Remove one of them.")
        named[name] = frame
    return named


def parted(
    capture: Capture, views: list[View], named: dict[str, Frame]
) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Returns (train, test) views, as the capture's split defines them.

    Raises:
        DatasetError: if no view is left to train on.
    """
    tested = capture.held_out or set()
    test = tuple(view for view in views if named[view.name].name in tested)
    train = tuple(view for view in views if named[view.name].name not in tested)
    if not train:
        raise DatasetError(
            f"{capture.source}: all photos that are there are held out. Put those to train on beside it."
        )
    return train, test


def near_origin(capture: Capture, present: list[Frame]) -> tuple[Capture, list[Frame], tuple[str, ...]]:
    """Moves a capture in geographic coordinates near the origin, because scenes are in single precision.

    Returns:
        The capture, its frames with photos, and a note that states the shift, if there is one.
    """
    poses = np.stack([frame.cam_from_world for frame in present])
    if not np.isfinite(poses).all():
        return capture, present, ()  # refused later, with the photo's name
    eyes = -np.einsum("nji,nj->ni", poses[:, :, :3], poses[:, :, 3])
    middle = np.median(eyes, axis=0)
    spread = np.abs(eyes - middle).max()
    if not 0 < FAR * spread < np.abs(middle).max():
        return capture, present, ()
    digits = max(0, 1 - int(np.floor(np.log10(spread))))
    shift = np.round(middle, digits)
    moved = [
        replace(frame, cam_from_world=np.column_stack([pose[:, :3], -pose[:, :3] @ (eye - shift)]))
        for frame, pose, eye in zip(present, poses, eyes, strict=True)
    ]
    positions = capture.points.positions.astype(np.float64) - shift
    capture = replace(capture, points=PointCloud(positions.astype(np.float32), capture.points.colors))
    by = " ".join(f"{-number:.{digits}f}" for number in shift)
    return (
        capture,
        moved,
        (f"moved by {by}, because the cameras are far from the origin",),
    )
