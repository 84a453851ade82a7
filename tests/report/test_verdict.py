"""The verdict of a report: causes of bad photos, and places for the next ones."""

import re
from dataclasses import replace

import numpy as np
import pytest

import splatax as sx
from report.galleries import gallery_of
from splatax.evaluation import ViewScore
from splatax.report.next_photos import ISOLATED, spacings, spots_of
from splatax.report.page import Account, report
from splatax.report.plan import places
from splatax.report.verdict import verdict_of
from splatax.runs.history import History
from splatax.runs.results import Comparison

NOISE = np.random.default_rng(0).integers(0, 255, (36, 48, 3)).astype(np.uint8)


@pytest.fixture(scope="module")
def dataset():
    """24 photos all around a toy, of which three are held out."""
    return sx.demo_dataset(photos=24, width=48, height=36, scene="object")


def judged(dataset, psnrs, gain=0.2, images=None):
    """The verdict on held-out photos with the given scores."""
    comparisons = [
        Comparison(ViewScore(view.name, psnr, 0.9, psnr + gain), NOISE, (images or {}).get(view.name, NOISE))
        for view, psnr in zip(dataset.test, psnrs, strict=True)
    ]
    return verdict_of(dataset, gallery_of(comparisons).judged, unseen=True)


def test_a_good_scene_is_called_good_and_nothing_is_bad(dataset):
    verdict = judged(dataset, [33.0, 34.0, 35.0])
    assert verdict.headline == (
        "From the viewpoints of photos that it was not trained on, the scene is nearly the same as the photo."
    )
    assert verdict.good[0] == "3 of 3 photos that it was not trained on are matched well; best: view16.png."
    assert not verdict.bad


def test_a_scene_that_is_evenly_poor_is_not_called_faultless(dataset):
    verdict = judged(dataset, [24.0, 24.5, 25.0])
    assert [each.what for each in verdict.bad] == ["No photo is matched well."]


def test_photos_that_counted_little_are_named(dataset):
    comparisons = [Comparison(ViewScore(view.name, 33.0, 0.9, 33.0), NOISE, NOISE) for view in dataset.test]
    doubted = {"view03.png": 0.5, "view11.png": 0.02}
    (complaint,) = verdict_of(dataset, gallery_of(comparisons).judged, True, doubted).bad
    assert complaint.what == "view11.png, view03.png do not fit the other photos."
    assert "the weight was lowered: to 0.02" in complaint.why


def test_few_panoramas_are_not_to_be_taken_around_a_subject(dataset):
    few = replace(dataset, train=dataset.train[:3])
    faces = replace(few, train=tuple(replace(view, face_of="a") for view in few.train))
    around, anywhere = (judged(each, [33.0, 34.0, 35.0]).bad[-1] for each in (few, faces))
    assert (around.what, anywhere.what) == ("There are only 6 photos.", "There are only 4 photos.")
    assert "around the subject" in around.fix
    assert "from other viewpoints" in anywhere.fix


def test_the_faces_of_a_panorama_are_judged_as_one_photo(dataset):
    faces = {"view00.png": "a", "view08.png": "a"}
    whole = tuple(replace(view, face_of=faces.get(view.name)) for view in dataset.test)
    gallery = gallery_of(
        Comparison(ViewScore(view.name, psnr, 0.9, psnr), NOISE, NOISE)
        for view, psnr in zip(whole, [15.0, 15.0, 33.0], strict=True)
    )
    in_faces = replace(dataset, test=whole)
    gallery.join_faces(in_faces.views)
    verdict = verdict_of(in_faces, gallery.judged, unseen=True)
    assert [score.name for score in gallery.scores] == ["a", "view16.png"]
    assert verdict.matched == {"a": False, "view16.png": True}
    assert verdict.bad[0].what == "a is clearly different from the photo."


def test_a_photo_of_another_brightness_is_blamed_on_exposure(dataset):
    verdict = judged(dataset, [21.0, 28.0, 28.0], gain=5.0)
    assert verdict.bad[0].what.startswith("view00.png is clearly different from the photo")
    assert verdict.bad[0].why.startswith("Exposure")


def test_a_photo_with_badly_placed_points_is_blamed_on_poses(dataset):
    errors = {view.name: np.full(30, 0.4) for view in dataset.views} | {"view08.png": np.full(30, 5.0)}
    surveyed = replace(dataset, survey=replace(dataset.survey, errors=errors))
    verdict = judged(surveyed, [30.0, 18.0, 30.0])
    assert verdict.bad[0].why.startswith("Poses")


def test_an_error_in_one_place_is_blamed_on_what_is_there(dataset):
    moved = NOISE.copy()
    moved[:6, :6] = 255 - moved[:6, :6]
    verdict = judged(dataset, [18.0, 30.0, 30.0], images={"view00.png": moved})
    assert "in one small part of the picture" in verdict.bad[0].why


def azimuth(view):
    x, y, _ = np.asarray(view.camera.position)
    return np.degrees(np.arctan2(y, x))


def test_a_picture_without_contrast_is_called_hazy(dataset):
    fog = (0.3 * NOISE + 90).astype(np.uint8)
    verdict = judged(dataset, [15.0, 30.0, 30.0], gain=3.0, images={"view00.png": fog})
    assert verdict.bad[0].why.startswith("Haze")


def without_sector(dataset, low, high):
    """The capture without photos whose azimuth around the z axis is between two angles, degrees."""

    def outside(view):
        return not low < azimuth(view) < high

    return replace(
        dataset, train=tuple(filter(outside, dataset.train)), test=tuple(filter(outside, dataset.test))
    )


def test_the_next_photos_are_taken_where_a_sector_is_missing(dataset):
    (spot,) = spots_of(without_sector(dataset, -40, 40), [])
    assert spot.gap
    x, y, _ = spot.position
    assert abs(np.degrees(np.arctan2(y, x))) < 15  # photos are 15 degrees apart
    assert np.hypot(x, y) == pytest.approx(2.2, abs=0.4)  # as far from the toy as the others
    assert not spots_of(dataset, [])


def test_photos_from_one_height_are_told_to_go_around_higher(dataset):
    level = [view for i, view in enumerate(dataset.views) if i % 3 == 0]
    (spot,) = spots_of(replace(dataset, train=tuple(level), test=()), [])
    assert "from one height" in spot.why


def test_a_photo_far_from_the_others_is_told_so(dataset):
    alone = without_sector(dataset, 10, 100)
    lost = [view for view in dataset.views if view not in alone.views]
    middle = min(lost, key=lambda view: abs(azimuth(view) - 55))
    assert spacings(replace(alone, test=(middle,)))[middle.name] > ISOLATED
    assert spacings(dataset)[middle.name] < ISOLATED


def test_the_report_begins_with_words_and_ends_with_numbers(dataset):
    verdict = judged(
        without_sector(dataset, -40, 40), [18.0, 30.0, 30.0][: len(without_sector(dataset, -40, 40).test)]
    )
    picture = places(dataset, verdict.matched, verdict.spots)
    history = History(losses=[0.5, 0.4], counts=[10, 12])
    account = Account({"PSNR": "26 dB"}, ["24 photos"], verdict, picture)
    page = report("a scene", account, history, gallery_of([]), b"")
    heads = re.findall(r"<h2>(.*?)</h2>", page)
    assert heads == [
        "What is good",
        "What is bad, and why",
        "Where the photos were taken",
        "Numbers",
        "Curves",
        "Views, worst first",
    ]
    assert set(re.findall(r'src="(.{5})', page)) == {"data:"}
    assert page.index(verdict.headline) < page.index("26 dB")
