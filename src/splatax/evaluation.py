"""Evaluation: PSNR, SSIM and LPIPS of renderings compared with photos, usually held-out ones."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from threading import Lock

import numpy as np
from jaxtyping import Bool, UInt8

from splatax import metrics
from splatax.ahead import cores, in_order
from splatax.cameras import Camera
from splatax.cameras.canvases import Size, canvases_for
from splatax.dataset import Mask, View, by_photo, mask_of
from splatax.errors import DatasetError, InputError
from splatax.gaussians import Gaussians
from splatax.lpips import Lpips
from splatax.rendering import BackgroundLike, Renderer
from splatax.shapes import check_kind

PROTOCOL = {  # how scores are computed, in words
    "images": "rounded to 8 bits, at the size they were loaded in",
    "psnr": metrics.PSNR_PROTOCOL,
    "corrected_psnr": metrics.CORRECTION_PROTOCOL,
    "ssim": metrics.SSIM_PROTOCOL,
    "masks": metrics.MASK_PROTOCOL,
}


MOST_SIZES = 4  # of renderings, each of which compiles a program; see `cameras.canvases`
THREADS = 4  # that score views, at most; each holds about 20 bytes for a pixel of its view


@dataclass(frozen=True)
class ViewScore:
    """Scores of one view, or of all faces of a 360-degree photo, computed on 8-bit images.

    Attributes:
        name: name of the view or the photo.
        psnr: dB.
        ssim: at most 1.
        corrected_psnr: dB, after an affine map of the rendering's colours; see `metrics.color_corrected`.
        lpips: 0 is best; None if it was not computed.
    """

    name: str
    psnr: float
    ssim: float
    corrected_psnr: float
    lpips: float | None = None


@dataclass(frozen=True)
class Scores:
    """Scores of several views, and their means."""

    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        """Mean over views of PSNR, dB."""
        return float(np.mean([view.psnr for view in self.views]))

    @property
    def ssim(self) -> float:
        """Mean over views of SSIM."""
        return float(np.mean([view.ssim for view in self.views]))

    @property
    def corrected_psnr(self) -> float:
        """Mean over views of the colour-corrected PSNR, dB."""
        return float(np.mean([view.corrected_psnr for view in self.views]))

    @property
    def lpips(self) -> float | None:
        """Mean over views of LPIPS; None if it was not computed."""
        values = [view.lpips for view in self.views if view.lpips is not None]
        return float(np.mean(values)) if values else None

    @property
    def worst(self) -> ViewScore:
        """The view with the lowest PSNR."""
        return min(self.views, key=lambda view: view.psnr)


Picture = UInt8[np.ndarray, "_ _ 3"]
Compared = tuple[ViewScore, Picture, Picture, Mask | None]  # score, photo, rendering and mask


def evaluate(
    gaussians: Gaussians,
    views: Iterable[View],
    *,
    renderer: Renderer = Renderer(),
    lpips: Lpips | None = None,
) -> Scores:
    """Renders each view and compares it with its photo, inside its mask if it has one.

    Args:
        gaussians: the scene.
        views: with photos; those with alpha are composited over the renderer's background.
        renderer: with the low-pass filter that the scene was trained with.
        lpips: the metric to compute as well; None for none.

    Raises:
        DatasetError: if there are no views, or a photo is too small to be compared, or masked too much.
        TypeError: if a data set or one view is given instead of views.
    """
    check_kind("views", views, Iterable, "Give several, such as dataset.test, or [view].")
    views = tuple(views)
    if not views:
        raise DatasetError("There are no views to score. Hold some out when the capture is loaded.")
    return scores_of(views, [score for score, *_ in compared(gaussians, views, renderer, lpips)])


def require_scorable(views: Iterable[View]) -> None:
    """Checks the sizes and masks of photos to score, so that hours of training do not end in an error.

    Raises:
        DatasetError: if a photo is too small to be compared, or no pixel of it counts.
    """
    views = tuple(views)
    for view in views:
        width, height = view.camera.width, view.camera.height
        if min(width, height) < metrics.WINDOW:
            raise DatasetError(
                f"{view.name}: {width} x {height} pixels are too few for a score, which needs at least "
                f"{metrics.WINDOW} x {metrics.WINDOW}. Load larger photos, or hold out others.",
                options=("downscale", "hold_out"),
            )
    for _ in in_order(mask_of, views, cores()):
        pass


def scores_of(views: Iterable[View], scores: Iterable[ViewScore]) -> Scores:
    """Returns the scores of photos. The faces of a 360-degree photo have one, of all of their pixels.

    Args:
        views: views with the scores, and perhaps others.
        scores: of views.
    """
    views = tuple(views)
    if not any(view.face_of for view in views):
        return Scores(tuple(scores))
    photos = by_photo(views, {score.name: score for score in scores})
    return Scores(
        tuple(each[0] if each[0].name == photo else joined(photo, each) for photo, each in photos.items())
    )


def joined(photo: str, faces: Sequence[ViewScore]) -> ViewScore:
    """Returns the score of a 360-degree photo: squared errors and the other measures are means over faces."""

    def mean_psnr(values: list[float]) -> float:
        error = float(np.mean([10 ** (-value / 10) for value in values]))
        return -10 * float(np.log10(error)) if error else float("inf")

    lpips = [face.lpips for face in faces if face.lpips is not None]
    return ViewScore(
        photo,
        mean_psnr([face.psnr for face in faces]),
        float(np.mean([face.ssim for face in faces])),
        mean_psnr([face.corrected_psnr for face in faces]),
        float(np.mean(lpips)) if lpips else None,
    )


def compared(
    gaussians: Gaussians, views: Iterable[View], renderer: Renderer, lpips: Lpips | None = None
) -> Iterator[Compared]:
    """Yields score, photo, rendering and mask of each view, in order; see `evaluate`.

    Photos are read and scored in threads. Memory holds the pictures of a few views at a time.
    """
    drawing = Lock()  # one view at a time, which leaves the device's memory to it
    views = tuple(views)
    canvases = canvases_for([view.camera for view in views], MOST_SIZES)

    def comparison(numbered: tuple[View, Size | None]) -> Compared:
        view, canvas = numbered
        photo = photo_of(view, renderer.behind(view.camera))
        camera = view.camera if canvas is None else view.camera.on_canvas(*canvas)
        with drawing:
            image = picture(gaussians, camera, renderer)[: view.camera.height, : view.camera.width]
        mask = mask_of(view)
        return score(view.name, image, photo, mask, lpips), photo, image, mask

    return in_order(comparison, zip(views, canvases, strict=True), min(cores(), THREADS))


def score(
    name: str,
    image: UInt8[np.ndarray, "h w 3"],
    photo: UInt8[np.ndarray, "h w 3"],
    mask: Bool[np.ndarray, "h w"] | None = None,
    lpips: Lpips | None = None,
) -> ViewScore:
    """Compares a rendering with a photo.

    Raises:
        DatasetError: if they are too small, or the mask leaves too little of them.
    """
    try:
        return ViewScore(
            name,
            metrics.psnr(image, photo, mask),
            metrics.ssim(image, photo, mask),
            metrics.corrected_psnr(image, photo, mask),
            lpips(image, photo, mask) if lpips else None,
        )
    except InputError as error:
        raise DatasetError(f"{name}: {error}. Load larger photos, or mask less of them.") from error


def picture(
    gaussians: Gaussians, camera: Camera, renderer: Renderer = Renderer()
) -> UInt8[np.ndarray, "h w 3"]:
    """Renders a view to 8-bit RGB."""
    return metrics.to_8bit(np.asarray(renderer(gaussians, camera).rgb))


def photo_of(view: View, background: BackgroundLike) -> UInt8[np.ndarray, "h w 3"]:
    """Returns the photo of a view; one with alpha is composited over the background."""
    pixels = view.pixels()
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3:].astype(np.float64) / 255
    return metrics.to_8bit(pixels[..., :3] / 255 * alpha + (1 - alpha) * np.array(background))
