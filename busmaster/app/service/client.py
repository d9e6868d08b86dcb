"""One program that is connected to the line's owner. Its requests are run here, and end with the connection."""

from __future__ import annotations

import asyncio
import logging
from collections import Counter
from collections.abc import Callable, Hashable
from dataclasses import replace
from functools import partial
from itertools import islice
from typing import Any, TypeAlias

from busmaster import (
    BacklogFull,
    BusClosed,
    BusError,
    InvalidCommand,
    Node,
    Point,
    PollGroup,
    Priority,
    WriteUnconfirmed,
    ext,
)
from busmaster.app.bounds import (
    LONGEST_SENDER,
    MOST_HOLDS,
    MOST_NODES,
    MOST_POLLED,
    MOST_POLLED_POINTS,
    MOST_REPORTED,
    MOST_REQUESTS,
    MOST_STREAMS,
    MOST_URGENT,
)
from busmaster.app.service import client_messages as messages
from busmaster.app.service.client_messages import ClientMessage, RequestParams, SafeParams, WriteParams
from busmaster.app.service.client_requests import BY_OWNER, ClientRequest, RequestSender, Writing, client_request_of
from busmaster.app.service.encoding import (
    SyncReads,
    encode_statistics,
    listed_groups,
    point_of,
    profile_of,
)
from busmaster.app.service.failures import REFUSED, START_OWNER, encode_error, refusal_of
from busmaster.app.service.fields import ReplyTimesForm, protocol_of
from busmaster.app.service.line import ServedLine
from busmaster.app.service.messages import (
    NO_METHOD,
    InvalidParams,
    Malformed,
    decode_client_notification,
    decode_part,
    decode_request_params,
    encode_error_reply,
    encode_notification,
    encode_result,
    encode_stream_message,
    encode_value,
)
from busmaster.app.service.outbox import Outbox
from busmaster.app.service.overview import encode_details
from busmaster.app.service.owner_messages import (
    AccessParams,
    NodeResult,
    NoResult,
    PollResult,
    StopsParams,
    SubscribeResult,
    TouchedParams,
)
from busmaster.app.service.peers import Peer
from busmaster.app.service.permission import Permission
from busmaster.app.service.plans import groups_of
from busmaster.app.service.refusals import KINDS, is_interface_name
from busmaster.app.service.reply_times import check_within, timings_of
from busmaster.app.service.rights import RIGHTS, Rights, Role
from busmaster.app.service.safe import SafeResult
from busmaster.app.service.streams import Broadcast
from busmaster.app.service.typed import Raw
from busmaster.ext import (
    ORDINARY,
    Hold,
    LineClient,
    NodeRecord,
    PlannedGroup,
    Requester,
    RequestOptions,
)

NodeKey = tuple[str, int]
MOST_FAILED = 1_000_000
"""Failed logins of one peer in one message."""
LONGEST_GROUP_NAME = 40
"""Characters of a client's name for a poll group that the owner's name for it has."""
FOR_SAFE_STATE = ("safe", "cancel")
"""Methods of a program that has a place for the safe state."""


