"""Photos are kept on disk only if memory is short, in a folder that the user can choose, limit and clear."""

import numpy as np
import pytest

import splatax as sx
from captures import write_capture
from splatax import cli
from splatax.errors import InputError
from splatax.runs.keeping import PLACE, SIZE, user_store, with_photos_kept
from splatax.runs.planning import Room


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.setenv(PLACE, str(tmp_path / "kept"))
    monkeypatch.delenv(SIZE, raising=False)
    return tmp_path / "kept" / "splatax" / "photos"


@pytest.fixture
def dataset(tmp_path):
    return sx.load_dataset(write_capture(tmp_path / "capture"))


def test_photos_that_fit_in_memory_are_not_kept_on_disk(place, dataset):
    assert with_photos_kept(dataset, Room()) == (dataset, "")
    assert not place.exists()


def test_photos_that_do_not_fit_are_kept_and_can_be_removed(place, dataset, capsys):
    kept, line = with_photos_kept(dataset, Room(photos=0.0))
    assert "8 of 8 are kept decoded on disk" in line
    for ours, theirs in zip(kept.train, dataset.train, strict=True):
        np.testing.assert_array_equal(ours.pixels(), theirs.pixels())
    assert len(list(place.iterdir())) == 8
    assert kept.test == dataset.test
    cli.main(["cache"])
    assert str(place) in capsys.readouterr().out.replace("\n", "")
    cli.main(["cache", "--clear"])
    assert not list(place.iterdir())


def test_files_of_the_user_in_the_chosen_folder_are_never_removed(place, dataset, tmp_path):
    own = tmp_path / "kept" / "own.npy"
    own.parent.mkdir()
    own.write_bytes(b"mine")
    with_photos_kept(dataset, Room(photos=0.0))
    cli.main(["cache", "--clear"])
    assert own.read_bytes() == b"mine"


def test_a_folder_that_cannot_be_made_is_named_and_training_goes_on(place, dataset, tmp_path):
    (tmp_path / "kept").write_bytes(b"")
    same, line = with_photos_kept(dataset, Room(photos=0.0))
    assert same is dataset
    assert str(place) in line
    assert "decoded again for each step" in line
    assert PLACE in line


def test_a_size_of_zero_keeps_nothing_and_says_so(place, dataset, monkeypatch):
    monkeypatch.setenv(SIZE, "0")
    same, line = with_photos_kept(dataset, Room(photos=0.0))
    assert same is dataset
    assert f"{SIZE} is 0" in line
    assert not place.exists()


def test_a_size_that_is_none_is_refused_by_its_name(place, monkeypatch):
    monkeypatch.setenv(SIZE, "plenty")
    with pytest.raises(InputError, match=f"{SIZE}=plenty"):
        user_store()
