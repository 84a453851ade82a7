"""How well a scene predicts photos that it may not have seen."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from splatax import metrics, rasterizers
from splatax.camera import Camera
from splatax.dataset import View
from splatax.gaussians import Gaussians
from splatax.projection import Dilation, LowPass
from splatax.rendering import render


@dataclass(frozen=True)
class ViewScore:
    """Of one view: PSNR in dB and SSIM, on 8-bit images."""

    name: str
    psnr: float
    ssim: float


@dataclass(frozen=True)
class Scores:
    """Of several views."""

    views: tuple[ViewScore, ...]

    @property
    def psnr(self) -> float:
        """Mean over views of PSNR, dB."""
        return float(np.mean([view.psnr for view in self.views]))

    @property
    def ssim(self) -> float:
        """Mean over views of SSIM."""
        return float(np.mean([view.ssim for view in self.views]))


def evaluate(
    gaussians: Gaussians,
    views: Iterable[View],
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    low_pass: LowPass = Dilation(),
    backend: str = rasterizers.AUTO,
) -> Scores:
    """Renders each view and compares it with its photo.

    Args:
        gaussians: the scene.
        views: with photos; those with alpha are composited over the background.
        background: RGB.
        low_pass: the one that the scene was trained with.
        backend: see `render`.
    """
    scores = []
    for view in views:
        photo = photo_of(view, background)
        image = picture(gaussians, view.camera, background=background, low_pass=low_pass, backend=backend)
        scores.append(ViewScore(view.name, metrics.psnr(image, photo), metrics.ssim(image, photo)))
    return Scores(tuple(scores))


def picture(
    gaussians: Gaussians,
    camera: Camera,
    *,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    low_pass: LowPass = Dilation(),
    backend: str = rasterizers.AUTO,
) -> UInt8[np.ndarray, "h w 3"]:
    """Renders a view to 8-bit RGB."""
    rgb = render(
        gaussians, camera, background=np.array(background, np.float32), low_pass=low_pass, backend=backend
    ).rgb
    return metrics.to_8bit(np.asarray(rgb))


def photo_of(view: View, background: tuple[float, float, float]) -> UInt8[np.ndarray, "h w 3"]:
    """The photo of a view, over the background where it is transparent."""
    pixels = view.pixels()
    if pixels.shape[2] == 3:
        return pixels
    alpha = pixels[..., 3:].astype(np.float64) / 255
    return metrics.to_8bit(pixels[..., :3] / 255 * alpha + (1 - alpha) * np.array(background))
