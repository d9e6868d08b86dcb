"""One request of a client: a command that is built again here, and so checked again, and run on the line."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple, Protocol, TypeAlias, cast

from busmaster import InvalidCommand, Node, NotStarted, Point, WriteUnconfirmed, ext
from busmaster.app.bounds import FARTHEST_REQUESTED, LONGEST_WAIT
from busmaster.app.service.authorisation import FRESH, NEVER_SENT, WriteRequest, outcome_of
from busmaster.app.service.client_messages import RequestParams, WriteParams
from busmaster.app.service.fields import OptionsForm, protocol_of, shortened
from busmaster.app.service.line import ServedLine
from busmaster.app.service.messages import value_of
from busmaster.app.service.peers import Peer
from busmaster.app.service.permission import Permission
from busmaster.app.service.record import RAW_COMMAND
from busmaster.app.service.rights import Rights
from busmaster.app.service.typed import asdict
from busmaster.ext import (
    ORDINARY,
    Changing,
    Command,
    CommandOptions,
    LineClient,
    NodeRecord,
    Placed,
    Request,
    RequestOptions,
    seconds,
)

INTERFACE = "service"
BY_PROGRAM, BY_OWNER = "its program cancelled it", "the program that owns the line ended"
"""Why a request was cancelled."""
CHECK_WHETHER_STOPPED = "check whether the requesting program, or the owner of the line, was stopped meanwhile"


class RequestSender(Protocol):
    """The client that sends the request."""

    @property
    def peer(self) -> Peer: ...

    @property
    def permission(self) -> Permission: ...

    @property
    def reads(self) -> RequestOptions:
        """Return the default options of its reads. Their priority is the highest that its role has for reads, except
        for URGENT."""
        ...

    @property
    def rights(self) -> Rights: ...

    def node(self, name: str, address: int, /) -> Node:
        """Return a node of the line. Raises InvalidCommand."""
        ...

    @property
    def turn(self) -> LineClient:
        """Return its entry in the rotation of clients, except for its sequences."""
        ...

    def client_of(self, sequence: int | None, node: Node, /) -> LineClient:
        """Return the rotation entry of a request: the program's, or that of its sequence. Raises InvalidCommand."""
        ...

    def stops_before(self, node: Node, /) -> int:
        """Return the number of stops of a node from which this client counts."""
        ...

    def takes_stop(self, node: Node, /) -> bool:
        """Return whether the write that is begun now is a stop of its node, as the client has announced."""
        ...

    def notify_stops(self, node: NodeRecord, /) -> None:
        """Send the number of stops of a node."""
        ...


class RequestedCommand(NamedTuple):
    """A requested command for a node, the command that reads the written value (`touches`), and perhaps its point."""

    node: Node
    command: Command[Any]
    touches: Command[Any] | None = None
    value: Any = None
    """The value in the form of the audit log."""
    point: Point[Any] | None = None

    @classmethod
    def of_node(cls, params: RequestParams, sender: RequestSender) -> RequestedCommand:
        """Return the command that a client sends. Raises InvalidCommand for one that the protocol does not have."""
        node, command, touches = sender.node(params.protocol, params.address), params.checked_command, params.touches
        value = str(command) if command.writes else None
        read = None if touches is None else protocol_of(params.protocol).read_back(touches)
        return cls(node, command, read, value)

    @classmethod
    def of_point(cls, params: WriteParams, sender: RequestSender, line: ServedLine) -> RequestedCommand:
        """Return the write of a value to a point of a poll group.

        Raises InvalidCommand, after an audit entry, for a value that cannot be written.
        """
        _, point = line.point(params.group, params.key)
        value = value_of(params.value)
        assert isinstance(point.node, Node)
        try:
            if isinstance(value, str) and point.meaning.labels:
                value = point.meaning.number_of(value)
            return cls(point.node, _encoded(point, value), point.command, value, point)
        except NEVER_SENT as error:
            by, permission = str(sender.peer), sender.permission
            request = WriteRequest(
                interface=INTERFACE, by=by, name=point.key, point=point, value=value, permission=permission
            )
            refusal = line.authorisation.refusal(request) or outcome_of(error)[1]
            line.authorisation.refuse(request, refusal)
            raise InvalidCommand(refusal) from None


