"""One end of a WebSocket, without a task: what is said leaves in the turn of the loop in which it is said, and what
comes is heard in that in which it came. The library knows the bytes; here are the transport, the time, and the end.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING, Any, Protocol, cast

from busmaster.app.service.frames import NO_MASK, look_at, new_key, text_frame
from busmaster.app.service.peers import CREDENTIALS
from busmaster.app.service.refusals import peer_of
from busmaster.bounds import MOST_FRAMES, SEND_WITHIN
from busmaster.errors import InvalidCommand

if TYPE_CHECKING:
    from websockets.client import ClientProtocol
    from websockets.frames import Frame
    from websockets.http11 import Request, Response
    from websockets.server import ServerProtocol

PING_EVERY = 20.0
"""Seconds between two pings. One that says nothing at all between two of them is let go."""
LONGEST_REFUSAL = 300
"""Bytes of the words of a refusal that are shown."""
CLOSE_WITHIN = 1.0
"""Seconds that the other end has to hear the last of it."""
NORMAL, GOING_AWAY, NO_TEXT, POLICY = 1000, 1001, 1007, 1008

END_OF_HEAD = b"\r\n\r\n"
LONGEST_HEAD = 14
"""Bytes of a frame before its message."""
_BINARY, _CONTROL, _OPEN = 2, 8, 1  # numbers of the WebSocket's standard, and of the library's states
_ANY_URI = "ws://busmaster/"


class Hearer(Protocol):
    """Who hears what comes. Nothing of it may raise: the connection would be lost."""

    def opened(self) -> None:
        """Hear that messages may be said, and will come."""
        ...

    def heard(self, message: str | bytes) -> None:
        """Hear a message: bytes are none of JSON-RPC's."""
        ...

    def writable(self) -> None:
        """Hear that the connection is not full any more."""
        ...

    def lost(self) -> None:
        """Hear that the connection is over, for whatever reason: the last that is heard."""
        ...


class TokenCheck(Hearer, Protocol):
    """Who hears what comes to one that serves, and decides whether it may."""

    def delay(self, origin: int | str | None, process: int, /) -> float | None:
        """Return after how many seconds a connection that was made is read; None if it is closed."""
        ...

    def refusal(self, request: Request, /) -> tuple[int, str] | None:
        """Return the HTTP status and words with which a request to connect is refused; None if it is not."""
        ...


