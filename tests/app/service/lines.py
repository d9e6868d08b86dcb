"""An emulated line that is served, and programs that come to it: all in one process and loop, by a real socket."""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
from collections.abc import AsyncIterator, Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from websockets.asyncio.client import ClientConnection, unix_connect

from busmaster import Bus, Hcp2Controller, MemoryPort, MicroFlexDrive, RemoteBus, Service, connect
from busmaster.app.service.authorisation import Authorisation
from busmaster.app.service.permission import Access
from busmaster.app.service.record import WriteRecord
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.emulator.line import Line
from busmaster.registry import make_device
from tests.app.service.schema import check_owner
from tests.patience import PATIENCE

PATIENT = Timings.uniform(ReplyTiming(0.3, 0.3, 0.3, 0.02))
"""Of a node that is not there: what is asked of it is on the wire for a while."""
ABSENT = 9


@dataclass
class Served:
    """A line with controllers 5 and 6 and drive 7, which is served."""

    bus: Bus
    service: Service
    authorisation: Authorisation
    records: list[WriteRecord]

    @property
    def address(self) -> str:
        return self.service.address

    async def sent(self) -> None:
        """Wait until a request of a program is on the wire, or was."""
        await until(lambda: any(one.sent for client in self.service.clients for one in client.unfinished))

    async def alone(self) -> None:
        """Wait until no program is connected."""
        await until(lambda: not self.service.clients)

    def audit(self) -> list[tuple[str, str]]:
        """What was written, and what became of it: of a raw command, itself."""
        return [
            (record.point.replace("raw command", str(record.value).strip("'")), record.outcome.value)
            for record in self.records
        ]


class SlowWay:
    """Takes messages while it is not full."""

    def __init__(self) -> None:
        self.full = False
        self.sent: list[bytes] = []

    def send(self, message: bytes, /) -> None:
        self.sent.append(message)


async def until(fact: Callable[[], object]) -> None:
    """Wait for a fact of this process: its loop turns until it is one."""
    while not fact():  # noqa: ASYNC110  nobody tells it
        await asyncio.sleep(0.001)


@contextlib.asynccontextmanager
async def served(
    folder: Path, *, read_only: bool = False, access: Access | None = None, listen: tuple[str, int] | None = None
) -> AsyncIterator[Served]:
    devices = [make_device("hcp2", 5), make_device("hcp2", 6), make_device("microflex", 7)]
    async with Bus(MemoryPort(Line(Hcp2Controller.profile.line, devices, paced=False))) as bus:
        authorisation, records = Authorisation(bus, read_only=read_only, access=access), list[WriteRecord]()
        authorisation.record = records.append
        async with Service(bus, authorisation=authorisation, path=folder / "line.sock", listen=listen) as service:
            yield Served(bus, service, authorisation, records)


def on_a_served_line(
    folder: Path, story: Callable[[Served, RemoteBus], Awaitable[None]], *, read_only: bool = False
) -> None:
    async def run() -> None:
        async with (
            asyncio.timeout(PATIENCE),
            served(folder, read_only=read_only) as line,
            connect(line.address) as remote,
        ):
            await story(line, remote)

    asyncio.run(run())


def on_a_line(folder: Path, story: Callable[[Served], Awaitable[None]], *, read_only: bool = False) -> None:
    async def run() -> None:
        async with asyncio.timeout(PATIENCE), served(folder, read_only=read_only) as line:
            await story(line)

    asyncio.run(run())


class Raw:
    """A client that says what it is told, word for word."""

    def __init__(self, connection: ClientConnection) -> None:
        self.connection = connection

    async def say(self, **message: Any) -> None:
        await self.connection.send(json.dumps({"jsonrpc": "2.0", **message}))

    async def hear(self) -> dict[str, Any]:
        said: dict[str, Any] = json.loads(await self.connection.recv())
        check_owner(said)
        return said

    async def ask(self, method: str, **params: Any) -> dict[str, Any]:
        await self.say(method=method, params=params, id=1)
        return await self.hear()


@contextlib.asynccontextmanager
async def raw(line: Served, *, hello: bool = True, **options: Any) -> AsyncIterator[Raw]:
    path = line.address.removeprefix("unix:")
    quiet = logging.getLogger("tests.app.service")
    options = {"uri": "ws://localhost/", "compression": None, "logger": quiet, **options}
    async with unix_connect(path, **options) as connection:
        client = Raw(connection)
        if hello:
            assert (await client.ask("hello", versions=[3]))["result"]["version"] == 3
        yield client


__all__ = [
    "ABSENT",
    "PATIENT",
    "MicroFlexDrive",
    "Raw",
    "Served",
    "SlowWay",
    "on_a_line",
    "on_a_served_line",
    "raw",
    "served",
    "until",
]
