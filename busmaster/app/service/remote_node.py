"""One node of a line that another program owns."""

from __future__ import annotations

from collections.abc import Coroutine, Iterable, Mapping, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import replace
from typing import Any, Protocol, TypeVar, Unpack

from busmaster import Point, Sample
from busmaster.app.service.encoding import protocol_of
from busmaster.app.service.link import Link
from busmaster.app.service.messages import value_of, words
from busmaster.app.service.reads import words_of
from busmaster.app.service.sequences import HoldsLine, RequestLimit, held_remotely, shortened
from busmaster.errors import InvalidCommand
from busmaster.ext import (
    ORDINARY,
    URGENT,
    Command,
    CommandOptions,
    Limit,
    Merge,
    Profile,
    Requester,
    RequestOptions,
    checked_hold,
)

T = TypeVar("T")
LEFT_OUT = ("verify", "safe")
"""Options without use on another's line. If they are given, they are false."""


class RemoteLine(HoldsLine, Protocol):
    """The line of a remote node."""

    @property
    def address(self) -> str: ...

    @property
    def line(self) -> str: ...

    @property
    def room(self) -> RequestLimit: ...

    def opened(self, node: RemoteNode, command: Command[Any], /) -> Link:
        """Return the connection for a request. Raises BusClosed, naming it, before the line is entered."""
        ...

    def prepare(self, node: RemoteNode, commands: tuple[Command[Any], ...], stop: bool, /) -> None:
        """Have these writes checked when the line is entered, if it is not yet."""
        ...

    def now(self) -> float: ...

    def latest(self, point: Point[T], /) -> Sample[T] | None: ...


class RemoteNode:
    """One node of a line that another program owns. Handles and points work on it as on a node of this process."""

    def __init__(self, bus: RemoteLine, profile: Profile, address: int) -> None:
        self.stops = 0
        """Number of stops by any program since this one named the node."""
        self.label = profile.label(address)
        self._bus = bus
        self._profile = profile.with_default_merge()
        self._address = address
        self._protocol = protocol_of(profile.name)

    @property
    def line(self) -> str:
        """Return the name of its line's port."""
        return self._bus.line

    @property
    def address(self) -> int:
        return self._address

    @property
    def profile(self) -> Profile:
        return self._profile

    def __repr__(self) -> str:
        return f"<RemoteNode {self.profile.name} {self.address} of {self._bus.address}>"

    def note_stop(self) -> None:
        """Inform the line that this node is being stopped, before all later requests."""
        self.stops += 1
        self._bus.link.notify("stop", {"protocol": self.profile.name, "address": self.address})

    def now(self) -> float:
        """Return the time of the line's clock, in seconds: that of its owner's machine."""
        return self._bus.now()

    def latest(self, point: Any, /) -> Sample[Any] | None:
        """Return the youngest good sample of a point in this program's poll groups, unless a write to the node, by
        any program, has made it stale."""
        return self._bus.latest(point)

    def merge_reads(self, merge: Merge, /) -> None:
        """Let the profile propose `merge`. The line's owner decides which reads are merged."""
        self._profile = replace(self._profile, merge=merge)

    def use_sync_reads(self, probe: Command[Any] | None, sync_reads: Sequence[Command[Any]], /) -> None:
        """Change nothing: the line's owner sends the probes and the sync reads."""

    def limit(self, limit: Limit, /) -> None:
        """Raise InvalidCommand: limits are held by the program that owns the line, for all programs."""
        raise InvalidCommand(f"{self.label}: limits are held by the program that owns the line: set {limit.name} there")

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        """Have the line check these writes when the bus is entered: entering raises InvalidCommand for a bad one.

        Later it does nothing: the line checks each write as it comes. Of several, those before a bad one are written.
        """
        self._bus.prepare(self, commands, stop is True)

    def request(
        self,
        command: Command[T],
        /,
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> Coroutine[Any, Any, T]:
        """Run one command on the line and return its value: as `Requester.request`, with the same errors.

        If the connection is lost meanwhile, a write raises WriteUnconfirmed, or NotStarted where it was not handed over
        yet, and a read LineDown. Cancelling it cancels it there.
        """
        return self.ask(command, None, touches, stops_seen, stop, options)

    async def ask(
        self,
        command: Command[T],
        sequence: int | None,
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
        options: CommandOptions,
        /,
    ) -> T:
        """Do what `request` does, within a sequence of this program, if it is given the number of one."""
        chosen = RequestOptions.of(options, self.label) if options else ORDINARY
        if chosen.verify:
            raise InvalidCommand(f"{self.label}: verify is only available for the write methods of a handle")
        if chosen.safe:
            raise InvalidCommand(f"{self.label}: the safe state is sent by the program that owns the line")
        link, room = self._bus.opened(self, command), self._bus.room
        # A request of a sequence does not wait for the other requests of this program, which wait for the sequence.
        waits = sequence is None and chosen.priority is not URGENT
        waited = await room.wait(chosen, self, command) if waits and not room.take() else 0.0
        try:
            left: Mapping[str, Any] = {**options, **shortened(chosen, waited)} if waited else options
            more = left or stop or touches is not None or stops_seen is not None or sequence is not None
            if more or getattr(command, "writes", True):
                question = self._words(command, left, touches, stops_seen, stop, sequence)
            else:
                question = words_of(self._profile.name, self._address, command)  # type: ignore[arg-type]  # is hashable
            asked = link.put(question, command.writes, self, command)
            value: T = value_of(await link.answer(asked, left.get("finish_within")))
            return value
        finally:
            if waits:
                room.give_back()

    def exclusive(self, *, max_hold: float = 0.5) -> AbstractAsyncContextManager[Requester]:
        """Return, for `async with`, this node for one sequence of requests: see `Requester.exclusive`.

        The line is held no longer than the connection lasts.
        """
        return held_remotely(self, self._bus, checked_hold(max_hold, self.label))

    def _words(
        self,
        command: Command[Any],
        options: Mapping[str, Any],
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
        sequence: int | None,
    ) -> str:
        """Return the text of a request that is not a plain read."""
        params: dict[str, Any] = {
            "protocol": self._profile.name,
            "address": self._address,
            "command": self._protocol.write_down(command),
            "requested": self._bus.now(),
        }
        if touches is not None:
            params["touches"] = self._protocol.write_down(touches)
        if stops_seen is not None:
            params["stops_seen"] = stops_seen
        if stop:
            params["stop"] = True
        if sequence is not None:
            params["sequence"] = sequence
        if options:
            given = {name: value for name, value in options.items() if value is not None}
            params["options"] = {name: given[name] for name in given if name not in LEFT_OUT}
        return words("request", params)

    def encode_sync_read(self, commands: Iterable[Command[Any]], stop: bool) -> dict[str, Any]:
        """Return writes of this node in the form of the message with which the line checks them."""
        decoded = [self._protocol.write_down(command) for command in commands]
        return {"protocol": self.profile.name, "address": self.address, "commands": decoded, "stop": stop}
