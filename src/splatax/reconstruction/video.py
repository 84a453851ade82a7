"""Extracts the sharpest frames of a video, using PyAV, an optional package."""

import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Num

from splatax.errors import DatasetError, InputError
from splatax.reconstruction.photos import save

WIDTH = 480  # pixels of the size at which sharpness is measured
QUARTER_TURNS = {0: 0, 90: 1, 180: 2, 270: 3}
COMPLETE = 0.9  # of the frames and of the time that the header gives; a video with less of both is incomplete


def sharpness(gray: Num[np.ndarray, "h w"]) -> float:
    """Returns the variance of the Laplacian (Pech-Pacheco et al. 2000) of brightness in [0, 255]."""
    g = gray.astype(np.float32)
    laplacian = 4 * g[1:-1, 1:-1] - g[:-2, 1:-1] - g[2:, 1:-1] - g[1:-1, :-2] - g[1:-1, 2:]
    return float(laplacian.var())


def pick_frames(path: Path, folder: Path, count: int, watch: Callable[[int, int], None]) -> None:
    """Writes the sharpest frame of each of `count` equally long stretches of a video to a folder, as JPEG.

    Warns if the video ends long before its header says.

    Args:
        path: path of the video.
        folder: folder for the frames.
        count: number of frames; the video may have fewer.
        watch: function that is called with (frames decoded, approximate number of frames).

    Raises:
        InputError: if PyAV is not installed.
        DatasetError: if the file is not a video, or is damaged.
    """
    try:
        import av
    except ImportError:
        raise InputError(
            f"{path}: reading videos needs another package: pip install '.[video]' in the checkout of "
            "splatax. Or give a folder of frames."
        ) from None
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with av.open(str(path)) as container:
            if not container.streams.video:
                raise DatasetError(f"{path}: there is no picture in this video.")
            stream = container.streams.video[0]
            stream.thread_type = "AUTO"
            seconds = float(container.duration or 0) / 1e6
            if stream.duration:
                seconds = float(stream.duration * stream.time_base)
            total = stream.frames or int(seconds * float(stream.average_rate or 30))
            times: list[float] = []
            frames = noting_times(container.decode(stream), times)
            for index, frame in best_of_stretches(frames, total, count, watch):
                turned = np.rot90(
                    frame.to_ndarray(format="rgb24"), QUARTER_TURNS[round(frame.rotation) % 360]
                )
                save(folder / f"frame_{index:06}.jpg", np.ascontiguousarray(turned))
            warn_if_cut_short(path, times, total, seconds)
    except (av.error.FFmpegError, KeyError) as error:
        raise DatasetError(
            f"{path}: the video cannot be read ({error}). Copy it from the camera again if it does not play; "
            "if it does, convert it: ffmpeg -i VIDEO -c:v libx264 converted.mp4."
        ) from error


def noting_times(frames: Iterable[Any], times: list[float]) -> Iterator[Any]:
    """Yields frames, and appends the time of each, in seconds, to a list."""
    for frame in frames:
        times.append(frame.time or 0.0)
        yield frame


def warn_if_cut_short(path: Path, times: list[float], total: int, seconds: float) -> None:
    """Warns if a video has fewer frames and less time than its header says, as after an interrupted copy.

    Both must be short. A header's number of frames is an estimate in some formats, too high where the frame
    rate varies, and an edit list hides frames. Its time includes that of the sound, which may be longer.

    Args:
        path: path of the video.
        times: times of all frames, seconds.
        total: number of frames according to the header, approximately.
        seconds: duration according to the header.
    """
    if not times or len(times) >= COMPLETE * total or times[-1] - times[0] >= COMPLETE * seconds:
        return
    warnings.warn(
        f"{path}: it ends after {len(times)} of about {total} frames, so it is probably incomplete. Copy it "
        "from the camera again. Only the frames that are there are used.",
        stacklevel=1,
    )


def best_of_stretches(
    frames: Iterator[Any], total: int, count: int, watch: Callable[[int, int], None]
) -> Iterator[tuple[int, Any]]:
    """Yields (index, frame) of the sharpest frame in each of `count` stretches of about `total` frames."""
    length = max(total / count, 1.0)
    best: tuple[float, int, Any] | None = None
    stretch = 0
    for index, frame in enumerate(frames):
        if index >= (stretch + 1) * length and best is not None:
            yield best[1], best[2]
            best, stretch = None, int(index / length)
        height = max(round(frame.height * WIDTH / frame.width), 3)
        score = sharpness(frame.reformat(width=WIDTH, height=height, format="gray").to_ndarray())
        if best is None or score > best[0]:
            best = score, index, frame
        watch(index + 1, max(total, index + 1))
    if best is not None:
        yield best[1], best[2]
