"""Pictures for reports: error maps, depth and normals as colours, and the animation of a run."""

import base64
import io
from collections.abc import Sequence

import matplotlib
import numpy as np
from jaxtyping import Float
from PIL import Image, ImageDraw

from splatax.cameras import Camera
from splatax.dataset import Mask
from splatax.metrics import to_8bit
from splatax.runs.history import Picture, shrunk

LARGEST_ERROR = 0.25  # of full scale: where the colours of error maps end
FRAME_SECONDS, LAST_SECONDS = 0.25, 2.5  # of an animation
LABEL_HEIGHT = 18  # pixels


def error_map(image: Picture, photo: Picture, mask: Mask | None = None) -> Picture:
    """Returns the mean absolute difference over RGB: black is none, bright yellow a quarter of full scale.

    Pixels outside the mask do not count, and are black.
    """
    error = np.mean(np.abs(image.astype(np.float32) - photo), axis=2) / 255
    if mask is not None:
        error = np.where(mask, error, 0)
    return colored(error / LARGEST_ERROR, "inferno")


def depth_map(depth: Float[np.ndarray, "h w"], alpha: Float[np.ndarray, "h w"]) -> Picture:
    """Returns depth as colours between its 2nd and 98th percentiles, near bright; black where it is empty."""
    return shaded(depth, alpha, depth_range(depth, alpha))


def depth_range(
    depth: Float[np.ndarray, "..."], alpha: Float[np.ndarray, "..."]
) -> tuple[float, float] | None:
    """Returns the 2nd and 98th percentiles of depth where alpha is above 0.5; None if it is nowhere.

    Depths of 0 are unknown, and do not count.
    """
    known = depth[(alpha > 0.5) & (depth > 0)]
    if not known.size:
        return None
    near, far = np.percentile(known, [2, 98])
    return float(near), float(far)


def shaded(
    depth: Float[np.ndarray, "h w"], alpha: Float[np.ndarray, "h w"], limits: tuple[float, float] | None
) -> Picture:
    """Returns depth as colours, from bright at the nearer limit to dark at the other; black if empty."""
    if limits is None:
        return np.zeros((*depth.shape, 3), np.uint8)
    near, far = limits
    shades = 1 - (depth - near) / max(far - near, 1e-12)
    known = (alpha > 0.5) & (depth > 0)
    return np.where(known[..., None], colored(shades, "viridis"), 0).astype(np.uint8)


def normal_map(
    normals: Float[np.ndarray, "h w 3"], alpha: Float[np.ndarray, "h w"], camera: Camera
) -> Picture:
    """Returns normals as colours, in the axes of a camera; black where it is empty.

    A component n has the value 255 (0.5 + 0.5 n): red for right, green for up and blue for towards the
    camera. A surface that faces the camera is light blue, as in a normal map of OpenGL.

    Args:
        normals: unit vectors in the world; 0 where they are unknown.
        alpha: coverage of the pixels.
        camera: camera of the view.
    """
    right, down, forward = np.asarray(camera.rotation)
    turned = normals @ np.stack([right, -down, -forward], axis=1)
    known = (alpha > 0.5) & (normals != 0).any(axis=2)
    return np.where(known[..., None], to_8bit(0.5 + 0.5 * turned), 0).astype(np.uint8)


def colored(values: Float[np.ndarray, "h w"], colormap: str) -> Picture:
    """Returns values in [0, 1] as colours; others are clipped."""
    return matplotlib.colormaps[colormap](np.clip(values, 0, 1), bytes=True)[..., :3]


def animation(frames: Sequence[tuple[str, Picture]]) -> bytes:
    """Returns labelled pictures as a GIF that pauses on the last one."""
    images = [_labelled(label, picture) for label, picture in frames]
    durations = [FRAME_SECONDS * 1000] * (len(images) - 1) + [LAST_SECONDS * 1000]
    palettes = [image.quantize(128, dither=Image.Dither.FLOYDSTEINBERG) for image in images]
    buffer = io.BytesIO()
    palettes[0].save(buffer, "GIF", save_all=True, append_images=palettes[1:], duration=durations, loop=0)
    return buffer.getvalue()


def data_uri(picture: Picture) -> str:
    """Returns a picture as a JPEG in a data URI."""
    image = Image.fromarray(shrunk(picture))
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=88)
    return encoded(buffer.getvalue(), "image/jpeg")


def encoded(contents: bytes, kind: str) -> str:
    """Returns the contents of a file as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(contents).decode()}"


def _labelled(label: str, picture: Picture) -> Image.Image:
    image = Image.fromarray(shrunk(picture))
    canvas = Image.new("RGB", (image.width, image.height + LABEL_HEIGHT), "black")
    canvas.paste(image, (0, 0))
    ImageDraw.Draw(canvas).text((6, image.height + 2), label, fill="white")
    return canvas
