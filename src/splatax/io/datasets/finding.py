"""Finds the photos that a file of poses names, which other programs do in many ways."""

from functools import cached_property
from pathlib import Path, PurePosixPath

from splatax.errors import DatasetError, shown
from splatax.io import images
from splatax.io.datasets import names

FOLDERS = ("", "images", "photos")


class Photos:
    """The photos in the folder of a capture."""

    def __init__(self, capture: Path):
        self.capture = capture

    @cached_property
    def by_name(self) -> dict[str, list[Path]]:
        """All photos of the capture, by their names and by their names without suffix."""
        found: dict[str, list[Path]] = {}
        for path in sorted(self.capture.rglob("*")):
            if images.is_image(path) and path.is_file():
                for key in (path.name, path.stem):
                    found.setdefault(key, []).append(path)
        return found

    def path_of(self, name: str, where: object) -> Path:
        """Returns the path of a photo, which may be missing.

        The photo is looked for where the name says, then in images/ and photos/. If it is in neither, it is
        the only photo of that name in the capture. The name may lack its suffix.

        Args:
            name: name in the file.
            where: the file, for messages.

        Raises:
            DatasetError: if the name is not valid, or several photos have it.
        """
        name = names.checked(name, where)
        for folder in FOLDERS:
            if (path := self.capture / folder / name).is_file():
                return path
        found = self.by_name.get(PurePosixPath(name).name, [])
        if len(found) > 1:
            raise DatasetError(
                f"{where}: {shown(name)} may be {len(found)} photos, such as "
                f"{found[0].relative_to(self.capture)} and {found[1].relative_to(self.capture)}. Put the "
                "photos where the file says."
            )
        return found[0] if found else self.capture / FOLDERS[1] / name
