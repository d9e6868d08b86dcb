"""What OPC UA clients ask for and do not get: what is not supported, and what is beyond a bound."""

from __future__ import annotations

import asyncio
import contextlib
import math
import socket
import struct
from datetime import UTC, datetime
from typing import Any

import opcua
import pytest
from asyncua.ua.ua_binary import nodeid_from_binary
from opcua import ua

from busmaster.app import bounds
from busmaster.app.interfaces import opcua_connections, opcua_sessions
from tests.app.interfaces.opcua_client import OtherClient, other_client
from tests.app.interfaces.test_opcua import Opened, opened
from tests.app.service.lines import until
from tests.patience import PATIENCE

__all__ = ["opened"]
pytestmark = pytest.mark.asyncio(loop_scope="module")
ABSOLUTE, PERCENT = ua.DeadbandType.Absolute, ua.DeadbandType.Percent


def read(
    client: OtherClient, name: str, attribute: Any = ua.AttributeIds.Value, *, age: float = 0, part: str = ""
) -> Any:
    wanted = ua.ReadValueId()
    wanted.NodeId, wanted.AttributeId, wanted.IndexRange = client.node(name).nodeid, attribute, part
    asked = ua.ReadParameters()
    asked.MaxAge = age
    asked.NodesToRead.append(wanted)
    return client.client.uaclient.read(asked)[0]


def monitor(client: OtherClient, names: list[str], kind: Any = None, deadband: float = 0.0) -> list[str]:
    """Create items of a subscription of their own, and return their statuses."""
    subscription = client.client.create_subscription(100, None)
    asked = ua.CreateMonitoredItemsParameters()
    asked.SubscriptionId = subscription.subscription_id
    for name in names:
        item = ua.MonitoredItemCreateRequest()
        item.ItemToMonitor.NodeId, item.ItemToMonitor.AttributeId = client.node(name).nodeid, ua.AttributeIds.Value
        item.MonitoringMode = ua.MonitoringMode.Reporting
        item.RequestedParameters.QueueSize = 1
        if kind is not None:
            filter_ = ua.DataChangeFilter()
            filter_.Trigger = ua.DataChangeTrigger.StatusValue
            filter_.DeadbandType, filter_.DeadbandValue = kind, deadband
            item.RequestedParameters.Filter = filter_
        asked.ItemsToCreate.append(item)
    try:
        return [result.StatusCode.name for result in client.client.uaclient.create_monitored_items(asked)]
    finally:
        subscription.delete()


@pytest.mark.slow
async def test_a_read_that_is_not_supported_is_refused(opened: Opened) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        assert (
            await asyncio.to_thread(read, opened.client, "5/10", part="0:1")
        ).StatusCode.name == "BadIndexRangeInvalid"
        for age in (-1.0, math.nan):
            with pytest.raises(ua.UaStatusCodeError, match="BadMaxAgeInvalid"):
                await asyncio.to_thread(read, opened.client, "5/10", age=age)
        assert (await asyncio.to_thread(read, opened.client, "5/10", age=1000.0)).StatusCode.name == "Good"


@pytest.mark.slow
async def test_a_deadband_that_is_not_supported_is_refused(opened: Opened) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        for kind, deadband, name, status in (
            (PERCENT, 10.0, "5/10", "BadMonitoredItemFilterUnsupported"),
            (ABSOLUTE, -1.0, "5/10", "BadDeadbandFilterInvalid"),
            (ABSOLUTE, math.nan, "5/10", "BadDeadbandFilterInvalid"),
            (ABSOLUTE, math.inf, "5/10", "BadDeadbandFilterInvalid"),
            (ABSOLUTE, 1.0, "Line Connected", "BadFilterNotAllowed"),
            (ABSOLUTE, 1.0, "5/10", "Good"),
            (None, 0.0, "5/10", "Good"),
        ):
            assert await asyncio.to_thread(monitor, opened.client, [name], kind, deadband) == [status], (kind, deadband)


