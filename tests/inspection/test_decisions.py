"""Examination of the photos before training."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import splatax as sx
from scenes import camera_at
from splatax.inspection import decisions, examine, problems_of
from splatax.inspection.decisions import Sight, look_first
from splatax.inspection.looks import Look

PHOTOS = 18
CAMERA, BLACK = camera_at((0.0, 0.0, -4.0)), np.zeros((4, 4, 3), np.uint8)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """The synthetic still life, with its photos on disk."""
    folder = tmp_path_factory.mktemp("photos")
    dataset = sx.demo_dataset(photos=PHOTOS, width=96, height=72)
    for view in dataset.views:
        Image.fromarray(view.pixels()).save(folder / view.name)
    return replace(
        dataset,
        survey=replace(dataset.survey, files={view.name: folder / view.name for view in dataset.views}),
    )


def changed(dataset, folder, changes):
    """The capture with some of its photos changed, by name."""
    files = dict(dataset.survey.files)
    for name, change in changes.items():
        pixels = np.asarray(Image.open(files[name])).astype(float)
        files[name] = folder / name
        Image.fromarray(np.clip(np.round(change(pixels)), 0, 255).astype(np.uint8)).save(files[name])
    return replace(dataset, survey=replace(dataset.survey, files=files))


@pytest.mark.slow
def test_even_photos_need_nothing(plain):
    found = look_first(plain)
    assert found.seen == PHOTOS
    assert not found.blurred
    assert not found.repeated
    assert found.exposure < 0.05
    assert not found.uneven


@pytest.mark.slow
def test_exposure_that_differs_is_measured_in_stops_whatever_the_photos_show(plain, tmp_path):
    stops = np.random.default_rng(0).normal(0, 0.25, PHOTOS)
    stops -= stops.mean()
    brighter = {
        view.name: lambda pixels, by=by: pixels * 2.0**by for view, by in zip(plain.views, stops, strict=True)
    }
    found = look_first(changed(plain, tmp_path, brighter))
    assert found.uneven
    assert found.exposure == pytest.approx(stops.std(), rel=0.2)


def test_blurred_photos_are_left_out_unless_there_are_few(plain, tmp_path, monkeypatch):
    names = [plain.train[2].name, plain.test[1].name]
    blurred = changed(plain, tmp_path, dict.fromkeys(names, lambda p: ndimage.gaussian_filter(p, (3, 3, 0))))
    monkeypatch.setattr(decisions, "FEW", 10)
    found = look_first(blurred)
    assert (found.blurred, found.kept) == ((names[0],), ())  # a held-out one is not trained on anyway
    monkeypatch.setattr(decisions, "FEW", PHOTOS)
    found = look_first(blurred)
    assert (found.blurred, found.kept) == ((), (names[0],))


def test_the_least_blurred_photos_above_a_fifth_are_kept_and_named():
    levels = {f"{i:02}.jpg": 100.0 + i for i in range(16)} | {f"{i:02}.jpg": 2.0 + i for i in range(16, 20)}
    levels["20.jpg"] = 1.0
    sights = [
        Sight(sx.View(name, CAMERA, lambda: BLACK), Look(sharpness=level), np.zeros((24, 32)), np.zeros(0))
        for name, level in levels.items()
    ]
    spared, kept = decisions.blurred_of(sights, set(levels))
    assert spared == ("16.jpg", "17.jpg", "18.jpg", "20.jpg")
    assert kept == ("19.jpg",)


def test_inspection_and_training_call_the_same_photos_blurred(plain, tmp_path):
    names = [plain.train[2].name, plain.train[9].name, plain.test[1].name]
    blurred = changed(plain, tmp_path, dict.fromkeys(names, lambda p: ndimage.gaussian_filter(p, (2, 2, 0))))
    (problem,) = (each for each in problems_of(examine(tmp_path, blurred)) if "blurred" in each.what)
    assert problem.photos == tuple(sorted(names))
    found = look_first(blurred)
    assert sorted(found.blurred + found.kept) == sorted(names[:2])  # a held-out one is not trained on


def test_photos_that_there_is_no_time_for_are_counted(plain, monkeypatch):
    found = look_first(plain)
    assert (found.seen, found.photos) == (PHOTOS, PHOTOS)
    monkeypatch.setattr(decisions, "LOOKING", 0.0)
    found = look_first(plain)
    assert (found.seen, found.photos) == (0, PHOTOS)


def test_photos_that_repeat_another_are_left_out_above_all_those_of_held_out_ones(plain):
    kept, held_out = plain.train[3], plain.test[1]
    files = plain.survey.files
    files = files | {"z1.png": files[kept.name], "a.png": files[held_out.name]}
    again = replace(kept, name="z1.png"), replace(held_out, name="a.png")
    twice = replace(plain, train=(*plain.train, *again), survey=replace(plain.survey, files=files))
    assert look_first(twice).repeated == {"z1.png": kept.name, "a.png": held_out.name}


def test_the_same_colours_from_another_place_are_no_repetition(plain, tmp_path):
    grey = changed(plain, tmp_path, {view.name: lambda pixels: 0 * pixels + 90 for view in plain.views})
    assert not look_first(grey).repeated


def test_a_face_without_detail_does_not_make_a_panorama_blurred():
    rng = np.random.default_rng(0)

    def sight(photo, face, sharpness):
        view = sx.View(f"{photo}-{face}", CAMERA, lambda: BLACK, face_of=photo)
        return Sight(view, Look(sharpness=sharpness), np.zeros((24, 32)), np.zeros(0))

    sharp = [
        sight(f"{photo:02}.jpg", face, 0.1 if face == "up" else rng.uniform(90, 110))
        for photo in range(PHOTOS)
        for face in ("front", "right", "back", "left", "up", "down")
    ]
    training = {each.view.name for each in sharp}
    assert decisions.blurred_of(sharp, training) == ((), ())
    blurred = [
        replace(each, look=Look(sharpness=2.0)) if each.view.photo == "05.jpg" else each for each in sharp
    ]
    assert decisions.blurred_of(blurred, training) == (("05.jpg",), ())


def test_a_panorama_repeats_another_only_if_all_of_its_faces_do():
    sights = [
        Sight(
            sx.View(f"{photo}-{face}", CAMERA, lambda: BLACK, face_of=photo),
            Look(),
            np.zeros((24, 32)),
            np.zeros(0),
        )
        for photo in ("a", "b", "c")
        for face in ("front", "back")
    ]
    repeated = {"b-front": "a-front", "b-back": "a-back", "c-front": "a-front"}
    assert decisions.repeated_photos(sights, repeated) == {"b": "a"}
