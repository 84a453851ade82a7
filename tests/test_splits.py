"""Rules that choose the held-out photos."""

import pytest

from splatax.errors import InputError
from splatax.splits import Every, Last, Listed, Nothing, parse_hold_out

NAMES = [f"{i:02}.jpg" for i in range(1, 21)]


@pytest.mark.parametrize("count", [1, 2, 5, 6, 12, 13, 14, 20])
def test_neither_the_first_nor_the_last_photo_of_a_path_is_held_out_by_default(count):
    names = NAMES[:count]
    chosen = Every().of(names)
    assert not {names[0], names[-1]} & set(chosen)
    assert len(chosen) == {1: 0, 2: 0, 5: 0, 6: 1, 12: 1, 13: 1, 14: 2, 20: 2}[count]


@pytest.mark.parametrize(
    ("text", "rule", "held_out"),
    [
        ("every:8", Every(), ("05.jpg", "13.jpg")),
        ("every:8:1", Every(8, 1), ("01.jpg", "09.jpg", "17.jpg")),  # the rule of published results
        ("every:2", Every(2), tuple(NAMES[1:-1:2])),
        ("last", Last(), ("20.jpg",)),
        ("last:2", Last(2), ("19.jpg", "20.jpg")),
        ("none", Nothing(), ()),
        ("03.jpg, 04", Listed(("03.jpg", "04")), ("03.jpg", "04.jpg")),
    ],
)
def test_a_rule_is_what_its_text_says(text, rule, held_out):
    assert parse_hold_out(text) == rule
    assert rule.of(NAMES) == held_out


def test_a_list_may_be_a_file_with_one_name_a_line(tmp_path):
    path = tmp_path / "held.txt"
    path.write_text("a, with a comma.jpg\n\n02\n")
    rule = parse_hold_out(str(path))
    assert rule == Listed(("a, with a comma.jpg", "02"), str(path))
    with pytest.raises(InputError, match=r"held.txt names a, with a comma.jpg, but the capture has no such"):
        rule.of(NAMES)
    with pytest.raises(InputError, match=r"none.txt: the list of photos cannot be read \(No such file"):
        parse_hold_out(str(tmp_path / "none.txt"))


@pytest.mark.parametrize("text", ["", "every:1", "last:0", "every:8:0", ","])
def test_a_text_that_is_no_rule_is_refused_with_those_that_are(text):
    with pytest.raises(ValueError, match='"every:N", "every:N:FIRST", "last"'):
        parse_hold_out(text)


def test_a_name_without_suffix_that_two_photos_share_means_none_of_them():
    with pytest.raises(InputError, match="the list names a, but"):
        Listed(("a",)).of(["a.jpg", "a.png"])
