"""A cache of decoded photos: it keeps as many as fit in a given memory and decodes the others again."""

from collections.abc import Sequence
from threading import Lock

from splatax.cameras import Camera
from splatax.dataset import Mask, Pixels, View, mask_of
from splatax.errors import DatasetError
from splatax.training.resolution import divided

Frame = tuple[Camera, Pixels, Mask | None]


class PhotoCache:
    """Decoded photos and masks, by the index of their view. Threads share it.

    Photos are requested in random order, so each is equally likely to be next. The cache therefore never
    replaces a photo that it keeps: the replaced one would only have to be decoded again.
    """

    def __init__(self, views: Sequence[View], room: int | float):
        """Creates an empty cache for so many bytes; `math.inf` keeps all photos."""
        self._views, self._left = views, room
        self._kept: dict[int, tuple[int, Frame]] = {}
        self._lock = Lock()

    def frame(self, index: int, divisor: int) -> Frame:
        """Returns a view whose width and height are divided by `divisor`.

        A photo that is kept at another size is dropped, which frees its memory.

        Raises:
            DatasetError: if the photo or its mask is not of the camera's size.
        """
        with self._lock:
            kept = self._kept.get(index)
            if kept and kept[0] == divisor:
                return kept[1]
            self._drop(index)
        view = self._views[index]
        frame = divided(view.camera, checked(view), mask_of(view), divisor)
        with self._lock:  # another thread may have read the view meanwhile
            if index not in self._kept and size_of(frame) <= self._left:
                self._kept[index] = divisor, frame
                self._left -= size_of(frame)
        return frame

    def _drop(self, index: int) -> None:
        if index in self._kept:
            self._left += size_of(self._kept.pop(index)[1])


def size_of(frame: Frame) -> int:
    """Returns the bytes of a photo and its mask."""
    return sum(array.nbytes for array in frame[1:] if array is not None)


def checked(view: View) -> Pixels:
    """Returns the photo of a view.

    Raises:
        DatasetError: if it is not of the camera's size.
    """
    pixels = view.pixels()
    height, width = pixels.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        expected = f"{view.camera.width} x {view.camera.height}"
        raise DatasetError(f"{view.name}: the photo has {width} x {height} pixels, its camera {expected}.")
    return pixels
