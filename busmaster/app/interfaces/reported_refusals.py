"""What an interface refuses: reported on its standard error, and to the owner of the line, which counts it."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial

from busmaster import LineDown
from busmaster.app.bounds import MOST_REPORTED
from busmaster.app.interfaces.following import Following
from busmaster.app.service.refusals import OTHERS, LimitedReport, failed_text

REPORT_EVERY = 1.0
"""Seconds from one message to the line's owner to the next: a guesser fails a thousand times a second."""


class ReportedRefusals:
    """Reports to the line's owner what `interface` refuses, once in TELL_EVERY, as soon as the owner is there.

    `kinds` are what this interface can refuse: "logins", "connections", "requests". The owner gets them with each
    connection, so that its metrics have a count of 0 before the first refusal.
    """

    def __init__(self, interface: str, line: Following, *kinds: str) -> None:
        self._interface = interface
        self._line = line
        self._unreported: dict[str, Counter[str]] = {kind: Counter() for kind in kinds}
        self._timer: asyncio.TimerHandle | None = None
        line.on_state(self._announce)

    def note(self, kind: str, peer: str) -> None:
        """Count a refusal of a peer."""
        unreported = self._unreported[kind]
        unreported[peer if peer in unreported or len(unreported) < MOST_REPORTED else OTHERS] += 1
        if self._timer is None:
            self._report_later()

    def _announce(self) -> None:
        if self._line.is_connected:
            self._report_to_owner(self._unreported)

    def _report_later(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(REPORT_EVERY, self._report_what_is_new)

    def _report_what_is_new(self) -> None:
        self._timer = None
        if not self._report_to_owner([kind for kind, counts in self._unreported.items() if counts]):
            self._report_later()

    def _report_to_owner(self, kinds: Iterable[str]) -> bool:
        """Report these kinds. Return whether the owner was there."""
        try:
            for kind in kinds:
                self._line.remote.report_refusals(self._interface, kind, self._unreported[kind])
                self._unreported[kind].clear()
        except LineDown:
            return False
        return True


class FailedLogins:
    """Counts failed logins at `interface`. `report` is called at most once a minute; the owner counts them too."""

    def __init__(self, interface: str, line: Following, report: Callable[[str], None]) -> None:
        self._report = LimitedReport(report, partial(failed_text, interface))
        self._refusals = ReportedRefusals(interface, line, "logins")

    def note(self, peer: str) -> None:
        """Take note of a failed login of a peer."""
        self._report.note(peer)
        self._refusals.note("logins", peer)
