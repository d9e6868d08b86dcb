"""The socket of one line, at which other programs ask its nodes."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import Collection, Hashable
from functools import partial
from http import HTTPStatus
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from busmaster.arbiter.health import NodeRecord
from busmaster.bus.bus import Bus
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup
from busmaster.contract.places import Placed
from busmaster.errors import InvalidCommand
from busmaster.gate.gate import Gate
from busmaster.service.client import Client
from busmaster.service.exchanges import ExchangesBroadcast
from busmaster.service.folder import Owner, ServedSocket, line_name, runtime_folder
from busmaster.service.messages import (
    GOING_AWAY,
    HELLO_WITHIN,
    INVALID_PARAMS,
    LONGEST_MESSAGE,
    MOST_CLIENTS,
    VERSIONS,
    Malformed,
    read,
    written,
)
from busmaster.service.outbox import Outbox
from busmaster.service.overview import Journal, Overview, state_text
from busmaster.service.peers import Peer, process_of
from busmaster.service.safe import SafeWishes
from busmaster.service.streams import Broadcast, EventBroadcast, GroupBroadcast
from busmaster.service.tcp import HostPort, check_listening, holder, is_our_name, listening

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.http11 import Request, Response

HOSTS = ("localhost", "busmaster")
"""What a client calls us: a page that was tricked into asking here would say another name."""
SEND_WITHIN = 20.0
"""Seconds in which a client has to take a message: one that stands still is let go, with all that it asked for."""
READ_AT_ONCE = 4096
"""Bytes of a connection that are taken in one turn of the line's loop: of small messages it holds hundreds."""
CLOSE_WITHIN = 1.0
"""Seconds that a client has to hear the last of it."""
POLICY = 1008


