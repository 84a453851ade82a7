"""Frames of videos: sharp and upright ones."""

import warnings

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import corner
from splatax.errors import DatasetError, InputError
from splatax.reconstruction import reconstruct, video
from splatax.reconstruction.pipeline import gather

av = pytest.importorskip("av")


def write_video(path, count=30, sharp=lambda i: i % 10 == 4, every=1, **options):
    """Frames 160 x 120 of a moving pattern, blurred but for some. One frame in `every` has a picture."""
    paper = corner.wallpaper()
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("mpeg4", rate=30)
        stream.width, stream.height, stream.pix_fmt, stream.bit_rate = 160, 120, "yuv420p", 4_000_000
        for i in range(count):
            crop = paper[100:220, 5 * i : 5 * i + 160]
            crop = crop if sharp(i) else ndimage.gaussian_filter(crop, (3, 3, 0))
            frame = av.VideoFrame.from_ndarray(crop.astype(np.uint8), format="rgb24")
            frame.pts = i * every
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def test_the_sharpest_frame_of_each_stretch_is_taken(tmp_path):
    told = []
    path = write_video(tmp_path / "walk.mp4")
    video.pick_frames(path, tmp_path / "frames", 3, lambda *far: told.append(far))
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == [
        "frame_000004.jpg",
        "frame_000014.jpg",
        "frame_000024.jpg",
    ]
    assert told[-1] == (30, 30)
    assert Image.open(tmp_path / "frames" / "frame_000004.jpg").size == (160, 120)


def test_a_short_video_gives_all_its_frames(tmp_path):
    path = write_video(tmp_path / "walk.mp4", count=4)
    video.pick_frames(path, tmp_path / "frames", 100, lambda *far: None)
    assert len(list((tmp_path / "frames").iterdir())) == 4


def test_frames_are_photos_to_reconstruct_from(tmp_path):
    (tmp_path / "work").mkdir()
    photos, damaged = gather(
        write_video(tmp_path / "walk.mp4"), tmp_path / "work", 5, "auto", lambda *far: None
    )
    assert len(photos) == 5
    assert not damaged
    assert len({photo.device for photo in photos}) == 1  # one camera


@pytest.mark.parametrize("contents", [b"", b"no video", bytes(5000)])
def test_what_is_no_video(tmp_path, contents):
    (tmp_path / "walk.mp4").write_bytes(contents)
    with pytest.raises(DatasetError, match=r"walk.mp4: the video cannot be read"):
        video.pick_frames(tmp_path / "walk.mp4", tmp_path / "frames", 5, lambda *far: None)


def test_without_the_package_the_way_to_it_is_named(tmp_path, monkeypatch):
    walk = write_video(tmp_path / "walk.mp4")
    monkeypatch.setitem(__import__("sys").modules, "av", None)
    with pytest.raises(InputError, match=r"pip install '\.\[video\]' in the checkout"):
        video.pick_frames(walk, tmp_path / "frames", 5, lambda *far: None)


@pytest.mark.parametrize(("name", "options"), [("walk.mkv", {}), ("walk.mp4", {"movflags": "faststart"})])
def test_the_frames_of_a_video_that_ends_too_early_are_used_with_a_warning(tmp_path, name, options):
    path = write_video(tmp_path / name, **options)
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.warns(UserWarning, match=rf"{name}: it ends after \d+ of about 30 frames.*Copy it") as told:
        video.pick_frames(path, tmp_path / "frames", 100, lambda *far: None)
    found = len(list((tmp_path / "frames").iterdir()))
    assert 5 < found < 27
    assert f"after {found} of" in str(told[0].message)


@pytest.mark.parametrize("name", ["walk.mp4", "walk.mkv"])
@pytest.mark.parametrize("every", [1, 3])
def test_a_whole_video_gives_no_warning_whatever_its_frame_rate(tmp_path, name, every):
    path = write_video(tmp_path / name, every=every)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        video.pick_frames(path, tmp_path / "frames", 100, lambda *far: None)


@pytest.mark.parametrize(
    ("frames", "total", "seconds", "short"),
    [
        (30, 30, 1.0, False),
        (12, 30, 1.0, True),
        (12, 0, 0.0, False),  # a header without numbers
        (12, 30, 0.4, False),  # an edit list hides frames, or there are fewer frames a second than usual
        (30, 30, 5.0, False),  # the sound is longer
    ],
)
def test_a_video_is_short_if_frames_and_time_are_missing(tmp_path, frames, total, seconds, short):
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        video.warn_if_cut_short(tmp_path / "a.mp4", [i / 30 for i in range(frames)], total, seconds)
    assert len(told) == short


def test_a_video_of_too_few_frames_leaves_nothing_behind(tmp_path):
    path, out = write_video(tmp_path / "walk.mp4", count=2), tmp_path / "capture"
    with pytest.raises(DatasetError, match="2 photos to use, but depth needs at least 3"):
        reconstruct(path, out)
    assert not out.exists()
