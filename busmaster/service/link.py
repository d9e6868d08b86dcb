"""The client's end of a connection: questions and their answers, and what comes unasked."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

from busmaster.contract.arguments import host_and_port
from busmaster.errors import (
    Addressed,
    BusClosed,
    BusError,
    InvalidCommand,
    LineDown,
    NoReply,
    NotStarted,
    WriteUnconfirmed,
)
from busmaster.service.failures import error_of
from busmaster.service.folder import socket_path
from busmaster.service.messages import LONGEST_MESSAGE, VERSIONS, Malformed, read, written

if TYPE_CHECKING:
    from websockets.asyncio.client import ClientConnection

GRACE = 0.25
"""Seconds beyond `finish_within` in which the line's owner, who knows more, may say what became of a request."""
CONNECT_WITHIN = 10.0
TCP = "tcp://"
GONE = "the connection to the program that owns the line was lost"
AGAIN = "see whether it runs, and connect again"


class Asked:
    """One question on its way. `writes`: of what it asks for, it must be said whether it may have been sent."""

    __slots__ = ("command", "future", "handed", "node", "number", "writes")

    def __init__(
        self, number: int, future: asyncio.Future[Any], writes: bool, node: Addressed | None, command: str | None
    ) -> None:
        self.number = number
        self.future = future
        self.writes = writes
        self.node = node
        self.command = command
        self.handed = False
        """Whether it was handed to the connection: what was not has certainly not been sent."""

    def fail(self, kind: type[BusError], what: str, hint: str | None = None) -> None:
        """End it with an error, unless it has ended."""
        if not self.future.done():
            self.future.set_exception(kind(what, node=self.node, command=self.command, hint=hint))

    def lost(self, kind: type[BusError], what: str, hint: str) -> None:
        """End it truthfully, as no answer will come: `kind` is for what changes nothing."""
        if not self.writes:
            self.fail(kind, what, hint)
        elif self.handed:
            self.fail(WriteUnconfirmed, f"{what}, and the write may have been sent")
        else:
            self.fail(NotStarted, what, hint)