class Requests:
    """Runs requests, and calls `answer` or `refuse` with the number that the program gave."""

    def __init__(
        self,
        sender: RequestSender,
        line: ServedLine,
        answer: Callable[[int, Any], object],
        refuse: Callable[[int, Exception], object],
    ) -> None:
        self._sender = sender
        self._line = line
        self._answer = answer
        self._refuse = refuse
        self._under_way: dict[int, ClientRequest | None] = {}
        """Requests without a reply, by number. None is the safe state, which is being sent."""
        self._log = logging.getLogger("busmaster.app.service")

    def check_number(self, number: int) -> None:
        """Raise Malformed if the number belongs to a request without a reply."""
        if number in self._under_way:
            raise Malformed(f"request {number} is already in progress; use another number")

    @property
    def unfinished(self) -> tuple[ClientRequest, ...]:
        """Return the requests at its nodes."""
        return tuple(request for request in self._under_way.values() if request is not None)

    @property
    def sends_safe_state(self) -> bool:
        """Return whether the safe state is being sent for this program."""
        return None in self._under_way.values()

    def begin(self, number: int, params: RequestParams | WriteParams) -> None:
        """Start a command. Raises Malformed if the number belongs to a request without a reply."""
        under_way = self._under_way
        if number in under_way:  # as check_number does: this is done for every request
            self.check_number(number)
        try:
            if len(under_way) >= MOST_REQUESTS:
                self._check_room(urgent=_is_urgent(params))
            under_way[number] = request = client_request_of(params, self._sender, self._line)
            request.begin(partial(self._ended, number))
        except REFUSED as error:
            under_way.pop(number, None)
            self._refuse(number, refusal_of("request", error))

    def begin_safe(self, number: int, params: SafeParams) -> None:
        """Start to send the safe state. Raises Malformed if the number belongs to a request without a reply."""
        self.check_number(number)
        try:
            self._check_room(urgent=True)  # ordinary requests that wait must not keep the safe state from the line
            sending = self._line.safe_writes.begin(params.writes, self._sender.peer)
        except REFUSED as error:
            self._refuse(number, refusal_of("safe", error))
        else:
            self._under_way[number] = None
            sending.add_done_callback(partial(self._safe_sent, number))

    def cancel(self, number: int) -> None:
        """Cancel a command; it gets no reply. An unknown number is ignored."""
        request = self._under_way.get(number)
        if request is not None:
            request.cancel()

    def end(self) -> None:
        """Send the result of all requests, because the service ends, and perhaps the bus too."""
        for number, request in list(self._under_way.items()):
            if request is not None:
                request.cancel(BY_OWNER)
                # The advice of BusClosed is for the program that has closed its bus.
                self._refuse(
                    number, _unreported(request, BusClosed, "the program that owns the line ends", START_OWNER)
                )

    async def give_up(self) -> None:
        """Cancel all requests, and return when they have ended. The safe state continues."""
        for request in self.unfinished:
            request.cancel()
        while doing := [
            request.doing for request in self.unfinished if isinstance(request, Writing) and request.doing is not None
        ]:
            await asyncio.wait(doing)

    # inside

    def _check_room(self, *, urgent: bool) -> None:
        waiting = len(self._under_way)
        if waiting >= MOST_REQUESTS + (MOST_URGENT if urgent else 0):
            raise BacklogFull(f"{waiting} requests of this program have no reply yet")

    def _ended(self, number: int, request: ClientRequest, value: Any, error: BaseException | None) -> None:
        del self._under_way[number]
        if request.given_up:
            return
        try:
            if error is not None:
                raise error
            self._answer(number, encode_value(value))
        except (BusError, InvalidCommand) as refusal:
            self._refuse(number, refusal)
        except Exception as bug:  # an error of a protocol: the client gets it, and the line continues
            self._log.exception("a request of %s failed", self._sender.peer)
            what = f"the program that owns the line failed: {type(bug).__name__}: {bug}"
            self._refuse(number, _unreported(request, BusError, what))

    def _safe_sent(self, number: int, sending: asyncio.Task[SafeResult]) -> None:
        del self._under_way[number]
        error = WriteUnconfirmed("the program that owns the line ends") if sending.cancelled() else sending.exception()
        if error is None:
            self._answer(number, sending.result())
        else:
            self._refuse(number, error if isinstance(error, Exception) else BusError(str(error)))


def _unreported(request: ClientRequest, kind: type[BusError], what: str, hint: str | None = None) -> BusError:
    """Return the error for a request whose result is unknown: `kind` with `hint`, unless it may have written."""
    if request.command.writes and request.sent:
        kind, hint = WriteUnconfirmed, None
    return kind(what, node=request.node, command=str(request.command), hint=hint)


def _is_urgent(params: RequestParams | WriteParams) -> bool:
    return params.options is not None and params.options.priority is Priority.URGENT


def _reads_of(role: Role) -> RequestOptions:
    return replace(ORDINARY, priority=max(ORDINARY.priority, RIGHTS[role].reads))


