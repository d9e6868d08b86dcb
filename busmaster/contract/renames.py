"""Names that have changed since version 0.3. Old names are not accepted; the error contains the new name.

This is the only list of old names: errors, `busmaster migrate` and docs/upgrading.md use it.
"""

from __future__ import annotations

from collections.abc import Iterable

TIMES = {
    "nominal": "late_after",
    "lateness": "max_reply_delay",
    "byte_gap": "inter_byte_timeout",
    "turnaround": "driver_release_time",
}
"""Keys of `timing` in a LINE.toml, and arguments and attributes of `ReplyTiming`."""
_MOVED = {
    **dict.fromkeys(
        (
            "AlarmChanged",
            "LineChange",
            "LineChanged",
            "MaxReplyDelayLowered",
            "MaxReplyDelayRaised",
            "NodeChanged",
            "PortFailed",
            "RepliesLate",
            "Stream",
        ),
        "busmaster.events",
    ),
    **dict.fromkeys(
        (
            "DriverErrors",
            "GroupStatistics",
            "LearnedTimes",
            "LineStatistics",
            "NodeStatistics",
            "Quantiles",
            "Timeline",
        ),
        "busmaster.statistics",
    ),
    **dict.fromkeys(("GroupPlan", "Plan", "PlannedGroup", "PlannedNode"), "busmaster.planning"),
    **dict.fromkeys(("CommandWord", "StatusWord"), "busmaster.protocols.hcp2"),
    **dict.fromkeys(("ProgramStatus",), "busmaster.protocols.msc"),
    **dict.fromkeys(("Learned",), "busmaster.contract.learning"),
    **dict.fromkeys(("Profile",), "busmaster.contract.profile"),
    **dict.fromkeys(("Requester", "RequestOptions"), "busmaster.bus.requester"),
}
ROOT = {name: (where, name) for name, where in _MOVED.items()} | {
    "LatenessLowered": ("busmaster.events", "MaxReplyDelayLowered"),
    "LatenessRaised": ("busmaster.events", "MaxReplyDelayRaised"),
}
"""Names that the root had in 0.2: the module that has the object now, and its name there."""
STATISTICS = {
    "unasked_bytes": "unexpected_bytes",
    "settles": "resyncs",
    "settling": "quiet_time",
    "checks": "sync_reads",
    "doubted": "ambiguous",
}
"""Fields of `LineStatistics`, and metrics of these names."""


def now_called(name: str, known: Iterable[str]) -> str | None:
    """Return the new name of a key or argument, or None if it is not an old name of one of `known`."""
    new = TIMES.get(name)
    return new if new in set(known) else None


def refuse_old_arguments(names: Iterable[str], what: str) -> None:
    """Raise TypeError with the new name if one of these arguments of `what` was renamed."""
    for name in names:
        if name in TIMES:
            raise TypeError(f"{what} takes no argument {name!r}: it is now {TIMES[name]!r}; see docs/upgrading.md")
