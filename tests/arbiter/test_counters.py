"""What statistics count, and that nobody who holds them sees them change."""

from __future__ import annotations

from dataclasses import FrozenInstanceError, astuple, fields, replace
from typing import Any

import pytest

from busmaster.arbiter.counters import DriverErrors
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import FIVE, Bench

LINE = Bench().arbiter.statistics(1.0)
NODE = Bench().node().counters.snapshot(0.150)


def test_nothing_is_counted_before_anything_has_happened() -> None:
    counts = ("exchanges", "tainted", "collisions", "noisy", "losses", "checks", "doubted", "breaks")
    assert [getattr(LINE, name) for name in counts] == [0] * len(counts)
    assert (NODE.attempts, NODE.failed, NODE.latency.count) == (0, 0, 0)


def test_the_utilisation_of_a_line_is_the_share_of_the_time_in_which_it_was_in_use() -> None:
    for busy, settling, elapsed, share in ((0.25, 0.5, 1.5, 0.5), (0.0, 0.0, 0.0, 0.0), (0.6, 0.5, 1.0, 1.0)):
        assert replace(LINE, busy=busy, settling=settling, elapsed=elapsed).utilisation == share


@pytest.mark.parametrize(
    "record", [LINE, LINE.waits[0], NODE, DriverErrors(0, 0, 0, 0, 0)], ids=lambda record: type(record).__name__
)
def test_statistics_never_change(record: Any) -> None:
    for each in fields(record):
        with pytest.raises(FrozenInstanceError):
            setattr(record, each.name, None)
    assert astuple(replace(record)) == astuple(record)


def test_a_timeline_says_when_the_first_byte_of_a_reply_came_and_when_the_last() -> None:
    bench = Bench()
    read = bench.ask(bench.node(), hcp2.Read(1))
    bench.sent()
    start = bench.now
    bench.hear(FIVE[:5], after=0.004)
    bench.hear(FIVE[6:], after=0.003)
    timeline = read.timeline()
    assert (timeline.started, timeline.first_byte) == (start, start + 0.004)
    assert timeline.last_byte == pytest.approx(start + 0.007)


def test_attempts_are_those_that_have_ended_whatever_came_of_them() -> None:
    bench = Bench()
    node = bench.node()
    bench.ask(node, hcp2.Read(1))
    bench.sent()
    assert node.counters.attempts == 0, "while it is under way"
    bench.hear(FIVE, after=0.004)
    assert (node.counters.ok, node.counters.attempts) == (1, 1)
    bench.ask(node, hcp2.Read(1))
    bench.sent()
    bench.arbiter.line_down("unplugged", bench.now)
    counts = node.counters.snapshot(0.0)
    assert (counts.ok, counts.attempts, counts.fruitless, counts.failed) == (1, 2, 0, 1)
