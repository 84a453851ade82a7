"""Records of a capture in memory: views with their cameras, and points. Nothing here reads files."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np
from jaxtyping import Bool, Float, UInt8

from splatax.cameras import Camera, rig
from splatax.errors import DatasetError, InputError
from splatax.gaussians import Gaussians, joined
from splatax.splits import Every, HoldOut, Listed

Pixels = UInt8[np.ndarray, "_ _ 3"] | UInt8[np.ndarray, "_ _ 4"]
Mask = Bool[np.ndarray, "_ _"]
Value = TypeVar("Value")


@dataclass(frozen=True)
class TrueGeometry:
    """True surfaces that a view sees, to evaluate a scene with; nothing is trained on them.

    The maps have the proportions of the photo, and may have another size.

    Attributes:
        depth: by the camera's lens, world units; 0 where it is unknown or there is no surface.
        normals: unit normals in the world, towards the camera; 0 where they are unknown. None if they are
            unknown everywhere.
    """

    depth: Float[np.ndarray, "_ _"]
    normals: Float[np.ndarray, "_ _ 3"] | None = None


@dataclass(frozen=True)
class Edited:
    """Decodes a photo and changes its pixels.

    Attributes:
        decode: function that decodes the photo.
        change: function from the decoded pixels to new ones of the same size.
        identity: key of the change; equal changes have equal keys.
        kept: function that reads the changed photo from where it is kept; None if it is made at each call.
    """

    decode: Callable[[], Pixels]
    change: Callable[[Pixels], Pixels]
    identity: str
    kept: Callable[[], Pixels] | None = None

    def __call__(self) -> Pixels:
        """Returns the changed photo."""
        return self.kept() if self.kept else self.change(self.decode())


@dataclass(frozen=True)
class View:
    """Photo and its camera.

    Attributes:
        name: name of the photo, unique in its data set.
        camera: camera of the same size as the photo.
        pixels: function that decodes the photo to 8-bit RGB, or RGBA with straight alpha.
        mask: function that decodes the mask, true where a pixel counts in training and evaluation; None if
            all pixels count.
        landmarks: function that returns world points on the surfaces that the photo shows, such as those of
            structure from motion or of a depth map; None if none are known.
        truth: function that returns the true geometry; None if it is not known.
        face_of: name of the 360-degree photo that the view is a face of; None for a photo by itself.
    """

    name: str
    camera: Camera
    pixels: Callable[[], Pixels] = field(repr=False)
    mask: Callable[[], Mask] | None = field(default=None, repr=False)
    landmarks: Callable[[], Float[np.ndarray, "_ 3"]] | None = field(default=None, repr=False)
    truth: Callable[[], TrueGeometry] | None = field(default=None, repr=False)
    face_of: str | None = None

    @property
    def photo(self) -> str:
        """Name of the photo, which all faces of a 360-degree photo share."""
        return self.face_of or self.name

    def as_taken(self) -> "View":
        """Returns the view with its photo as it was before any change of its pixels."""
        pixels = self.pixels
        return replace(self, pixels=pixels.decode) if isinstance(pixels, Edited) else self


def by_photo(views: Iterable[View], values: Mapping[str, Value]) -> dict[str, list[Value]]:
    """Returns the values of each photo by its name: several for a photo in faces.

    Args:
        views: views in the order of the result.
        values: by the names of views; views without one are passed over.
    """
    found: dict[str, list[Value]] = {}
    for view in views:
        if view.name in values:
            found.setdefault(view.photo, []).append(values[view.name])
    return found


def photos_in(views: Iterable[View]) -> int:
    """Returns the number of photos that views show; the faces of a 360-degree photo are one."""
    return len({view.photo for view in views})


def mask_of(view: View) -> Mask | None:
    """Returns the mask of a view, true where a pixel counts; None if all pixels count.

    Raises:
        DatasetError: if the sizes of mask and camera differ, or no pixel counts.
    """
    if view.mask is None:
        return None
    mask = view.mask()
    height, width = mask.shape
    if (width, height) != (view.camera.width, view.camera.height):
        expected = f"{view.camera.width} x {view.camera.height}"
        raise DatasetError(f"{view.name}: its mask has {width} x {height} pixels, its camera {expected}.")
    if not mask.any():
        raise DatasetError(
            f"{view.name}: its mask is entirely black, so no pixel of the photo counts. Repair the mask; or "
            "delete it, and start a new run."
        )
    return mask


@dataclass(frozen=True)
class PointCloud:
    """Points on surfaces, in world units, with colours in [0, 1]."""

    positions: Float[np.ndarray, "n 3"]
    colors: Float[np.ndarray, "n 3"]

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class Survey:
    """Measurements of a loader beyond the views, for inspection of a capture. All may be empty.

    Attributes:
        files: path of each view's photo, by the view's name.
        lenses: calibrated camera of each photo in words, by the view's name.
        unused: names of photos in the folder that have no pose.
        errors: reprojection errors of a sample of observations, pixels of the view, by the view's name.
    """

    files: dict[str, Path] = field(default_factory=dict)
    lenses: dict[str, str] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    errors: dict[str, Float[np.ndarray, " _"]] = field(default_factory=dict)


@dataclass(frozen=True)
class Block:
    """Part of a scene that is trained in its own run, among fixed Gaussians; see `splatax.blocks`.

    Attributes:
        start: Gaussians from which its training starts.
        context: Gaussians around it, which are drawn with it in every view and do not change.
        fraction: part of the whole scene's Gaussians that the block has, for means over all.
        extent: size of the whole scene, world units; None for that of the block's views.
    """

    start: Gaussians
    context: Gaussians
    fraction: float = 1.0
    extent: float | None = None


@dataclass(frozen=True, repr=False)
class Dataset:
    """Capture for training and evaluation.

    Attributes:
        train: training views.
        test: held-out views; may be empty.
        points: points from structure from motion; may be empty.
        notes: lines of text about the capture, for people to read.
        background: background for photos with alpha; None if the capture does not define it.
        survey: measurements of the loader beyond the views.
        split: how the test views were chosen, in words; empty for the default rule.
        block: the part of the scene that is trained; None for all of it.
    """

    train: tuple[View, ...]
    test: tuple[View, ...]
    points: PointCloud
    notes: tuple[str, ...] = ()
    background: Literal["white"] | None = None
    survey: Survey = field(default_factory=Survey)
    split: str = ""
    block: Block | None = None

    def __repr__(self) -> str:
        """Returns the numbers of views and points; a notebook shows it."""
        train, test, points = len(self.train), len(self.test), len(self.points)
        return f"Dataset({train:,} training views, {test:,} held-out views, {points:,} points)"

    @cached_property
    def views(self) -> tuple[View, ...]:
        """All views, sorted by name."""
        return tuple(sorted(self.train + self.test, key=lambda view: view.name))

    @cached_property
    def standpoints(self) -> tuple[View, ...]:
        """One view of each photo, sorted by name: the first of the faces of a 360-degree photo."""
        return tuple({view.photo: view for view in reversed(self.views)}.values())[::-1]

    @cached_property
    def extent(self) -> float:
        """Size of the scene, world units; see `cameras.rig.extent_of` of the training cameras.

        It is computed once: it takes 0.1 ms per camera. A block has that of the whole scene.
        """
        if self.block and self.block.extent is not None:
            return self.block.extent
        return rig.extent_of([view.camera for view in self.train], self.points.positions)

    def in_context(self, gaussians: Gaussians) -> Gaussians:
        """Returns a scene that was trained on the capture as the photos show it.

        It is the scene itself. If it is a block, the context of the block follows in further rows.
        """
        if self.block is None:
            return gaussians
        drawn_alike = replace(self.block.context, low_pass=gaussians.low_pass, order=gaussians.order)
        return joined([gaussians, drawn_alike])


def hold_out(views: Sequence[View], rule: HoldOut = Every()) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Splits views into (train, test), both sorted by name. Faces of a 360-degree photo stay together.

    Args:
        views: views in any order.
        rule: chooses the views to hold out.

    Raises:
        InputError: if the rule leaves no view to train on, or names a photo that is not there.
    """
    ordered = sorted(views, key=lambda view: view.name)
    tested = photos_by(rule, ordered)
    test = tuple(view for view in ordered if view.photo in tested)
    train = tuple(view for view in ordered if view.photo not in tested)
    if not train:
        raise InputError(
            f"Holding out {rule} leaves none of {photos_in(ordered)} photos to train on. Hold out fewer.",
            options=("hold_out",),
        )
    return train, test


