"""What no client should do: it costs the others nothing, and the audit stays true."""

from __future__ import annotations

import asyncio
import json
import os
import random
import re
import socket
import stat
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.frames import Frame, Opcode

from busmaster import Bus, Hcp2Controller, MemoryPort, RemoteBus, Service, connect, ext
from busmaster.app import bounds
from busmaster.app.service import admission
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.client import Client
from busmaster.app.service.client_messages import ClientMessage, NoParams
from busmaster.app.service.folder import Owner, ServedSocket, find_owner, line_name, owners, runtime_folder, socket_path
from busmaster.app.service.messages import encode_request
from busmaster.app.service.outbox import Outbox
from busmaster.app.service.owner_messages import TouchedParams
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.typed import Raw as Encoded
from busmaster.bus.node import Node
from busmaster.emulator.line import Line
from busmaster.errors import BacklogFull, InvalidCommand
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.registry import make_device
from tests.app.service.lines import ABSENT, PATIENT, Raw, Served, SlowWay, on_a_line, on_a_served_line, raw, until
from tests.patience import PATIENCE

ENORMOUS = 10**310
"""JSON has it, and no float is as large."""
READ = {"protocol": "hcp2", "address": 5, "command": {"command": "read", "element": 1}}
POINT = {**READ, "key": "5/1", "item": "1", "unit": ""}

UPGRADE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
)


# authorisation


