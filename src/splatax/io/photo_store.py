"""Decoded photos and masks on disk, for captures whose photos do not fit in memory.

FOLDER/KEY.npy     one file for each photo or mask of a view, as NumPy writes it

Files are written whole or not at all and never changed, so processes may share the folder, be killed, and
remove files that others use. They leave a tenth of the disk free.
"""

import os
import shutil
import time
import warnings
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from splatax.dataset import Edited, View
from splatax.io.datasets.decoding import MaskDecoder, PhotoDecoder
from splatax.io.files import replacing

FREE = 0.1  # fraction of the disk that is left free
HEADER = 128  # bytes of a file before its pixels
ABANDONED = 3600.0  # seconds after which an unfinished file is one of a process that was killed


@dataclass(frozen=True)
class Use:
    """Part of a capture that is kept on disk.

    Attributes:
        kept: number of photos.
        photos: number of all photos.
        size: bytes of those that are kept, with their masks.
        folder: place of the files.
    """

    kept: int
    photos: int
    size: int
    folder: Path


@dataclass
class PhotoStore:
    """A folder of decoded photos and masks, shared by all threads of a process.

    Attributes:
        folder: place of the files.
        most: bytes that all files may take.
    """

    folder: Path
    most: int
    _writing: set[str] = field(default_factory=set)
    _lock: Any = field(default_factory=Lock)
    _full: bool = False

    def size(self) -> int:
        """Returns the bytes of all files."""
        return sum(size for _, size, _ in self._files())

    def clear(self) -> int:
        """Removes all files, and returns their number."""
        files = self._files()
        for _, _, path in files:
            remove(path)
        return len(files)

    def reserve(self, sizes: Mapping[str, int]) -> set[str]:
        """Makes room for arrays, and returns the keys of those that there is room for, in their order.

        Files of other captures are removed for them, those that were used longest ago first.

        Args:
            sizes: bytes of each array, by its key.
        """
        others = [file for file in self._files() if file[2].stem not in sizes]
        present = {path.stem: size for _, size, path in self._files() if path.stem in sizes}
        self.folder.mkdir(parents=True, exist_ok=True)
        disk = shutil.disk_usage(self.folder)
        taken = sum(present.values()) + sum(size for _, size, _ in others)
        most = min(self.most, taken + disk.free - round(FREE * disk.total))
        wanted = sum(sizes.values()) + HEADER * len(sizes)
        left = sum(size for _, size, _ in others)
        for _, size, path in sorted(others):
            if left + wanted <= most:
                break
            remove(path)
            left -= size
        kept, room = set[str](), most - left
        for key in sorted(sizes, key=lambda key: key not in present):  # stable: those present come first
            if sizes[key] + HEADER <= room:
                room -= sizes[key] + HEADER
                kept.add(key)
        return kept

    def get(self, key: str) -> np.ndarray | None:
        """Returns an array, mapped into memory; None if it is not there or its file is damaged."""
        path = self._path(key)
        try:
            found = np.load(path, mmap_mode="r", allow_pickle=False)
            os.utime(path)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, EOFError):  # NumPy raises the last for an empty file
            remove(path)
            return None
        return found

    def put(self, key: str, array: np.ndarray) -> None:
        """Writes an array, unless another thread does. A full disk ends all writing, with a warning."""
        with self._lock:
            if self._full or key in self._writing:
                return
            self._writing.add(key)
        try:
            disk = shutil.disk_usage(self.folder)
            if disk.free - array.nbytes < FREE * disk.total:
                raise OSError(None, "a tenth of the disk is left free")
            with replacing(self._path(key)) as file:
                np.save(file, np.ascontiguousarray(array), allow_pickle=False)
        except OSError as error:
            self._full = True
            warnings.warn(
                f"{self.folder}: no more decoded photos can be kept there ({error.strerror}); the others are "
                "decoded again for each step",
                stacklevel=1,
            )
        finally:
            with self._lock:
                self._writing.discard(key)

    def _path(self, key: str) -> Path:
        return self.folder / f"{key}.npy"

    def _files(self) -> list[tuple[float, int, Path]]:
        """Returns time of last use, bytes and path of each file. Removes those that were never finished."""
        found = []
        for path in self.folder.glob("*"):
            with suppress(OSError):  # another process may remove it
                stat = path.stat()
                if path.suffix == ".npy":
                    found.append((stat.st_mtime, stat.st_size, path))
                elif path.suffix == ".tmp" and time.time() - stat.st_mtime > ABANDONED:
                    remove(path)
        return found


@dataclass(frozen=True)
class Kept:
    """Returns an array from a store; makes and stores it if it is not there."""

    store: PhotoStore
    key: str
    make: Callable[[], np.ndarray]

    def __call__(self) -> Any:
        """Returns the array."""
        found = self.store.get(self.key)
        if found is None:
            found = self.make()
            self.store.put(self.key, found)
        return found


def kept_on_disk(views: tuple[View, ...], store: PhotoStore) -> tuple[tuple[View, ...], Use]:
    """Returns views whose photos and masks are decoded once and then read from disk, and what that takes.

    Photos that do not come from files, and those that there is no room for, stay as they are.
    """
    keys = [keys_of(view) for view in views]
    reserved = store.reserve({key: size for each in keys for key, size in each.items()})
    kept = [
        view_from(store, view, [*each]) if each and reserved.issuperset(each) else None
        for view, each in zip(views, keys, strict=True)
    ]
    size = sum(sum(each.values()) for each, view in zip(keys, kept, strict=True) if view)
    use = Use(sum(view is not None for view in kept), len(views), size, store.folder)
    return tuple(new or old for new, old in zip(kept, views, strict=True)), use


def keys_of(view: View) -> dict[str, int]:
    """Returns the keys of a view's photo and mask with their bytes; empty if they do not come from files."""
    decoder, mask = decoder_of(view), view.mask
    if not isinstance(decoder, PhotoDecoder) or not isinstance(mask, MaskDecoder | None):
        return {}
    area = view.camera.width * view.camera.height
    change = view.pixels.identity if isinstance(view.pixels, Edited) else ""
    opaque = decoder.stored.path.suffix.lower() in (".jpg", ".jpeg") and not change
    try:
        key = f"{decoder.identity}-{change}" if change else decoder.identity
        return {key: (3 if opaque else 4) * area} | ({mask.identity: area} if mask else {})  # at most
    except OSError:
        return {}  # reported when training reads the photo


def decoder_of(view: View) -> Callable[[], Any]:
    """Returns the decoder of a view's photo, without later changes of its pixels."""
    return view.as_taken().pixels


def view_from(store: PhotoStore, view: View, keys: list[str]) -> View:
    """Returns a view that reads its photo, and its mask if it has one, from a store.

    A photo whose pixels are changed is stored as changed.
    """
    photo = Kept(store, keys[0], view.pixels)
    pixels = replace(view.pixels, kept=photo) if isinstance(view.pixels, Edited) else photo
    return replace(view, pixels=pixels, mask=Kept(store, keys[1], view.mask) if view.mask else None)


def remove(path: Path) -> None:
    """Removes a file, unless it no longer exists, or is in use on a system that does not allow this."""
    with suppress(OSError):
        path.unlink()
