"""Inspection of captures: it finds each defect that is put into a capture, and none in a good one."""

import re
import sys
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pycolmap
import pytest
from PIL import Image
from scipy import ndimage

import splatax as sx
from captures import SIZE, model_of, pinhole, write_capture, write_transforms
from scenes import camera_at
from splatax.cameras import look_at, rig
from splatax.inspection import Examination, examine, problems_of
from splatax.inspection.looks import Look, looks_of, spread, thumbnail
from splatax.inspection.outliers import robust_scores
from splatax.io.images import read
from splatax.report.capture import MOST, capture_page, facts_of, roughly
from splatax.report.plan import upright_frame

COUNT = 24
NAMES = [f"photo{i:02}.png" for i in range(COUNT)]


@pytest.fixture
def capture(tmp_path):
    """Photos of one smooth pattern, as sharp and bright as each other, and 30 points."""
    capture = write_capture(tmp_path / "capture", count=COUNT)
    rng = np.random.default_rng(0)
    for name in NAMES:
        smooth = ndimage.gaussian_filter(rng.normal(size=(48, 64)), 1.0)
        Image.fromarray(gray(128 + 200 * smooth)).save(capture / "images" / name)
    return capture


def gray(values):
    return np.repeat(np.clip(values, 0, 255)[..., None], 3, axis=2).astype(np.uint8)


def edit(capture, name, change):
    path = capture / "images" / name
    Image.fromarray(change(read(path).astype(np.float64)).clip(0, 255).astype(np.uint8)).save(path)


def problems(capture):
    return problems_of(examine(capture, sx.load_dataset(capture)))


def said(capture):
    return [problem.what for problem in problems(capture)]


FEW_POINTS = "Only 30 points to start from."


def test_a_sound_capture_has_no_problem_but_its_few_points(capture):
    assert said(capture) == [FEW_POINTS]


def test_one_photo_without_poses_is_too_few(capture):
    for name in NAMES[1:]:
        (capture / "images" / name).unlink()
    problems = problems_of(examine(capture / "images", None))
    assert [problem.what for problem in problems][1] == "Only 1 photo."


@pytest.mark.parametrize(
    ("change", "what"),
    [
        (lambda p: ndimage.gaussian_filter(p, (2.5, 2.5, 0)), "1 photo is blurred, compared with the rest"),
        (lambda p: p * 0.4, "1 photo is much darker than the rest"),
        (lambda p: p * 0.4 + 150, "1 photo is much brighter than the rest"),
        (lambda p: np.where(np.arange(64)[:, None] < 30, 255, p), "1 photo is white over more than 20% of"),
    ],
    ids=["blurred", "dark", "bright", "burnt out"],
)
def test_a_photo_unlike_the_rest_is_found(capture, change, what):
    edit(capture, "photo07.png", change)
    assert any(line.startswith(what) and line.endswith(": photo07.png.") for line in said(capture))


def test_a_photo_that_cannot_be_read_is_an_error(capture):
    path = capture / "images" / "photo03.png"
    path.write_bytes(path.read_bytes()[:500])
    first = problems(capture)[0]
    assert first.severity == "error"
    assert re.match(r"1 photo cannot be read: photo03.png \(.+\)", first.what)
    assert ".)" not in first.what


def test_photos_without_a_pose_are_named(capture):
    (capture / "images" / "extra.png").write_bytes((capture / "images" / "photo00.png").read_bytes())
    assert f"1 of {COUNT + 1} photos have no pose: extra.png." in said(capture)


def test_observations_that_points_do_not_project_to_are_an_error(capture):
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    for image in model.images.values():
        for point in image.points2D:
            point.xy = point.xy + [6, 8]
    model.write_binary(capture / "sparse" / "0")
    assert "Points project 10.0 pixels from where they were seen, in the median photo." in said(capture)
    assert problems(capture)[0].severity == "error"


def test_one_badly_placed_photo_is_found(capture):
    model = pycolmap.Reconstruction(capture / "sparse" / "0")
    for point in model.find_image_with_name("photo05.png").points2D:
        point.xy = point.xy + [3, 4]
    model.write_binary(capture / "sparse" / "0")
    assert "1 photo is placed worse than the rest: photo05.png." in said(capture)


