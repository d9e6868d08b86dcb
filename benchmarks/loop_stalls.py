"""How long does each public call hold the loop that owns the line, at 500 points and 200 groups?

A line of 50 HCP2 nodes goes on while it is measured; the other end answers at once. A hold is what the loop does
between two looks at its port, the call and all that comes of it included: the longest of the time that follows is
taken. It is processor time, for on a shared machine the clock also counts what others do meanwhile, and without the
passes of Python's garbage collector, which come when they will and take longer the more an application holds; the
longest with these, and by the clock, stand beside it. Then 200 groups are added in one callback to a paced line with
traffic.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Awaitable, Callable
from statistics import median
from typing import Any

from benchmarks.harness import Claim, Options, Outcome, Table
from benchmarks.lines import Lines
from benchmarks.questions import telegram
from benchmarks.watch import Hold, Watch, watched
from busmaster import Bus, BusError, Hcp2Controller, LineSettings, Node, Point, PollGroup
from busmaster.protocols.hcp2 import codec as hcp2

NODES = range(1, 51)
ELEMENTS = range(1, 11)
GROUPS = 200
POINTS_EACH = 3
STREAMS = 100
WAITING = 500
MOST_WAITING = 900
PERIODS = (0.25, 0.5, 1.0, 2.0, 0.1, 0.3, 0.7, 5.0)
SETTINGS = LineSettings(57600)
DELAY = 0.002
WANTED_MS = 2.0
HELD_BY_DESIGN = "plan_at_once"
"""Holds the loop, and says so: `plan` is for a line that runs."""
COLUMNS = ("call", "hold ms", "collector included: longest ms", "by the clock: longest ms")


Holds = dict[str, list[Hold]]
"""Of each call, round by round."""


def run(options: Options) -> Outcome:
    outcome = Outcome()
    calls: Holds = {}
    for _ in range(options.pick(10, 1)):
        outcome.wrong += watched(lambda watch: _all_calls(watch, calls))
        outcome.wrong += watched(lambda watch: _all_fail(watch, calls, "line lost", _lose))
        outcome.wrong += watched(lambda watch: _all_fail(watch, calls, "bus closed", _close))
    table = Table(f"{len(NODES) * len(ELEMENTS)} points, {GROUPS} groups: longest hold of the loop", COLUMNS)
    for name, holds in calls.items():
        own = median(hold.own for hold in holds)
        table.row(name, own, max(hold.cpu for hold in holds), max(hold.clock for hold in holds))
        if name.partition("(")[0] != HELD_BY_DESIGN:
            outcome.claims.append(Claim(f"longest hold of the loop, ms: {name}", own, WANTED_MS))
    table.notes.append("hold: processor time without the garbage collector, median of the rounds")
    table.notes.append("plan_at_once() calculates at once and says so; plan() does the same while the line goes on")
    outcome.tables.append(table)
    outcome.series = {name: [hold.own for hold in holds] for name, holds in calls.items()}
    _running_line(options, outcome)
    return outcome


def value_of(node: int, element: int) -> float:
    """Says whose it is."""
    return float(node * 100 + element)


def replies() -> dict[bytes, tuple[bytes]]:
    table = {}
    for node in NODES:
        for element in ELEMENTS:
            request = hcp2.Read(element).open(node, hcp2.PROFILE.timings).request
            table[request] = (telegram(b"%02X%g" % (element, value_of(node, element))),)
    return table


def wrong_in(group: PollGroup, points: dict[Point[Any], float]) -> int:
    """Values of its latest snapshot that are another's."""
    if group.latest is None:
        return 0
    return sum(sample.error is None and sample.value != points[point] for point, sample in group.latest.items())


class Round:
    """One bus, and what holds its loop."""

    def __init__(self, bus: Bus, watch: Watch, calls: Holds) -> None:
        self.bus = bus
        self.watch = watch
        self.calls = calls

    async def hold(self, name: str, call: Callable[[], Any], resynchronise: float = 0.05) -> Any:
        """What the call returns, or what it brings if it is awaited. `resynchronise`: seconds for what comes of it."""
        await asyncio.sleep(0)
        self.watch.take()
        result = call()
        if asyncio.iscoroutine(result):
            with contextlib.suppress(BusError):  # on a machine that is busy with other things
                result = await result
        await asyncio.sleep(resynchronise)
        self.calls.setdefault(name, []).append(self.watch.take())
        return result


async def _all_calls(watch: Watch, calls: Holds) -> int:
    with Lines(1, replies()) as lines:
        bus = Bus(lines.ports[0])
        turn = Round(bus, watch, calls)
        await bus.__aenter__()
        await asyncio.sleep(0.2)
        values: dict[Point[Any], float] = {}
        for node in NODES:
            axis = Hcp2Controller(bus, node)
            values |= {axis.element(element): value_of(node, element) for element in ELEMENTS}
            await asyncio.sleep(0)
        wrong = await _one_large_group(turn, values)
        wrong += await _many_groups(turn, values)
        await _requests(turn, list(values))
        await turn.hold("leaving the bus", lambda: bus.__aexit__(None, None, None), 0.0)
    return wrong


