"""A line in a process of its own, of whose programs some are refused: for want of a place, and for a wrong token."""

from __future__ import annotations

import asyncio
import json
import socket
import subprocess
import urllib.request
from contextlib import AsyncExitStack
from pathlib import Path

import pytest

from busmaster import Hcp2Controller, bounds, connect
from busmaster.emulator.serve import TcpServer
from busmaster.errors import LineDown
from tests.cli.conftest import Command, owner
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
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=PATIENCE) as answer:
        lines = answer.read().decode().splitlines()
    [value] = [line.rpartition(" ")[2] for line in lines if line.startswith(f"busmaster_{name}")]
    return float(value)


def told(process: subprocess.Popen[str], what: str) -> str:
    """Wait until the owner reports something on standard error, and return that line."""
    assert process.stderr is not None
    while what not in (line := process.stderr.readline()):
        assert line, "it ended"
    return line


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
                assert "busmaster: slitter: 1 connections refused, as no place was free\n" in ran.err
                assert await asyncio.to_thread(count_of, metrics, 'connections_refused_total{role="read"}') == 1
                # All the owner's places, and those that writers have beyond: for the safe state there is still one.
                assert await fill(stack, address) == bounds.RESERVED_FOR_ADMINS
                ran = await asyncio.to_thread(busmaster, "safe", str(file))
                assert (ran.status, ran.out) == (0, "winder/force ok\n")
                ran = await asyncio.to_thread(busmaster, "read", address, "--protocol", "hcp2", "--node", "1", "10")
                assert "all 72 places for role admin are taken" in ran.err

        asyncio.run(asyncio.wait_for(story(), PATIENCE))
