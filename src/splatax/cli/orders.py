"""The input and the output folder of `splatax create`: results of another input are never reused."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from splatax.cli.options import flag
from splatax.cli.reconstruct import FindingCameras
from splatax.dataset import Dataset
from splatax.errors import InputError

FINDING = {field.name for field in fields(FindingCameras)}  # options that decide the cameras


@dataclass(frozen=True)
class Order:
    """The input of an output folder of `create`.

    Attributes:
        photos: absolute path of the photos, video or capture.
        options: the given options that decide the result, as JSON values by name; times in seconds.
    """

    photos: str
    options: dict


def refuse_other_options(out: Path, earlier: Order, now: Order, photos: Path, capture: Path) -> None:
    """Raises InputError if the results in a folder were made with other options.

    Args:
        out: the folder.
        earlier: order of the results.
        now: order that is given.
        photos: path of the photos, video or capture.
        capture: path of the capture that is trained on.
    """
    names = [name for name in {**earlier.options, **now.options} if not same(name, earlier, now)]
    if not names:
        return
    name = next((name for name in names if name in FINDING), names[0])
    then, asked = (named(name, order.options.get(name)) for order in (earlier, now))
    elsewhere = f"Train with the same cameras in another folder: splatax create {capture} --out OTHER"
    if name in FINDING and capture != photos:
        elsewhere = f"Find the cameras again in another folder: splatax create {photos} --out OTHER"
    raise InputError(f"{out}: made {then}, not {asked}. {elsewhere}, or replace it: --overwrite.")


def same(name: str, one: Order, other: Order) -> bool:
    """Returns whether an option is the same in two orders."""
    return bool(one.options.get(name) == other.options.get(name))


def named(name: str, value: Any) -> str:
    """Returns an option as part of a sentence: "with --budget 1:00 min", "without --recipe"."""
    return f"without {flag(name)}" if value is None else f"with {flag(name)} {value}"


def refuse_place_of_capture(out: Path, capture: Path, dataset: Dataset) -> None:
    """Raises InputError if results would lie beside the files of a capture, or among its photos.

    Args:
        out: folder for the results.
        capture: folder of the capture.
        dataset: the capture.
    """
    place, root = out.resolve(), capture.resolve()
    if place == root:
        raise InputError(f"{out}: the folder of the capture itself. Choose another --out.")
    for folder in {path.parent.resolve() for path in dataset.survey.files.values()} - {root}:
        if place.is_relative_to(folder) or folder.is_relative_to(place):
            raise InputError(f"{out}: lies among the photos of {capture}. Choose another --out.")
