"""The pages of `train` and `inspect` on the screen of a phone."""

from dataclasses import replace

import numpy as np
import pytest

import splatax as sx
from captures import model_of, pinhole, write_photos
from report.galleries import gallery_of
from splatax.evaluation import ViewScore
from splatax.inspection import examine, problems_of
from splatax.report.capture import capture_page
from splatax.report.page import Account, report
from splatax.report.pictures import data_uri
from splatax.report.verdict import verdict_of
from splatax.runs.history import History
from splatax.runs.results import Comparison

pytestmark = pytest.mark.slow
PHONE = (390, 844)  # CSS pixels of common phones, held upright
LONG = "PXL_20261122_143501123_MOTION_front_of_the_old_railway_station_"  # without a place to break it
PICTURE = np.random.default_rng(0).integers(0, 255, (300, 800, 3)).astype(np.uint8)  # wider than the screen
OUTSIDE = """[...document.querySelectorAll('body *')]
    .filter(each => each.getBoundingClientRect().right > innerWidth && !each.closest('.wide'))
    .map(each => `${each.tagName} ${each.textContent.trim().slice(0, 40)}`)"""


def require_no_sideways_scroll(open_page, path, html):
    path.write_text(html)
    tab = open_page(path, PHONE)
    outside = tab.tell(OUTSIDE)
    assert tab.tell("document.documentElement.scrollWidth") <= PHONE[0], outside
    assert tab.errors == []


def test_a_report_is_read_on_a_phone_without_scrolling_sideways(open_page, tmp_path):
    drawn = sx.demo_dataset(photos=24, width=48, height=36)
    named = {
        split: tuple(replace(view, name=LONG + view.name) for view in getattr(drawn, split))
        for split in ("train", "test")
    }
    dataset = replace(drawn, **named)
    comparisons = [
        Comparison(ViewScore(view.name, psnr, 0.9, psnr + 0.2), PICTURE, PICTURE)
        for view, psnr in zip(dataset.test, [14.0, 26.0, 33.0], strict=True)
    ]
    gallery = gallery_of(comparisons, most=2)  # so that there is a table of all views
    verdict = verdict_of(dataset, gallery.judged, unseen=True)
    assert verdict.bad
    account = Account(
        {"PSNR of 3 held-out photos": "24.33 dB", "training": "6:00 min", "Gaussians": "106,231"},
        [f"held out: {LONG}00.png", "1,234 points; photos 48 x 36 from images/"],
        verdict,
        data_uri(PICTURE),
        gallery.judged,
    )
    history = History(losses=[0.5, 0.4, 0.3], counts=[10, 10, 12], train_seconds=1.5)
    html = report(f"{LONG}title", account, history, gallery, b"")
    assert '<table class="scores">' in html
    require_no_sideways_scroll(open_page, tmp_path / "report.html", html)


def test_the_page_of_inspect_is_read_on_a_phone_without_scrolling_sideways(open_page, tmp_path):
    capture, names = tmp_path / f"{LONG}capture", [f"{LONG}{i:02}.png" for i in range(9)]
    sparse = capture / "sparse" / "0"
    sparse.mkdir(parents=True)
    model_of(names, pinhole()).write_binary(sparse)
    write_photos(capture / "images", [*names, f"{LONG}without_a_pose.png"])
    found = examine(capture, sx.load_dataset(capture))
    problems = problems_of(found)
    assert any(LONG in problem.what for problem in problems)
    require_no_sideways_scroll(open_page, tmp_path / "inspect.html", capture_page(found, problems))
