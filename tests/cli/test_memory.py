"""Runs with a limit of memory."""

import json
import math
import re

import pytest

import splatax as sx
from splatax import cli
from splatax.cli import planning
from splatax.cli.settings import Settings
from splatax.errors import InputError
from splatax.runs.budget import Cost, Costs, parse_bytes
from splatax.runs.forecast import memory
from splatax.runs.planning import Room, room_within
from splatax.training.recipes import room_for
from training.test_training import SIZE
from training.test_training import capture as made


def test_sizes_are_read_with_their_units():
    assert [parse_bytes(text) for text in ("4GB", "800 mb", "2GiB", "1.5gb", "5")] == [
        4_000_000_000,
        800_000_000,
        2**31,
        1_500_000_000,
        5,
    ]


@pytest.mark.parametrize("text", ["", "GB", "-4GB", "0MB", "4 elephants"])
def test_what_is_no_size_is_refused(text):
    with pytest.raises(ValueError, match="a size such as 4GB"):
        parse_bytes(text)


def test_the_room_is_as_large_as_the_limit_but_not_larger():
    room = room_within(2_000_000_000, made(), first=100)
    photos = 3 * SIZE[0] * SIZE[1] * len(made().train)
    assert room.photos == photos
    least, more = (memory(n, *SIZE, photos) + room.decoding for n in (room.gaussians, room.gaussians + 2))
    assert least <= 2_000_000_000 < more


def test_more_photos_in_a_step_leave_room_for_fewer_gaussians(capture, tmp_path, capsys):
    one, eight = (room_within(2_000_000_000, made(), first=100, views=views) for views in (1, 8))
    assert eight.gaussians < one.gaussians
    options = ["--memory", "2GB", "--views", "8", "--max-gaussians", str(eight.gaussians * 11 // 10)]
    with pytest.raises(SystemExit):
        cli.main(["train", str(capture), "--out", str(tmp_path / "run"), *options])
    assert "--memory 2GB has room for" in capsys.readouterr().err
    with pytest.raises(InputError, match="smaller, or use fewer photos in a step") as refusal:
        room_within(100_000_000, made(), first=100, views=8)
    assert refusal.value.options == ("memory", "downscale", "views")


@pytest.mark.parametrize(("gaussians", "expected"), [(math.inf, 2), (1, 1)])
def test_a_long_run_grows_to_twice_the_usual_gaussians_if_they_fit(capture, monkeypatch, gaussians, expected):
    dataset = made()
    monkeypatch.setattr(planning, "measured", lambda *_: Costs(Cost(1e-3, 0.0), Cost(1e-3, 0.0)))
    room = Room(gaussians * room_for(dataset))
    settings, _, _ = planning.planned(Settings(capture, budget="10min"), dataset, room)
    assert settings.max_gaussians == expected * room_for(dataset)


def test_a_run_that_would_over_fit_ends_before_its_time_and_says_so(capture, monkeypatch, capsys):
    dataset = made()
    monkeypatch.setattr(planning, "measured", lambda *_: Costs(Cost(1e-3, 0.0), Cost(1e-3, 0.0)))
    settings, _, _ = planning.planned(Settings(capture, budget="10min"), dataset, Room())
    assert settings.steps == 500 * len(dataset.train)
    told = capsys.readouterr().out
    assert "more than 500 steps for each photo over-fit, so the run ends before its time" in told
    assert "10:00 min" not in told
    planning.planned(Settings(capture, budget="1s"), dataset, Room())
    assert "over-fit" not in capsys.readouterr().out


def test_a_limit_that_the_start_exceeds_is_refused_with_the_numbers(capture, tmp_path, capsys):
    with pytest.raises(SystemExit):
        cli.main(["train", str(capture), "--out", str(tmp_path / "run"), "--memory", "100MB"])
    assert re.search(r"start alone takes about 0\.\d\d GB, with 30 Gaussians", capsys.readouterr().err)


def test_more_gaussians_than_there_is_room_for_are_refused_with_the_numbers(capture, tmp_path, capsys):
    options = ["--memory", "700MB", "--max-gaussians", "1000000"]
    with pytest.raises(SystemExit):
        cli.main(["train", str(capture), "--out", str(tmp_path / "run"), *options])
    assert "--max-gaussians 1000000: --memory 700MB has room for" in capsys.readouterr().err


def test_a_start_with_more_gaussians_than_were_asked_for_is_said(capture, tmp_path, capsys):
    run = tmp_path / "run"
    cli.main(["train", str(capture), "--out", str(run), "--steps", "2", "--max-gaussians", "7"])
    assert "about 30 Gaussians, more than --max-gaussians 7, so it does not grow" in capsys.readouterr().out
    assert len(sx.load(run / "scene.ply")) <= 30


@pytest.mark.parametrize("recipe", ["default", "classic"])
def test_a_limit_lowers_the_number_of_gaussians_and_is_written_down(recipe, capture, tmp_path, monkeypatch):
    monkeypatch.setattr("splatax.runs.forecast.most_gaussians", lambda *_, **__: 37)
    options = ["--memory", "4GB", "--steps", "30", "--recipe", recipe]
    cli.main(["train", str(capture), "--out", str(tmp_path), *options])
    config = json.loads((tmp_path / "config.json").read_text())
    assert config["options"]["max_gaussians"] == 37
    assert len(sx.load(tmp_path / "scene.ply")) <= 37