def test_turning_on_the_spot_is_an_error(tmp_path):
    capture = write_capture(tmp_path / "capture", count=COUNT)
    model = model_of(NAMES, pinhole())
    for image in model.images.values():
        pose = image.cam_from_world()
        image.frame.rig_from_world = pycolmap.Rigid3d(pose.rotation, np.zeros(3))
    model.write_binary(capture / "sparse" / "0")
    assert "All photos were taken from one place, so they contain no information about depth." in said(
        capture
    )


def test_inverted_masks_are_suspected(capture):
    (capture / "masks").mkdir()
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    mask[:4] = 255
    for name in NAMES:
        Image.fromarray(mask).save(capture / "masks" / name)
    found = examine(capture, sx.load_dataset(capture))
    assert found.coverage["photo00.png"] == pytest.approx(4 / 48)
    assert any("masks leave less than 20% of their photo" in what for what in said(capture))


def test_masks_that_cannot_be_used_are_an_error(capture):
    (capture / "masks").mkdir()
    for name, level in zip(NAMES, [0, 255, 255], strict=False):
        Image.new("L", SIZE, level).save(capture / "masks" / name)
    (first, *_) = problems(capture)
    assert first.severity == "error"
    assert first.what.startswith("1 mask cannot be used: photo00.png (its mask is entirely black")


def test_one_mask_that_hides_its_photo_is_spoken_of_in_the_singular(capture):
    (capture / "masks").mkdir()
    mask = np.zeros((SIZE[1], SIZE[0]), np.uint8)
    mask[:4] = 255
    Image.fromarray(mask).save(capture / "masks" / "photo02.png")
    assert "1 mask leaves less than 20% of its photo: photo02.png." in said(capture)


def test_a_lens_of_one_photo_is_counted_in_the_singular(tmp_path):
    facts = dict(facts_of(examine(path := write_capture(tmp_path / "one", count=1), sx.load_dataset(path))))
    assert facts["lens"].endswith("(1 photo)")


def test_files_among_photos_that_cannot_be_used_are_listed_with_the_reason(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for name in ("anim.gif", "sub/raw.dng", "walk.mp4", "IMG_1.HEIC", "notes.txt"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"x")
    Image.new("RGB", (64, 48), "gray").save(tmp_path / "a.jpg")
    found = examine(tmp_path, None)
    assert list(found.photos) == ["a.jpg"]
    listed = {problem.what: problem.fix for problem in problems_of(found) if "cannot be used" in problem.what}
    formats, video, heic = sorted(listed, reverse=True)
    assert formats.startswith("2 files cannot be used: anim.gif, sub/raw.dng (not a format")
    assert listed[formats] == "Save it as JPEG or PNG."
    assert video.startswith("1 file cannot be used: walk.mp4 (a video")
    assert heic == "1 file cannot be used: IMG_1.HEIC (reading HEIC needs another package)."
    assert "pip install '.[heic]'" in listed[heic]


def test_captures_without_points_are_told_how_to_start(tmp_path):
    found = problems(write_transforms(tmp_path / "capture"))
    (fix,) = (p.fix for p in found if p.what == "There are no points to start from.")
    assert "splatax train finds some in the photos" in fix
    assert "reconstruction.triangulated" in fix


def test_memory_that_is_not_there_is_an_error(capture, monkeypatch):
    monkeypatch.setattr("splatax.inspection.examination.available_memory", lambda: 10**8)
    assert re.match(r"Training needs about 0.\d GB, but 0.1 GB are free here", said(capture)[0])


def test_photos_are_looked_at_evenly_until_the_time_is_up(capture):
    names = [f"{i:03}" for i in range(100)]
    assert sorted(spread(names)) == names
    assert list(spread(names))[:7] == ["000", "016", "032", "048", "064", "080", "096"]
    paths = {name: capture / "images" / name for name in NAMES}
    assert looks_of(paths, 0.0) == {}
    assert list(looks_of(paths, 60.0)) == NAMES


def test_an_outlier_does_not_hide_itself():
    scores = robust_scores(np.array([1.0, 1.1, 0.9, 1.05, 0.95, 9.0]), 0.01)
    assert scores[-1] > 50
    assert np.abs(scores[:-1]).max() < 2


def test_the_page_needs_nothing_else_and_escapes_names(capture):
    evil = capture / "images" / "<script>alert(1)<.png"
    evil.write_bytes((capture / "images" / "photo00.png").read_bytes())
    found = examine(capture, sx.load_dataset(capture))
    page = capture_page(found, problems_of(found))
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)" in page
    assert set(re.findall(r'src="(.{5})', page)) == {"data:"}
    assert not re.findall(r'<link|url\(["\']?http|href="http', page)
    assert page.count("<figcaption><b>photo") == COUNT
    assert page.count('<img src="data:image/jpeg') == COUNT  # each photo with a pose is shown
    assert "All photos" not in page


