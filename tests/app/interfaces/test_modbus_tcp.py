"""`busmaster modbus-tcp`: its frames and its map alone, its server by sockets, and the whole by pymodbus's clients."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import os
import random
import re
import signal
import socket
import struct
import subprocess
import threading
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from pymodbus.client import ModbusTcpClient

from busmaster import Priority, Quality, Snapshot
from busmaster.app import bounds
from busmaster.app.interfaces import followed_groups, modbus_tcp, reported_refusals
from busmaster.app.interfaces.following import Connected, Following, Lost
from busmaster.app.interfaces.modbus_tcp import (
    UNIT_REFUSED,
    Answers,
    BadFrame,
    Entry,
    ExceptionReply,
    ModbusTcpServer,
    ReadRequest,
    RegisterMap,
    Rules,
    Values,
    WriteRequest,
    automatic_map,
    code_of,
    length_of,
    read_map,
    read_reply,
    request_of,
)
from busmaster.app.service.picture import Row
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.errors import (
    BacklogFull,
    InvalidCommand,
    LineDown,
    NodeDown,
    NoReply,
    NotStarted,
    Refused,
    Superseded,
    WriteUnconfirmed,
)
from busmaster.protocols.modbus.codec import EXCEPTIONS
from busmaster.registry import find, make_device
from tests.app.cli.conftest import Command, busmaster, owner, serve, started
from tests.app.interfaces.test_following import Remote, connected, row, shown_frame
from tests.app.outputs.cycles import cycle
from tests.app.service.test_interfaces import has_ipv6
from tests.patience import PATIENCE

__all__ = ["busmaster"]

# frames


def frame(pdu: bytes, *, transaction: int = 1, unit: int = 1, protocol: int = 0, length: int | None = None) -> bytes:
    return struct.pack(">HHHB", transaction, protocol, len(pdu) + 1 if length is None else length, unit) + pdu


READ = bytes.fromhex("03 0000 0001")


@pytest.mark.parametrize(
    ("pdu", "request_"),
    [
        ("01 0000 07d0", ReadRequest("coil", 0, 2000)),
        ("02 ffff 0001", ReadRequest("discrete", 65535, 1)),
        ("03 0010 007d", ReadRequest("holding", 16, 125)),
        ("04 0010 0002", ReadRequest("input", 16, 2)),
        ("05 0003 ff00", WriteRequest("coil", 3, (1,))),
        ("05 0003 0000", WriteRequest("coil", 3, (0,))),
        ("06 0003 1234", WriteRequest("holding", 3, (0x1234,))),
        ("0f 0003 000a 02 0502", WriteRequest("coil", 3, (1, 0, 1, 0, 0, 0, 0, 0, 0, 1))),
        ("0f 0003 0007 01 45", WriteRequest("coil", 3, (1, 0, 1, 0, 0, 0, 1))),
        ("0f 0003 0008 01 85", WriteRequest("coil", 3, (1, 0, 1, 0, 0, 0, 0, 1))),  # a full byte
        ("0f 0003 0009 02 8501", WriteRequest("coil", 3, (1, 0, 1, 0, 0, 0, 0, 1, 1))),
        ("0f 0000 07b0 f6" + 246 * "ff", WriteRequest("coil", 0, 1968 * (1,))),
        ("10 0003 0002 04 0001 fffe", WriteRequest("holding", 3, (1, 0xFFFE))),
    ],
)
def test_a_request_is_decoded(pdu: str, request_: ReadRequest | WriteRequest) -> None:
    assert request_of(bytes.fromhex(pdu)) == request_


@pytest.mark.parametrize(
    ("pdu", "code"),
    [
        ("00", 1),
        ("16 0004 00f2 0025", 1),
        ("17 0000 0001 0000 0001 02 0001", 1),
        ("2b 0e 01 00", 1),
        ("83 0000 0001", 1),
        ("01 0000 07d1", 3),
        ("03 0000 007e", 3),
        ("03 0000 0000", 3),
        ("03 0000 00", 3),
        ("03 0000 0001 00", 3),
        ("03 ffff 0002", 2),
        ("05 0000 0001", 3),
        ("06 0000", 3),
        ("0f 0000 07b1 f7" + 247 * "00", 3),
        ("0f 0000 0009 01 01", 3),
        ("0f 0000 0008 02 0100", 3),
        ("0f 0000 0009", 3),
        ("10 0000 007c f8" + 248 * "00", 3),
        ("10 0000 0002 04 0001", 3),
        ("10 0000 0001 04 0001 0002", 3),
        ("10 ffff 0002 04 0001 0002", 2),
    ],
)
def test_a_malformed_request_has_an_exception_code(pdu: str, code: int) -> None:
    with pytest.raises(ExceptionReply) as raised:
        request_of(bytes.fromhex(pdu))
    assert raised.value.code == code


@pytest.mark.parametrize("header", ["0001 0001 0006 01", "0001 0000 0001 01", "0001 0000 00ff 01", "0001 0000 ffff 01"])
def test_a_header_of_another_protocol_or_length_is_a_bad_frame(header: str) -> None:
    with pytest.raises(BadFrame):
        length_of(bytes.fromhex(header))


def test_replies_to_reads_are_encoded() -> None:
    assert length_of(bytes.fromhex("0001 0000 00fe 01")) == 253
    assert read_reply(1, [1, 0, 0, 0, 0, 0, 0, 0, 1]) == bytes.fromhex("01 02 01 01")
    assert read_reply(3, [1, 0xFFFE]) == bytes.fromhex("03 04 0001 fffe")


def test_exceptions_of_units_keep_their_code_and_others_say_what_happened_to_the_request() -> None:
    for code, name in EXCEPTIONS.items():
        assert code_of(Refused(f"refused: {name}")) == code
        assert UNIT_REFUSED[name] == code
    assert code_of(Refused("refused: exception 9")) == 9
    assert code_of(Refused("refused")) == 4
    assert code_of(NotStarted("busy")) == 6  # nothing was sent
    assert [code_of(kind("x")) for kind in (NoReply, NodeDown, WriteUnconfirmed)] == [11, 11, 11]
    assert code_of(InvalidCommand("too high")) == 3


# the map


@pytest.mark.parametrize(
    ("options", "value", "registers"),
    [
        ({"type": "int16"}, -2, [0xFFFE]),
        ({"type": "uint16"}, 65535, [0xFFFF]),
        ({"type": "int16", "scale": 0.1}, 12.3, [123]),
        ({"type": "int32"}, -2, [0xFFFF, 0xFFFE]),
        ({"type": "uint32", "word_order": "little"}, 0x12345678, [0x5678, 0x1234]),
        ({"type": "uint32", "byte_order": "little"}, 0x12345678, [0x3412, 0x7856]),
        ({"type": "uint32", "byte_order": "little", "word_order": "little"}, 0x12345678, [0x7856, 0x3412]),
        ({"type": "int64"}, -(2**63), [0x8000, 0, 0, 0]),
        ({"type": "uint64", "word_order": "little"}, 1, [1, 0, 0, 0]),
        ({"type": "float32"}, 12.3, [0x4144, 0xCCCD]),
        ({"type": "float32"}, 1975308.5, [0x49F1, 0x2064]),  # of eight digits
        ({"type": "float32"}, -103.217316, [0xC2CE, 0x6F44]),  # of nine
        ({"type": "float32"}, 3.4028235e38, [0x7F7F, 0xFFFF]),
        ({"type": "float32"}, 1.4013e-45, [0x0000, 0x0001]),
        ({"type": "float64"}, 12.3, [0x4028, 0x9999, 0x9999, 0x999A]),
        ({"type": "bit", "table": "coil"}, 1, [1]),
    ],
)
def test_values_are_encoded_and_decoded(options: dict[str, Any], value: float, registers: list[int]) -> None:
    entry = Entry("winder/force", 0, **options)
    assert entry.size == len(registers)
    assert entry.registers(value) == registers
    assert entry.value(registers) == value


@pytest.mark.parametrize(
    ("options", "value"),
    [
        ({"type": "int16"}, 32768),
        ({"type": "int16"}, 32767.5),
        ({"type": "uint16"}, -1),
        ({"type": "int16", "scale": 0.1}, 3276.8),
        ({"type": "uint32"}, 2**32),
        ({"type": "int64"}, 1e19),
        ({"type": "float32"}, 16777217),  # it would be sent as 16777216
        ({"type": "float32"}, 1e39),
        ({"type": "float64"}, float("inf")),
        ({"type": "float64", "scale": 0.1}, 1e308),  # it would be sent as infinity
        ({"type": "float64"}, "running"),
        ({"type": "float64"}, (1, 2)),
        ({"type": "bit", "table": "coil"}, 2),
    ],
)
def test_a_value_that_does_not_fit_is_an_error(options: dict[str, Any], value: Any) -> None:
    with pytest.raises(ValueError, match="not"):
        Entry("winder/force", 0, **options).registers(value)


def test_a_written_number_that_is_none_is_an_error() -> None:
    with pytest.raises(ValueError, match="nan"):
        Entry("winder/force", 0).value([0x7FC0, 0])
    with pytest.raises(ValueError, match="not within"):
        Entry("winder/force", 0, type="float64", scale=10).value([0x7FEF, 0xFFFF, 0xFFFF, 0xFFFF])


MAP = """
[[registers]]
point = "a/x"
address = 0
type = "int32"
status = 2
[[registers]]
point = "a/on"
table = "coil"
address = 0
"""


def written(folder: Path, text: str) -> str:
    path = folder / "map.toml"
    path.write_text(text)
    return str(path)


def test_a_map_file_is_read(tmp_path: Path) -> None:
    shown = read_map(written(tmp_path, MAP))
    assert shown.entries == (Entry("a/x", 0, type="int32", status=2), Entry("a/on", 0, table="coil", type="bit"))
    assert shown.whole("holding", 0, 3) == [(shown.entries[0], False), (shown.entries[0], True)]


STATUS_AT_0 = MAP.replace("address = 0", "address = 5", 1).replace("status = 2", "status = 0")


def test_a_status_can_have_the_address_0(tmp_path: Path) -> None:
    shown = read_map(written(tmp_path, STATUS_AT_0))
    assert shown.whole("holding", 0, 1) == [(shown.entries[0], True)]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (STATUS_AT_0 + "[[registers]]\npoint = 'a/y'\naddress = 0", "a/y: holding 0 is in use by a/x"),
        ("registers = [", "map.toml: "),
        ("", "there is no [[registers]]"),
        ("registers = 3", "there is no [[registers]]"),
        ("stale = 'no'\n" + MAP, "stale is"),
        ("stale = 'last'\n" + MAP, "a/on: status is missing"),
        ("points = 3\n" + MAP, "there is no key 'points'"),
        (MAP + "adress = 3", "entry 2: there is no key 'adress'"),
        (MAP.replace("point = ", "item = "), "entry 1: there is no key 'item'"),
        (MAP.replace('point = "a/x"', ""), "entry 1: point is missing"),
        (MAP + "type = 'int16'", "entry 2: type is bit"),
        (MAP + "scale = 2", "entry 2: a bit has no scale"),
        (MAP.replace('"int32"', '"int24"'), "entry 1: type is int16"),
        (MAP.replace('"int32"', "true"), "entry 1: type is not a text"),
        (MAP.replace("address = 0", "address = '0'"), "entry 1: address is not a number"),
        (MAP.replace("address = 0", "address = true"), "entry 1: address is not a number"),
        (MAP.replace("address = 0", "address = 0.5"), "entry 1: address is not a number"),
        (MAP.replace("address = 0", "address = -1"), "not within 0 to 65535"),
        (MAP.replace("address = 0", "address = 65535"), "not within 0 to 65535"),
        (MAP.replace("status = 2", "status = 65536"), "not within 0 to 65535"),
        (MAP.replace("status = 2", "status = 1"), "a/x: holding 1 is in use by a/x"),
        (MAP.replace("status = 2", "word_order = 'middle'"), "word_order is big, little"),
        (MAP.replace("status = 2", "byte_order = 'middle'"), "byte_order is big, little"),
        (MAP.replace("status = 2", "scale = 0"), "scale is a number that is not 0"),
        (MAP.replace("status = 2", "scale = nan"), "scale is a number that is not 0"),
        (MAP.replace("coil", "coils"), "entry 2: table is holding, input, coil, discrete"),
        (MAP + "[[registers]]\npoint = 'a/y'\naddress = 1", "a/y: holding 1 is in use by a/x"),
    ],
)
def test_a_wrong_map_file_names_the_file_the_entry_and_the_key(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(InvalidCommand) as raised:
        read_map(written(tmp_path, text))
    assert "map.toml" in str(raised.value)
    assert complaint in str(raised.value)


@pytest.mark.parametrize(("first", "count", "code"), [(0, 1, 3), (1, 1, 3), (1, 2, 3), (0, 4, 2), (3, 1, 2), (2, 2, 2)])
def test_a_part_of_a_value_and_an_address_without_one_are_refused(
    tmp_path: Path, first: int, count: int, code: int
) -> None:
    with pytest.raises(ExceptionReply) as raised:
        read_map(written(tmp_path, MAP)).whole("holding", first, count)
    assert raised.value.code == code


def test_the_automatic_map_keeps_its_addresses_when_points_are_added_behind() -> None:
    before, after = automatic_map(["a", "b"], "float32", False), automatic_map(["a", "b", "c"], "float32", False)
    assert after.entries[:2] == before.entries
    assert [entry.address for entry in after.entries] == [0, 2, 4]
    with_status = automatic_map(["a", "b"], "float32", True)
    assert [(entry.address, entry.status) for entry in with_status.entries] == [(0, 2), (3, 5)]
    full = automatic_map((str(number) for number in range(20_000)), "float64", False)
    assert len(full.entries) == 16384


def test_only_listed_addresses_are_writers() -> None:
    rules = Rules(peers=(ipaddress.ip_network("10.0.0.0/24"), ipaddress.ip_network("fe80::/64")))
    assert [rules.is_writer(peer) for peer in ("10.0.0.7", "::ffff:10.0.0.7", "fe80::1%eth0")] == [True, True, True]
    assert [rules.is_writer(peer) for peer in ("10.0.1.7", "127.0.0.1", "unknown")] == [False, False, False]


# the server


class Echo:
    """Replies to each request at once, and counts those of each unit."""

    def __init__(self) -> None:
        self.counts = {1: 0, 2: 0}

    async def reply(self, _peer: str, unit: int, pdu: bytes) -> bytes:
        self.counts[unit] += 1
        return pdu


Connect = Callable[..., Awaitable[tuple[asyncio.StreamReader, asyncio.StreamWriter]]]
"""Takes the address from which it connects."""


def with_server(
    story: Callable[[Connect, Echo, list[str]], Awaitable[None]], echo: Echo | None = None, **options: Any
) -> list[tuple[str, str]]:
    """Run a story with a server. Return what it refused."""
    refused: list[tuple[str, str]] = []

    async def run() -> None:
        replies, reports, opened = echo or Echo(), list[str](), list[asyncio.StreamWriter]()
        note: Any = lambda *refusal: refused.append(refusal)  # noqa: E731
        served = ModbusTcpServer(replies, reports.append, note, **options)  # type: ignore[arg-type]

        async def connect(source: str = "127.0.0.1") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
            reader, writer = await asyncio.open_connection(*server.sockets[0].getsockname(), local_addr=(source, 0))
            opened.append(writer)
            return reader, writer

        async with (
            asyncio.timeout(PATIENCE),
            await asyncio.start_server(served.accept, "127.0.0.1", 0, limit=bounds.MOST_GATEWAY_UNREAD) as server,
        ):
            await story(connect, replies, reports)
            for writer in opened:
                writer.transport.abort()
            while served._open:  # noqa: ASYNC110  nothing reports that the last connection has ended
                await asyncio.sleep(0.001)

    asyncio.run(run())
    return refused


async def is_closed(reader: asyncio.StreamReader) -> bool:
    try:
        return await reader.read(1) == b""
    except ConnectionError:
        return True


def test_requests_of_one_segment_are_all_replied_to_in_their_order() -> None:
    async def story(connect: Connect, _echo: Echo, _reports: list[str]) -> None:
        reader, writer = await connect()
        sent = b"".join(frame(READ, transaction=number) for number in range(300))
        for byte in sent[:20]:  # in pieces, too
            writer.write(bytes((byte,)))
            await writer.drain()
        writer.write(sent[20:])
        assert await reader.readexactly(len(sent)) == sent

    with_server(story)


def test_a_client_that_floods_is_served_in_turn_with_the_others() -> None:
    async def story(connect: Connect, echo: Echo, _reports: list[str]) -> None:
        (_, flooder), (reader, writer) = await connect(), await connect()
        flooder.write(600 * frame(READ, unit=1))
        for _ in range(5):
            writer.write(frame(READ, unit=2))
            await reader.readexactly(len(frame(READ)))
        assert echo.counts[2] == 5
        assert echo.counts[1] < 600

    with_server(story)


async def serving_no_line(
    report: Callable[[str], None] = lambda _: None, **options: float
) -> tuple[asyncio.Task[None], str, int]:
    """Start the server over a line that never answers, and return it with its host and port."""

    async def forever() -> None:
        await asyncio.get_running_loop().create_future()

    opened: asyncio.Future[str] = asyncio.get_running_loop().create_future()
    line: Any = SimpleNamespace(follow=forever, on_state=lambda _: None, read_only=False)
    values: Any = SimpleNamespace(run=forever, line=line)
    serving = asyncio.ensure_future(
        modbus_tcp.serve(values, Rules(), ("127.0.0.1", 0), opened.set_result, report, **options)
    )
    host, _, port = (await asyncio.wait_for(opened, PATIENCE)).rpartition(":")
    return serving, host, int(port)


def test_the_end_of_the_server_is_the_end_of_its_connections() -> None:
    """From Python 3.12 on, a server that waits for its clients would not end before they do."""

    async def run() -> None:
        serving, host, port = await serving_no_line()
        async with asyncio.timeout(PATIENCE):
            ends = [await asyncio.open_connection(host, port) for _ in range(2)]
            for reader, writer in ends:
                writer.write(frame(b"\x63"))  # there is no such function
                assert (await reader.readexactly(9))[7:] == b"\xe3\x01"
            serving.cancel()
            with pytest.raises(asyncio.CancelledError):
                await serving
            for reader, writer in ends:
                assert await is_closed(reader)
                writer.transport.abort()
            with pytest.raises(ConnectionRefusedError):
                await asyncio.open_connection(host, port)

    asyncio.run(run())


def test_the_time_without_a_request_is_the_one_that_the_server_is_given() -> None:
    async def run() -> None:
        serving, host, port = await serving_no_line(reports.append, idle=0.05)
        async with asyncio.timeout(PATIENCE):
            reader, writer = await asyncio.open_connection(host, port)
            assert await is_closed(reader)
        writer.transport.abort()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)

    reports: list[str] = []
    asyncio.run(run())
    assert reports == ["Modbus TCP connections closed: 1 (no request for 0.05 s)"]


def test_what_a_server_refuses_is_reported_here_and_to_the_owner(monkeypatch: pytest.MonkeyPatch) -> None:
    refused: list[tuple[str, str]] = []

    class Refusals:
        def __init__(self, interface: str, line: Any, *kinds: str) -> None:
            assert (interface, kinds) == ("modbus-tcp", ("connections", "requests"))

        def note(self, kind: str, peer: str) -> None:
            refused.append((kind, peer))

    async def run() -> None:
        serving, host, port = await serving_no_line(reports.append)
        async with asyncio.timeout(PATIENCE):
            reader, writer = await asyncio.open_connection(host, port)
            writer.write(frame(bytes.fromhex("06 0000 0007")))
            assert (await reader.readexactly(9))[7:] == b"\x86\x01"
            writer.write(frame(READ, protocol=1))
            assert await is_closed(reader)
        writer.transport.abort()
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)

    reports: list[str] = []
    monkeypatch.setattr(modbus_tcp, "ReportedRefusals", Refusals)
    asyncio.run(run())
    assert refused == [("requests", "127.0.0.1"), ("connections", "127.0.0.1")]
    assert [text.partition(",")[0] for text in reports] == [
        "1 write requests of Modbus TCP were refused",
        "Modbus TCP connections closed: 1 (not Modbus TCP)",
    ]


def test_rights_are_of_an_address_and_bounds_and_refusals_of_its_network(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "peer_of", lambda host: f"the network of {host}")
    peers: list[str] = []

    class Noted(Echo):
        async def reply(self, peer: str, unit: int, pdu: bytes) -> bytes:
            peers.append(peer)
            return await super().reply(peer, unit, pdu)

    async def story(connect: Connect, _echo: Echo, _reports: list[str]) -> None:
        reader, writer = await connect()
        writer.write(frame(READ, transaction=0x1234, unit=2))
        assert await reader.readexactly(len(frame(READ))) == frame(READ, transaction=0x1234, unit=2)
        writer.write(frame(READ, protocol=1))
        assert await is_closed(reader)

    assert with_server(story, Noted()) == [("connections", "the network of 127.0.0.1")]
    assert peers == ["127.0.0.1"]


@pytest.mark.parametrize(
    "sent", [frame(READ, protocol=1), frame(READ, length=1), frame(READ, length=255), b"GET / HTTP"]
)
def test_a_bad_frame_closes_the_connection_and_is_counted(sent: bytes) -> None:
    async def story(connect: Connect, _echo: Echo, reports: list[str]) -> None:
        for _ in range(2):
            reader, writer = await connect()
            writer.write(sent)
            assert await is_closed(reader)
        assert reports == ["Modbus TCP connections closed: 1 (not Modbus TCP)"]  # the second is counted for a minute

    with_server(story)


def test_an_idle_client_and_half_a_request_are_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "REQUEST_WITHIN", 0.2)

    async def story(connect: Connect, _echo: Echo, reports: list[str]) -> None:
        (silent, _), (half, writer) = await connect(), await connect()
        writer.write(frame(READ)[:9])
        assert await is_closed(silent)
        assert "no request for 0.05 s" in reports[0]
        assert await is_closed(half)

    refused = with_server(story, idle=0.05)
    assert refused == [("connections", "127.0.0.1")]  # the client that was silent has done no wrong


def test_half_a_request_is_closed_sooner_than_an_idle_client(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "REQUEST_WITHIN", 0.05)

    async def story(connect: Connect, _echo: Echo, reports: list[str]) -> None:
        reader, writer = await connect()
        writer.write(frame(READ) + frame(READ)[:1])
        assert await reader.readexactly(len(frame(READ))) == frame(READ)
        assert await is_closed(reader)
        assert reports == ["Modbus TCP connections closed: 1 (half a request for 0.05 s)"]

    with_server(story)


@pytest.mark.slow
def test_a_client_that_does_not_read_its_replies_is_closed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "GATEWAY_SEND_WITHIN", 0.05)

    class Long(Echo):
        async def reply(self, _peer: str, _unit: int, _pdu: bytes) -> bytes:
            return bytes(5000)  # the system holds some megabytes: a real reply would fill that slowly

    async def story(connect: Connect, _echo: Echo, reports: list[str]) -> None:
        _, writer = await connect()
        with contextlib.suppress(ConnectionError):
            while not reports:
                writer.write(1000 * frame(READ))
                await writer.drain()
        assert "replies not read" in reports[0]

    assert with_server(story, Long()) == [("connections", "127.0.0.1")]


def test_the_time_in_which_a_client_must_read_its_replies_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "GATEWAY_SEND_WITHIN", 0.01)

    class Unread:
        """The end of a client that reads nothing."""

        def __init__(self) -> None:
            self.transport = self
            self.sent: list[bytes] = []
            self.aborted = False

        def get_extra_info(self, _name: str) -> tuple[str, int]:
            return "10.0.0.1", 50_000

        def set_write_buffer_limits(self, high: int) -> None:
            """Have a small buffer."""

        def write(self, data: bytes) -> None:
            self.sent.append(data)

        async def drain(self) -> None:
            await asyncio.get_running_loop().create_future()

        def abort(self) -> None:
            self.aborted = True

    async def run() -> Unread:
        reader, writer = asyncio.StreamReader(), Unread()
        reader.feed_data(2 * frame(READ))
        note: Any = lambda *refusal: refused.append(refusal)  # noqa: E731
        async with asyncio.timeout(PATIENCE):
            await ModbusTcpServer(cast("Any", Echo()), reports.append, note).accept(reader, cast("Any", writer))
        return writer

    reports: list[str] = []
    refused: list[tuple[str, str]] = []
    writer = asyncio.run(run())
    assert (writer.sent, writer.aborted) == ([frame(READ)], True)
    assert reports == ["Modbus TCP connections closed: 1 (replies not read for 0.01 s)"]
    assert refused == [("connections", "10.0.0.1")]


def test_a_client_that_leaves_has_done_no_wrong_wherever_its_request_ends(caplog: pytest.LogCaptureFixture) -> None:
    async def story(connect: Connect, _echo: Echo, reports: list[str]) -> None:
        for sent in (b"", frame(READ)[:3], frame(READ)[:9], frame(READ)):
            reader, writer = await connect()
            writer.write(sent)
            writer.write_eof()
            with contextlib.suppress(ConnectionError):
                assert await reader.read() == (sent if sent == frame(READ) else b"")
        assert reports == []

    assert with_server(story) == []
    assert not caplog.records


def test_connections_are_bounded_in_all_and_for_each_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_PER_PEER", 3)

    async def per_peer(connect: Connect, _echo: Echo, reports: list[str]) -> None:
        opened = [await connect() for _ in range(4)]
        assert await is_closed(opened[3][0])
        opened[0][1].write(frame(READ))
        assert await opened[0][0].readexactly(len(frame(READ))) == frame(READ)
        assert "beyond 3 of one address" in reports[0]

    with_server(per_peer)
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_CONNECTIONS", 2)

    async def total(connect: Connect, _echo: Echo, reports: list[str]) -> None:
        (first, writer), (second, _) = await connect(), await connect()
        writer.write(frame(READ))
        await first.readexactly(len(frame(READ)))
        await connect()
        assert await is_closed(second)  # the first has sent a request since
        assert "idle for the longest time" in reports[0]

    assert with_server(total) == [("connections", "127.0.0.1")]

    async def of_others(connect: Connect, _echo: Echo, _reports: list[str]) -> None:
        (first, _), _ = await connect("127.0.0.2"), await connect("127.0.0.3")
        await connect("127.0.0.4")
        assert await is_closed(first)

    # The address is that of the connection that is closed.
    assert with_server(of_others) == [("connections", "127.0.0.2")]


def test_an_address_with_many_connections_makes_room_and_one_with_few_keeps_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_CONNECTIONS", 3)

    async def story(connect: Connect, _echo: Echo, _reports: list[str]) -> None:
        few, writer = await connect("127.0.0.1")  # idle for the longest time
        many = [(await connect("127.0.0.2"))[0] for _ in range(4)]
        assert [await is_closed(reader) for reader in many[:2]] == [True, True]
        third, _ = await connect("127.0.0.3")
        assert await is_closed(many[2])
        again, _ = await connect("127.0.0.2")  # now each address has one
        assert await is_closed(many[3])
        writer.write(frame(READ))
        assert await few.readexactly(len(frame(READ))) == frame(READ)
        assert not third.at_eof()
        assert not again.at_eof()

    assert with_server(story) == [("connections", "127.0.0.2")] * 4


def test_a_connection_whose_request_is_on_its_way_keeps_its_place(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_CONNECTIONS", 2)
    go_on = asyncio.Event()

    class Slow(Echo):
        async def reply(self, peer: str, unit: int, pdu: bytes) -> bytes:
            reply = await super().reply(peer, unit, pdu)
            await go_on.wait()
            return reply

    async def story(connect: Connect, echo: Echo, _reports: list[str]) -> None:
        busy = [await connect() for _ in range(2)]
        for _, writer in busy:
            writer.write(frame(READ))
        while echo.counts[1] < 2:  # noqa: ASYNC110  nothing reports it
            await asyncio.sleep(0.001)
        beyond, _ = await connect()
        assert await is_closed(beyond)
        go_on.set()
        for reader, _ in busy:
            assert await reader.readexactly(len(frame(READ))) == frame(READ)

    with_server(story, Slow())


def test_an_address_with_many_requests_on_the_line_makes_room_for_another_address(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_CONNECTIONS", 4)
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_PER_PEER", 4)
    go_on = asyncio.Event()

    class Slow(Echo):
        async def reply(self, peer: str, unit: int, pdu: bytes) -> bytes:
            reply = await super().reply(peer, unit, pdu)
            await go_on.wait()
            return reply

    async def story(connect: Connect, echo: Echo, reports: list[str]) -> None:
        async def requesting(source: str) -> asyncio.StreamReader:
            reader, writer = await connect(source)
            writer.write(frame(READ))
            return reader

        many = [await requesting("127.0.0.1") for _ in range(4)]
        while echo.counts[1] < 4:  # noqa: ASYNC110
            await asyncio.sleep(0.001)
        few = [await requesting("127.0.0.2") for _ in range(2)]
        assert [await is_closed(reader) for reader in many[:2]] == [True, True]
        while echo.counts[1] < 6:  # noqa: ASYNC110
            await asyncio.sleep(0.001)
        for source in ("127.0.0.1", "127.0.0.2"):  # neither has two more than the other
            assert await is_closed(await requesting(source))
        go_on.set()
        for reader in (*many[2:], *few):
            assert await reader.readexactly(len(frame(READ))) == frame(READ)
        assert "one of the address with the most" in reports[0]

    with_server(story, Slow())


def test_an_address_with_one_request_more_than_another_keeps_them_all(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_CONNECTIONS", 3)
    go_on = asyncio.Event()

    async def story(connect: Connect, echo: Echo, _reports: list[str]) -> None:
        open_ = []
        for source in ("127.0.0.1", "127.0.0.1", "127.0.0.2"):
            reader, writer = await connect(source)
            writer.write(frame(READ))
            open_.append(reader)
        while echo.counts[1] < 3:  # noqa: ASYNC110  nothing reports it
            await asyncio.sleep(0.001)
        another, _ = await connect("127.0.0.2")
        assert await is_closed(another), "then it would be the address with one more"
        go_on.set()
        for reader in open_:
            assert await reader.readexactly(len(frame(READ))) == frame(READ)

    with_server(story, SlowUnit(go_on))


class SlowUnit(Echo):
    """Unit 1 replies when it may go on."""

    def __init__(self, go_on: asyncio.Event) -> None:
        super().__init__()
        self._go_on = go_on

    async def reply(self, peer: str, unit: int, pdu: bytes) -> bytes:
        reply = await super().reply(peer, unit, pdu)
        if unit == 1:
            await self._go_on.wait()
        return reply


def test_requests_of_replaced_connections_count_as_those_of_their_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_CONNECTIONS", 3)
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_PER_PEER", 2)
    go_on = asyncio.Event()

    async def story(connect: Connect, echo: Echo, _reports: list[str]) -> None:
        for source in ("127.0.0.1", "127.0.0.1", "127.0.0.2"):
            (await connect(source))[1].write(frame(READ, unit=1))
        while echo.counts[1] < 3:  # noqa: ASYNC110  nothing reports it
            await asyncio.sleep(0.001)
        reader, writer = await connect("127.0.0.3")  # replaces one of 127.0.0.1
        writer.write(frame(READ, unit=2))
        await reader.readexactly(len(frame(READ)))
        writer.close()
        await writer.wait_closed()
        beyond, writer = await connect("127.0.0.1")  # there is room, but two of its requests are on the line
        writer.write(frame(READ, unit=2))
        assert await is_closed(beyond)
        go_on.set()

    with_server(story, SlowUnit(go_on))


def test_a_connection_whose_request_was_replied_to_makes_room_for_a_new_one(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_CONNECTIONS", 2)

    async def story(connect: Connect, _echo: Echo, _reports: list[str]) -> None:
        readers = []
        for _ in range(4):
            reader, writer = await connect()
            writer.write(frame(READ))
            assert await reader.readexactly(len(frame(READ))) == frame(READ)
            readers.append(reader)
        assert [await is_closed(reader) for reader in readers[:2]] == [True, True]

    with_server(story)


def test_replaced_connections_no_longer_count_when_their_requests_are_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_CONNECTIONS", 2)
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_PER_PEER", 2)
    go_on = asyncio.Event()

    async def story(connect: Connect, echo: Echo, _reports: list[str]) -> None:
        many = [await connect("127.0.0.1") for _ in range(2)]
        for _, writer in many:
            writer.write(frame(READ, unit=1))
        while echo.counts[1] < 2:  # noqa: ASYNC110  nothing reports it
            await asyncio.sleep(0.001)
        reader, writer = await connect("127.0.0.2")  # replaces one of 127.0.0.1
        writer.write(frame(READ, unit=2))
        await reader.readexactly(len(frame(READ)))
        go_on.set()
        writer.close()
        reader, writer = many[1]
        await reader.readexactly(len(frame(READ)))
        writer.close()
        for _ in range(3):
            reader, writer = await connect("127.0.0.1")
            writer.write(frame(READ, unit=2))
            assert await reader.readexactly(len(frame(READ)))
            writer.close()
            await writer.wait_closed()
        opened = [await connect("127.0.0.1") for _ in range(2)]  # as many as before
        for reader, writer in opened:
            writer.write(frame(READ, unit=2))
            assert await reader.readexactly(len(frame(READ)))

    with_server(story, SlowUnit(go_on))


# the command, beside an owner, by real clients

TEXT = """
title = "Ovens"
port = "PORT?baudrate=115200"
[nodes.oven]
protocol = "modbus"
address = 11
points.setpoint = { item = "holding:0", maximum = 50 }
points.speed = { item = "holding:1", maximum = 50 }
points.temperature = { item = "holding:2" }
points.fan = { item = "coil:2" }
[nodes.kiln]
protocol = "modbus"
address = 12
points.setpoint = { item = "holding:0" }
[groups.fast]
period = 0.02
points = ["oven/setpoint,speed,temperature,fan", "kiln/setpoint"]
"""
REGISTERS = """
[[registers]]
point = "oven/setpoint"
address = 0
type = "int16"
[[registers]]
point = "oven/speed"
address = 1
type = "int16"
[[registers]]
point = "oven/temperature"
address = 2
type = "int32"
[[registers]]
point = "kiln/setpoint"
address = 10
type = "int16"
scale = 0.1
[[registers]]
point = "oven/missing"
address = 20
[[registers]]
point = "oven/fan"
table = "coil"
address = 0
"""


@pytest.fixture
def units() -> Iterator[TcpServer]:
    with serve("modbus", 11, 12) as server:
        yield server


@pytest.fixture
def file(tmp_path: Path, units: TcpServer) -> Path:
    path = tmp_path / "ovens.toml"
    path.write_text(TEXT.replace("PORT", units.path))
    (tmp_path / "map.toml").write_text(REGISTERS)
    return path


class Interface:
    """An interface as a process, and its port. Its standard error is collected by a thread."""

    def __init__(self, *arguments: str) -> None:
        self.text = ""
        self.process: subprocess.Popen[str] = started("modbus-tcp", *arguments, "--bind", "127.0.0.1:0").__enter__()
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        self.port = int(self.await_text(r"serving Modbus TCP at 127\.0\.0\.1:(\d+)")[1])

    def _read(self) -> None:
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.text += line

    def await_text(self, pattern: str) -> re.Match[str]:
        end = time.monotonic() + PATIENCE
        while not (found := re.search(pattern, self.text)):
            assert time.monotonic() < end, self.text
            assert self.process.poll() is None, self.text
            time.sleep(0.01)
        return found

    def close(self) -> None:
        self.process.send_signal(signal.SIGTERM)
        assert self.process.wait(PATIENCE) == 143, self.text
        self._reader.join(PATIENCE)
        self.process.__exit__(None, None, None)


@contextlib.contextmanager
def interface(*arguments: str) -> Iterator[Interface]:
    opened = Interface(*arguments)
    try:
        yield opened
    finally:
        opened.close()


@contextlib.contextmanager
def client_of(opened: Interface) -> Iterator[Any]:
    client: Any = ModbusTcpClient("127.0.0.1", port=opened.port, timeout=PATIENCE, retries=0)
    assert client.connect()
    try:
        yield client
    finally:
        client.close()


def code(reply: Any) -> int:
    """The exception code of a reply, 0 for none."""
    return int(reply.exception_code) if reply.isError() else 0


def eventually(request: Callable[[], Any], wanted: Callable[[Any], bool], allowed: tuple[int, ...] = (11,)) -> Any:
    """The reply to a request that is as wanted; before it there may be these exceptions, but no other value."""
    end = time.monotonic() + PATIENCE
    while not wanted(reply := request()):
        assert code(reply) in allowed, reply
        assert time.monotonic() < end, reply
        time.sleep(0.01)
    return reply


def write(request: Callable[[], Any]) -> None:
    """Write. On a busy machine, a request can reach the owner too late to be sent: the exception 6."""
    eventually(request, lambda reply: not code(reply), allowed=(6,))


@pytest.mark.slow
def test_a_client_that_asks_nothing_for_the_time_of_the_option_is_disconnected(file: Path) -> None:
    with (
        owner("serve", str(file)),
        interface(str(file), "--map", str(file.parent / "map.toml"), "--idle", "1") as opened,
    ):
        with socket.create_connection(("127.0.0.1", opened.port), PATIENCE) as idle:
            assert idle.recv(1) == b""
        opened.await_text("no request for 1 s")


@pytest.mark.slow
def test_points_are_read_and_written_as_the_map_says(file: Path) -> None:
    options = ("--map", str(file.parent / "map.toml"), "--allow", "oven/*", "--allow", "kiln/*")
    with owner("serve", str(file)), interface(str(file), *options) as opened, client_of(opened) as client:
        opened.await_text("the map has 'oven/missing', which is not a point of this line")
        first = eventually(lambda: client.read_holding_registers(0, count=4), lambda reply: not code(reply))
        assert first.registers == [0, 0, 0, 0]
        # a write is confirmed, and the value before it is never read again
        for number in range(1, 20):
            write(lambda number=number: client.write_register(0, number))  # type: ignore[misc]
            eventually(
                lambda: client.read_holding_registers(0, count=1),
                lambda reply, number=number: not code(reply) and reply.registers == [number],  # type: ignore[misc]
            )
        write(lambda: client.write_register(10, 1230))
        eventually(
            lambda: client.read_holding_registers(10), lambda reply: not code(reply) and reply.registers == [1230]
        )
        write(lambda: client.write_registers(2, [0, 1234]))
        write(lambda: client.write_coil(0, True))
        eventually(lambda: client.read_coils(0), lambda reply: not code(reply) and reply.bits[0])
        write(lambda: client.write_coils(0, [False]))
        # what is refused, and why
        assert code(client.write_register(2, 5)) == 3  # a part of a value
        assert code(client.write_registers(2, [1, 0])) == 3  # 65536 is more than the unit's register holds
        assert code(client.write_register(0, 51)) == 3  # beyond the limit
        opened.await_text(r"oven/setpoint = 51: .*above its maximum of 50")
        assert code(client.write_registers(0, [10, 51])) == 3
        opened.await_text("of this request 1 of 2 points were written")
        eventually(lambda: client.read_holding_registers(0), lambda reply: not code(reply) and reply.registers == [10])
        assert code(client.read_holding_registers(2, count=1)) == 3
        assert code(client.read_holding_registers(4)) == 2
        assert code(client.read_input_registers(0)) == 2
        assert code(client.read_holding_registers(20, count=2)) == 10
        assert code(client.read_coils(1)) == 2
        assert code(client.readwrite_registers(read_address=0, read_count=1, address=0, values=[1])) == 1


@pytest.mark.slow
def test_without_allow_nothing_is_written_and_only_what_it_names_otherwise(file: Path) -> None:
    with owner("serve", str(file)):
        with interface(str(file)) as opened, client_of(opened) as client:
            eventually(lambda: client.read_holding_registers(0, count=4), lambda reply: not code(reply))
            assert code(client.write_registers(0, [0, 0, 0, 0])) == 1
            opened.await_text("1 write requests of Modbus TCP were refused")
        options = ("--map", str(file.parent / "map.toml"), "--allow", "oven/setpoint")
        with interface(str(file), *options) as opened, client_of(opened) as client:
            eventually(lambda: client.read_holding_registers(0), lambda reply: not code(reply))
            assert code(client.write_register(1, 7)) == 3
            assert code(client.write_registers(0, [7, 7])) == 3  # and not the first of them either
            assert client.read_holding_registers(0).registers == [0]
            assert code(client.write_register(0, 7)) == 0
        elsewhere = ("--allow-from", "10.0.0.0/24")
        with interface(str(file), *options, *elsewhere) as opened, client_of(opened) as client:
            eventually(lambda: client.read_holding_registers(0), lambda reply: not code(reply))
            assert code(client.write_register(0, 8)) == 1


@pytest.mark.slow
def test_a_value_is_not_sent_when_the_owner_stands_still_or_is_gone(file: Path) -> None:
    kept = list(struct.unpack(">2H", struct.pack(">f", 21)))

    def shown(reply: Any) -> list[int] | None:
        if code(reply):
            return None
        assert reply.registers[:2] == kept or reply.registers[2] == 1  # the value before the write is sent as stale
        return list(reply.registers)

    options = ("--type", "float32", "--last", "--allow", "oven/setpoint")
    with interface(str(file), *options) as opened, client_of(opened) as client:
        assert code(client.read_holding_registers(0, count=3)) == 11
        with interface(str(file)) as plain, client_of(plain) as other:
            with owner("serve", str(file)) as (process, _):
                eventually(lambda: other.read_holding_registers(0, count=4), lambda reply: not code(reply))
                eventually(lambda: client.write_registers(0, kept), lambda reply: not code(reply))
                eventually(
                    lambda: client.read_holding_registers(0, count=3),
                    lambda reply: shown(reply) == [*kept, 0],
                    (0, 11),
                )
                os.kill(process.pid, signal.SIGSTOP)
                try:
                    eventually(lambda: other.read_holding_registers(0, count=4), lambda reply: code(reply) == 11, (0,))
                    eventually(
                        lambda: client.read_holding_registers(0, count=3), lambda reply: reply.registers[2] == 1, (0,)
                    )
                finally:
                    os.kill(process.pid, signal.SIGCONT)
                eventually(lambda: other.read_holding_registers(0, count=4), lambda reply: not code(reply))
            eventually(lambda: other.read_holding_registers(0, count=4), lambda reply: code(reply) == 11, (0,))
            eventually(lambda: client.read_holding_registers(2, count=1), lambda reply: reply.registers == [3], (0,))
            for _ in range(20):  # the last value stays for as long as the owner is away
                time.sleep(0.05)
                assert client.read_holding_registers(0, count=3).registers == [*kept, 3]
            with owner("serve", str(file)):
                eventually(lambda: other.read_holding_registers(0, count=4), lambda reply: not code(reply))


@pytest.mark.slow
def test_a_value_of_a_lost_line_is_not_sent(file: Path, units: TcpServer) -> None:
    with owner("serve", str(file)), interface(str(file)) as opened, client_of(opened) as client:
        eventually(lambda: client.read_holding_registers(0, count=4), lambda reply: not code(reply))
        units.close()
        eventually(lambda: client.read_holding_registers(0, count=4), lambda reply: code(reply) == 11, (0,))


@pytest.mark.slow
def test_a_value_of_a_unit_that_has_fallen_silent_is_not_sent(tmp_path: Path) -> None:
    devices = [make_device("modbus", address) for address in (11, 12)]
    line = Line(find("modbus").profile.line, devices, chance=random.Random(1), paced=False)
    path = tmp_path / "ovens.toml"
    with serve_tcp(line) as server:
        path.write_text(TEXT.replace("PORT", server.path))
        with owner("serve", str(path)), interface(str(path)) as opened, client_of(opened) as client:
            eventually(lambda: client.read_holding_registers(16, count=4), lambda reply: not code(reply))
            devices[1].faults = Faults(lost=1.0)
            eventually(lambda: client.read_holding_registers(16, count=4), lambda reply: code(reply) == 11, (0,))
            eventually(lambda: client.read_holding_registers(0, count=4), lambda reply: not code(reply))
            assert code(client.read_holding_registers(0, count=20)) == 11  # one of them is


def test_units_are_read_with_the_priority_of_polls_and_written_as_commands() -> None:
    sent: list[tuple[str, str, Priority]] = []

    class Unit:
        async def request(self, command: Any, *, touches: Any, priority: Priority, finish_within: float) -> Any:
            sent.append((str(command), str(touches), priority))
            return (7,)

    line: Any = SimpleNamespace(
        is_connected=True,
        read_only=False,
        picture=SimpleNamespace(nodes={("modbus", 3): None}),
        remote=SimpleNamespace(find=lambda _protocol, _unit: Unit()),
    )

    async def run() -> None:
        rules = Rules(units=frozenset((3,)), pass_through=True)
        answers = Answers(Values(line), rules, lambda _: None)
        assert await answers.reply("127.0.0.1", 3, READ) == bytes.fromhex("03 02 0007")
        for pdu in ("06 0000 0007", "0f 0008 0002 01 03"):  # and what they change, so that only that becomes stale
            assert await answers.reply("127.0.0.1", 3, bytes.fromhex(pdu)) == bytes.fromhex(pdu)[:5]

    asyncio.run(run())
    assert sent == [
        ("read holding 0", "None", Priority.POLL),
        ("write holding 0 = 7", "read holding 0", Priority.COMMAND),
        ("write coil 8-9 = 1, 1", "read coil 8-9", Priority.COMMAND),
    ]


def test_an_address_has_few_requests_on_the_line_and_does_not_delay_another(monkeypatch: pytest.MonkeyPatch) -> None:
    on_line: list[int] = []
    times: list[float] = []
    most = 0

    class Unit:
        async def request(self, command: Any, *, finish_within: float, **_options: Any) -> Any:
            nonlocal most
            times.append(finish_within)
            on_line.append(command.first)
            most = max(most, len(on_line))
            await go_on.wait()
            on_line.remove(command.first)
            return (command.first,)

    line: Any = SimpleNamespace(
        is_connected=True,
        picture=SimpleNamespace(nodes={("modbus", 3): None}),
        remote=SimpleNamespace(find=lambda _protocol, _unit: Unit()),
    )

    async def run() -> list[bytes]:
        answers = Answers(Values(line), Rules(pass_through=True), lambda _: None)

        def reading(peer: str, first: int) -> asyncio.Future[bytes]:
            return asyncio.ensure_future(answers.reply(peer, 3, b"\x03" + struct.pack(">HH", first, 1)))

        many = [reading("10.0.0.1", first) for first in range(10)]
        await asyncio.sleep(0)
        assert on_line == [0, 1, 2, 3]
        another = reading("10.0.0.2", 99)
        await asyncio.sleep(0)
        assert on_line == [0, 1, 2, 3, 99]
        monkeypatch.setattr(modbus_tcp, "FINISH_WITHIN", 0.0)
        assert await reading("10.0.0.1", 50) == b"\x83\x06"  # its time is over before its turn
        go_on.set()
        return await asyncio.gather(*many, another)

    go_on = asyncio.Event()
    replies = asyncio.run(run())
    assert [reply[-1] for reply in replies] == [*range(10), 99]
    assert most == 5
    assert all(0 < left < 3.0 for left in times), "the wait for the turn counts"


def test_the_addresses_of_an_ipv6_network_have_few_requests_on_the_line_together() -> None:
    on_line: list[int] = []
    go_on = asyncio.Event()

    class Unit:
        async def request(self, command: Any, **_options: Any) -> Any:
            on_line.append(command.first)
            await go_on.wait()
            return (command.first,)

    line: Any = SimpleNamespace(
        is_connected=True,
        picture=SimpleNamespace(nodes={("modbus", 3): None}),
        remote=SimpleNamespace(find=lambda _protocol, _unit: Unit()),
    )

    async def run() -> None:
        answers = Answers(Values(line), Rules(pass_through=True), lambda _: None)
        peers = [f"2001:db8::{number}" for number in range(1, 9)]
        replies = [
            asyncio.ensure_future(answers.reply(peer, 3, b"\x03" + struct.pack(">HH", first, 1)))
            for first, peer in enumerate([*peers, "2001:db8:0:1::1"])
        ]
        await asyncio.sleep(0)
        assert on_line == [*range(bounds.MOST_GATEWAY_ON_LINE), 8]
        go_on.set()
        await asyncio.gather(*replies)

    asyncio.run(run())


@contextlib.asynccontextmanager
async def serving_at(host: str, owner: Owner) -> AsyncIterator[str]:
    """Serve a line that is followed by no connection, and yield the address."""
    line = connected(owner)
    opened: asyncio.Queue[str] = asyncio.Queue()

    async def follow() -> None:
        await asyncio.Event().wait()

    line.follow = follow  # type: ignore[method-assign,assignment]  # replaced here
    values = values_of(line, row_of("1"))
    serving = asyncio.ensure_future(modbus_tcp.serve(values, Rules(), (host, 0), opened.put_nowait, lambda _: None))
    try:
        async with asyncio.timeout(PATIENCE):
            yield await opened.get()
    finally:
        serving.cancel()
        await asyncio.gather(serving, return_exceptions=True)


def test_refused_writes_and_connections_of_the_server_are_reported_to_the_owner(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(reported_refusals, "REPORT_EVERY", 0.0)
    monkeypatch.setattr(modbus_tcp, "MOST_GATEWAY_PER_PEER", 1)
    reported: asyncio.Queue[tuple[str, str, dict[str, int]]] = asyncio.Queue()

    class Told(Owner):
        def report_refusals(self, interface: str, kind: str, peers: Any) -> None:
            reported.put_nowait((interface, kind, dict(peers)))

    async def story() -> list[tuple[str, str, dict[str, int]]]:
        found = []
        async with serving_at("127.0.0.1", Told()) as address:
            port = int(address.rpartition(":")[2])
            reader, writer = await asyncio.open_connection("127.0.0.1", port)
            writer.write(frame(bytes.fromhex("06 0000 0007"), unit=1))
            assert (await reader.readexactly(9))[-2:] == bytes.fromhex("86 01")
            found.append(await reported.get())
            _, beyond = await asyncio.open_connection("127.0.0.1", port)
            found.append(await reported.get())
            for one in (writer, beyond):
                one.close()
        return found

    assert asyncio.run(story()) == [
        ("modbus-tcp", "requests", {"127.0.0.1": 1}),
        ("modbus-tcp", "connections", {"127.0.0.1": 1}),
    ]


@pytest.mark.skipif(not has_ipv6(), reason="this machine has no IPv6")
def test_an_ipv6_address_is_reported_in_brackets() -> None:
    async def story() -> str:
        async with serving_at("::1", Owner()) as address:
            return address

    assert re.fullmatch(r"\[::1\]:\d+", asyncio.run(story()))


@pytest.mark.slow
def test_requests_are_passed_through_to_units_and_several_clients_get_their_own_replies(file: Path) -> None:
    with (
        owner("serve", str(file)),
        interface(str(file), "--pass-through", "--allow-unit", "11") as opened,
        client_of(opened) as client,
    ):
        allowed = (10, 11)  # the nodes of the line are not known yet
        eventually(
            lambda: client.read_holding_registers(100, count=9, device_id=11), lambda one: not code(one), allowed
        )
        assert code(client.write_registers(100, list(range(100, 125)), device_id=11)) == 0
        assert code(client.write_register(125, 125, device_id=11)) == 0
        assert code(client.write_coils(10, [True, False, True], device_id=11)) == 0
        assert client.read_coils(10, count=3, device_id=11).bits[:3] == [True, False, True]
        assert client.read_discrete_inputs(0, count=3, device_id=11).bits[:3] == [False, False, False]
        assert client.read_input_registers(0, count=2, device_id=12).registers == [0, 0]
        assert code(client.read_holding_registers(999, count=2, device_id=11)) == 2  # of the unit
        assert code(client.write_register(100, 1, device_id=12)) == 3
        assert code(client.read_holding_registers(0, device_id=13)) == 10
        for number in range(1, 6):  # a point that reads what was written is stale until it is read again
            assert code(client.write_register(2, number, device_id=11)) == 0
            eventually(
                lambda: client.read_holding_registers(8, count=4, device_id=255),
                lambda one, number=number: one.registers == list(struct.unpack(">4H", struct.pack(">d", number))),  # type: ignore[misc]
            )
        opened.await_text(r"unit 11, 25 from holding 100: written")
        wrong: list[Any] = []

        def read(offset: int) -> None:
            with client_of(opened) as own:
                for number in range(100):
                    first = 100 + (number * 7 + offset) % 20
                    reply = own.read_holding_registers(first, count=4, device_id=11)
                    if code(reply) or reply.registers != list(range(first, first + 4)):
                        wrong.append((first, reply))

        threads = [threading.Thread(target=read, args=(offset,)) for offset in range(3)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(PATIENCE)
        assert wrong == []


@pytest.mark.slow
def test_a_unit_that_does_not_reply_is_exception_11(file: Path) -> None:
    text = file.read_text().replace("address = 12", "address = 13")
    file.write_text(text)
    with owner("serve", str(file)), interface(str(file), "--pass-through") as opened, client_of(opened) as client:
        eventually(lambda: client.read_holding_registers(0, device_id=11), lambda one: not code(one), (10, 11))
        assert code(client.read_holding_registers(0, device_id=13)) == 11


@pytest.mark.slow
def test_hostile_bytes_do_not_disturb_another_client(file: Path) -> None:
    with owner("serve", str(file)), interface(str(file)) as opened, client_of(opened) as client:
        eventually(lambda: client.read_holding_registers(0, count=4), lambda reply: not code(reply))
        for number in range(200):
            with socket.create_connection(("127.0.0.1", opened.port), timeout=PATIENCE) as hostile:
                hostile.sendall(bytes((number * 7 + place * 13) % 256 for place in range(number)))
        assert code(client.read_holding_registers(0, count=4)) == 0
        assert opened.process.poll() is None


def test_the_map_is_printed_as_csv(file: Path, busmaster: Command) -> None:
    with owner("serve", str(file)):
        printed = busmaster("modbus-tcp", str(file), "--print-map", "--allow", "oven/s*")
    assert printed.status == 0, printed.err
    assert printed.lines[:3] == [
        "table,address,registers,type,word_order,byte_order,scale,status,point,unit,write",
        "holding,0,4,float64,big,big,1,,oven/setpoint,,yes",
        "holding,4,4,float64,big,big,1,,oven/speed,,yes",
    ]
    assert printed.lines[5] == "holding,16,4,float64,big,big,1,,kiln/setpoint,,no"


def test_the_map_of_a_line_that_does_not_run_is_not_waited_for() -> None:
    line = Following(lambda: "unix:/nobody")

    async def follow(*, patient: bool = True) -> None:
        raise LineDown("nobody is there") if not patient else AssertionError("it would wait")

    line.follow = follow  # type: ignore[method-assign]  # replaced here
    with pytest.raises(ExceptionGroup) as raised:
        asyncio.run(modbus_tcp.map_text(Values(line), ()))
    assert [type(error) for error in raised.value.exceptions] == [LineDown]


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("--read-only", "--allow", "*"), "--allow and --read-only exclude each other"),
        (("--bind", "0.0.0.0:0", "--allow", "*"), "needs --allow-from"),
        (("--bind", "0.0.0.0:0", "--pass-through", "--allow-unit", "3"), "needs --allow-from"),
        (("--allow-unit", "3"), "needs --pass-through"),
        (("--allow", "*", "--allow-from", "here"), "--allow-from: 'here'"),
        (("--allow-from", "10.0.0.1"), "--allow-from needs points that may be written"),
        (("--map", "absent.toml"), "absent.toml"),
        (("--map", __file__), "test_modbus_tcp.py: "),
        (("--map", __file__, "--last"), "--type and --last are for the automatic map"),
        (("--bind", "here"), "--bind: a TCP address is written HOST:PORT"),
    ],
)
def test_wrong_usage_is_an_error(busmaster: Command, arguments: tuple[str, ...], complaint: str) -> None:
    ran = busmaster("modbus-tcp", "ovens", *arguments)
    assert ran.status in (1, 2)
    assert complaint in ran.err


def test_a_map_without_points_has_no_addresses() -> None:
    with pytest.raises(ExceptionReply):
        RegisterMap().whole("holding", 0, 1)


# the values, beside an owner that the test plays


class Group:
    """A poll group of an owner: its cycles are what the test puts into a queue."""

    def __init__(self) -> None:
        self.cycles: asyncio.Queue[Snapshot | Exception] = asyncio.Queue()
        self.subscriptions = 0
        self.closes = 0
        self.dropped = 0

    def __aiter__(self) -> Group:
        self.subscriptions += 1
        return self

    async def __anext__(self) -> Snapshot:
        found = await self.cycles.get()
        if isinstance(found, Exception):
            raise found
        return found

    def close(self) -> None:
        self.closes += 1


class Owner(Remote):
    """The bus of an owner, with its clock and poll groups."""

    def __init__(self, now: float = 100.0) -> None:
        super().__init__(now)
        self.groups: dict[str, Group] = {}

    def group(self, name: str) -> Group:
        return self.groups.setdefault(name, Group())


def values_of(line: Following, *rows: Row, **options: Any) -> Values:
    """The values of a line that has these points."""
    show(line, *rows)
    return Values(line, **options)


def show(line: Following, *rows: Row) -> None:
    line.picture._rows = {0: list(rows)}
    line.picture.frame = shown_frame(points=len(rows))


def read_cycle(*values: Any, at: float = 100.0, quality: Quality = Quality.GOOD) -> Snapshot:
    """A cycle of the elements 1, 2, ... of node 5, requested at `at`."""
    snapshot = cycle(1, *values, at=at)
    samples = {
        point: sample if sample.error else sample._replace(quality=quality)
        for point, sample in snapshot.samples.items()
    }
    return replace(snapshot, samples=samples)


def row_of(item: str, group: str = "axes", **given: Any) -> Row:
    return row(item=item, group=group, key=f"winder/{item}", **given)


async def look(values: Values) -> None:
    """Have the values look at the line, and its cycles arrive."""
    await values._look()
    for _ in range(5):
        await asyncio.sleep(0)


async def story_of_values() -> None:
    owner = Owner()
    line = connected(owner)
    values = values_of(line, row_of("1"), row_of("2"), row_of("3"))
    assert values.look_up(["winder/1"]) == {"winder/1": (None, 3)}
    await look(values)
    assert values.known.is_set()
    group = owner.groups["axes"]
    assert values.look_up(["winder/1"]) == {"winder/1": (None, 4)}
    group.cycles.put_nowait(read_cycle(1.5, NoReply("no reply"), 3.5))
    await look(values)
    keys = ["winder/1", "winder/2", "winder/3", "winder/9"]
    assert values.look_up(keys) == dict(zip(keys, [(1.5, 0), (None, 4), (3.5, 0), (None, 4)], strict=True))
    # a value that could not be read any more, and one behind it
    group.cycles.put_nowait(read_cycle(NoReply("no reply"), 2.5, 4.5, at=101.0))
    await look(values)
    assert values.look_up(keys[:3]) == {"winder/1": (1.5, 2), "winder/2": (2.5, 0), "winder/3": (4.5, 0)}
    group.cycles.put_nowait(read_cycle(1.5, 2.5, at=102.0, quality=Quality.STALE))
    await look(values)
    assert values.look_up(keys[:3]) == {"winder/1": (1.5, 1), "winder/2": (2.5, 1), "winder/3": (4.5, 0)}
    # a write to the second, and then one that its owner does not name
    group.cycles.put_nowait(read_cycle(1.0, 2.0, 3.0, at=103.0))
    await look(values)
    values._receive_touched({"protocol": "hcp2", "address": 5, "when": 103.5, "items": ["2"], "all": False})
    assert [status for _, status in values.look_up(keys[:3]).values()] == [0, 1, 0]
    # cycles that do not come any more
    owner.time = 105.0
    assert [status for _, status in values.look_up(keys[:3]).values()] == [1, 1, 1]
    owner.time = 103.1
    # a line that is lost: values that were read before are of no use
    line.picture.frame = shown_frame(points=3, now=103.0, state="offline")
    assert [status for _, status in values.look_up(keys[:3]).values()] == [3, 3, 3]
    group.cycles.put_nowait(read_cycle(1.0, at=104.0))
    await look(values)
    assert [status for _, status in values.look_up(keys[:3]).values()] == [0, 3, 3]
    # an owner that is away, and another one with another clock
    line.state = Lost("gone")
    assert values.look_up(keys) == dict(zip(keys, [(1.0, 3), (2.0, 3), (3.0, 3), (None, 3)], strict=True))
    line._remote = None
    await look(values)
    assert values.look_up(keys[:1]) == {"winder/1": (1.0, 3)}
    again = Owner(7.0)
    line._remote, line.state = cast("Any", again), Connected({"read_only": False})
    show(line, row_of("1"), row_of("2"))
    await look(values)
    assert values.look_up(keys[:2]) == {"winder/1": (None, 4), "winder/2": (None, 4)}
    again.groups["axes"].cycles.put_nowait(read_cycle(1.0, 2.0, at=7.0))
    await look(values)
    assert values.look_up(keys[:2]) == {"winder/1": (1.0, 0), "winder/2": (2.0, 0)}, "no write is known of this owner"
    await values._groups.leave()


def test_a_value_has_the_status_of_its_read_its_group_its_line_and_its_owner() -> None:
    asyncio.run(story_of_values())


def test_a_value_is_of_the_time_of_its_request() -> None:
    async def story() -> None:
        owner = Owner()
        values = values_of(connected(owner), row_of("1"))
        await look(values)
        snapshot = read_cycle(1.0)
        [(point, sample)] = snapshot.samples.items()
        later = {point: sample._replace(started=100.0, finished=100.4)}
        owner.groups["axes"].cycles.put_nowait(replace(snapshot, samples=later))
        await look(values)
        values._receive_touched({"protocol": "hcp2", "address": 5, "when": 100.2, "items": ["1"], "all": False})
        assert values.look_up(["winder/1"]) == {"winder/1": (1.0, 1)}, "the write ended while it was read"
        await values._groups.leave()

    asyncio.run(story())


def test_a_point_of_two_groups_has_the_values_of_the_first_and_a_group_that_has_gone_leaves_none(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(followed_groups, "ASK_AGAIN", 0.0)

    async def story() -> None:
        owner = Owner()
        line = connected(owner)
        values = values_of(line, row_of("1", "fast"), row_of("1", "slow", writable=True), row_of("2", "slow"))
        await look(values)
        assert not values.rows["winder/1"].writable
        owner.groups["fast"].cycles.put_nowait(read_cycle(1.0))
        await look(values)
        owner.groups["slow"].cycles.put_nowait(read_cycle(2.0, 3.0))
        await look(values)
        assert values.look_up(["winder/1", "winder/2"]) == {"winder/1": (1.0, 0), "winder/2": (3.0, 0)}
        # a group that ends is requested again; its values get old meanwhile
        owner.groups["slow"].cycles.put_nowait(LineDown("closed"))
        await look(values)
        await look(values)
        assert (owner.groups["slow"].subscriptions, owner.groups["slow"].closes) == (2, 1)
        assert values.look_up(["winder/2"]) == {"winder/2": (3.0, 0)}
        # the group has gone, and its points are of another one
        show(line, row_of("1", "fast"), row_of("2", "other"))
        values._receive("rows", {})
        await look(values)
        assert values.look_up(["winder/1", "winder/2"]) == {"winder/1": (1.0, 0), "winder/2": (None, 4)}
        owner.groups["other"].cycles.put_nowait(read_cycle(1.0, 7.0))
        await look(values)
        assert values.look_up(["winder/2"]) == {"winder/2": (7.0, 0)}
        await values._groups.leave()
        assert all(group.subscriptions == group.closes for group in owner.groups.values())

    asyncio.run(story())


def test_points_keep_their_addresses_and_what_has_none_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    async def story() -> None:
        warnings: list[str] = []
        line = connected(Owner())
        values = values_of(line, row_of("1"), row_of("2"), type_="float32", warn=warnings.append)
        await look(values)
        show(line, row_of("0"), row_of("1"), row_of("3"))
        line.picture.frame = shown_frame(points=4)  # a part of the rows is still to come
        values._receive("rows", {})
        await look(values)
        assert [entry.point for entry in values.map.entries] == ["winder/1", "winder/2"]
        assert warnings == []
        line.picture.frame = shown_frame(points=3)
        await look(values)
        found = {entry.point: entry.address for entry in values.map.entries}
        assert found == {"winder/1": 0, "winder/2": 2, "winder/0": 4, "winder/3": 6}
        assert [text.partition(":")[0] for text in warnings] == ["the points have changed"]
        monkeypatch.setattr(modbus_tcp, "ADDRESSES", 8)
        show(line, *(row_of(str(number)) for number in range(6)))
        values._receive("rows", {})
        await look(values)
        assert len(values.map.entries) == 4
        assert warnings[-1] == "2 points have no address: 65536 are in use"
        await values._groups.leave()

    asyncio.run(story())


def test_every_entry_of_the_map_that_is_no_point_is_reported() -> None:
    async def story() -> None:
        warnings: list[str] = []
        fixed = RegisterMap.of([Entry(f"winder/{item}", 4 * number) for number, item in enumerate("123")], False)
        values = values_of(connected(Owner()), row_of("2"), fixed=fixed, warn=warnings.append)
        await look(values)
        assert [text.split()[3] for text in warnings] == ["'winder/1',", "'winder/3',"]
        assert values.map is fixed
        await values._groups.leave()

    asyncio.run(story())


def test_the_values_follow_each_change_of_the_line_at_once_until_they_are_cancelled(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(modbus_tcp, "LOOK_EVERY", PATIENCE)

    async def story() -> None:
        owner = Owner()
        line = connected(owner)
        values = values_of(line, row_of("1"))
        running = asyncio.ensure_future(values.run())
        async with asyncio.timeout(PATIENCE):
            await values.known.wait()
            owner.groups["axes"].cycles.put_nowait(read_cycle(1.0))
            while values.look_up(["winder/1"]) != {"winder/1": (1.0, 0)}:  # noqa: ASYNC110  nothing reports it
                await asyncio.sleep(0)
        line._receive_touched({"protocol": "hcp2", "address": 5, "when": 100.2, "items": ["1"], "all": False})
        assert values.look_up(["winder/1"]) == {"winder/1": (1.0, 1)}
        show(line, row_of("1"), row_of("2"))
        for method, points in (("rows", 3), ("frame", 2)):  # a part of the rows is still to come
            assert "winder/2" not in values.rows
            line.picture.frame = shown_frame(points=points)
            for receive in list(line._listeners):
                receive(method, {})
            for _ in range(5):
                await asyncio.sleep(0)
        assert "winder/2" in values.rows
        line._remote = None
        line._change(Lost("gone"))
        for _ in range(20):
            await asyncio.sleep(0)
        assert owner.groups["axes"].closes == 1
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
        assert (line._listeners, line._watchers, line._touch_listeners) == ([], [], [])
        assert owner.groups["axes"].closes == 1

    asyncio.run(story())


# the replies, with values that the test gives


class Given:
    """The values of a line, and the writes to it."""

    def __init__(self, shown: RegisterMap, **values: tuple[Any, int]) -> None:
        self.map = shown
        self.rows = {f"a/{name}": row(item=name, key=f"a/{name}", writable=name != "fixed") for name in values}
        self.known = asyncio.Event()
        self.known.set()
        self.line = self
        self.is_connected = True
        self.read_only = False
        self.picture = SimpleNamespace(nodes={("modbus", 3): None})
        self.remote = self
        self.writes: list[tuple[str, str, Any]] = []
        self.error: Exception | None = None
        self.requests: list[str] = []
        self._values = values

    def look_up(self, keys: Any) -> dict[str, tuple[Any, int]]:
        return {key: self._values.get(key.removeprefix("a/"), (None, 4)) for key in keys}

    async def write(self, group: str, key: str, value: Any) -> None:
        if self.error is not None and self.writes:
            raise self.error
        self.writes.append((group, key, value))

    def find(self, _protocol: str, unit: int) -> Any:
        assert unit == 3
        return self

    async def request(self, command: Any, **_options: Any) -> Any:
        self.requests.append(str(command))
        if self.error is not None:
            raise self.error
        return (1, 0)


ENTRIES = (
    Entry("a/x", 0, type="int16", status=1),
    Entry("a/y", 2, type="int32", status=4),
    Entry("a/fixed", 5, type="int16"),
    Entry("a/gone", 6, type="int16"),
    Entry("a/on", 0, table="coil", type="bit", status=1),
    Entry("a/off", 0, table="discrete", type="bit", status=1),
)


def answering(last: bool = False, **rules: Any) -> tuple[Given, Callable[..., bytes], list[str], list[tuple[str, str]]]:
    """Values, the reply to a request for them, the reports and the refusals."""
    entries = [entry for entry in ENTRIES if entry.status is not None or not last]
    given = Given(RegisterMap.of(entries, last), x=(5, 0), y=(-2, 1), fixed=(1, 0), on=(1, 0), off=(0, 2), bad=(1, 0))
    reports: list[str] = []
    refused: list[tuple[str, str]] = []

    def reply(pdu: str, unit: int = 1, peer: str = "127.0.0.1") -> bytes:
        async def run() -> bytes:
            answers = Answers(cast("Values", given), Rules(**rules), reports.append, lambda *what: refused.append(what))
            return await answers.reply(peer, unit, bytes.fromhex(pdu))

        return asyncio.run(run())

    return given, reply, reports, refused


@pytest.mark.parametrize(
    ("pdu", "last", "reply"),
    [
        ("03 0000 0001", False, "03 02 0005"),
        ("03 0000 0002", False, "03 04 0005 0000"),
        ("03 0001 0001", False, "03 02 0000"),
        ("03 0002 0002", False, "83 0b"),  # its value is stale
        ("03 0002 0002", True, "03 04 ffff fffe"),
        ("03 0002 0003", True, "03 06 ffff fffe 0001"),
        ("03 0004 0001", False, "03 02 0001"),
        ("03 0006 0001", False, "83 0a"),  # it is not a point of the line
        ("01 0000 0002", False, "01 01 01"),
        ("02 0001 0001", False, "02 01 01"),  # a status bit is 0 or 1
        ("02 0000 0001", False, "82 0b"),
        ("04 0000 0001", False, "84 02"),
    ],
)
def test_a_value_that_is_not_current_is_only_sent_where_its_status_is(pdu: str, last: bool, reply: str) -> None:
    _, answer, _, _ = answering(last)
    assert answer(pdu) == bytes.fromhex(reply)


def test_a_value_that_does_not_fit_its_registers_is_a_failure_and_no_map_is_no_reply() -> None:
    given, answer, _, _ = answering()
    given._values["x"] = (40_000, 0)
    assert answer("03 0000 0001") == bytes.fromhex("83 04")
    given.known.clear()  # the points are not known yet: the map may have more
    assert answer("03 0006 0001") == bytes.fromhex("83 0b")
    given.map = RegisterMap()
    assert answer("03 0000 0001") == bytes.fromhex("83 0b")


@pytest.mark.parametrize(
    ("pdu", "reply", "written"),
    [
        ("06 0000 0007", "06 0000 0007", [("a/x", 7)]),
        ("10 0002 0002 04 ffff fffe", "10 0002 0002", [("a/y", -2)]),
        ("05 0000 ff00", "05 0000 ff00", [("a/on", 1)]),
        ("06 0001 0007", "86 03", []),  # a status
        ("06 0005 0007", "86 03", []),  # a point that cannot be written
        ("06 0006 0007", "86 0a", []),  # no point of the line
        ("10 0000 0002 04 0007 0007", "90 03", []),
    ],
)
def test_a_write_has_the_values_of_whole_points_that_may_be_written(
    pdu: str, reply: str, written: list[tuple[str, int]]
) -> None:
    given, answer, reports, _ = answering(allow=("a/x", "a/*"))
    assert answer(pdu) == bytes.fromhex(reply)
    assert given.writes == [("axes", *one) for one in written]
    lines = [f"client 127.0.0.1: {key} = {value}: written" for key, value in written]
    assert [text for text in reports if "written" in text] == lines


def test_of_several_points_in_one_request_each_gets_its_own_registers_and_an_error_says_how_many_were_written() -> None:
    given, answer, reports, _ = answering(allow=("a/*",))
    given.map = RegisterMap.of([Entry("a/x", 0, type="int16"), Entry("a/y", 1, type="int32")], False)
    assert answer("10 0000 0003 06 0007 0001 0000") == bytes.fromhex("10 0000 0003")
    assert given.writes == [("axes", "a/x", 7), ("axes", "a/y", 65536)]
    given.writes.clear()
    given.error = WriteUnconfirmed("no reply")
    assert answer("10 0000 0003 06 0007 0001 0000") == bytes.fromhex("90 0b")
    assert reports[-1].endswith(f"a/y = 65536: {given.error}; of this request 1 of 2 points were written")
    assert answer("06 0000 0007") == bytes.fromhex("86 0b")
    assert reports[-1] == f"client 127.0.0.1: a/x = 7: {given.error}"
    given.is_connected = False
    assert answer("06 0000 0007") == bytes.fromhex("86 0b")


def test_a_write_while_the_owner_of_the_line_is_away_is_no_reply_and_is_not_tried() -> None:
    given, answer, reports, refused = answering(allow=("a/x",))
    given.is_connected = False
    assert answer("06 0000 0007") == bytes.fromhex("86 0b")
    assert (given.writes, reports, refused) == ([], [], [])
    given.is_connected = True
    assert answer("06 0000 0007") == bytes.fromhex("06 0000 0007")
    assert given.writes == [("axes", "a/x", 7)]


def test_a_number_that_cannot_be_written_keeps_the_points_before_it_from_being_written() -> None:
    given, answer, _, refused = answering(allow=("a/*",))
    given.map = RegisterMap.of([Entry("a/x", 0, type="int16"), Entry("a/y", 1, type="float32")], False)
    assert answer("10 0000 0003 06 0007 7fc0 0000") == bytes.fromhex("90 03")  # a NaN
    assert (given.writes, refused) == ([], [])
    assert answer("10 0000 0003 06 0007 3fc0 0000") == bytes.fromhex("10 0000 0003")
    assert given.writes == [("axes", "a/x", 7), ("axes", "a/y", 1.5)]


@pytest.mark.parametrize(
    ("rules", "peer", "code"),
    [
        ({}, "127.0.0.1", 1),
        ({"allow": ("a/y",)}, "127.0.0.1", 3),
        ({"allow": ("a/x",), "peers": (ipaddress.ip_network("10.0.0.0/8"),)}, "127.0.0.1", 1),
        ({"allow": ("a/x",), "peers": (ipaddress.ip_network("10.0.0.0/8"),)}, "10.1.2.3", 0),
        ({"allow": ("a/x",), "units": frozenset((3,))}, "127.0.0.1", 0),
        ({"units": frozenset((3,))}, "127.0.0.1", 1),
        ({}, "2001:db8::7", 1),
        ({"allow": ("a/x",), "peers": (ipaddress.ip_network("2001:db8::7"),)}, "2001:db8::8", 1),
        ({"allow": ("a/x",), "peers": (ipaddress.ip_network("2001:db8::7"),)}, "2001:db8::7", 0),
    ],
)
def test_a_write_that_is_not_allowed_is_refused_counted_and_reported(
    rules: dict[str, Any], peer: str, code: int
) -> None:
    given, answer, reports, refused = answering(**rules)
    assert answer("06 0000 0007", peer=peer) == bytes.fromhex(f"86 {code:02x}" if code else "06 0000 0007")
    assert len(given.writes) == (not code)
    network = "2001:db8::/64" if ":" in peer else peer
    assert refused == ([("requests", network)] if code else [])
    why = "--allow does not name the point, or --allow-from does not include the client"
    refusal = f"1 write requests of Modbus TCP were refused, because {why}: 1 from {network}"
    assert reports == [refusal if code else f"client {peer}: a/x = 7: written"]
    given.read_only = True
    assert answer("06 0000 0007", peer=peer) == bytes.fromhex("86 01")


def test_units_of_the_line_are_written_if_they_are_named_and_their_errors_are_reported() -> None:
    given, answer, reports, refused = answering(pass_through=True, allow=("a/x",), units=frozenset((3,)))
    assert answer("01 0000 0002", unit=3) == bytes.fromhex("01 01 01")
    assert answer("02 0000 0002", unit=3) == bytes.fromhex("02 01 01")
    assert answer("04 0000 0002", unit=3) == bytes.fromhex("04 04 0001 0000")
    assert answer("06 0000 0007", unit=3) == bytes.fromhex("06 0000 0007")
    assert reports == ["client 127.0.0.1: unit 3, 1 from holding 0: written"]
    assert [text.split()[:2] for text in given.requests] == [
        *(["read", "coil"], ["read", "discrete"], ["read", "input"], ["write", "holding"])
    ]
    given.error = Refused("refused: illegal data address")
    assert answer("06 0000 0007", unit=3) == bytes.fromhex("86 02")
    assert reports[-1] == f"client 127.0.0.1: unit 3, 1 from holding 0: {given.error}"
    assert answer("03 0000 0001", unit=4) == bytes.fromhex("83 0a")
    given.error = None
    for own in (0, 255):
        assert answer("03 0000 0001", unit=own) == bytes.fromhex("03 02 0005")
    assert refused == []
    assert answer("06 0000 0007", unit=4) == bytes.fromhex("86 03")
    assert refused == [("requests", "127.0.0.1")]
    given.is_connected = False
    assert answer("03 0000 0001", unit=3) == bytes.fromhex("83 0b")
    _, answer, _, refused = answering(pass_through=True, allow=("a/x",))
    assert answer("06 0000 0007", unit=3) == bytes.fromhex("86 01")
    _, answer, _, _ = answering(units=frozenset((3,)))
    assert answer("03 0000 0001", unit=3) == bytes.fromhex("03 02 0005"), "without pass-through every unit is its own"


def test_the_places_of_an_address_on_the_line_are_free_again_after_errors() -> None:
    given, _, _, _ = answering()
    given.error = NoReply("no reply")

    async def run() -> list[bytes]:
        answers = Answers(cast("Values", given), Rules(pass_through=True), lambda _: None)
        async with asyncio.timeout(PATIENCE):
            waiting = (answers.reply("10.0.0.1", 3, READ) for _ in range(3 * bounds.MOST_GATEWAY_ON_LINE))
            return await asyncio.gather(*waiting)

    assert set(asyncio.run(run())) == {b"\x83\x0b"}


def test_busy_is_what_was_not_sent_because_of_others() -> None:
    for kind in (NotStarted, BacklogFull, Superseded):
        assert code_of(kind("x")) == 6


def test_the_map_as_csv_has_the_unit_of_each_point_and_who_may_write_it() -> None:
    shown = RegisterMap.of(
        [
            Entry("a/x", 0, type="int16", scale=0.1, status=1),
            Entry("a/x", 0, table="input", type="int16"),
            Entry("a/on", 0, table="coil", type="bit"),
            Entry("a/fixed", 2, type="int16"),
            Entry("a/other", 3, type="int16"),
            Entry("a/none", 4, type="int16"),
        ],
        False,
    )
    rows = {f"a/{name}": row(item=name, unit="mm", writable=name != "fixed") for name in ("x", "on", "fixed", "other")}
    lines = modbus_tcp.map_as_csv(shown, rows, ("a/x", "a/on", "a/fixed", "a/none")).splitlines()[1:]
    assert lines == [
        "holding,0,1,int16,big,big,0.1,1,a/x,mm,yes",
        "input,0,1,int16,big,big,1,,a/x,mm,no",
        "coil,0,1,bit,big,big,1,,a/on,mm,yes",
        "holding,2,1,int16,big,big,1,,a/fixed,mm,no",
        "holding,3,1,int16,big,big,1,,a/other,mm,no",
        "holding,4,1,int16,big,big,1,,a/none,,no",
    ]


def test_values_are_rounded_to_registers_and_shown_with_the_digits_that_they_have() -> None:
    assert Entry("a/x", 0, type="int16").registers(2.6) == [3]
    assert Entry("a/x", 0, type="int16").registers(-2.6) == [0xFFFD]
    assert Entry("a/on", 0, type="int16", scale=0.5).registers(True) == [2]
    assert Entry("a/x", 0).value(Entry("a/x", 0).registers(16777215)) == 16777215
    assert type(Entry("a/x", 0).value([0x40E0, 0])) is int  # a point of whole numbers is written 7 and not 7.0
    assert read_reply(1, 8 * [1]) == bytes.fromhex("01 01 ff")
    assert read_reply(2, [0] * 9) == bytes.fromhex("02 02 00 00")
    with pytest.raises(ValueError, match="inf"):
        Entry("a/x", 0).value([0x7F80, 0])
    assert automatic_map(map(str, range(32_768)), "float32", False).entries[-1].address == 65534


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("registers = [1]", "there is no [[registers]]"),
        ("registers = []", "there is no [[registers]]"),
        (MAP.replace("status = 2", "scale = inf"), "scale is a number that is not 0"),
    ],
)
def test_a_map_of_something_else_is_no_map(tmp_path: Path, text: str, complaint: str) -> None:
    with pytest.raises(InvalidCommand, match=re.escape(complaint)):
        read_map(written(tmp_path, text))
    (tmp_path / "map.toml").write_bytes(b"\xff\xfe")
    with pytest.raises(InvalidCommand, match=r"map\.toml: "):
        read_map(str(tmp_path / "map.toml"))