class Connection(asyncio.BufferedProtocol):
    """One end of a connection, for an event loop. `hearer` hears what comes, at most `read_at_once` bytes in a turn;
    a message of more than `longest` bytes is the last."""

    _serves: bool

    def __init__(
        self, core: ServerProtocol | ClientProtocol, hearer: Hearer, *, longest: int, read_at_once: int
    ) -> None:
        self.full = False
        """Whether what was said last has not left yet: what is said now waits behind it in memory."""
        self._core = core
        self._hearer = hearer
        self._buffer = memoryview(bytearray(read_at_once))
        self._transport: asyncio.Transport | None = None
        self._loop: asyncio.AbstractEventLoop
        self._is_open = False
        self._talks = False
        """Whether messages are said and heard: it is open, and the end of it is not said yet."""
        self._rest = bytearray()
        """The beginning of a frame that has not come whole."""
        self._longest = longest + LONGEST_HEAD
        self._key = b""
        """For the mask of what is said next: an owner has none."""
        self._masks = False
        """Whether each message has another key."""
        self._part: bytearray | None = None
        """The beginning of a message that comes in pieces."""
        self._is_text = True
        self._silent = False
        self._unwanted = False
        """Whether it is to end before it has begun."""
        self._timers: dict[str, asyncio.TimerHandle] = {}
        self._over = asyncio.Event()

    # what its owner calls

    @property
    def transport(self) -> asyncio.Transport:
        """Return what it runs on, once it is made."""
        assert self._transport is not None
        return self._transport

    def say(self, text: str) -> None:
        """Say a message: nothing where the connection ends already."""
        transport = self._transport
        if self._talks and transport is not None and not transport.is_closing():
            transport.write(text_frame(text.encode(), self._key))
            if self._masks:
                self._key = new_key()  # already: what is said next is to wait for nothing

    def close(self, code: int = NORMAL, reason: str = "") -> None:
        """Say that this is the end, behind all that was said; the other end has CLOSE_WITHIN to agree."""
        if self._talks:
            self._core.send_close(code, reason)
            self._write()
        elif not self._is_open:
            self.abort()

    def abort(self) -> None:
        """End it at once."""
        self._unwanted = True
        if self._transport is not None:
            self._transport.abort()

    def pause(self) -> None:
        """Read nothing until `resume`."""
        self.transport.pause_reading()

    def resume(self) -> None:
        """Read on."""
        if self._transport is not None:
            self._transport.resume_reading()

    async def closed(self) -> None:
        """Return when the connection is over."""
        await self._over.wait()

    # what asyncio calls

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._loop = asyncio.get_running_loop()
        self._transport = cast("asyncio.Transport", transport)
        self._transport.set_write_buffer_limits(0)
        if self._unwanted:
            self.abort()

    def get_buffer(self, sizehint: int) -> memoryview:
        return self._buffer

    def buffer_updated(self, count: int) -> None:
        self._silent = False
        self._rest += self._buffer[:count]
        while self._rest:
            if not self._is_open:
                end = self._rest.find(END_OF_HEAD)
                size = end + len(END_OF_HEAD) if end >= 0 else len(self._rest) - len(END_OF_HEAD) + 1
                if size <= 0:
                    return
                self._feed(self._cut(size))
                continue
            size, text = look_at(self._rest, self._serves)
            if not self._talks or size > self._longest:
                self._feed(self._cut(len(self._rest)))
            elif len(self._rest) < size:
                return
            elif text is None or self._part is not None:
                self._feed(self._cut(size))
            else:
                del self._rest[:size]
                self._tell(text, True)

    def eof_received(self) -> None:
        if self._rest:
            self._feed(bytes(self._rest))
        self._core.receive_eof()
        self._write()

    def pause_writing(self) -> None:
        self.full = True
        self._set_timer("taken", SEND_WITHIN, self.abort)

    def resume_writing(self) -> None:
        self.full = False
        self._timers.pop("taken").cancel()
        self._hearer.writable()

    def connection_lost(self, cause: Exception | None) -> None:
        for timer in self._timers.values():
            timer.cancel()
        self._core.receive_eof()
        self._is_open = self._talks = False
        self._over.set()
        self._hearer.lost()

    # inside

    def _shake_hands(self, event: Any) -> None:
        raise NotImplementedError

    def _open(self) -> None:
        self._is_open = self._talks = True
        self._set_timer("ping", PING_EVERY, self._ping)
        self._hearer.opened()

    def _cut(self, size: int) -> bytes:
        part = bytes(self._rest[:size])
        del self._rest[:size]
        return part

    def _check_frame(self) -> None:
        """Look at a frame that is not a whole message."""

    def _feed(self, data: bytes) -> None:
        """Have the library see to what is no whole text."""
        self._core.receive_data(data)
        self._write()
        for event in self._core.events_received():
            if self._is_open:
                self._hear(cast("Frame", event))
            else:
                self._shake_hands(event)

    def _hear(self, frame: Frame) -> None:
        self._check_frame()
        if frame.opcode >= _CONTROL:
            return
        if frame.opcode:
            self._is_text, self._part = frame.opcode != _BINARY, bytearray()
        assert self._part is not None  # the library lets nothing else pass
        self._part += frame.data
        if frame.fin:
            data, self._part = bytes(self._part), None
            self._tell(data, self._is_text)

    def _tell(self, data: bytes, is_text: bool) -> None:
        try:
            message = data.decode() if is_text else data
        except UnicodeDecodeError:
            self._core.fail(NO_TEXT, "a message is text in UTF-8")
            self._write()
        else:
            self._hearer.heard(message)

    def _write(self) -> None:
        transport = self.transport
        self._talks = self._is_open and self._core.state == _OPEN
        for data in self._core.data_to_send():
            if transport.is_closing():
                return
            if data:
                transport.write(data)
            else:
                transport.write_eof()
        if self._core.close_expected() and "close" not in self._timers:
            self._set_timer("close", CLOSE_WITHIN, self.abort)

    def _ping(self) -> None:
        """Let go of one of whom nothing came since it was pinged. While nothing is read from it that says nothing."""
        if self._silent and self.transport.is_reading():
            self.abort()
        elif self._talks:
            self._silent = True
            self._core.send_ping(b"")
            self._write()
            self._set_timer("ping", PING_EVERY, self._ping)

    def _set_timer(self, name: str, delay: float, call: Callable[[], object]) -> None:
        self._timers[name] = self._loop.call_later(delay, call)


