"""Attacks below the level of requests, for `python -m tests.app.service.attackers`: connections, frames and bodies.

Each is made by one attacking process, from its first connection on; the other connections only stay. Attacks whose name
begins with `page` are on a `busmaster web` over the attacked line, those that begin with `modbus-tcp` on a `busmaster
modbus-tcp` that passes requests through to its unit, which may be written; `address` is then the URL of the interface.
"""

from __future__ import annotations

import asyncio
import contextlib
import gzip
import os
import random
import resource
import signal
import socket
import sys
import zlib
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import NamedTuple
from urllib.parse import urlsplit

from busmaster import RemoteBus, connect
from busmaster.app.service.messages import encode
from busmaster.protocols.modbus.codec import PROFILE, ReadRegisters

MANY = 10_000
"""Connections at once; fewer where the process may have fewer descriptors."""
QUEUED = 1_000_000
"""Reads that one client requests without waiting for a reply."""
SPARE = 200
"""Descriptors that connections leave to the process."""
ZEROS = bytes(8 << 20)
FROM = "127.0.0.2"
"""Where the attacks come from: another address of this machine than others have."""
PING = b"\x89\x80" + bytes(4)

Raw = Callable[[str, int, str], Awaitable[None]]
"""An attack on a host and a port, with a token."""


def most_descriptors() -> int:
    """Let this process have as many descriptors as it may, and return for how many connections that is enough."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))
    return min(MANY, hard - SPARE)


def upgrade(path: str, host: str, token: str, *, deflate: bool = False) -> bytes:
    """Return a request for a WebSocket."""
    extensions = "Sec-WebSocket-Extensions: permessage-deflate\r\n" if deflate else ""
    shown = f"Authorization: Bearer {token}\r\n" if token else ""
    return (
        f"GET {path} HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n{shown}{extensions}"
        "Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
    ).encode()


def frame(data: bytes, *, compressed: bool = False) -> bytes:
    """Return a text message as a client sends it, masked with nothing; `compressed` with permessage-deflate."""
    first = b"\xc1" if compressed else b"\x81"
    if len(data) < 126:
        return first + bytes([0x80 | len(data)]) + bytes(4) + data
    if len(data) < 1 << 16:
        return first + b"\xfe" + len(data).to_bytes(2, "big") + bytes(4) + data
    return first + b"\xff" + len(data).to_bytes(8, "big") + bytes(4) + data


HELLO = frame(b'{"jsonrpc":"2.0","id":0,"method":"hello","params":{"versions":[3]}}')


def bomb() -> bytes:
    """Return 8 MiB of zeros as permessage-deflate has them: 8 KiB."""
    deflate = zlib.compressobj(9, zlib.DEFLATED, -15)
    return (deflate.compress(ZEROS) + deflate.flush(zlib.Z_SYNC_FLUSH))[:-4]


async def connections(host: str, port: int, token: str) -> None:
    """Hold as many connections as possible; open each again that is closed."""
    count = most_descriptors()

    async def hold() -> None:
        loop = asyncio.get_running_loop()
        while True:
            with contextlib.suppress(OSError), socket.socket() as one:
                one.bind((FROM, 0))
                one.setblocking(False)
                await loop.sock_connect(one, (host, port))
                await loop.sock_recv(one, 1)
            await asyncio.sleep(0.05)

    await asyncio.gather(*(hold() for _ in range(count)))


Talk = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


async def _again(host: str, port: int, talk: Talk, source: str = FROM) -> None:
    """Connect again and again, and talk."""
    while True:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError):
            reader, writer = await asyncio.open_connection(host, port, local_addr=(source, 0))
            try:
                await talk(reader, writer)
            finally:
                writer.transport.abort()
        await asyncio.sleep(0.001)


async def service_bombs(host: str, port: int, token: str) -> None:
    """Offer compression, and send 8 MiB in 8 KiB whether it is accepted or not."""
    message = frame(bomb(), compressed=True)

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(upgrade("/", "localhost", token, deflate=True) + HELLO + message * 16)
        await reader.read(-1)

    await asyncio.gather(*(_again(host, port, talk) for _ in range(8)))


async def service_pings(host: str, port: int, token: str) -> None:
    """Send pings as fast as they are taken, and read the pongs."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(upgrade("/", "localhost", token) + HELLO)
        await _flood(reader, writer)

    await asyncio.gather(*(_again(host, port, talk) for _ in range(8)))


