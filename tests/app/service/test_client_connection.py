"""The order and the end of the messages of one connection, without a socket."""

from __future__ import annotations

import asyncio
import json
import logging
from typing import Any

import pytest

from busmaster.app.bounds import HELLO_WITHIN
from busmaster.app.service.client_connection import ClientConnection, MessageOrder
from busmaster.app.service.connection import GOING_AWAY, POLICY
from busmaster.app.service.messages import INTERNAL, INVALID_PARAMS, INVALID_REQUEST, Malformed
from busmaster.app.service.outbox import Outbox
from tests.stories import in_virtual_time


def message(number: int) -> str:
    return json.dumps({"jsonrpc": "2.0", "id": number, "method": "now"})


class Way:
    """A websocket that records the calls of its owner."""

    def __init__(self) -> None:
        self.full = False
        self.paused = False
        self.sent: list[Any] = []
        self.closed: list[tuple[int, str]] = []

    def send(self, encoded: bytes) -> None:
        self.sent.append(json.loads(encoded))

    def pause(self) -> None:
        self.paused = True

    def resume(self) -> None:
        self.paused = False

    def close(self, code: int, reason: str) -> None:
        self.closed.append((code, reason))


class Program:
    """A client that keeps the numbers of its messages; one with a negative number is malformed, 0 a bug."""

    def __init__(self, way: Way) -> None:
        self.outbox = Outbox(way, lambda _: None)
        self.taken: list[int] = []

    def take(self, message: Any) -> None:
        if message.id < 0:
            raise Malformed("x" * 200)
        if not message.id:
            raise ZeroDivisionError("a bug")
        self.taken.append(message.id)


class Host:
    """A server that admits everyone."""

    def __init__(self) -> None:
        self.message_order = MessageOrder()
        self.rejected = 0
        self.ends = 0

    def delay(self, origin: object, process: int) -> float | None:
        return 0.25

    def refusal(self, connection: ClientConnection, request: Any) -> tuple[int, str] | None:
        return 503, "full"

    def admit(self, connection: ClientConnection, message: Any) -> Any:
        if message.id < 0:
            raise Malformed("not admitted", INVALID_PARAMS)
        return Program(connection.websocket)  # type: ignore[arg-type]  # a way

    def count_rejected(self, connection: ClientConnection) -> None:
        self.rejected += 1

    def ended(self, connection: ClientConnection) -> None:
        self.ends += 1


class Opened:
    """A connection whose program is admitted, unless `hello` is False."""

    def __init__(self, host: Host, *, hello: bool = True) -> None:
        self.host = host
        self.connection = ClientConnection(host)
        self.connection.peer = "user me"  # type: ignore[assignment]  # for the log
        self.way = Way()
        self.connection.websocket = self.way  # type: ignore[assignment]  # as much of one as a connection uses
        if hello:
            self.connection.received(message(1))

    @property
    def program(self) -> Any:
        return self.connection.client


async def opened(host: Host) -> Opened:
    found = Opened(host)
    await asyncio.sleep(0)  # the next message is taken in another turn
    return found


@in_virtual_time
async def test_a_program_is_not_read_while_its_message_waits_for_its_turn() -> None:
    host = Host()
    one, two = await opened(host), await opened(host)
    one.connection.received(message(2))
    two.connection.received(message(2))
    assert (one.program.taken, one.way.paused) == ([2], False)
    assert (two.program.taken, two.way.paused) == ([], True)
    two.connection.received(message(3))  # it was read before
    await asyncio.sleep(0)
    assert two.program.taken == [2]
    for _ in range(3):
        await asyncio.sleep(0)
    assert (two.program.taken, two.way.paused) == ([2, 3], False)


@in_virtual_time
async def test_a_program_that_does_not_read_its_replies_is_not_read_until_it_does() -> None:
    one = await opened(Host())
    one.way.full = True
    one.connection.received(message(2))
    assert one.program.taken == [2]  # few replies wait
    for number in range(5000):
        one.program.outbox.put(b"%d" % number)
    assert one.program.outbox.crowded
    await asyncio.sleep(0)
    one.connection.received(message(3))
    await asyncio.sleep(0)
    assert (one.program.taken, one.way.paused) == ([2], True)
    one.way.full = False
    one.connection.writable()
    assert one.way.sent[-1] == 4999
    assert (one.program.taken, one.way.paused) == ([2, 3], False)