class Service:
    """Serve a bus that is open, on a Unix socket, in `async with`. It ends before the bus is closed.

    `path` is the socket's; without it, it is NAME.sock in this user's runtime folder, where `name` is that of the
    line, by default its port's. Every write passes `gate`, which says who may do what: without one, its own, which
    keeps a record in the log "busmaster.audit", and lets this user write and others read. `mode` and `group`, a number,
    are the socket's. `listen` is a host and a port where programs may come by TCP too: off this machine only where the
    gate knows tokens. `title` is written over what a person sees of the line. Entering raises InvalidCommand where the
    socket is served by another process, which it names, or cannot be made.
    """

    def __init__(
        self,
        bus: Bus,
        *,
        gate: Gate | None = None,
        name: str | None = None,
        path: Path | str | None = None,
        mode: int = 0o600,
        group: int | None = None,
        listen: HostPort | None = None,
        title: str = "",
    ) -> None:
        self.bus = bus
        self.gate = gate or Gate(bus)
        if listen is not None:
            check_listening(listen, tokens=bool(self.gate.access.secrets))
        self.safe_wishes = SafeWishes(self.gate)
        self.name = name or line_name(bus.endpoint.name)
        self.title = title or self.name
        """What is written over what a person sees of the line."""
        self.journal = Journal(bus)
        """What happens from now on, also before it is entered."""
        self.refused = 0
        """Connections that were one too many, or that began with what no client says."""
        self._path = None if path is None else Path(path).absolute()
        self._mode = mode
        self._group = group
        self._listen = listen
        self._served: ServedSocket
        self._servers: list[Server] = []
        self._clients: dict[Client, ServerConnection] = {}
        self._count = 0
        self._groups: dict[PollGroup, GroupBroadcast] = {}
        self._events: EventBroadcast | None = None
        self._overview: Overview | None = None
        self._exchanges: ExchangesBroadcast | None = None
        self._points: dict[object, Point[Any]] = {}
        self._points_of: list[tuple[str, tuple[Point[Any], ...]]] = []
        self._log = logging.getLogger("busmaster.service")

    @property
    def address(self) -> str:
        """Return what `connect` takes."""
        return self._served.owner.address

    @property
    def tcp_address(self) -> str | None:
        """Return what `connect` takes of a program that comes by TCP; None where none can."""
        if self._listen is None:
            return None
        host, port = self._servers[-1].sockets[0].getsockname()[:2]
        return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"

    @property
    def clients(self) -> tuple[Client, ...]:
        """Return the programs that are connected."""
        return tuple(self._clients)

    async def __aenter__(self) -> Service:
        _websockets()  # before anything is made
        path = self._path or runtime_folder() / f"{self.name}.sock"
        endpoint = self.bus.endpoint
        settings = endpoint.settings
        owner = Owner(
            self.name,
            endpoint.name,
            str(path),
            os.getpid(),
            None if settings is None else settings.baudrate,
            None if settings is None else settings.framing,
            endpoint.echo,
        )
        served = ServedSocket(owner, mode=self._mode, group=self._group)
        self._served = served.__enter__()
        try:
            sockets = [self._served.socket]
            if self._listen is not None:
                sockets.append(await asyncio.to_thread(listening, self._listen))
            for opened in sockets:
                self._servers.append(await self._serve_at(opened))
        except BaseException:
            for server in self._servers:
                server.close()
            served.__exit__(None, None, None)
            raise
        self.bus.on_stop.append(self._tell_stop)
        self.journal.begin()
        self.gate.on_access.append(self._let_go)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Let nobody in any more, tell all clients what became of their requests, and let them go."""
        self.bus.on_stop.remove(self._tell_stop)
        self.gate.on_access.remove(self._let_go)
        await self.safe_wishes.close()
        for server in self._servers:
            server.close(close_connections=False)
        for client in self.clients:
            client.release()
        try:
            async with asyncio.timeout(CLOSE_WITHIN):
                await asyncio.gather(*(self._bid_farewell(*of) for of in list(self._clients.items())))
        except TimeoutError:
            pass  # one that does not listen
        finally:
            for connection in self._clients.values():
                connection.transport.abort()
            try:
                for server in self._servers:
                    await server.wait_closed()
            finally:
                self._served.__exit__(None, None, None)
                await self.journal.close()

    # what clients share

    def broadcast_of(self, group: PollGroup) -> Broadcast:
        """Return what tells the cycles of a poll group."""
        if group not in self._groups:
            self._groups[group] = GroupBroadcast(group, partial(self._forget_group, group))
        return self._groups[group]

    def events(self) -> Broadcast:
        """Return what tells of line and nodes."""
        if self._events is None:
            self._events = EventBroadcast(self.bus, self._end_events)
        return self._events

    def overview(self) -> Broadcast:
        """Return what tells what a person sees of the line."""
        if self._overview is None:
            self._overview = Overview(self.bus, self.gate, self.journal, lambda: self.title, self._end_overview)
        return self._overview

    def exchanges(self) -> Broadcast:
        """Return what tells what passes on the line."""
        if self._exchanges is None:
            self._exchanges = ExchangesBroadcast(self.bus, self._end_exchanges)
        return self._exchanges

    def group(self, name: str) -> PollGroup:
        """Return a poll group. Raises InvalidCommand, with those that there are, for a name that is none."""
        found = next((group for group in self.bus.groups if group.name == name), None)
        if found is None:
            names = ", ".join(group.name for group in self.bus.groups) or "none"
            raise InvalidCommand(f"no poll group {name!r}; there are: {names}")
        return found

    def point(self, group: str, key: str) -> tuple[PollGroup, Point[Any]]:
        """Return a point of a poll group, and the group. Raises InvalidCommand if there is none."""
        found = self.group(group)
        for point in found.points:
            if point.key == key:
                return found, point
        raise InvalidCommand(f"poll group {group!r} has no point {key!r}")

    def node(self, protocol: str, address: int) -> Node:
        """Return a node that is on the line. Raises InvalidCommand if there is none."""
        for node in self.bus.nodes:
            if (node.profile.name, node.address) == (protocol, address):
                return node
        raise InvalidCommand(f"there is no node {address} of {protocol} on this line")

    def named(self, node: Node, places: Collection[Hashable]) -> Point[Any] | None:
        """Return the point of a poll group that reads these places of a node."""
        groups = [(group.name, group.points) for group in self.bus.groups]
        if groups != self._points_of:
            self._points_of = groups
            self._points = {
                (point.node, frozenset(point.command.places)): point
                for _, points in groups
                for point in points
                if isinstance(point.command, Placed)
            }
        return self._points.get((node, frozenset(places)))

    def _forget_group(self, group: PollGroup) -> None:
        self._groups.pop(group, None)

    def _end_events(self) -> None:
        self._events = None

    def _end_overview(self) -> None:
        self._overview = None

    def _end_exchanges(self) -> None:
        self._exchanges = None

    def _tell_stop(self, record: NodeRecord) -> None:
        for client in self._clients:
            client.tell_stops(record)

    # one connection

    async def _serve_at(self, opened: socket.socket) -> Server:
        by_path, by_port = _websockets()
        serve = by_path if opened.family == socket.AF_UNIX else by_port
        server: Server = await serve(
            self._serve,
            sock=opened,
            process_request=self._check_request,
            origins=[None],
            compression=None,
            max_size=LONGEST_MESSAGE,
            close_timeout=CLOSE_WITHIN,
            server_header=None,
            logger=_quiet(),
        )
        return server

    def _check_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Refuse whoever is one too many, or shows no token, and what may be a page's.

        An Origin is refused by the library.
        """
        host = request.headers.get("Host", "")
        if host.partition(":")[0] not in HOSTS and not (self._listen and is_our_name(host, self._listen)):
            self.refused += 1
            return connection.respond(HTTPStatus.FORBIDDEN, f"no such host: {host[:40]!r}\n")
        if self._peer(connection, request) is None:
            self.refused += 1
            return connection.respond(HTTPStatus.UNAUTHORIZED, "a token that is known here is needed\n")
        if len(self._clients) >= MOST_CLIENTS:
            self.refused += 1
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{MOST_CLIENTS} programs are here already\n")
        return None

    def _peer(self, connection: ServerConnection, request: Request) -> Peer | None:
        """Return who has connected; None for whoever shows no token where one is needed."""
        connected = connection.transport.get_extra_info("socket")
        if connected.family == socket.AF_UNIX:
            return process_of(connected)
        return holder(connected, request.headers, self.gate.access)

    def _let_go(self) -> None:
        """Let those go whose token holds no more."""
        for client, connection in self._clients.items():
            if not client.peer.may_stay(self.gate.access):
                connection.transport.abort()

    async def _serve(self, connection: ServerConnection) -> None:
        assert connection.request is not None
        peer = self._peer(connection, connection.request)
        if peer is None:  # its token held as it came, and not any more
            return
        connection.transport.max_size = READ_AT_ONCE  # type: ignore[attr-defined]  # asyncio's own, not declared
        self._count += 1

        def drop(stream: object) -> None:
            client.dropped[stream] = client.dropped.get(stream, 0) + 1

        client = Client(self, peer, self._count, Outbox(partial(_send, connection), drop))
        self._clients[client] = connection
        sending = asyncio.ensure_future(client.outbox.run())
        try:
            async with asyncio.timeout(HELLO_WITHIN):
                self._welcome(client, read(await connection.recv()))
            async for text in connection:
                client.take(read(text))
                await client.outbox.room()
                await asyncio.sleep(0)  # what came together is taken one by one: the line goes between
        except (Malformed, TimeoutError) as error:
            self.refused += 1
            code = error.code if isinstance(error, Malformed) else INVALID_PARAMS
            what = str(error) or "no hello came"
            client.outbox.put(written({"id": None, "error": {"code": code, "message": what}}))
            await self._last_words(client)
            await connection.close(POLICY, what[:100])
        except _closed():
            pass
        finally:
            sending.cancel()
            try:
                await client.leave()
                await asyncio.gather(sending, return_exceptions=True)
            finally:
                del self._clients[client]

    def _welcome(self, client: Client, said: dict[str, Any]) -> None:
        params = said.get("params", {})
        wanted = params.get("versions") if isinstance(params, dict) else None
        if said.get("method") != "hello" or not isinstance(wanted, list):
            raise Malformed("the first message is hello, with the versions that its client knows")
        common = [version for version in VERSIONS if version in wanted]
        if not common:
            raise Malformed(f"versions {wanted} are not spoken here, but {list(VERSIONS)}", INVALID_PARAMS)
        owner = self._served.owner
        nodes = [
            {
                "protocol": node.profile.name,
                "address": node.address,
                "label": node.label,
                "health": node.health.value,
            }
            for node in self.bus.nodes
        ]
        result = {
            "version": max(common),
            "name": owner.name,
            "line": owner.port,
            "baudrate": owner.baudrate,
            "framing": owner.framing,
            "echo": owner.echo,
            "tcp": self.tcp_address,
            "process": owner.pid,
            "read_only": self.gate.read_only or not client.permission.writes,
            "clients": len(self._clients),
            "state": state_text(self.bus),
            "nodes": nodes,
        }
        client.outbox.put(written({"id": said.get("id"), "result": result}))

    async def _bid_farewell(self, client: Client, connection: ServerConnection) -> None:
        await self._last_words(client)
        await connection.close(GOING_AWAY, "the program that owns the line ends")

    async def _last_words(self, client: Client) -> None:
        try:
            async with asyncio.timeout(CLOSE_WITHIN):
                await client.outbox.flushed()
        except TimeoutError:
            pass


async def _send(connection: ServerConnection, text: str) -> None:
    try:
        async with asyncio.timeout(SEND_WITHIN):
            await connection.send(text)
    except TimeoutError:
        connection.transport.abort()  # the library's pings wait behind what is not taken, and find nothing out
        raise


def _websockets() -> tuple[Any, Any]:
    """Return what serves a Unix socket, and a port. Raises InvalidCommand where it is not installed."""
    try:
        from websockets.asyncio.server import serve, unix_serve
    except ImportError:
        raise InvalidCommand("the service needs websockets: pip install 'busmaster[service]'") from None
    return unix_serve, serve


def _closed() -> type[Exception]:
    from websockets.exceptions import ConnectionClosed

    return ConnectionClosed


def _quiet() -> logging.Logger:
    """Return a log for what the library says of connections that come and go: it is no news of the line's."""
    log = logging.getLogger("busmaster.service.connections")
    log.addHandler(logging.NullHandler())
    log.propagate = False
    return log
