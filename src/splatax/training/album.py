"""The photos of a run, decoded once and kept 8-bit while there is room, else read again when wanted."""

from collections.abc import Sequence

from splatax.camera import Camera
from splatax.dataset import Mask, Pixels, View, mask_of
from splatax.errors import DatasetError
from splatax.training.resolution import divided

Frame = tuple[Camera, Pixels, Mask | None]


class Album:
    """Frames by the index of their view and the divisor of their size.

    In random orders all photos are as likely to come next, so those that were kept first stay: to put
    others in their place would only have these read again.
    """

    def __init__(self, views: Sequence[View], room: int | float, smallest: int = 1):
        """With room for so many bytes; infinite for all. For `smallest`, see `Resolution`."""
        self._views, self._room, self._left, self._smallest = views, room, room, smallest
        self._divisor = 1
        self._kept: dict[int, Frame] = {}

    def frame(self, index: int, divisor: int) -> Frame:
        """A view, with so many times fewer pixels a side. Those of another divisor are kept no longer.

        Raises:
            DatasetError: if the photo or its mask is not of the camera's size.
        """
        if divisor != self._divisor:
            self._kept, self._left, self._divisor = {}, self._room, divisor
        if index in self._kept:
            return self._kept[index]
        view = self._views[index]
        frame = divided(view.camera, checked(view), mask_of(view), divisor, self._smallest)
        size = sum(array.nbytes for array in frame[1:] if array is not None)
        if size <= self._left:
            self._kept[index] = frame
            self._left -= size
        return frame


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
