"""Store and forward: while an output is down, its queue can go to disk, from which a restarted process continues.

Theory of operation. While the output is down, and when it ends, the thread moves the queue from memory to its spool.
Items on disk are older than all items in memory, so they are delivered first, and new items are appended to them. They
are deleted from disk after delivery: after a crash in between they are delivered twice, but never lost.
"""

from __future__ import annotations

import os
import sqlite3
import time
from abc import abstractmethod
from collections.abc import Callable, Iterable

from busmaster import InvalidCommand
from busmaster.app.outputs.base import BATCH, Output, check_folder
from busmaster.app.outputs.settings import SpillingSettings
from busmaster.app.outputs.spool import Record, Spool

HURRY = 2.0
"""Seconds from the request to end until what could not be delivered goes to disk: less than an output has to end."""
SPILL_EVERY = 0.2
"""Seconds between two movings of what waits to disk, while the output is down."""


class SpillingOutput(Output):
    """An output with a spool, if its settings name one. All of it is on the output's thread."""

    def __init__(self, kind: str, settings: SpillingSettings, report: Callable[[str], None] = lambda _: None) -> None:
        super().__init__(kind, settings, report)
        self._mode = settings.mode
        self._spill = settings.spill
        self._most_spilled = settings.spill_values
        self._spool: Spool | None = None
        self._spool_error = ""
        if self._spill is not None:
            check_folder(self._spill)

    @abstractmethod
    def hold(self, most: int) -> bool:
        """Take what waits in hand, up to so many values, and return whether there is anything.

        What could not be delivered is still in hand, and comes first.
        """

    @abstractmethod
    def records(self) -> Iterable[Record]:
        """Return the items in hand, in their form on disk."""

    @abstractmethod
    def let_go(self) -> int:
        """Empty the hand, and return how many values were in it."""

    def succeed(self, before: Output) -> None:
        super().succeed(before)
        if isinstance(before, SpillingOutput) and before.spilled and before._spill != self._spill:
            self._report(f"{self.kind}: {before.spilled} values stay in {before._spill}, which is not used any more")

    def open_spool(self) -> None:
        """Open the spool, and count its items. An output begins its work with this.

        A spool that cannot be opened is reported. Raises InvalidCommand if it may contain items, because newer values
        must not overtake them.
        """
        if self._spill is None or self._spool is not None:
            return
        try:
            self._spool = Spool(
                self._spill,
                self._most_spilled,
                self.kind,
                lambda text: self._report(f"{self.kind}: {text}"),
                mode=self._mode,
                strict=self.is_strict,
            )
        except InvalidCommand as error:
            if os.path.isfile(self._spill) and os.path.getsize(self._spill):
                raise
            self._report_once(str(error))
        else:
            self.spilled = self._spool.values  # first: the line's loop must never take it for more in memory
            self.found += self._spool.values

    def put_by(self) -> None:
        """Move the queue from memory to disk. Items that the disk does not accept stay in memory, reported once."""
        if self._spill is None:
            return
        try:
            self.open_spool()
        except InvalidCommand:
            return  # the output stays down, and reports this as the reason
        while self._spool is not None and self.hold(BATCH):
            try:
                lost = self._spool.put(self.records())
            except sqlite3.Error as error:
                self.put_back()
                self._report_once(f"{self._spill}: {error}")
                return
            self.lost += lost  # first, for the same reason
            self.spilled += self.let_go() - lost
            self._spool_error = ""

    def forwarded(self, up_to: int, records: Iterable[Record]) -> None:
        """Delete delivered items from disk, and append new items to the rest."""
        assert self._spool is not None
        values = sum(record.values for record in records)
        self._spool.remove(up_to, values)
        self.written += values
        self.spilled = self._spool.values
        if self.spilled:
            self.put_by()

    def rest(self, seconds: float) -> None:
        """Wait, or until the output is stopped. New items of an output that is down go to disk, if permitted."""
        over = time.monotonic() + seconds
        while not self._stop.is_set() and time.monotonic() < over:
            self.put_by()
            self._stop.wait(min(SPILL_EVERY, seconds))

    def _run(self) -> None:
        """Work until stopped. The rest in memory then goes to disk, if permitted."""
        try:
            super()._run()
        finally:
            self.put_by()
            if self._spool is not None:
                self._spool.close()

    def _report_once(self, error: str) -> None:
        if error != self._spool_error:
            self._spool_error = error
            self._report(f"{self.kind}: {error}")
