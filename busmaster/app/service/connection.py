"""One end of a WebSocket, without a task: messages are sent and delivered in the same turn of the loop. The library
encodes and decodes the bytes. This module adds the transport, the timers and the end of a connection.
"""

from __future__ import annotations

import asyncio
import logging
import os
import socket
from collections.abc import Callable
from math import inf
from typing import TYPE_CHECKING, Any, Protocol, cast

from busmaster import InvalidCommand
from busmaster.app.bounds import MOST_FRAMES, SEND_WITHIN
from busmaster.app.service.peers import CREDENTIALS
from busmaster.app.service.refusals import peer_of

if TYPE_CHECKING:
    from websockets.client import ClientProtocol
    from websockets.frames import Frame
    from websockets.http11 import Request, Response
    from websockets.server import ServerProtocol

PING_EVERY = 20.0
"""Seconds between two pings. A peer that sends nothing between two of them is disconnected."""
LONGEST_REFUSAL = 300
"""Bytes of the words of a refusal that are shown."""
CLOSE_WITHIN = 1.0
"""Seconds for the other end to receive the last message."""
NORMAL, GOING_AWAY, NO_TEXT, POLICY = 1000, 1001, 1007, 1008

END_OF_HEAD = b"\r\n\r\n"
LONGEST_HEAD = 14
"""Bytes of a frame before its message."""
_BINARY, _CONTROL, _OPEN = 2, 8, 1  # numbers of the WebSocket's standard, and of the library's states
_ANY_URI = "ws://busmaster/"

TEXT = 0x81
"""The first byte of a message of text in one piece."""
MASKED = 0x80
SHORT, LONG = 126, 127
NO_MASK = bytes(4)
"""The key of a mask that changes nothing."""


# Frames that are whole texts, as nearly all are, are read and written here; the library handles all others. With the
# library alone, a remote read on an idle line takes 3 to 4 % longer: `python -m benchmarks service` measures this with
# the table "A remote read on an idle line".


def look_at(data: bytearray, masked: bool) -> tuple[int, bytes | None]:
    """Return the size of the frame at the start, or the number of bytes needed to know it, and the text of the frame.
    The text is None unless it is complete, a whole text, and masked as required.
    """
    come = len(data)
    if come < 2:
        return 2, None
    length, begin = data[1], 2
    if is_masked := length >= MASKED:
        length -= MASKED
    if length >= SHORT:
        begin = 4 if length == SHORT else 10
        if come < begin:
            return begin, None
        length = data[2] << 8 | data[3] if length == SHORT else int.from_bytes(data[2:begin], "big")
    text = begin + 4 if is_masked else begin
    size = text + length
    if come < size or data[0] != TEXT or is_masked is not masked:
        return size, None
    payload, key = bytes(data[text:size]), data[begin:text]
    return size, mask(payload, key) if masked and key != NO_MASK else payload


def text_frame(data: bytes, key: bytes) -> bytes:
    """Return the frame of a text: with a mask, if there is a key for one."""
    length, flag = len(data), MASKED if key else 0
    if length < SHORT:
        head = bytes((TEXT, flag | length))
    elif length < 1 << 16:
        head = bytes((TEXT, flag | SHORT, length >> 8, length & 0xFF))
    else:
        head = bytes((TEXT, flag | LONG)) + length.to_bytes(8, "big")
    return head + key + (mask(data, key) if key and key != NO_MASK else data)


def new_key() -> bytes:
    """Return a key for the mask of one frame."""
    return os.urandom(4)