def test_a_write_is_on_record_with_who_wrote_what_and_what_it_was_before(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        point = Hcp2Controller(line.bus, 5, timings=PATIENT).point("1")
        group = line.bus.poll_group("axes", period=0.02, points=[point])
        async for snapshot in group:
            if snapshot[point].value == 0.0:
                break
        await Hcp2Controller(remote, 5).point("1").write(2.5)
        [record] = line.records
        assert (record.interface, record.point, record.before, record.value) == ("service", "5/1", 0.0, 2.5)
        assert record.by.endswith(f"(process {os.getpid()})")
        assert record.ok

    on_a_served_line(tmp_path, story)


def test_the_owner_knows_the_value_before_of_each_place_that_a_program_changes(tmp_path: Path) -> None:
    async def run() -> None:
        line = Line(ModbusUnit.profile.line, [make_device("modbus", 5)], paced=False)
        async with asyncio.timeout(PATIENCE), Bus(MemoryPort(line)) as bus:
            authorisation, records, unit = Authorisation(bus), list[WriteRecord](), ModbusUnit(bus, 5)
            authorisation.record = records.append
            await unit.write("holding:10", 11, 12, 13)
            group = bus.poll_group("all", period=0.02, points=[unit.point("holding:10:3")])
            path = tmp_path / "line.sock"
            async with (
                Service(bus, authorisation=authorisation, path=path) as service,
                connect(service.address) as remote,
            ):
                for item, values in (("holding:11", (1,)), ("holding:10", (2, 3))):
                    await anext(aiter(group))
                    await ModbusUnit(remote, 5).write(item, *values)
            assert [record.before for record in records] == [12, (11, 1)]

    asyncio.run(run())


def test_a_block_write_is_not_on_record_as_a_write_to_the_point_of_one_of_its_places(tmp_path: Path) -> None:
    async def run() -> None:
        line = Line(ModbusUnit.profile.line, [make_device("modbus", 5)], paced=False)
        async with asyncio.timeout(PATIENCE), Bus(MemoryPort(line)) as bus:
            authorisation, records, unit = Authorisation(bus), list[WriteRecord](), ModbusUnit(bus, 5)
            authorisation.record = records.append
            bus.poll_group("all", period=60.0, points=[unit.point("holding:10"), unit.point("holding:12")])
            path = tmp_path / "line.sock"
            async with (
                Service(bus, authorisation=authorisation, path=path) as service,
                connect(service.address) as remote,
            ):
                await ModbusUnit(remote, 5).write("holding:10", 2)
                await ModbusUnit(remote, 5).write("holding:10", 2, 3)
                await ModbusUnit(remote, 5).write("holding:11", 4, 5)
            assert [record.point for record in records] == ["5/holding:10", "5/raw command", "5/raw command"]

    asyncio.run(run())


def test_a_read_only_line_lets_no_program_write(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        with pytest.raises(InvalidCommand, match="node 5: this line is read-only"):
            await controller.write(1, 1)
        assert await controller.read(1) == 0
        assert [outcome for _, outcome in line.audit()] == ["refused"]

    on_a_served_line(tmp_path, story, read_only=True)


def test_a_write_that_took_long_to_come_is_not_sent(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            write = {"command": "write", "element": 1, "values": [1]}
            said = await client.ask("request", **{**READ, "command": write}, requested=line.bus.now() - 2 * PATIENCE)
            assert said["error"]["data"]["error"] == "NotStarted"
            found = re.search(r"the request arrived (\d+\.\d) s after the program made it", said["error"]["message"])
            assert found is not None
            assert 2 * PATIENCE <= float(found[1]) < 4 * PATIENCE
            assert "the line is busy" not in said["error"]["message"]
            data = said["error"]["data"]
            assert data["hint"].endswith("the requesting program, or the owner of the line, was stopped meanwhile")
            assert (data["label"], data["command"]) == ("node 5", "write element 1 = 1")
        assert [outcome for _, outcome in line.audit()] == ["not started"]

    on_a_line(tmp_path, story)


def test_the_audit_is_true_of_a_program_that_is_killed_mid_write(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with connect(line.address) as remote:
            sent = asyncio.ensure_future(Hcp2Controller(remote, ABSENT, timings=PATIENT).write(1, 1))
            await line.sent()
            waiting = asyncio.ensure_future(Hcp2Controller(remote, 5).write(1, 1))
            await until(lambda: ext.line_statistics(line.bus).backlog)
            remote.link._connection.abort()  # type: ignore[union-attr]  # it is open
            await asyncio.gather(sent, waiting, return_exceptions=True)
        await line.alone()
        assert sorted(line.audit()) == [
            ("5/write element 1 = 1", "not started"),
            ("9/write element 1 = 1", "unconfirmed"),
        ]
        assert line.bus.nodes == ()

    on_a_line(tmp_path, story)


# what is said wrongly


@pytest.mark.parametrize(
    ("said", "complaint"),
    [
        ("{", "not valid JSON"),
        ('{"params": ' + "[" * 8_000, "not valid JSON"),
        ("[" * 8_000, "not a message of JSON-RPC 2.0"),
        ('{"jsonrpc": "2.0", "id": 2, "method": "now", "params": NaN}', "not valid JSON"),
        ('{"jsonrpc": "2.0", "id": 2, "method": "\\ud800"}', "not valid JSON"),
        ('{"jsonrpc": "2.0", "id": 2}', "a message has a method"),
        ('{"jsonrpc": "1.0", "id": 2, "method": "now"}', "not a message of JSON-RPC 2.0"),
        ("[" * 60_000, "a message must have at most 8192 values"),
        ("[" + "[]," * 20_000 + "0]", "a message must have at most 8192 values"),
        ("[]", "not a message of JSON-RPC 2.0"),
        ('{"jsonrpc": "2.0", "id": 2, "method": 3}', "a message has a method"),
        ('{"jsonrpc": "2.0", "method": "cancel", "params": {"id": [1]}}', "cancel: "),
        ('{"jsonrpc": "2.0", "id": true, "method": "groups"}', "the id of a request is a whole number"),
        (b"\x00\xff", "a message is text"),
    ],
    ids=range(14),
)
def test_garbage_ends_the_conversation_with_its_reason(said: str | bytes, complaint: str, tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            await client.connection.send(said)
            assert complaint in (await client.hear())["error"]["message"]
            with pytest.raises(ConnectionClosed):
                await client.hear()
        await line.alone()
        assert line.service.refused == 1

    on_a_line(tmp_path, story)


@pytest.mark.parametrize(
    ("method", "params", "complaint"),
    [
        ("request", {}, "request: 'protocol' is missing; service.schema.json has its parameters"),
        ("request", {**READ, "protocol": "profibus"}, "no such protocol"),
        ("request", {**READ, "address": 999}, "address 999 does not exist"),
        ("request", {**READ, "address": [5]}, "request: address: expected `int`, got `array`; service.schema.json"),
        ("request", {**READ, "command": {"command": "read", "element": 1000}}, "element"),
        ("request", {**READ, "command": 3}, "request"),
        ("request", {**READ, "options": {"safe": True}}, "request: options: object contains unknown field `safe`"),
        ("request", {**READ, "options": {"retries": -1}}, "retries"),
        ("request", {**READ, "options": {"priority": 9}}, "priority"),
        ("request", {**READ, "requested": "now"}, "requested"),
        ("node", {"protocol": "hcp2", "address": 6, "timings": {"read": 3}}, "timings.read: expected"),
        ("subscribe", {"group": "axes", "stream": 1}, "no poll group 'axes'"),
        ("poll", {"name": "x", "stream": 1, "period": 0, "points": []}, "period"),
        ("poll", {"name": "x", "stream": 1, "period": 1, "points": [{**POINT, "command": {}}]}, "has no command"),
        ("poll", {"name": "x", "stream": 1, "period": ENORMOUS, "points": []}, "period: number out of range"),
        ("request", {**READ, "requested": ENORMOUS}, "requested: number out of range"),
        ("request", {**READ, "options": {"finish_within": ENORMOUS}}, "finish_within: number out of range"),
        ("events", {"stream": -1}, "events: stream: expected `int` >= 0"),
        ("erase", {}, "no method 'erase'"),
    ],
    ids=str,
)
def test_what_cannot_be_asked_is_refused_in_words_and_the_conversation_goes_on(
    method: str, params: dict[str, Any], complaint: str, tmp_path: Path
) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            said = await client.ask(method, **params)
            assert complaint in said["error"]["message"]
            assert (await client.ask("groups"))["result"] == []
            assert (await client.ask("request", **READ))["result"] == 0
        await line.alone()
        assert (line.bus.nodes, line.bus.groups) == ((), ())

    on_a_line(tmp_path, story)


def test_a_value_that_is_too_large_for_a_number_is_refused_in_words(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        line.bus.poll_group("axes", period=0.02, points=[Hcp2Controller(line.bus, 5).point("1")])
        async with raw(line) as client:
            said = await client.ask("write", group="axes", key="5/1", value={"float": ENORMOUS})
            assert "request: OverflowError" in said["error"]["message"]
            assert len((await client.ask("groups"))["result"]) == 1

    on_a_line(tmp_path, story)


def test_a_message_that_the_owner_fails_at_ends_its_program_and_keeps_no_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    usual = Client.take

    def take(client: Client, message: ClientMessage) -> None:
        if message.method == "groups":
            raise ZeroDivisionError("a bug")
        usual(client, message)

    async def story(line: Served) -> None:
        async with raw(line) as client:
            monkeypatch.setattr(Client, "take", take)
            both = (encode_request(method, 1, NoParams()) for method in ("now", "groups"))
            frames = [Frame(Opcode.TEXT, said).serialize(mask=True) for said in both]
            client.connection.transport.write(b"".join(frames))  # the second waits for its turn
            assert "result" in await client.hear()
            assert "failed: ZeroDivisionError: a bug" in (await client.hear())["error"]["message"]
            with pytest.raises(ConnectionClosed):
                await client.hear()
        await line.alone()
        assert "a message of" in caplog.text

    on_a_line(tmp_path, story)


def test_a_message_of_ten_megabytes_ends_its_program_alone(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        reader, writer = await asyncio.open_unix_connection(line.address.removeprefix("unix:"))
        writer.write(UPGRADE)
        assert (await reader.readuntil(b"\r\n\r\n")).startswith(b"HTTP/1.1 101")
        writer.write(b"\x81\xff" + (10_000_000).to_bytes(8, "big") + bytes(4) + bytes(10_000_000))
        last = await reader.read(4)
        assert (last[0], last[2:]) == (0x88, (1009).to_bytes(2, "big"))  # too big, and closed
        writer.transport.abort()
        await until(lambda: len(line.service.clients) == 1)
        assert await Hcp2Controller(remote, 5).read(1) == 0

    on_a_served_line(tmp_path, story)


def test_a_version_that_is_not_spoken_is_said(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line, hello=False) as client:
            said = await client.ask("hello", versions=[0, 99])
            assert said["error"]["message"] == (
                "the service protocol has version 3 here, not [0, 99]; update the older of the two programs"
            )
            assert (said["id"], said["error"]["code"], "data" in said["error"]) == (None, -32602, False)
        for method, params in (("groups", {}), ("hello", {}), ("hello", {"versions": 3})):
            async with raw(line, hello=False) as client:
                said = await client.ask(method, **params)
                assert "the first message must be hello" in said["error"]["message"]
                assert (said["id"], said["error"]["code"], "data" in said["error"]) == (None, -32600, False)

    on_a_line(tmp_path, story)


def test_pages_cannot_use_it(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        offers: tuple[dict[str, Any], ...] = (
            {"origin": "http://evil.example"},
            {"origin": "null"},
            {"uri": "ws://evil.example/"},
        )
        for options in offers:
            with pytest.raises(InvalidStatus, match="403"):
                async with raw(line, **options):
                    pass
        assert line.service.clients == ()

    on_a_line(tmp_path, story)


# how much


def test_one_program_has_so_many_requests_and_a_few_urgent_ones_more(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_REQUESTS", 3)

    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        ended = await asyncio.gather(*(controller.read(n) for n in range(1, 6)), return_exceptions=True)
        assert [type(end) for end in ended if isinstance(end, Exception)] == [BacklogFull] * 2
        urgent = (controller.read(n, priority=0) for n in range(1, 6))  # type: ignore[call-overload]  # a number will do
        assert await asyncio.gather(*urgent) == [0] * 5

    on_a_served_line(tmp_path, story)


def test_a_program_that_does_not_read_loses_its_own_news_and_nothing_else() -> None:
    way, dropped = SlowWay(), list[object]()
    outbox = Outbox(way, dropped.append)
    outbox.put(b"first")
    way.full = True
    for number in range(bounds.MOST_UNREAD + 2):
        outbox.put_droppable(7, b"news %d" % number)
    outbox.put(b"an answer")
    for number in range(3):
        outbox.put_latest("stops", b"stops %d" % number)
    outbox.flush()
    assert way.sent == [b"first"]
    way.full = False
    outbox.flush()
    assert way.sent[:2] == [b"first", b"news 2"]
    assert way.sent[-2:] == [b"an answer", b"stops 2"]
    assert len(way.sent) == bounds.MOST_UNREAD + 3
    assert dropped == [7, 7]


def test_a_dropped_message_is_counted_for_its_own_stream(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.outbox.MOST_UNREAD", 2)
    way, dropped = SlowWay(), list[object]()
    outbox = Outbox(way, dropped.append)
    way.full = True
    for stream in (7, 8, 9, 9):
        outbox.put_droppable(stream, b"%d" % stream)
    assert dropped == [7, 8]
    way.full = False
    outbox.flush()
    assert way.sent == [b"9", b"9"]


def test_messages_of_streams_count_towards_the_unsent_messages_of_a_program(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.service.outbox.MOST_WAITING", 4)
    way = SlowWay()
    outbox = Outbox(way, lambda _: None)
    way.full = True
    outbox.put_droppable(7, b"a cycle")
    outbox.put_latest("stops", b"stops 1")
    outbox.put(b"a reply")
    assert not outbox.crowded
    outbox.put_droppable(7, b"a cycle")
    assert outbox.crowded


def test_a_program_that_does_not_read_its_answers_is_not_read_either(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.outbox.MOST_WAITING", 3)

    async def story(line: Served) -> None:
        async with raw(line) as client:
            [visitor] = line.service.clients
            connection = line.service._clients[visitor].websocket
            connection.full = True
            for number in range(5):
                await client.say(id=number, method="groups", params={})
            await until(lambda: visitor.outbox.crowded and not connection.transport.is_reading())
            assert visitor.outbox.waiting == 3
            connection.full = False
            line.service._clients[visitor].writable()
            assert [(await client.hear())["id"] for _ in range(5)] == [*range(5)]

    on_a_line(tmp_path, story)


def test_a_program_that_is_lost_while_it_does_not_read_leaves_all_the_same(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.outbox.MOST_WAITING", 3)

    async def story(line: Served) -> None:
        async with raw(line, max_queue=1) as client:

            async def flood() -> None:
                for number in range(2, 10_000_000):
                    await client.say(id=number, method="statistics", params={})

            flooding = asyncio.ensure_future(flood())
            await until(lambda: line.service.clients[0].outbox.waiting >= 3)
            client.connection.transport.abort()
            await asyncio.gather(flooding, return_exceptions=True)
            await line.alone()

    on_a_line(tmp_path, story)


@pytest.mark.slow
def test_a_thousand_programs_come_and_go_as_they_like_and_leave_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(admission, "FREE_CONNECTIONS", 2000)  # all are of one process here, which has one rate
    chance = random.Random(1)
    half_open: list[asyncio.StreamWriter] = []

    async def visit(line: Served) -> None:
        _, writer = await asyncio.open_unix_connection(line.address.removeprefix("unix:"))
        kind = chance.randrange(4)
        if kind:
            writer.write(b"GET / HTTP/1.1\r\nHost: localhost\r\n" if kind == 1 else chance.randbytes(40))
        if kind == 3:
            half_open.append(writer)
        elif chance.random() < 0.5:
            writer.transport.abort()
        else:
            writer.close()

    async def story(line: Served, remote: RemoteBus) -> None:
        group = line.bus.poll_group("axes", period=0.05, points=[Hcp2Controller(line.bus, 5).point("1")])
        for _ in range(10):
            await asyncio.gather(*(visit(line) for _ in range(95)), *(read(line) for _ in range(5)))
        assert await Hcp2Controller(remote, 6).read(1) == 0
        await until(lambda: len(line.service.clients) == 1)
        await until(lambda: len(line.bus.nodes) == 2)
        assert group.statistics().bad == 0
        for writer in half_open:
            writer.transport.abort()

    async def read(line: Served) -> None:
        async with connect(line.address) as remote:
            assert await Hcp2Controller(remote, 5).read(1) == 0

    on_a_served_line(tmp_path, story)


# the socket


def test_a_socket_is_this_users_alone_unless_it_is_given_to_a_group(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    with ServedSocket(Owner("a", "/dev/ttyUSB0", str(path), os.getpid())):
        assert stat.S_IMODE(path.stat().st_mode) == 0o600
    with ServedSocket(Owner("a", "/dev/ttyUSB0", str(path), os.getpid()), mode=0o660, group=os.getgid()):
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
    assert list(tmp_path.iterdir()) == []


def test_a_socket_that_is_served_names_its_process_and_one_of_a_dead_process_is_replaced(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    with (
        ServedSocket(Owner("a", "/dev/ttyUSB0", str(path), os.getpid())),
        pytest.raises(
            InvalidCommand, match=rf"by process {os.getpid()}, for /dev/ttyUSB0; give this line another name"
        ),
        ServedSocket(Owner("a", "/dev/ttyUSB1", str(path), os.getpid())),
    ):
        pass
    with (
        ServedSocket(Owner("a", "/dev/ttyUSB0", str(path), os.getpid())),
        pytest.raises(InvalidCommand, match="for /dev/ttyUSB0; use it, or stop that process first"),
        ServedSocket(Owner("a", "/dev/ttyUSB0", str(path), os.getpid())),
    ):
        pass
    with socket.socket(socket.AF_UNIX) as left:
        left.bind(str(path))
    path.with_suffix(".line").write_text("{")
    with ServedSocket(Owner("a", "/dev/ttyUSB0", str(path), os.getpid())) as served_again:
        assert json.loads(path.with_suffix(".line").read_text())["pid"] == os.getpid()
        assert served_again.owner.address == f"unix:{path}"


def test_what_is_no_socket_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "a.sock"
    path.write_text("mine")
    with (
        pytest.raises(InvalidCommand, match="is not a socket and is not replaced"),
        ServedSocket(Owner("a", "b", str(path), os.getpid())),
    ):
        pass
    assert path.read_text() == "mine"


def test_a_line_is_found_by_its_name_and_by_its_port_however_that_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "port").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "port")
    path = runtime_folder() / "slitter.sock"
    with ServedSocket(Owner("slitter", str(tmp_path / "port"), str(path), os.getpid())) as found:
        for name in ("slitter", str(tmp_path / "port"), f"{tmp_path}/by-id?baudrate=9600"):
            assert find_owner(name) == found.owner
        assert socket_path("slitter") == socket_path(f"unix:{path}") == str(path)
        assert find_owner("/dev/null") is None
    path.with_suffix(".line").write_text(json.dumps({"name": "slitter", "port": "x", "socket": str(path), "pid": 1}))
    assert list(owners()) == []


def test_a_line_is_found_though_the_entry_of_a_killed_owner_was_longer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    path = runtime_folder() / "slitter.sock"
    path.with_suffix(".line").write_text("{" + 1000 * " " + "}")
    with ServedSocket(Owner("slitter", str(tmp_path / "port"), str(path), os.getpid())) as found:
        assert find_owner("slitter") == found.owner


@pytest.mark.parametrize(
    "spelling",
    [
        "127.0.0.1:4001",
        "socket://LOCALHOST:4001",
        "[::ffff:127.0.0.1]:4001",
        "socket://[::ffff:7f00:1]:4001?echo=1",
        "127.1:4001",
    ],
)
def test_the_owner_of_a_serial_server_is_found_by_its_address_in_any_spelling(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spelling: str
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    folder = runtime_folder()
    with ServedSocket(Owner("slitter", "localhost:4001", str(folder / "slitter.sock"), os.getpid())) as served_socket:
        assert find_owner(spelling) == served_socket.owner
        assert find_owner(spelling.replace("4001", "4002")) is None
        assert find_owner("no such name") is None


@pytest.mark.parametrize("name", ["start_within", "finish_within"])
@pytest.mark.parametrize(
    ("value", "complaint"),
    [
        ("1e308", "86400 s at most, not 1e+308 s: leave it out for no limit"),
        ("86400.5", "86400 s at most"),
        ("1" * 400, "number out of range"),
        ("1e999", "number out of range"),
        ('{"float": "inf"}', "expected `float | null`, got `object`"),
        ("true", "expected `float | null`, got `bool`"),
        ("-1", "expected `float` >= 0"),
    ],
)
def test_a_request_waits_for_a_time_that_a_client_can_mean(
    tmp_path: Path, name: str, value: str, complaint: str
) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            for command in ('{"command": "read", "element": 1}', '{"command": "write", "element": 1, "values": [7.0]}'):
                params = f'{{"protocol": "hcp2", "address": 5, "command": {command}, "options": {{"{name}": {value}}}}}'
                await client.connection.send(f'{{"jsonrpc":"2.0","method":"request","params":{params},"id":1}}')
                said = await client.hear()
                assert name in said["error"]["message"]
                assert complaint in said["error"]["message"]
            assert (await line.bus.statistics()).exchanges == 0

    on_a_line(tmp_path, story)


def test_a_request_may_wait_for_a_day(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        controller = Hcp2Controller(remote, 5)
        assert await controller.read(1, start_within=86_400, finish_within=86_400.0) == 0

    on_a_served_line(tmp_path, story)


def test_systemd_says_where_its_lines_have_their_sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RUNTIME_DIRECTORY", f"{tmp_path}/slitter")
    assert runtime_folder() == tmp_path / "slitter"


def test_nobody_else_may_look_into_the_folder_that_it_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    assert runtime_folder().stat().st_mode & 0o777 == 0o700


def test_a_folder_that_others_could_enter_is_not_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    (tmp_path / "busmaster").mkdir()
    (tmp_path / "busmaster").chmod(0o777)
    with pytest.raises(InvalidCommand, match="others may write in"):
        runtime_folder()


@pytest.mark.parametrize(
    ("port", "name"), [("/dev/ttyUSB0", "ttyUSB0"), ("socket://10.0.0.1:502", "10.0.0.1-502"), ("..", "line")]
)
def test_a_line_is_called_after_its_port(port: str, name: str) -> None:
    assert line_name(port) == name


def test_a_bus_is_served_again_after_it_was(tmp_path: Path) -> None:
    async def run() -> None:
        async with Bus(MemoryPort(Line(Hcp2Controller.profile.line))) as bus:
            for _ in range(2):
                async with Service(bus, path=tmp_path / "a.sock") as service, connect(service.address) as remote:
                    assert remote.groups == ()
            assert not bus._line.on_stop
            assert not bus._line.on_groups

    asyncio.run(run())


def test_a_program_learns_how_many_messages_of_a_stream_it_was_too_slow_for(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        async with raw(line) as client:
            [visitor] = line.service.clients
            connection = line.service._clients[visitor].websocket
            connection.full = True
            for _ in range(bounds.MOST_UNREAD + 3):
                visitor.notify(7, "exchanges", Encoded(b'{"now": 0, "left_out": 0, "exchanges": []}'))
            assert visitor.dropped == {7: 3}
            connection.full = False
            line.service._clients[visitor].writable()
            heard = [await client.hear() for _ in range(bounds.MOST_UNREAD)]
            assert {message["params"]["stream"] for message in heard} == {7}

    on_a_line(tmp_path, story)


def test_a_stream_that_begins_again_under_its_number_counts_its_dropped_messages_from_0(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        line.bus.poll_group("axes", period=60.0, points=[Hcp2Controller(line.bus, 5).point("1")])

        async def dropped(client: Raw) -> list[int]:
            await client.say(id=1, method="subscribe", params={"group": "axes", "stream": 7})
            counts: list[int] = []
            while "result" not in (message := await client.hear()):
                if message["method"] == "points":
                    counts.append(message["params"]["dropped"])
            return counts

        async with raw(line) as client:
            assert await dropped(client) == [0]
            [program] = line.service.clients
            connection = line.service._clients[program]
            connection.websocket.full = True
            for _ in range(bounds.MOST_UNREAD + 3):
                program.notify(7, "exchanges", Encoded(b'{"now": 0, "left_out": 0, "exchanges": []}'))
            assert program.dropped[7]
            connection.websocket.full = False
            connection.writable()
            await client.say(method="end", params={"stream": 7})
            assert await dropped(client) == [0]

    on_a_line(tmp_path, story)


def test_messages_that_wait_replace_only_earlier_ones_of_the_same_subject(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    most = 5
    monkeypatch.setattr("busmaster.app.service.outbox.MOST_UNREAD", most)

    async def story(line: Served) -> None:
        nodes = [Node.of(Hcp2Controller(line.bus, address)) for address in (5, 6, 7)]
        for node in nodes:
            node.note_stop()  # before the program names it
        async with raw(line) as client:
            for address in (5, 6):
                assert "result" in await client.ask("node", protocol="hcp2", address=address)
            [program] = line.service.clients
            connection = line.service._clients[program]
            connection.websocket.full = True
            for _ in range(most + 3):
                program.notify(7, "exchanges", Encoded(b'{"now": 0, "left_out": 0, "exchanges": []}'))
            for set_ in (1, 2):
                program.notify_surely(7, "rows", Encoded(b'{"set": %d, "first": 0, "rows": []}' % set_), 0)
                program.notify_surely(7, "rows", Encoded(b'{"set": %d, "first": 50, "rows": []}' % set_), 1)
                program.notify_surely(7, "values", Encoded(b'{"set": %d, "first": 0, "values": []}' % set_), 0)
                program.notify_surely(8, "rows", Encoded(b'{"set": %d, "first": 0, "rows": []}' % set_), 0)
                for address in (5, 6):
                    program.notify_touched(TouchedParams("hcp2", address, float(set_), True, None), address)
                for node in nodes:
                    node.note_stop()
                line.authorisation.read_only = set_ == 2
                program.notify_access()
            connection.websocket.full = False
            connection.writable()
            await client.say(method="now", params={}, id=9)
            received: list[dict[str, Any]] = []
            while (message := await client.hear()).get("id") != 9:
                received.append(message)
            assert len(received) == most + 9
            assert program.dropped[7] == 3
            await client.say(method="end", params={"stream": 7})
            assert "result" in await client.ask("now")
            assert program.dropped[7] == 0  # for a later stream of this number
        exchanges = [one["params"]["dropped"] for one in received if one["method"] == "exchanges"]
        assert exchanges == [0] * (most - 2) + [1, 2]
        params = [one["params"] for one in received[most:]]
        assert [(one["stream"], one["dropped"], one["body"]["set"], one["body"]["first"]) for one in params[:4]] == [
            (7, 3, 2, 0),
            (7, 3, 2, 50),
            (7, 3, 2, 0),
            (8, 0, 2, 0),
        ]
        assert [(one["address"], one["when"]) for one in params[4:6]] == [(5, 2.0), (6, 2.0)]
        assert [(one["address"], one["stops"]) for one in params[6:8]] == [(5, 2), (6, 2)]
        assert params[8] == {"read_only": True}

    on_a_line(tmp_path, story)
