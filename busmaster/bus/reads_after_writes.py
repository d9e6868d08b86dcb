"""Reads of points after confirmed writes to them (`read_after_write`)."""

from __future__ import annotations

from collections.abc import Callable, Coroutine, Mapping
from math import nextafter
from typing import Any

from busmaster.arbiter.transaction import ENDED, Priority, Transaction
from busmaster.bus.node import Node, Request
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup
from busmaster.bus.requester import RequestOptions
from busmaster.bus.shared_line import SharedLine
from busmaster.errors import BusError, InvalidCommand


class ReadsAfterWrites:
    """The reads of one line after writes. They belong to the line's owner and have the priority of its polls.

    The confirmation of a write never waits for its read, and commands go before it. If several writes to the same
    quantity are confirmed before its read is sent, one read serves all of them. A read that cannot be sent within the
    period of the group is dropped: the next poll reads the value.
    """

    def __init__(
        self,
        line: SharedLine,
        groups: Mapping[str, PollGroup],
        start: Callable[[Coroutine[Any, Any, None]], None],
    ) -> None:
        self._line = line
        self._groups = groups
        self._start = start
        self._waiting: set[object] = set()
        """The quantities with a queued or running read."""
        self.reset()

    def reset(self) -> None:
        """Reset the counters."""
        self.read = 0
        """Reads that returned a value."""
        self.failed = 0
        """Reads that were not sent in time, or had no reply."""
        self.shared = 0
        """Writes that were served by the queued read of an earlier write."""

    def note(self, write: Transaction, when: float) -> None:
        """Start the reads after a write that has just ended, if it is confirmed and a polled point requests it."""
        if write.error is not None or write.phase is not ENDED:
            return  # unconfirmed: its points are stale until they are polled
        before = nextafter(when, float("-inf"))
        for group in self._groups.values():
            for point in group.read_after_write:
                node = Node.of(point)
                # not after a write to all nodes: it is not confirmed, and reading each node would occupy the line
                if node._record is write.node and self._line.is_stale(point, before):
                    self._want(point, node, group.period)

    def _want(self, point: Point[Any], node: Node, within: float) -> None:
        if point.quantity in self._waiting:
            self.shared += 1
            return
        # Until its read has ended: a read that is on the wire may have been answered before the next write.
        self._waiting.add(point.quantity)
        self._start(self._read(point, node, within))

    async def _read(self, point: Point[Any], node: Node, within: float) -> None:
        """Read a point once and pass its value to the groups that poll it."""
        options = RequestOptions(priority=Priority.POLL, start_within=within)
        try:
            request = Request(point.command, options)
            await node._run(request)
            assert request.transaction is not None
            self.read += 1
            for group in self._groups.values():
                group.take_reading(point, request.transaction)
        except (BusError, InvalidCommand):  # InvalidCommand: the bus was closed or the node given back in the meantime
            self.failed += 1
        finally:
            # In any case: no later write to this quantity would be read otherwise.
            self._waiting.discard(point.quantity)


__all__ = [
    "ReadsAfterWrites",
]