async def test_a_write_that_is_not_supported_is_refused_and_one_beyond_a_limit_is_out_of_range(opened: Opened) -> None:
    async with opened.owned() as line:
        group = line.poll("10")
        group.points[0].limit(minimum=-5, maximum=250)
        await opened.is_("5/10", "Good")
        wanted = ua.WriteValue()
        wanted.NodeId, wanted.AttributeId = opened.client.node("5/10").nodeid, ua.AttributeIds.Value
        wanted.Value = ua.DataValue(ua.Variant(1.0, ua.VariantType.Double))
        wanted.Value.SourceTimestamp = datetime(2026, 1, 1, tzinfo=UTC)
        assert await asyncio.to_thread(opened.client.status_of, wanted) == "BadWriteNotSupported"
        assert line.audit() == []
        assert await opened.write("5/10", 251.0) == "BadOutOfRange"
        assert await opened.write("5/10", -6.0) == "BadOutOfRange"
        for value, kind in ((True, ua.VariantType.Boolean), ("7", ua.VariantType.String)):
            assert await opened.write("5/10", value, kind) == "BadTypeMismatch"
        assert await opened.write("5/10", 250.0) == "Good"


async def test_the_server_says_whose_it_is(opened: Opened) -> None:
    def info() -> list[str]:
        node = opened.client.client.get_node
        names = ("ProductUri", "ManufacturerName", "ProductName", "SoftwareVersion")
        found = [node(getattr(ua.ObjectIds, f"Server_ServerStatus_BuildInfo_{name}")).get_value() for name in names]
        server = opened.client.client.get_endpoints()[0].Server
        return [*found, server.ApplicationUri, server.ProductUri, *node(ua.ObjectIds.Server_ServerArray).get_value()]

    told = await asyncio.to_thread(info)
    assert all("busmaster" in text for text in (*told[:3], *told[4:])), told
    assert told[3][0].isdigit()


