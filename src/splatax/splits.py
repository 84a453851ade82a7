"""Rules for the photos to hold out from training, so that scenes are scored on photos they never saw."""

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from splatax.errors import InputError, shown

STRIDE = 8  # of the default: the stride of the literature


@dataclass(frozen=True)
class Every:
    """Holds out every photo at a fixed stride.

    Attributes:
        stride: distance of held-out photos in the order of names.
        first: number of the first held-out photo, counted from 1. None starts in the middle of the stride
            and never holds out the first or the last photo, because nothing shows what lies beyond them.
    """

    stride: int = STRIDE
    first: int | None = None

    def of(self, names: Sequence[str]) -> tuple[str, ...]:
        """Returns the photos to hold out, from all names in order."""
        if self.first is not None:
            return tuple(names[self.first - 1 :: self.stride])
        return tuple(names[max(self.stride // 2, 1) : -1 : self.stride])

    def __str__(self) -> str:
        from_ = self.first or max(self.stride // 2, 1) + 1
        between = "" if self.first else ", but not the last"
        return f"every {ordinal(self.stride)} photo by sorted name, from the {ordinal(from_)}{between}"


@dataclass(frozen=True)
class Last:
    """Holds out the last photos by name, such as the end of a path."""

    count: int = 1

    def of(self, names: Sequence[str]) -> tuple[str, ...]:
        """Returns the photos to hold out, from all names in order."""
        return tuple(names[-self.count :])

    def __str__(self) -> str:
        return "the last photo by name" if self.count == 1 else f"the last {self.count} photos by name"


@dataclass(frozen=True)
class Listed:
    """Holds out the photos of a list.

    Attributes:
        names: names of photos, with or without their suffix.
        source: origin of the list, for messages.
    """

    names: tuple[str, ...]
    source: str = "the list"

    def of(self, names: Sequence[str]) -> tuple[str, ...]:
        """Returns the photos to hold out, from all names in order.

        Raises:
            InputError: if the list names a photo that is not there.
        """
        found = matched(self.names, names)
        if missing := [name for name in self.names if name not in found]:
            more = f" and {len(missing) - 1} more" if len(missing) > 1 else ""
            raise InputError(
                f"{self.source} names {shown(missing[0])}{more}, but the capture has no such photo with a "
                f"pose. Its photos are {shown(names[0])} to {shown(names[-1])}."
            )
        return tuple(dict.fromkeys(found.values()))

    def __str__(self) -> str:
        return f"the photos that {self.source} names"


@dataclass(frozen=True)
class Nothing:
    """Holds out no photo."""

    def of(self, names: Sequence[str]) -> tuple[str, ...]:
        """Returns no photos."""
        return ()

    def __str__(self) -> str:
        return "none"


HoldOut = Every | Last | Listed | Nothing
WANTED = '"every:N", "every:N:FIRST", "last", "last:N", "none", names of photos with commas, or a .txt file'


def parse_hold_out(text: str) -> HoldOut:
    """Returns the rule that a text stands for.

    Args:
        text: "every:N" (from the middle of the stride), "every:N:FIRST" (from a photo counted from 1),
            "last", "last:N", "none", names of photos separated by commas, or a .txt file with one name a
            line.

    Raises:
        ValueError: if a number is missing or too small.
        InputError: if the file cannot be read.
    """
    if text == "none":
        return Nothing()
    if text == "last":
        return Last()
    if match := re.fullmatch(r"last:([1-9]\d*)", text):
        return Last(int(match[1]))
    if (match := re.fullmatch(r"every:(\d+)(?::([1-9]\d*))?", text)) and int(match[1]) > 1:
        return Every(int(match[1]), int(match[2]) if match[2] else None)
    names = listed_in(text)
    if not names or text.startswith(("every:", "last:")):
        raise ValueError(f"{WANTED}, not {text!r}")
    return Listed(names, text if is_list(text) else "the list")


def is_list(text: str) -> bool:
    """Returns whether a text is the name of a file with a list of photos, not a list itself."""
    return "\n" not in text and text.lower().endswith(".txt")


def listed_in(text: str) -> tuple[str, ...]:
    """Returns the names of photos in a text: in lines if it has several, else separated by commas.

    A text that ends in .txt is the path of a file of lines, which is read.

    Raises:
        InputError: if the file cannot be read.
    """
    lines: Iterable[str]
    if is_list(text):
        try:
            lines = Path(text).read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            why = error.strerror if isinstance(error, OSError) else "it is not UTF-8 text"
            raise InputError(f"{text}: the list of photos cannot be read ({why}).") from error
    else:
        lines = text.splitlines() if "\n" in text else text.split(",")
    return tuple(name for line in lines if (name := line.strip()))


def matched(wanted: Iterable[str], names: Sequence[str]) -> dict[str, str]:
    """Returns the photo that each wanted name means, for those that mean exactly one.

    Args:
        wanted: names of photos, with or without their suffix.
        names: of all photos.
    """
    exact = set(names)
    stems: dict[str, list[str]] = {}
    for name in names:
        stems.setdefault(PurePosixPath(name).with_suffix("").as_posix(), []).append(name)
    found = {}
    for name in wanted:
        if name in exact:
            found[name] = name
        elif len(candidates := stems.get(name, [])) == 1:
            found[name] = candidates[0]
    return found


def ordinal(number: int) -> str:
    """Returns a number as an ordinal, such as "3rd"."""
    suffix = "th" if number % 100 in (11, 12, 13) else {1: "st", 2: "nd", 3: "rd"}.get(number % 10, "th")
    return f"{number}{suffix}"