OnEnd: TypeAlias = Callable[["ClientRequest", Any, BaseException | None], object]
"""Called at the end of a request with its value or its error; with neither if it was cancelled, see there."""


class Reading:
    """A command that writes nothing, for one client. It gets the result itself, at once: the turn of the loop that a
    future takes would add to the time that a program waits.
    """

    __slots__ = ("_on_end", "_over", "_request", "command", "given_up", "node")

    _on_end: OnEnd

    def __init__(
        self,
        node: Node,
        command: Command[Any],
        client: LineClient,
        stops_seen: int | None = None,
        options: RequestOptions = ORDINARY,
    ) -> None:
        self.node = node
        self.command = command
        self.given_up = False
        self._request = Request(command, options, stops_seen=stops_seen, client=client)
        self._over = False

    @property
    def sent(self) -> bool:
        """Return whether an attempt was passed to the line."""
        return self._request.sent

    def begin(self, on_end: OnEnd) -> None:
        """Start the command; `on_end` is called once at its end, perhaps before this returns.

        Raises BusError or InvalidCommand if it could not be started.
        """
        self._on_end = on_end
        ext.start(self.node, self._request, self)

    def cancel(self, cause: str = BY_PROGRAM) -> None:
        """Cancel the command. If it is on the wire, its reply is discarded. No audit log needs the cause of a read."""
        if not self._over:
            if self._request.transaction is not None:
                ext.give_up(self.node, self._request.transaction)
            self._over = self.given_up = True
            self._on_end(self, None, None)

    # called by the line

    def done(self) -> bool:
        """Return whether the result is not awaited any more."""
        return self._over

    def set_result(self, value: Any, /) -> None:
        """Handle the value that was read."""
        self._over = True
        self._on_end(self, value, None)

    def set_exception(self, error: BaseException, /) -> None:
        """Handle the error of a failed read."""
        self._over = True
        self._on_end(self, None, error)


