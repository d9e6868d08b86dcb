"""The histogram of times, against the sorted list that it stands for."""

from __future__ import annotations

from math import ceil

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.arbiter.counters import BATCH, Histogram

TIMES = st.lists(st.just(0.0) | st.floats(1e-9, 1e6), min_size=1, max_size=3 * BATCH)


def histogram_of(times: list[float]) -> Histogram:
    histogram = Histogram()
    for time in times:
        histogram.record(time)
    return histogram


@given(TIMES, st.floats(0.001, 1.0))
def test_a_quantile_is_at_most_a_sixteenth_above_the_true_one_and_never_below(times: list[float], q: float) -> None:
    true = sorted(times)[ceil(q * len(times)) - 1]
    assert true <= histogram_of(times).quantile(q) <= true * (1 + 1 / 16)


@given(TIMES)
def test_count_sum_and_highest_are_exact_whenever_they_are_asked(times: list[float]) -> None:
    histogram = Histogram()
    for number, time in enumerate(times, 1):
        histogram.record(time)
        if number % 7 == 0:
            assert histogram.count == number
    assert histogram.count == len(times)
    assert histogram.total == pytest.approx(sum(times))
    assert histogram.mean == pytest.approx(sum(times) / len(times))
    assert histogram.highest == max(times)


@given(TIMES)
def test_the_buckets_hold_everything_once_and_ascend(times: list[float]) -> None:
    buckets = histogram_of(times).buckets()
    assert sum(count for _, count in buckets) == len(times)
    edges = [edge for edge, _ in buckets]
    assert edges == sorted(set(edges))
    below = 0
    for edge, count in buckets:
        below += count
        assert below == sum(time < edge for time in times)


def test_an_empty_one_is_all_zero() -> None:
    histogram = Histogram()
    assert (histogram.count, histogram.mean, histogram.highest, histogram.quantile(0.5)) == (0, 0.0, 0.0, 0.0)
    assert histogram.buckets() == []


@pytest.mark.parametrize("negative", [-1.0, -1e-9])
def test_a_negative_time_counts_as_zero(negative: float) -> None:
    histogram = histogram_of([negative, 0.0])
    assert (histogram.count, histogram.total, histogram.highest, histogram.quantile(1.0)) == (2, 0.0, 0.0, 0.0)