async def test_a_waiting_write_does_not_keep_its_client_from_reading(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        go_on, arrived = asyncio.Event(), asyncio.Event()
        write = opened.line.write

        async def held(*what: Any) -> None:
            arrived.set()
            await go_on.wait()
            await write(*what)

        monkeypatch.setattr(opened.line, "write", held)
        waiting = asyncio.create_task(opened.write("5/10", 12.0))
        await arrived.wait()
        assert (await asyncio.to_thread(opened.client.read, "5/10")).status == "Good"
        assert not waiting.done()
        go_on.set()
        assert await waiting == "Good"


async def test_write_requests_beyond_the_bound_are_refused_until_others_have_their_replies(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opcua_connections, "MOST_WAITING_WRITES", 2)
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        go_on, waiting_requests = asyncio.Event(), []
        write = opened.line.write

        async def held(*what: Any) -> None:
            waiting_requests.append(what)
            await go_on.wait()
            await write(*what)

        monkeypatch.setattr(opened.line, "write", held)
        waiting = asyncio.create_task(opened.write("5/10", 1.0))
        await until(lambda: waiting_requests)
        [processor] = [one.processor for one in opened.server.acceptor.clients if one.processor.has_session]
        more = asyncio.create_task(opened.write("5/10", 2.0))
        await until(lambda: processor._writes.qsize() == 1)
        with pytest.raises(ua.UaStatusCodeError, match="BadTooManyOperations"):
            await opened.write("5/10", 3.0)
        go_on.set()
        assert [await waiting, await more] == ["Good", "Good"]
        for number in range(3):
            assert await opened.write("5/10", float(number)) == "Good"
        assert [value for _, _, value in waiting_requests] == [1.0, 2.0, 0.0, 1.0, 2.0], "in their order"


async def test_the_waiting_writes_of_a_client_whose_connection_is_lost_are_not_carried_out(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        go_on, requested = asyncio.Event(), list[float]()
        write = opened.line.write

        async def held(group: str, key: str, value: float) -> None:
            requested.append(value)
            await go_on.wait()
            await write(group, key, value)

        monkeypatch.setattr(opened.line, "write", held)
        known = set(opened.server.acceptor.clients)
        entered = other_client(opened.url)
        client = await asyncio.to_thread(entered.__enter__)
        [connection] = set(opened.server.acceptor.clients) - known
        writing = [asyncio.create_task(asyncio.to_thread(client.write, "5/10", value)) for value in (1.0, 2.0)]
        await until(lambda: connection.processor._writes.qsize() == 1)
        client.client.keepalive.stop()
        processor = connection.processor
        connection.transport.abort()
        await until(lambda: not processor.has_session)
        go_on.set()
        assert await opened.write("5/10", 3.0) == "Good"
        assert (len(requested), requested[-1]) == (2, 3.0)
        assert line.audit() == [("5/10", "written")]
        await asyncio.gather(*writing, return_exceptions=True)
        with contextlib.suppress(Exception):
            await asyncio.to_thread(entered.__exit__, None, None, None)


async def test_a_session_ends_after_the_writes_before_it(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        go_on, begun, closing = asyncio.Event(), asyncio.Event(), asyncio.Event()
        process, write = opcua_connections.Requests.process_message, opened.line.write
        had_session: list[bool] = []
        processors: list[opcua_connections.Requests] = []

        async def noted(processor: opcua_connections.Requests, seqhdr: Any, body: Any) -> bool:
            kind = nodeid_from_binary(body.copy())
            if kind == opcua_connections.OF_THE_SESSION[-1]:
                processors.append(processor)
                closing.set()
            return await process(processor, seqhdr, body)

        async def held(*what: Any) -> None:
            begun.set()
            await go_on.wait()
            had_session.append(processors[0].has_session)
            await write(*what)

        monkeypatch.setattr(opcua_connections.Requests, "process_message", noted)
        monkeypatch.setattr(opened.line, "write", held)
        entered = other_client(opened.url)
        client = await asyncio.to_thread(entered.__enter__)
        waiting = asyncio.create_task(asyncio.to_thread(client.write, "5/10", 12.0))
        await begun.wait()
        leaving = asyncio.create_task(asyncio.to_thread(entered.__exit__, None, None, None))
        await closing.wait()
        for _ in range(20):
            await asyncio.sleep(0)
        go_on.set()
        assert await waiting == "Good"
        await leaving
        assert had_session == [True]


async def test_a_connection_with_many_requests_is_read_again_when_these_have_their_replies(
    opened: Opened, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(opcua_connections, "MOST_QUEUED", 1)
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        [connection] = [one for one in opened.server.acceptor.clients if one.processor.has_session]
        pauses: list[int] = []
        pause = connection.transport.pause_reading

        def noted() -> None:
            pauses.append(connection.messages.qsize())
            pause()

        monkeypatch.setattr(connection.transport, "pause_reading", noted)
        for _ in range(3):
            assert (await asyncio.to_thread(opened.client.read, "5/10")).status == "Good"
        assert len(pauses) >= 3
        assert min(pauses) >= 1


async def test_monitored_items_beyond_the_bounds_are_refused(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        monkeypatch.setattr(opcua_sessions, "MOST_SESSION_ITEMS", 3)
        assert await asyncio.to_thread(monitor, opened.client, ["5/10"] * 4) == [
            *["Good"] * 3,
            "BadTooManyMonitoredItems",
        ]
        monkeypatch.setattr(opcua_sessions, "MOST_ITEMS", 2)
        assert (await asyncio.to_thread(monitor, opened.client, ["5/10"] * 3))[2] == "BadTooManyMonitoredItems"
        monkeypatch.setattr(opcua_sessions, "MOST_OPERATIONS", 2)
        with pytest.raises(ua.UaStatusCodeError, match="BadTooManyOperations"):
            await asyncio.to_thread(monitor, opened.client, ["5/10"] * 3)


def closes(address: tuple[str, int], sent: bytes) -> int:
    """Send bytes, and return how many were taken before the server closed the connection."""
    with socket.create_connection(address, timeout=PATIENCE) as connection:
        taken = 0
        try:
            for begin in range(0, len(sent), 4096):
                connection.sendall(sent[begin : begin + 4096])
                taken += 4096
            while connection.recv(4096):
                pass
        except ConnectionError:
            pass
        return taken


@pytest.mark.parametrize(
    "sent",
    [
        pytest.param(b"HELF" + struct.pack("<I", bounds.LONGEST_OPCUA_HELLO + 1), id="a long Hello"),
        pytest.param(b"MSGF" + struct.pack("<I", 1 << 30) + bytes(100), id="a chunk of 1 GB"),
        pytest.param(b"MSGC" + struct.pack("<III", 32, 0, 0) + bytes(16), id="a message before the channel"),
        pytest.param(b"GET / HTTP/1.1\r\n\r\n", id="another protocol"),
        pytest.param(b"HELF" + struct.pack("<I", 16) + b"\xff" * 8, id="a Hello of something else"),
        pytest.param(b"OPNF" + struct.pack("<I", 64) + b"\xff" * 56, id="a channel of something else"),
    ],
)
async def test_a_message_that_is_too_long_or_out_of_order_ends_its_connection(opened: Opened, sent: bytes) -> None:
    host, _, port = opened.url.removeprefix("opc.tcp://").rstrip("/").rpartition(":")
    await asyncio.to_thread(closes, (host, int(port)), sent)


def hello(receive: int, send: int, url: bytes = b"") -> bytes:
    """A Hello with these sizes of buffers, in bytes."""
    return b"HELF" + struct.pack("<IIIIIIi", 32 + len(url), 0, receive, send, 0, 0, len(url) or -1) + url


@pytest.mark.parametrize(
    ("sent", "acknowledged"),
    [
        pytest.param(hello(65_536, 65_536) * 2, 1, id="a second Hello"),
        pytest.param(hello(8_191, 65_536), 0, id="a client that receives short chunks"),
        pytest.param(hello(65_536, 8_191), 0, id="a client that sends short chunks"),
        pytest.param(hello(8_192, 8_192) * 2, 1, id="the shortest buffers that are taken"),
        pytest.param(
            hello(65_536, 65_536, (bounds.LONGEST_OPCUA_HELLO - 32) * b"x") + hello(65_536, 65_536),
            1,
            id="the longest Hello that is taken",
        ),
    ],
)
async def test_a_second_hello_and_one_with_too_short_buffers_end_the_connection(
    opened: Opened, sent: bytes, acknowledged: int
) -> None:
    host, _, port = opened.url.removeprefix("opc.tcp://").rstrip("/").rpartition(":")

    def received() -> bytes:
        with socket.create_connection((host, int(port)), timeout=PATIENCE) as connection:
            connection.sendall(sent)
            found = b""
            while part := connection.recv(4096):
                found += part
            return found

    assert (await asyncio.to_thread(received)).count(b"ACKF") == acknowledged


async def test_the_reply_to_a_hello_has_the_bounds_of_messages(opened: Opened) -> None:
    host, _, port = opened.url.removeprefix("opc.tcp://").rstrip("/").rpartition(":")

    def received() -> tuple[int, ...]:
        with socket.create_connection((host, int(port)), timeout=PATIENCE) as connection:
            connection.sendall(hello(1 << 24, 1 << 24))
            reply = connection.recv(28, socket.MSG_WAITALL)
            assert reply[:4] == b"ACKF"
            return struct.unpack("<IIII", reply[12:])

    receive, send, message, chunks = await asyncio.to_thread(received)
    assert (receive, send) == (bounds.LONGEST_OPCUA_CHUNK, bounds.LONGEST_OPCUA_CHUNK)
    assert message == bounds.LONGEST_OPCUA_REQUEST
    assert chunks * 8_192 > message > (chunks - 2) * 8_192, "also for a client with the shortest chunks"


async def test_a_message_that_arrives_byte_by_byte_is_one(opened: Opened) -> None:
    host, _, port = opened.url.removeprefix("opc.tcp://").rstrip("/").rpartition(":")

    def received() -> bytes:
        with socket.create_connection((host, int(port)), timeout=PATIENCE) as connection:
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, True)
            for byte in hello(65_536, 65_536):
                connection.send(bytes((byte,)))
            return connection.recv(4)

    assert await asyncio.to_thread(received) == b"ACKF"


async def test_a_message_in_many_chunks_ends_a_connection_without_a_session(opened: Opened) -> None:
    client = opcua.Client(opened.url, timeout=PATIENCE)

    def send() -> None:
        client.connect_socket()
        client.send_hello()
        client.open_secure_channel()
        used = client.uaclient._uasocket
        token, last, size = used._connection.security_token, used._connection._sequence_number, 32_768
        for number in (1, 2, 3):  # a fourth would be the last
            header = struct.pack("<4sIIIII", b"MSGC", size, token.ChannelId, token.TokenId, last + number, 7)
            used._socket.socket.sendall(header + bytes(size - len(header)))

    known = set(opened.server.acceptor.clients)
    await asyncio.to_thread(send)
    others = [one for one in opened.server.acceptor.clients if one not in known]

    def has_kept_all() -> bool:
        return any(
            one.processor and one.processor._connection._incoming_size > 90_000 and not one.transport.is_closing()
            for one in others
        )

    await until(lambda: has_kept_all() or not client.uaclient._uasocket._thread.is_alive())
    assert not has_kept_all()
    await asyncio.to_thread(client.disconnect_socket)


async def test_the_pause_after_which_a_session_ends_is_bounded(opened: Opened) -> None:
    def revised(wanted: float) -> float:
        client = opcua.Client(opened.url, timeout=PATIENCE)
        client.session_timeout = wanted
        client.connect()
        try:
            return float(client.session_timeout)
        finally:
            client.disconnect()

    most = 1000 * bounds.LONGEST_SESSION_PAUSE
    assert await asyncio.to_thread(revised, 3_600_000) == most
    assert await asyncio.to_thread(revised, most - 1) == most - 1


async def test_a_second_session_of_a_connection_ends_the_first_with_its_subscriptions(opened: Opened) -> None:
    service = opened.server.iserver.subscription_service

    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")
        entered = other_client(opened.url)
        client = await asyncio.to_thread(entered.__enter__)
        before = set(service.subscriptions)
        await asyncio.to_thread(client.client.create_subscription, 100, None)
        assert set(service.subscriptions) > before
        client.client.keepalive.stop()
        await asyncio.to_thread(client.client.create_session)
        assert set(service.subscriptions) == before
        await asyncio.to_thread(client.client.activate_session)
        assert (await asyncio.to_thread(client.read, "5/10")).status == "Good"
        await asyncio.to_thread(entered.__exit__, None, None, None)


async def test_a_connection_without_a_session_is_closed(opened: Opened, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(opcua_connections, "SESSION_WITHIN", 0.1)
    host, _, port = opened.url.removeprefix("opc.tcp://").rstrip("/").rpartition(":")
    await asyncio.to_thread(closes, (host, int(port)), b"")


@pytest.mark.slow
async def test_the_work_of_a_client_that_is_killed_ends_at_once(opened: Opened) -> None:
    async with opened.owned() as line:
        line.poll("10")
        await opened.is_("5/10", "Good")

        def vanish() -> None:
            client = opcua.Client(opened.url, timeout=PATIENCE)
            client.connect()
            subscription = client.create_subscription(100, None)
            subscription.subscribe_data_change([OtherClient(client).node("5/10")] * 2000)
            client.keepalive.stop()
            client.uaclient._uasocket._socket.socket.shutdown(socket.SHUT_RDWR)
            client.uaclient._uasocket._thread.join(PATIENCE)
            client.uaclient._uasocket._socket.socket.close()

        service = opened.server.iserver.subscription_service
        await asyncio.to_thread(vanish)
        await until(lambda: not service.subscriptions)
        assert (await opened.is_("5/10", "Good")).value == 0.0