@in_virtual_time
async def test_a_connection_without_a_first_message_is_closed_after_a_time() -> None:
    host = Host()
    silent, prompt = Opened(host, hello=False), await opened(host)
    gone = Opened(host, hello=False)
    gone.connection.lost()
    silent.connection.writable()
    await asyncio.sleep(HELLO_WITHIN - 0.1)
    assert silent.way.closed == []
    await asyncio.sleep(0.2)
    assert silent.way.closed == [(POLICY, "no hello was received")]
    assert [one["error"]["code"] for one in silent.way.sent] == [INVALID_PARAMS]
    assert (prompt.way.closed, gone.way.closed, gone.way.sent) == ([], [], [])
    assert (host.rejected, host.ends) == (1, 1)
    assert silent.connection.delay(None, 1) == 0.25
    assert silent.connection.refusal(None) == (503, "full")  # type: ignore[arg-type]  # not looked at


@in_virtual_time
async def test_an_invalid_message_ends_a_connection_after_all_replies(caplog: pytest.LogCaptureFixture) -> None:
    host = Host()
    caplog.set_level(logging.ERROR, "busmaster.app.service")
    for number, code, reason in (
        (-1, INVALID_REQUEST, "x" * 100),
        (0, INTERNAL, "the program that owns the line failed: ZeroDivisionError: a bug"),
    ):
        one = await opened(host)
        one.way.full = True
        one.program.outbox.put(b"7")
        one.connection.received(message(number))
        one.connection.received(message(5))
        assert one.way.closed == [(POLICY, reason)]
        reply, error = one.way.sent
        assert (reply, error["error"]["code"]) == (7, code)
        assert not one.way.paused
        await asyncio.sleep(0)
        one.connection.received(message(6))
        assert one.program.taken == []
        one.connection.lost()
    assert (host.rejected, host.ends) == (2, 2)
    assert [record.message for record in caplog.records] == ["a message of user me could not be taken"]
    stranger = Opened(host, hello=False)
    stranger.connection.received(message(-1))
    assert stranger.way.closed == [(POLICY, "not admitted")]
    assert [one["error"]["code"] for one in stranger.way.sent] == [INVALID_PARAMS]


@in_virtual_time
async def test_a_message_that_waits_is_not_taken_after_the_end() -> None:
    host = Host()
    for end in ("end", "lost"):
        one, two = await opened(host), await opened(host)
        one.connection.received(message(2))
        two.connection.received(message(2))
        two.way.full = True
        two.program.outbox.put(b"7")
        getattr(two.connection, end)()
        for _ in range(3):
            await asyncio.sleep(0)
        assert two.program.taken == []
        if end == "end":
            assert two.way.closed == [(GOING_AWAY, "the program that owns the line ends")]
            assert (two.way.sent, two.way.paused) == ([7], False)
        one.connection.received(message(3))
        assert one.program.taken == [2, 3]  # the order of messages goes on
        await asyncio.sleep(0)


def test_messages_leave_an_outbox_in_their_order() -> None:
    way = Way()
    outbox = Outbox(way, lambda _: None)
    way.full = True
    outbox.put(b"1")
    way.full = False  # `flush` follows
    outbox.put_latest("a", b"2")
    outbox.put_droppable(7, b"3")
    outbox.put(b"4")
    outbox.put_latest("b", b"5")
    outbox.put_latest("a", b"6")
    assert way.sent == []
    outbox.flush()
    assert way.sent == [1, 6, 3, 4, 5]
    outbox.put_latest("a", b"7")
    outbox.put_droppable(7, b"8")
    assert way.sent[5:] == [7, 8]
    way.full = True
    for number in (1, 2):
        outbox.put_latest("a", b"%d" % number)
    outbox.put_droppable(7, b"3")
    outbox.flush()
    assert (way.sent[7:], outbox.waiting) == ([], 2)
    outbox.flush(last=True)
    assert (way.sent[7:], outbox.waiting) == ([2, 3], 0)
    outbox.put_latest("a", b"4")  # not the one that was sent
    way.full = False
    outbox.flush()
    assert way.sent[9:] == [4]
