"""What a listener makes of another master's telegrams: one of them may tell several points, written or read."""

from __future__ import annotations

import json
import random
import time
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import anyio
import anyio.lowlevel
import pytest

from busmaster.app.cli.overheard import HeardGroup, Overheard, feed, only_protocol, silent
from busmaster.app.config import emulated_line, load
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.bus.polling import Snapshot
from busmaster.capture.decode import Decoder
from busmaster.contract.tap import Attempt
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import GarbledReply, InvalidCommand
from busmaster.protocols.ct_ansi.handle import CtAnsiDrive
from busmaster.protocols.dc104.handle import Dc104Drive
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.mentor.handle import MentorDrive
from busmaster.protocols.modbus.handle import ModbusUnit
from busmaster.protocols.msc.handle import MscController
from busmaster.registry import find
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.patience import PATIENCE

FILE = """
port = "/dev/ttyUSB0"
[nodes.drive]
protocol = "{kind}"
{options}
points = {{ a = {{ item = "{a}", factor = 0.5 }}, b = {{ item = "{b}" }} }}
[groups.all]
period = 3600
points = ["drive/a", "drive/b"]
"""
Master = Callable[[Any], AsyncIterator[None]]
"""Yields when the listener is to begin."""


class Heard:
    """A tap that tells a listener nothing but bytes: not who spoke, nor what was meant."""

    def __init__(self, kind: str, overheard: Overheard) -> None:
        self._decoder = Decoder(find(kind).protocol.dialect())
        self._overheard = overheard

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        for frame in self._decoder.feed(data, now):
            self._overheard.heard(frame)

    received = transmitted

    def attempted(self, attempt: Attempt, /) -> None:
        pass


def heard(kind: str, options: str, a: str, b: str, master: Master) -> dict[str, Any]:
    """What is heard of points a, which is half of what the line carries, and b."""
    file = read(Source("line.toml", FILE.format(kind=kind, options=options, a=a, b=b)))
    listener = ConfiguredLine(file, outputs=False)
    points = listener.members("all")
    overheard = Overheard(find(kind).protocol, points, lambda: 0.0)
    overheard.groups.append(HeardGroup("all", 3600, points, 0.0))

    async def story() -> None:
        random.seed(1)
        line = ConfiguredLine(file, port=MemoryPort(emulated_line(file)), outputs=False, tap=Heard(kind, overheard))
        async with line.bus:
            async for _ in master(line.nodes["drive"]):
                overheard.groups[0].turn(0.0, 0.0)  # what was said so far does not count

    run_in_virtual_time(story())
    snapshot = overheard.groups[0].turn(0.0, 0.0)
    return {point.item: sample.value for point, sample in snapshot.samples.items()} if snapshot else {}


async def comms_list(drive: Hcp2Controller) -> AsyncIterator[None]:
    yield
    await drive.write(10, 20.0, 3.0)


async def comms_reads(drive: Hcp2Controller) -> AsyncIterator[None]:
    await drive.write(10, 20.0, 3.0)
    yield
    await drive.read(10)


async def modbus_block(drive: ModbusUnit) -> AsyncIterator[None]:
    yield
    await drive.write("holding:99", 1, 20, 3, 4)


async def modbus_block_read(drive: ModbusUnit) -> AsyncIterator[None]:
    await drive.write("holding:99", 1, 20, 3, 4)
    yield
    await drive.read("holding:90:30")


async def modbus_half(drive: ModbusUnit) -> AsyncIterator[None]:
    yield
    await drive.read("holding:100:2")


async def modbus_coils(drive: ModbusUnit) -> AsyncIterator[None]:
    yield
    await drive.write("coil:4", 1, 0, 1)


async def msc_block(drive: MscController) -> AsyncIterator[None]:
    yield
    await drive.write_block(1992, [0, 0, 20, 3] + [0] * 28)


