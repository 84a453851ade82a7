"""The rule for file names inside a capture, which all loaders share.

A name is a path below the capture's folder: relative, without "..", without a drive, and without control
characters. Names become paths of photos to read and of pictures to write, and text on terminals and web
pages. The rule keeps paths inside their folders and text harmless.

Links are followed, and their targets are checked: the file must lie in the capture's folder, or in the
folder of photos, which may itself be a link to another place. A photo that is a link to a file outside
both folders is refused.
"""

from pathlib import Path, PurePosixPath, PureWindowsPath

from splatax.errors import DatasetError, is_shown, shown

LONGEST_PART = 255  # bytes of each part of a name, the limit of file systems
LONGEST = 1024  # bytes of a whole name


def checked(name: str, where: object) -> str:
    """Checks a name, and returns it with forward slashes and without superfluous dots.

    Args:
        name: name in the capture. Backslashes separate folders, as on Windows.
        where: file that contains the name, for the message.

    Raises:
        DatasetError: if the name is empty, leads out of the capture's folder, or is not valid for a file.
    """
    slashed = name.replace("\\", "/")
    if _plain(slashed):  # true for nearly all names, which skip the slower checks
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
    """Checks that a file of a capture lies there after all links are followed, and returns its path.

    Args:
        path: path below the capture's folder, whose name is `checked`.
        capture: folder of the capture. It may be a link, and so may the folder of photos directly in it.

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
    """Returns whether a name has characters that terminals interpret instead of showing."""
    return not name.isprintable() and not all(is_shown(character) for character in name)


def _plain(name: str) -> bool:
    """Returns whether a name obviously follows the rule. The test is fast, and true for most names."""
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
