"""One node of a line that another program owns."""

from __future__ import annotations

from collections.abc import Coroutine, Iterable, Sequence
from contextlib import AbstractAsyncContextManager
from dataclasses import replace
from typing import Any, Protocol, TypeVar, Unpack

from busmaster import InvalidCommand, Point, Sample
from busmaster.app.service.client_messages import CheckParams, RequestParams, StopParams
from busmaster.app.service.encoding import protocol_of
from busmaster.app.service.fields import OptionsForm, shortened
from busmaster.app.service.link import Link
from busmaster.app.service.messages import value_of
from busmaster.app.service.sequences import HoldsLine, RequestLimit, held_remotely
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
    checked_priority,
)

T = TypeVar("T")


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
        self._bus.link.notify("stop", StopParams(self.profile.name, self.address))

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
            left = shortened(options, waited) if waited else options
            params = self._params(command, left, touches, stops_seen, stop, sequence)
            asked = link.ask("request", params, writes=command.writes, node=self, command=command)
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

    def _params(
        self,
        command: Command[Any],
        options: CommandOptions,
        touches: Command[Any] | None,
        stops_seen: int | None,
        stop: bool,
        sequence: int | None,
    ) -> RequestParams:
        is_limited = command.writes or bool(options)
        return RequestParams(
            self._profile.name,
            self._address,
            self._protocol.write_down(command),
            touches=None if touches is None else self._protocol.write_down(touches),
            options=_encode_options(options) if options else None,
            stops_seen=stops_seen,
            stop=stop,
            requested=self._bus.now() if is_limited else None,
            sequence=sequence,
        )

    def check_params(self, commands: Iterable[Command[Any]], stop: bool) -> CheckParams:
        """Return the message with which the line checks these writes of the node."""
        forms = [self._protocol.write_down(command) for command in commands]
        return CheckParams(self.profile.name, self.address, forms, stop)


def _encode_options(options: CommandOptions) -> OptionsForm:
    """Return the options of a request. `safe` is false, and `verify` is a handle's affair."""
    priority = options.get("priority")
    return OptionsForm(
        None if priority is None else checked_priority(priority),
        options.get("start_within"),
        options.get("finish_within"),
        options.get("retries"),
        options.get("idempotent"),
    )
