"""What `Bus.events` reports: changes of the line, of its nodes and of alarms."""

from busmaster.arbiter.events import (
    LineChange,
    LineChanged,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.bus.alarms import AlarmChanged, BusEvent
from busmaster.bus.polling import Stream

__all__ = [
    "AlarmChanged",
    "BusEvent",
    "LineChange",
    "LineChanged",
    "MaxReplyDelayLowered",
    "MaxReplyDelayRaised",
    "NodeChanged",
    "PortFailed",
    "RepliesLate",
    "Stream",
]
