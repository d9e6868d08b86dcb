"""A line in a process of its own, of whose programs some are refused: for want of a place, and for a wrong token."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import urllib.request
from contextlib import AsyncExitStack, ExitStack, closing, suppress
from http.client import HTTPConnection
from pathlib import Path

import pytest
from asyncua import Client, ua

from busmaster import Hcp2Controller, connect
from busmaster.app import bounds
from busmaster.emulator.serve import TcpServer
from busmaster.errors import LineDown
from tests.app.cli.conftest import Command, owner, started
from tests.patience import PATIENCE

READER, WRITER = "a-token-of-a-reader-1", "a-token-of-a-writer-2"
SAFE = '[safe]\nwithin = 5.0\nrepeatable = ["winder/force"]\nwrites = { "winder/force" = 1.5 }\n'


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port: int = free.getsockname()[1]
        return port


@pytest.fixture
def metrics(file: Path) -> int:
    """The port of the metrics of the line, to whose service programs come by TCP with tokens."""
    tokens, port = file.with_name("tokens"), free_port()
    tokens.write_text(f"reader {READER}\nwriter {WRITER}\n")
    tokens.chmod(0o600)
    service = f'[service]\nlisten = "127.0.0.1:0"\ntoken_file = "{tokens}"\ntokens.writer = {{ role = "write" }}\n'
    file.write_text(f"{file.read_text()}{SAFE}{service}[outputs.metrics]\nport = {port}\n")
    return port


async def fill(stack: AsyncExitStack, address: str, token: str | None = None) -> int:
    """Have programs come until one is refused, and return how many stay until `stack` ends."""
    for count in range(1000):
        try:
            await stack.enter_async_context(connect(address, token=token))
        except LineDown:
            return count
    raise AssertionError("all are admitted")


def count_of(port: int, name: str) -> float:
    [value] = counts_of(port, name)
    return value


def counts_of(port: int, name: str) -> list[float]:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE) as answer:
        lines = answer.read().decode().splitlines()
    return [float(line.rpartition(" ")[2]) for line in lines if line.startswith(f"busmaster_{name}")]


def told(process: subprocess.Popen[str], what: str) -> str:
    """Wait until the owner reports something on standard error, and return that line."""
    assert process.stderr is not None
    while what not in (line := process.stderr.readline()):
        assert line, "it ended"
    return line


GUESSER = "127.0.0.2"


def status_of(port: int, token: str, source: str, *, path: str, method: str = "GET", body: str = "") -> int:
    """Return the status of a request that shows a token, from an address of this machine."""
    headers = {"Authorization": f"Bearer {token}", "Content-Type": "application/json"}
    if method == "GET":
        headers |= {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13"}
        headers["Sec-WebSocket-Key"] = "dGhlIHNhbXBsZSBub25jZQ=="
    connection = HTTPConnection("127.0.0.1", port, timeout=PATIENCE, source_address=(source, 0))
    with closing(connection):
        connection.request(method, path, body or None, headers)
        return connection.getresponse().status


def failed_logins(busmaster: Command) -> int:
    count: int = json.loads(busmaster("status", "--json").out)["failed_logins"]
    return count


@pytest.mark.slow
def test_who_guesses_tokens_of_the_service_is_slowed_down_counted_and_reported(
    busmaster: Command, file: Path, metrics: int
) -> None:
    with owner("serve", str(file)) as (process, _):
        tcp = json.loads(busmaster("status", "--json").out)["tcp"]
        port = int(tcp.rpartition(":")[2])
        statuses = [status_of(port, "x" * 16, GUESSER, path="/") for _ in range(bounds.FREE_LOGINS + 3)]
        assert statuses == [401] * bounds.FREE_LOGINS + [429] * 3
        assert f"1 failed login at service: 1 from {GUESSER}" in told(process, "failed login")
        assert status_of(port, WRITER, "127.0.0.1", path="/") == 101  # from another address
        count = len(statuses)
        while status_of(port, WRITER, GUESSER, path="/") == 429:
            count += 1  # until the pause is over
        assert failed_logins(busmaster) == count
        assert f"slitter: {count} logins failed" in busmaster("status").err
        assert count_of(metrics, 'logins_failed_total{interface="service"}') == count


@pytest.mark.slow
def test_who_guesses_tokens_of_the_page_is_slowed_down_counted_and_reported(
    busmaster: Command, file: Path, metrics: int
) -> None:
    tokens = str(file.with_name("tokens"))
    with (
        owner("serve", str(file)) as (process, address),
        started("web", "--bind", "127.0.0.1:0", "--token-file", tokens, address) as interface,
    ):
        try:
            port = int(told(interface, "the page is at").rpartition(":")[2].strip().strip("/"))
            told(interface, "connected to line")
            place = {"path": "/api/points/fast/winder/force", "method": "PUT", "body": '{"value": 3}'}
            while status_of(port, WRITER, "127.0.0.1", **place) != 200:
                pass  # until the page knows the points
            statuses = [status_of(port, "x" * 16, GUESSER, **place) for _ in range(bounds.FREE_LOGINS + 3)]
            assert statuses == [401] * bounds.FREE_LOGINS + [429] * 3
            assert f"1 failed login at web: 1 from {GUESSER}" in told(interface, "failed login")
            assert status_of(port, READER, "127.0.0.1", **place) == 200
            assert told(process, "at web: ").strip().endswith(f"from {GUESSER}")
            while failed_logins(busmaster) < len(statuses):
                pass
            assert count_of(metrics, 'logins_failed_total{interface="web"}') == len(statuses)
        finally:
            interface.kill()
            interface.communicate(timeout=PATIENCE)


@pytest.mark.slow
def test_who_guesses_passwords_of_opcua_is_slowed_down_counted_and_reported(
    busmaster: Command, file: Path, metrics: int
) -> None:
    tokens = str(file.with_name("tokens"))
    with (
        owner("serve", str(file)) as (process, address),
        started("opcua", "--bind", "127.0.0.1:0", "--token-file", tokens, "--allow", "*", address) as interface,
    ):
        try:
            port = int(told(interface, "opc.tcp://").rpartition(":")[2].strip().strip("/"))

            async def story() -> None:
                relay, far = await relayed(port, GUESSER)
                wrong = [await login(far, "writer", "x" * 16) for _ in range(bounds.FREE_LOGINS + 3)]
                assert wrong == ["BadUserAccessDenied"] * bounds.FREE_LOGINS + ["BadServerTooBusy"] * 3
                assert await login(port, "writer", WRITER) == "Good"  # from another address
                relay.close()

            asyncio.run(asyncio.wait_for(story(), PATIENCE))
            count = bounds.FREE_LOGINS + 3
            assert f"1 failed login at opcua: 1 from {GUESSER}" in told(interface, "failed login")
            told(process, "failed login")
            while failed_logins(busmaster) < count:
                pass
            assert count_of(metrics, 'logins_failed_total{interface="opcua"}') == count
        finally:
            interface.kill()
            interface.communicate(timeout=PATIENCE)


@pytest.mark.slow
def test_what_modbus_tcp_refuses_is_counted_and_reported_by_the_owner(
    busmaster: Command, file: Path, metrics: int
) -> None:
    places = bounds.MOST_GATEWAY_PER_PEER
    with (
        owner("serve", str(file)) as (process, address),
        started("modbus-tcp", "--bind", "127.0.0.1:0", address) as interface,
        ExitStack() as stack,
    ):
        try:
            port = int(told(interface, "serving Modbus TCP at").rpartition(":")[2])
            counts = 'interface_refused_total{interface="modbus-tcp",kind='
            while len(zeros := counts_of(metrics, counts)) < 2:
                pass  # until it has named itself to the owner
            assert zeros == [0, 0]
            opened = [
                stack.enter_context(socket.create_connection(("127.0.0.1", port), PATIENCE, (GUESSER, 0)))
                for _ in range(places)
            ]
            for one in opened:
                one.sendall(bytes.fromhex("0001 0000 0006 01 06 0000 0001"))
                assert one.recv(260) == bytes.fromhex("0001 0000 0003 01 86 01")  # nothing is allowed
            for _ in range(3):
                with (
                    socket.create_connection(("127.0.0.1", port), PATIENCE, (GUESSER, 0)) as beyond,
                    suppress(ConnectionError),
                ):
                    assert beyond.recv(1) == b""
            texts = [told(process, "refused at modbus-tcp: ") for _ in range(2)]
            assert all(text.strip().endswith(f"from {GUESSER}") for text in texts)
            assert sorted("connection" in text for text in texts) == [False, True]
            line = {"refused_connections": 0, "refused_requests": 0}
            while line["refused_requests"] < places or line["refused_connections"] < 3:
                line = json.loads(busmaster("status", "--json").out)
            assert (line["refused_connections"], line["refused_requests"], line["failed_logins"]) == (3, places, 0)
            assert f"slitter: 3 connections refused, {places} requests refused" in busmaster("status").err
            assert count_of(metrics, f'{counts}"connections"') == 3
            assert count_of(metrics, f'{counts}"requests"') == places
        finally:
            interface.kill()
            interface.communicate(timeout=PATIENCE)


async def login(port: int, user: str, password: str) -> str:
    """Return the status with which an OPC UA server lets a user in."""
    client = Client(f"opc.tcp://127.0.0.1:{port}/")
    client.set_user(user)
    client.set_password(password)
    try:
        async with client:
            return "Good"
    except ua.UaStatusCodeError as error:
        return type(error).__name__


async def relayed(port: int, source: str) -> tuple[asyncio.Server, int]:
    """Relay connections to a port of this machine, so that they come from another of its addresses."""

    async def pump(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1 << 16):
            writer.write(data)
        writer.close()

    async def relay(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        far = await asyncio.open_connection("127.0.0.1", port, local_addr=(source, 0))
        await asyncio.gather(pump(reader, far[1]), pump(far[0], writer), return_exceptions=True)

    server = await asyncio.start_server(relay, "127.0.0.1", 0)
    return server, server.sockets[0].getsockname()[1]


def test_readers_in_all_places_keep_out_no_writer_no_owner_and_no_safe_state(
    busmaster: Command, file: Path, metrics: int, three_controllers: TcpServer
) -> None:
    with owner("serve", str(file)) as (process, address):
        tcp = json.loads(busmaster("status", "--json").out)["tcp"]

        async def story() -> None:
            async with AsyncExitStack() as stack:
                assert await fill(stack, tcp, READER) == bounds.MOST_CLIENTS
                assert "1 connection was refused, because no place was free: 1 of role read" in await asyncio.to_thread(
                    told, process, "refused"
                )
                async with connect(tcp, token=WRITER) as writer:
                    await Hcp2Controller(writer, 1).write(10, 70)
                ran = await asyncio.to_thread(busmaster, "read", address, "--protocol", "hcp2", "--node", "1", "10")
                assert (ran.status, ran.out) == (0, "10 70\n")
                assert (await asyncio.to_thread(busmaster, "safe", str(file))).status == 0
                ran = await asyncio.to_thread(busmaster, "status")
                assert "busmaster: slitter: 1 connections refused\n" in ran.err
                assert await asyncio.to_thread(count_of, metrics, 'connections_refused_total{role="read"}') == 1
                # All the owner's places, and those that writers have beyond: for the safe state there is still one.
                assert await fill(stack, address) == bounds.RESERVED_FOR_ADMINS
                ran = await asyncio.to_thread(busmaster, "safe", str(file))
                assert (ran.status, ran.out) == (0, "winder/force ok\n")
                ran = await asyncio.to_thread(busmaster, "read", address, "--protocol", "hcp2", "--node", "1", "10")
                assert "all 72 places for role admin are taken" in ran.err

        asyncio.run(asyncio.wait_for(story(), PATIENCE))
