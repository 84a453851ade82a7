"""A capture in memory: views with their cameras, and points. Records alone, no reading of files."""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, UInt8

from splatax.cameras import Camera, rig
from splatax.errors import DatasetError

Pixels = UInt8[np.ndarray, "_ _ 3"] | UInt8[np.ndarray, "_ _ 4"]
Mask = Bool[np.ndarray, "_ _"]


@dataclass(frozen=True)
class View:
    """A photo and the camera that took it.

    Attributes:
        name: of the photo, unique in its data set.
        camera: of the same size as the photo.
        pixels: decodes the photo: 8-bit RGB, or RGBA with straight alpha.
        mask: decodes which pixels count, for training and scores alike; None if all do.
    """

    name: str
    camera: Camera
    pixels: Callable[[], Pixels]
    mask: Callable[[], Mask] | None = None


def mask_of(view: View) -> Mask | None:
    """Which pixels of a view count; None if all do.

    Raises:
        DatasetError: if the mask is not of the camera's size, or no pixel counts.
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
            f"{view.name}: its mask is black all over, so nothing of the photo counts. Repair or delete the "
            "mask, or remove the photo from the capture."
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
    """What a loader saw beside the views, for those who judge a capture. All may be empty.

    Attributes:
        files: the photo of each view on disk, by the view's name.
        lenses: the camera of each as it was calibrated, in words.
        unused: photos that lie with the others but have no pose.
        errors: distances in pixels of the view between where points were seen and where they project.
    """

    files: dict[str, Path] = field(default_factory=dict)
    lenses: dict[str, str] = field(default_factory=dict)
    unused: tuple[str, ...] = ()
    errors: dict[str, Float[np.ndarray, " _"]] = field(default_factory=dict)


@dataclass(frozen=True)
class Dataset:
    """What a scene is trained on and judged by.

    Attributes:
        train: views to learn from.
        test: views held out; may be empty.
        points: from structure from motion; may be empty.
        notes: what the loader found, a line each, for people to read.
        background: that photos with alpha are to be seen over; None where the capture does not say.
        survey: what the loader saw beside the views.
    """

    train: tuple[View, ...]
    test: tuple[View, ...]
    points: PointCloud
    notes: tuple[str, ...] = ()
    background: Literal["white"] | None = None
    survey: Survey = field(default_factory=Survey)

    @property
    def views(self) -> tuple[View, ...]:
        """All views, by name."""
        return tuple(sorted(self.train + self.test, key=lambda view: view.name))

    @property
    def extent(self) -> float:
        """Size of the scene, world units; see `cameras.rig.extent_of` of the training cameras."""
        return rig.extent_of([view.camera for view in self.train], self.points.positions)


def hold_out(views: list[View], every: int = 8) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """(train, test): every 8th view by name, from the first, is for testing. A lone view is not."""
    ordered = sorted(views, key=lambda view: view.name)
    if len(ordered) < 2:
        return tuple(ordered), ()
    test = tuple(ordered[::every])
    return tuple(view for i, view in enumerate(ordered) if i % every), test
