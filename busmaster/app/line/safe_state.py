"""The safe state of a line: writes that are sent urgently, and verified, when the program leaves the line.

A write may arrive more than once: it is repeated until it reads back as written, or until the time is over. Hence each
write of a safe state must be repeatable and readable.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import anyio

from busmaster import Bus, BusClosed, BusError, InvalidCommand, Node, NotStarted, Priority, ext
from busmaster.app.bounds import LONGEST_SAFE_STATE
from busmaster.app.config.points import NamedPoint
from busmaster.app.service.authorisation import Authorisation, WriteRequest, outcome_of
from busmaster.app.service.permission import Permission
from busmaster.app.service.record import Outcome
from busmaster.ext import Command, Handle, Send

LOOK_AGAIN = 0.05
"""Seconds from a failure to the next try at the same node."""


@dataclass(frozen=True, slots=True)
class SafeWrite:
    """One write of the safe state: a point, and the value that it is left at."""

    point: NamedPoint
    value: float
    node: Node
    command: Command[None]
    prepare: Callable[[float], Send]
    """Makes what writes it and reads it back, in so many seconds."""

    @classmethod
    def of(cls, point: NamedPoint, handle: Handle, value: float, *, repeatable: bool) -> SafeWrite:
        """Check and make one write of the safe state.

        Raises InvalidCommand for what cannot be sent, may not be repeated, or cannot be read back.
        """
        if not point.writable:
            raise InvalidCommand(f"{point.key} is read-only")
        if point.encode is None:
            raise InvalidCommand(f"{point.key} is a run of values; write them one by one, because each is verified")
        command = point.encode(value)
        if not (repeatable or command.idempotent):
            raise InvalidCommand(
                f"{point.key} is not repeatable by its protocol; if a second write does no harm, "
                f'add repeatable = ["{point.key}"]'
            )
        node = Node.of(point)
        # No limit applies when the safe state is sent, so a mistyped value would be. 0 usually stops a drive, so it is
        # allowed below a minimum too.
        if value != 0:
            node.check(command)
        item, number = point.source.item, point.unscaled(value)

        def prepare(within: float) -> Send:
            [send] = ext.prepare_write(
                handle,
                item,
                [number],
                priority=Priority.URGENT,
                idempotent=True,  # defined by the protocol or by `repeatable`
                verify=True,
                safe=True,
                finish_within=within,
            )
            return send

        prepare(LONGEST_SAFE_STATE)  # what would be refused at the end is refused when the file is read
        return cls(point, value, node, command, prepare)


@dataclass(frozen=True, slots=True)
class SafeState:
    """The writes of one file, and the seconds in which all of them are to be confirmed."""

    within: float
    writes: Sequence[SafeWrite]

    def __bool__(self) -> bool:
        return bool(self.writes)

    @property
    def values(self) -> dict[str, float]:
        """Return the value of each point, by its name."""
        return {write.point.key: write.value for write in self.writes}

    def refusal(self, permission: Permission) -> str:
        """Return why a client may not send the safe state, "" if it may."""
        return next(
            (why for write in self.writes if (why := permission.refusal(write.node, write.command))),
            "",
        )

    async def enter(self, authorisation: Authorisation, by: str, *, leaving: bool = True) -> dict[str, BusError | None]:
        """Send all, urgently, read them back, and return by point why it was not confirmed, None if it was.

        From now on the bus rejects all other writes. If the line continues (`leaving` is False), the bus accepts
        writes again afterwards, but discards those that were queued or decided before. Nodes are served at the same
        time, each in the file's order. A failed write is retried until the time is over. `by` is the source in the
        audit log.
        """
        if not self.writes:
            return {}
        take_writes_again = ext.take_only_safe_writes(authorisation.bus)
        try:
            for node in authorisation.bus.nodes:
                node.note_stop()  # also nodes that keep their values: a write decided for them is old too
            return await self._send(authorisation, by)
        finally:
            if not leaving:
                take_writes_again()

    async def _send(self, authorisation: Authorisation, by: str) -> dict[str, BusError | None]:
        bus = authorisation.bus
        deadline = bus.now() + self.within
        by_node: dict[Node, list[Leaving]] = {}
        for write in self.writes:
            by_node.setdefault(write.node, []).append(Leaving(write, authorisation, by))
        leaving = [one for ones in by_node.values() for one in ones]
        try:
            with anyio.CancelScope(shield=True):  # the signal that ends the line has cancelled this task
                async with anyio.create_task_group() as tasks:
                    for node, ones in by_node.items():
                        node.suspend(0.0)  # also a node that a client has suspended
                        tasks.start_soon(_leave, bus, ones, deadline)
        finally:
            for one in leaving:
                one.end()
        outcomes = {one.write.point.key: one.error for one in leaving}
        return {write.point.key: outcomes[write.point.key] for write in self.writes}  # in the file's order


class Leaving:
    """One write of the safe state on its way. `error` is why it is not confirmed yet, None once it is."""

    def __init__(self, write: SafeWrite, authorisation: Authorisation, by: str) -> None:
        self.write = write
        self.error: BusError | None = NotStarted("not sent in time", node=write.node)
        key = write.point.key
        self._in_progress = authorisation.begin(
            WriteRequest(interface="safe", by=by, name=key, point=write.point, value=write.value)
        )

    async def try_once(self, within: float) -> bool:
        """Write it and read it back, and return whether it is over: confirmed, or nothing can be sent any more."""
        try:
            await self.write.prepare(within)()
        except BusError as error:
            # one that was sent before may have arrived, whatever keeps this one from being sent
            if not (self._was_sent and outcome_of(error)[0] is Outcome.NOT_STARTED):
                self.error = error
            return isinstance(error, BusClosed)
        self.error = None
        self.end()
        return True

    def end(self) -> None:
        """Keep the record of it, once."""
        if self._in_progress.record is None:
            self._in_progress.end(self.error)

    @property
    def _was_sent(self) -> bool:
        return outcome_of(self.error)[0] is not Outcome.NOT_STARTED


async def _leave(bus: Bus, leaving: Sequence[Leaving], deadline: float) -> None:
    """Send the remaining writes of one node in rounds, so that a failed write does not block the others."""
    waiting = list(leaving)
    while waiting and bus.now() < deadline:
        left = []
        for one in waiting:
            within = deadline - bus.now()
            if within <= 0 or not await one.try_once(within):
                left.append(one)
        waiting = left
        if waiting:
            await anyio.sleep(min(LOOK_AGAIN, max(0.0, deadline - bus.now())))
