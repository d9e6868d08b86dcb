"""Limits for writes to one quantity of a node."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from math import isclose
from typing import Any

from busmaster.contract.exchange import Command
from busmaster.contract.places import Placed
from busmaster.errors import InvalidCommand

ROUNDING = 1e-6
"""Relative tolerance of limits: written values are rounded to the resolution of the protocol."""


# Compared by identity: `lift` must not remove the equal limit of another caller.
@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Limit:
    """Limits for writes to the quantity that `read` reads, under any name and in any way it is written.

    `minimum`, `maximum` and `max_step` (largest change from the last confirmed value) are in the unit of the decoded
    value (`decode`); None for no limit. `name` is used in messages. Raises InvalidCommand for limits that allow no
    value, and for quantities that cannot be limited: runs, and words that are never written.
    """

    name: str
    read: Command[Any]
    decode: Callable[[Any], Any] = field(repr=False)
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    max_step: float | None = None
    writable: bool = True

    def __post_init__(self) -> None:
        if not isinstance(self.read, Placed):
            raise InvalidCommand(f"{self.name} cannot be limited: limit each value of it")
        if self.minimum is not None and self.maximum is not None and self.minimum > self.maximum:
            raise InvalidCommand(f"{self.name}: its minimum of {self.minimum} is above its maximum of {self.maximum}")
        # `not ... > 0`, so that nan is rejected too: with it, every step would be too large.
        if self.max_step is not None and not self.max_step > 0:
            raise InvalidCommand(f"{self.name}: max_step is more than 0, not {self.max_step}")

    @property
    def places(self) -> tuple[Hashable, ...]:
        assert isinstance(self.read, Placed)
        return self.read.places

    def touched_by(self, changes: Mapping[Hashable, Any]) -> bool:
        """Return True if a write changes the quantity or a part of it."""
        return any(place in changes for place in self.places)

    def value_after(self, changes: Mapping[Hashable, Any]) -> Any:
        """Return its value after a write. Raises InvalidCommand for a write that changes only a part of it."""
        assert isinstance(self.read, Placed)
        # Half of a 32-bit value, for example: which value results depends on the other half.
        if any(changes.get(place) is None for place in self.places):
            raise InvalidCommand(f"{self.name} has limits: write it as a whole, and alone, so that they can be held")
        return self.decode(self.read.shown(changes))

    def check(self, value: Any) -> None:
        """Raise InvalidCommand with the limit for a value that must not be written."""
        if not self.writable:
            raise InvalidCommand(f"{self.name} may not be written: it is declared writable = false")
        if self.minimum is not None and not (value >= self.minimum or _equal(value, self.minimum)):
            raise InvalidCommand(f"{self.name} = {self.text(value)} is below its minimum of {self.text(self.minimum)}")
        if self.maximum is not None and not (value <= self.maximum or _equal(value, self.maximum)):
            raise InvalidCommand(f"{self.name} = {self.text(value)} is above its maximum of {self.text(self.maximum)}")

    def check_step(self, before: Any, value: Any) -> None:
        """Raise InvalidCommand with the limit for a value that is too far from the current one.

        If the current value is beyond a limit, the step counts from that limit: else no write could bring it back.
        """
        start = before
        if self.maximum is not None and start > self.maximum:
            start = self.maximum
        if self.minimum is not None and start < self.minimum:
            start = self.minimum
        step = abs(value - start)
        if self.max_step is not None and not (step <= self.max_step or _equal(step, self.max_step)):
            beyond = "" if start == before else f" (it is {self.text(before)} now, beyond its limits)"
            raise InvalidCommand(
                f"{self.name} = {self.text(value)} is too far from {self.text(start)}{beyond}: "
                f"its max_step is {self.text(self.max_step)}"
            )

    def text(self, value: float) -> str:
        return f"{value:.10g} {self.unit}".rstrip()


def _equal(value: float, limit: float) -> bool:
    return isclose(value, limit, rel_tol=ROUNDING)
