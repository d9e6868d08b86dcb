"""The safe state that a file declares. `busmaster.app.line.safe_state` sends it.

[safe]
within = 2.0                                 # seconds for all of it
repeatable = ["press/setpoint"]              # a second write does no harm, although the protocol does not define that
writes = { "drive4/speed_reference" = 0, "press/setpoint" = 0 }

Only these writes are sent. Each is repeated until the value reads back or the time is over, and can arrive more than
once. So each must be repeatable, and the point must be readable.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated

from busmaster import InvalidCommand
from busmaster.app.bounds import LONGEST_SAFE_STATE
from busmaster.app.config.keys import Form, Internal, read_section
from busmaster.app.config.table import Table
from busmaster.ext import Between, Parsed


def _check_within(seconds: float) -> float:
    if not 0 < seconds <= LONGEST_SAFE_STATE:
        raise InvalidCommand(f"must be more than 0 and at most {LONGEST_SAFE_STATE:g} seconds, not {seconds}")
    return seconds


def _read_writes(table: Table, key: str) -> Mapping[str, float]:
    values = table.table(key)
    writes: dict[str, float] = {}
    for name in values.data:
        with values.part():
            numbers = values.numbers(name)
            if len(numbers) != 1:
                raise values.error("must be one value; write the others as points of their own", name)
            writes[name] = numbers[0]
    return writes


WRITES = Form("table", {"type": "object", "additionalProperties": {"$ref": "#/$defs/values"}}, _read_writes)


@dataclass(frozen=True, slots=True, kw_only=True)
class SafeSection:
    """The section `[safe]`: values by point, in their order. Without writes there is no safe state."""

    writes: Annotated[Mapping[str, float], WRITES] = field(default_factory=dict)
    """The value to write to each point, in its unit and in this order: `writes = { "winder/setpoint" = 0 }`. One that
    must not be repeated, or cannot be read back, is rejected when the file is read."""
    within: Annotated[float, Between(0, LONGEST_SAFE_STATE, "s", self_checked=True), Parsed(_check_within)] = 2.0
    """The time for all writes, more than 0. Writes that are not confirmed by then are reported, and the exit status is
    1."""
    repeatable: tuple[str, ...] = ()
    """Points that can be written twice without harm although the protocol does not define that."""
    table: Internal[Table] = field(compare=False, repr=False)


def read_safe(table: Table) -> SafeSection:
    """Read `[safe]`. Raises FileError with line and key for an error in it."""
    section = SafeSection(**read_section(table, SafeSection), table=table)
    if table.data and not table.table("writes").data:
        raise table.error('a safe state needs writes; add writes = { "NODE/ITEM" = VALUE }')
    return section
