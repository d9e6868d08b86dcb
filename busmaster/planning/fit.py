"""Checks whether a schedule fits a line. Pure calculation with profiles, commands and periods.

`plan` calculates the line load, the cycle time of each group, which group will miss cycles and what would fit, and the
longest wait in the worst case. Reply times are measured or given; if neither is known, half of `late_after` is assumed.
All times are in seconds.
"""

from __future__ import annotations

import heapq
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import count
from math import ceil, floor, inf, log10
from typing import Any

from busmaster.arbiter.backlog import SHARE
from busmaster.arbiter.schedule import SLICE, Priority, Schedule, line_time
from busmaster.arbiter.transaction import Poll
from busmaster.contract.exchange import Command
from busmaster.contract.profile import LineSettings
from busmaster.planning.losses import Losses, LostAttempts, losses
from busmaster.planning.merging import WEIGHING, Merge, Served, at_once, cheapest
from busmaster.planning.worst_case import ALONE, Bounds, PlannedNode, Read, Sharing, bound_steps, unanswered

COMFORT = 0.9
"""Share of the line that a schedule may use. The rest is for commands, retries and probes."""
BAUDRATES = (1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
HORIZON = 10
"""Periods of the slowest group for which the timetable is simulated, at most TIMETABLE exchanges."""
TIMETABLE = 20_000
PIECE = 32
"""Exchanges of the timetable simulated in one step."""


@dataclass(frozen=True, slots=True)
class PlannedGroup:
    """A planned poll group: its reads, by node, once per period.

    `merge`: optional cheaper exchanges, in addition to those of the profiles.
    """

    name: str
    period: float
    reads: Sequence[Read]
    phase: float | None = None
    priority: Priority = Priority.POLL
    merge: Sequence[Merge] = ()


@dataclass(frozen=True, slots=True)
class MergedReads:
    """One merged exchange of a group: how many single commands it replaces, and its saving per cycle."""

    node: str
    command: str
    serves: int
    saved: float


@dataclass(frozen=True, slots=True)
class GroupPlan:
    """The result for one group. `values` are read in `exchanges` that take `line_time` seconds per cycle.

    `cycle`, `longest_cycle`: mean and longest time from a cycle's due time to its last value, without disturbances.
    `missed`: share of cycles that cannot start in time, so that the actual period is `achieved` seconds. `worst_wait`,
    `worst_cycle`: the bounds of R9 from due time to start and to end. `fitting_period`: shortest period of this group
    with which the schedule would fit comfortably. None if it already fits, or if this group alone cannot make it
    fit. `could_save`: savings per cycle by merges that are not enabled.
    """

    name: str
    period: float
    values: int
    exchanges: int
    line_time: float
    cycle: float
    longest_cycle: float
    missed: float
    achieved: float
    worst_wait: float
    worst_cycle: float
    merged: tuple[MergedReads, ...]
    fitting_period: float | None
    could_save: float

    @property
    def utilisation(self) -> float:
        """Return the share of the line that it needs."""
        return self.line_time / self.period


@dataclass(frozen=True, slots=True)
class Plan:
    """The result for a line. `utilisation`: share of the line that the schedule needs; above 1 it does not fit.

    A command waits at most `typical_wait` on a healthy line (one exchange), and `dead_wait` behind a node that does not
    reply. `worst_waits`: the bounds of R9 for one more request of each class. `fitting_baudrate`: lowest usual baud
    rate at which the schedule would fit comfortably. None if it already fits, if no rate is sufficient, or if the
    devices of a protocol support only one rate.
    """

    line: LineSettings
    utilisation: float
    groups: tuple[GroupPlan, ...]
    typical_wait: float
    dead_wait: float
    worst_waits: Mapping[Priority, float]
    fitting_baudrate: int | None
    losses: Losses

    @property
    def fits(self) -> bool:
        """Return True if no cycle is missed without disturbances."""
        return self.utilisation <= 1 and not any(group.missed for group in self.groups)

    @property
    def advice(self) -> tuple[str, ...]:
        """Return what does not fit and what would, one sentence each. Empty if the schedule fits comfortably."""
        return tuple(_advice(self))


def plan(
    groups: Iterable[PlannedGroup],
    *,
    line: LineSettings,
    receive_latency: float = 0.0,
    others: Iterable[Read] = (),
    could_merge: Sequence[Merge] = (),
    sharing: Sharing = ALONE,
) -> Plan:
    """Calculate the load of these poll groups on this line.

    `others`: further requests, which the worst case includes together with a probe of each node. `could_merge`: merges
    to evaluate that no group has enabled. `sharing`: other programs on the line. Raises InvalidCommand for an invalid
    period or phase.
    """
    return at_once(
        plan_steps(
            groups,
            line=line,
            receive_latency=receive_latency,
            others=others,
            could_merge=could_merge,
            sharing=sharing,
        )
    )


def plan_steps(
    groups: Iterable[PlannedGroup],
    *,
    line: LineSettings,
    receive_latency: float = 0.0,
    others: Iterable[Read] = (),
    could_merge: Sequence[Merge] = (),
    sharing: Sharing = ALONE,
) -> Generator[int, None, Plan]:
    """Calculate as `plan` does, in steps. Each yields the units of work it took, of about a microsecond."""
    drafts: list[_Draft] = []
    for group in groups:
        drafts.append(_Draft(group, line.byte_time))
        yield from drafts[-1].weigh()
    asked = [(node, served.command) for draft in drafts for node, served in draft.exchanges]
    low = sum(len(draft.costs) for draft in drafts if draft.group.priority is Priority.BACKGROUND)
    polls = sum(len(draft.costs) for draft in drafts) - low
    bound = yield from bound_steps((*asked, *others), line.byte_time, receive_latency, polls, low, sharing)
    utilisation = sum(draft.utilisation for draft in drafts)
    yield from _play(drafts)
    planned = []
    for draft in drafts:
        yield from draft.weigh_further(could_merge)
        planned.append(draft.planned(utilisation, bound))
        yield WEIGHING
    return Plan(
        line=line,
        utilisation=utilisation,
        groups=tuple(planned),
        typical_wait=max((cost for draft in drafts for cost in draft.costs), default=0.0),
        dead_wait=max((draft.unanswered + receive_latency for draft in drafts if draft.costs), default=0.0),
        worst_waits={priority: bound.wait(priority) for priority in Priority},
        fitting_baudrate=(yield from _fitting_baudrate(drafts, line)) if utilisation > COMFORT else None,
        losses=losses(utilisation, [(draft.group.period, draft.lost) for draft in drafts]),
    )


class _Draft:
    """A group during the calculation of its GroupPlan."""

    def __init__(self, group: PlannedGroup, byte_time: float) -> None:
        self.group = group
        self.byte_time = byte_time
        self.exchanges: list[tuple[PlannedNode, Served]] = []
        self.costs: list[float] = []
        self.unanswered = 0.0
        self.lost = LostAttempts()
        self.could_save = 0.0
        self.poll = Poll(group.name, group.period, phase=group.phase)
        self.poll.group = self
        self.finished = 0
        self.total = self.longest = 0.0

    @property
    def utilisation(self) -> float:
        return self.poll.cost / self.group.period

    def note_cycle(self, seconds: float) -> None:
        self.finished += 1
        self.total += seconds
        self.longest = max(self.longest, seconds)

    def weigh(self) -> Generator[int, None, None]:
        """Choose its exchanges and calculate their line time."""
        self.exchanges = yield from _exchanges(self.group, self.group.merge, self.byte_time)
        for node, served in self.exchanges:
            exchange = node.open(served.command)
            self.costs.append(line_time(exchange, self.byte_time, node.reply_time))
            self.unanswered = max(self.unanswered, unanswered(exchange, self.byte_time))
            self.lost.add(node, exchange, self.byte_time)
            yield WEIGHING
        self.poll.cost = sum(self.costs)

    def weigh_further(self, could_merge: Sequence[Merge]) -> Generator[int, None, None]:
        """Calculate the savings of merges that are not enabled."""
        if could_merge:
            merge = (*self.group.merge, *could_merge)
            further = _Draft(replace(self.group, merge=merge), self.byte_time)
            yield from further.weigh()
            self.could_save = max(0.0, self.poll.cost - further.poll.cost)

    def planned(self, utilisation: float, bound: Bounds) -> GroupPlan:
        group, cost = self.group, self.poll.cost
        missed = self.poll.missed / (self.poll.missed + max(1, self.finished))
        left = COMFORT - (utilisation - self.utilisation)
        wait = bound.wait(group.priority, patience=self.poll.patience)
        return GroupPlan(
            name=group.name,
            period=group.period,
            values=len(group.reads),
            exchanges=len(self.costs),
            line_time=cost,
            cycle=self.total / self.finished if self.finished else inf if self.costs else 0.0,
            longest_cycle=self.longest if self.finished or not self.costs else inf,
            missed=missed,
            achieved=group.period / (1 - missed),
            worst_wait=wait,
            worst_cycle=wait + bound.hold,
            merged=tuple(
                MergedReads(node.profile.label(node.address), str(s.command), len(s.serves), s.saved)
                for node, s in self.exchanges
                if s.batch
            ),
            fitting_period=_rounded_up(cost / left) if utilisation > COMFORT and left > 0 else None,
            could_save=self.could_save,
        )


def _exchanges(
    group: PlannedGroup, merges: Sequence[Merge], byte_time: float
) -> Generator[int, None, list[tuple[PlannedNode, Served]]]:
    """Choose the exchanges of each node, each command once."""
    commands: dict[PlannedNode, dict[Command[Any], None]] = {}
    for node, command in group.reads:
        commands.setdefault(node, {})[command] = None
        yield 8
    exchanges = []
    for node, wanted in commands.items():
        own = () if node.profile.merge is None else (node.profile.merge,)
        cost = partial(node.line_time, byte_time=byte_time)
        chosen = yield from cheapest(tuple(wanted), (*own, *merges), cost)
        exchanges += [(node, served) for served in chosen]
    return exchanges


def _play(drafts: Sequence[_Draft]) -> Generator[int, None, None]:
    """Simulate the timetable with the line time of each exchange: earliest deadline first, and BACKGROUND as in R9."""
    schedule, order = Schedule(), count()
    for draft in drafts:
        schedule.add(draft.poll, 0.0)
        yield WEIGHING
    while schedule.unplaced():
        schedule.work(0.0)
        yield SLICE
    waiting: list[tuple[float, int, float, _Draft]] = []
    background: list[tuple[float, int, float, _Draft]] = []

    def release(now: float) -> Generator[int, None, float]:
        """Queue the polls that are due. Returns the time of the next one."""
        while (due := schedule.next_due()) <= now:
            for poll in schedule.release(now):
                draft: _Draft = poll.group
                yield 4 + len(draft.costs)
                queue = background if draft.group.priority is Priority.BACKGROUND else waiting
                poll.remaining = len(draft.costs)
                for cost in draft.costs:
                    heapq.heappush(queue, (poll.due + poll.patience, next(order), cost, draft))
        return due

    end = HORIZON * max((draft.group.period for draft in drafts), default=0.0)
    now = due = 0.0
    streak = 0
    for number in range(TIMETABLE):
        if number % PIECE == 0:
            yield 2 * PIECE
        if not waiting and not background:
            now = max(now, due)
            due = yield from release(now)
        if now >= end:
            break
        if background and (streak >= SHARE or not waiting):
            streak = 0
            _, _, cost, draft = heapq.heappop(background)
        elif waiting:
            streak = streak + 1 if background else 0
            _, _, cost, draft = heapq.heappop(waiting)
        else:
            continue
        now += cost
        if now >= due:
            due = yield from release(now)
        draft.poll.remaining -= 1
        if not draft.poll.remaining:
            draft.note_cycle(now - draft.poll.due)


# what would fit


def _fitting_baudrate(drafts: Sequence[_Draft], line: LineSettings) -> Generator[int, None, int | None]:
    # All share one line: if one device has a fixed rate, no other rate is possible.
    if any(node.profile.fixed_rate for draft in drafts for node, _ in draft.exchanges):
        return None
    for baudrate in BAUDRATES:
        if baudrate > line.baudrate:
            byte_time = replace(line, baudrate=baudrate).byte_time
            utilisation = 0.0
            for draft in drafts:
                faster = _Draft(draft.group, byte_time)
                yield from faster.weigh()
                utilisation += faster.utilisation
            if utilisation <= COMFORT:
                return baudrate
    return None


def _rounded_up(seconds: float) -> float:
    """Round up to two digits, to a period that a person would write."""
    unit = 10.0 ** (floor(log10(seconds)) - 1)
    # 0.14 / 0.01 is slightly more than 14 in floats, and would become 0.15.
    return round(ceil(seconds / unit - 1e-9) * unit, 9)


def _advice(plan: Plan) -> Iterator[str]:
    tight = any(group.longest_cycle > COMFORT * group.period for group in plan.groups)
    if plan.utilisation <= COMFORT and plan.fits and not tight:
        return
    yield f"the schedule needs {plan.utilisation:.0%} of the line; up to {COMFORT:.0%} is comfortable"
    for group in plan.groups:
        if group.missed:
            yield (
                f"group {group.name!r} will miss {group.missed:.0%} of its cycles: "
                f"one every {group.achieved:.3g} s in place of {group.period:g} s"
            )
        elif group.longest_cycle > COMFORT * group.period:
            yield f"group {group.name!r} has no time to spare: a cycle takes up to {group.longest_cycle:.3g} s"
        if group.fitting_period is not None:
            yield f"it would fit with a period of {group.fitting_period:g} s for group {group.name!r}"
        if group.could_save:
            share = group.could_save / group.period
            yield f"merged reads would take {share:.0%} of the line off group {group.name!r}, where they are safe"
    if plan.utilisation > COMFORT:
        yield f"it would fit with all periods {plan.utilisation / COMFORT:.2f} times as long"
    if plan.fitting_baudrate is not None:
        yield f"it would fit at {plan.fitting_baudrate} baud"
