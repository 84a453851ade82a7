"""Reads masks beside the photos of a capture, as COLMAP and nerfstudio use them: black pixels are ignored.

CAPTURE/masks/NAME.jpg.png  or  CAPTURE/masks/NAME.png     for the photo NAME.jpg
"""

from collections.abc import Iterable
from pathlib import Path

from splatax.errors import DatasetError
from splatax.io import images

FOLDER = "masks"


def masks_of(capture: Path, names: Iterable[str]) -> dict[str, Path]:
    """Returns the mask of each photo that has one.

    Raises:
        DatasetError: if there are masks, but none has the name of a photo.
    """
    folder = capture / FOLDER
    masks = {}
    for name in names:
        candidates = (folder / f"{name}.png", (folder / name).with_suffix(".png"))
        if found := [path for path in candidates if path.is_file()]:
            masks[name] = found[0]
    if not masks and any(images.is_image(path) for path in folder.rglob("*")):
        raise DatasetError(
            f"{folder}: no mask has the name of a registered photo: NAME.png or "
            "NAME.jpg.png for NAME.jpg. Rename them, or move the folder away to train without masks."
        )
    return masks


def check_proportions(path: Path, photo: tuple[int, int]) -> None:
    """Checks that a mask has the proportions of its photo, whose width and height are given.

    Raises:
        DatasetError: if they differ.
    """
    (width, height), (photo_width, photo_height) = images.size_of(path, what="mask"), photo
    rounding = 1.5 * max(width / photo_width, 1)  # pixels by which a resized side may differ
    if abs(width * photo_height / photo_width - height) > rounding:
        raise DatasetError(
            f"{path}: {width} x {height} pixels, but its photo {photo_width} x {photo_height}: other "
            "proportions. Make the mask from that photo, turned the same way."
        )
