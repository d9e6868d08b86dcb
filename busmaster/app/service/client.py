"""One program that is connected to the line's owner. Its requests are run here, and end with the connection."""

from __future__ import annotations

import asyncio
from collections.abc import Hashable, Mapping
from dataclasses import replace
from itertools import islice
from typing import Any

from busmaster import Node, Point, PollGroup, Priority, ext
from busmaster.app.service.client_requests import ClientRequest, Writing, client_request_of
from busmaster.app.service.encoding import encode_statistics, listed_groups, point_of, profile_of, protocol_of
from busmaster.app.service.failures import REFUSED, encode_error, refusal_of
from busmaster.app.service.line import ServedLine
from busmaster.app.service.messages import NO_METHOD, Malformed, answered, check_within, timings_of, written
from busmaster.app.service.outbox import Outbox
from busmaster.app.service.overview import encode_details
from busmaster.app.service.peers import Peer
from busmaster.app.service.permission import Permission
from busmaster.app.service.plans import groups_of
from busmaster.app.service.refusals import KINDS, is_interface_name
from busmaster.app.service.requests import Requests
from busmaster.app.service.rights import RIGHTS, Rights, Role
from busmaster.app.service.streams import Broadcast, GroupBroadcast
from busmaster.bounds import (
    LONGEST_SENDER,
    MOST_CHECKED,
    MOST_HOLDS,
    MOST_NODES,
    MOST_POLLED,
    MOST_POLLED_POINTS,
    MOST_REPORTED,
    MOST_STREAMS,
)
from busmaster.errors import InvalidCommand
from busmaster.ext import (
    ORDINARY,
    Hold,
    LineClient,
    NodeRecord,
    PlannedGroup,
    Requester,
    RequestOptions,
    checked_priority,
    seconds,
    whole_number,
)