class Writing:
    """A command that writes, with its options, for one client. It is checked by authorisation."""

    def __init__(
        self,
        task: RequestedCommand,
        options: CommandOptions,
        *,
        line: ServedLine,
        sender: RequestSender,
        client: LineClient,
        asked: float,
        late: float,
        stops_seen: int | None,
        stop: bool,
    ) -> None:
        self.node = task.node
        self.command = task.command
        self.given_up = False
        self.doing: asyncio.Task[Any] | None = None
        """The running write, once it has begun."""
        self._request = Request(task.command, ORDINARY, task.touches, stops_seen, stop, client)
        self._task = task
        self._options = options
        self._line = line
        self._sender = sender
        self._asked = asked
        self._late = late
        """Age of the request at its arrival, in seconds. This end's own time to begin does not make it late."""
        self._stop = stop
        self._begun = False
        self._cause = BY_PROGRAM
        self._on_end: OnEnd

    @property
    def sent(self) -> bool:
        """Return whether an attempt was passed to the line."""
        return self._request.sent

    def check(self) -> None:
        """Raise InvalidCommand for a write that would be refused now, after an audit entry."""
        request = self._write_request()
        try:
            if refusal := self._line.authorisation.refusal(request):
                raise InvalidCommand(f"{self.node.label}: {refusal}")
            self.node.check(self.command, stop=self._stop)
        except InvalidCommand as error:
            self._line.authorisation.refuse(request, str(error))
            raise

    def begin(self, on_end: OnEnd) -> None:
        """Start the write; `on_end` is called once at its end."""
        self._on_end = on_end
        if self._sender.takes_stop(self.node):
            self._stop_node()
        self.doing = asyncio.ensure_future(self._write())
        self.doing.add_done_callback(self._written)

    def cancel(self, cause: str = BY_PROGRAM) -> None:
        """Cancel the write. If it is on the wire, its reply is discarded. `cause` is for the audit log."""
        self._cause = cause
        if self.doing is not None:
            self.doing.cancel()

    # inside

    def _stop_node(self) -> None:
        """Count this write as a stop if it is permitted. Otherwise send the program the number of stops."""
        if self._line.authorisation.refusal(self._write_request()):
            self._sender.notify_stops(ext.record_of(self.node))
        else:
            self.node.note_stop()

    def _written(self, writing: asyncio.Task[Any]) -> None:
        if not self._begun:  # a task that is cancelled before its first step runs nothing of it
            self._line.authorisation.begin(self._write_request()).end(self._truth(asyncio.CancelledError()))
        self.given_up = writing.cancelled()
        error = None if self.given_up else writing.exception()
        self._on_end(self, None if self.given_up or error is not None else writing.result(), error)

    async def _write(self) -> Any:
        self._begun = True
        request = self._write_request()
        in_progress = self._line.authorisation.begin(request)
        try:
            if refusal := self._line.authorisation.refusal(request):
                raise InvalidCommand(f"{self.node.label}: {refusal}")
            # A stop is sent however late it comes: without it, the drive would go on.
            if (age := self._line.bus.now() - self._asked) > FRESH and not self._stop:
                raise _arrived_late(age, self.node, self.command, CHECK_WHETHER_STOPPED)
            _check_arrival(self._options, self._late, self.node, self.command)
            self._request.options = ext.checked_options(
                self.node, shortened(self._options, self._line.bus.now() - self._asked)
            )
            value = await ext.run(self.node, self._request)
        except BaseException as error:
            in_progress.end(self._truth(error))
            raise
        in_progress.end(None)
        if why := await in_progress.not_durable():
            hint = "check why that output failed; the value need not be written again"
            raise WriteUnconfirmed(why, node=self.node, command=str(self.command), hint=hint)
        return value

    def _truth(self, error: BaseException) -> BaseException:
        """Return the error for the audit log. A cancelled write may never have been sent."""
        if isinstance(error, Exception):
            return error
        if self.sent:
            return WriteUnconfirmed(f"{self._cause} before the reply")
        return NotStarted(f"{self._cause} before it was sent")

    def _write_request(self) -> WriteRequest:
        """Return the request for the audit log, with the name and unit of a point if a poll group has it."""
        command, point, value = self.command, self._task.point, self._task.value
        if point is None and isinstance(command, Changing):
            changes = command.changes(self.node.profile)
            point = self._line.named(self.node, changes.keys())
            if point is not None:
                value = _value(point, changes, value)
        point = point or Point(self.node, RAW_COMMAND, command)
        return WriteRequest(
            interface=INTERFACE,
            by=str(self._sender.peer),
            name=point.key,
            point=point,
            value=value,
            command=command,
            permission=self._sender.permission,
        )


ClientRequest: TypeAlias = Reading | Writing


def client_request_of(params: RequestParams | WriteParams, sender: RequestSender, line: ServedLine) -> ClientRequest:
    """Return the request of a client. Raises InvalidCommand for a command that the protocol does not have."""
    if isinstance(params, WriteParams):
        task = RequestedCommand.of_point(params, sender, line)
        client, stop = sender.client_of(None, task.node), False
    else:
        task = RequestedCommand.of_node(params, sender)
        client = sender.client_of(params.sequence, task.node)
        stop = params.stop and _check_stop(task.node, task.command)
    node, command = task.node, task.command
    stops_seen = None if params.stops_seen is None else params.stops_seen + sender.stops_before(node)
    if params.options is None and params.requested is None and not command.writes:
        return Reading(node, command, client, stops_seen, sender.reads)
    given = _options_of(params.options, node)
    now = line.bus.now()
    asked = now if params.requested is None else min(now, _requested(params.requested, now))
    if not command.writes:
        _check_arrival(given, now - asked, node, command)
        options = RequestOptions.of(shortened(given, now - asked), node.label)
        options = replace(options, priority=max(options.priority, sender.rights.reads))
        return Reading(node, command, client, stops_seen, options)
    return Writing(
        task,
        given,
        line=line,
        sender=sender,
        client=client,
        asked=asked,
        late=now - asked,
        stops_seen=stops_seen,
        stop=stop,
    )


