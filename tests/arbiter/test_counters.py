"""What statistics count, and that nobody who holds them sees them change."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import FrozenInstanceError, astuple, fields, replace
from typing import Any

import pytest

from busmaster.arbiter.counters import (
    BATCH,
    DriverErrors,
    Histogram,
    LineStatistics,
    NodeStatistics,
    Quantiles,
    RecentUtilisation,
)
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import BAD_CHECKSUM, FIVE, NAK, SEVEN, TAU, Bench, up

REQUEST = 8 * TAU
Story = Callable[[Bench, NodeRecord], None]


def line_statistics() -> LineStatistics:
    return Bench().arbiter.statistics(1.0)


def node_statistics() -> NodeStatistics:
    return Bench().node().counters.snapshot(0.150)


def test_nothing_is_counted_before_anything_has_happened() -> None:
    counts = ("exchanges", "tainted", "collisions", "noisy", "losses", "sync_reads", "ambiguous", "breaks")
    line, node = line_statistics(), node_statistics()
    assert [getattr(line, name) for name in counts] == [0] * len(counts)
    assert (node.attempts, node.failed, node.latency.count) == (0, 0, 0)


def test_time_without_a_port_is_neither_quiet_nor_busy_time() -> None:
    bench = Bench()
    before = bench.arbiter.statistics(bench.now)
    bench.arbiter.line_down("pulled out", bench.now)
    bench.wait(5.0)
    after = bench.arbiter.statistics(bench.now)
    assert after.elapsed == before.elapsed + 5.0
    assert (after.quiet_time, after.busy) == (before.quiet_time, before.busy)


def is_late(bench: Bench, node: NodeRecord) -> None:
    bench.ask(node)
    bench.sent()
    bench.hear(FIVE, after=REQUEST + 0.060)


def is_overdue(bench: Bench, node: NodeRecord) -> None:
    bench.ask(node)
    bench.sent()
    bench.hear(FIVE, after=REQUEST + 0.101)


def is_refused_twice(bench: Bench, node: NodeRecord) -> None:
    bench.ask(node)
    for _ in range(2):
        bench.until_sent()
        bench.sent()
        bench.hear(NAK, after=0.004)


def is_silent(bench: Bench, node: NodeRecord) -> None:
    node.health = Health.UP
    bench.ask(node, retries=1)
    bench.sent()
    bench.wait(0.152)


def answers_something_else(heard: str, after: float) -> Story:
    def story(bench: Bench, node: NodeRecord) -> None:
        bench.ask(node, retries=0)
        bench.sent()
        bench.hear(heard, after)

    return story


def is_asked_and_not_waited_for(bench: Bench, node: NodeRecord) -> None:
    on_the_wire, waiting = bench.ask(node), bench.ask(node)
    bench.sent()
    for asked in (on_the_wire, waiting):
        bench.arbiter.cancel(asked, bench.now)
    bench.answer()


def speaks_unexpected(count: int) -> Story:
    def story(bench: Bench, node: NodeRecord) -> None:
        for _ in range(count):
            bench.hear("FF", after=0.010)

    return story


def vanishes_with_the_port(bench: Bench, node: NodeRecord) -> None:
    bench.ask(node)
    bench.sent()
    bench.arbiter.line_down("unplugged", bench.now)
    bench.listen()


ONE = {"attempts": 1, "exchanges": 1, "completed": 1}
FAILED = ONE | {"failed": 1}


@pytest.mark.parametrize(
    ("story", "line", "counts"),
    [
        (is_late, {}, ONE | {"ok": 1, "late": 1}),
        (is_overdue, {}, ONE | {"ok": 1, "late": 1, "overdue": 1}),
        (is_refused_twice, {}, FAILED | {"attempts": 2, "exchanges": 2, "refused": 2, "resyncs": 2}),
        (is_silent, {}, {"attempts": 1, "exchanges": 1, "no_reply": 1, "retries": 1, "resyncs": 1, "sync_reads": 1}),
        (answers_something_else(BAD_CHECKSUM, 0.004), {}, FAILED | {"garbled": 1, "resyncs": 1}),
        (answers_something_else(FIVE, 0.0001), {"paced": True}, FAILED | {"garbled": 1, "tainted": 1, "resyncs": 1}),
        (answers_something_else(SEVEN, 0.001), {"echo": True}, FAILED | {"garbled": 1, "collisions": 1, "resyncs": 1}),
        (
            is_asked_and_not_waited_for,
            {},
            {"attempts": 1, "exchanges": 1, "ok": 1, "unheard": 1, "cancelled": 2},
        ),
        (speaks_unexpected(2), {}, {"unexpected_bytes": 2, "resyncs": 1}),
        (speaks_unexpected(120), {}, {"unexpected_bytes": 120, "resyncs": 1, "noisy": 1}),
        (vanishes_with_the_port, {}, FAILED | {"losses": 1}),
    ],
)
def test_what_happens_is_counted_once_and_nothing_else_is(
    story: Story, line: dict[str, Any], counts: dict[str, int]
) -> None:
    bench = Bench(**line)
    node = bench.node()
    bench.arbiter.reset_statistics(bench.now)
    story(bench, node)
    records = (bench.arbiter.statistics(bench.now), node.counters.snapshot(0.150))
    known = {each.name: getattr(record, each.name) for record in records for each in fields(record)}
    known.pop("backlog")
    assert {name: count for name, count in known.items() if type(count) is int and count} == counts


def test_resetting_the_statistics_of_a_line_resets_those_of_its_nodes() -> None:
    bench = Bench()
    nodes = [up(bench, address) for address in (1, 2)]
    assert [node.counters.snapshot(0.150).ok for node in nodes] == [1, 1]
    bench.arbiter.reset_statistics(bench.now)
    assert [node.counters.snapshot(0.150).ok for node in nodes] == [0, 0]


def test_quantiles_are_of_what_the_histogram_holds() -> None:
    histogram = Histogram()
    for number in range(1, 101):
        histogram.record(number / 1000)
    quantiles = Quantiles.of(histogram)
    assert (quantiles.count, quantiles.highest) == (100, 0.1)
    assert quantiles.mean == pytest.approx(0.0505)
    assert [quantiles.p50, quantiles.p99] == pytest.approx([0.050, 0.099], rel=0.1)


def test_the_median_of_waits_most_of_which_took_no_time_is_0() -> None:
    histogram = Histogram()
    for seconds in (0.0, -1e-9, 0.0, 0.025):
        histogram.record(seconds)
    quantiles = Quantiles.of(histogram)
    assert (quantiles.p50, quantiles.highest) == (0.0, 0.025)


def test_the_utilisation_of_a_line_is_the_share_of_the_time_in_which_it_was_in_use() -> None:
    for busy, quiet_time, elapsed, share in ((0.25, 0.5, 1.5, 0.5), (0.0, 0.0, 0.0, 0.0), (0.6, 0.5, 1.0, 1.0)):
        assert replace(line_statistics(), busy=busy, quiet_time=quiet_time, elapsed=elapsed).utilisation == share


def test_statistics_never_change() -> None:
    line = line_statistics()
    for record in (line, line.waits[0], node_statistics(), DriverErrors(0, 0, 0, 0, 0)):
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


def test_errors_of_the_driver_count_from_a_snapshot() -> None:
    before, now = DriverErrors(1, 2, 3, 4, 5), DriverErrors(11, 22, 33, 44, 55)
    assert now.since(before) == DriverErrors(10, 20, 30, 40, 50)


def test_the_recent_utilisation_begins_anew_when_the_statistics_are_reset() -> None:
    recent = RecentUtilisation(10.0)
    idle = line_statistics()
    recent.note(0.0, replace(idle, busy=2.0, quiet_time=1.0))
    assert recent.note(4.0, replace(idle, busy=4.0, quiet_time=1.0)) == pytest.approx(0.5)
    reset = replace(idle, busy=4.5, quiet_time=0.0)
    assert recent.note(5.0, reset) == reset.utilisation
    assert recent.note(6.0, replace(idle, busy=4.5, quiet_time=0.5)) == pytest.approx(0.5)


def test_the_recent_utilisation_is_1_at_most_though_an_exchange_counts_whole_when_it_ends() -> None:
    recent = RecentUtilisation(10.0)
    idle = line_statistics()
    recent.note(0.0, replace(idle, busy=0.0, quiet_time=0.0))
    assert recent.note(1.0, replace(idle, busy=1.0, quiet_time=0.5)) == 1.0


def test_the_recent_utilisation_is_that_of_the_window_and_of_no_time_before() -> None:
    recent, idle = RecentUtilisation(10.0), line_statistics()
    recent.note(0.0, idle)
    assert recent.note(10.0, replace(idle, busy=10.0)) == pytest.approx(1.0)
    assert recent.note(20.0, replace(idle, busy=10.0)) == 0.0
    assert recent.note(25.0, replace(idle, busy=15.0)) == pytest.approx(5 / 15), "the last snapshot from before it"


def test_r12_times_that_are_not_in_buckets_yet_are_bounded() -> None:
    bench = Bench()
    node = up(bench)
    for _ in range(BATCH + 10):
        bench.served(bench.ask(node))
    line, of_node = bench.arbiter._counters, node.counters
    for histogram in (*line.waits, of_node.latency):
        assert len(histogram.new) < BATCH
    assert of_node.latency.count >= BATCH + 10


def test_the_recent_utilisation_of_no_time_is_that_since_the_reset() -> None:
    recent = RecentUtilisation(10.0)
    line = replace(line_statistics(), busy=2.0, quiet_time=0.0)
    assert [recent.note(float(now), line) for now in ("4", "4")] == [line.utilisation] * 2


def test_the_99th_percentile_is_not_the_highest() -> None:
    histogram = Histogram()
    for seconds in (*[0.001] * 199, 1.0):
        histogram.record(seconds)
    quantiles = Quantiles.of(histogram)
    assert quantiles.highest == 1.0
    assert quantiles.p99 < 0.002
