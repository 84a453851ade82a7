"""The one rule for names of files that a capture brings along, whichever loader reads them.

A name is that of a file below the capture's folder: relative, without "..", without a drive, and without
control characters. Names become paths of photos to read and of pictures to write, and lines on terminals
and web pages, so this rule is what keeps all of them where they belong.

Links are followed, and where they end counts: the file must lie in the capture's folder, or in the folder
of photos, which may be a link to somewhere else. A photo that is itself a link to a file outside both is
refused.
"""

from pathlib import Path, PurePosixPath, PureWindowsPath

from splatax.errors import DatasetError, is_shown, shown

LONGEST_PART = 255  # bytes, of each part of a name: what file systems allow
LONGEST = 1024  # bytes, of a whole name


def checked(name: str, where: object) -> str:
    """Returns a name with forward slashes and without superfluous dots, if it follows the rule.

    Args:
        name: as the capture has it. Backslashes separate folders, as on Windows.
        where: the file that has the name, for the message.

    Raises:
        DatasetError: if the name is empty, leads out of the capture's folder, or cannot be that of a file.
    """
    slashed = name.replace("\\", "/")
    if _plain(slashed):  # nearly all names: a fast way past the slower checks
        return slashed
    windows = PureWindowsPath(name)
    parts = PurePosixPath(slashed).parts
    if windows.drive or windows.root or slashed.startswith("/") or ".." in parts:
        raise DatasetError(
            f"{where}: {shown(name)} leads out of the capture's folder. Move the photos into it, and name "
            "them relative to it."
        )
    if not parts:
        raise DatasetError(f"{where}: {shown(repr(name))} is not the name of a file. Correct the name.")
    if has_control_characters(name):
        raise DatasetError(
            f"{where}: the name {shown(name)} has control characters. Rename the file, and its mention."
        )
    if len(name.encode()) > LONGEST or any(len(part.encode()) > LONGEST_PART for part in parts):
        raise DatasetError(f"{where}: the name {shown(name)} is longer than that of any file. Shorten it.")
    return "/".join(parts)


def confined(path: Path, capture: Path) -> Path:
    """Returns the path of a file of a capture, if it lies there with all links followed.

    Args:
        path: below the capture's folder, by a name that is `checked`.
        capture: the folder. It may be a link, and so may the folder of photos right in it.

    Raises:
        DatasetError: if a link leads elsewhere.
    """
    within = path.relative_to(capture).parts
    homes = [capture] if len(within) == 1 else [capture, capture / within[0]]
    target = path.resolve()
    if not any(target.is_relative_to(home.resolve()) for home in homes):
        raise DatasetError(
            f"{path}: a link to a file outside of the capture, {shown(str(target))}. Replace the link by the "
            "file itself (cp --dereference)."
        )
    return path


def has_control_characters(name: str) -> bool:
    """Returns whether a name has characters that terminals and text files obey instead of showing."""
    return not name.isprintable() and not all(is_shown(character) for character in name)


def _plain(name: str) -> bool:
    """Returns whether a name follows the rule at first sight; most do."""
    return (
        name.isascii()
        and name.isprintable()
        and 0 < len(name) <= LONGEST_PART
        and ".." not in name
        and "./" not in name
        and "//" not in name
        and ":" not in name
        and name[0] != "/"
        and name[-1] not in "./"
    )
