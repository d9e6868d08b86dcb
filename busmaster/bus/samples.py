"""The result of one point in a cycle: value, time and quality."""

from __future__ import annotations

import enum
from typing import Generic, NamedTuple, TypeVar

from busmaster.arbiter.transaction import Timeline
from busmaster.errors import BusError

T = TypeVar("T")


class Quality(enum.Enum):
    """Quality of a value.

    GOOD. LATE: the reply began after `late_after`. STALE: older than a write to it. BAD: no value. OVERHEARD: received
    from another master's exchange, of which a part may have been missed.
    """

    GOOD = "good"
    LATE = "late"
    OVERHEARD = "overheard"
    STALE = "stale"
    BAD = "bad"

    @property
    def is_current(self) -> bool:
        """True if this line's master read the value, and no later write is known."""
        return self in (Quality.GOOD, Quality.LATE)


class Sample(NamedTuple, Generic[T]):
    """One point's result in one cycle. Times are on the bus's clock (`bus.now()`), in seconds.

    `value` is None if there is an `error`. `wall`: `finished` in seconds since 1970, by the machine's clock. That clock
    is read once per cycle, so setting it takes effect with the next cycle.
    """

    value: T
    error: BusError | None
    due: float
    started: float | None
    finished: float
    quality: Quality
    timeline: Timeline
    wall: float

    def age(self, now: float) -> float:
        """Return the seconds since the value was requested."""
        return now - (self.finished if self.started is None else self.started)
