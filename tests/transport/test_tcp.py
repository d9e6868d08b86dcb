"""TcpPort against a server on the loopback interface."""

from __future__ import annotations

import asyncio
import socket
from collections.abc import AsyncIterator, Awaitable
from contextlib import asynccontextmanager
from typing import Any, NoReturn

import pytest

from busmaster.errors import InvalidCommand, LineDown
from busmaster.transport import tcp
from busmaster.transport.endpoints import is_paced
from busmaster.transport.tcp import TcpPort
from tests.patience import PATIENCE
from tests.transport.fakes import Recorder


class Server:
    """Collects what is sent to it; `said` is that of all connections."""

    def __init__(self) -> None:
        self.said = b""
        self.writers: list[asyncio.StreamWriter] = []
        self.heard = asyncio.Event()
        self.port = 0

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.writers.append(writer)
        self.heard.set()
        while data := await reader.read(1000):
            self.said += data
            self.heard.set()
        writer.close()


@asynccontextmanager
async def served() -> AsyncIterator[Server]:
    server = Server()
    listening = await asyncio.start_server(server.serve, "127.0.0.1", 0)
    server.port = listening.sockets[0].getsockname()[1]
    try:
        yield server
    finally:
        listening.close()
        for writer in server.writers:
            writer.close()
        await listening.wait_closed()


async def done(happening: Awaitable[Any]) -> None:
    async with asyncio.timeout(PATIENCE):
        await happening


@pytest.mark.parametrize(
    "values",
    [
        {"host": ""},
        {"port": 0},
        {"port": 65536},
        {"port": "4001"},
        {"port": 4001.0},
        {"baudrate": 0},
        {"receive_latency": -1.0},
        {"receive_latency": float("inf")},
        {"paced": True},
    ],
)
def test_values_that_no_server_can_have_are_refused_when_it_is_built(values: dict[str, Any]) -> None:
    values = {"host": "server", "port": 4001, **values}
    with pytest.raises(InvalidCommand):
        TcpPort(**values)


def test_its_baud_rate_tells_when_a_request_has_left() -> None:
    assert TcpPort("server", 4001).settings is None
    settings = TcpPort("server", 4001, baudrate=9600).settings
    assert settings is not None
    assert settings.byte_time == pytest.approx(10 / 9600)
    assert TcpPort("::1", 4001).name == "[::1]:4001"


@pytest.mark.asyncio
async def test_bytes_go_both_ways_without_delay_and_a_dead_server_is_found_out() -> None:
    async with served() as server:
        recorder = Recorder()
        port = TcpPort("127.0.0.1", server.port)
        transport = await port.open(lambda: recorder)
        assert recorder.connections == 1
        assert not is_paced(port, transport)
        assert transport.get_write_buffer_limits() == (0, 0)
        sock = transport.get_extra_info("socket")
        assert sock.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)
        assert sock.getsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE)
        idle, interval, count, unacknowledged = (
            sock.getsockopt(socket.IPPROTO_TCP, option)
            for option in (socket.TCP_KEEPIDLE, socket.TCP_KEEPINTVL, socket.TCP_KEEPCNT, socket.TCP_USER_TIMEOUT)
        )
        assert idle <= 5
        assert idle + count * interval <= 10
        assert 5_000 <= unacknowledged <= 10_000, "milliseconds"
        transport.write(b"ping")
        while server.said != b"ping":
            server.heard.clear()
            await done(server.heard.wait())
        server.writers[0].write(b"pong")
        await recorder.heard(b"pong")
        transport.close()
        await recorder.lost()
        assert recorder.losses == [None]


@pytest.mark.asyncio
async def test_more_than_one_read_takes_arrives_whole_and_each_read_keeps_its_bytes() -> None:
    class Keeping(Recorder):
        def __init__(self) -> None:
            super().__init__()
            self.reads: list[bytes] = []

        def data_received(self, data: bytes) -> None:
            self.reads.append(data)
            super().data_received(data)

    burst = bytes(range(256)) * (3 * tcp.READ_AT_ONCE // 256) + b"end"
    async with served() as server:
        recorder = Keeping()
        transport = await TcpPort("127.0.0.1", server.port).open(lambda: recorder)
        await done(server.heard.wait())
        server.writers[0].write(burst)
        await recorder.heard(b"end")
        assert len(recorder.reads) > 1
        assert b"".join(recorder.reads) == burst, "a later read does not change what an earlier one delivered"
        server.writers[0].close()
        await recorder.lost()
        assert transport.is_closing()


@pytest.mark.asyncio
async def test_a_server_that_does_not_run_refuses() -> None:
    async with served() as server:
        pass
    with pytest.raises(LineDown, match=rf"^127.0.0.1:{server.port} refused the connection; check that the server"):
        await TcpPort("127.0.0.1", server.port).open(Recorder)
    with pytest.raises(LineDown, match=r"^localhost:\d+ refused the connection; check that the server"):
        await TcpPort("localhost", server.port).open(Recorder)


@pytest.mark.asyncio
async def test_an_unknown_host_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    async def unknown(*_: object, **__: object) -> NoReturn:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", unknown)
    with pytest.raises(LineDown, match="no such host: server; check the name"):
        await TcpPort("server", 4001).open(Recorder)


@pytest.mark.asyncio
async def test_a_server_that_does_not_answer_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    async def silent(*_: object, **__: object) -> NoReturn:
        await asyncio.Event().wait()
        raise AssertionError

    monkeypatch.setattr(asyncio.get_running_loop(), "getaddrinfo", silent)
    monkeypatch.setattr(tcp, "CONNECT_DEADLINE", 0.01)
    with pytest.raises(LineDown, match="server:4001 did not answer within"):
        await TcpPort("server", 4001).open(Recorder)


@pytest.mark.asyncio
async def test_any_other_failure_is_put_into_words(monkeypatch: pytest.MonkeyPatch) -> None:
    async def unreachable(*_: object, **__: object) -> NoReturn:
        raise OSError(101, "Connect call failed ('10.0.0.1', 4001)")

    monkeypatch.setattr(asyncio.get_running_loop(), "create_connection", unreachable)
    with pytest.raises(LineDown, match="cannot connect to server:4001: Network is unreachable"):
        await TcpPort("server", 4001).open(Recorder)
