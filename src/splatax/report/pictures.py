"""Pictures for reports: error maps, depth in colour, the progress of training as an animation."""

import base64
import io
from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image, ImageDraw

from splatax.dataset import Mask

Picture = UInt8[np.ndarray, "_ _ 3"]

LARGEST_ERROR = 0.25  # of full scale: where the colours of error maps end
REPORT_WIDTH = 720  # pixels; pictures in a report are shrunk to it
FRAME_SECONDS, LAST_SECONDS = 0.25, 2.5  # of an animation
LABEL_HEIGHT = 18  # pixels


def error_map(image: Picture, photo: Picture, mask: Mask | None = None) -> Picture:
    """Mean absolute difference over RGB: black is none, bright yellow a quarter of full scale.

    Outside the mask, where nothing counts, it is black.
    """
    error = np.mean(np.abs(image.astype(np.float32) - photo), axis=2) / 255
    if mask is not None:
        error = np.where(mask, error, 0)
    return colored(error / LARGEST_ERROR, "inferno")


def depth_map(depth: Float[np.ndarray, "h w"], alpha: Float[np.ndarray, "h w"]) -> Picture:
    """Depth in colour, near is bright, from the 2nd to the 98th percentile; black where nothing is."""
    return shaded(depth, alpha, depth_range(depth, alpha))


def depth_range(
    depth: Float[np.ndarray, "..."], alpha: Float[np.ndarray, "..."]
) -> tuple[float, float] | None:
    """The 2nd and the 98th percentile of depth where something is; None where nothing is."""
    covered = depth[alpha > 0.5]
    if not covered.size:
        return None
    near, far = np.percentile(covered, [2, 98])
    return float(near), float(far)


def shaded(
    depth: Float[np.ndarray, "h w"], alpha: Float[np.ndarray, "h w"], limits: tuple[float, float] | None
) -> Picture:
    """Depth in colour, from bright at the nearer limit to dark at the other; black where nothing is."""
    if limits is None:
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = limits
    shades = 1 - (depth - near) / max(far - near, 1e-12)
    return np.where((alpha > 0.5)[..., None], colored(shades, "viridis"), 0).astype(np.uint8)


def colored(values: Float[np.ndarray, "h w"], colormap: str) -> Picture:
    """Values in [0, 1] as colours; the rest is clipped."""
    return matplotlib.colormaps[colormap](np.clip(values, 0, 1), bytes=True)[..., :3]


def animation(frames: Sequence[tuple[str, Picture]]) -> bytes:
    """Labelled pictures as a GIF that rests on the last, no wider than those of a report."""
    images = [_labelled(label, picture) for label, picture in frames]
    durations = [FRAME_SECONDS * 1000] * (len(images) - 1) + [LAST_SECONDS * 1000]
    palettes = [image.quantize(128, dither=Image.Dither.FLOYDSTEINBERG) for image in images]
    buffer = io.BytesIO()
    palettes[0].save(buffer, "GIF", save_all=True, append_images=palettes[1:], duration=durations, loop=0)
    return buffer.getvalue()


def shrunk(picture: Picture) -> Picture:
    """A picture no wider than a report shows it."""
    height, width = picture.shape[:2]
    if width <= REPORT_WIDTH:
        return picture
    size = REPORT_WIDTH, max(round(height * REPORT_WIDTH / width), 1)
    return np.asarray(Image.fromarray(picture).resize(size, Image.Resampling.BOX))


def data_uri(picture: Picture) -> str:
    """A picture as a JPEG inside a page."""
    image = Image.fromarray(shrunk(picture))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=88)
    return encoded(buffer.getvalue(), "image/jpeg")


def encoded(contents: bytes, kind: str) -> str:
    """A file inside a page."""
    return f"data:{kind};base64,{base64.b64encode(contents).decode()}"


def _labelled(label: str, picture: Picture) -> Image.Image:
    image = Image.fromarray(shrunk(picture))
    canvas = Image.new("RGB", (image.width, image.height + LABEL_HEIGHT), "black")
    canvas.paste(image, (0, 0))
    ImageDraw.Draw(canvas).text((6, image.height + 2), label, fill="white")
    return canvas