def mask(data: bytes, key: bytes | bytearray) -> bytes:
    """Return data with a mask put on, or taken off."""
    length = len(data)
    keys = (key * (length // 4 + 1))[:length]
    return (int.from_bytes(data, "little") ^ int.from_bytes(keys, "little")).to_bytes(length, "little")


class MessageHandler(Protocol):
    """Receives the messages of a connection. Its methods must not raise, because the connection would be lost."""

    def opened(self) -> None:
        """Handle the opening: from now on messages can be sent, and will arrive."""
        ...

    def received(self, message: str | bytes) -> None:
        """Handle a message. Bytes are not JSON-RPC."""
        ...

    def writable(self) -> None:
        """Handle that the connection is not full any more."""
        ...

    def lost(self) -> None:
        """Handle the end of the connection, for any reason. It is the last call."""
        ...


class TokenCheck(MessageHandler, Protocol):
    """Receives the messages of a serving connection, and decides whether it is admitted."""

    def delay(self, origin: int | str | None, process: int, /) -> float | None:
        """Return after how many seconds a connection that was made is read; None if it is closed."""
        ...

    def refusal(self, request: Request, /) -> tuple[int, str] | None:
        """Return the HTTP status and words with which a request to connect is refused; None if it is not."""
        ...


class Connection(asyncio.BufferedProtocol):
    """One end of a connection, for an event loop. `handler` receives the messages, at most `read_at_once` bytes in a
    turn; a message of more than `longest` bytes ends the connection."""

    _serves: bool

    def __init__(
        self, core: ServerProtocol | ClientProtocol, handler: MessageHandler, *, longest: int, read_at_once: int
    ) -> None:
        self.full = False
        """Whether earlier messages are still unsent. Later ones wait behind them in memory."""
        self._core = core
        self._handler = handler
        self._buffer = memoryview(bytearray(read_at_once))
        self._transport: asyncio.Transport | None = None
        self._loop: asyncio.AbstractEventLoop
        self._is_open = False
        self._talks = False
        """Whether messages are exchanged: the connection is open, and its end is not announced yet."""
        self._rest = bytearray()
        """The beginning of an incomplete frame."""
        self._longest = longest + LONGEST_HEAD
        self._key = b""
        """Key for the mask of the next message; empty for an owner."""
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
        """Return the transport, once it exists."""
        assert self._transport is not None
        return self._transport

    def send(self, message: bytes) -> None:
        """Send a message, unless the connection is ending."""
        transport = self._transport
        if self._talks and transport is not None and not transport.is_closing():
            transport.write(text_frame(message, self._key))
            if self._masks:
                self._key = new_key()  # in advance, so that the next message does not wait for it

    def close(self, code: int = NORMAL, reason: str = "") -> None:
        """Announce the end, after all messages. The other end has CLOSE_WITHIN to agree."""
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
                self._notify(text, True)

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
        self._handler.writable()

    def connection_lost(self, cause: Exception | None) -> None:
        for timer in self._timers.values():
            timer.cancel()
        self._core.receive_eof()
        self._is_open = self._talks = False
        self._over.set()
        self._handler.lost()

    # inside

    def _shake_hands(self, event: Any) -> None:
        raise NotImplementedError

    def _open(self) -> None:
        self._is_open = self._talks = True
        self._set_timer("ping", PING_EVERY, self._ping)
        self._handler.opened()

    def _cut(self, size: int) -> bytes:
        part = bytes(self._rest[:size])
        del self._rest[:size]
        return part

    def _check_frame(self) -> None:
        """Look at a frame that is not a whole message."""

    def _feed(self, data: bytes) -> None:
        """Let the library handle everything except whole texts."""
        self._core.receive_data(data)
        self._write()
        for event in self._core.events_received():
            if self._is_open:
                self._receive(cast("Frame", event))
            else:
                self._shake_hands(event)

    def _receive(self, frame: Frame) -> None:
        self._check_frame()
        if frame.opcode >= _CONTROL:
            return
        if frame.opcode:
            self._is_text, self._part = frame.opcode != _BINARY, bytearray()
        assert self._part is not None  # the library lets nothing else pass
        self._part += frame.data
        if frame.fin:
            data, self._part = bytes(self._part), None
            self._notify(data, self._is_text)

    def _notify(self, data: bytes, is_text: bool) -> None:
        try:
            message = data.decode() if is_text else data
        except UnicodeDecodeError:
            self._core.fail(NO_TEXT, "a message is text in UTF-8")
            self._write()
        else:
            self._handler.received(message)

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
        """Disconnect a peer that has sent nothing since the last ping, unless reading is paused."""
        if self._silent and self.transport.is_reading():
            self.abort()
        elif self._talks:
            self._silent = True
            self._core.send_ping(b"")
            self._write()
            self._set_timer("ping", PING_EVERY, self._ping)

    def _set_timer(self, name: str, delay: float, call: Callable[[], object]) -> None:
        self._timers[name] = self._loop.call_later(delay, call)


class IncomingConnection(Connection):
    """The server's end."""

    _core: ServerProtocol
    _handler: TokenCheck
    _serves = True

    def __init__(self, handler: TokenCheck, *, longest: int, read_at_once: int) -> None:
        server = check_installed()[0]
        core = server(origins=[None], max_size=longest, logger=_quiet())
        super().__init__(core, handler, longest=longest, read_at_once=read_at_once)
        self.origin: int | str | None = None
        """Where the connection comes from: the number of a user, or an address of the network."""
        self._frames = 0
        self._counted_from = -inf
        """When it was begun to count frames."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        connected = transport.get_extra_info("socket")
        self.origin = origin_of(connected)
        super().connection_made(transport)
        delay = self._handler.delay(self.origin, process_number(connected))
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
            self._core.fail(POLICY, f"more than {MOST_FRAMES} pings and pieces of messages in a second")
            self._write()
            self.pause()  # its further data is not read: it has CLOSE_WITHIN to receive this

    def _shake_hands(self, event: Request) -> None:
        refusal = self._handler.refusal(event)
        answer = self._core.accept(event) if refusal is None else self._core.reject(*refusal)
        self._core.send_response(answer)
        self._write()
        if self._core.state == _OPEN:
            self._open()


class OutgoingConnection(Connection):
    """The client's end, with a token if there is one.

    `masks`: whether messages are masked, as required where a proxy between the two ends could misinterpret them. There
    is no proxy on a Unix socket, and both ends save the time.
    """

    _core: ClientProtocol
    _serves = False

    def __init__(
        self, handler: MessageHandler, *, masks: bool, token: str | None = None, longest: int, read_at_once: int
    ) -> None:
        _, client, parse_uri = check_installed()
        core = client(parse_uri(_ANY_URI), max_size=longest, logger=_quiet())
        super().__init__(core, handler, longest=longest, read_at_once=read_at_once)
        self._masks = masks
        self._key = new_key() if masks else NO_MASK
        self._token = token

    @property
    def status(self) -> int | None:
        """Return the HTTP status of a refusal, None if there was none."""
        response = getattr(self._core.handshake_exc, "response", None)
        return None if response is None else int(response.status_code)

    @property
    def refusal(self) -> str:
        """Return the text of a refusal, "" if there was none."""
        body = getattr(getattr(self._core.handshake_exc, "response", None), "body", None)
        text = bytes(body or b"")[:LONGEST_REFUSAL].decode(errors="replace").strip()
        return text if text.isprintable() else ""

    @property
    def complaint(self) -> str | None:
        """Return why communication with the other end failed, None if it did not."""
        return None if self._core.handshake_exc is None else str(self._core.handshake_exc)

    @property
    def close_reason(self) -> str:
        """Return the reason with which the other end closed the connection, "" if it has not."""
        frame = self._core.close_rcvd
        return "" if frame is None else frame.reason

    @property
    def owner_ended(self) -> bool:
        """Return whether the other end closed the connection because it ends in an orderly way."""
        frame = self._core.close_rcvd
        return frame is not None and frame.code == GOING_AWAY

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
    """Return the protocol classes of the library. Raises InvalidCommand with the missing package."""
    try:
        import msgspec  # noqa: F401  typed.py has placeholders without it
        from websockets.client import ClientProtocol
        from websockets.server import ServerProtocol
        from websockets.uri import parse_uri
    except ImportError as missing:
        name = (missing.name or "websockets").partition(".")[0]
        raise InvalidCommand(f"sharing a line needs {name}; pip install 'busmaster[service]'") from None
    return ServerProtocol, ClientProtocol, parse_uri


def _quiet() -> logging.Logger:
    """Return a log for the library's messages about connections, which are not of interest to the user."""
    log = logging.getLogger("busmaster.app.service.connections")
    if not log.handlers:
        log.addHandler(logging.NullHandler())
        log.propagate = False
    return log
