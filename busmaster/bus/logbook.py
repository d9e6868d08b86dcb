"""The log of a line (R14): changes of state, not more often than a person can read."""

from __future__ import annotations

import logging
from collections.abc import Hashable

from busmaster.arbiter.events import (
    CameUnexpected,
    LineChange,
    LineChanged,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.bus.alarms import AlarmChanged, BusEvent

logger = logging.getLogger("busmaster")

PAUSE = 10.0
"""Seconds for which a repeated message is logged once. The next line has the number of repetitions."""


class Logbook:
    """The log of one line. `name` is the port's."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._written: dict[Hashable, tuple[float, int]] = {}

    def note(self, event: BusEvent, now: float) -> None:
        """Log a change of a node or the line, a collision, a new maximum reply delay, a failed opening, or an alarm."""
        if isinstance(event, NodeChanged):
            level = logging.WARNING if event.after is Health.DOWN else logging.INFO
            text = f"{event.node.label} is {event.after.value} (was {event.before.value})"
            self._write((event.node, event.after), level, text, now)
        elif isinstance(event, LineChanged):
            level = logging.WARNING if event.change in (LineChange.DOWN, LineChange.NOISY) else logging.INFO
            because = f": {event.cause}" if event.cause else ""
            self._write(event.change, level, f"the line is {event.change.value}{because}", now)
        elif isinstance(event, MaxReplyDelayRaised):
            text = (
                f"{event.node.label} replied after {event.age * 1000:.0f} ms; "
                f"maximum reply delay raised to {event.max_reply_delay * 1000:.0f} ms"
            )
            self._write((event.node, MaxReplyDelayRaised), logging.WARNING, text, now)
        elif isinstance(event, MaxReplyDelayLowered):
            text = (
                f"{event.node.label} has replied in time for an hour; "
                f"maximum reply delay lowered to {event.max_reply_delay * 1000:.0f} ms"
            )
            self._write((event.node, MaxReplyDelayLowered), logging.INFO, text, now)
        elif isinstance(event, RepliesLate):
            text = (
                f"{event.node.label} replies after {event.age * 1000:.0f} ms, later than its reply window of "
                f"{event.window * 1000:g} ms; its values are marked late"
            )
            self._write((event.node, RepliesLate), logging.WARNING, text, now)
        elif isinstance(event, PortFailed):
            text = f"cannot connect: {event.cause}" + (f"; {event.hint}" if event.hint else "")
            # With the cause: another reason is logged at once (R13).
            self._write((PortFailed, event.cause), logging.WARNING, text, now, event.bug)
        elif isinstance(event, AlarmChanged):
            level = logging.WARNING if event.active else logging.INFO
            # With `active`: the end of a short alarm must not be hidden by the line for its begin.
            self._write((AlarmChanged, event.point.key, event.limit, event.active), level, event.text, now)
        elif isinstance(event, CameUnexpected) and event.collision:
            text = f"the echo differs from the bytes sent: a collision ({event.data.hex(' ')})"
            self._write(CameUnexpected, logging.WARNING, text, now)

    def failed_hook(self, label: str, error: Exception) -> None:
        """Log that a user's on_return hook raised an exception."""
        logger.error("%s: the on_return hook of %s failed", self._name, label, exc_info=error)

    def failed_choice(self, group: str, error: Exception) -> None:
        """Log that a merge, or the line time of a protocol's exchange, raised an exception."""
        logger.error("%s: the exchanges of poll group %r could not be chosen", self._name, group, exc_info=error)

    def rounded(self, node: NodeRecord, what: str, now: float) -> None:
        """Log that a write has sent a rounded value: `what` is the text of its `Rounding`."""
        text = f"{node.label}: {what}; round it, or declare the decimals of the parameter"
        # By parameter and not by value: a program that calculates values writes a different one each time.
        self._write((node, what.partition(" = ")[0]), logging.WARNING, text, now)

    def _write(self, key: Hashable, level: int, text: str, now: float, bug: BaseException | None = None) -> None:
        # R14: by node and state, so that a flapping node does not hide the messages of another one.
        last, more = self._written.get(key, (-PAUSE, 0))
        if now - last < PAUSE:
            self._written[key] = (last, more + 1)
            return
        self._written[key] = (now, 0)
        again = f" ({more} more since the last such line)" if more else ""
        logger.log(level, "%s: %s%s", self._name, text, again, exc_info=bug)
