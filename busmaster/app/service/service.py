"""The socket of one line, through which other programs use its nodes."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from math import inf
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from busmaster import Bus, InvalidCommand, ext
from busmaster.app.service.admission import Admission, ConnectionRate, connecting_peer, stranger_to_close
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.client import Client
from busmaster.app.service.client_connection import ClientConnection, MessageOrder
from busmaster.app.service.client_messages import ClientMessage, HelloParams
from busmaster.app.service.connection import CLOSE_WITHIN, check_installed
from busmaster.app.service.encoding import listed_groups
from busmaster.app.service.folder import Owner, ServedSocket, checked_name, line_name, runtime_folder
from busmaster.app.service.line import ServedLine
from busmaster.app.service.messages import (
    INVALID_PARAMS,
    VERSIONS,
    InvalidParams,
    Malformed,
    decode_request_params,
    encode_notification,
    encode_result,
)
from busmaster.app.service.outbox import Outbox
from busmaster.app.service.overview import state_text
from busmaster.app.service.owner_messages import HelloResult, KnownNode, PollGroupsParams, TouchedParams
from busmaster.app.service.peers import Holder, Peer, find_name, process_of
from busmaster.app.service.refusals import SERVICE, Logins, wait_text
from busmaster.app.service.tcp import HostPort, check_listening, holder, is_our_name, listening
from busmaster.ext import LEAST_SHARE, MOST_SHARE, NodeRecord, protocols

if TYPE_CHECKING:
    from websockets.datastructures import Headers
    from websockets.http11 import Request

HOSTS = ("localhost", "busmaster")
"""Host names of this server. A web page that was tricked into a request here would use another one."""
MOST_WAITING_TO_CONNECT = 100
NAME_WITHIN = 1.0
"""Seconds that the first client waits at most for this user's name. Audit entries then have the number."""
WITHDRAWN = "this token is not valid any more"
GROUPS_EVERY = 0.1
"""Seconds between two lists of the poll groups, however often clients open and close groups."""


