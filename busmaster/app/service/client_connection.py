"""One connection of a program to the line's owner, from its first byte to its end, and the order of its messages."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from typing import TYPE_CHECKING, Protocol

from busmaster.app.bounds import HELLO_WITHIN, LONGEST_REQUEST, READ_AT_ONCE
from busmaster.app.service.client import Client
from busmaster.app.service.client_messages import ClientMessage
from busmaster.app.service.connection import GOING_AWAY, POLICY, IncomingConnection
from busmaster.app.service.messages import (
    INTERNAL,
    INVALID_PARAMS,
    Malformed,
    decode_client_message,
    encode_error_reply,
)
from busmaster.app.service.owner_messages import ErrorForm
from busmaster.app.service.peers import Peer

if TYPE_CHECKING:
    from websockets.http11 import Request


class MessageOrder:
    """The order of messages: one in a turn of the loop, from any program, so that the line can work in between. The
    first message of each program is taken before the second of any.
    """

    def __init__(self) -> None:
        self._waiting: deque[ClientConnection] = deque()
        self._taken = False
        """Whether a message was taken in this turn of the loop."""

    def ask(self, connection: ClientConnection) -> None:
        """Take a message of this program: at once, or when it is its turn."""
        if self._taken:
            self._waiting.append(connection)
            return
        self._taken = True
        try:
            connection.take()
        finally:  # after the message, which must not wait for this
            asyncio.get_running_loop().call_soon(self._next)

    def _next(self) -> None:
        self._taken = False
        if self._waiting:
            self.ask(self._waiting.popleft())


class Host(Protocol):
    """The server of a connection."""

    @property
    def message_order(self) -> MessageOrder: ...

    def delay(self, origin: int | str | None, process: int, /) -> float | None:
        """Return after how many seconds the connection is read; None if it is closed."""
        ...

    def refusal(self, connection: ClientConnection, request: Request, /) -> tuple[int, str] | None:
        """Store the peer; return the HTTP status and text of a refusal, None if it is admitted."""
        ...

    def admit(self, connection: ClientConnection, message: ClientMessage, /) -> Client:
        """Admit a program by its first message, and reply to that. Raises Malformed."""
        ...

    def count_rejected(self, connection: ClientConnection, /) -> None:
        """Count a connection that is closed because of an invalid or missing message."""
        ...

    def ended(self, connection: ClientConnection, /) -> None:
        """Handle the end of a connection."""
        ...


class ClientConnection:
    """One connection. Its program is unknown until its first message, which must arrive within HELLO_WITHIN."""

    def __init__(self, host: Host) -> None:
        self.client: Client | None = None
        self.peer: Peer
        """Set before the connection is opened."""
        self.websocket = IncomingConnection(self, longest=LONGEST_REQUEST, read_at_once=READ_AT_ONCE)
        self._host = host
        self._messages: deque[str | bytes] = deque()
        self._queued = False
        self._ended = False
        self._log = logging.getLogger("busmaster.app.service")
        self._hello_timer = asyncio.get_running_loop().call_later(HELLO_WITHIN, self._wait_no_longer)

    # called by the connection

    def delay(self, origin: int | str | None, process: int, /) -> float | None:
        """Return the result of its host."""
        return self._host.delay(origin, process)

    def refusal(self, request: Request, /) -> tuple[int, str] | None:
        """Return the result of its host."""
        return self._host.refusal(self, request)

    def opened(self) -> None:
        """Wait for the first message."""

    def received(self, message: str | bytes) -> None:
        """Take a message when it is its turn; until then nothing more is read."""
        if self._ended:
            return
        self._messages.append(message)
        self._go_on()
        if self._messages:
            self.websocket.pause()

    def writable(self) -> None:
        """Send waiting messages, and continue to read if that was paused."""
        if self.client is not None:
            self.client.outbox.flush()
        self._go_on()

    def lost(self) -> None:
        """Handle the loss of the connection."""
        self._finish()
        self._host.ended(self)

    # called by the host

    def take(self) -> None:
        """Take its oldest message, because it is its turn."""
        self._queued = False
        if self._ended:
            return
        try:
            message = decode_client_message(self._messages.popleft())
            if self.client is None:
                self.client = self._host.admit(self, message)
                self._hello_timer.cancel()
            else:
                self.client.take(message)
        except Malformed as error:
            self._reject(error)
        except Exception as bug:  # without this, the connection would stay paused for ever and keep its place
            self._log.exception("a message of %s could not be taken", self.peer)
            self._reject(Malformed(f"the program that owns the line failed: {type(bug).__name__}: {bug}", INTERNAL))
        else:
            self._go_on()

    def end(self) -> None:
        """Close the connection, because the line's owner ends, after all messages."""
        self._end(GOING_AWAY, "the program that owns the line ends")

    def cut(self, reason: str) -> None:
        """End the connection at once, because its program may not use the line any more. Nothing of it may go on while
        it does not read, so its agreement is not awaited."""
        self._end(POLICY, reason)
        self.websocket.abort()

    # inside

    def _go_on(self) -> None:
        """Schedule the next message, or read more, unless too many replies are unread."""
        if self._queued or self._ended:
            return
        # Messages for a client wait only behind a full connection, which is rare.
        if self.websocket.full and self.client is not None and self.client.outbox.crowded:
            self.websocket.pause()  # `writable` comes here again
        elif self._messages:
            self._queued = True
            self._host.message_order.ask(self)
        else:
            self.websocket.resume()

    def _wait_no_longer(self) -> None:
        self._reject(Malformed("no hello was received", INVALID_PARAMS))

    def _reject(self, error: Malformed) -> None:
        self._host.count_rejected(self)
        reply = encode_error_reply(None, ErrorForm(error.code, str(error)))
        if self.client is not None:
            self.client.outbox.put(reply)
        else:
            self.websocket.send(reply)
        self._end(POLICY, str(error)[:100])

    def _end(self, code: int, reason: str) -> None:
        self._finish()
        if self.client is not None:
            self.client.outbox.flush(last=True)
        self.websocket.close(code, reason)
        self.websocket.resume()  # the other end's agreement must be read

    def _finish(self) -> None:
        self._ended = True
        self._hello_timer.cancel()
        self._messages.clear()
