"""The socket of one line, at which other programs ask its nodes."""

from __future__ import annotations

import asyncio
import logging
import os
import socket
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from http import HTTPStatus
from math import inf
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any

from busmaster import Bus, ext
from busmaster.app.service.admission import Admission, ConnectionRate, connecting_peer, stranger_to_close
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.client import Client
from busmaster.app.service.connection import CLOSE_WITHIN, check_installed
from busmaster.app.service.folder import Owner, ServedSocket, checked_name, line_name, runtime_folder
from busmaster.app.service.line import ServedLine
from busmaster.app.service.messages import INVALID_PARAMS, VERSIONS, Malformed, written
from busmaster.app.service.outbox import Outbox
from busmaster.app.service.overview import state_text
from busmaster.app.service.peers import Holder, Peer, find_name, process_of
from busmaster.app.service.refusals import SERVICE, Logins, wait_text
from busmaster.app.service.tcp import HostPort, check_listening, holder, is_our_name, listening
from busmaster.app.service.telling import listed_groups
from busmaster.app.service.visit import Reception, Visit
from busmaster.errors import InvalidCommand
from busmaster.ext import LEAST_SHARE, MOST_SHARE, NodeRecord
from busmaster.registry import protocols

if TYPE_CHECKING:
    from websockets.datastructures import Headers
    from websockets.http11 import Request

HOSTS = ("localhost", "busmaster")
"""What a client calls us: a page that was tricked into asking here would say another name."""
MOST_WAITING_TO_CONNECT = 100
NAME_WITHIN = 1.0
"""Seconds that the first client waits at most for this user's name: records then have his number."""
GROUPS_EVERY = 0.1
"""Seconds between two lists of the poll groups, however often a client begins and ends its own."""