async def _all_fail(watch: Watch, calls: Holds, what: str, fail: Callable[[Bus], Any]) -> int:
    """Everything that waits at once; half of it in a group."""
    with Lines(1, replies()) as lines:
        bus = Bus(lines.ports[0])
        turn = Round(bus, watch, calls)
        await bus.__aenter__()
        await asyncio.sleep(0.2)
        axes = [Hcp2Controller(bus, node) for node in NODES]
        values = {axis.element(n): value_of(axis.node.address, n) for axis in axes for n in ELEMENTS}
        group = _group(bus, "large", 0.4, list(values))
        await asyncio.sleep(1.0)
        reading = [asyncio.create_task(point.read()) for point in (list(values) * 2)[:MOST_WAITING]]
        await asyncio.sleep(0)
        await turn.hold(f"{what} with {len(values)} points and {MOST_WAITING} waiting", lambda: fail(bus), 0.3)
        wrong = wrong_in(group, values)
        got = await asyncio.gather(*reading, return_exceptions=True)
        asked = (list(values) * 2)[:MOST_WAITING]
        wrong += sum(not isinstance(v, BusError) and v != values[point] for v, point in zip(got, asked, strict=True))
        await bus.__aexit__(None, None, None)
    return wrong


def _lose(bus: Bus) -> None:
    bus._pump.connection_lost(OSError("unplugged"))


def _close(bus: Bus) -> Awaitable[None]:
    return bus.__aexit__(None, None, None)


