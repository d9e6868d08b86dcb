"""Failed logins at an interface: reported on its standard error, and to the owner of the line, which counts them."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable
from functools import partial

from busmaster.app.interfaces.following import Following
from busmaster.app.service.refusals import OTHERS, LimitedReport, failed_text
from busmaster.bounds import MOST_REPORTED
from busmaster.errors import LineDown

TELL_EVERY = 1.0
"""Seconds from one message to the line's owner to the next: a guesser fails a thousand times a second."""


class FailedLogins:
    """Takes note of failed logins at `interface`.

    `tell` is told of them at most once a minute, the line's owner once in TELL_EVERY, as soon as it is there.
    """

    def __init__(self, interface: str, line: Following, tell: Callable[[str], None]) -> None:
        self._interface = interface
        self._line = line
        self._report = LimitedReport(tell, partial(failed_text, interface))
        self._untold: Counter[str] = Counter()
        self._timer: asyncio.TimerHandle | None = None

    def note(self, peer: str) -> None:
        """Take note of a failed login of a peer."""
        self._report.note(peer)
        self._untold[peer if peer in self._untold or len(self._untold) < MOST_REPORTED else OTHERS] += 1
        if self._timer is None:
            self._tell_later()

    def _tell_later(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(TELL_EVERY, self._tell_owner)

    def _tell_owner(self) -> None:
        self._timer = None
        try:
            self._line.remote.report_failed_logins(self._interface, self._untold)
        except LineDown:
            self._tell_later()
        else:
            self._untold.clear()
