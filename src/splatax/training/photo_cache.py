"""A cache of decoded photos: it keeps as many as fit in a given memory and decodes the others again."""

from collections.abc import Hashable, Sequence
from threading import Lock

import jax
import numpy as np

from splatax.cameras import Camera
from splatax.cameras.canvases import Size
from splatax.dataset import Mask, Pixels, View, mask_of
from splatax.errors import DatasetError
from splatax.training.resolution import divided

Frame = tuple[Camera, Pixels, Mask | None]


class PhotoCache:
    """Decoded photos and masks, by the index of their view. Threads share it.

    Photos are requested in random order, so each is equally likely to be next. The cache therefore never
    replaces a photo that it keeps: the replaced one would only have to be decoded again.
    """

    def __init__(
        self, views: Sequence[View], room: int | float, canvases: Sequence[Size | None] | None = None
    ):
        """Creates an empty cache.

        Args:
            views: views whose photos are decoded.
            room: bytes of memory; `math.inf` keeps all photos.
            canvases: size of the canvas of each photo at full size, None for none; see
                `cameras.canvases`. What is kept has the size of the photo.
        """
        self._views, self._left = views, room
        self._canvases = [None] * len(views) if canvases is None else canvases
        self._masked = any(
            view.mask is not None and canvas for view, canvas in zip(views, self._canvases, strict=True)
        )
        self._kept: dict[int, tuple[int, Frame]] = {}
        self._lock = Lock()

    def frame(self, index: int, divisor: int) -> Frame:
        """Returns a view whose width and height are divided by `divisor`, on its canvas if it has one.

        Photos on canvases are RGBA, and all of them have a mask if one has, so that they share programs. A
        photo that is kept at another size is dropped, which frees its memory.

        Raises:
            DatasetError: if the photo or its mask is not of the camera's size.
        """
        frame, canvas = self._tight(index, divisor), self._canvas(index, divisor)
        if canvas is None:
            return frame
        camera, photo, mask = frame
        if self._masked and mask is None:
            mask = np.ones(photo.shape[:2], bool)
        counted = None if mask is None else _padded(mask, canvas)
        return camera.on_canvas(*canvas), _padded(with_alpha(photo), canvas), counted

    def camera(self, index: int, divisor: int) -> Camera:
        """Returns the camera of `frame`, without decoding the photo."""
        camera, canvas = self._views[index].camera, self._canvas(index, divisor)
        if divisor != 1:
            camera = camera.resized(camera.width // divisor, camera.height // divisor)
        return camera if canvas is None else camera.on_canvas(*canvas)

    def kind(self, index: int) -> Hashable:
        """Returns what photos of a step have in common: image size, lens model, whether there is a mask."""
        camera = self.camera(index, 1)
        masked = self._masked if self._canvases[index] else self._views[index].mask is not None
        return camera.width, camera.height, jax.tree.structure(camera), masked

    def _canvas(self, index: int, divisor: int) -> Size | None:
        canvas = self._canvases[index]
        return canvas and (canvas[0] // divisor, canvas[1] // divisor)

    def _tight(self, index: int, divisor: int) -> Frame:
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


def with_alpha(photo: Pixels) -> Pixels:
    """Returns a photo as RGBA. Alpha of 255 changes no bit of the loss."""
    if photo.shape[2] == 4:
        return photo
    return np.dstack([photo, np.full_like(photo[..., 0], 255)])


def _padded(picture: np.ndarray, canvas: Size) -> np.ndarray:
    """Returns a picture at the top left of a canvas of zeros."""
    width, height = canvas
    padded = np.zeros((height, width, *picture.shape[2:]), picture.dtype)
    padded[: picture.shape[0], : picture.shape[1]] = picture
    return padded


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
