"""Plans of a line: how clients request them, and how they are sent."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from busmaster import Bus, InvalidCommand, LineSettings, Priority, ext
from busmaster.app.bounds import MOST_PLANNED_GROUPS, MOST_PLANNED_READS
from busmaster.app.service.client_messages import PlannedGroupForm, PlannedRead
from busmaster.app.service.fields import protocol_of
from busmaster.app.service.messages import encode_value, value_of
from busmaster.app.service.owner_messages import PlanResult
from busmaster.app.service.reply_times import encode_timings, timings_of
from busmaster.app.service.typed import convert, to_builtins
from busmaster.ext import (
    LONGEST_PERIOD,
    SHORTEST_PERIOD,
    Command,
    GroupPlan,
    Learned,
    Losses,
    MergedReads,
    Plan,
    PlannedGroup,
    PlannedNode,
    checked_priority,
    seconds,
)

PAUSE = 0.005
"""Seconds between two milliseconds of calculation: clients that request one plan after the other take a sixth of the
owner's processor time at most."""


class Planner:
    """Calculates the plans that clients request: one at a time, so that the owner's loop has time for its line."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._turn = asyncio.Lock()

    async def plan(self, more: Sequence[PlannedGroup]) -> PlanResult:
        """Return the plan as it is sent. Raises InvalidCommand for a line with too many groups."""
        async with self._turn:
            _check_groups(len(self._bus.groups) + len(more))
            return encode_plan(await ext.plan_with_pauses(self._bus, *more, pause=PAUSE))


def encode_groups(groups: Sequence[PlannedGroup]) -> list[PlannedGroupForm]:
    """Return planned groups as they are sent. Raises InvalidCommand for those that cannot be."""
    if any(group.merge for group in groups):
        raise InvalidCommand("merges of planned groups cannot be sent to the program that owns the line")
    _check_groups(len(groups))
    _check_size(sum(len(group.reads) for group in groups))
    for _, command in (read for group in groups for read in group.reads):
        _check_reads(command)
    return [
        PlannedGroupForm(
            group.name,
            _period(group.period),
            [_encode_read(node, command) for node, command in group.reads],
            group.phase,
            checked_priority(group.priority),
        )
        for group in groups
    ]


def _period(period: float) -> float:
    if not SHORTEST_PERIOD <= (period := seconds(period, "a period")) <= LONGEST_PERIOD:
        raise InvalidCommand(
            f"the period of a planned group is {SHORTEST_PERIOD:g} to {LONGEST_PERIOD:g} s, not {period:g}"
        )
    return period


def _encode_read(node: PlannedNode, command: Command[Any]) -> PlannedRead:
    return PlannedRead(
        node.profile.name,
        node.address,
        protocol_of(node.profile.name).write_down(command),
        encode_timings(node.timings),
        node.reply_time,
    )


def groups_of(forms: Sequence[PlannedGroupForm], bus: Bus) -> list[PlannedGroup]:
    """Return the planned groups that a client has sent: nodes of the line are as the line has measured them.

    Raises InvalidCommand for groups that cannot be planned.
    """
    _check_size(sum(len(group.reads) for group in forms))
    known = {(node.profile.name, node.address): node.planned() for node in bus.nodes}
    return [
        PlannedGroup(
            group.name[:80], group.period, [_read(read, known) for read in group.reads], group.phase, group.priority
        )
        for group in forms
    ]


def _read(form: PlannedRead, known: Mapping[tuple[str, int], PlannedNode]) -> tuple[PlannedNode, Any]:
    protocol = protocol_of(form.protocol)
    command = protocol.read_back(form.command)
    _check_reads(command)
    if (node := known.get((protocol.name, form.address))) is not None:
        return node, command
    protocol.profile.check_address(form.address)
    times = timings_of(form.timings)
    if isinstance(times, Learned):
        times = times.document
    return PlannedNode(protocol.profile.with_default_merge(), form.address, times, form.reply_time), command


def _check_reads(command: Command[Any]) -> None:
    if getattr(command, "writes", False):
        raise InvalidCommand(f"a poll group only reads, and {command} writes")


def _check_groups(groups: int) -> None:
    if groups > MOST_PLANNED_GROUPS:
        raise InvalidCommand(
            f"a plan for a client has {MOST_PLANNED_GROUPS} groups at most, and not {groups}: use busmaster plan"
        )


def _check_size(reads: int) -> None:
    if reads > MOST_PLANNED_READS:
        raise InvalidCommand(f"a client has {MOST_PLANNED_READS} reads planned at once, and not {reads}")


def encode_plan(plan: Plan) -> PlanResult:
    """Return a plan as it is sent."""
    parts = {**asdict(plan), "worst_waits": [plan.worst_waits[priority] for priority in Priority]}
    return convert(encode_value(parts), PlanResult, from_attributes=True)


def plan_of(form: PlanResult) -> Plan:
    """Return the plan that was sent."""
    plan = value_of(to_builtins(form))
    groups = tuple(
        GroupPlan(**{**group, "merged": tuple(MergedReads(**merged) for merged in group["merged"])})
        for group in plan["groups"]
    )
    parts = {
        "line": LineSettings(**plan["line"]),
        "groups": groups,
        "losses": Losses(**plan["losses"]),
        "worst_waits": dict(zip(Priority, plan["worst_waits"], strict=True)),
    }
    return Plan(**{**plan, **parts})
