"""What no other test of the service noticed when it was broken: each was planted once (docs/planted-bugs.md)."""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import time
from collections.abc import AsyncIterator, Coroutine, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from busmaster import Bus, Hcp2Controller, MemoryPort, MentorDrive, RemoteBus, Service, connect
from busmaster.app.service import remote as remote_module
from busmaster.app.service.permission import Access, Permission
from busmaster.app.service.rights import Role
from busmaster.emulator.line import Line
from busmaster.errors import LineDown, NoReply, WriteUnconfirmed
from busmaster.registry import make_device
from tests.app.service.lines import Served, on_a_line, served, until
from tests.app.service.test_safe_state_requests import BOTH, TEXT
from tests.app.service.test_safe_state_requests import on_a_line as on_a_safe_line
from tests.patience import PATIENCE


class Way:
    """What lies between a program and an owner: it may stand still, and be slow once."""

    def __init__(self, port: int) -> None:
        self.open = asyncio.Event()
        self.open.set()
        self.slow_once = 0.0
        self._to = port

    async def carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        there_reader, there_writer = await asyncio.open_connection("127.0.0.1", self._to)
        with contextlib.closing(writer), contextlib.closing(there_writer):
            async with asyncio.TaskGroup() as tasks:
                tasks.create_task(self._pass(reader, there_writer))
                tasks.create_task(self._pass(there_reader, writer, back=True))

    async def _pass(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, back: bool = False) -> None:
        while data := await reader.read(65536):
            await self.open.wait()
            if back and b'"result"' in data and self.slow_once:
                delay, self.slow_once = self.slow_once, 0.0
                await asyncio.sleep(delay)
            writer.write(data)
        writer.close()


@contextlib.asynccontextmanager
async def by_way(line: Served) -> AsyncIterator[tuple[Way, str]]:
    assert line.service.tcp_address is not None
    way = Way(int(line.service.tcp_address.rpartition(":")[2]))
    async with await asyncio.start_server(way.carry, "127.0.0.1", 0) as server:
        yield way, f"tcp://127.0.0.1:{server.sockets[0].getsockname()[1]}"


@contextlib.asynccontextmanager
async def behind_a_stopped_way(folder: Path) -> AsyncIterator[tuple[Served, RemoteBus, Way]]:
    """A line, and a program that has read node 5, and whose connection stands still."""
    async with (
        asyncio.timeout(PATIENCE),
        served(folder, listen=("127.0.0.1", 0)) as line,
        by_way(line) as (way, address),
        connect(address) as remote,
    ):
        assert await Hcp2Controller(remote, 5).read(1) == 0
        way.open.clear()
        yield line, remote, way


def test_a_request_is_over_when_its_time_is_though_its_owner_says_nothing(tmp_path: Path) -> None:
    async def run() -> None:
        async with behind_a_stopped_way(tmp_path) as (line, remote, way):
            controller = Hcp2Controller(remote, 5)
            with pytest.raises(NoReply, match="the program that owns the line did not reply"):
                await controller.read(1, finish_within=0.05)
            with pytest.raises(WriteUnconfirmed, match="the program that owns the line did not reply"):
                await controller.write(1, 5, finish_within=0.05)
            way.open.set()
            await until(lambda: line.records)

    asyncio.run(run())


def test_the_wait_for_a_place_counts_as_time_of_a_request_whose_owner_says_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.sequences.MOST_UNDER_WAY", 1)
    monkeypatch.setattr("busmaster.app.service.link.GRACE", 0.0)
    never = 10 * PATIENCE

    async def run() -> None:
        async with behind_a_stopped_way(tmp_path) as (_, remote, way):
            controller = Hcp2Controller(remote, 5)
            asked: dict[type[Exception], Coroutine[Any, Any, object]] = {
                NoReply: controller.read(1, finish_within=never),
                WriteUnconfirmed: controller.write(1, 5, finish_within=never),
            }
            for error, request in asked.items():
                first = asyncio.ensure_future(controller.read(1))
                await asyncio.sleep(0)  # it has the place
                second = asyncio.ensure_future(request)
                await asyncio.sleep(0)
                monkeypatch.setattr(remote, "_ahead", remote._ahead + never)  # the second has waited for that long
                first.cancel()
                with pytest.raises(error, match="the program that owns the line did not reply"):
                    await second
            way.open.set()

    asyncio.run(run())


def test_the_owners_clock_is_known_as_well_as_the_quickest_answer_tells_it(tmp_path: Path) -> None:
    async def run() -> None:
        async with (
            asyncio.timeout(PATIENCE),
            served(tmp_path, listen=("127.0.0.1", 0)) as line,
            by_way(line) as (way, address),
        ):
            remote = connect(address)
            opening = asyncio.ensure_future(remote.__aenter__())
            await until(lambda: line.service.clients)  # the next result answers the first question for the time
            way.slow_once = 1.0
            await opening
            assert not way.slow_once
            assert time.monotonic() - remote.now() < 0.5
            await remote.__aexit__(None, None, None)

    asyncio.run(run())


