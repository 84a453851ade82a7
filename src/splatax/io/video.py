"""Writes videos: .mp4 and .webm with FFmpeg through PyAV, .gif with Pillow, or a folder of images."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from splatax.errors import InputError
from splatax.io import images
from splatax.io.files import replacing

Picture = UInt8[np.ndarray, "_ _ 3"]
Add = Callable[[Picture], None]  # adds the next frame

SUFFIXES = {".mp4", ".webm", ".gif"}
READ = {".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mts", ".3gp"}  # by `splatax reconstruct`
X264 = {"crf": "17", "preset": "medium"}  # visually near lossless
VP9 = {"crf": "24", "b": "0", "deadline": "good", "cpu-used": "4", "row-mt": "1"}
BT709 = 1  # matrix, primaries and transfer of HD television in H.273, which players assume


def is_video(path: Path) -> bool:
    """Returns whether a path has the suffix of a video whose frames can be used as photos."""
    return path.suffix.lower() in READ


def writing(path: Path, size: tuple[int, int], fps: int) -> AbstractContextManager[Add]:
    """Opens a video, and yields a function that adds a frame to it.

    A file appears when all frames are written. A folder fills frame by frame.

    Args:
        path: its suffix selects the format; a name without suffix is a folder.
        size: width and height of all frames, pixels.
        fps: frames per second.

    Raises:
        InputError: if the format is unknown, PyAV or its codec is missing, or the format does not allow this
            size.
    """
    writers = {".mp4": _mp4, ".webm": _webm, ".gif": _gif, "": _folder}
    if path.suffix.lower() not in writers:
        raise InputError(
            f"{path}: videos are .mp4, .webm or .gif, or a folder of images: a name without a dot."
        )
    if path.suffix.lower() in (".mp4", ".webm"):
        _require_pyav(path)
        if size[0] % 2 or size[1] % 2:
            raise InputError(
                f"{path}: {size[0]} x {size[1]} pixels, but this format needs even numbers. "
                "Choose an even width and an even height.",
                options=("size",),
            )
    return writers[path.suffix.lower()](path, size, fps)


def _require_pyav(path: Path) -> None:
    try:
        import av  # noqa: F401
    except ImportError:
        raise InputError(
            f"{path}: needs PyAV. Install it: pip install '.[video]' in the checkout of splatax. Or write a "
            ".gif or a folder."
        ) from None


@contextmanager
def _encoded(
    path: Path, size: tuple[int, int], fps: int, container: str, codec: str, options: dict[str, str]
) -> Iterator[Add]:
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file, av.open(file, "w", format=container, options=_front(container)) as film:
        try:
            stream = film.add_stream(codec, rate=Fraction(fps), options=options)
        except ValueError as error:
            raise InputError(
                f"{path}: this FFmpeg has no {codec}. Install PyAV's own build, "
                "pip install --force-reinstall av, or write another format."
            ) from error
        stream.width, stream.height = size
        stream.pix_fmt = "yuv420p"  # the only pixel format that all players support
        context = stream.codec_context
        context.color_range, context.colorspace = 1, BT709
        context.color_primaries, context.color_trc = BT709, BT709

        def add(picture: Picture) -> None:
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame = frame.reformat(format="yuv420p", dst_colorspace="ITU709")
            film.mux(stream.encode(frame))

        yield add
        film.mux(stream.encode(None))


def _front(container: str) -> dict[str, str]:
    """Returns the option that puts an MP4's index first, so that the video plays while it loads."""
    return {"movflags": "+faststart"} if container == "mp4" else {}


def _mp4(path: Path, size: tuple[int, int], fps: int) -> AbstractContextManager[Add]:
    return _encoded(path, size, fps, "mp4", "libx264", X264)


def _webm(path: Path, size: tuple[int, int], fps: int) -> AbstractContextManager[Add]:
    return _encoded(path, size, fps, "webm", "libvpx-vp9", VP9)


@contextmanager
def _gif(path: Path, size: tuple[int, int], fps: int) -> Iterator[Add]:
    from PIL import Image

    frames: list[Image.Image] = []
    yield lambda picture: frames.append(
        Image.fromarray(picture).quantize(256, dither=Image.Dither.FLOYDSTEINBERG)
    )
    ends = [round(100 * (i + 1) / fps) for i in range(len(frames))]  # GIF stores hundredths of a second
    durations = [10 * (end - start) for start, end in zip([0, *ends], ends, strict=False)]
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as file:
        frames[0].save(file, "GIF", save_all=True, append_images=frames[1:], duration=durations, loop=0)


@contextmanager
def _folder(path: Path, size: tuple[int, int], fps: int) -> Iterator[Add]:
    path.mkdir(parents=True, exist_ok=True)
    for earlier in path.glob("frame[0-9]*.png"):
        earlier.unlink()
    count = 0

    def add(picture: Picture) -> None:
        nonlocal count
        images.write(path / f"frame{count:05}.png", picture)
        count += 1

    yield add