async def _one_large_group(turn: Round, values: dict[Point[Any], float]) -> int:
    bus, points = turn.bus, list(values)
    cut = points[: len(points) // 10]
    group = await turn.hold("poll_group() of 500 points", lambda: _group(bus, "large", 0.4, points), 1.0)
    await turn.hold("a cycle of 500 points", lambda: None, 0.8)
    await turn.hold("PollGroup.demand()", group.demand, 0.2)
    await turn.hold("PollGroup.remove() of 50 points", lambda: group.remove(*cut), 0.5)
    await turn.hold("PollGroup.add() of 50 points", lambda: group.add(*cut), 0.5)
    await turn.hold("PollGroup.statistics()", group.statistics)
    await turn.hold("PollGroup.planned()", group.planned)
    streams = await turn.hold(f"PollGroup.subscribe(), {STREAMS} times", lambda: _subscribed(group))
    readers = [asyncio.create_task(_read(stream)) for stream in streams]
    await turn.hold(f"a snapshot for {STREAMS} streams", lambda: None, 0.8)
    await turn.hold(f"Stream.close(), {STREAMS} times", lambda: [stream.close() for stream in streams])
    await asyncio.gather(*readers)
    await turn.hold("plan_at_once() of 500 points", lambda: bus._plan_at_once(()))
    await turn.hold("plan() of 500 points", bus.plan)
    await turn.hold("worst_case_wait() of 500 points", bus.worst_case_wait)
    wrong = wrong_in(group, values)
    await turn.hold("PollGroup.close() of 500 points", group.close)
    return wrong


async def _many_groups(turn: Round, values: dict[Point[Any], float]) -> int:
    bus, points = turn.bus, list(values)
    groups: list[PollGroup] = []
    for number in range(GROUPS - 1):
        groups.append(_group(bus, str(number), PERIODS[number % len(PERIODS)], _some(points, number)))
        await asyncio.sleep(0)
    some = _some(points, GROUPS)
    groups.append(await turn.hold("poll_group(), the 200th", lambda: _group(bus, "last", 0.3, some), 2.0))
    await turn.hold("cycles of 200 groups", lambda: None, 1.0)
    await turn.hold("plan_at_once() of 200 groups", lambda: bus._plan_at_once(()))
    await turn.hold("plan() of 200 groups", bus.plan)
    await turn.hold("worst_case_wait() of 200 groups", bus.worst_case_wait)
    await turn.hold("Bus.statistics()", bus.statistics)
    await turn.hold("Bus.reset_statistics()", bus.reset_statistics)
    await turn.hold("Node.statistics()", bus.nodes[0].statistics)
    await turn.hold("Bus.latest()", lambda: bus.latest(points[0]))
    await turn.hold("Point.read(max_age=)", lambda: points[0].read(max_age=10.0))
    await turn.hold("PollGroup.close(), one of 200", groups.pop().close)
    wrong = sum(wrong_in(group, values) for group in groups)
    for group in groups[:-10]:
        group.close()
        await asyncio.sleep(0)
    return wrong


async def _requests(turn: Round, points: list[Point[Any]]) -> None:
    node = Node.of(points[0])
    await turn.hold("Node.request()", lambda: node.request(hcp2.Read(1)))
    await turn.hold("Node.timed_request()", lambda: node.timed_request(hcp2.Read(1)))
    await turn.hold("Node.probe()", node.probe)
    await turn.hold("Node.suspend()", lambda: node.suspend(0.0))
    await turn.hold("Bus.node()", lambda: turn.bus.node(hcp2.PROFILE, 200))
    reading = [asyncio.create_task(point.read()) for point in (points * 2)[:WAITING]]
    await asyncio.sleep(0)
    await turn.hold(f"a request behind {WAITING} others", lambda: node.request(hcp2.Read(1)))
    await asyncio.gather(*reading, return_exceptions=True)


def _group(bus: Bus, name: str, period: float, points: list[Point[Any]]) -> PollGroup:
    return bus.poll_group(name, period=period, points=points)


def _some(points: list[Point[Any]], number: int) -> list[Point[Any]]:
    first = 7 * number % (len(points) - POINTS_EACH)
    return points[first : first + POINTS_EACH]


def _subscribed(group: PollGroup) -> list[Any]:
    return [group.subscribe() for _ in range(STREAMS)]


async def _read(stream: Any) -> None:
    async for _ in stream:
        pass


# a line with traffic


def _running_line(options: Options, outcome: Outcome) -> None:
    """What is added in one callback by the application holds the loop by its own number of calls."""
    tally = Traffic()
    for _ in range(options.pick(5, 1)):
        watched(lambda watch: _add_to_traffic(watch, tally, options.pick(2.0, 1.0)))
    outcome.wrong += tally.wrong
    placed = min(tally.placed)
    hold = median(tally.holds)
    table = Table(
        f"{GROUPS} groups added in one callback to a line of {SETTINGS.baudrate} baud with traffic",
        (
            "replies",
            "wrong",
            "failed",
            "maximum reply delay raised",
            "slowest before ms",
            "slowest while ms",
            "longest hold ms",
        ),
    )
    table.row(tally.right, tally.wrong, tally.failed, tally.raised, tally.slowest[False], tally.slowest[True], hold)
    table.notes.append(f"slowest: from asking to the value, of two callers; {placed} groups polled in the end")
    outcome.tables.append(table)
    outcome.claims += [
        Claim(f"failed replies while {GROUPS} groups are added to a healthy line", tally.failed, 0),
        Claim("nodes whose maximum reply delay was raised by that", tally.raised, 0),
        Claim(f"longest hold of the loop, ms: after {GROUPS} groups were added", hold, WANTED_MS),
        Claim("groups that were polled in the end", placed, GROUPS, at_most=False),
    ]


class Traffic:
    """What became of a line's traffic; times in milliseconds, `slowest` before and while groups were added."""

    def __init__(self) -> None:
        self.right = self.wrong = self.failed = self.raised = 0
        self.placed: list[int] = []
        self.holds: list[float] = []
        self.adding = False
        self.slowest = {False: 0.0, True: 0.0}


async def _add_to_traffic(watch: Watch, tally: Traffic, seconds: float) -> int:
    with Lines(1, replies(), settings=SETTINGS, delay=DELAY) as lines:
        async with Bus(lines.ports[0]) as bus:
            axes = [Hcp2Controller(bus, node) for node in NODES]
            points = [axis.element(element) for axis in axes for element in ELEMENTS]
            with contextlib.suppress(BusError):
                await axes[0].read(1)
            tally.adding = False
            callers = [asyncio.create_task(_ask(axes[number::2], tally)) for number in range(2)]
            await asyncio.sleep(seconds)
            tally.adding = True
            groups = [_group(bus, str(n), 10 * PERIODS[n % len(PERIODS)], _some(points, n)) for n in range(GROUPS)]
            await asyncio.sleep(0)
            watch.take()
            await asyncio.sleep(2 * seconds)
            tally.holds.append(watch.take().own)
            for caller in callers:
                caller.cancel()
            await asyncio.gather(*callers, return_exceptions=True)
            tally.placed.append(sum(group.poll.placed for group in groups))
            tally.failed += sum(group.statistics().bad for group in groups)
            tally.raised += sum(
                node.statistics().max_reply_delay > hcp2.PROFILE.timings.read.max_reply_delay for node in bus.nodes
            )
    return 0


async def _ask(axes: list[Hcp2Controller], tally: Traffic) -> None:
    while True:
        for axis in axes:
            asked = time.perf_counter()
            try:
                value = await axis.read(1)
            except BusError:
                tally.failed += 1
            else:
                right = value == value_of(axis.node.address, 1)
                tally.right += right
                tally.wrong += not right
                tally.slowest[tally.adding] = max(tally.slowest[tally.adding], 1000 * (time.perf_counter() - asked))