async def _flood(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    async def take() -> None:
        while await reader.read(1 << 16):
            pass
        writer.transport.abort()

    taking = asyncio.ensure_future(take())
    try:
        while not taking.done():
            writer.write(PING * 1000)
            await writer.drain()
    finally:
        taking.cancel()


async def queued_reads(host: str, port: int, token: str) -> None:
    """Request 10^6 reads, and read no reply."""
    params = {"protocol": "modbus", "address": 1, "command": {"command": "read_registers", "first": 0}}
    request = {"jsonrpc": "2.0", "method": "request", "params": params}
    requests = [frame(encode({**request, "id": number})) for number in range(1, 1001)]

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(upgrade("/", "localhost", token) + HELLO)
        for _ in range(QUEUED // len(requests)):
            writer.write(b"".join(requests))
            await writer.drain()

    await asyncio.gather(*(_again(host, port, talk) for _ in range(8)))


async def page_bombs(host: str, port: int, token: str) -> None:
    """Write with bodies of gzip, 8 MiB in 8 KiB, and of a size that is not said before."""
    body = gzip.compress(ZEROS)
    head = (
        f"PUT /api/points/fast/unit/p0 HTTP/1.1\r\nHost: {host}:{port}\r\nAuthorization: Bearer {token}\r\n"
        "Content-Type: application/json\r\nContent-Encoding: gzip\r\n"
    )
    whole = f"{head}Content-Length: {len(body)}\r\n\r\n".encode() + body
    chunk = f"{len(body):x}\r\n".encode() + body + b"\r\n"
    endless = f"{head}Transfer-Encoding: chunked\r\n\r\n".encode() + chunk * 64

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(whole)
        await reader.readuntil(b"\r\n\r\n")
        writer.write(endless)
        await reader.read(-1)

    await asyncio.gather(*(_again(host, port, talk) for _ in range(8)))


async def page_deflate(host: str, port: int, token: str) -> None:
    """Offer compression on the page's WebSocket, and send 8 MiB in 8 KiB whether it is accepted or not."""
    message = frame(bomb(), compressed=True)

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(upgrade("/api/stream", f"{host}:{port}", "", deflate=True) + message * 16)
        await reader.read(-1)

    await asyncio.gather(*(_again(host, port, talk) for _ in range(8)))


async def page_pings(host: str, port: int, token: str) -> None:
    """Send pings on the page's WebSocket as fast as they are taken."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(upgrade("/api/stream", f"{host}:{port}", ""))
        await _flood(reader, writer)

    await asyncio.gather(*(_again(host, port, talk) for _ in range(8)))


READ = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
WRITE = bytes.fromhex("0001 0000 0006 01 06 003c 0001")
READ_REPLY, WRITE_REPLY = 11, 12
SOURCES = [f"127.0.0.{last}" for last in range(2, 10)]
"""The interface has 32 connections of one address, and 128 in all: these have more."""


async def _from_all(host: str, port: int, talk: Talk) -> None:
    """Talk at 40 connections of each address."""
    await asyncio.gather(*(_again(host, port, talk, source) for source in SOURCES for _ in range(40)))


async def modbus_half(host: str, port: int, token: str) -> None:
    """Send half a header, and stay."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(READ[:4])
        await reader.read(-1)

    await _from_all(host, port, talk)


async def modbus_bytes(host: str, port: int, token: str) -> None:
    """Send a byte each second."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            for byte in READ:
                writer.write(bytes((byte,)))
                await writer.drain()
                await asyncio.sleep(1.0)

    await _from_all(host, port, talk)


async def modbus_garbage(host: str, port: int, token: str) -> None:
    """Send random bytes, and headers of other protocols and lengths."""
    chance = random.Random(1)
    heads = [bytes.fromhex(head) for head in ("00010001000601", "00010000000101", "0001000000ff01", "00010000ffff01")]

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(chance.choice([chance.randbytes(1000), *heads]) + chance.randbytes(1000))
        await reader.read(-1)

    await asyncio.gather(*(_again(host, port, talk) for _ in range(32)))


async def modbus_queued(host: str, port: int, token: str) -> None:
    """Send reads without a pause, and read no reply."""

    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while True:
            writer.write(READ * 1000)
            await writer.drain()

    await _from_all(host, port, talk)


def _requests(request: bytes, size: int) -> Raw:
    """Return what makes one request after the other at 32 connections."""

    async def flood(host: str, port: int, token: str) -> None:
        async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
            while True:
                writer.write(request)
                await reader.readexactly(size)

        await asyncio.gather(*(_again(host, port, talk) for _ in range(32)))

    return flood


async def stopped_holder(bus: RemoteBus, number: int) -> None:
    """Have a process take a sequence of 5 s and stop it (SIGSTOP) while it holds the line; then the next one."""
    if number:
        await asyncio.Event().wait()
    while True:
        holder = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "tests.app.service.floods", bus.address), stdout=asyncio.subprocess.PIPE
        )
        assert holder.stdout is not None
        try:
            await holder.stdout.readline()
            holder.send_signal(signal.SIGSTOP)
            await asyncio.sleep(6.0)
        finally:
            holder.kill()
            await holder.wait()


async def hold(address: str) -> None:
    """Hold the line for a sequence, and print a line once it is held."""
    async with (
        connect(address, token=os.environ["HOLDER"]) as bus,
        bus.node(PROFILE, 1).exclusive(max_hold=5.0) as held,
    ):
        await held.request(ReadRegisters(0, 1))
        sys.stdout.write("held\n")
        sys.stdout.flush()
        await asyncio.sleep(60.0)


SERVICE: dict[str, Raw] = {
    "read: 10,000 connections": connections,
    "read: deflate bombs": service_bombs,
    "read: ping floods": service_pings,
    "read: 10^6 queued reads": queued_reads,
}
PAGE: dict[str, Raw] = {
    "page: 10,000 connections": connections,
    "page: gzip and chunked bodies": page_bombs,
    "page: deflate bombs": page_deflate,
    "page: ping floods": page_pings,
}
MODBUS: dict[str, Raw] = {
    "modbus-tcp: 10,000 connections": connections,
    "modbus-tcp: half a header": modbus_half,
    "modbus-tcp: a byte a second": modbus_bytes,
    "modbus-tcp: garbage": modbus_garbage,
    "modbus-tcp: queued reads": modbus_queued,
    "modbus-tcp: reads": _requests(READ, READ_REPLY),
    "modbus-tcp: writes": _requests(WRITE, WRITE_REPLY),
}
MODBUS_READER: dict[str, Raw] = {"modbus-tcp of role read: reads": _requests(READ, READ_REPLY)}


def on_service(raw: Raw, token: str) -> Callable[[RemoteBus, int], Awaitable[None]]:
    """Return the attack that the first connection makes: the others stay."""

    async def attack(bus: RemoteBus, number: int) -> None:
        if number == 0:
            await at(raw, bus.address, token)
        await asyncio.Event().wait()

    return attack


async def at(raw: Raw, address: str, token: str) -> None:
    """Make an attack on an address: tcp://HOST:PORT or http://HOST:PORT/."""
    place = urlsplit(address)
    assert place.hostname is not None
    assert place.port is not None
    await raw(place.hostname, place.port, token)


async def page(address: str, _tcp: str, tokens: str) -> tuple[asyncio.subprocess.Process, str]:
    """Start `busmaster web` for a line, and return it with its URL once the line is followed."""
    started = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "busmaster", "web", "--bind", "127.0.0.1:0", "--token-file", tokens, address),
        stderr=asyncio.subprocess.PIPE,
    )
    assert started.stderr is not None
    url = ""
    while line := (await started.stderr.readline()).decode():
        url = line.partition("the page is at ")[2].strip() or url
        if "connected to line" in line:
            break
    return started, url


