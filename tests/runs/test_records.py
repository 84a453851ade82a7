"""Records that were edited or truncated give one sentence."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import pytest

from splatax.errors import FormatError
from splatax.runs.records import read_record, typed_fields, understood


@dataclass
class Settings:
    count: int
    rate: float
    name: Literal["a", "b"] | None
    place: Path
    size: Literal["auto"] | int


GOOD = {"count": 3, "rate": 2, "name": None, "place": "/x", "size": 4}


def test_values_get_the_types_of_their_fields():
    assert Settings(**typed_fields(Settings, GOOD)) == Settings(3, 2.0, None, Path("/x"), 4)


@pytest.mark.parametrize(
    "wrong",
    [
        {"count": "3"},
        {"count": True},
        {"rate": None},
        {"rate": [1]},
        {"name": "c"},
        {"name": []},
        {"place": 5},
        {"size": "large"},
        {"size": {}},
    ],
)
def test_values_of_another_type_are_refused(wrong):
    (name,) = wrong
    with pytest.raises(TypeError, match=name):
        typed_fields(Settings, GOOD | wrong)


@pytest.mark.parametrize("contents", [b"", b"{", b"[]", b"3", b"\xff\xfe", b"[" * 100_000, b'{"a": 1} {'])
def test_what_is_no_json_object_is_refused_with_the_way_out(contents, tmp_path):
    path = tmp_path / "config.json"
    path.write_bytes(contents)
    with pytest.raises(FormatError) as refused:
        read_record(path, "Train again.")
    assert str(refused.value).startswith(f"{path}: damaged (")
    assert str(refused.value).endswith(". Train again.")
    assert "\n" not in str(refused.value)


def test_errors_of_the_file_system_are_not_the_records(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_record(tmp_path / "none.json", "")
    with pytest.raises(FormatError, match="no 'x' in it"), understood(tmp_path, ""):
        {}["x"]
