"""Label images: pictures whose grey levels or palette entries are whole numbers, such as masks of instances.

FOLDER/NAME.png or FOLDER/NAME.jpg.png for the photo NAME.jpg      label of each pixel
FOLDER/labels.txt                                                  names, a line for each label from 0
"""

from pathlib import Path

import numpy as np
from jaxtyping import Int

from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.files import path_inside

NAMES = "labels.txt"
SILENT = 255  # of 8-bit pictures: pixels that say nothing, as in Pascal VOC and Cityscapes
LONGEST = 1 << 16  # bytes of the list of names


def path_of(folder: Path, photo: str) -> Path | None:
    """Returns the label image of a photo in a folder; None if it has none.

    Raises:
        InputError: if the photo's name leads out of the folder.
    """
    whole = path_inside(folder, photo)
    candidates = (whole.with_name(f"{whole.name}.png"), whole.with_suffix(".png"))
    return next((path for path in candidates if path.is_file()), None)


def read(path: Path, width: int, height: int) -> Int[np.ndarray, "h w"]:
    """Returns the labels of a picture, -1 where it says nothing (255 of 8 bits), at a view's size.

    A picture of another size but the same proportions is sampled at the nearest pixel.

    Raises:
        DatasetError: if the picture is missing or damaged, has colours, or has other proportions.
    """
    with images.opened(path, "label image") as image:
        if image.mode not in ("1", "L", "P", "I") and not image.mode.startswith("I;16"):
            raise DatasetError(
                f"{path}: a picture of colours ({image.mode}). Labels are whole numbers: save it as one grey "
                "channel or a palette."
            )
        eight = image.mode in ("1", "L", "P")
        labels = np.array(image).astype(np.int32)
    if eight:
        labels = np.where(labels == SILENT, -1, labels)
    rows, columns = labels.shape
    if abs(columns * height / rows - width) > 1.5 * max(width / columns, 1):
        raise DatasetError(
            f"{path}: {columns} x {rows} pixels, but its photo {width} x {height}: other proportions. "
            "Make it from that photo, turned the same way."
        )
    y = np.minimum(((np.arange(height) + 0.5) * rows / height).astype(int), rows - 1)
    x = np.minimum(((np.arange(width) + 0.5) * columns / width).astype(int), columns - 1)
    return labels[y[:, None], x[None, :]]


def names_in(folder: Path, count: int) -> tuple[str, ...]:
    """Returns the names of the labels from 0: those of labels.txt, else "background", "label 1" and so on.

    Raises:
        DatasetError: if the list is not text, has fewer names than there are labels, or one twice.
    """
    path = folder / NAMES
    if not path.is_file():
        return ("background", *(f"label {i}" for i in range(1, count)))
    if path.stat().st_size > LONGEST:
        raise DatasetError(f"{path}: too long for a list of names. Give a name in each line.")
    try:
        names = tuple(line.strip() for line in path.read_text(encoding="utf-8").splitlines() if line.strip())
    except UnicodeDecodeError as error:
        raise DatasetError(f"{path}: not text in UTF-8. Save it as such.") from error
    if len(names) < count:
        raise DatasetError(
            f"{path}: {len(names)} names, but the label images have labels up to {count - 1}. Add a line for "
            "each label, from 0."
        )
    if repeated := [name for name in names if names.count(name) > 1]:
        raise DatasetError(f"{path}: the name {shown(repeated[0])} occurs twice. Give each label its own.")
    return names
