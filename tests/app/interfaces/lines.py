"""An emulated line that is served, and its page: all in one process and loop, by real sockets."""

from __future__ import annotations

import asyncio
import contextlib
import os
import threading
from collections.abc import AsyncIterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2 as httpx

from busmaster import Hcp2Controller
from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.guard import Guard
from busmaster.app.interfaces.web import PastValues, application, serving
from busmaster.app.outputs.history import History
from busmaster.app.service.permission import Access, Permission
from busmaster.app.service.rights import Role
from busmaster.bus.points import Point
from tests.app.service.lines import Served, until
from tests.patience import PATIENCE

ONE = "/api/points/axes/5/10"
HERE = ("127.0.0.1", 0)
READS = Access(users={os.getuid(): Permission("this user", Role.READ)})
"""What an owner's file says where this user may only read."""


@contextlib.asynccontextmanager
async def followed(folder: Path, *, read_only: bool = False) -> AsyncIterator[Following]:
    """What follows the line of this folder, whether it is served yet or not."""
    line = Following(lambda: f"unix:{folder}/line.sock", read_only=read_only)
    task = asyncio.ensure_future(line.follow())
    try:
        async with asyncio.timeout(PATIENCE):
            yield line
    finally:
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task


def poll(line: Served, *more: Point[Any], period: float = 0.02) -> None:
    controller = Hcp2Controller(line.bus, 5)
    line.bus.poll_group("axes", period=period, points=[controller.point("10"), controller.point("outputs"), *more])


async def assert_goes_on_alone(line: Served) -> None:
    """Fail where interfaces have left anything with the line; wait until its poll group has gone on without them."""
    await line.alone()
    await until(lambda: line.bus._pump.tap is None)
    [group] = line.bus.groups
    assert len(line.bus.nodes) == 1
    cycles = group.statistics().cycles
    await until(lambda: group.statistics().cycles > cycles)


async def shows(line: Following) -> None:
    """Wait until the picture of an owner that is there has a value."""
    await until(lambda: line.is_connected and line.picture.rows and line.picture.rows[0].value is not None)
    await until(lambda: line.picture.frame is not None and line.picture.nodes)


@dataclass
class Page:
    """The page of a line: what it follows, where it is, and what was told of its writes."""

    line: Following
    url: str
    client: httpx.AsyncClient
    writes: list[str]


@contextlib.asynccontextmanager
async def page(
    folder: Path,
    *,
    read_only: bool = False,
    listen: tuple[str, int] = HERE,
    seen_at: tuple[str, int] | None = None,
    secrets: dict[str, bytes] | None = None,
    history: PastValues | None = None,
) -> AsyncIterator[Page]:
    """The page of the line of this folder. Its guard takes it that it listens at `seen_at`, if that is not so."""
    writes: list[str] = []
    async with followed(folder, read_only=read_only) as line:
        guarded = application(line, Guard(seen_at or listen, secrets or {}), writes.append, history)
        async with (
            serving(guarded, listen) as url,
            httpx.AsyncClient(base_url=url, timeout=PATIENCE, trust_env=False) as client,
        ):
            yield Page(line, url, client, writes)


class Past:
    """Past values that a test gives. What was requested is kept, with the thread that read it."""

    def __init__(self, found: History | Exception | None = None) -> None:
        self.found = found or History()
        self.requests: list[tuple[str, str, float, float, int]] = []
        self.threads: set[int] = set()
        self.held = threading.Event()
        self.held.set()

    def read(self, key: str, unit: str, begin: float, end: float, limit: int) -> History:
        self.requests.append((key, unit, begin, end, limit))
        self.threads.add(threading.get_ident())
        assert self.held.wait(PATIENCE)
        if isinstance(self.found, Exception):
            raise self.found
        return self.found
