"""Work ahead of the caller: in order, not too far ahead, and with errors raised at their item."""

import time

import pytest

from splatax.ahead import in_order


def test_results_come_in_the_order_of_the_items_however_long_each_takes():
    def slow(i):
        time.sleep(0.01 * (i % 3))
        return i

    assert list(in_order(slow, range(12), 4)) == list(range(12))


def test_no_more_items_are_taken_than_threads_and_one_are_ahead():
    taken = []

    def items():
        for i in range(20):
            taken.append(i)
            yield i

    for i in in_order(lambda item: item, items(), 3):
        assert len(taken) <= i + 4


def test_an_error_is_raised_where_its_result_would_be():
    def fails(i):
        if i == 2:
            raise ValueError("two")
        return i

    results = in_order(fails, range(5), 3)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(results)