async def page_answers(url: str) -> bool:
    """Return whether a page that is attacked answers another client within 5 s."""
    place = urlsplit(url)
    with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError):
        async with asyncio.timeout(5.0):
            reader, writer = await asyncio.open_connection(place.hostname, place.port)
            try:
                writer.write(f"GET /api/line HTTP/1.1\r\nHost: {place.netloc}\r\nConnection: close\r\n\r\n".encode())
                return (await reader.readline()).startswith(b"HTTP/1.1 200")
            finally:
                writer.transport.abort()
    return False


async def modbus_tcp_of_a_reader(_address: str, tcp: str, tokens: str) -> tuple[asyncio.subprocess.Process, str]:
    """Start `busmaster modbus-tcp` with a token of the role `read`, whose requests use what the owner leaves."""
    text = await asyncio.to_thread(Path(tokens).read_text)
    known = dict(line.split() for line in text.splitlines())
    return await modbus_tcp(tcp, tcp, tokens, {**os.environ, "BUSMASTER_TOKEN": known["reader"]})


async def modbus_tcp(
    address: str, _tcp: str, _tokens: str, environment: Mapping[str, str] | None = None
) -> tuple[asyncio.subprocess.Process, str]:
    """Start `busmaster modbus-tcp` for a line, and return it with its URL once it replies."""
    started = await asyncio.create_subprocess_exec(
        *(sys.executable, "-m", "busmaster", "modbus-tcp", "--bind", "127.0.0.1:0", "--pass-through"),
        *("--allow-unit", "1", address),
        stderr=asyncio.subprocess.PIPE,
        env=environment,
    )
    assert started.stderr is not None
    url = ""
    while not url and (line := (await started.stderr.readline()).decode()):
        place = line.partition("serving Modbus TCP at ")[2].strip()
        url = f"modbus://{place}" if place else ""
    while not await modbus_answers(url):  # noqa: ASYNC110  nothing reports that it knows the nodes of the line
        await asyncio.sleep(0.1)
    return started, url