class Service:
    """Serve a bus that is open, on a Unix socket, in `async with`. It ends before the bus is closed.

    `path` is the socket's; without it, it is NAME.sock in this user's runtime folder, where `name` is that of the line,
    by default its port's: letters, digits, and _.- between them. Every write passes `authorisation`, which says who may
    do what: without one, its own, which keeps a record in the log "busmaster.audit", and lets this user write and
    others read. `mode` and `group`, a number, are the socket's. `listen` is a host and a port where programs may come
    by TCP too: off this machine only where authorisation knows tokens. Each program takes turns with the others and
    with this one; `share`, 0.1 to 10, weighs its line time: with 0.5, half as much as this one has, as long as both
    wait. `title` is written over what a person sees of the line. Raises InvalidCommand for what cannot be; so does
    entering where the socket is served by another process, which it names, or cannot be made.
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
            raise InvalidCommand(f"a program's share is a number from {LEAST_SHARE:g} to {MOST_SHARE:g}, not {share!r}")
        self.bus = bus
        self.authorisation = authorisation or Authorisation(bus)
        if listen is not None:
            check_listening(listen, tokens=bool(self.authorisation.access.secrets))
        self.name = line_name(bus.endpoint.name) if name is None else checked_name(name)
        self.line = ServedLine(bus, self.authorisation, share, title or self.name)
        self.refused = 0
        """Connections that were one too many, or that began with what no client says."""
        self._path = None if path is None else Path(path).absolute()
        self._mode = mode
        self._group = group
        self._listen = listen
        self._served: ServedSocket
        self._servers: list[asyncio.Server] = []
        self._clients: dict[Client, Visit] = {}
        self._strangers: dict[Visit, None] = {}
        """Connections of which no first message has come, the oldest first."""
        self._leaving: set[asyncio.Task[None]] = set()
        self._count = 0
        self._admission = Admission(self.authorisation.refusals)
        self._rate = ConnectionRate(time.monotonic)
        self._logins = Logins(partial(self.authorisation.refusals.note_login, SERVICE), time.monotonic)
        self._log = logging.getLogger("busmaster.app.service")
        self.tell: Callable[[str], None] = self._log.warning
        """Told, at most once a minute, of connections and logins that were refused."""
        self.reception = Reception()
        self._groups_sent = -inf
        self._groups_timer: asyncio.TimerHandle | None = None

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

    @property
    def strangers(self) -> int:
        """Return how many connections there are of which no first message has come."""
        return len(self._strangers)

    async def __aenter__(self) -> Service:
        check_installed()
        await asyncio.to_thread(protocols)  # they are imported for this: not when the first client asks
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
        ext.line_of(self.bus).on_stop.append(self._tell_stop)
        self.line.journal.begin()
        ext.line_of(self.bus).on_touched.append(self._tell_touched)
        ext.line_of(self.bus).on_groups.append(self._note_groups)
        self.authorisation.on_access.append(self._tell_access)
        self.authorisation.refusals.on_report.append(self._report)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Let nobody in any more, tell all clients what became of their requests, and let them go."""
        ext.line_of(self.bus).on_stop.remove(self._tell_stop)
        ext.line_of(self.bus).on_touched.remove(self._tell_touched)
        ext.line_of(self.bus).on_groups.remove(self._note_groups)
        if self._groups_timer is not None:
            self._groups_timer.cancel()
        self.authorisation.on_access.remove(self._tell_access)
        self.authorisation.refusals.on_report.remove(self._report)
        await self.line.safe_wishes.close()
        for server in self._servers:
            server.close()
        visits = [*self._clients.values(), *self._strangers]
        for client in self._clients:
            client.release()
        for visit in visits:
            visit.bid_farewell()
        try:
            await _closed(visits)
        finally:
            for visit in visits:
                visit.connection.abort()
            try:
                await _closed(visits)
                while self._leaving:
                    await asyncio.wait(self._leaving)
            finally:
                self._served.__exit__(None, None, None)
                await self.line.journal.close()

    def _report(self, text: str) -> None:
        """Report what was refused, and show it among the events of the line."""
        self.line.journal.note(text)
        self.tell(text)

    def _tell_stop(self, record: NodeRecord) -> None:
        for client in self._clients:
            client.tell_stops(record)

    def _tell_touched(self, record: NodeRecord, when: float) -> None:
        clients = [client for client in self._clients if client.has_values]
        if not clients:
            return
        params: dict[str, Any] = {"protocol": record.profile.name, "address": record.address, "when": when}
        params["all"] = record.address == record.profile.broadcast
        items = params["items"] = None if params["all"] else self.line.stale_items(record, when)
        key = (record.profile.name, record.address, None if items is None else tuple(items))
        for client in clients:
            client.tell_touched(params, key)

    def _note_groups(self) -> None:
        """Have all clients sent the list of the poll groups: it has changed."""
        if self._groups_timer is None:
            loop = asyncio.get_running_loop()
            due = max(loop.time(), self._groups_sent + GROUPS_EVERY)
            self._groups_timer = loop.call_at(due, self._send_groups)

    def _send_groups(self) -> None:
        self._groups_timer, self._groups_sent = None, asyncio.get_running_loop().time()
        text = written({"method": "poll_groups", "params": {"groups": listed_groups(self.bus)}})
        for client in self._clients:
            client.outbox.put_latest("poll_groups", text)

    # those who come

    async def _serve_at(self, opened: socket.socket) -> asyncio.Server:
        """Serve a socket. One connection is taken in a turn of the loop; that others wait is the kernel's affair."""
        loop = asyncio.get_running_loop()
        serve: Any = loop.create_unix_server if opened.family == socket.AF_UNIX else loop.create_server
        server: asyncio.Server = await serve(self._visited, sock=opened, backlog=1)
        opened.listen(MOST_WAITING_TO_CONNECT)
        return server

    def _visited(self) -> asyncio.BaseProtocol:
        """Return the end of a connection that was made just now, and close one that is one too many for it."""
        if (one_too_many := stranger_to_close(self._strangers)) is not None:
            self.refused += 1
            one_too_many.connection.abort()
        visit = Visit(self)
        self._strangers[visit] = None
        return visit.connection

    def delay(self, origin: int | str | None, process: int, /) -> float | None:
        """Return after how many seconds a connection from there is read; None if it is closed, and counted."""
        delay = self._rate.delay(connecting_peer(origin, process))
        if delay is None:
            self.refused += 1
            self.authorisation.refusals.note_rate(origin if isinstance(origin, str) else f"user {origin}")
        return delay

    def refusal(self, visit: Visit, request: Request, /) -> tuple[int, str] | None:
        """Note who has come. Refuse what may be a page's, whoever shows no token, and one too many.

        An Origin is refused by the library.
        """
        refusal = self._refusal(visit, request.headers)
        if refusal is not None:
            self.refused += 1
        return refusal

    def _refusal(self, visit: Visit, headers: Headers) -> tuple[int, str] | None:
        hosts, shown = headers.get_all("Host"), headers.get_all("Authorization")
        if len(hosts) != 1 or not self._is_our_name(hosts[0]):
            return HTTPStatus.FORBIDDEN, f"no such host: {', '.join(hosts)[:40]!r}\n"
        peer, origin = self._peer(visit.connection.transport.get_extra_info("socket"), shown), visit.connection.origin
        if shown and isinstance(origin, str):  # by TCP
            wait = self._logins.judge(origin, peer.token if isinstance(peer, Holder) else None)
            if wait:
                return HTTPStatus.TOO_MANY_REQUESTS, f"{wait_text(wait)}\n"
        if peer is None:
            return HTTPStatus.UNAUTHORIZED, "a token that is known here is needed\n"
        permission = peer.permission(self.authorisation.access)
        # One that may write says in `hello` whether it only sends the safe state, which has places of its own.
        if not permission.writes and (refusal := self._admission.refusal(permission, self._clients)):
            return HTTPStatus.SERVICE_UNAVAILABLE, f"{refusal}\n"
        visit.peer = peer
        return None

    def _is_our_name(self, host: str) -> bool:
        return host.partition(":")[0] in HOSTS or (self._listen is not None and is_our_name(host, self._listen))

    def _peer(self, connected: socket.socket, shown: Sequence[str]) -> Peer | None:
        """Return who has connected; None for whoever shows no token where one is needed."""
        if connected.family == socket.AF_UNIX:
            return process_of(connected)
        return holder(connected, shown, self.authorisation.access)

    def _tell_access(self) -> None:
        """Let those go whose token holds no more, and tell the others what they may do now."""
        for client, visit in self._clients.items():
            if client.peer.may_stay(self.authorisation.access):
                client.tell_access()
            else:
                visit.connection.abort()

    def welcome(self, visit: Visit, said: Mapping[str, Any], /) -> Client:
        """Let a program in by its first message, and answer that. Raises Malformed."""
        params = said.get("params", {})
        wanted = params.get("versions") if isinstance(params, dict) else None
        if said.get("method") != "hello" or not isinstance(wanted, list):
            raise Malformed("the first message is hello, with the versions that its client knows")
        common = [version for version in VERSIONS if version in wanted]
        if not common:
            raise Malformed(
                f"the service protocol has version {VERSIONS[-1]} here, not {wanted}: "
                "update the older of the two programs",
                INVALID_PARAMS,
            )
        if not visit.peer.may_stay(self.authorisation.access):
            raise Malformed("this token is known no more")
        permission, safe_only = visit.peer.permission(self.authorisation.access), params.get("safe_only") is True
        in_safe_place = self._admission.admit(permission, self._clients, safe_only=safe_only)

        def drop(stream: object) -> None:
            client.dropped[stream] = client.dropped.get(stream, 0) + 1

        self._count += 1
        outbox = Outbox(visit.connection, drop)
        client = Client(self.line, visit.peer, self._count, outbox, in_safe_place=in_safe_place)
        del self._strangers[visit]
        self._clients[client] = visit
        client.outbox.put(written({"id": said.get("id"), "result": self._about(client, max(common))}))
        return client

    def send_away(self, visit: Visit, /) -> None:
        """Count one whose conversation is ended for what it said, or did not say."""
        self.refused += 1

    def over(self, visit: Visit, /) -> None:
        """Have a program leave whose connection is over, with all that it asked for."""
        self._strangers.pop(visit, None)
        if visit.client is not None:
            leaving = asyncio.ensure_future(self._see_off(visit.client))
            self._leaving.add(leaving)
            leaving.add_done_callback(self._leaving.discard)

    async def _see_off(self, client: Client) -> None:
        try:
            await client.leave()
        finally:
            del self._clients[client]

    def _about(self, client: Client, version: int) -> dict[str, Any]:
        """Return what a program is told of the line."""
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
        return {
            "version": version,
            "now": self.bus.now(),
            "name": owner.name,
            "line": owner.port,
            "baudrate": owner.baudrate,
            "framing": owner.framing,
            "echo": owner.echo,
            "tcp": self.tcp_address,
            "process": owner.pid,
            "read_only": client.read_only,
            "clients": len(self._clients),
            "refused_connections": self.authorisation.refusals.total("connections"),
            "refused_requests": self.authorisation.refusals.total("requests"),
            "failed_logins": self.authorisation.refusals.logins.total(),
            "state": state_text(self.bus),
            "nodes": nodes,
            "groups": listed_groups(self.bus),
        }


async def _closed(visits: Iterable[Visit]) -> None:
    """Wait until connections are over, for CLOSE_WITHIN: there may be one that does not listen."""
    with suppress(TimeoutError):
        async with asyncio.timeout(CLOSE_WITHIN):
            for visit in visits:
                await visit.connection.closed()
