"""What a cycle brings of one point: its value, when it was asked for, and how good it is."""

from __future__ import annotations

import enum
from typing import Generic, NamedTuple, TypeVar

from busmaster.arbiter.transaction import Timeline
from busmaster.errors import BusError

T = TypeVar("T")


class Quality(enum.Enum):
    """GOOD; LATE: begun after `late_after`; STALE: older than a write to it; BAD: no value; OVERHEARD: taken
    from another master's exchange, of which a listener may have missed a part."""

    GOOD = "good"
    LATE = "late"
    OVERHEARD = "overheard"
    STALE = "stale"
    BAD = "bad"

    @property
    def is_current(self) -> bool:
        """The value was read by this line's own master, and nothing is known that would have changed it since."""
        return self in (Quality.GOOD, Quality.LATE)


class Sample(NamedTuple, Generic[T]):
    """One point's outcome in one cycle. Times are the bus's clock (`bus.now()`), in seconds.

    `value` is None where there is an `error`. `wall` is `finished` by the machine's clock, in seconds since 1970: one
    look at that clock serves a cycle, and one that was set is followed with the next.
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
        """Return the seconds since the value was asked for."""
        return now - (self.finished if self.started is None else self.started)