def test_the_page_of_5000_photos_shows_those_with_problems_and_lists_all_below_20_mb(tmp_path):
    rng = np.random.default_rng(0)
    noise = [thumbnail(rng.integers(0, 256, (240, 240, 3), np.uint8)) for _ in range(2)]  # compresses worst
    names = [f"{i:04}.jpg" for i in range(5000)]
    looks = {name: Look(0.5, 0.0, 100.0, noise[i % 2]) for i, name in enumerate(names)}
    dark = names[7::625]  # more than the sentence lists
    looks |= {name: replace(looks[name], luminance=0.1) for name in dark}
    looks[names[99]] = Look(unreadable="no photo")
    found = Examination(tmp_path, None, dict.fromkeys(names, tmp_path), looks)
    page = capture_page(found, problems_of(found))
    assert len(page) < 20e6
    pictured = re.findall(r"<figcaption><b>(.*?)</b>", page)
    assert len(pictured) == MOST
    assert pictured[:9] == sorted([*dark, names[99]])
    gaps = np.diff([names.index(name) for name in pictured[9:]])
    assert gaps.min() > 0
    assert gaps.max() <= len(names) // MOST + 3  # between them lie photos with problems
    assert f"Pictures of {MOST} of 5000 photos" in page
    assert re.findall(r"<tr(?: class=\"bad\")?><td>(\d{4}\.jpg)", page) == names
    assert page.count('<tr class="bad">') == 9


def test_up_in_the_picture_is_where_photos_have_their_top():
    away_from = look_at(*(jnp.array(v) for v in ((0.0, 0.0, 4.0), (0.0, 0.0, 0.0), (0.0, 1.0, 0.0))))
    right, away, up = upright_frame([replace(camera_at(), cam_from_world=away_from)] * 3)
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(away, [0, 0, -1], atol=1e-6)
    np.testing.assert_allclose(right, [1, 0, 0], atol=1e-6)


def test_up_in_the_picture_is_that_of_trajectories_and_pages_where_cameras_are_tilted():
    # A quarter circle of level cameras that look down: the mean of their tops leans to one side.
    cameras = [camera_at((4 * np.sin(a), -5.0, 4 * np.cos(a))) for a in np.linspace(0, np.pi / 2, 7)]
    assert rig.tops_of(cameras).mean(axis=0) @ [0, -1, 0] < 0.8
    *ground, up = upright_frame(cameras)
    np.testing.assert_array_equal(up, rig.up_of(cameras))
    np.testing.assert_allclose(up, [0, -1, 0], atol=0.05)
    np.testing.assert_allclose(np.array(ground) @ up, 0, atol=1e-12)


def test_times_are_told_roughly():
    assert [roughly(s) for s in (10, 61, 1300, 6000)] == ["1 minute", "1 minute", "22 minutes", "1.7 hours"]


def test_photos_of_360_degrees_are_listed_and_those_that_may_be_some_are_asked_about(tmp_path):
    told = 'GPano:ProjectionType="equirectangular"'
    Image.new("RGB", (64, 32), "gray").save(tmp_path / "a.jpg", xmp=told.encode())
    Image.new("RGB", (64, 32), "gray").save(tmp_path / "b.jpg")
    Image.new("RGB", (64, 48), "gray").save(tmp_path / "c.jpg")
    found = examine(tmp_path, None)
    assert found.panoramas == ("a.jpg",)
    assert ("360 degrees", "1 photo, equirectangular") in facts_of(found)
    asked = [problem.what for problem in problems_of(found) if "360" in problem.what]
    assert asked == [
        "1 photo is twice as wide as high, like 360-degree photos, but their metadata do not say that they "
        "are: b.jpg."
    ]