async def msc_block_read(drive: MscController) -> AsyncIterator[None]:
    await drive.write(2000, 20)
    await drive.write(2004, 3)
    yield
    await drive.read(1996, 32)


async def msc_flags(drive: MscController) -> AsyncIterator[None]:
    yield
    await drive.set_flag(200)
    await drive.clear_flag(201)


async def msc_all_flags(drive: MscController) -> AsyncIterator[None]:
    await drive.set_flag(200)
    yield
    await drive.flags()


async def mentor_writes(drive: MentorDrive) -> AsyncIterator[None]:
    yield
    await drive.write("1.17", 20)
    await drive.write("1.18", 3)


async def mentor_run(drive: MentorDrive) -> AsyncIterator[None]:
    await drive.write("1.17", 20)
    await drive.write("1.18", 3)
    yield
    await drive.read("1.17", 2)


async def mentor_backwards(drive: MentorDrive) -> AsyncIterator[None]:
    await drive.write("1.17", 20)
    await drive.write("1.18", 3)
    yield
    await drive.read("1.18", 2, step=-1)


async def mentor_to_all(drive: MentorDrive) -> AsyncIterator[None]:
    """Nobody says that he has it."""
    yield
    await drive.write_all("1.17", 20)


async def ct_ansi_writes(drive: CtAnsiDrive) -> AsyncIterator[None]:
    yield
    await drive.write("1.21", 20)
    await drive.write("1.22", 3)


async def dc104_writes(drive: Dc104Drive) -> AsyncIterator[None]:
    yield
    await drive.write(12, 20)
    await drive.write(13, 3)


async def dc104_read(drive: Dc104Drive) -> AsyncIterator[None]:
    await drive.write(12, 20)
    yield
    await drive.read(12)


BOTH = {"a": 10, "b": 3}
STORIES: list[tuple[str, str, str, str, Master, dict[str, Any]]] = [
    ("hcp2", "address = 5", "10", "11", comms_list, BOTH),
    ("hcp2", "address = 5", "10", "11", comms_reads, {"a": 10}),
    ("hcp", "address = 5", "10", "11", comms_list, BOTH),
    ("modbus", "address = 17", "holding:100", "holding:101", modbus_block, BOTH),
    ("modbus", "address = 17", "holding:100", "holding:101", modbus_block_read, BOTH),
    ("modbus", "address = 17", "holding:100", "holding:101:2", modbus_half, {"a": 0}),
    ("modbus", "address = 17", "coil:5", "coil:6", modbus_coils, {"a": False, "b": True}),
    ("msc", "address = 3\naddress_step = 4", "2000", "2004", msc_block, BOTH),
    ("msc", "address = 3\naddress_step = 4", "2000", "2004", msc_block_read, BOTH),
    ("msc", "address = 3\naddress_step = 4", "2000", "2001", msc_block, {"a": 10}),
    ("msc", "address = 3", "1996", "2000", msc_block_read, {"a": 0}),
    ("msc", "address = 3", "flag:200", "flag:201", msc_flags, {"a": True, "b": False}),
    ("msc", "address = 3", "flag:200", "flag:201", msc_all_flags, {"a": True, "b": False}),
    ("mentor", "address = 14", "1.17", "1.18", mentor_writes, BOTH),
    ("mentor", "address = 14", "1.17", "1.18", mentor_run, BOTH),
    ("mentor", "address = 14", "1.17", "1.18", mentor_backwards, BOTH),
    ("mentor", "address = 14", "1.17", "1.18", mentor_to_all, {}),
    ("ct-ansi", "address = 14", "1.21", "1.22", ct_ansi_writes, BOTH),
    ("dc104", "", "12", "13", dc104_writes, BOTH),
    ("dc104", "", "12", "13", dc104_read, {"a": 10}),
]


