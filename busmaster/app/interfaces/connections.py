"""The connections of the page's server: their maximum number, and the longest time that each may block the server.

The server's library limits neither. A connection that sends nothing or half a request, or does not read its reply,
would stay open as long as its client likes. Each needs a descriptor.
"""

from __future__ import annotations

import asyncio
import resource
from collections import Counter
from collections.abc import Callable
from functools import partial
from typing import Any

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

from busmaster.app.bounds import MOST_PAGE_CONNECTIONS, READ_AT_ONCE, REQUEST_WITHIN, SEND_WITHIN
from busmaster.app.service.refusals import LimitedReport

RESERVED = 128
"""Descriptors that connections leave: for those that are accepted before others are closed, for files and sockets."""
FEWEST = 16
WAITING = (h11.IDLE, h11.SEND_BODY)
"""States of a client that has not sent a whole request."""


def most_connections() -> int:
    """Return how many connections are held at a time: below the number of descriptors that this process may have."""
    soft, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
    return MOST_PAGE_CONNECTIONS if soft == resource.RLIM_INFINITY else min(MOST_PAGE_CONNECTIONS, soft - RESERVED)


class Crowd:
    """All connections of one server. Beyond the bound, the one that has waited longest without a request is closed."""

    def __init__(self, report: Callable[[str], None]) -> None:
        self.most = max(FEWEST, most_connections())
        self._report = LimitedReport(report, self._closed_text)
        self._waiting: dict[HttpConnection, None] = {}
        """Connections without a whole request; the one that has waited longest first."""

    def protocols(self) -> dict[str, Any]:
        """Return what the server's settings take: the classes of its connections."""
        return {"http": partial(HttpConnection, crowd=self), "ws": PageConnection}

    def note_waiting(self, connection: HttpConnection, count: int) -> None:
        """Note a connection that has no whole request; `count` connections are open with it."""
        self._waiting[connection] = None
        if count > self.most:
            oldest = next(iter(self._waiting))
            self.note_busy(oldest)
            oldest.transport.abort()
            self._report.note()

    def note_busy(self, connection: HttpConnection) -> None:
        """Note a connection that has a whole request, or that is over."""
        self._waiting.pop(connection, None)

    def _closed_text(self, counts: Counter[str]) -> str:
        many = counts.total()
        closed = f"{many} that had sent no whole request {'was' if many == 1 else 'were'} closed"
        return f"there are {self.most} connections to the page, and no more are held: {closed}"


class _Taken:
    """A connection of which READ_AT_ONCE bytes are handled in a turn of the loop, so that all others get their turns,
    and whose client must read its messages. One that reads nothing for SEND_WITHIN is closed."""

    transport: Any
    _reading: asyncio.TimerHandle | None = None

    def connection_made(self, transport: Any) -> None:
        # The library handles all that it gets in one turn: of 256 KiB, which is asyncio's value, that is a second.
        transport.max_size = READ_AT_ONCE
        super().connection_made(transport)  # type: ignore[misc]

    def pause_writing(self) -> None:
        super().pause_writing()  # type: ignore[misc]
        if self._reading is None:
            self._reading = asyncio.get_running_loop().call_later(SEND_WITHIN, self.transport.abort)

    def resume_writing(self) -> None:
        super().resume_writing()  # type: ignore[misc]
        self._read()

    def connection_lost(self, exc: Exception | None) -> None:
        self._read()
        super().connection_lost(exc)  # type: ignore[misc]

    def _read(self) -> None:
        if self._reading is not None:
            self._reading.cancel()
            self._reading = None


class HttpConnection(_Taken, H11Protocol):
    """A connection whose client must send each request whole within REQUEST_WITHIN."""

    def __init__(self, *args: Any, crowd: Crowd, **options: Any) -> None:
        super().__init__(*args, **options)
        self._crowd = crowd
        self._request: asyncio.TimerHandle | None = None
        self._upgraded = False
        """Whether the connection is a page's, which another object serves from now on."""

    def handle_websocket_upgrade(self, event: h11.Request) -> None:
        self._upgraded = True
        super().handle_websocket_upgrade(event)

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self._look()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        self._look()

    def on_response_complete(self) -> None:
        super().on_response_complete()
        self._look()

    def connection_lost(self, exc: Exception | None) -> None:
        self._have_request()
        super().connection_lost(exc)

    def _look(self) -> None:
        """Begin to wait for a request, or have one."""
        if self._upgraded or self.conn.their_state not in WAITING or self.transport.is_closing():
            self._have_request()
        elif self._request is None:
            self._request = self.loop.call_later(REQUEST_WITHIN, self.transport.abort)
            self._crowd.note_waiting(self, len(self.connections))

    def _have_request(self) -> None:
        self._crowd.note_busy(self)
        if self._request is not None:
            self._request.cancel()
            self._request = None


class PageConnection(_Taken, WebSocketsSansIOProtocol):
    """A page that follows the line. The library sends pings, and closes one that does not answer them."""
