"""The client's end of a connection: requests and their replies, and notifications."""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from busmaster import BusClosed, BusError, LineDown, NoReply, NotStarted, WriteUnconfirmed
from busmaster.app.bounds import LONGEST_ANSWER
from busmaster.app.service.client_messages import CancelParams, HelloParams
from busmaster.app.service.connection import OutgoingConnection, check_installed
from busmaster.app.service.failures import START_OWNER, error_of
from busmaster.app.service.folder import socket_path
from busmaster.app.service.messages import (
    VERSIONS,
    decode_owner_message,
    decode_owner_notification,
    decode_result,
    encode_notification,
    encode_request,
)
from busmaster.app.service.owner_messages import HelloResult, OwnerMessage
from busmaster.app.service.typed import Struct, UnsetType
from busmaster.ext import Command, Requester, host_and_port

GRACE = 0.25
"""Seconds after `finish_within` in which the line's owner, which knows more, can send the result of a request."""
CONNECT_WITHIN = 10.0
ENDED = "the program that owns the line has ended"
READ_AT_ONCE = 1 << 16
TCP = "tcp://"
GONE = "the connection to the program that owns the line was lost"
NO_PLACE = "see busmaster status; if no place is free, stop a program that uses the line"
AGAIN = "check whether it is running, and connect again"


class PendingRequest:
    """One request in progress. `writes`: its error must state whether the write may have been sent."""

    __slots__ = ("command", "future", "handed", "method", "node", "number", "writes")

    def __init__(
        self,
        number: int,
        method: str,
        future: asyncio.Future[Any],
        writes: bool,
        node: Requester | None,
        command: Command[Any] | None,
        handed: bool = False,
    ) -> None:
        self.number = number
        self.method = method
        """The type of its result depends on it."""
        self.future = future
        self.writes = writes
        self.node = node
        self.command = command
        self.handed = handed
        """Whether it was passed to the connection. Otherwise it has certainly not been sent."""

    def fail(self, kind: type[BusError], what: str, hint: str | None = None) -> None:
        """End it with an error, unless it has already ended."""
        if not self.future.done():
            self.future.set_exception(kind(what, node=self.node, command=_text(self.command), hint=hint))

    def lost(self, kind: type[BusError], what: str, hint: str) -> None:
        """End it with an error, because no reply will arrive. `kind`: the error of a request that writes nothing."""
        if not self.writes:
            self.fail(kind, what, hint)
        elif self.handed:
            self.fail(WriteUnconfirmed, f"{what}; the write may have been sent")
        else:
            self.fail(NotStarted, what, hint)


def _text(command: Command[Any] | None) -> str | None:
    return None if command is None else str(command)


