"""The bench: what it measures in virtual time is known to the microsecond, and the same each time."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Callable
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import pytest

from busmaster import Bus, Hcp2Controller, MemoryPort, MentorDrive, NoReply
from busmaster.arbiter.transaction import Priority
from busmaster.bus.node import Node
from busmaster.contract.profile import LineSettings, Profile
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Echo, Line
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2.codec import Read, Write
from busmaster.registry import find, kinds, make_device
from busmaster.testing.bench import (
    BenchReport,
    Budget,
    BudgetExceeded,
    EmulatedLine,
    Measurement,
    Stopwatch,
    Times,
    Workload,
    bench,
    check_plot,
    emulated,
    measure,
    parse_priorities,
    plot,
    ratios,
    reads_of,
)
from busmaster.testing.fixtures import latency_bench
from busmaster.testing.latency_plot import _course, _title
from busmaster.testing.latency_report import histogram
from busmaster.testing.virtual_time import run_in_virtual_time

__all__ = ["latency_bench"]


def two_nodes(profile: Profile) -> list[int]:
    """Two addresses that every host may use; the one drive of a protocol without addresses."""
    return [address for address in (11, 12) if address in profile.addresses] or list(profile.addresses[:1])


@pytest.mark.parametrize("name", kinds())
def test_callers_without_a_pause_reach_the_limit_of_the_wire_in_virtual_time(name: str) -> None:
    """The limit is calculated from bits and reply delay, the rate is measured: no byte is counted twice or left out."""
    report = bench(name, two_nodes(kinds()[name].profile), virtual=True, seconds=2, delay=Delay(0.003))
    assert report.values > 20
    assert report.errors == {}
    assert report.share == pytest.approx(1, abs=1e-6)
    assert report.rate == pytest.approx(report.limit, rel=1e-6)


def test_the_polls_of_a_group_count_towards_the_share_of_the_wire() -> None:
    report = bench("hcp2", range(1, 9), virtual=True, seconds=2, callers=1, period=0.1)
    assert report.share == pytest.approx(1, abs=1e-6)
    assert report.values > report.total.count + 100


def test_failed_attempts_and_retries_are_no_part_of_the_share() -> None:
    report = bench("hcp2", [1], virtual=True, seconds=5, faults=["lost=0.2"])
    assert 0 < report.share < 0.5
    assert report.values == report.total.count, "a sync read after a lost frame has no caller"


@pytest.mark.parametrize("delay", [Delay(0.0), Delay(0.003), Delay(0.0, 0.006)])
def test_the_limit_is_that_of_the_known_reply_delay_however_late_the_drive_replies(delay: Delay) -> None:
    def once(*faults: str) -> BenchReport:
        return bench("hcp2", [1], virtual=True, seconds=1, delay=delay, faults=faults)

    on_time, late = once(), once("late=1", "late_by=0.05")
    assert late.limit == pytest.approx(on_time.limit)
    assert late.share < 0.5
    assert on_time.share == pytest.approx(1, abs=0.1)


def test_the_same_arguments_give_the_same_report_and_another_seed_another() -> None:
    def once(seed: int) -> str:
        mixed = "command=4,urgent=1,background=1"
        report = bench("hcp2", [1, 2], virtual=True, seconds=2, delay=Delay(0.001, 0.009), seed=seed, priorities=mixed)
        return json.dumps({**report.fields(), "workload": None})

    assert once(1) == once(1)
    assert once(1) != once(2)


def test_a_latency_is_counted_from_the_call_to_the_value() -> None:
    alone = bench("dc104", find("dc104").profile.addresses[:1], virtual=True, seconds=1, every=0.1)
    several = bench("dc104", find("dc104").profile.addresses[:1], virtual=True, seconds=1, callers=3)
    assert alone.total.count == 10
    assert alone.total.figures["max"] == pytest.approx(1 / alone.limit)
    assert several.total.figures["p50"] == pytest.approx(3 / several.limit), "each waits for the two before it"


def test_an_urgent_read_waits_for_one_exchange_and_others_for_all() -> None:
    report = bench("hcp2", range(1, 17), virtual=True, seconds=5, priorities="command=15,urgent=1")
    assert report.priorities["urgent"].figures["p50"] < 3 / report.limit
    assert report.priorities["command"].figures["p50"] > 10 / report.limit
    assert report.priorities["urgent"].count + report.priorities["command"].count == report.total.count


def test_a_caller_with_a_period_counts_the_cycles_that_it_cannot_begin() -> None:
    """A read takes about 54 ms: of each three periods of 20 ms two are missed."""
    report = bench("hcp2", [1], virtual=True, seconds=3, every=0.02, delay=Delay(0.05))
    assert report.total.count == 50
    assert report.missed == 100
    quick = bench("hcp2", [1], virtual=True, seconds=3, every=0.06, delay=Delay(0.05))
    assert (quick.total.count, quick.missed) == (50, 0)


def test_the_cycles_of_a_poll_group_are_measured_and_missed_ones_counted() -> None:
    easy = bench("hcp2", range(1, 5), virtual=True, seconds=2, callers=0, period=0.1)
    assert easy.total.count == 0
    assert easy.cycles.count in (20, 21)
    assert easy.missed == 0
    assert easy.cycles.figures["p50"] >= 4 / easy.limit * 0.99
    hard = bench("hcp2", range(1, 5), virtual=True, seconds=2, callers=0, period=0.01)
    assert hard.missed > 50


@pytest.mark.parametrize("callers", [1, 3, 7])
def test_every_node_is_read_whatever_the_number_of_callers(callers: int) -> None:
    report = bench("hcp2", [1, 2, 3, 4, 5], virtual=True, seconds=1, callers=callers)
    assert [name for name, times in report.nodes.items() if times.count] == ["1", "2", "3", "4", "5"]


def test_errors_are_counted_by_kind_and_have_no_latency() -> None:
    report = bench("hcp2", [1, 2], virtual=True, seconds=20, faults=["dead=1"])
    assert report.values == report.total.count == 0
    assert report.errors["NoReply"] > 0
    assert sum(report.errors.values()) <= 2 * 20 / 0.05, "a caller pauses after an error"
    assert report.exceeded(["p99=1000"]) == ["p99: nothing was measured"]


def test_an_application_runs_beside_the_callers_and_times_its_own_calls() -> None:
    async def application(bus: Bus, timed: Stopwatch) -> None:
        axis = Hcp2Controller(bus, 1)
        while True:
            await timed("position", axis.read(1))
            await asyncio.sleep(0.1)

    report = bench("hcp2", [1], virtual=True, seconds=2, callers=0, application=application)
    assert report.calls["position"].count == report.total.count == 20
    assert report.nodes["1"].count == 0, "it is no read of the bench's own"
    report.check("position.max=10", "max=10")
    with pytest.raises(BudgetExceeded, match=r"p50 of position: \d+\.\d+ ms, budget 1 ms"):
        report.check("position.p50=1")


def test_an_error_of_the_application_ends_the_bench_as_it_is() -> None:
    async def application(bus: Bus, timed: Stopwatch) -> None:
        await timed("lost", Hcp2Controller(bus, 2).read(1))

    with pytest.raises(NoReply):
        bench("hcp2", [1], virtual=True, application=application)


def test_an_open_bus_is_measured_by_its_own_handles() -> None:
    async def main() -> BenchReport:
        line = Line(find("hcp2").profile.line, [make_device("hcp2", node, delay=Delay(0.004)) for node in (3, 4)])
        async with Bus(MemoryPort(line)) as bus:
            handles = [Hcp2Controller(bus, 3), Hcp2Controller(bus, 4)]
            return await measure(bus, handles, Workload(seconds=2, items=("1",)))

    report = run_in_virtual_time(main())
    assert report.line == {"protocol": "hcp2", "port": "the emulated line", "baudrate": 57600, "framing": "8N1"}
    assert list(report.nodes) == ["3", "4"]
    assert report.share == pytest.approx(1, abs=0.02), "the reply delay is observed, not known"


def test_an_item_that_is_named_and_refused_is_an_error_and_not_left_out() -> None:
    async def main() -> BenchReport:
        device = EmulatedMint(3, axes=0, refuse_reserved=True)
        async with Bus(MemoryPort(Line(find("hcp2").profile.line, [device]))) as bus:
            return await measure(bus, [Hcp2Controller(bus, 3)], Workload(seconds=1, items=("1", "105")))

    report = run_in_virtual_time(main())
    assert set(report.errors) == {"Refused"}
    assert report.values > 0


def test_callers_with_a_period_begin_spread_over_it() -> None:
    """Of four at once, three would wait for the others."""
    report = bench("hcp2", range(1, 5), virtual=True, seconds=2, every=0.2)
    assert report.total.count == 40
    assert report.total.figures["max"] == pytest.approx(report.total.figures["p50"], rel=0.3)
    assert sorted(round(at % 0.2, 2) for at, _, _ in report.samples[::10]) == [0.0, 0.05, 0.1, 0.15]


def test_the_bytes_of_the_echo_take_no_further_time_on_the_wire() -> None:
    async def main(echo: Echo | None) -> BenchReport:
        devices = [make_device("hcp2", 3, delay=Delay(0.004))]
        async with Bus(MemoryPort(Line(find("hcp2").profile.line, devices, echo=echo))) as bus:
            measurement = Measurement(bus, [Hcp2Controller(bus, 3)], Workload(seconds=1), reply_delay=0.004)
            await measurement.run_open()
            return measurement.report()

    plain, echoed = (run_in_virtual_time(main(echo)) for echo in (None, Echo()))
    assert plain.share == pytest.approx(1, abs=0.01)
    assert echoed.share == pytest.approx(plain.share, abs=0.01)
    assert echoed.limit == pytest.approx(plain.limit, rel=0.01)


def test_the_fixture_measures(latency_bench: Callable[..., BenchReport]) -> None:
    latency_bench("hcp2", [1], virtual=True, seconds=1).check("p99=10", "errors=0", "missed=0")


def test_a_real_pseudo_terminal_is_served_by_another_process() -> None:
    line = EmulatedLine("hcp2", (1, 2), delay=(0.001, 0.001))
    with emulated(line, Workload(seconds=0.3)) as measurement:
        assert str(measurement.bus.endpoint.name).startswith("/dev/pts/")
        asyncio.run(measurement.run())
        report = measurement.report()
    assert report.values > 0
    assert 0 < report.share <= 1.01
    assert report.line["virtual"] is False


def test_the_port_of_a_pseudo_terminal_has_all_settings_of_the_line(monkeypatch: pytest.MonkeyPatch) -> None:
    class Other(EmulatedLine):
        def settings(self) -> LineSettings:
            return LineSettings(4800, 7, "O", 2)

    monkeypatch.setattr("busmaster.testing.bench.in_own_process", lambda line: nullcontext("/dev/pts/99"))
    with ExitStack() as stack:
        with pytest.warns(UserWarning, match="mentor is meant for 7E1, but /dev/pts/99 is 7O2"):
            measurement = stack.enter_context(emulated(Other("mentor", (11,)), Workload(), handle=MentorDrive))
        assert measurement.bus.endpoint.settings == LineSettings(4800, 7, "O", 2)
        assert measurement.bus.endpoint.name == "/dev/pts/99"


# reads alone


def test_a_command_that_writes_is_refused() -> None:
    profile = SimpleNamespace(probe=Write(1, (0.0,)), sync_reads=())
    handle: Any = SimpleNamespace(node=SimpleNamespace(profile=profile, label="node 1"))
    with pytest.raises(InvalidCommand, match=r"node 1: .* is a write, and a bench only reads"):
        reads_of(handle)


def test_all_items_that_are_named_are_read_and_of_the_profiles_own_reads_four_at_most() -> None:
    async def reads(*items: str) -> list[Any]:
        axis = Hcp2Controller(Bus(MemoryPort(Line(find("hcp2").profile.line))), 1)
        axis.use_sync_reads(probe="1", sync_reads=[str(element) for element in range(2, 9)])
        return list(reads_of(axis, items))

    assert run_in_virtual_time(reads()) == [Read(1), Read(2), Read(3), Read(4)]
    several = [str(element) for element in range(9, 15)]
    assert run_in_virtual_time(reads(*several, "9")) == [Read(element) for element in range(9, 15)]


@pytest.mark.parametrize("name", kinds())
def test_the_reads_of_every_protocol_are_several_and_none_writes(name: str) -> None:
    async def reads() -> list[Any]:
        bus = Bus(MemoryPort(Line(kinds()[name].profile.line)))
        return list(reads_of(kinds()[name].handle(bus, two_nodes(kinds()[name].profile)[0])))

    found = run_in_virtual_time(reads())
    assert len(found) > 1
    assert not any(read.writes for read in found)


# what cannot be


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ({"seconds": 0}, "more than 0 s"),
        ({"seconds": 1e9}, "at most"),
        ({"seconds": True}, "a time"),
        ({"every": 0}, "every is a time above 0"),
        ({"period": 0.0}, "period is a time above 0"),
        ({"callers": 1001}, "the number of callers"),
        ({"callers": -1}, "the number of callers"),
        ({"priorities": "hurry=1"}, "no such priority 'hurry'"),
        ({"priorities": "urgent=0"}, "one of them is above 0"),
        ({"priorities": "urgent=-1"}, "whole number"),
        ({"items": ("nothing",)}, "nothing"),
        ({"faults": ["rain=1"]}, "no such fault 'rain'"),
        ({"nodes": [999]}, "address 999"),
        ({"nodes": []}, "at least one node"),
        ({"baud": 0}, "baudrate"),
    ],
)
def test_a_bench_that_cannot_be_is_refused(arguments: dict[str, Any], complaint: str) -> None:
    nodes = arguments.pop("nodes", [1])
    with pytest.raises(InvalidCommand, match=complaint):
        bench("hcp2", nodes, virtual=True, **arguments)


def test_a_workload_at_its_bounds_is_accepted_and_a_share_below_0_is_not() -> None:
    for callers in (0, 1000):
        assert Workload(seconds=3600, callers=callers).callers == callers
    with pytest.raises(InvalidCommand, match=r"more than 0 s, and 3600 s at most, not 3600\.1 s"):
        Workload(seconds=3600.1)
    with pytest.raises(InvalidCommand, match="each share of a priority is 0 or more"):
        Workload(priorities={Priority.COMMAND: 2, Priority.URGENT: -1})


def test_shares_of_priorities_are_read() -> None:
    assert parse_priorities("command=8, urgent") == {Priority.COMMAND: 8, Priority.URGENT: 1}


# percentiles, budgets, comparison


def test_a_percentile_is_the_nearest_rank() -> None:
    times = Times.of(number / 1000 for number in range(1000, 0, -1))
    assert times.figures == {"p50": 0.5, "p90": 0.9, "p99": 0.99, "p99.9": 0.999, "max": 1.0}
    assert times.count == 1000
    assert times.mean == pytest.approx(0.5005)
    assert set(Times.of([0.25]).figures.values()) == {0.25}
    assert Times.of([]) == Times()


@pytest.mark.parametrize(
    "latencies", [[0.004], [0.001 * 1.3**n for n in range(40)], [0.0, 0.01], [0.0101, 0.0102, 0.0109]]
)
def test_each_latency_is_in_one_bucket_of_the_histogram(latencies: list[float]) -> None:
    buckets = histogram(latencies)
    assert sum(count for _, count in buckets) == len(latencies)
    assert len(buckets) <= 20
    below = 0
    for edge, count in buckets:
        below += count
        assert below == sum(latency < edge for latency in latencies)


@pytest.mark.parametrize(
    ("text", "budget"),
    [
        ("p99=20", Budget("", "p99", 0.02)),
        ("p99.9=20ms", Budget("", "p99.9", 0.02)),
        ("urgent.p99.9=1.5", Budget("urgent", "p99.9", 0.0015)),
        ("5.max=50", Budget("5", "max", 0.05)),
        ("p50=1.2x", Budget("", "p50", 1.2, relative=True)),
        ("errors=3", Budget("", "errors", 3)),
    ],
)
def test_a_budget_is_read(text: str, budget: Budget) -> None:
    assert Budget.parse(text) == budget


@pytest.mark.parametrize("text", ["", "p99", "p98=20", "p99=-1", "p99=nan", "p99=20s", "urgent.errors=1", "missed=2x"])
def test_a_budget_that_is_none_is_refused(text: str) -> None:
    with pytest.raises(InvalidCommand):
        Budget.parse(text)


def test_a_budget_is_exceeded_above_its_limit_and_not_at_it() -> None:
    report = bench("hcp2", [1], virtual=True, seconds=1, every=0.02, delay=Delay(0.05), faults=["lost=0.3"])
    highest = report.total.figures["max"]
    assert report.exceeded([Budget("", "max", highest), Budget("command", "max", highest), "missed=1000"]) == []
    assert len(report.exceeded([Budget("1", "max", highest * 0.999), "missed=0"])) == 2
    with pytest.raises(InvalidCommand, match=r"no.*has the name '7'"):
        report.exceeded(["7.p99=20"])
    with pytest.raises(InvalidCommand, match="needs a report to compare with"):
        report.exceeded(["p99=2x"])


def test_two_reports_are_compared_figure_by_figure() -> None:
    one = bench("dc104", find("dc104").profile.addresses[:1], virtual=True, seconds=1)
    two = bench("dc104", find("dc104").profile.addresses[:1], virtual=True, seconds=1, callers=2)
    found = ratios(one, two)
    assert found[""]["p50"] == pytest.approx(2)
    assert set(found) == {"", "command", next(iter(one.nodes))}
    assert two.exceeded(["p50=2.01x"], before=one) == []
    [text] = two.exceeded(["p50=1.5x"], before=one)
    assert "(1.5 times " in text


def test_a_report_is_the_same_after_json() -> None:
    report = bench("hcp2", [1, 2], virtual=True, seconds=1, period=0.1, faults=["lost=0.1"])
    again = BenchReport.from_json(report.to_json())
    assert again == report
    assert report.samples
    assert again.samples == ()


def test_every_field_of_a_report_is_in_its_json() -> None:
    times = iter(Times.of([0.01 * number, 0.5]) for number in range(1, 20))
    report = BenchReport(
        {"port": "COM1"}, {"nodes": [5]}, 2.0, 7, 30.0, 0.25, next(times), {"5": next(times)}, {"urgent": next(times)},
        {"position": next(times)}, next(times), 3, {"NoReply": 2, "Refused": 1}, ((0.1, 4), (0.2, 3)),
    )  # fmt: skip
    again = BenchReport.from_json(report.to_json())
    assert again == report
    assert json.loads(report.to_json())["rate"] == report.rate == 3.5


@pytest.mark.slow
def test_a_report_from_json_is_plotted_with_the_counts_of_its_histogram(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    figure = pytest.importorskip("matplotlib.figure").Figure
    drawn: list[Any] = []
    really = figure.savefig

    def savefig(this: Any, path: str) -> None:
        drawn.append(this)
        really(this, path)

    monkeypatch.setattr(figure, "savefig", savefig)
    report = bench("hcp2", [1, 2], virtual=True, seconds=1, period=0.1, faults=["lost=0.1"])
    for one in (report, BenchReport.from_json(report.to_json())):
        plot(one, str(tmp_path / "bench.png"))
    whole, counts = drawn
    assert [len(whole.axes), len(counts.axes)] == [2, 1]
    bars = [(bar.get_x(), bar.get_height()) for bar in counts.axes[0].patches]
    assert [height for _, height in bars] == [values for _, values in report.histogram]
    assert len(report.histogram) > 1
    tops: dict[float, float] = {}
    for bar in whole.axes[0].patches:
        tops[bar.get_x()] = max(tops.get(bar.get_x(), 0), bar.get_y() + bar.get_height())
    assert dict(bars) == tops
    for panel in (whole.axes[0], counts.axes[0]):
        marks = {line.get_label(): line.get_xdata()[0] for line in panel.lines}
        assert [label.partition(" ")[0] for label in marks] == ["p50", "p99", "max"]
        assert list(marks.values()) == [1000 * report.total.figures[name] for name in ("p50", "p99", "max")]
    [course] = whole.axes[1].lines
    assert [tuple(dot) for dot in course.get_xydata()] == [(at, 1000 * latency) for at, latency, _ in report.samples]
    assert course.get_label() == "command"


@pytest.mark.parametrize("text", ["", "{}", "[]", "null", '{"layout": 2}', '{"layout": 1}', "\xff"])
def test_a_text_that_is_no_report_is_refused(text: str) -> None:
    with pytest.raises(InvalidCommand, match="report"):
        BenchReport.from_json(text)


def test_an_exceeded_budget_is_described_with_what_was_measured() -> None:
    half = Times.of([0.5])
    report = BenchReport(
        {}, {}, 1.0, 1, 1.0, 1.0, half, {}, {"urgent": half}, {}, Times(), 2, {"NoReply": 2, "Refused": 1}, ()
    )
    before = replace(report, total=Times.of([0.2]), priorities={"urgent": Times()}, missed=0)
    texts = report.exceeded(
        ["p50=499.9", "urgent.max=1x", "max=2x", "errors=2", "missed=1", "cycle.p99=1", "max=2.5x"], before=before
    )
    assert texts == [
        "p50: 500 ms, budget 499.9 ms",
        "max of urgent: nothing was measured in the first report",
        "max: 500 ms, budget 400 ms (2 times 200 ms)",
        "3 errors, budget 2",
        "2 missed, budget 1",
        "p99 of cycle: nothing was measured",
    ]
    with pytest.raises(BudgetExceeded, match=r"^3 errors, budget 0; 2 missed, budget 0$"):
        report.check("errors=0", Budget("", "missed", 0))
    report.check("errors=3", "missed=2", "p50=500", "max=2.5x", before=before)
    assert ratios(before, report) == {"": dict.fromkeys(half.figures, 2.5)}


def test_a_node_that_refuses_some_reads_is_measured_by_the_others_and_one_that_refuses_all_has_errors() -> None:
    async def main() -> tuple[BenchReport, BenchReport]:
        device = EmulatedMint(3, axes=0, refuse_reserved=True)
        async with Bus(MemoryPort(Line(find("hcp2").profile.line, [device]))) as bus:
            axis = Hcp2Controller(bus, 3)
            axis.use_sync_reads(probe="1", sync_reads=["axis0.position", "2"])
            some = await measure(bus, [axis], Workload(seconds=1))
            Node.of(axis)._record.profile = replace(axis.node.profile, probe=Read(105), sync_reads=(Read(106),))
            return some, await measure(bus, [axis], Workload(seconds=1))

    some, every = run_in_virtual_time(main())
    assert some.errors == {}
    assert some.values > 50
    assert (set(every.errors), every.values) == ({"Refused"}, 0)


def test_a_measurement_that_fails_leaves_the_bus_as_it_was() -> None:
    async def application(bus: Bus, timed: Stopwatch) -> None:
        await asyncio.sleep(0.5)
        raise ZeroDivisionError

    async def main() -> float:
        async with Bus(MemoryPort(Line(find("hcp2").profile.line, [make_device("hcp2", 3)]))) as bus:
            axis = Hcp2Controller(bus, 3)
            measurement = Measurement(bus, [axis], Workload(seconds=1, period=0.1), application=application)
            with pytest.raises(ZeroDivisionError):
                await measurement.run_open()
            assert (bus.groups, bus._pump.tap) == ((), None)
            await asyncio.sleep(5.0)
            return measurement.report().elapsed

    assert run_in_virtual_time(main()) == pytest.approx(0.5, abs=0.01)


def test_a_measurement_leaves_the_bus_as_it_was() -> None:
    async def main() -> BenchReport:
        line = Line(find("hcp2").profile.line, [make_device("hcp2", 3)])
        async with Bus(MemoryPort(line)) as bus:
            axis = Hcp2Controller(bus, 3)
            own = [bus.poll_group(name, period=10.0, points=[axis.point("9")]) for name in ("bench", "bench1")]
            measurement = Measurement(bus, [axis], Workload(seconds=1, callers=1, period=0.1))
            states = [(measurement.begun, measurement.report().elapsed)]
            await measurement.run_open()
            assert [*states, measurement.begun] == [(False, 0), True]
            assert bus.groups == tuple(own)
            assert bus._pump.tap is None
            return measurement.report()

    report = run_in_virtual_time(main())
    assert report.cycles.count in (10, 11)
    assert report.elapsed == pytest.approx(1, abs=0.05)
    assert report.samples[0][0] < 0.1
    assert {kind for _, _, kind in report.samples} == {"command"}


def test_errors_of_polls_and_of_calls_are_counted_too() -> None:
    async def application(bus: Bus, timed: Stopwatch) -> None:
        for _ in range(2):
            with suppress(NoReply):
                await timed("lost", Hcp2Controller(bus, 2).read(1, retries=0))
        await asyncio.sleep(3600)

    report = bench("hcp2", [1], virtual=True, seconds=2, callers=0, application=application)
    assert report.errors == {"NoReply": 2}
    assert report.calls == {}
    polled = bench("hcp2", [1], virtual=True, seconds=2, callers=0, period=0.5, faults=["dead=1"])
    assert sum(polled.errors.values()) == polled.cycles.count > 1


def test_the_workload_of_a_report_is_what_was_wanted() -> None:
    report = bench(
        "hcp2",
        [1],
        baud=9600,
        virtual=True,
        seconds=1,
        callers=2,
        every=0.5,
        period=0.25,
        priorities="urgent=3",
        items=("7",),
        seed=5,
        delay=Delay(0.001, 0.003),
        faults=["lost=0"],
    )
    assert report.workload == {
        "nodes": [1],
        "seconds": 1,
        "callers": 2,
        "priorities": {"urgent": 3},
        "every": 0.5,
        "period": 0.25,
        "items": ["7"],
        "seed": 5,
    }
    assert report.line == {
        "protocol": "hcp2",
        "port": "emulated",
        "baudrate": 9600,
        "framing": "8N1",
        "virtual": True,
        "reply_delay": [0.001, 0.003],
        "faults": ["lost=0"],
    }
    assert set(report.priorities) == {"urgent"}


# the plot


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["svg", "png"])
def test_the_plot_is_drawn(suffix: str, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    report = bench("hcp2", [1, 2], virtual=True, seconds=1, priorities="command=3,urgent=1")
    path = tmp_path / f"latency.{suffix}"
    plot(report, str(path))
    assert path.read_bytes().startswith({"png": b"\x89PNG", "svg": b"<?xml"}[suffix])


@pytest.mark.slow
def test_a_plot_of_nothing_is_drawn(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    plot(bench("hcp2", [1], virtual=True, seconds=1, faults=["dead=1"]), str(tmp_path / "latency.png"))


def test_the_title_of_a_plot_names_the_line_and_its_rate() -> None:
    pytest.importorskip("matplotlib")
    report = bench("hcp2", [1, 2], virtual=True, seconds=1)
    assert (
        _title(report)
        == f"hcp2, 2 nodes, 57600 baud 8N1: {report.rate:.1f} values a second, 100.0% of the wire's limit"
    )
    one = replace(report, nodes={"1": Times()}, values=25, elapsed=2.0, share=0.5)
    assert _title(one).startswith("hcp2, 1 node, 57600")
    assert _title(one).endswith("8N1: 12.5 values a second, 50.0% of the wire's limit")


def test_a_plot_over_time_has_a_bounded_number_of_dots_of_each_class() -> None:
    pytest.importorskip("matplotlib")
    drawn: dict[str, int] = {}
    panel: Any = MagicMock()
    panel.plot = lambda x, y, *style, label, **options: drawn.__setitem__(label, len(x))
    _course(panel, {"command": [(0.0, 1.0)] * 50_001, "urgent": [(0.0, 1.0)] * 20})
    assert drawn == {"command": 16_667, "urgent": 20}


def test_a_suffix_of_a_plot_may_have_capital_letters(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    check_plot("latency.PNG")
    check_plot(str(tmp_path / "latency.svg"))


def test_a_plot_that_cannot_be_written_is_refused_before_anything_is_measured(tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    with pytest.raises(InvalidCommand, match="no plot has the suffix 'txt'"):
        check_plot("latency.txt")
    with pytest.raises(InvalidCommand, match="there is no folder"):
        check_plot(str(tmp_path / "nowhere" / "latency.png"))
    with pytest.raises(InvalidCommand, match="no plot has the suffix 'txt'"):
        plot(bench("hcp2", [1], virtual=True, seconds=0.1), str(tmp_path / "latency.txt"))


def test_without_matplotlib_the_error_names_the_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.partition(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InvalidCommand, match=r"pip install 'busmaster\[plots\]'"):
        check_plot("latency.png")
