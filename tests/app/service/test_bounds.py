"""What one program may have of a served line, and of its owner's time and memory."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
from dataclasses import replace
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed

from busmaster import Bus, Hcp2Controller, MemoryPort, RemoteBus, connect
from busmaster.app import bounds
from busmaster.app.bounds import READ_AT_ONCE
from busmaster.app.service import plans
from busmaster.app.service.client import Client
from busmaster.app.service.client_connection import ClientConnection, MessageOrder
from busmaster.app.service.client_messages import CancelParams, ClientMessage, RequestParams, StreamParams
from busmaster.app.service.folder import Owner, ServedSocket
from busmaster.app.service.messages import decode_client_message, encode_notification, encode_request
from busmaster.app.service.outbox import Outbox
from busmaster.app.service.streams import SAMPLES_IN_A_TURN, GroupBroadcast
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.emulator.line import Line as EmulatedLine
from busmaster.errors import InvalidCommand
from busmaster.planning import PlannedGroup
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from tests.app.service.lines import ABSENT, Served, SlowWay, on_a_line, on_a_served_line, raw, served, until
from tests.patience import PATIENCE
from tests.stories import on_a_bus


def test_news_that_were_dropped_take_no_memory() -> None:
    way = SlowWay()
    outbox = Outbox(way, lambda _: None)
    way.full = True
    outbox.put(b"an answer that is not read")
    for number in range(10 * bounds.MOST_UNREAD):
        outbox.put_droppable(7, b"news %d" % number)
    assert outbox.waiting == bounds.MOST_UNREAD + 1


def test_a_write_that_is_given_up_before_its_first_step_is_on_record_and_leaves_nothing(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        [client] = line.service.clients
        command = {"command": "write", "element": 1, "values": [7.0]}
        client.take(decode_client_message(encode_request("request", 70, RequestParams("hcp2", 5, command)).decode()))
        client.take(decode_client_message(encode_notification("cancel", CancelParams(70)).decode()))
        await until(lambda: not client.unfinished)
        assert line.audit() == [("5/write element 1 = 7", "not started")]
        assert await Hcp2Controller(line.bus, 5).read(1) == 0

    on_a_served_line(tmp_path, story)


def test_what_is_cancelled_before_it_was_handed_over_is_never_said(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        await controller.read(1)
        connection = remote.link._connection
        assert connection is not None
        connection.full = True
        writing = asyncio.ensure_future(controller.write(1, 7))
        await asyncio.sleep(0)
        writing.cancel()
        await asyncio.gather(writing, return_exceptions=True)
        connection.full = False
        remote.link.writable()
        assert await controller.read(1) == 0
        assert line.records == []

    on_a_served_line(tmp_path, story)


def test_only_what_stops_passes_the_limits_as_a_stop(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        own = Hcp2Controller(line.bus, 5)
        own.point("1").limit(maximum=10)
        async with raw(line) as client:
            write = {"command": "write", "element": 1, "values": [11.0]}
            said = await client.ask("request", protocol="hcp2", address=5, command=write, stop=True)
            assert "is not a stop" in said["error"]["message"]
        assert await own.read(1) == 0

    on_a_served_line(tmp_path, story)


def test_a_program_cannot_have_the_line_wait_as_long_as_it_likes(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        long = Timings.uniform(ReplyTiming(0.01, 0.01, bounds.LONGEST_REPLY + 1, 0.01))
        with pytest.raises(InvalidCommand, match="may have the line wait 5 s"):
            await Hcp2Controller(remote, ABSENT, timings=long).read(1)
        assert line.bus.nodes == ()

    on_a_served_line(tmp_path, story)


def test_the_socket_of_another_program_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "other.sock"
    with socket.socket(socket.AF_UNIX) as other, socket.socket(socket.AF_UNIX) as friend:
        other.bind(str(path))
        other.listen()
        with pytest.raises(InvalidCommand, match="another program; stop it, or use another path"):
            ServedSocket(Owner("other", "x", str(path), 1)).__enter__()
        friend.connect(str(path))
    assert os.listdir(tmp_path) == ["other.sock"]


def test_a_socket_that_cannot_be_given_to_its_group_is_not_left_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def chown(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(os, "chown", chown)
    with pytest.raises(InvalidCommand, match="cannot be served: Operation not permitted"):
        ServedSocket(Owner("line", "x", str(tmp_path / "line.sock"), 1), group=1).__enter__()
    assert os.listdir(tmp_path) == []


def test_messages_that_come_together_are_taken_one_in_a_turn(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    turn = 0
    taken: list[int] = []
    take = Client.take

    def note(client: Client, message: ClientMessage) -> None:
        taken.append(turn)
        take(client, message)

    monkeypatch.setattr(Client, "take", note)

    async def story(line: Served, remote: RemoteBus) -> None:
        def count() -> None:
            nonlocal turn
            turn += 1
            asyncio.get_running_loop().call_soon(count)

        count()
        await remote.statistics()
        taken.clear()
        [connection] = line.service._clients.values()
        sizes: list[int] = []
        receive = connection.websocket.buffer_updated

        def received(count: int) -> None:
            sizes.append(count)
            receive(count)

        monkeypatch.setattr(connection.websocket, "buffer_updated", received)
        for _ in range(100):
            remote.link.notify("end", StreamParams(7))
        await until(lambda: len(taken) >= 100)
        assert len(set(taken)) == len(taken)
        assert max(sizes) <= READ_AT_ONCE

    on_a_served_line(tmp_path, story)


def test_a_program_that_stands_still_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.connection.SEND_WITHIN", 0.05)

    async def story(line: Served, remote: RemoteBus) -> None:
        async with raw(line, max_queue=1) as client:
            client.connection.transport.pause_reading()
            with contextlib.suppress(ConnectionClosed):
                while True:
                    await client.say(id=2, method="statistics", params={})
                    await asyncio.sleep(0)
            await until(lambda: len(line.service.clients) == 1)
            client.connection.transport.abort()
        assert await Hcp2Controller(remote, 5).read(1) == 0

    on_a_served_line(tmp_path, story)


@pytest.mark.slow
def test_a_poll_group_of_a_thousand_points_comes_in_messages_that_hold_up_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lengths: list[int] = []
    heard = ClientConnection.received

    def note(connection: ClientConnection, message: str | bytes) -> None:
        lengths.append(len(message))
        heard(connection, message)

    monkeypatch.setattr(ClientConnection, "received", note)

    async def story(line: Served, remote: RemoteBus) -> None:
        handles = [Hcp2Controller(remote, 5 + number % 2) for number in range(10)]
        points = [handles[n % 10].point(f"{n % 99 + 1}") for n in range(198)]
        scaled = [replace(point, item=f"{point.item} {n}") for n in range(6) for point in points]
        group = remote.poll_group("many", period=60, points=scaled[: bounds.MOST_POLLED_POINTS])
        cycles = group.subscribe()
        await group.ready()
        line.bus.groups[0].demand()
        snapshot = await anext(cycles)
        assert len(snapshot) == bounds.MOST_POLLED_POINTS
        assert all(sample.value == 0 for sample in snapshot.samples.values())
        assert max(lengths) < bounds.LONGEST_REQUEST / 2
        with pytest.raises(InvalidCommand, match="1000 points at most"):
            await remote.poll_group("more", period=60, points=scaled[: bounds.MOST_POLLED_POINTS + 1]).ready()

    on_a_served_line(tmp_path, story)


def test_of_those_who_never_say_hello_the_oldest_goes_for_one_too_many(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.admission.MOST_STRANGERS", 3)

    async def story(line: Served, remote: RemoteBus) -> None:
        path = line.address.removeprefix("unix:")
        first, *others = [await asyncio.open_unix_connection(path) for _ in range(3)]
        await until(lambda: line.service.strangers == 3)
        async with connect(line.address) as another:
            assert await first[0].read() == b""
            assert await Hcp2Controller(another, 5).read(1) == 0
        assert line.service.refused == 1
        assert await Hcp2Controller(remote, 5).read(1) == 0
        for _, writer in (first, *others):
            writer.transport.abort()

    on_a_served_line(tmp_path, story)


def test_one_that_says_nothing_for_ten_seconds_is_let_go(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.client_connection.HELLO_WITHIN", 0.05)

    async def story(line: Served) -> None:
        async with raw(line, hello=False) as client:
            assert (await client.hear())["error"]["message"] == "no hello was received"
        reader, writer = await asyncio.open_unix_connection(line.address.removeprefix("unix:"))
        assert await reader.read() == b""
        writer.transport.abort()
        await until(lambda: not line.service.strangers)

    on_a_line(tmp_path, story)


@pytest.mark.parametrize("flood", [b"\x89\x80" + bytes(4), b"\x00\x80" + bytes(4)], ids=["pings", "pieces"])
def test_a_client_that_floods_the_owner_with_pings_or_pieces_of_messages_is_closed(
    tmp_path: Path, flood: bytes
) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        async with raw(line) as client:
            if flood[0] == 0:
                client.connection.transport.write(b"\x01\x80" + bytes(4))  # the first piece
            client.connection.transport.write(flood * (bounds.MOST_FRAMES - 2))
            await until(lambda: not client.connection.transport.get_write_buffer_size())
            if flood[0] != 0:
                assert "result" in await client.ask("now")  # so many may come
            client.connection.transport.write(flood * bounds.MOST_FRAMES)
            with pytest.raises(ConnectionClosed, match=r"1008.*more than 50 pings and pieces of messages in a second"):
                await client.hear()
        assert await Hcp2Controller(remote, 5).read(1) == 0

    on_a_served_line(tmp_path, story)


def test_one_message_of_each_program_is_taken_before_the_second_of_any() -> None:
    class Queue:
        """Some messages of one program."""

        def __init__(self, name: str, count: int) -> None:
            self.name = name
            self.count = count

        def take(self) -> None:
            taken.append((self.name, turn))
            self.count -= 1
            if self.count:
                message_order.ask(self)  # type: ignore[arg-type]  # all of a connection that it asks for

    taken: list[tuple[str, int]] = []
    turn, message_order = 0, MessageOrder()

    async def run() -> None:
        nonlocal turn
        for name, count in (("first", 1), ("much", 4), ("some", 2), ("one", 1)):
            message_order.ask(Queue(name, count))  # type: ignore[arg-type]  # all of a client that is asked of it
        for turn in range(1, 9):  # noqa: B007  it is looked at in `take`
            await asyncio.sleep(0)

    asyncio.run(run())
    assert [name for name, _ in taken] == ["first", "much", "some", "one", "much", "some", "much", "much"]
    assert len({turn for _, turn in taken}) == len(taken)


def test_a_service_ends_though_a_connection_has_only_just_been_taken(tmp_path: Path) -> None:
    async def run() -> None:
        async with asyncio.timeout(PATIENCE):
            async with served(tmp_path) as line:
                with socket.socket(socket.AF_UNIX) as stranger:
                    stranger.connect(line.address.removeprefix("unix:"))
                    await until(lambda: line.service.strangers)  # its end is there, and not connected to it yet
            assert line.service.strangers == 0

    asyncio.run(run())


def test_it_runs_on_uvloop_too(tmp_path: Path) -> None:
    uvloop = pytest.importorskip("uvloop", reason="uvloop is not installed")

    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(tmp_path) as line, connect(line.address) as remote:
            controller = Hcp2Controller(remote, 5)
            await controller.write(1, 1.5)
            assert await asyncio.gather(*(controller.read(number) for number in (1, 2))) == [1.5, 0]
            async with raw(line) as client:
                await client.connection.send("[" * (bounds.LONGEST_REQUEST + 100))
                with pytest.raises(ConnectionClosed, match="1009"):
                    await client.hear()

    with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
        runner.run(run())


@pytest.mark.asyncio
async def test_a_long_cycle_is_encoded_in_several_turns_of_the_loop() -> None:
    devices = [make_device("hcp2", address) for address in (1, 2)]
    bus = Bus(MemoryPort(EmulatedLine(Hcp2Controller.profile.line, devices, paced=False)))
    points = [Hcp2Controller(bus, address).point(str(element)) for address in (1, 2) for element in range(1, 61)]
    loop, turns = asyncio.get_running_loop(), 0

    def turn() -> None:
        nonlocal turns
        turns += 1
        loop.call_soon(turn)

    async with bus:
        group = bus.poll_group("long", period=0.05, points=points)
        async for snapshot in group:
            turn()
            before = turns
            body = await GroupBroadcast(group, lambda: None)._encode(snapshot)
            assert turns - before == len(points) // SAMPLES_IN_A_TURN
            assert len(json.loads(bytes(body))["samples"]) == len(points)
            break


def test_a_plan_for_a_client_counts_the_groups_of_the_line_too(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plans, "MOST_PLANNED_GROUPS", 2)

    async def story(bus: Bus) -> None:
        controller = Hcp2Controller(bus, 1)
        planner = plans.Planner(bus)
        more = [PlannedGroup(name, 1.0, [(bus.nodes[0].planned(), hcp2.Read(1))]) for name in ("a", "b")]
        await planner.plan(more)
        bus.poll_group("own", period=1.0, points=[controller.point("1")])
        await planner.plan(more[:1])
        with pytest.raises(InvalidCommand, match="2 groups at most, and not 3"):
            await planner.plan(more)

    on_a_bus(story, EmulatedMint(1))