class Client:
    """One connected program. `take` handles its messages in their order; `leave` ends all of its requests.

    `in_safe_place`: it has one of the places for programs that only send the safe state, and all other requests are
    rejected.
    """

    def __init__(
        self, line: ServedLine, peer: Peer, number: int, outbox: Outbox, *, in_safe_place: bool = False
    ) -> None:
        self.peer = peer
        self.in_safe_place = in_safe_place
        self.dropped = Counter[Hashable]()
        """Of each stream, how many messages the client was too slow for."""
        self.outbox = outbox
        self._line = line
        self._number = number
        self._nodes: dict[NodeKey, Node] = {}
        self._stops: dict[NodeKey, int] = {}
        """Number of stops of each node when this client named it. The client counts from there."""
        self._stopping: set[Node] = set()
        """Nodes that the client stops without the permission to write all of them. Such a stop counts with the write
        that follows, if that is permitted."""
        self._refused: dict[NodeKey, str] = {}
        """Why a node could not be used as the client named it. Requests are refused until it is named correctly."""
        self.requests = Requests(self, line, self._report_result, self._refuse)
        """Its requests that have not ended."""
        self._streams: dict[int, Broadcast] = {}
        self._groups: dict[int, PollGroup] = {}
        self._role = self.permission.role
        self.reads = _reads_of(self._role)
        """Default options of its reads."""
        self.turn = ext.line_of(line.bus).add_client(line.share, self.rights.owner_time, peer.account)
        """Its entry in the rotation of the line's clients."""
        self._holds: dict[int, Hold | str] = {}
        """Its exclusive sequences, by the number from the client; or the reason why one could not begin."""
        self._planning: asyncio.Task[None] | None = None
        self._gathered: dict[int, list[Point[Any]]] = {}
        """Points for poll groups that it will make, by the streams of those."""

    @property
    def permission(self) -> Permission:
        """Return its present permission."""
        return self.peer.permission(self._line.authorisation.access)

    @property
    def rights(self) -> Rights:
        """Return the rights of its role. `notify_access` updates it, so that it is not looked up for every request."""
        return RIGHTS[self._role]

    @property
    def read_only(self) -> bool:
        """Return whether none of its writes is permitted at present."""
        return self._line.authorisation.read_only or not self.permission.writes

    @property
    def unfinished(self) -> tuple[ClientRequest, ...]:
        """Return its requests that have not ended."""
        return self.requests.unfinished

    # messages to the client

    def notify(self, stream: int, method: str, body: Raw) -> None:
        """Send a message of a stream; it is dropped if the client does not keep up."""
        self.outbox.put_droppable(stream, encode_stream_message(method, stream, self.dropped[stream], body))

    def notify_surely(self, stream: int, method: str, body: Raw, part: int = 0) -> None:
        """Send a message about a part of a stream, which replaces an earlier unsent one."""
        message = encode_stream_message(method, stream, self.dropped[stream], body)
        self.outbox.put_latest((stream, method, part), message)

    def notify_access(self) -> None:
        """Apply a changed role at once, and send the new permission."""
        role = self.permission.role
        if role is not self._role:
            self._role, self.reads = role, _reads_of(role)
            ext.line_of(self._line.bus).arbiter.change_client(self.turn, self.rights.owner_time)
        self.outbox.put_latest("access", encode_notification("access", AccessParams(self.read_only)))

    def notify_stops(self, node: NodeRecord) -> None:
        """Send the number of stops of a node, if this client uses it."""
        key = (node.profile.name, node.address)
        if key in self._nodes:
            params = StopsParams(*key, node.stops - self._stops[key])
            self.outbox.put_latest(("stops", key), encode_notification("stops", params))

    @property
    def has_values(self) -> bool:
        """Return whether it follows a stream of the line, and so can hold values that a write makes stale."""
        return bool(self._streams)

    def notify_touched(self, params: TouchedParams, key: Hashable) -> None:
        """Send which values a write has made stale; `key` identifies these values."""
        self.outbox.put_latest(("touched", key), encode_notification("touched", params))

    # messages from the client

    def take(self, message: ClientMessage) -> None:
        """Handle a message. Raises Malformed for one that no client of this version sends."""
        number, method = message.id, message.method
        if self.in_safe_place and method not in FOR_SAFE_STATE:
            raise Malformed("all other places are taken; this program can only send the safe state")
        if number is None:
            self._take_notification(method, message.params)
            return
        try:
            params = decode_request_params(method, message.params)
        except (InvalidParams, Malformed) as error:
            self.requests.check_number(number)
            node: messages.StopParams | None = decode_part("stop", message.params) if method == "node" else None
            if node is not None:
                self._note_refused((node.protocol, node.address), str(error))
            self._refuse(number, error)
            return
        if method in ("request", "write"):
            self.requests.begin(number, params)
        elif method == "safe":
            self.requests.begin_safe(number, params)
        else:
            self.requests.check_number(number)
            self._take_request(number, method, params)

    def _take_notification(self, method: str, encoded: Raw) -> None:
        """Handle a notification. One of a later version is ignored. Raises Malformed for invalid parameters."""
        try:
            params = decode_client_notification(method, encoded)
        except InvalidParams as error:
            held: messages.SequenceParams | None = decode_part("release", encoded) if method == "hold" else None
            if held is not None:
                self._begin_sequence(held.sequence, error)  # the requests of the sequence are refused with the reason
                return
            raise Malformed(str(error)) from None
        match params:
            case messages.CancelParams():
                self.requests.cancel(params.id)
            case messages.StreamParams():
                self._end_stream(params.stream)
            case messages.HoldParams():
                self._begin_sequence(params.sequence, params)
            case messages.SequenceParams():
                self._release(params.sequence)
            case messages.RefusalsParams():
                self._take_refusals(params)
            case messages.StopParams():
                self._take_stop(params)

    def _take_stop(self, params: messages.StopParams) -> None:
        """Count a stop that follows, also of a node that this client has not named yet."""
        try:
            node = self.node(params.protocol, params.address)
        except REFUSED:
            return  # the request that follows is refused with the reason
        if self.permission.covers(node):
            node.note_stop()
        else:
            self._stopping.add(node)

    def _take_refusals(self, params: messages.RefusalsParams) -> None:
        """Count the refusals that an interface in another process reports. Names that cannot be shown are ignored."""
        if not is_interface_name(params.interface) or params.kind not in KINDS:
            return
        refusals = self._line.authorisation.refusals
        refusals.begin(params.interface, params.kind)
        for peer, count in islice(params.peers.items(), MOST_REPORTED + 1):
            if 0 < count <= MOST_FAILED and len(peer) <= LONGEST_SENDER and peer.isprintable():
                refusals.note(params.interface, params.kind, peer, count)

    def _take_request(self, number: int, method: str, params: Any) -> None:
        """Handle a request that is not for a node's command."""
        if method == "plan":
            self._begin_plan(number, params)
            return
        try:
            handler = HANDLERS.get(method)
            if handler is None:
                raise Malformed(f"no method {method!r} after the first message", NO_METHOD)
            result = handler(self, params)
        except REFUSED as error:
            self._refuse(number, refusal_of(method, error))
        else:
            self._report_result(number, result)

    def _check(self, params: messages.CheckParams) -> None:
        for command in params.commands:
            single = RequestParams(params.protocol, params.address, command, stop=params.stop)
            request = client_request_of(single, self, self._line)
            if isinstance(request, Writing):
                request.check()

    def _begin_plan(self, number: int, params: messages.PlanParams) -> None:
        """Begin to calculate a plan: one at a time."""
        try:
            if self._planning is not None and not self._planning.done():
                raise InvalidCommand("a plan for this program is already being calculated; wait for it")
            more = groups_of(params.groups, self._line.bus)
        except REFUSED as error:
            self._refuse(number, refusal_of("plan", error))
        else:
            self._planning = asyncio.ensure_future(self._plan(number, more))

    async def _plan(self, number: int, more: list[PlannedGroup]) -> None:
        try:
            plan = await self._line.planner.plan(more)
        except REFUSED as error:
            self._refuse(number, refusal_of("plan", error))
        else:
            self._report_result(number, plan)

    # Each changes how the line is polled for all clients. The events name the program. They raise InvalidCommand if the
    # program may not write to the nodes.

    def _suspend(self, params: messages.SuspendParams) -> None:
        node = self._line.node(params.protocol, params.address)
        self._check_steering(node)
        node.suspend(params.for_)
        did = f"is suspended for {params.for_:g} s" if node.suspended else "is resumed"
        self._line.journal.note(f"{node.label} {did} by {self.peer}")

    def _pause(self, params: messages.PauseParams) -> None:
        group = self._line.group(params.group)
        self._check_steering(*(point.node for point in group.points))
        group.pause() if params.paused else group.resume()
        self._line.journal.note(f"{group.name} is {'paused' if group.paused else 'resumed'} by {self.peer}")

    def _demand(self, params: messages.DemandParams) -> None:
        self._line.demand(self._line.group(params.group), self._role)

    def _check_steering(self, *nodes: Requester) -> None:
        if not all(map(self.permission.reaches, nodes)):
            raise InvalidCommand(
                f"{self.permission.who} may not pause or suspend this; that needs the permission to write to its nodes"
            )

    # nodes

    def _name_node(self, params: messages.NodeParams) -> NodeResult:
        key = params.protocol, params.address
        self._refused.pop(key, None)
        try:
            node = self.node(*key, params.timings, params.retries, SyncReads(params.probe, params.sync_reads))
        except InvalidCommand as error:
            self._note_refused(key, str(error))
            raise
        return NodeResult(node.label, node.health.value)

    def _note_refused(self, key: NodeKey, reason: str) -> None:
        """Refuse the requests to a node until it is named correctly."""
        if len(self._refused) < MOST_NODES:
            self._refused[key] = reason

    def node(
        self,
        name: str,
        address: int,
        timings: ReplyTimesForm | None = None,
        retries: int | None = None,
        sync_reads: SyncReads = SyncReads(),  # noqa: B008  it is immutable
    ) -> Node:
        """Return a node, which this client has until it leaves. Raises InvalidCommand as `Bus.node` does."""
        if refused := self._refused.get((name, address)):
            raise InvalidCommand(refused)
        known = self._nodes.get((name, address))
        if known is not None and timings is None and retries is None:
            return known
        protocol = protocol_of(name)
        if known is None and len(self._nodes) >= MOST_NODES:
            raise InvalidCommand(f"one program names {MOST_NODES} nodes at most")
        bus, rights = self._line.bus, self.rights
        profile = profile_of(protocol, sync_reads)
        times = timings_of(timings)
        if known is None and not ext.has_node(bus, profile, address):
            if sum(not ext.is_kept(node) for node in self._nodes.values()) >= rights.new_nodes:
                raise InvalidCommand(
                    f"{profile.label(address)}: a program with the role {self._role.value} names {rights.new_nodes} "
                    "nodes at most that the line's owner does not have: add the node to the line's file"
                )
            if not rights.own_times:
                check_within(times, profile, address)
        node = ext.lend_node(bus, profile, address, timings=times, retries=retries, budgeted=rights.budgeted)
        if known is not None:
            ext.give_back(bus, node)  # lent only for the error that it would raise
        self._nodes[name, address] = node
        self._stops.setdefault((name, address), node.stops)
        return node

    def stops_before(self, node: Node) -> int:
        """Return the number of stops of a node when this client named it. Raises InvalidCommand if it has not."""
        stops = self._stops.get((node.profile.name, node.address))
        if stops is None:
            raise InvalidCommand(
                f"{node.label}: stops are counted from the message `node`: send it before `stops_seen`"
            )
        return stops

    def takes_stop(self, node: Node) -> bool:
        """Return whether the write to a node that is begun now is the stop that this client has announced: once."""
        announced = node in self._stopping
        self._stopping.discard(node)
        return announced

    # answers

    def _report_result(self, number: int, result: Any) -> None:
        self.outbox.put(encode_result(number, result))

    def _refuse(self, number: int, error: Exception) -> None:
        self.outbox.put(encode_error_reply(number, encode_error(error)))

    # sequences

    def client_of(self, sequence: int | None, node: Node) -> LineClient:
        """Return whose turn a request takes. Raises InvalidCommand for a sequence that this client does not have."""
        if sequence is None:
            return self.turn
        hold = self._holds.get(sequence)
        if isinstance(hold, str):
            raise InvalidCommand(hold)
        if hold is None or hold.node is not ext.record_of(node):
            raise InvalidCommand(f"{node.label}: no sequence {sequence} was begun for it, of {MOST_HOLDS} at most")
        return hold

    def _begin_sequence(self, number: int, params: messages.HoldParams | InvalidCommand) -> None:
        """Begin a sequence. If it cannot begin, its requests are refused with the reason."""
        if isinstance(self._holds.get(number), Hold) or len(self._holds) >= MOST_HOLDS:
            return
        try:
            if isinstance(params, InvalidCommand):
                raise params
            node = self.node(params.protocol, params.address)
            if not self.permission.reaches(node):  # a program that only reads must not keep others waiting like this
                raise InvalidCommand(
                    f"{node.label}: {self.permission.who} may not hold the line; "
                    "that needs the permission to write to it"
                )
            self._holds[number] = ext.hold(node, params.max_hold, self.turn)
        except InvalidCommand as error:
            self._holds[number] = str(error)

    def _release(self, sequence: int) -> None:
        hold = self._holds.pop(sequence, None)
        if isinstance(hold, Hold):
            ext.line_of(self._line.bus).release(hold)

    # streams

    def _follow(self, stream: int, source: Broadcast) -> None:
        if stream in self._streams:
            raise InvalidCommand(f"stream {stream} of this program is in use; choose another number, or end it first")
        if len(self._streams) >= MOST_STREAMS:
            raise InvalidCommand(f"one program has {MOST_STREAMS} streams at most; end one first")
        self._streams[stream] = source
        source.join(self, stream)

    def _follow_line(self, stream: int, source: Broadcast) -> NoResult:
        self._follow(stream, source)
        return NoResult()

    def _subscribe(self, params: messages.SubscribeParams) -> SubscribeResult:
        group = self._line.group(params.group)
        self._follow(params.stream, self._line.broadcast_of(group))
        return SubscribeResult(group.period)

    def _gather(self, params: messages.GatherParams | messages.PollParams) -> NoResult:
        """Keep points for a poll group: a message is too short for as many as one may have."""
        stream = params.stream
        if stream not in self._gathered and len(self._gathered) >= MOST_POLLED:
            raise InvalidCommand(f"one program has {MOST_POLLED} poll groups at most")
        known = self._gathered.get(stream, [])
        if len(known) + len(params.points) > MOST_POLLED_POINTS:
            raise InvalidCommand(f"a poll group of a program has {MOST_POLLED_POINTS} points at most")
        read = [point_of(point, self.node) for point in params.points]
        if any(point.command.writes for point in read):
            raise InvalidCommand("a poll group reads: it writes nothing")
        self._gathered[stream] = known + read
        return NoResult()

    def _poll(self, params: messages.PollParams) -> PollResult:
        if len(self._groups) >= self.rights.groups:
            raise InvalidCommand(f"one program has {self.rights.groups} poll groups at most")
        self._gather(params)
        read = self._gathered.pop(params.stream)
        name, program = params.name, f"{self.peer.short}-{self._number}"
        if len(name) > LONGEST_GROUP_NAME:  # with its stream: another name may have the same beginning
            name, program = name[:LONGEST_GROUP_NAME], f"{program}.{params.stream}"
        group = self._line.bus.poll_group(
            f"{name} ({program})",
            period=params.period,
            points=read,
            phase=params.phase,
            priority=max(self.rights.polls, params.priority),
            client=self.turn,
        )
        try:
            self._follow(params.stream, self._line.broadcast_of(group))
        except BaseException:
            group.close()
            raise
        self._groups[params.stream] = group
        self._line.of_programs.add(group)
        return PollResult(group.period, group.name)

    def _end_stream(self, stream: int) -> None:
        source = self._streams.pop(stream, None)
        if source is not None:
            source.leave(self, stream)
        self._gathered.pop(stream, None)
        group = self._groups.pop(stream, None)
        if group is not None:
            group.close()
        self.dropped.pop(stream, None)

    # its end

    def release(self) -> None:
        """Send the result of all of its requests, because the service ends, and perhaps the bus too."""
        self.requests.end()

    async def leave(self) -> None:
        """End all of its requests, and give back its nodes."""
        if self._planning is not None:
            self._planning.cancel()
        for stream in list(self._streams):
            self._end_stream(stream)
        await self.requests.give_up()
        for sequence in list(self._holds):
            self._release(sequence)
        ext.line_of(self._line.bus).remove_client(self.turn)
        for node in self._nodes.values():
            ext.give_back(self._line.bus, node)
        self._nodes.clear()


Handler: TypeAlias = Callable[[Client, Any], Any]
HANDLERS: dict[str, Handler] = {
    "node": Client._name_node,
    "check": Client._check,
    "now": lambda client, _: client._line.bus.now(),
    "statistics": lambda client, _: encode_statistics(ext.line_statistics(client._line.bus)),
    "groups": lambda client, _: listed_groups(client._line.bus),
    "subscribe": Client._subscribe,
    "events": lambda client, params: client._follow_line(params.stream, client._line.events()),
    "gather": Client._gather,
    "poll": Client._poll,
    "overview": lambda client, params: client._follow_line(params.stream, client._line.overview()),
    "exchanges": lambda client, params: client._follow_line(params.stream, client._line.exchanges()),
    "details": lambda client, params: encode_details(client._line.bus, *client._line.point(params.group, params.key)),
    "pause": Client._pause,
    "demand": Client._demand,
    "suspend": Client._suspend,
}
"""The requests that get a reply at once, by their methods. A handler raises InvalidCommand, BusError, or Malformed."""