def test_the_owners_clock_is_read_again_because_two_clocks_drift_apart(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock: Any = SimpleNamespace(ahead=0.0, monotonic=lambda: time.monotonic() + clock.ahead)
    monkeypatch.setattr(remote_module, "time", clock)
    monkeypatch.setattr(remote_module, "CLOCK_PERIOD", 0.02)

    async def run() -> None:
        async with (
            asyncio.timeout(PATIENCE),
            served(tmp_path, listen=("127.0.0.1", 0)) as line,
            by_way(line) as (way, address),
        ):
            async with connect(address) as remote:
                controller = Hcp2Controller(remote, 5)

                def behind() -> float:
                    now = remote.now()
                    return time.monotonic() - now

                for clock.ahead in (3.0, -3.0, 500.0, 0.0):
                    await until(lambda: abs(behind()) < 0.2)
                    assert behind() >= 0, "never ahead: an old write would seem to be new"
                    assert await controller.read(1, start_within=2) == 0
                way.slow_once = 0.5
                await until(lambda: not way.slow_once)
                for _ in range(3):  # a slow reply permits many offsets, and changes nothing
                    assert await controller.read(1, start_within=2) == 0
                    assert 0 <= behind() < 0.2
                [following] = [task for task in asyncio.all_tasks() if "_follow_clock" in str(task)]
            await asyncio.wait([following])
            assert following.cancelled()

    asyncio.run(run())


def test_a_write_to_all_makes_the_samples_of_each_node_stale(tmp_path: Path) -> None:
    async def run() -> None:
        line = Line(MentorDrive.profile.line, [make_device("mentor", 14)], paced=False)
        async with (
            asyncio.timeout(PATIENCE),
            Bus(MemoryPort(line)) as bus,
            Service(bus, path=tmp_path / "line.sock") as service,
            connect(service.address) as remote,
        ):
            point = MentorDrive(remote, 14).point("1.17")
            group = remote.poll_group("mine", period=60, points=[point])
            await group.ready()
            cycles = group.subscribe()
            bus.groups[0].demand()
            snapshot = await anext(cycles)
            assert point.node.latest(point) is snapshot[point]
            touched: list[Mapping[str, object]] = []
            remote.on_touched.append(touched.append)
            await MentorDrive(bus, 14).write_all("1.17", 20)
            await MentorDrive(remote, 14).read("1.18")  # what was told before has come
            assert point.node.latest(point) is None
            assert [(body["all"], body["items"]) for body in touched] == [(True, None)]

    asyncio.run(run())


def test_two_programs_that_ask_for_the_safe_state_have_it_sent_once(tmp_path: Path) -> None:
    async def story(line, service, remote, records):  # type: ignore[no-untyped-def]  # as `Story` says
        async with connect(service.address) as other:
            asking = asyncio.ensure_future(remote.enter_safe_state({"winder/speed": 0, "gone/speed": 0}))
            await until(lambda: service.line.safe_writes.under_way)
            both = await other.enter_safe_state({"winder/speed": 0, "gone/speed": 0}), await asking
        assert [list(outcomes) for outcomes in both] == [["winder/speed", "gone/speed"]] * 2
        assert sorted(record.point for record in records) == ["gone/speed", "winder/speed"]

    on_a_safe_line(tmp_path, TEXT + BOTH, story)


@pytest.mark.parametrize("host", ["localhostX", "localhost.evil.example", "xlocalhost", "busmaster.evil.example", ""])
def test_only_our_own_names_are_let_in(host: str, tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        reader, writer = await asyncio.open_unix_connection(line.address.removeprefix("unix:"))
        writer.write(
            f"GET / HTTP/1.1\r\nHost: {host}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
            "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
        )
        assert b" 101 " not in (await reader.readline())
        writer.close()
        assert line.service.clients == ()

    on_a_line(tmp_path, story)


def test_points_that_a_group_gets_are_told_to_who_reads_it(tmp_path: Path) -> None:
    async def story(line: Served) -> None:
        one, two = (Hcp2Controller(line.bus, node).point("1") for node in (5, 6))
        group = line.bus.poll_group("fast", period=0.01, points=[one])
        async with connect(line.address) as remote:
            theirs = remote.group("fast")
            cycles = theirs.subscribe()
            assert len(await anext(cycles)) == 1
            group.add(two)
            while len(await anext(cycles)) == 1:
                pass
            assert [point.key for point in theirs.points] == [one.key, two.key]
        group.close()

    on_a_line(tmp_path, story)


def test_who_came_by_tcp_without_a_token_goes_when_tokens_are_introduced(tmp_path: Path) -> None:
    access = Access(tokens={"web": Permission("token web", Role.WRITE)})

    async def run() -> None:
        async with (
            asyncio.timeout(PATIENCE),
            served(tmp_path, access=access, listen=("127.0.0.1", 0)) as line,
        ):
            address = line.service.tcp_address
            assert address is not None
            remote = connect(address)
            await remote.__aenter__()
            assert await Hcp2Controller(remote, 5).read(1) == 0
            line.authorisation.take_secrets({"web": hashlib.sha256(b"secret").digest()})
            await line.alone()
            with pytest.raises((LineDown, ConnectionClosed)):
                await Hcp2Controller(remote, 5).read(1)
            await remote.__aexit__(None, None, None)
            with pytest.raises((LineDown, InvalidStatus)):
                async with connect(address):
                    pass

    asyncio.run(run())