NodeKey = tuple[str, int]
MOST_FAILED = 1_000_000
"""Failed logins of one peer in one message."""
FOR_SAFE_STATE = ("safe", "cancel")
"""Methods of a program that has a place for the safe state."""


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
        self.dropped: dict[Hashable, int] = {}
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

    def notify(self, stream: int, method: str, body: str) -> None:
        """Send a message of a stream; it is dropped if the client does not keep up."""
        self.outbox.put_news(stream, self._news(stream, method, body))

    def notify_surely(self, stream: int, method: str, body: str, part: int = 0) -> None:
        """Send a message about a part of a stream, which replaces an earlier unsent one."""
        self.outbox.put_latest((stream, method, part), self._news(stream, method, body))

    def _news(self, stream: int, method: str, body: str) -> str:
        dropped = self.dropped.get(stream, 0)
        head = f'{{"jsonrpc":"2.0","method":"{method}","params":{{"stream":{stream},"dropped":{dropped},"body":'
        return f"{head}{body}}}}}"

    def notify_access(self) -> None:
        """Apply a changed role at once, and send the new permission."""
        role = self.permission.role
        if role is not self._role:
            self._role, self.reads = role, _reads_of(role)
            ext.line_of(self._line.bus).arbiter.change_client(self.turn, self.rights.owner_time)
        self.outbox.put_latest("access", written({"method": "access", "params": {"read_only": self.read_only}}))

    def notify_stops(self, node: NodeRecord) -> None:
        """Send the number of stops of a node, if this client uses it."""
        key = (node.profile.name, node.address)
        if key in self._nodes:
            params = {"protocol": key[0], "address": key[1], "stops": node.stops - self._stops[key]}
            self.outbox.put_latest(("stops", key), written({"method": "stops", "params": params}))

    @property
    def has_values(self) -> bool:
        """Return whether it follows a stream of the line, and so can hold values that a write makes stale."""
        return bool(self._streams)

    def notify_touched(self, params: Mapping[str, Any], key: Hashable) -> None:
        """Send which values a write has made stale; `key` identifies these values."""
        self.outbox.put_latest(("touched", key), written({"method": "touched", "params": params}))

    # messages from the client

    def take(self, decoded: Mapping[str, Any]) -> None:
        """Handle a message. Raises Malformed for one that no client of this version sends."""
        number, method, params = decoded.get("id"), decoded.get("method"), decoded.get("params", {})
        if not isinstance(method, str) or not isinstance(params, dict):
            raise Malformed("a message has a method, and its parameters by name")
        if self.in_safe_place and method not in FOR_SAFE_STATE:
            raise Malformed("all other places are taken; this program can only send the safe state")
        if number is None:
            try:
                self._notified(method, params)
            except TypeError as error:  # a list for a number
                raise Malformed(f"{method[:40]}: {error}") from None
            return
        if isinstance(number, bool) or not isinstance(number, int):
            raise Malformed("the id of a request is a whole number")
        if method in ("request", "write"):
            self.requests.begin(number, params)
            return
        if method == "safe":
            self.requests.begin_safe(number, params)
            return
        self.requests.check_number(number)
        if method == "plan":
            self._begin_plan(number, params)
            return
        try:
            answer = self._answer(method, params)
        except REFUSED as error:
            self._refuse(number, refusal_of(method, error))
        else:
            self._report_result(number, answer)

    def _notified(self, method: str, params: Mapping[str, Any]) -> None:
        match method:
            case "cancel":
                self.requests.cancel(params.get("id"))
            case "end":
                self._end_stream(params.get("stream", -1))
            case "hold":
                self._hold(params)
            case "release":
                self._release(params.get("sequence", -1))
            case "refusals":
                self._take_refusals(params.get("interface"), params.get("kind"), params.get("peers"))
            case "stop":
                node = self._nodes.get((str(params.get("protocol")), params.get("address", -1)))
                if node is not None and self.permission.covers(node):
                    node.note_stop()
                elif node is not None:
                    self._stopping.add(node)

    def _take_refusals(self, interface: object, kind: object, peers: object) -> None:
        """Count the refusals that an interface in another process reports. Other data is ignored."""
        if not (isinstance(interface, str) and is_interface_name(interface)):
            return
        if not (isinstance(kind, str) and kind in KINDS and isinstance(peers, dict)):
            return
        refusals = self._line.authorisation.refusals
        refusals.begin(interface, kind)
        for peer, count in islice(peers.items(), MOST_REPORTED + 1):
            if type(count) is int and 0 < count <= MOST_FAILED and len(peer) <= LONGEST_SENDER and peer.isprintable():
                refusals.note(interface, kind, peer, count)

    def _answer(self, method: str, params: Mapping[str, Any]) -> Any:
        """Return the immediate reply to a request. Raises InvalidCommand, BusError, or Malformed."""
        match method:
            case "node":
                return self._name_node(params)
            case "check":
                if len(params["commands"]) > MOST_CHECKED:
                    raise InvalidCommand(f"more than {MOST_CHECKED} writes in one check; send several checks")
                for command in params["commands"]:
                    request = client_request_of({**params, "command": command}, self, self._line)
                    if isinstance(request, Writing):
                        request.check()
                return None
            case "now":
                return self._line.bus.now()
            case "statistics":
                return encode_statistics(ext.line_statistics(self._line.bus))
            case "groups":
                return listed_groups(self._line.bus)
            case "subscribe":
                return self._follow(params, self._line.broadcast_of(self._line.group(params["group"])))
            case "events":
                return self._follow(params, self._line.events())
            case "gather":
                return self._gather(params)
            case "poll":
                return self._poll(params)
            case "overview":
                return self._follow(params, self._line.overview())
            case "exchanges":
                return self._follow(params, self._line.exchanges())
            case "details":
                return encode_details(self._line.bus, *self._line.point(params["group"], params["key"]))
            case "pause" | "demand" | "suspend":
                return self._steer(method, params)
        raise Malformed(f"no method {method[:40]!r}", NO_METHOD)

    def _begin_plan(self, number: int, params: Mapping[str, Any]) -> None:
        """Begin to calculate a plan: one at a time."""
        try:
            if self._planning is not None and not self._planning.done():
                raise InvalidCommand("a plan for this program is already being calculated; wait for it")
            more = groups_of(params.get("groups", []), self._line.bus)
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

    def _steer(self, method: str, params: Mapping[str, Any]) -> None:
        """Change how the line is polled for all clients. The events name the program that did it.

        Raises InvalidCommand if the program may not write to the nodes.
        """
        if method == "suspend":
            node = self._line.node(params["protocol"], params["address"])
            self._check_steering(node)
            node.suspend(params["for"])
            did = f"{node.label} is suspended for {params['for']:g} s" if node.suspended else f"{node.label} is resumed"
        else:
            group = self._line.group(params["group"])
            if method == "demand":
                self._line.demand(group, self._role)
                return
            self._check_steering(*(point.node for point in group.points))
            group.pause() if params["paused"] is True else group.resume()
            did = f"{group.name} is {'paused' if group.paused else 'resumed'}"
        self._line.journal.note(f"{did} by {self.peer}")

    def _check_steering(self, *nodes: Requester) -> None:
        if not all(map(self.permission.reaches, nodes)):
            raise InvalidCommand(
                f"{self.permission.who} may not pause or suspend this; that needs the permission to write to its nodes"
            )

    # nodes

    def _name_node(self, params: Mapping[str, Any]) -> dict[str, Any]:
        key = params["protocol"], params["address"]
        self._refused.pop(key, None)
        try:
            sync_reads = params.get("probe"), params.get("sync_reads")
            node = self.node(*key, params.get("timings"), params.get("retries"), sync_reads)
        except InvalidCommand as error:
            if len(self._refused) < MOST_NODES:
                self._refused[key] = str(error)
            raise
        return {"label": node.label, "health": node.health.value}

    def node(
        self,
        name: str,
        address: int,
        timings: Any = None,
        retries: int | None = None,
        sync_reads: tuple[Any, Any] = (None, None),
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
        profile = profile_of(protocol, *sync_reads)
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
        """Return the number of stops of a node when this client named it."""
        return self._stops[node.profile.name, node.address]

    def takes_stop(self, node: Node) -> bool:
        """Return whether the write to a node that is begun now is the stop that this client has announced: once."""
        announced = node in self._stopping
        self._stopping.discard(node)
        return announced

    # answers

    def _report_result(self, number: int, result: Any) -> None:
        self.outbox.put(answered(number, result))

    def _refuse(self, number: int, error: Exception) -> None:
        self.outbox.put(written({"id": number, "error": encode_error(error)}))

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

    def _hold(self, params: Mapping[str, Any]) -> None:
        """Begin a sequence. If it cannot begin, its requests are refused with the reason."""
        number = params.get("sequence")
        if isinstance(number, int) and not isinstance(self._holds.get(number), Hold) and len(self._holds) < MOST_HOLDS:
            try:
                self._holds[number] = self._begin_hold(params)
            except InvalidCommand as error:
                self._holds[number] = str(error)
            except KeyError as missing:
                self._holds[number] = f"a sequence is held with protocol, address and max_hold: {missing} is missing"

    def _begin_hold(self, params: Mapping[str, Any]) -> Hold:
        node = self.node(params["protocol"], params["address"])
        if not self.permission.reaches(node):  # a program that only reads must not keep others waiting like this
            raise InvalidCommand(
                f"{node.label}: {self.permission.who} may not hold the line; that needs the permission to write to it"
            )
        return ext.hold(node, seconds(params["max_hold"], "max_hold"), self.turn)

    def _release(self, sequence: int) -> None:
        hold = self._holds.pop(sequence, None)
        if isinstance(hold, Hold):
            ext.line_of(self._line.bus).release(hold)

    # streams

    def _follow(self, params: Mapping[str, Any], source: Broadcast) -> dict[str, Any]:
        stream = whole_number(params["stream"], 0, 2**53, "a stream")
        if stream in self._streams or len(self._streams) >= MOST_STREAMS:
            raise InvalidCommand(f"one program has {MOST_STREAMS} streams at most, each with a number of its own")
        self._streams[stream] = source
        source.join(self, stream)
        return {"period": source.group.period} if isinstance(source, GroupBroadcast) else {}

    def _gather(self, params: Mapping[str, Any]) -> dict[str, Any]:
        """Keep points for a poll group: a message is too short for as many as one may have."""
        stream, points = whole_number(params["stream"], 0, 2**53, "a stream"), params.get("points", [])
        if stream not in self._gathered and len(self._gathered) >= MOST_POLLED:
            raise InvalidCommand(f"one program has {MOST_POLLED} poll groups at most")
        known = self._gathered.get(stream, [])
        if not isinstance(points, list) or len(known) + len(points) > MOST_POLLED_POINTS:
            raise InvalidCommand(f"a poll group of a program has {MOST_POLLED_POINTS} points at most")
        read = [point_of(point, self.node) for point in points]
        if any(point.command.writes for point in read):
            raise InvalidCommand("a poll group reads: it writes nothing")
        self._gathered[stream] = known + read
        return {}

    def _poll(self, params: Mapping[str, Any]) -> dict[str, Any]:
        if len(self._groups) >= self.rights.groups:
            raise InvalidCommand(f"one program has {self.rights.groups} poll groups at most")
        self._gather(params)
        read = self._gathered.pop(params["stream"])
        phase = params.get("phase")
        group = self._line.bus.poll_group(
            f"{str(params['name'])[:40]} ({self.peer.short}-{self._number})",
            period=seconds(params["period"], "a period"),
            points=read,
            phase=None if phase is None else seconds(phase, "a phase"),
            priority=checked_priority(max(self.rights.polls, params.get("priority", Priority.POLL))),
            client=self.turn,
        )
        try:
            answer = self._follow(params, self._line.broadcast_of(group))
        except BaseException:
            group.close()
            raise
        self._groups[params["stream"]] = group
        return {**answer, "name": group.name}

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