class Link:
    """One connection to the owner of a line. `on_news` is told, in its order, what comes unasked."""

    def __init__(
        self,
        address: str,
        token: str | None,
        on_news: Callable[[str, Mapping[str, Any]], None],
        on_lost: Callable[[], None],
    ) -> None:
        self.address = address
        self._token = token
        self._on_news = on_news
        self._on_lost = on_lost
        self._connection: ClientConnection | None = None
        self._waiting: deque[tuple[str, Asked | None]] = deque()
        self._something = asyncio.Event()
        self._asked: dict[int, Asked] = {}
        self._count = 0
        self._over: tuple[type[BusError], str, str] | None = None
        self._tasks: list[asyncio.Task[None]] = []

    async def open(self, program: str) -> dict[str, Any]:
        """Connect, agree on a version, and return what the owner says of the line. Raises LineDown."""
        connect, refused, _ = _websockets()
        where, place = _where(self.address)
        headers = None if self._token is None else {"Authorization": f"Bearer {self._token}"}
        try:
            connection = await connect(
                "ws://busmaster/",
                **place,
                additional_headers=headers,
                compression=None,
                max_size=LONGEST_MESSAGE,
                open_timeout=CONNECT_WITHIN,
                close_timeout=1.0,
                user_agent_header=None,
                proxy=None,
            )
        except (OSError, TimeoutError, refused) as error:
            raise _unreachable(where, error, shown=self._token is not None) from error
        self._connection = connection
        hello = Asked(0, asyncio.get_running_loop().create_future(), False, None, None)
        self._asked[0] = hello
        try:
            text = written({"id": 0, "method": "hello", "params": {"versions": list(VERSIONS), "program": program}})
            await connection.send(text)
            self._tasks = [asyncio.ensure_future(self._receive()), asyncio.ensure_future(self._send())]
            said: dict[str, Any] = await hello.future
        except BaseException:
            await self.close()
            raise
        return said

    async def close(self) -> None:
        """Let go: whoever still waits is told so."""
        self._end(BusClosed, "the bus was closed", "make a new one: it is opened and closed once")
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if self._connection is not None:
            # Where it was lost while something was sent, the library aborts a transport that asyncio has let go of.
            with contextlib.suppress(AttributeError):
                await self._connection.close()

    def tell(self, method: str, params: Mapping[str, Any]) -> None:
        """Say something that is not answered; nothing once the connection is lost."""
        if self._over is None:
            self._put(written({"method": method, "params": params}), None)

    def ask(
        self,
        method: str,
        params: Mapping[str, Any],
        *,
        writes: bool = False,
        node: Addressed | None = None,
        command: str | None = None,
    ) -> Asked:
        """Ask something, after all that was said before; its future has the answer. Raises LineDown or BusClosed."""
        if self._over is not None:
            kind, what, hint = self._over
            raise kind(what, node=node, command=command, hint=hint)
        self._count += 1
        asked = Asked(self._count, asyncio.get_running_loop().create_future(), writes, node, command)
        self._asked[asked.number] = asked
        self._put(written({"id": asked.number, "method": method, "params": params}), asked)
        return asked

    async def answer(self, asked: Asked, finish_within: float | None = None) -> Any:
        """Wait for an answer. Cancelling it cancels the request at the line too."""
        timer = None
        if finish_within is not None:
            loop = asyncio.get_running_loop()
            timer = loop.call_later(finish_within + GRACE, self._overdue, asked)
        try:
            return await asked.future
        except asyncio.CancelledError:
            self._drop(asked)
            raise
        finally:
            if timer is not None:
                timer.cancel()

    # inside

    def _put(self, text: str, asked: Asked | None) -> None:
        self._waiting.append((text, asked))
        self._something.set()

    def _drop(self, asked: Asked) -> None:
        """Wait for it no longer, and have it cancelled there."""
        if self._asked.pop(asked.number, None) is not None and asked.handed:
            self.tell("cancel", {"id": asked.number})

    def _overdue(self, asked: Asked) -> None:
        what = "its time was over, and the program that owns the line says nothing"
        asked.lost(NoReply, what, "see whether that program runs")
        self._drop(asked)

    def _end(self, kind: type[BusError], what: str, hint: str) -> None:
        if self._over is None:
            self._over = kind, what, hint
            for asked in self._asked.values():
                asked.lost(kind, what, hint)
            self._asked.clear()
            self._waiting.clear()
            self._on_lost()

    async def _send(self) -> None:
        assert self._connection is not None
        _, _, closed = _websockets()
        with contextlib.suppress(closed):  # `_receive` hears of that too
            while True:
                while self._waiting:
                    text, asked = self._waiting.popleft()
                    if asked is not None:
                        if asked.future.done():
                            continue  # nobody waits for it any more: it is not even said
                        asked.handed = True
                    await self._connection.send(text)
                self._something.clear()
                await self._something.wait()

    async def _receive(self) -> None:
        assert self._connection is not None
        _, _, closed = _websockets()
        why = GONE
        try:
            async for text in self._connection:
                self._take(read(text))
        except closed:
            pass
        except (Malformed, KeyError, TypeError, ValueError, AttributeError, InvalidCommand) as error:
            why = f"the program that owns the line said what is not understood: {error}"
        self._end(LineDown, why, AGAIN)

    def _take(self, said: Mapping[str, Any]) -> None:
        if "method" in said:
            self._on_news(said["method"], said["params"])
            return
        asked = self._asked.pop(said["id"], None) if said.get("id") is not None else None
        if asked is None or asked.future.done():
            return
        if "error" in said:
            asked.future.set_exception(error_of(said["error"]))
        else:
            asked.future.set_result(said.get("result"))


def _where(address: str) -> tuple[str, dict[str, Any]]:
    """Return where that is for messages, and for the library. Raises InvalidCommand."""
    if address.startswith(TCP):
        text = address.removeprefix(TCP).rstrip("/")
        host, port = host_and_port(text)
        return text, {"host": host, "port": port}
    path = socket_path(address)
    return path, {"path": path, "unix": True}


def _unreachable(where: str, error: Exception, *, shown: bool) -> LineDown:
    response = getattr(error, "response", None)
    match None if response is None else response.status_code:
        case 401:
            what = "does not know this token" if shown else "wants a token"
            return LineDown(f"{where} {what}", hint="its owner has the tokens in a file, see [service] of LINE.toml")
        case 503:
            return LineDown(f"{where} has too many programs already", hint="end one, see busmaster status")
    if isinstance(error, TimeoutError):
        what = f"the program that serves {where} did not answer in {CONNECT_WITHIN:g} s"
        return LineDown(what, hint="if it stands still, end it: the line is its own as long as it is there")
    why = getattr(error, "strerror", None) or str(error) or "it does not answer"
    return LineDown(f"no program serves {where}: {why}", hint="start busmaster run, or see busmaster status")


def _websockets() -> tuple[Any, type[Exception], type[Exception]]:
    """Return what connects, and what it raises when that fails, and when the connection is over.

    Raises InvalidCommand, with what to install, where it is missing.
    """
    try:
        from websockets.asyncio.client import connect
        from websockets.exceptions import ConnectionClosed, WebSocketException
    except ImportError:
        raise InvalidCommand("a line of another program needs websockets: pip install 'busmaster[service]'") from None
    return connect, WebSocketException, ConnectionClosed
