"""How much one program asks at a time, and how soon it has its answer."""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import AsyncGenerator, Awaitable, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest

from busmaster import Hcp2Controller, Priority, RemoteBus, connect
from busmaster.app.service.client_messages import CancelParams, RequestParams
from busmaster.app.service.connection import IncomingConnection
from busmaster.app.service.messages import decode_client_message, encode_notification, encode_request
from busmaster.app.service.sequences import RequestLimit
from busmaster.app.service.streams import READERS_IN_A_TURN, Broadcast
from busmaster.app.service.typed import Raw
from busmaster.bus.requester import ORDINARY, Requester, RequestOptions
from busmaster.errors import BusClosed, InvalidCommand, NotStarted
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.msc import codec as msc
from busmaster.testing import run_in_virtual_time
from busmaster.transport.pump import Pump
from tests.app.service.lines import Served, on_a_line, on_a_served_line, raw, until

NODE = cast("Requester", SimpleNamespace(label="node 5", line="line", address=5))
COMMAND = hcp2.Read(1)


def full(monkeypatch: pytest.MonkeyPatch, most: int = 1) -> RequestLimit:
    """A room that is taken."""
    monkeypatch.setattr("busmaster.app.service.sequences.MOST_UNDER_WAY", most)
    room = RequestLimit(lambda: asyncio.get_running_loop().time())
    assert all(room.take() for _ in range(most))
    assert not room.take()
    return room


