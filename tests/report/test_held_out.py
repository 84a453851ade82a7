"""The photos that a trial run held out, as the report of another run quotes them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

import splatax as sx
from captures import write_capture
from report.galleries import gallery_of
from splatax.errors import FormatError
from splatax.evaluation import Scores, ViewScore
from splatax.report import held_out
from splatax.report.gallery import symptoms_of
from splatax.report.page import Account, report
from splatax.report.training import corrected
from splatax.report.verdict import verdict_of
from splatax.runs.finished import FinishedRun
from splatax.runs.history import History
from splatax.runs.results import Comparison, scores_as_json

NOISE = np.random.default_rng(0).integers(0, 255, (36, 48, 3)).astype(np.uint8)
SMOOTH = (np.linspace(20, 200, 48)[None, :, None] + np.zeros((36, 48, 3))).astype(np.uint8)
FOG = (0.3 * NOISE + 90).astype(np.uint8)


@pytest.fixture(scope="module")
def dataset():
    """40 photos all around a toy, all of them training photos."""
    split = sx.demo_dataset(photos=40, width=48, height=36, scene="object")
    return replace(split, train=split.views, test=())


@pytest.fixture
def trial(tmp_path):
    """Makes the folder of a trial run which held out five photos, the first of which is bad."""

    def made(photo=NOISE, image=NOISE, keeps=True, steps=3000):
        others = [
            Comparison(ViewScore(f"view{i:02}.png", 30.0, 0.9, 30.1), NOISE, NOISE) for i in range(1, 5)
        ]
        bad = Comparison(ViewScore("view00.png", 18.0, 0.5, 18.2), photo, image)
        gallery = gallery_of([bad, *others])
        if keeps:
            (tmp_path / held_out.NAME).write_bytes(held_out.stored(gallery.judged))
        scores = json.loads(json.dumps(scores_as_json(Scores(tuple(gallery.scores)))))
        return FinishedRun("trial", tmp_path, {}, {"test": scores, "steps": steps})

    return made


def moved():
    picture = NOISE.copy()
    picture[:6, :6] = 255 - picture[:6, :6]
    return picture


@pytest.mark.parametrize(
    ("photo", "image", "why"),
    [
        (NOISE, FOG, "Haze"),
        (NOISE, moved(), "Most of the error is in one small part"),
        (NOISE, 255 - NOISE, "The error is spread over the picture"),
    ],
)
def test_the_cause_is_that_of_the_pictures_of_the_trial(dataset, trial, photo, image, why):
    verdict = verdict_of(dataset, held_out.quoted(trial(photo, image)), unseen=True)
    assert verdict.bad[0].what == "view00.png is clearly different from the photo."
    assert verdict.bad[0].why.startswith(why)


def test_the_cause_is_motion_if_the_photo_is_blurred_compared_with_the_others(tmp_path):
    capture = write_capture(tmp_path / "capture", count=24)
    for path in sorted((capture / "images").iterdir()):
        blur = 2.0 if path.name == "photo00.png" else 1.0
        smooth = ndimage.gaussian_filter(np.random.default_rng(0).normal(size=(48, 64)), blur)
        grey = (128 + 200 * smooth).clip(0, 255).astype(np.uint8)
        Image.fromarray(np.repeat(grey[..., None], 3, axis=2)).save(path)
    photos = sx.load_dataset(capture)
    photos = replace(photos, train=photos.views, test=())
    for name, is_blurred in (("photo00.png", True), ("photo01.png", False)):
        score = ViewScore(name, 18.0, 0.5, 18.2)
        seen = gallery_of([Comparison(score, NOISE, 255 - NOISE)]).judged
        others = [ViewScore(f"photo{i:02}.png", 30.0, 0.9, 30.1) for i in range(2, 24)]
        verdict = verdict_of(photos, replace(seen, scores=(score, *others)), unseen=True)
        assert verdict.bad[0].why.startswith("Motion" if is_blurred else "The error is spread")


def test_a_trial_of_few_steps_is_the_cause_of_missing_detail(dataset, trial):
    verdict = verdict_of(dataset, held_out.quoted(trial(NOISE, 255 - NOISE, steps=40)), unseen=True)
    assert "made only 40 steps" in verdict.bad[0].why


def test_without_pictures_no_cause_is_named(dataset, trial):
    verdict = verdict_of(dataset, held_out.quoted(trial(keeps=False)), unseen=True)
    assert verdict.bad[0].what == "view00.png is clearly different from the photo."
    assert verdict.bad[0].why == ""


def test_the_report_shows_the_accused_photo_and_the_best_of_the_trial(dataset, trial):
    judged = held_out.quoted(trial(SMOOTH, FOG))
    verdict = verdict_of(dataset, judged, unseen=True)
    training = gallery_of([Comparison(ViewScore("view39.png", 35.0, 0.9, 35.0), NOISE, NOISE)])
    page = report(
        "a scene",
        Account({}, verdict=verdict, judged=judged),
        History(losses=[0.5], counts=[10]),
        training,
        b"",
    )
    opening = page[: page.index("<h2>Numbers</h2>")]
    accused = judged.pictures["view00.png"]
    assert opening.index(verdict.bad[0].what) < opening.index(accused.photo) < opening.index(accused.image)
    assert opening.count(accused.photo) == 1
    assert judged.best.photo in opening
    assert "view39.png" not in opening


def test_only_the_worst_pictures_are_kept_and_what_is_read_is_what_was_seen(trial):
    comparisons = [Comparison(ViewScore(f"{i}.png", 20.0 + i, 0.9, 21.0 + i), NOISE, NOISE) for i in range(9)]
    seen = gallery_of(comparisons).judged
    run = trial()
    (run.folder / held_out.NAME).write_bytes(held_out.stored(seen))
    read = held_out.quoted(run)
    assert list(read.pictures) == [f"{i}.png" for i in range(held_out.MOST)]
    assert read.symptoms == seen.symptoms
    assert read.best == replace(seen.best, error="")


def test_a_file_of_the_version_before_is_read(trial):
    run = trial()
    path = run.folder / held_out.NAME
    contents = json.loads(path.read_text())
    for each in contents["symptoms"].values():
        each["sharpness"] = 3.5
    path.write_text(json.dumps(contents))
    assert held_out.quoted(run).symptoms == held_out.quoted(trial()).symptoms


def test_a_perfect_score_is_read_as_such(trial):
    run = trial()
    run.metrics["test"]["views"][1] |= {"psnr": None, "corrected_psnr": None}
    assert held_out.quoted(run).scores[1].psnr == np.inf


@pytest.mark.parametrize(
    "contents", ["[]", "{}", '{"symptoms": {"a": {"hazy": 3}}, "pictures": {}, "best": null}']
)
def test_a_damaged_file_is_named(trial, contents):
    run = trial()
    (run.folder / held_out.NAME).write_text(contents)
    with pytest.raises(FormatError, match=r"held_out.json: damaged .* Delete it"):
        held_out.quoted(run)


def test_where_exposure_is_learned_a_photo_of_another_exposure_is_not_bad(dataset):
    scores = [(f"view{i:02}.png", 30.0 + i, 30.0 + i) for i in range(4)]
    gallery = gallery_of(
        Comparison(ViewScore(name, psnr, 0.9, after), NOISE, NOISE)
        for name, psnr, after in [*scores, ("view09.png", 17.0, 34.0)]
    )
    for compensates, judged in ((False, gallery.judged), (True, corrected(gallery.judged))):
        verdict = verdict_of(dataset, judged, unseen=True)
        assert bool(verdict.bad) is not compensates
        assert bool(verdict.remark) is compensates
        assert judged.best.score.name == ("view09.png" if compensates else "view03.png")


def test_a_darker_picture_is_not_hazy():
    dark = (0.5 * NOISE).astype(np.uint8)
    score = ViewScore("a", 15.0, 0.9, 40.0)
    assert not symptoms_of(Comparison(score, NOISE, dark)).hazy
    assert symptoms_of(Comparison(score, NOISE, FOG)).hazy
