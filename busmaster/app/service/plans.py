"""Plans of a line: how clients request them, and how they are sent."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from busmaster import Bus, LineSettings, Priority, ext
from busmaster.app.service.encoding import protocol_of
from busmaster.app.service.messages import encode_timings, timings_of, value_of
from busmaster.bounds import MOST_PLANNED_GROUPS, MOST_PLANNED_READS
from busmaster.errors import InvalidCommand
from busmaster.ext import (
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
    whole_number,
)

PAUSE = 0.005
"""Seconds between two milliseconds of calculation: clients that request one plan after the other take a sixth of the
owner's processor time at most."""

SHORTEST, LONGEST = 0.001, 86_400.0
"""Seconds of the period of a planned group: the timetable is played through cycle by cycle."""


class Planner:
    """Calculates the plans that clients request: one at a time, so that the owner's loop has time for its line."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._turn = asyncio.Lock()

    async def plan(self, more: Sequence[PlannedGroup]) -> dict[str, Any]:
        """Return the plan as it is sent. Raises InvalidCommand for a line with too many groups."""
        async with self._turn:
            _check_groups(len(self._bus.groups) + len(more))
            return encode_plan(await ext.plan_with_pauses(self._bus, *more, pause=PAUSE))


def encode_groups(groups: Sequence[PlannedGroup]) -> list[dict[str, Any]]:
    """Return planned groups as they are sent. Raises InvalidCommand for those that cannot be."""
    if any(group.merge for group in groups):
        raise InvalidCommand("merges of planned groups cannot be sent to the program that owns the line")
    _check_groups(len(groups))
    _check_size(sum(len(group.reads) for group in groups))
    for _, command in (read for group in groups for read in group.reads):
        _check_reads(command)
    return [
        {
            "name": group.name,
            "period": _period(group.period),
            "phase": group.phase,
            "priority": group.priority,
            "reads": [
                {
                    "protocol": node.profile.name,
                    "address": node.address,
                    "command": protocol_of(node.profile.name).write_down(command),
                    "timings": encode_timings(node.timings),
                    "reply_time": node.reply_time,
                }
                for node, command in group.reads
            ],
        }
        for group in groups
    ]


def groups_of(decoded: Any, bus: Bus) -> list[PlannedGroup]:
    """Return the planned groups that a client has sent: nodes of the line are as the line has measured them.

    Raises InvalidCommand for what no planned group is.
    """
    if not isinstance(decoded, list) or not all(isinstance(group, dict) for group in decoded):
        raise InvalidCommand("the groups of a plan are a list of objects")
    _check_size(sum(len(group["reads"]) for group in decoded))
    known = {(node.profile.name, node.address): node.planned() for node in bus.nodes}
    return [
        PlannedGroup(
            str(group["name"])[:80],
            _period(group["period"]),
            [_read(read, known) for read in group["reads"]],
            None if group.get("phase") is None else seconds(group["phase"], "a phase"),
            checked_priority(group.get("priority", Priority.POLL)),
        )
        for group in decoded
    ]


def _period(decoded: Any) -> float:
    if not SHORTEST <= (period := seconds(decoded, "a period")) <= LONGEST:
        raise InvalidCommand(f"the period of a planned group is {SHORTEST:g} to {LONGEST:g} s, not {period:g}")
    return period


def _read(decoded: Mapping[str, Any], known: Mapping[tuple[str, int], PlannedNode]) -> tuple[PlannedNode, Any]:
    protocol = protocol_of(decoded["protocol"])
    address = whole_number(decoded["address"], 0, 2**31, "an address")
    command = protocol.read_back(decoded["command"])
    _check_reads(command)
    if (node := known.get((protocol.name, address))) is not None:
        return node, command
    protocol.profile.check_address(address)
    times, reply_time = timings_of(decoded.get("timings")), decoded.get("reply_time")
    if isinstance(times, Learned):
        times = times.document
    reply_time = None if reply_time is None else seconds(reply_time, "a reply time")
    return PlannedNode(protocol.profile.with_default_merge(), address, times, reply_time), command


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


def encode_plan(plan: Plan) -> dict[str, Any]:
    """Return a plan as it is sent."""
    return {**asdict(plan), "worst_waits": [plan.worst_waits[priority] for priority in Priority]}


def plan_of(decoded: Mapping[str, Any]) -> Plan:
    """Return the plan that was sent."""
    plan = value_of(decoded)
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