class Link:
    """One connection to the owner of a line. `on_notification` is called with each method and its parameters."""

    def __init__(
        self,
        address: str,
        token: str | None,
        on_notification: Callable[[str, Any], None],
        on_lost: Callable[[], None],
        *,
        safe_only: bool = False,
    ) -> None:
        self.address = address
        self._safe_only = safe_only
        self._token = token
        self._on_notification = on_notification
        self._on_lost = on_lost
        self._connection: OutgoingConnection | None = None
        self._waiting: deque[tuple[bytes, PendingRequest | None]] = deque()
        """Messages to send when the connection is ready, each with its request."""
        self._pending: dict[int, PendingRequest] = {}
        self._count = 0
        self._over: tuple[type[BusError], str, str] | None = None
        self._is_open = False

    async def open(self, program: str) -> HelloResult:
        """Connect, agree on a version, and return the owner's description of the line. Raises LineDown."""
        check_installed()
        # A thread, since the host of a serial server may have to be found.
        where, place = (
            await asyncio.to_thread(_where, self.address) if is_a_name(self.address) else _where(self.address)
        )
        loop = asyncio.get_running_loop()
        self._pending[0] = hello = PendingRequest(0, "hello", loop.create_future(), False, None, None)
        params = HelloParams(list(VERSIONS), program, self._safe_only)
        self._waiting.appendleft((encode_request("hello", 0, params), hello))
        try:
            async with asyncio.timeout(CONNECT_WITHIN):
                if place is None:
                    await loop.create_unix_connection(self._connect, where)
                else:
                    await loop.create_connection(self._connect, *place)
                about: HelloResult = await hello.future
        except BaseException as error:
            hello.future.cancel()  # its result is not awaited any more
            shut = self._shut(where, error)
            await self.close()
            if shut is not None:
                raise shut from error
            raise
        return about

    async def close(self) -> None:
        """Close the connection. Requests in progress end with BusClosed."""
        self._end(BusClosed, "the bus was closed", "make a new one: it is opened and closed once")
        if self._connection is not None:
            self._connection.close()
            await self._connection.closed()

    def notify(self, method: str, params: Struct) -> None:
        """Send a notification, which has no reply. Does nothing if the connection is lost."""
        if self._over is None:
            message = encode_notification(method, params)
            if not self._passes(message):
                self._waiting.append((message, None))

    def ask(
        self,
        method: str,
        params: Struct,
        *,
        writes: bool = False,
        node: Requester | None = None,
        command: Command[Any] | None = None,
    ) -> PendingRequest:
        """Send a request after all earlier messages. Its future gets the result. Raises LineDown or BusClosed."""
        if self._over is not None:
            self.check(node, command)
        self._count = number = self._count + 1
        message = encode_request(method, number, params)
        handed = self._passes(message)  # first: the other end begins while this end creates the objects for it
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
        pending = PendingRequest(number, method, future, writes, node, command, handed)
        self._pending[number] = pending
        if not handed:
            self._waiting.append((message, pending))
        return pending

    def check(self, node: Requester | None = None, command: Command[Any] | None = None) -> None:
        """Raise LineDown or BusClosed with the reason if the connection is over."""
        if self._over is not None:
            kind, what, hint = self._over
            raise kind(what, node=node, command=_text(command), hint=hint)

    async def answer(self, pending: PendingRequest, finish_within: float | None = None) -> Any:
        """Wait for a reply. A cancellation also cancels the request at the line."""
        timer = None
        if finish_within is not None:
            loop = asyncio.get_running_loop()
            timer = loop.call_later(finish_within + GRACE, self._overdue, pending)
        try:
            return await pending.future
        except asyncio.CancelledError:
            self._drop(pending)
            raise
        finally:
            if timer is not None:
                timer.cancel()

    # called by the connection

    def _connect(self) -> OutgoingConnection:
        is_tcp = self.address.startswith(TCP)
        self._connection = OutgoingConnection(
            self, masks=is_tcp, token=self._token, longest=LONGEST_ANSWER, read_at_once=READ_AT_ONCE
        )
        return self._connection

    def opened(self) -> None:
        """Send the waiting messages, `hello` first."""
        self._is_open = True
        self.writable()

    def received(self, message: str | bytes) -> None:
        """Pass a reply to its request, and a notification to `on_notification`."""
        try:
            self._take(decode_owner_message(message))
        except Exception as error:  # invalid messages of any kind
            what = f"the program that owns the line sent an invalid message: {type(error).__name__}: {error}"
            self._end(LineDown, what, AGAIN)
            assert self._connection is not None
            self._connection.close()

    def writable(self) -> None:
        """Send the waiting messages until the connection is full."""
        connection = self._connection
        assert connection is not None
        while self._waiting and self._is_open and not connection.full:
            message, pending = self._waiting.popleft()
            if pending is not None:
                if pending.future.done():
                    continue  # cancelled before it was sent
                pending.handed = True
            connection.send(message)

    def lost(self) -> None:
        """End all requests, because the connection is over."""
        if self._connection is not None and self._connection.owner_ended:
            self._end(LineDown, ENDED, START_OWNER)
        self._end(LineDown, GONE, AGAIN)

    # inside

    def _shut(self, where: str, error: BaseException) -> LineDown | None:
        """Return why the owner did not admit this program, None if the error has another cause."""
        connection = self._connection
        status = None if connection is None else connection.status
        close_reason = "" if connection is None else connection.close_reason
        complaint = None if connection is None else connection.complaint
        if status == HTTPStatus.UNAUTHORIZED:
            what = f"{where} {'requires a token' if self._token is None else 'does not accept this token'}"
            return LineDown(what, hint="use a token from the token_file in [service] of its LINE.toml")
        if status == HTTPStatus.SERVICE_UNAVAILABLE:
            what = f"{where} does not admit this program: {connection.refusal if connection else ''}"
            return LineDown(what, hint=NO_PLACE)
        if status == HTTPStatus.TOO_MANY_REQUESTS and connection is not None:
            return LineDown(
                f"{where} does not check this token: {connection.refusal}", hint="correct the token, and wait"
            )
        if close_reason:
            return LineDown(f"{where} does not admit this program: {close_reason}", hint=NO_PLACE)
        if connection is not None and isinstance(error, TimeoutError):
            what = f"the program that serves {where} did not reply within {CONNECT_WITHIN:g} s"
            return LineDown(what, hint="if it hangs, stop it, because it keeps the line for itself")
        if complaint is None and isinstance(error, OSError) and not isinstance(error, BusError):
            complaint = os.strerror(error.errno) if error.errno else str(error) or "no reply"
        if complaint is None:
            return None
        return LineDown(f"no program serves {where}: {complaint}", hint="start busmaster run, or see busmaster status")

    def _passes(self, message: bytes) -> bool:
        """Send it at once if nothing waits before it; return whether it was sent."""
        connection = self._connection
        if self._waiting or not self._is_open or connection is None or connection.full:
            return False
        connection.send(message)
        return True

    def _drop(self, pending: PendingRequest) -> None:
        """Stop waiting for a request, and cancel it at the line."""
        if self._pending.pop(pending.number, None) is not None and pending.handed:
            self.notify("cancel", CancelParams(pending.number))

    def _overdue(self, pending: PendingRequest) -> None:
        what = "the time of the request is over, and the program that owns the line did not reply"
        pending.lost(NoReply, what, "check whether that program is running")
        self._drop(pending)

    def _end(self, kind: type[BusError], what: str, hint: str) -> None:
        if self._over is None:
            self._over = kind, what, hint
            for pending in self._pending.values():
                pending.lost(kind, what, hint)
            self._pending.clear()
            self._waiting.clear()
            self._on_lost()

    def _take(self, message: OwnerMessage) -> None:
        if not isinstance(message.method, UnsetType):
            params = decode_owner_notification(message.method, message.params)
            if params is not None:  # one of a later version is ignored
                self._on_notification(message.method, params)
            return
        pending = None if message.id is None else self._pending.get(message.id)
        if pending is None:
            return
        # Decoded first: if that fails, the request is still registered, and ends with the connection.
        error = None if isinstance(message.error, UnsetType) else error_of(message.error)
        result = None if isinstance(message.result, UnsetType) else decode_result(pending.method, message.result)
        del self._pending[pending.number]
        if pending.future.done():
            return
        if error is not None:
            pending.future.set_exception(error)
        else:
            pending.future.set_result(result)


def is_a_name(address: str) -> bool:
    """Return whether an address is the name of a line or of a port, and not itself a place."""
    return not address.startswith((TCP, "unix:"))


def _where(address: str) -> tuple[str, tuple[str, int] | None]:
    """Return where that is for messages, and host and port, None of a Unix socket. Raises InvalidCommand."""
    if not address.startswith(TCP):
        return socket_path(address), None
    text = address.removeprefix(TCP).rstrip("/")
    return text, host_and_port(text)