class ServedConnection(Connection):
    """The end of whoever serves."""

    _core: ServerProtocol
    _hearer: TokenCheck
    _serves = True

    def __init__(self, hearer: TokenCheck, *, longest: int, read_at_once: int) -> None:
        server = check_installed()[0]
        core = server(origins=[None], max_size=longest, logger=_quiet())
        super().__init__(core, hearer, longest=longest, read_at_once=read_at_once)
        self.origin: int | str | None = None
        """Where the connection comes from: the number of a user, or an address of the network."""
        self._frames = 0
        self._counted_from = -inf
        """When it was begun to count frames."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        connected = transport.get_extra_info("socket")
        self.origin = origin_of(connected)
        super().connection_made(transport)
        delay = self._hearer.delay(self.origin, process_number(connected))
        if delay is None:
            self.abort()
        elif delay:
            self.pause()
            self._set_timer("delay", delay, self.resume)

    def _check_frame(self) -> None:
        """Close the connection of a client that sends so many of them that it would take the time of others."""
        now = self._loop.time()
        if now - self._counted_from >= 1.0:
            self._frames, self._counted_from = 0, now
        self._frames += 1
        if self._frames > MOST_FRAMES and self._talks:
            self._core.fail(POLICY, f"{MOST_FRAMES} pings and pieces of messages in a second at most")
            self._write()
            self.pause()  # what else it sends is not read: it has CLOSE_WITHIN to take this

    def _shake_hands(self, event: Request) -> None:
        refusal = self._hearer.refusal(event)
        answer = self._core.accept(event) if refusal is None else self._core.reject(*refusal)
        self._core.send_response(answer)
        self._write()
        if self._core.state == _OPEN:
            self._open()


class AskingConnection(Connection):
    """The end of whoever connects, and shows a token if he has one.

    `masks`: what it says passes where something between the two ends could take it for something else. In the kernel is
    nothing, and each end is spared the time of a mask.
    """

    _core: ClientProtocol
    _serves = False

    def __init__(
        self, hearer: Hearer, *, masks: bool, token: str | None = None, longest: int, read_at_once: int
    ) -> None:
        _, client, parse_uri = check_installed()
        core = client(parse_uri(_ANY_URI), max_size=longest, logger=_quiet())
        super().__init__(core, hearer, longest=longest, read_at_once=read_at_once)
        self._masks = masks
        self._key = new_key() if masks else NO_MASK
        self._token = token

    @property
    def status(self) -> int | None:
        """Return the HTTP status with which the other end did not let us in, None if it did, or said none."""
        response = getattr(self._core.handshake_exc, "response", None)
        return None if response is None else int(response.status_code)

    @property
    def refusal(self) -> str:
        """Return the words with which the other end did not let us in, "" if it said none."""
        body = getattr(getattr(self._core.handshake_exc, "response", None), "body", None)
        text = bytes(body or b"")[:LONGEST_REFUSAL].decode(errors="replace").strip()
        return text if text.isprintable() else ""

    @property
    def complaint(self) -> str | None:
        """Return why the other end cannot be spoken with, None as long as it can."""
        return None if self._core.handshake_exc is None else str(self._core.handshake_exc)

    @property
    def farewell(self) -> str:
        """Return why the other end let go of us, "" as long as it has not said so."""
        said = self._core.close_rcvd
        return "" if said is None else said.reason

    @property
    def owner_ended(self) -> bool:
        """Return whether the other end let go of us because it ends in good order."""
        said = self._core.close_rcvd
        return said is not None and said.code == GOING_AWAY

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        request = self._core.connect()
        if self._token is not None:
            request.headers["Authorization"] = f"Bearer {self._token}"
        self._core.send_request(request)
        self._write()

    def _shake_hands(self, event: Response) -> None:
        if self._core.state == _OPEN:
            self._open()


def process_number(connected: socket.socket | None) -> int:
    """Return the number of the process that has connected a Unix socket; 0 for a peer of the network."""
    if connected is None or connected.family != socket.AF_UNIX:
        return 0
    try:
        pid: int = CREDENTIALS.unpack(connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, CREDENTIALS.size))[0]
    except OSError:  # it has gone already
        return 0
    return pid


def origin_of(connected: socket.socket | None) -> int | str | None:
    """Return the number of the user that has connected a Unix socket, or the address of a peer of the network."""
    if connected is None:  # a transport without a socket
        return None
    try:
        if connected.family == socket.AF_UNIX:
            size = CREDENTIALS.size
            user: int = CREDENTIALS.unpack(connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, size))[1]
            return user
        return peer_of(str(connected.getpeername()[0]))
    except OSError:  # it has gone already
        return None


def check_installed() -> tuple[type[ServerProtocol], type[ClientProtocol], Callable[[str], Any]]:
    """Return what knows the bytes of either end. Raises InvalidCommand, with what to install, where it is missing."""
    try:
        from websockets.client import ClientProtocol
        from websockets.server import ServerProtocol
        from websockets.uri import parse_uri
    except ImportError:
        raise InvalidCommand("lines are shared by way of websockets: pip install 'busmaster[service]'") from None
    return ServerProtocol, ClientProtocol, parse_uri


def _quiet() -> logging.Logger:
    """Return a log for what the library says of connections that come and go: it is no news of the line's."""
    log = logging.getLogger("busmaster.app.service.connections")
    if not log.handlers:
        log.addHandler(logging.NullHandler())
        log.propagate = False
    return log