def _check_arrival(options: CommandOptions, age: float, node: Node, command: Command[Any]) -> None:
    """Raise NotStarted for a request that arrives, `age` seconds old, after its `start_within`.

    An idle line would send it: there, a request with no time left to wait does not have to wait.
    """
    limit = options.get("start_within")
    if limit is not None and age > limit:
        over = f"its start_within of {limit:g} s was over; give it more time, or {CHECK_WHETHER_STOPPED}"
        raise _arrived_late(age, node, command, over)


def _arrived_late(age: float, node: Node, command: Command[Any], hint: str) -> NotStarted:
    late = f"{age:.1f} s" if age >= 1.0 else f"{age * 1000.0:.0f} ms"
    return NotStarted(
        f"the request arrived {late} after the program made it",
        node=node,
        command=str(command),
        hint=hint,
    )


def _requested(requested: float, now: float) -> float:
    """Return the time of a request. Raises InvalidCommand for one that cannot be of the owner's clock: it would not
    protect from a late write."""
    if seconds(requested, "requested") > now + FARTHEST_REQUESTED:
        raise InvalidCommand(
            f"requested is {requested:.0f} s, and the clock of the line's owner shows {now:.0f} s; use the time that "
            "`now` returns"
        )
    return requested


def _options_of(form: OptionsForm | None, node: Node) -> CommandOptions:
    """Return the options of a request. Raises InvalidCommand for a time to wait that is too long."""
    if form is None:
        return {}
    given = cast("CommandOptions", asdict(form))
    _check_waits(given, node)
    return given


def _check_waits(options: CommandOptions, node: Node) -> None:
    """Raise InvalidCommand for a request that may wait for longer than a client can mean."""
    for name in ("start_within", "finish_within"):
        limit = options.get(name)
        if isinstance(limit, int | float) and limit > LONGEST_WAIT:
            raise InvalidCommand(
                f"{node.label}: {name} is {LONGEST_WAIT:g} s at most, not {limit:g} s: leave it out for no limit"
            )


def _encoded(point: Point[Any], value: Any) -> Command[Any]:
    """Return the write of a value. Raises InvalidCommand for one that cannot be written.

    Where the line carries a number, each codec refuses true and false: a client that means 1 must send 1. Where it
    carries a whole number, 7.0 means 7: JSON and OPC UA clients have one type for all numbers.
    """
    if point.encode is None:
        raise InvalidCommand(f"{point.node.label}: {point.item} is read-only")
    try:
        return point.encode(value)
    except InvalidCommand:
        if isinstance(value, float) and value.is_integer():
            return point.encode(int(value))
        raise


def _check_stop(node: Node, command: Command[Any]) -> bool:
    """Return True for a stop. Raises InvalidCommand for any other write, because limits do not apply to stops."""
    changes = command.changes(node.profile) if isinstance(command, Changing) else {"": None}
    if any(value != 0 for value in changes.values()):
        raise InvalidCommand(f"{node.label}: {command} is not a stop, which only writes 0; leave out `stop`")
    return True


def _value(point: Point[Any], changes: Mapping[Hashable, Any], otherwise: Any) -> Any:
    """Return what the point will read after these changes, in its unit."""
    assert isinstance(point.command, Placed)
    try:
        return point.value_of(point.command.shown(changes))
    except Exception:  # of a decoder; the audit log then has the value on the line
        return otherwise