class Service:
    """Serve a bus that is open, on a Unix socket, in `async with`. It ends before the bus is closed.

    `path` is the socket's. Without it, the socket is NAME.sock in this user's runtime folder. `name` is that of the
    line, by default its port's: letters, digits, and _.- between them. `authorisation` checks every write. By default
    it stores audit entries in the log "busmaster.audit", and permits this user to write and others to read. `mode` and
    `group`, a number, are the socket's. `listen` is a host and a port for connections by TCP; other machines can
    connect only if authorisation has tokens. Each program takes turns with the others and with this one. `share`, 0.1
    to 10, weighs its line time: with 0.5, it gets half as much as this one while both wait. `title` is shown above the
    views of the line. Raises InvalidCommand for invalid arguments. Entering raises it if the socket cannot be created,
    or is served by another process, which the error names.
    """

    def __init__(
        self,
        bus: Bus,
        *,
        authorisation: Authorisation | None = None,
        name: str | None = None,
        path: Path | str | None = None,
        mode: int = 0o600,
        group: int | None = None,
        share: float = 1.0,
        listen: HostPort | None = None,
        title: str = "",
    ) -> None:
        if isinstance(share, bool) or not LEAST_SHARE <= share <= MOST_SHARE:
            raise InvalidCommand(f"a share must be a number from {LEAST_SHARE:g} to {MOST_SHARE:g}, not {share!r}")
        self.bus = bus
        self.authorisation = authorisation or Authorisation(bus)
        if listen is not None:
            check_listening(listen, tokens=bool(self.authorisation.access.secrets))
        self.name = line_name(bus.endpoint.name) if name is None else checked_name(name)
        self.line = ServedLine(bus, self.authorisation, share, title or self.name)
        self.refused = 0
        """Connections that were one too many, or began with an invalid message."""
        self._path = None if path is None else Path(path).absolute()
        self._mode = mode
        self._group = group
        self._listen = listen
        self._served: ServedSocket
        self._servers: list[asyncio.Server] = []
        self._clients: dict[Client, ClientConnection] = {}
        self._strangers: dict[ClientConnection, None] = {}
        """Connections without a first message, the oldest first."""
        self._leaving: set[asyncio.Task[None]] = set()
        self._count = 0
        self._admission = Admission(self.authorisation.refusals)
        self._rate = ConnectionRate(time.monotonic)
        self._logins = Logins(partial(self.authorisation.refusals.note_login, SERVICE), time.monotonic)
        self._log = logging.getLogger("busmaster.app.service")
        self.report: Callable[[str], None] = self._log.warning
        """Called, at most once a minute, with a text about refused connections and logins."""
        self.message_order = MessageOrder()
        self._groups_sent = -inf
        self._groups_timer: asyncio.TimerHandle | None = None

    @property
    def address(self) -> str:
        """Return the argument for `connect`."""
        return self._served.owner.address

    @property
    def tcp_address(self) -> str | None:
        """Return the argument for `connect` by TCP; None if that is not possible."""
        if self._listen is None:
            return None
        host, port = self._servers[-1].sockets[0].getsockname()[:2]
        return f"tcp://[{host}]:{port}" if ":" in host else f"tcp://{host}:{port}"

    @property
    def clients(self) -> tuple[Client, ...]:
        """Return the programs that are connected."""
        return tuple(self._clients)

    @property
    def strangers(self) -> int:
        """Return the number of connections without a first message."""
        return len(self._strangers)

    async def __aenter__(self) -> Service:
        check_installed()
        await asyncio.to_thread(protocols)  # they are imported now, and not at the first request of a client
        if finding := find_name(os.getuid()):
            await asyncio.wait([finding], timeout=NAME_WITHIN)
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
        ext.line_of(self.bus).on_stop.append(self._notify_stop)
        self.line.journal.begin()
        ext.line_of(self.bus).on_touched.append(self._notify_touched)
        ext.line_of(self.bus).on_groups.append(self._note_groups)
        self.authorisation.on_access.append(self._notify_access)
        self.authorisation.refusals.on_report.append(self._report)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Stop listening, send all clients the results of their requests, and disconnect them."""
        ext.line_of(self.bus).on_stop.remove(self._notify_stop)
        ext.line_of(self.bus).on_touched.remove(self._notify_touched)
        ext.line_of(self.bus).on_groups.remove(self._note_groups)
        if self._groups_timer is not None:
            self._groups_timer.cancel()
            self._groups_timer = None  # or no list would be sent any more if the bus is served again
        self.authorisation.on_access.remove(self._notify_access)
        self.authorisation.refusals.on_report.remove(self._report)
        await self.line.safe_writes.close()
        for server in self._servers:
            server.close()
        connections = [*self._clients.values(), *self._strangers]
        for client in self._clients:
            client.release()
        for connection in connections:
            connection.end()
        try:
            await _closed(connections)
        finally:
            for connection in connections:
                connection.websocket.abort()
            try:
                await _closed(connections)
                while self._leaving:
                    await asyncio.wait(self._leaving)
            finally:
                self._served.__exit__(None, None, None)
                await self.line.journal.close()

    def _report(self, text: str) -> None:
        """Report a refusal, and show it in the events of the line."""
        self.line.journal.note(text)
        self.report(text)

    def _notify_stop(self, record: NodeRecord) -> None:
        for client in self._clients:
            client.notify_stops(record)

    def _notify_touched(self, record: NodeRecord, when: float) -> None:
        clients = [client for client in self._clients if client.has_values]
        if not clients:
            return
        of_all = record.address == record.profile.broadcast
        items = None if of_all else self.line.stale_items(record, when)
        params = TouchedParams(record.profile.name, record.address, when, of_all, items)
        key = (record.profile.name, record.address, None if items is None else tuple(items))
        for client in clients:
            client.notify_touched(params, key)

    def _note_groups(self) -> None:
        """Send the changed list of poll groups to all clients."""
        if self._groups_timer is None:
            loop = asyncio.get_running_loop()
            due = max(loop.time(), self._groups_sent + GROUPS_EVERY)
            self._groups_timer = loop.call_at(due, self._send_groups)

    def _send_groups(self) -> None:
        self._groups_timer, self._groups_sent = None, asyncio.get_running_loop().time()
        message = encode_notification("poll_groups", PollGroupsParams(listed_groups(self.bus)))
        for client in self._clients:
            client.outbox.put_latest("poll_groups", message)

    # connections

    async def _serve_at(self, opened: socket.socket) -> asyncio.Server:
        """Serve a socket. One connection is accepted in a turn of the loop; the kernel queues the others."""
        loop = asyncio.get_running_loop()
        serve: Any = loop.create_unix_server if opened.family == socket.AF_UNIX else loop.create_server
        server: asyncio.Server = await serve(self._connected, sock=opened, backlog=1)
        opened.listen(MOST_WAITING_TO_CONNECT)
        return server

    def _connected(self) -> asyncio.BaseProtocol:
        """Return the end of a new connection, and close the oldest one if there are too many."""
        if (one_too_many := stranger_to_close(self._strangers)) is not None:
            self.refused += 1
            one_too_many.websocket.abort()
        connection = ClientConnection(self)
        self._strangers[connection] = None
        return connection.websocket

    def delay(self, origin: int | str | None, process: int, /) -> float | None:
        """Return after how many seconds the connection is read; None if it is closed, which is counted."""
        delay = self._rate.delay(connecting_peer(origin, process))
        if delay is None:
            self.refused += 1
            self.authorisation.refusals.note_rate(origin if isinstance(origin, str) else f"user {origin}")
        return delay

    def refusal(self, connection: ClientConnection, request: Request, /) -> tuple[int, str] | None:
        """Store the peer. Refuse possible requests of web pages, missing or wrong tokens, and one connection too many.

        An Origin is refused by the library.
        """
        refusal = self._refusal(connection, request.headers)
        if refusal is not None:
            self.refused += 1
        return refusal

    def _refusal(self, connection: ClientConnection, headers: Headers) -> tuple[int, str] | None:
        hosts, shown = headers.get_all("Host"), headers.get_all("Authorization")
        if len(hosts) != 1 or not self._is_our_name(hosts[0]):
            return HTTPStatus.FORBIDDEN, f"no such host: {', '.join(hosts)[:40]!r}\n"
        peer, origin = (
            self._peer(connection.websocket.transport.get_extra_info("socket"), shown),
            connection.websocket.origin,
        )
        if shown and isinstance(origin, str):  # by TCP
            wait = self._logins.judge(origin, peer.token if isinstance(peer, Holder) else None)
            if wait:
                return HTTPStatus.TOO_MANY_REQUESTS, f"{wait_text(wait)}\n"
        if peer is None:
            return HTTPStatus.UNAUTHORIZED, "a known token is required\n"
        permission = peer.permission(self.authorisation.access)
        # A program that may write declares in `hello` whether it only sends the safe state, which has reserved places.
        if not permission.writes and (refusal := self._admission.refusal(permission, self._clients)):
            return HTTPStatus.SERVICE_UNAVAILABLE, f"{refusal}\n"
        connection.peer = peer
        return None

    def _is_our_name(self, host: str) -> bool:
        return host.partition(":")[0] in HOSTS or (self._listen is not None and is_our_name(host, self._listen))

    def _peer(self, connected: socket.socket, shown: Sequence[str]) -> Peer | None:
        """Return the peer that has connected; None if it shows no token and one is required."""
        if connected.family == socket.AF_UNIX:
            return process_of(connected)
        return holder(connected, shown, self.authorisation.access)

    def _notify_access(self) -> None:
        """Disconnect clients whose token is not valid any more, and send the others their permission."""
        for client, connection in self._clients.items():
            if client.peer.may_stay(self.authorisation.access):
                client.notify_access()
            else:
                connection.cut(WITHDRAWN)

    def admit(self, connection: ClientConnection, message: ClientMessage, /) -> Client:
        """Admit a program by its first message, and reply to that. Raises Malformed."""
        if message.method != "hello":
            raise Malformed("the first message must be hello, with the supported versions")
        try:
            params: HelloParams = decode_request_params(message.method, message.params)
        except InvalidParams as error:
            raise Malformed(f"the first message must be hello, with the supported versions ({error})") from None
        common = [version for version in VERSIONS if version in params.versions]
        if not common:
            raise Malformed(
                f"the service protocol has version {VERSIONS[-1]} here, not {params.versions}; "
                "update the older of the two programs",
                INVALID_PARAMS,
            )
        if not connection.peer.may_stay(self.authorisation.access):
            raise Malformed(WITHDRAWN)
        permission = connection.peer.permission(self.authorisation.access)
        in_safe_place = self._admission.admit(permission, self._clients, safe_only=params.safe_only)

        def drop(stream: object) -> None:
            client.dropped[stream] += 1

        self._count += 1
        outbox = Outbox(connection.websocket, drop)
        client = Client(self.line, connection.peer, self._count, outbox, in_safe_place=in_safe_place)
        del self._strangers[connection]
        self._clients[client] = connection
        client.outbox.put(encode_result(message.id, self._about(client, max(common))))
        return client

    def count_rejected(self, connection: ClientConnection, /) -> None:
        """Count a connection that was closed because of an invalid or missing message."""
        self.refused += 1

    def ended(self, connection: ClientConnection, /) -> None:
        """End the requests of a program whose connection is over."""
        self._strangers.pop(connection, None)
        if connection.client is not None:
            leaving = asyncio.ensure_future(self._end_client(connection.client))
            self._leaving.add(leaving)
            leaving.add_done_callback(self._leaving.discard)

    async def _end_client(self, client: Client) -> None:
        try:
            await client.leave()
        finally:
            del self._clients[client]

    def _about(self, client: Client, version: int) -> HelloResult:
        """Return the description of the line for a program."""
        owner, refusals = self._served.owner, self.authorisation.refusals
        return HelloResult(
            version=version,
            now=self.bus.now(),
            name=owner.name,
            line=owner.port,
            baudrate=owner.baudrate,
            framing=owner.framing,
            echo=owner.echo,
            tcp=self.tcp_address,
            process=owner.pid,
            read_only=client.read_only,
            clients=len(self._clients),
            refused_connections=refusals.total("connections"),
            refused_requests=refusals.total("requests"),
            failed_logins=refusals.logins.total(),
            state=state_text(self.bus),
            nodes=[
                KnownNode(node.profile.name, node.address, node.label, node.health.value) for node in self.bus.nodes
            ],
            groups=listed_groups(self.bus),
        )


async def _closed(connections: Iterable[ClientConnection]) -> None:
    """Wait until connections are over, for CLOSE_WITHIN: there may be one that does not listen."""
    with suppress(TimeoutError):
        async with asyncio.timeout(CLOSE_WITHIN):
            for connection in connections:
                await connection.websocket.closed()
