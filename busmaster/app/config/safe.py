"""The safe state that a file declares. `busmaster.app.line.safe_state` sends it.

[safe]
within = 2.0                                 # seconds for all of it
repeatable = ["press/setpoint"]              # those that the protocol does not call so, and that harm nobody twice
writes = { "drive4/speed_reference" = 0, "press/setpoint" = 0 }

Nothing is sent unless it stands there. What is sent may arrive more than once, and is repeated until it reads back as
it was written or the time is over: so only a write that may be repeated can be of it, and one that can be read back.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from busmaster.app.config.keys import Key, names_of
from busmaster.app.config.table import Table
from busmaster.bounds import LONGEST_SAFE_STATE

WITHIN = 2.0
KEYS = (
    Key(
        "writes",
        "table",
        'The value that each point is left at, in its unit: `writes = { "winder/setpoint" = 0 }`, in this order. '
        "One that may not be repeated, or cannot be read back, is refused when the file is read.",
    ),
    Key(
        "within",
        "number",
        "The time for all of it, more than 0. What is not confirmed by then is named, and the exit status is 1.",
        f"{WITHIN:g}",
        "s",
        least=0,
        most=LONGEST_SAFE_STATE,
    ),
    Key(
        "repeatable",
        "texts",
        "Points whose write the protocol does not know to be repeatable, and of which only you know that writing them "
        "twice harms nobody.",
    ),
)
"""Of `[safe]`."""


@dataclass(frozen=True, slots=True)
class SafeSection:
    """What `[safe]` says: values by point, in their order. Without writes there is no safe state."""

    within: float
    repeatable: tuple[str, ...]
    writes: Mapping[str, float]
    table: Table = field(compare=False, repr=False)


def read_safe(table: Table) -> SafeSection:
    """Read `[safe]`. Raises FileError, naming line and key, for what is wrong in it."""
    table.only(*names_of(KEYS))
    within = table.number("within", WITHIN)
    if not 0 < within <= LONGEST_SAFE_STATE:
        raise table.error(f"must be more than 0 and at most {LONGEST_SAFE_STATE:g} seconds, not {within}", "within")
    values = table.table("writes")
    writes: dict[str, float] = {}
    for name in values.data:
        with values.part():
            writes[name] = _one(values, name)
    if table.data and not values.data:
        raise table.error('a safe state is of writes: writes = { "NODE/ITEM" = VALUE }')
    return SafeSection(within, table.texts("repeatable", ()), writes, table)


def _one(table: Table, name: str) -> float:
    numbers = table.numbers(name)
    if len(numbers) != 1:
        raise table.error("is one value: write the others as points of their own", name)
    return numbers[0]
