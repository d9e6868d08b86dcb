"""A limit holds on every way to write a quantity, under every name of it; and a stop passes during each refusal."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.cli.parsing import Assignment
from busmaster.app.cli.write import pass_on, prepare
from busmaster.app.config import emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.mqtt_commands import Answer, Commands
from busmaster.app.service.client_messages import WriteParams
from busmaster.app.service.client_requests import client_request_of
from busmaster.app.service.line import ServedLine
from busmaster.app.service.peers import Process
from busmaster.app.service.permission import EVERYTHING
from busmaster.app.service.record import Outcome, WriteRecord
from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.health import NodeRecord
from busmaster.bus.node import Node
from busmaster.bus.requester import ORDINARY, Priority
from busmaster.contract.exchange import Command
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import BusError, InvalidCommand, Superseded
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.testing.virtual_time import run_in_virtual_time

FILE = """
port = "/dev/ttyUSB0"
[nodes.drive]
protocol = "{kind}"
{options}
[nodes.drive.points]
speed = {{ item = "{item}", {limit} }}
pace = {{ item = "{item}" }}
[groups.all]
period = 3600
points = ["drive/speed", "drive/pace"]
[safe]
repeatable = ["drive/{safe}"]
writes = {{ "drive/{safe}" = 0 }}
"""
BEFORE = 40


@dataclass(frozen=True)
class Kind:
    """How a quantity is written in one protocol: alone, and in the midst of others."""

    name: str
    options: str
    item: str
    alone: Callable[[int], Command[None]]
    several: Callable[[int], Command[None]] | None = None
    first: str = ""
    """The item before it, from which two values are written."""
    broadcasts: bool = False


KINDS = [
    Kind("hcp2", "address = 5", "10", lambda v: hcp2.Write(10, (v,)), lambda v: hcp2.Write(9, (1, v)), "9"),
    Kind("hcp", "address = 5", "10", lambda v: hcp.Write(10, (v,)), lambda v: hcp.Write(9, (1, v)), "9"),
    Kind("mentor", "address = 14", "1.18", lambda v: mentor.Write(1, 18, v), None, "1.17", True),
    Kind("ct-ansi", "address = 14", "1.22", lambda v: ct_ansi.Write(1, 22, v), None, "1.21", True),
    Kind("dc104", "", "12", lambda v: dc104.Write(12, v), None, "11"),
    Kind(
        "msc",
        "address = 3\naddress_step = 4",
        "2008",
        lambda v: msc.DataWrite(2008, v),
        lambda v: msc.BlockWrite(2004, (1, v, *range(30))),
    ),
    Kind(
        "modbus",
        "address = 17",
        "holding:40",
        lambda v: modbus.WriteRegisters(40, (v,)),
        lambda v: modbus.WriteRegisters(39, (1, v)),
        "holding:39",
        True,
    ),
]
LIMITS = {
    "minimum": ("minimum = 5", 3, "its minimum of 5"),
    "maximum": ("maximum = 100", 101, "its maximum of 100"),
    "max_step": ("max_step = 10", 60, "its max_step is 10"),
    "not writable": ("writable = false", 50, "writable = false|read-only"),
}


class Plant:
    """A line that runs, whose drive holds BEFORE."""

    def __init__(self, kind: Kind, line: ConfiguredLine) -> None:
        self.kind = kind
        self.line = line
        self.handle = line.nodes["drive"]
        self.node = Node.of(self.handle)
        self.records: list[WriteRecord] = []
        line.authorisation.record = self.records.append

    async def held(self) -> Any:
        return await self.line.point(f"drive/{self.kind.item}").read()

    async def stop(self) -> None:
        """Write 0, as what stops a drive does."""
        self.node.note_stop()
        await self.node.request(self.kind.alone(0), stop=True, priority=Priority.URGENT)


async def by_handle(plant: Plant, value: int) -> None:
    item = plant.kind.item
    await plant.handle.write(int(item) if item.isdecimal() else item, value)


async def by_command(plant: Plant, value: int) -> None:
    await plant.node.request(plant.kind.alone(value))


async def by_command_in_midst(plant: Plant, value: int) -> None:
    assert plant.kind.several is not None
    await plant.node.request(plant.kind.several(value))


async def by_list(plant: Plant, value: int) -> None:
    for send in plant.handle._prepare_write(plant.kind.first, (1, value)):
        await send()


async def by_broadcast(plant: Plant, value: int) -> None:
    everyone = plant.line.bus.node(plant.node.profile, 0)
    await everyone.request(plant.kind.alone(value))


def by_point(name: str) -> Callable[[Plant, int], Awaitable[None]]:
    async def write(plant: Plant, value: int) -> None:
        await plant.line.point(f"drive/{name or plant.kind.item}").write(value)

    return write


def by_mqtt(name: str) -> Callable[[Plant, int], Awaitable[None]]:
    async def write(plant: Plant, value: int) -> None:
        key = f"drive/{name}"
        answers: asyncio.Queue[Answer] = asyncio.Queue()
        commands = Commands("line", plant.line.authorisation, {key: plant.line.point(key)}, plant.line.bus.now)
        commands.arrive(
            SimpleNamespace(  # type: ignore[arg-type]  # all that is looked at of a message
                topic=f"line/set/{key}", payload=str(value).encode(), retain=False, properties=None
            )
        )
        authorisation = plant.line.authorisation
        serving = asyncio.ensure_future(
            commands.serve(authorisation.write, authorisation.refuse, answers.put, lambda: 0)
        )
        try:
            answer = await answers.get()
        finally:
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
        raise_if(answer.error)

    return write


class Person:
    """Who looks at the line, and writes by a key."""

    peer = Process(1, 0, (), "busmaster")
    permission = EVERYTHING
    rights = EVERYTHING.rights
    reads = ORDINARY

    def node(self, name: str, address: int, /) -> Node:
        raise AssertionError("a person names points")

    @property
    def turn(self) -> LineClient:
        raise AssertionError("a person reads nothing")

    def client_of(self, sequence: int | None, node: Node, /) -> LineClient:
        return node._shared.add_client(1.0)

    def stops_before(self, node: Node, /) -> int:
        return 0

    def takes_stop(self, node: Node, /) -> bool:
        return False

    def notify_stops(self, node: NodeRecord, /) -> None:
        pass


def by_key(name: str) -> Callable[[Plant, int], Awaitable[None]]:
    async def write(plant: Plant, value: int) -> None:
        params = WriteParams("all", f"drive/{name}", value)
        request = client_request_of(params, Person(), ServedLine(plant.line.bus, plant.line.authorisation, 1.0, ""))
        ended: asyncio.Future[BaseException | None] = asyncio.get_running_loop().create_future()
        request.begin(lambda _, __, error: ended.set_result(error))
        if (error := await ended) is not None:
            raise error

    return write


def by_command_line(name: str) -> Callable[[Plant, int], Awaitable[None]]:
    async def write(plant: Plant, value: int) -> None:
        key = f"drive/{name or plant.kind.item}"
        await pass_on(plant.line, *prepare(plant.line, Assignment(key, (value,)), False))

    return write


def raise_if(error: str) -> None:
    if error:
        raise InvalidCommand(error)


PATHS = {
    "handle": by_handle,
    "command": by_command,
    "command in the midst": by_command_in_midst,
    "list": by_list,
    "broadcast": by_broadcast,
    "point": by_point("speed"),
    "alias": by_point("pace"),
    "item": by_point(""),
    "mqtt": by_mqtt("speed"),
    "mqtt alias": by_mqtt("pace"),
    "key": by_key("speed"),
    "key alias": by_key("pace"),
    "command line": by_command_line("speed"),
    "command line alias": by_command_line("pace"),
    "command line item": by_command_line(""),
}
OUTSIDE = ("mqtt", "mqtt alias", "key", "key alias", "command line", "command line alias", "command line item")


def in_plant(
    kind: Kind,
    limit: str,
    story: Callable[[Plant], Awaitable[None]],
    *,
    read_only: bool = False,
    safe: str = "pace",
) -> None:
    text = FILE.format(kind=kind.name, options=kind.options, item=kind.item, limit=limit, safe=safe)
    file = read(Source("line.toml", text))

    async def run() -> None:
        line = ConfiguredLine(file, port=MemoryPort(emulated_line(file)), outputs=False, read_only=read_only)
        async with line:
            plant = Plant(kind, line)
            await anext(aiter(line.groups["all"]))
            await plant.node.request(kind.alone(BEFORE), safe=True)
            assert await plant.held() == BEFORE
            await story(plant)

    run_in_virtual_time(run())


def is_a_way(kind: Kind, path: str) -> bool:
    """Whether anything can be written so: not every protocol has telegrams of several values, or to all."""
    ways = {"command in the midst": kind.several is not None, "list": bool(kind.first), "broadcast": kind.broadcasts}
    return ways.get(path, True)


kinds = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.name)
paths = pytest.mark.parametrize(
    ("kind", "path"),
    [pytest.param(kind, path, id=f"{kind.name} by {path}") for kind in KINDS for path in PATHS if is_a_way(kind, path)],
)
limits = pytest.mark.parametrize("limit", LIMITS)


@limits
@paths
def test_a_limit_is_named_and_nothing_is_written(kind: Kind, limit: str, path: str) -> None:
    text, value, said = LIMITS[limit]

    async def story(plant: Plant) -> None:
        exchanges = (await plant.line.bus.statistics()).exchanges
        with pytest.raises(InvalidCommand, match=said):
            await PATHS[path](plant, value)
        looked = limit == "max_step"  # what it holds is read first
        one_by_one = looked and path == "list" and kind.several is None  # and the item before it is written
        assert (await plant.line.bus.statistics()).exchanges == exchanges + looked + one_by_one
        assert await plant.held() == BEFORE
        assert [record.outcome for record in plant.records] == [Outcome.REFUSED] * (path in OUTSIDE)

    in_plant(kind, text, story)


@limits
@paths
def test_a_stop_passes_while_another_write_is_refused(kind: Kind, limit: str, path: str) -> None:
    text, value, said = LIMITS[limit]

    async def story(plant: Plant) -> None:
        async def write() -> str:
            with pytest.raises((InvalidCommand, Superseded)) as refused:
                await PATHS[path](plant, value)
            return str(refused.value)

        refused = asyncio.ensure_future(write())
        await asyncio.sleep(0)  # it is under way: at a limit, or at the read that a step needs
        await plant.stop()
        assert await plant.held() == 0
        assert re.search(f"{said}|overtaken by an urgent write", await refused)
        assert await plant.held() == 0

    in_plant(kind, text, story)


@kinds
@limits
def test_the_safe_state_passes_every_limit_and_is_on_record(kind: Kind, limit: str) -> None:
    text, value, _ = LIMITS[limit]

    async def story(plant: Plant) -> None:
        refused = asyncio.ensure_future(by_point("pace")(plant, value))
        await asyncio.sleep(0)
        assert await plant.line.safe_state.enter(plant.line.authorisation, "a test") == {"drive/pace": None}
        with pytest.raises((InvalidCommand, BusError)):
            await refused
        assert await plant.held() == 0
        [record] = plant.records
        assert (record.interface, record.point, record.value, record.outcome) == (
            "safe",
            "drive/pace",
            0,
            Outcome.WRITTEN,
        )

    in_plant(kind, text, story)


@kinds
def test_a_safe_write_may_go_by_its_item_alone(kind: Kind) -> None:
    async def story(plant: Plant) -> None:
        assert await plant.line.safe_state.enter(plant.line.authorisation, "a test") == {f"drive/{kind.item}": None}
        assert await plant.held() == 0

    in_plant(kind, "minimum = 5", story, safe=kind.item)


@kinds
@pytest.mark.parametrize("path", ["mqtt", "mqtt alias", "key", "key alias"])
def test_a_line_that_is_read_only_takes_nothing_from_outside_but_its_own_safe_state(kind: Kind, path: str) -> None:
    async def story(plant: Plant) -> None:
        with pytest.raises(InvalidCommand, match="this line is read-only"):
            await PATHS[path](plant, 41)
        assert await plant.held() == BEFORE
        assert await plant.line.safe_state.enter(plant.line.authorisation, "a test") == {"drive/pace": None}
        assert await plant.held() == 0
        assert [record.outcome for record in plant.records] == [Outcome.REFUSED, Outcome.WRITTEN]

    in_plant(kind, "minimum = 5", story, read_only=True)


@paths
def test_within_its_limits_it_is_written(kind: Kind, path: str) -> None:
    """Else the refusals above prove nothing."""

    async def story(plant: Plant) -> None:
        await PATHS[path](plant, 45)
        assert await plant.held() == 45

    in_plant(kind, "minimum = 5, maximum = 100, max_step = 10", story)
