"""The photos of a run, decoded once and kept 8-bit while there is room, else read again when wanted."""

from collections.abc import Sequence

from splatax.camera import Camera
from splatax.dataset import Mask, Pixels, View, mask_of
from splatax.errors import DatasetError
from splatax.training.resolution import divided

Frame = tuple[Camera, Pixels, Mask | None]


class PhotoCache:
    """Frames by the index of their view and the divisor of their size.

    In random orders all photos are as likely to come next, so those that were kept first stay: to put
    others in their place would only have these read again.
    """

    def __init__(self, views: Sequence[View], room: int | float):
        """With room for so many bytes; infinite for all."""
        self._views, self._left = views, room
        self._kept: dict[int, tuple[int, Frame]] = {}

    def frame(self, index: int, divisor: int) -> Frame:
        """A view, with so many times fewer pixels a side. With another divisor it is kept no longer.

        Raises:
            DatasetError: if the photo or its mask is not of the camera's size.
        """
        if index in self._kept:
            kept, frame = self._kept[index]
            if kept == divisor:
                return frame
            del self._kept[index]
            self._left += size_of(frame)
        view = self._views[index]
        frame = divided(view.camera, checked(view), mask_of(view), divisor)
        if size_of(frame) <= self._left:
            self._kept[index] = divisor, frame
            self._left -= size_of(frame)
        return frame


def size_of(frame: Frame) -> int:
    """Bytes of a photo and its mask."""
    return sum(array.nbytes for array in frame[1:] if array is not None)


def checked(view: View) -> Pixels:
    """The view's photo.

    Raises:
        DatasetError: if it is not of the camera's size.
    """
    pixels = view.pixels()
    height, width = pixels.shape[:2]
    if (width, height) != (view.camera.width, view.camera.height):
        expected = f"{view.camera.width} x {view.camera.height}"
        raise DatasetError(f"{view.name}: the photo has {width} x {height} pixels, its camera {expected}.")
    return pixels
