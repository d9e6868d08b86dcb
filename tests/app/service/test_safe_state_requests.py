"""The safe state of a line that is sent because another program asks for it."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from busmaster import Hcp2Controller, MemoryPort, RemoteBus, Service, connect
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.authorisation import SafeWrites
from busmaster.app.service.permission import Access, Permission
from busmaster.app.service.record import WriteRecord
from busmaster.app.service.rights import Role
from busmaster.app.service.safe import SafeStateRequests
from busmaster.emulator.line import Line
from busmaster.errors import BacklogFull, BusError, InvalidCommand, NoReply, Superseded, WriteUnconfirmed
from busmaster.registry import make_device
from tests.app.service.lines import PATIENT, raw, until
from tests.app.service.test_requests import READ
from tests.patience import PATIENCE

TEXT = """
port = "/dev/ttyUSB0?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 5
points.speed = { item = "10", minimum = 100, maximum = 500 }
[nodes.gone]
protocol = "hcp2"
address = 9
points.speed = { item = "10" }
"""
SAFE = '[safe]\nwithin = 5.0\nrepeatable = ["winder/speed"]\nwrites = { "winder/speed" = 0 }\n'
BOTH = """
[safe]
within = 0.3
repeatable = ["winder/speed", "gone/speed"]
writes = { "winder/speed" = 0, "gone/speed" = 0 }
"""
Story = Callable[[ConfiguredLine, Service, RemoteBus, list[WriteRecord]], Awaitable[None]]


def on_a_line(folder: Path, text: str, story: Story) -> None:
    async def run() -> None:
        port = MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False))
        line = ConfiguredLine(read(Source("line.toml", text)), port=port, outputs=False)
        records: list[WriteRecord] = []
        line.authorisation.record = records.append
        async with (
            asyncio.timeout(PATIENCE),
            line,
            Service(line.bus, authorisation=line.authorisation, path=folder / "line.sock") as service,
            connect(service.address) as remote,
        ):
            await story(line, service, remote, records)

    asyncio.run(run())


@pytest.mark.slow
def test_it_passes_limits_ends_what_waited_and_leaves_the_line_open(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, _: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        controller = Hcp2Controller(remote, 5)
        await controller.write(10, 300)
        absent = asyncio.ensure_future(Hcp2Controller(line.bus, 8, timings=PATIENT).read(1))
        await asyncio.sleep(0)  # the line waits for its answer, and the write for the line
        waiting = asyncio.ensure_future(Hcp2Controller(line.bus, 5).write(10, 400))
        await asyncio.sleep(0)
        assert await remote.enter_safe_state({"winder/speed": 0}) == {"winder/speed": None}
        with pytest.raises(Superseded):
            await waiting
        with pytest.raises(NoReply):
            await absent
        assert await controller.read(10) == 0
        await controller.write(10, 200)
        assert [(one.interface, one.value) for one in records if one.interface == "safe"] == [("safe", 0)]
        assert "process" in next(one.by for one in records if one.interface == "safe")

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_what_was_decided_before_does_not_undo_it(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, _: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        controller = Hcp2Controller(remote, 5)
        before = controller.node.stops
        await remote.enter_safe_state({"winder/speed": 0})
        command = controller._write_command(10, (400.0,))
        with pytest.raises(Superseded):
            await controller.node.request(command, stops_seen=before)

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_a_point_that_is_not_confirmed_is_told_with_its_error(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, _: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        outcomes = await remote.enter_safe_state({"winder/speed": 0, "gone/speed": 0})
        assert list(outcomes) == ["winder/speed", "gone/speed"]
        assert isinstance(outcomes["gone/speed"], BusError)

    on_a_line(tmp_path, TEXT + BOTH, story)


def test_it_is_sent_to_the_end_when_whoever_asked_for_it_has_gone(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        async with connect(service.address) as other:
            asking = asyncio.ensure_future(other.enter_safe_state({"winder/speed": 0, "gone/speed": 0}))
            await until(lambda: service.line.safe_writes.under_way)
        with pytest.raises(WriteUnconfirmed):
            await asking
        await until(lambda: len(records) == 2)
        assert {record.point for record in records} == {"winder/speed", "gone/speed"}
        assert service.clients[0].permission.writes  # the other program is where it was

    on_a_line(tmp_path, TEXT + BOTH, story)


def held_back(monkeypatch: pytest.MonkeyPatch) -> asyncio.Event:
    """Do not send the safe state before the event that is returned is set."""
    send, go_on = SafeStateRequests._send, asyncio.Event()

    async def hold(requests: SafeStateRequests, state: SafeWrites, by: str) -> dict[str, Any]:
        await go_on.wait()
        return await send(requests, state, by)

    monkeypatch.setattr(SafeStateRequests, "_send", hold)
    return go_on


def test_who_waits_for_it_has_one_request_more_that_is_not_answered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_REQUESTS", 1)

    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        meant = held_back(monkeypatch)
        asking = asyncio.ensure_future(remote.enter_safe_state({"winder/speed": 0}))
        await until(lambda: service.line.safe_writes.under_way)
        assert service.clients[0].requests.sends_safe_state, "it keeps its place for that long"
        with pytest.raises(BacklogFull, match="1 requests of this program have no reply yet"):
            await Hcp2Controller(remote, 5).read(10)
        meant.set()
        assert await asking == {"winder/speed": None}
        assert [client.requests.sends_safe_state for client in service.clients] == [False]
        assert await Hcp2Controller(remote, 5).read(10) == 0

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_its_number_is_that_of_no_other_request(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        go_on = held_back(monkeypatch)
        served: Any = service
        for method in ("safe", "request"):
            params = {"writes": {"winder/speed": 0}} if method == "safe" else READ
            async with raw(served) as client:
                await client.say(id=7, method="safe", params={"writes": {"winder/speed": 0}})
                await client.say(id=7, method=method, params=params)
                assert "request 7 is already in progress" in (await client.hear())["error"]["message"]
        go_on.set()
        await until(lambda: records)

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_it_is_sent_although_it_is_cancelled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        go_on = held_back(monkeypatch)
        served: Any = service
        async with raw(served) as client:
            await client.say(id=7, method="safe", params={"writes": {"winder/speed": 0}})
            await client.say(method="cancel", params={"id": 7})
            assert "result" in await client.ask("now")
            go_on.set()
            assert (await client.hear()) == {"jsonrpc": "2.0", "id": 7, "result": {"winder/speed": None}}
        assert [record.ok for record in records] == [True]

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_it_is_sent_again_when_it_is_requested_again_and_at_once_only_once(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        for count in (1, 2):
            both = await asyncio.gather(*(remote.enter_safe_state({"winder/speed": 0}) for _ in range(2)))
            assert both == [{"winder/speed": None}] * 2
            assert not service.line.safe_writes.under_way
            assert len(records) == count
        await Hcp2Controller(remote, 5).write(10, 200)  # the line goes on

    on_a_line(tmp_path, TEXT + SAFE, story)


@pytest.mark.asyncio
async def test_it_is_cancelled_when_the_owner_ends_which_sends_it_itself() -> None:
    authorisation: Any = None
    requests = SafeStateRequests(authorisation)
    await requests.close()  # there is none
    sending: Any = asyncio.ensure_future(asyncio.Event().wait())
    requests._sending = sending
    await asyncio.sleep(0)
    assert requests.under_way
    async with asyncio.timeout(PATIENCE):
        await requests.close()
    assert sending.cancelled()
    assert not requests.under_way


def test_who_waits_for_it_when_the_owner_ends_is_informed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def hold(*_: object) -> dict[str, Any]:
        await asyncio.Event().wait()
        return {}

    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        monkeypatch.setattr(SafeStateRequests, "_send", hold)
        asking = asyncio.ensure_future(remote.enter_safe_state({"winder/speed": 0}))
        await until(lambda: service.line.safe_writes.under_way)
        await service.__aexit__(None, None, None)
        with pytest.raises(WriteUnconfirmed, match="the program that owns the line ends"):
            await asking
        await service.__aenter__()  # for its context to leave

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_a_part_of_it_is_another_safe_state(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        for other, shown in (({}, "nothing"), ({"winder/speed": 0}, "winder/speed = 0")):
            with pytest.raises(InvalidCommand, match=f"gone/speed = 0, not {shown}; reload its file"):
                await remote.enter_safe_state(other)
        assert records == []

    on_a_line(tmp_path, TEXT + BOTH, story)


def test_ordinary_requests_that_wait_do_not_keep_it_from_the_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.service.client.MOST_REQUESTS", 1)
    monkeypatch.setattr("busmaster.app.service.client.MOST_URGENT", 1)

    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        go_on = held_back(monkeypatch)
        reading = asyncio.ensure_future(Hcp2Controller(remote, 8, timings=PATIENT).read(10))  # no such device
        await until(lambda: service.clients and service.clients[0].unfinished)
        entering = asyncio.ensure_future(remote.enter_safe_state({"winder/speed": 0}))
        await until(lambda: service.line.safe_writes.under_way)
        with pytest.raises(BacklogFull, match="2 requests of this program have no reply yet"):
            await remote.enter_safe_state({"winder/speed": 0})
        go_on.set()
        assert await entering == {"winder/speed": None}
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_it_is_for_those_who_may_write_all_of_it_and_expect_it(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, _: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        with pytest.raises(InvalidCommand, match="has the safe state winder/speed = 0, not winder/speed = 1"):
            await remote.enter_safe_state({"winder/speed": 1})
        for permission, complaint in (
            (Permission("user me", Role.READ), "user me may read this line"),
            (Permission("user me", Role.WRITE, {("hcp2", 9): None}), "user me may not write this"),
        ):
            line.authorisation.access = Access(users={os.getuid(): permission})
            with pytest.raises(InvalidCommand, match=complaint):
                await remote.enter_safe_state({"winder/speed": 0})
        line.authorisation.access = Access()
        line.authorisation.read_only = True
        with pytest.raises(InvalidCommand, match="this line is read-only"):
            await remote.enter_safe_state({"winder/speed": 0})
        assert records == []

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_while_it_is_being_sent_it_is_still_for_those_who_may_write_all_of_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def story(line: ConfiguredLine, service: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        go_on = held_back(monkeypatch)
        entering = asyncio.ensure_future(remote.enter_safe_state({"winder/speed": 0}))
        await until(lambda: service.line.safe_writes.under_way)
        with pytest.raises(InvalidCommand, match="has the safe state winder/speed = 0, not winder/speed = 1"):
            await remote.enter_safe_state({"winder/speed": 1})
        line.authorisation.access = Access(users={os.getuid(): Permission("user me", Role.READ)})
        with pytest.raises(InvalidCommand, match="user me may read this line"):
            await remote.enter_safe_state({"winder/speed": 0})
        line.authorisation.access = Access()
        go_on.set()
        assert await entering == {"winder/speed": None}

    on_a_line(tmp_path, TEXT + SAFE, story)


def test_it_is_the_same_in_another_order_of_its_points(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, _: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        outcomes = await remote.enter_safe_state({"gone/speed": 0, "winder/speed": 0})
        assert outcomes.keys() == {"winder/speed", "gone/speed"}

    on_a_line(tmp_path, TEXT + BOTH, story)


def test_a_line_without_a_safe_state_says_so(tmp_path: Path) -> None:
    async def story(line: ConfiguredLine, _: Service, remote: RemoteBus, records: list[WriteRecord]) -> None:
        with pytest.raises(InvalidCommand, match="has no safe state; stop it, then send yours"):
            await remote.enter_safe_state({"winder/speed": 0})

    on_a_line(tmp_path, TEXT, story)