def photos_by(rule: HoldOut, views: Sequence[View]) -> set[str]:
    """Returns the names of the photos that a rule chooses.

    Args:
        rule: the rule; a list may name a 360-degree photo or any of its faces.
        views: all views, sorted by name.

    Raises:
        InputError: if the rule names a photo that is not there.
    """
    photo_of = {view.name: view.photo for view in views}
    photos = list(dict.fromkeys(photo_of.values()))
    if isinstance(rule, Listed):
        return {photo_of.get(name, name) for name in rule.of(list(dict.fromkeys([*photos, *photo_of])))}
    return set(rule.of(photos))


def resplit(dataset: Dataset, rule: HoldOut) -> Dataset:
    """Returns a capture with other held-out views, chosen from all of its views.

    Raises:
        InputError: in the cases of `hold_out`.
    """
    train, test = hold_out(dataset.views, rule)
    return replace(dataset, train=train, test=test, split=str(rule))


def without(dataset: Dataset, names: Collection[str]) -> Dataset:
    """Returns a capture without some of its training photos, by their names.

    Raises:
        InputError: if none is left.
    """
    train = tuple(view for view in dataset.train if view.photo not in names)
    if not train:
        raise InputError("No photo is left to train on. Leave out fewer.", options=("leave_out",))
    return replace(dataset, train=train)