async def modbus_answers(url: str) -> bool:
    """Return whether an interface that is attacked reads the unit for another client within 5 s."""
    place = urlsplit(url)
    with contextlib.suppress(OSError, TimeoutError, asyncio.IncompleteReadError):
        async with asyncio.timeout(5.0):
            reader, writer = await asyncio.open_connection(place.hostname, place.port)
            try:
                writer.write(READ)
                return (await reader.readexactly(9))[7:] == b"\x03\x02"
            finally:
                writer.transport.abort()
    return False


class Interface(NamedTuple):
    """An interface that is attacked: how it is started, and whether it replies to another client."""

    attacks: dict[str, Raw]
    start: Callable[[str, str, str], Awaitable[tuple[asyncio.subprocess.Process, str]]]
    """Takes the line's address, the one by TCP, and the file of its tokens."""
    answers: Callable[[str], Awaitable[bool]]


INTERFACES = (
    Interface(PAGE, page, page_answers),
    Interface(MODBUS, modbus_tcp, modbus_answers),
    Interface(MODBUS_READER, modbus_tcp_of_a_reader, modbus_answers),
)


def interface_of(name: str) -> Interface | None:
    """Return the interface that an attack is on; None for the service."""
    return next((one for one in INTERFACES if name in one.attacks), None)


if __name__ == "__main__":
    asyncio.run(hold(sys.argv[1]))