@pytest.mark.parametrize(
    ("kind", "options", "a", "b", "master", "values"),
    STORIES,
    ids=[f"{story[0]} {getattr(story[4], '__name__', '')} {story[1][-8:]}" for story in STORIES],
)
def test_one_telegram_tells_all_its_points(
    kind: str, options: str, a: str, b: str, master: Master, values: dict[str, Any]
) -> None:
    assert heard(kind, options, a, b, master) == values


# the file of a listener


def test_a_listener_takes_no_commands_from_any_output(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(
        FILE.format(kind="hcp2", options="address = 5", a="10", b="11")
        + '[outputs.mqtt]\nallow_commands = ["drive/b"]\n[outputs.sqlite]\npath = "x.sqlite"\n'
    )
    file = load(path)
    outputs = silent(file).outputs
    assert outputs["mqtt"].allow_commands == ()  # type: ignore[attr-defined]  # of the subclass
    assert outputs["sqlite"] == file.outputs["sqlite"]
    assert file.outputs["mqtt"].allow_commands  # type: ignore[attr-defined]  # of the subclass


@pytest.mark.parametrize(
    ("kinds", "protocol"),
    [(["hcp2"], "hcp2"), (["microflex", "microflex"], "microflex"), (["hcp2", "microflex"], "hcp2")],
)
def test_a_listener_reads_the_one_protocol_of_the_file(kinds: list[str], protocol: str) -> None:
    nodes = {str(number): SimpleNamespace(protocol=kind) for number, kind in enumerate(kinds)}
    assert only_protocol(SimpleNamespace(nodes=nodes)) == protocol  # type: ignore[arg-type]  # a stand-in


def test_a_listener_reads_no_file_with_two_protocols() -> None:
    nodes = {str(number): SimpleNamespace(protocol=kind) for number, kind in enumerate(("mentor", "hcp2"))}
    with pytest.raises(InvalidCommand, match="one protocol per line, and the file has hcp2, mentor"):
        only_protocol(SimpleNamespace(nodes=nodes))  # type: ignore[arg-type]  # a stand-in


FED = """
port = "/dev/ttyUSB0"
[nodes.drive]
protocol = "hcp2"
address = 5
points = { a = { item = "10", high = 5 }, b = { item = "11" } }
[groups.fast]
period = 0.02
points = ["drive/a"]
[groups.slow]
period = 0.05
points = ["drive/b", "drive/a"]
[groups.slowest]
period = 3600
points = ["drive/b"]
[outputs.jsonl]
path = "FOLDER/line.jsonl"
"""


def test_each_group_is_fed_at_its_period_and_what_is_left_at_the_end_is_written_too(tmp_path: Path) -> None:
    (tmp_path / "line.toml").write_text(FED.replace("FOLDER", str(tmp_path)))
    line = ConfiguredLine(load(tmp_path / "line.toml"))
    points = [point for name in line.file.groups for point in line.members(name)]
    overheard = Overheard(find("hcp2").protocol, points, time.monotonic)
    shown: list[Snapshot] = []
    alarms: list[Any] = []

    async def listen() -> None:
        async for event in line.bus.events():
            alarms.append(event)  # noqa: PERF401  it is cancelled

    async def story() -> None:
        async with anyio.create_task_group() as tasks:
            tasks.start_soon(listen)
            await anyio.lowlevel.checkpoint()
            tasks.start_soon(feed, line, overheard, shown.append)
            with anyio.fail_after(PATIENCE):
                while len(overheard.groups) < 3:  # noqa: ASYNC110  nothing reports it
                    await anyio.sleep(0.001)
                for value in (4.0, 9.0):
                    overheard._deliver({points[0]: value, points[1]: value + 1}, time.monotonic())
                    count = len(shown)
                    while len({one.group for one in shown[count:]}) < 2:  # noqa: ASYNC110  nothing reports it
                        await anyio.sleep(0.001)
            tasks.cancel_scope.cancel()

    anyio.run(story)
    fast = [one for one in shown if one.group == "fast"]
    assert [[sample.value for sample in one.samples.values()] for one in fast] == [[4.0], [9.0]]
    assert [one.cycle for one in fast] == [1, 2]
    slow = [one for one in shown if one.group == "slow"]
    assert [sample.value for one in slow for sample in one.samples.values()] == [4.0, 5.0, 9.0, 10.0]
    assert [type(event).__name__ for event in alarms] == ["AlarmChanged"]
    kept = [json.loads(text) for text in (tmp_path / "line.jsonl").read_text().splitlines()]
    # the last group's only period is the one in which it ended
    assert {one["group"] for one in kept if "group" in one} == {"fast", "slow", "slowest"}


def test_a_listener_without_groups_waits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "line.toml").write_text(FED.replace("FOLDER", str(tmp_path)).partition("[groups")[0])
    line = ConfiguredLine(load(tmp_path / "line.toml"))
    waits: list[float] = []

    async def sleep(seconds: float) -> None:
        waits.append(seconds)
        raise EOFError

    monkeypatch.setattr("busmaster.app.cli.overheard.anyio.sleep", sleep)
    with pytest.raises(EOFError):
        anyio.run(feed, line, Overheard(find("hcp2").protocol, [], time.monotonic), lambda _: None)
    assert waits == [pytest.approx(1.0, abs=0.5)]


