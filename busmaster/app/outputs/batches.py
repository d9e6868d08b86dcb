"""Outputs that write batch by batch: files and databases."""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from math import inf
from typing import Any, Generic, TypeVar

from busmaster import Point, Sample, Snapshot
from busmaster.app.outputs.base import BATCH, PAUSE, TICK, Item, size_of
from busmaster.app.outputs.settings import SpillingSettings
from busmaster.app.outputs.spilling import HURRY, SpillingOutput
from busmaster.app.outputs.spool import Record
from busmaster.app.service.record import WriteRecord

Formatted = TypeVar("Formatted")

PIECE = 100
"""Values of one cycle after which the thread lets go of the interpreter too."""
SPILLED_AT_ONCE = 200
"""Cycles that are written at once from where they waited on disk."""


class BatchOutput(SpillingOutput, Generic[Formatted]):
    """An output that writes batch by batch. A batch whose `commit` fails is written again as a whole."""

    def __init__(
        self,
        kind: str,
        settings: SpillingSettings,
        report: Callable[[str], None] = lambda _: None,
    ) -> None:
        super().__init__(kind, settings, report)
        self._batch: list[Formatted] = []
        self._items: list[Item] = []
        """What the batch was formatted from."""
        self._hurries_at = inf
        """When it writes nothing more, because it is to end and the rest can go to disk."""

    @abstractmethod
    def format(self, item: Item) -> Formatted | None:
        """Return the item in the form in which it is written; None if it is not written here."""

    @abstractmethod
    def commit(self, batch: list[Formatted]) -> None:
        """Write the whole batch. Raises an error if that fails; the same items are then in the next batch.

        A file or a database must undo a part that it has written. A connection cannot undo the part that it has sent:
        the receiver can get these values twice, so it must accept repeated values.
        """

    @abstractmethod
    def pack(self, formatted: Formatted) -> str:
        """Return a formatted item as text for the disk."""

    @abstractmethod
    def unpack(self, text: str) -> Formatted:
        """Return what `pack` made a text of."""

    @abstractmethod
    def shut(self) -> None:
        """Let go of what `commit` opened. It never raises."""

    def work(self) -> None:
        """Write batch by batch until it is stopped, then the rest: with a spool, as much of it as takes HURRY."""
        self.open_spool()
        try:
            stopped = False
            while not stopped:
                # before the queue is emptied, so that everything offered until then is written
                stopped = self._stop.wait(TICK)
                if self._reopen.is_set():
                    self._reopen.clear()
                    self.shut()
                self._write_spilled()
                while not self.spilled and not self._hurries() and self.hold(BATCH):
                    self.commit(self._batch)
                    self.written += self.let_go()
                    self.up()
        finally:
            self.shut()

    def _hurries(self) -> bool:
        """Return whether the rest must go to disk now: a slow output would be left before it has written all."""
        if self._spool is not None and self._stop.is_set() and self._hurries_at == inf:
            self._hurries_at = time.monotonic() + HURRY
        return time.monotonic() >= self._hurries_at

    def _write_spilled(self) -> None:
        """Write all that is on disk. When all is to end the rest stays there."""
        while self._spool is not None and self.spilled and not self._stop.is_set():
            up_to, records = self._spool.oldest(SPILLED_AT_ONCE)
            self.commit([self.unpack(record.content) for record in records])
            self.forwarded(up_to, records)
            self.up()
            time.sleep(PAUSE)

    def hold(self, most: int) -> bool:
        """Format what waits, up to a batch, and return whether there is one."""
        size = self._size()
        while size < most and (item := self.take()) is not None:
            formatted = self.format(item)
            if formatted is None:
                self.written += size_of(item)  # items that are not written here, such as events in CSV, are not lost
            else:
                self._batch.append(formatted)
                self._items.append(item)
                size += size_of(item)
            if not self._stop.is_set():
                time.sleep(PAUSE)
        return bool(self._batch)

    def records(self) -> Iterator[Record]:
        """Yield the batch as it is kept on disk."""
        for formatted, item in zip(self._batch, self._items, strict=True):
            yield Record(self.pack(formatted), size_of(item))
            if not self._stop.is_set():
                time.sleep(PAUSE)

    def let_go(self) -> int:
        """Forget the batch, which is written or spilled, and return how many values were in it."""
        size, entries = self._size(), self._entries()
        self._batch, self._items = [], []
        for entry in entries:
            self.settle_entry(entry)
        return size

    def put_back(self) -> None:
        """Have the batch wait again."""
        items = self._items
        self._batch, self._items = [], []
        self.wait_again(items)

    @property
    def must_sync(self) -> bool:
        """Return whether the batch must survive a loss of power once it is written."""
        return self.is_strict and bool(self._entries())

    def _size(self) -> int:
        """Return how many values the batch holds."""
        return sum(map(size_of, self._items))

    def _entries(self) -> list[WriteRecord]:
        """Return the audit entries in the batch."""
        return [item for item in self._items if isinstance(item, WriteRecord)]

    def unhurried(self, snapshot: Snapshot) -> Iterator[tuple[Point[Any], Sample[Any]]]:
        """Yield the points and samples of a cycle.

        The thread lets go of the interpreter after each PIECE, so that a cycle of hundreds of points keeps the line's
        loop no longer than one of a few.
        """
        for number, item in enumerate(snapshot.samples.items(), 1):
            yield item
            if number % PIECE == 0 and not self._stop.is_set():
                time.sleep(PAUSE)