def test_who_waits_longest_is_let_in_first_and_says_how_long_that_was(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        room, let_in = full(monkeypatch), list[tuple[str, float]]()

        async def wait(name: str) -> None:
            let_in.append((name, await room.wait(ORDINARY, NODE, COMMAND)))

        waiting = [asyncio.ensure_future(wait(name)) for name in ("first", "second")]
        for _ in waiting:
            await asyncio.sleep(1)
            room.give_back()
        await asyncio.gather(*waiting)
        assert let_in == [("first", 1.0), ("second", 2.0)]
        assert not room.take()
        room.give_back()
        assert room.take()

    run_in_virtual_time(run())


def test_room_that_is_given_to_one_who_gives_up_just_then_is_anothers(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        room = full(monkeypatch)
        gone, other = (asyncio.ensure_future(room.wait(ORDINARY, NODE, COMMAND)) for _ in range(2))
        await asyncio.sleep(0)
        room.give_back()
        gone.cancel()
        assert await other == 0.0
        assert gone.cancelled()
        room.give_back()
        assert room.take()

    run_in_virtual_time(run())


def test_those_who_have_given_up_are_passed_over(monkeypatch: pytest.MonkeyPatch) -> None:
    async def run() -> None:
        room = full(monkeypatch)
        with pytest.raises(
            NotStarted, match="the time of the request is over, and 1 requests of this program have no reply yet"
        ) as caught:
            await room.wait(RequestOptions(start_within=0.5), NODE, COMMAND)
        assert (caught.value.label, caught.value.command) == ("node 5", str(COMMAND))
        loop = asyncio.get_running_loop()
        for options in (RequestOptions(finish_within=0.5), RequestOptions(start_within=0.5, finish_within=5.0)):
            began = loop.time()
            with pytest.raises(NotStarted):
                await room.wait(options, NODE, COMMAND)
            assert loop.time() - began == 0.5
        for options in (RequestOptions(start_within=0.0), RequestOptions(finish_within=0.0)):
            with pytest.raises(NotStarted):
                await room.wait(options, NODE, COMMAND)
            assert loop.time() - began == 0.5, "it does not wait at all"
        gone = asyncio.ensure_future(room.wait(ORDINARY, NODE, COMMAND))
        await asyncio.sleep(0)
        gone.cancel()
        await asyncio.gather(gone, return_exceptions=True)
        assert not room.take()
        room.give_back()
        assert room.take()

    run_in_virtual_time(run())


async def is_answered(controller: Hcp2Controller) -> None:
    assert await controller.read(1) == 0


async def is_not_a_command_of_the_node(controller: Hcp2Controller) -> None:
    with pytest.raises(InvalidCommand, match="hcp2 has no command DataRead"):
        await controller.node.request(msc.DataRead(1))


async def touches_what_the_node_does_not_have(controller: Hcp2Controller) -> None:
    with pytest.raises(InvalidCommand, match="hcp2 has no command DataRead"):
        await controller.node.request(hcp2.Write(1, (7.0,)), touches=msc.DataRead(1))


async def has_impossible_options(controller: Hcp2Controller) -> None:
    with pytest.raises(InvalidCommand, match="retries"):
        await controller.read(1, retries=-1)


async def is_refused_by_the_owner(controller: Hcp2Controller) -> None:
    command = hcp2.Write(1, (7.0,))
    with pytest.raises(InvalidCommand, match="is not a stop"):
        await controller.node.request(command, stop=True)


async def is_given_up(controller: Hcp2Controller) -> None:
    reading = asyncio.ensure_future(controller.read(1))
    await asyncio.sleep(0)
    reading.cancel()
    await asyncio.gather(reading, return_exceptions=True)
    assert reading.cancelled()


ENDS = [
    is_answered,
    is_not_a_command_of_the_node,
    touches_what_the_node_does_not_have,
    has_impossible_options,
    is_refused_by_the_owner,
    is_given_up,
]


@pytest.mark.parametrize("end", ENDS, ids=lambda end: end.__name__)
def test_a_request_gives_back_its_place_however_it_ends(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: Callable[[Hcp2Controller], Awaitable[None]]
) -> None:
    monkeypatch.setattr("busmaster.app.service.sequences.MOST_UNDER_WAY", 1)

    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        await end(controller)
        assert remote.room.take(), "the place is free again"
        assert not remote.room.take(), "and there is one"
        ending = asyncio.ensure_future(end(controller))
        behind = asyncio.ensure_future(controller.read(1))
        await asyncio.sleep(0)
        remote.room.give_back()  # to the request that waits for it, and from that to the one behind it
        await ending
        assert await behind == 0
        assert remote.room.take()
        assert not remote.room.take()

    on_a_served_line(tmp_path, story)


def test_a_request_that_takes_no_place_gives_none_back(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.sequences.MOST_UNDER_WAY", 1)

    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        assert remote.room.take()
        assert await controller.read(1, priority=Priority.URGENT) == 0
        with pytest.raises(InvalidCommand, match="no command"):
            await controller.node.request(msc.DataRead(1), priority=Priority.URGENT)
        async with controller.exclusive(max_hold=5.0) as held:
            assert await held.read(1) == 0
        assert not remote.room.take()

    on_a_served_line(tmp_path, story)


def test_a_request_before_the_bus_is_entered_takes_no_place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.sequences.MOST_UNDER_WAY", 1)

    async def story(line: Served) -> None:
        remote = connect(line.address)
        controller = Hcp2Controller(remote, 5)
        with pytest.raises(BusClosed, match="the bus is not open"):
            await controller.read(1)
        async with remote:
            assert remote.room.take()
            remote.room.give_back()
            assert await controller.read(1) == 0

    on_a_line(tmp_path, story)


def test_a_read_is_answered_in_the_callback_that_brought_its_reply(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[str] = []
    turn, send = Pump.turn, IncomingConnection.send

    def turned(pump: Pump) -> None:
        seen.append("turn")
        turn(pump)
        seen.append("turn over")

    def said(connection: Any, message: bytes) -> None:
        seen.append("answer")
        send(connection, message)

    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        await controller.read(1)
        monkeypatch.setattr(Pump, "turn", turned)
        monkeypatch.setattr(IncomingConnection, "send", said)
        assert await controller.read(1) == 0
        assert seen[-3:] == ["turn", "answer", "turn over"]

    on_a_served_line(tmp_path, story)


def test_a_read_that_its_program_gives_up_waits_for_the_line_no_longer(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        await Hcp2Controller(remote, 5).read(1)
        [client] = line.service.clients
        read = RequestParams("hcp2", 5, {"command": "read", "element": 1})
        for number in (70, 71, 72):
            client.take(decode_client_message(encode_request("request", number, read).decode()))
        for number in (70, 71, 72):
            client.take(decode_client_message(encode_notification("cancel", CancelParams(number)).decode()))
        assert client.unfinished == ()
        counts = await line.bus.statistics()
        assert (counts.cancelled, counts.backlog) == (3, 0)

    on_a_served_line(tmp_path, story)


def test_a_request_that_could_not_be_begun_leaves_its_number_free(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            read = {"protocol": "hcp2", "address": 5, "command": {"command": "read", "element": 1}}
            for _ in range(2):
                said = await client.ask("request", **read, stops_seen=7)
                assert said["error"]["data"]["error"] == "Superseded"
            assert (await client.ask("request", **read))["result"] == 0

    on_a_line(tmp_path, story)


@pytest.mark.asyncio
async def test_many_readers_of_a_stream_get_a_message_a_few_in_each_turn_of_the_loop() -> None:
    class Messages(Broadcast):
        async def _bodies(self) -> AsyncGenerator[tuple[str, Raw], None]:
            yield "cycle", Raw(b"{}")
            await asyncio.Event().wait()

    class Reader:
        def __init__(self) -> None:
            self.turn: int | None = None

        def notify(self, stream: int, method: str, body: Raw) -> None:
            self.turn = turn

        def notify_surely(self, stream: int, method: str, body: Raw, part: int = 0) -> None:
            raise AssertionError(method)

    turn = 0
    source, readers = Messages(lambda: None), [Reader() for _ in range(4 * READERS_IN_A_TURN)]
    for reader in readers:
        source.join(reader, 1)
    gone = readers[-1]
    while readers[-2].turn is None:
        await asyncio.sleep(0)
        turn += 1
        if gone in [reader for reader, _ in source.readers] and readers[0].turn is not None:
            source.leave(gone, 1)
    turns = Counter(reader.turn for reader in readers if reader is not gone)
    assert [*turns.values()] == [READERS_IN_A_TURN] * 3 + [READERS_IN_A_TURN - 1]
    assert gone.turn is None, "one that has left gets no message"
    for reader in readers[:-1]:
        source.leave(reader, 1)


class News(Broadcast):
    """A source whose messages are sent on demand of a test."""

    def __init__(self) -> None:
        self.begun = self.ended = 0
        self.messages: asyncio.Queue[bytes | Exception] = asyncio.Queue()
        super().__init__(self._count_end)

    def _count_end(self) -> None:
        self.ended += 1

    async def _bodies(self) -> AsyncGenerator[tuple[str, Raw], None]:
        self.begun += 1
        while not isinstance(message := await self.messages.get(), Exception):
            yield "news", Raw(message)
        if not isinstance(message, StopIteration):
            raise message


class NewsReader:
    """A client that keeps its messages."""

    def __init__(self) -> None:
        self.received: list[tuple[int, str]] = []

    def notify(self, stream: int, method: str, body: Raw) -> None:
        self.received.append((stream, bytes(body).decode()))

    def notify_surely(self, stream: int, method: str, body: Raw, part: int = 0) -> None:
        self.received.append((stream, method))


@pytest.mark.asyncio
async def test_a_source_runs_once_for_all_its_readers_until_the_last_has_left() -> None:
    news, first, second = News(), NewsReader(), NewsReader()
    for reader, stream in ((first, 1), (first, 2), (second, 1)):
        news.join(reader, stream)
    news.messages.put_nowait(b"1")
    await until(lambda: second.received)
    news.leave(first, 1)
    news.leave(first, 9)  # there is none
    news.messages.put_nowait(b"2")
    await until(lambda: len(second.received) == 2)
    assert first.received == [(1, "1"), (2, "1"), (2, "2")]
    assert (news.begun, news.ended) == (1, 0)
    news.leave(first, 2)
    news.leave(second, 1)
    assert news.ended == 1
    assert news._task is not None
    await asyncio.wait([news._task])
    assert news._task.cancelled()
    assert second.received == [(1, "1"), (1, "2")]


@pytest.mark.asyncio
@pytest.mark.parametrize(("end", "logged"), [(StopIteration(), []), (ValueError("odd"), ["a stream ended"])])
async def test_a_source_that_ends_or_fails_informs_all_its_readers(
    end: Exception, logged: list[str], caplog: pytest.LogCaptureFixture
) -> None:
    news, first, second = News(), NewsReader(), NewsReader()
    for reader, stream in ((first, 1), (first, 2), (second, 1)):
        news.join(reader, stream)
    news.messages.put_nowait(end)
    await until(lambda: second.received)
    assert (first.received, second.received) == ([(1, "ended"), (2, "ended")], [(1, "ended")])
    for reader, stream in ((first, 1), (first, 2), (second, 1)):
        news.leave(reader, stream)
    assert news.ended == 1, "another one may run for the same source by now"
    assert [record.getMessage() for record in caplog.records] == logged