def group_of_two() -> tuple[HeardGroup, list[Any]]:
    line = ConfiguredLine(
        read(Source("line.toml", FILE.format(kind="hcp2", options="address = 5", a="10", b="11"))), outputs=False
    )
    points = line.members("all")
    return HeardGroup("all", 10.0, points, 100.0), list(points)


def sample_at(finished: float, value: float) -> Any:
    return SimpleNamespace(finished=finished, value=value)


def test_a_group_keeps_to_its_grid_and_counts_only_periods_with_values() -> None:
    group, [a, b] = group_of_two()
    streams = [group.subscribe(10) for _ in range(2)]
    assert group.due == 110.0
    assert group.turn(110.5, 0.0) is None
    assert group.due == 120.0
    group.take(a, sample_at(111.0, 1))
    group.take(a, sample_at(115.0, 2))
    group.take(b, sample_at(113.0, 3))
    first = group.turn(121.0, 7.0)
    assert first is not None
    assert (first.cycle, first.due, first.started, first.finished) == (1, 120.0, 113.0, 121.0)
    assert [sample.value for sample in first.samples.values()] == [2, 3]
    assert group.turn(158.0, 0.0) is None  # after a standstill
    assert group.due == 150.0
    group.take(b, sample_at(159.0, 4))
    second = group.turn(160.0, 0.0)
    assert second is not None
    assert (second.cycle, len(second.samples)) == (2, 1)
    group.close()

    async def received(stream: Any) -> list[int]:
        return [snapshot.cycle async for snapshot in stream]

    assert [anyio.run(received, stream) for stream in streams] == [[1, 2], [1, 2]]


def test_a_value_that_a_point_cannot_have_does_not_keep_the_others_from_being_heard() -> None:
    group, [a, b] = group_of_two()

    class Refusing:
        def value_of(self, raw: Any) -> Any:
            raise GarbledReply("it is not a value")

    overheard = Overheard(find("hcp2").protocol, [], lambda: 5.0)
    overheard.groups += [HeardGroup("more", 10.0, [a, b], 100.0), group]
    refusing: Any = Refusing()
    overheard._deliver({refusing: 1, a: 4.0, b: 3.0}, 9.0)
    for one in overheard.groups:
        snapshot = one.turn(0.0, 0.0)
        assert snapshot is not None
        assert list(snapshot.samples) == [a, b]
    before = time.monotonic()
    overheard._deliver({a: 4.0}, 9.0)  # by a clock that was set back
    snapshot = group.turn(0.0, 0.0)
    assert snapshot is not None
    [sample] = snapshot.samples.values()
    assert before <= sample.finished <= time.monotonic()  # never of the future
