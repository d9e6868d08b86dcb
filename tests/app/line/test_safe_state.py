"""The safe state of a file, as it reaches the nodes of an emulated line, in virtual time."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Awaitable, Callable, Mapping

import pytest

from busmaster import Hcp2Controller, MemoryPort
from busmaster.app.bounds import LONGEST_SAFE_STATE
from busmaster.app.config.sections import read
from busmaster.app.config.source import FileError, Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.service.record import Outcome, WriteRecord
from busmaster.bus.node import Node
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.errors import BusClosed, Refused, Superseded, WriteUnconfirmed
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.testing.virtual_time import run_in_virtual_time

TEXT = """
port = "/dev/ttyUSB0?baudrate=57600"
[nodes.gone]
protocol = "hcp2"
address = 1
points.speed = { item = "10" }
[nodes.winder]
protocol = "hcp2"
address = 2
points.refused = { item = "190" }
points.speed = { item = "10" }
points.force = { item = "11" }
"""
WITHIN = 5.0
NO_OTHERS: Mapping[str, float] = {}
Story = Callable[[ConfiguredLine, list[WriteRecord]], Awaitable[None]]


class Forgetful(EmulatedMint):
    """Confirms so many writes of 0 without carrying them out."""

    left = 0

    def write_element(self, element: int, value: float, now: float) -> bool:
        if value == 0 and self.left:
            self.left -= 1
            return True
        return super().write_element(element, value, now)


def on_a_line(
    story: Story, *safe: str, others: Mapping[str, float] = NO_OTHERS, gone: bool = False, forgetful: int = 0
) -> None:
    """Run it on a line whose safe state leaves these points at 0, and `others` at their values.

    Node 1 may be gone, and node 2 `forgetful` of so many writes.
    """

    async def run() -> None:
        winder = Forgetful(2, axes=1)
        winder.left = forgetful
        devices: list[Device] = [EmulatedMint(1), winder]
        devices[0].faults.dead = float(gone)
        values = {**dict.fromkeys(safe, 0.0), **others}
        points = [f'"{name}"' for name in values]
        writes = ", ".join(f'"{name}" = {value}' for name, value in values.items())
        text = f"{TEXT}[safe]\nwithin = {WITHIN}\nrepeatable = [{', '.join(points)}]\nwrites = {{ {writes} }}\n"
        port = MemoryPort(Line(Hcp2Controller.profile.line, devices, chance=random.Random(1)))
        line = ConfiguredLine(read(Source("line.toml", text)), port=port, outputs=False)
        records: list[WriteRecord] = []
        line.authorisation.record = records.append
        async with line:
            for element in (10, 11):
                await Hcp2Controller(line.bus, 2).write(element, 7)
            await story(line, records)

    run_in_virtual_time(run())


def test_a_node_that_is_gone_does_not_hold_up_the_others() -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        outcomes = await line.safe_state.enter(line.authorisation, "a test", leaving=False)
        assert list(outcomes) == ["gone/speed", "winder/speed"]
        assert outcomes["winder/speed"] is None
        assert [record.point for record in records] == ["winder/speed", "gone/speed"]
        assert records[0].took < WITHIN / 2
        assert records[1].took == pytest.approx(WITHIN, abs=0.5)
        assert await line.nodes["winder"].read(10) == 0

    on_a_line(story, "gone/speed", "winder/speed", gone=True)


def test_outcomes_are_in_the_order_of_the_file_also_where_it_goes_back_to_a_node() -> None:
    points = ("winder/speed", "gone/speed", "winder/force")

    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        assert list(await line.safe_state.enter(line.authorisation, "a test")) == [*points]

    on_a_line(story, *points)


def test_what_was_sent_and_could_not_be_sent_again_is_not_called_not_started() -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        outcomes = await line.safe_state.enter(line.authorisation, "a test")
        assert isinstance(outcomes["gone/speed"], WriteUnconfirmed)
        assert [record.outcome for record in records] == [Outcome.UNCONFIRMED]
        assert Node.of(line.nodes["gone"]).health.value == "down"  # what was tried last was not sent

    on_a_line(story, "gone/speed", gone=True)


def test_a_write_that_is_refused_does_not_keep_the_others_of_its_node_from_being_sent() -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        outcomes = await line.safe_state.enter(line.authorisation, "a test", leaving=False)
        assert isinstance(outcomes["winder/refused"], Refused)
        assert outcomes["winder/speed"] is outcomes["winder/force"] is None
        assert [await line.nodes["winder"].read(element) for element in (10, 11)] == [0, 0]

    on_a_line(story, "winder/refused", "winder/speed", "winder/force")


def test_a_node_that_is_suspended_is_left_in_its_safe_state_too() -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        Node.of(line.nodes["winder"]).suspend(100 * WITHIN)
        assert await line.safe_state.enter(line.authorisation, "a test") == {"winder/speed": None}

    on_a_line(story, "winder/speed")


def test_each_write_is_read_back_and_sent_again_until_it_reads_as_it_was_written() -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        assert await line.safe_state.enter(line.authorisation, "a test") == {"winder/speed": None}
        assert [record.outcome for record in records] == [Outcome.WRITTEN]
        assert await line.nodes["winder"].read(10) == 0

    on_a_line(story, "winder/speed", forgetful=3)


@pytest.mark.parametrize("values", [(0, 0), (0, 20), (20, 0), (20, 30)])
def test_writes_to_any_of_its_nodes_that_were_decided_or_queued_before_are_not_sent(
    values: tuple[float, float],
) -> None:
    """Also to a node that is not left at 0."""
    left = dict(zip(("gone", "winder"), values, strict=True))

    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        nodes = {name: Node.of(line.nodes[name]) for name in left}
        before = {name: node.stops for name, node in nodes.items()}
        reading = asyncio.ensure_future(line.nodes["gone"].read(20))
        await asyncio.sleep(0)  # the writes wait until it has its reply
        queued = [asyncio.ensure_future(line.nodes[name].write(10, 5)) for name in left]
        await asyncio.sleep(0)
        await line.safe_state.enter(line.authorisation, "a test", leaving=False)
        for writing in queued:
            with pytest.raises(Superseded):
                await writing
        assert await reading == 0
        for name, node in nodes.items():
            with pytest.raises(Superseded):
                await node.request(hcp2.Write(10, (5.0,)), stops_seen=before[name])
            assert await line.nodes[name].read(10) == left[name]
            await node.request(hcp2.Write(10, (5.0,)), stops_seen=node.stops)
            assert await line.nodes[name].read(10) == 5
        assert [(record.interface, record.by) for record in records] == 2 * [("safe", "a test")]

    on_a_line(story, others={f"{name}/speed": value for name, value in left.items()})


def test_a_write_that_was_decided_before_is_not_sent_to_a_node_that_keeps_its_values_either() -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        node = Node.of(line.nodes["winder"])
        before = node.stops
        await line.safe_state.enter(line.authorisation, "a test", leaving=False)
        with pytest.raises(Superseded):
            await node.request(hcp2.Write(10, (5.0,)), stops_seen=before)
        assert await line.nodes["winder"].read(10) == 7
        await node.request(hcp2.Write(10, (5.0,)), stops_seen=node.stops)
        assert await line.nodes["winder"].read(10) == 5

    on_a_line(story, "gone/speed")


def test_a_line_without_a_safe_state_takes_writes_as_before() -> None:
    async def run() -> None:
        file = read(Source("line.toml", TEXT))
        devices: list[Device] = [EmulatedMint(2)]
        port = MemoryPort(Line(Hcp2Controller.profile.line, devices, chance=random.Random(1)))
        async with ConfiguredLine(file, port=port, outputs=False) as line:
            assert await line.safe_state.enter(line.authorisation, "a test") == {}
            await line.nodes["winder"].write(10, 5)
            assert await line.nodes["winder"].read(10) == 5

    run_in_virtual_time(run())


def test_a_safe_state_ends_at_once_if_the_line_is_closed() -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        await line.bus.__aexit__(None, None, None)
        began = asyncio.get_running_loop().time()
        outcomes = await line.safe_state.enter(line.authorisation, "a test")
        assert isinstance(outcomes["winder/speed"], BusClosed)
        assert asyncio.get_running_loop().time() - began < WITHIN / 2

    on_a_line(story, "winder/speed")


def test_what_waits_for_the_line_waits_until_the_safe_state_is_sent() -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        drive = line.nodes["winder"]
        before = Node.of(drive).statistics().attempts
        reads = [asyncio.ensure_future(drive.read(20)) for _ in range(50)]
        await asyncio.sleep(0)
        assert await line.safe_state.enter(line.authorisation, "a test") == {"winder/speed": None}
        # those of one read that was under way, of the write, and of the read that verifies it
        assert Node.of(drive).statistics().attempts - before <= 5
        assert await asyncio.gather(*reads) == [0] * len(reads)

    on_a_line(story, "winder/speed")


def test_a_safe_value_is_in_the_unit_of_its_point() -> None:
    text = LIMITED.replace("maximum = 500", "maximum = 500, factor = 0.1").replace("POINT", "force")

    async def run() -> None:
        file = read(Source("line.toml", text.replace("VALUE", "12.5")))
        devices: list[Device] = [EmulatedMint(2)]
        port = MemoryPort(Line(Hcp2Controller.profile.line, devices, chance=random.Random(1)))
        async with ConfiguredLine(file, port=port, outputs=False) as line:
            assert await line.safe_state.enter(line.authorisation, "a test") == {"winder/force": None}
            assert await line.nodes["winder"].read(11) == 125

    run_in_virtual_time(run())


@pytest.mark.parametrize("leaving", [True, False])
def test_a_line_that_is_left_takes_no_other_write_and_one_that_is_not_left_does(leaving: bool) -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        drive = line.nodes["winder"]
        await line.safe_state.enter(line.authorisation, "a test", leaving=leaving)
        if leaving:
            with pytest.raises(Superseded):
                await drive.write(10, 5)
        else:
            await drive.write(10, 5)
        assert await drive.read(10) == (0 if leaving else 5)

    on_a_line(story, "winder/speed")


@pytest.mark.parametrize("leaving", [True, False])
def test_a_line_takes_writes_again_after_a_safe_state_that_was_cancelled_unless_it_is_left(leaving: bool) -> None:
    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        drive = line.nodes["winder"]
        entering = asyncio.ensure_future(line.safe_state.enter(line.authorisation, "a test", leaving=leaving))
        await asyncio.sleep(WITHIN / 2)  # node 1 is gone
        with pytest.raises(Superseded):
            await drive.write(10, 5)
        entering.cancel()
        with pytest.raises(asyncio.CancelledError):
            await entering
        assert [(record.point, record.outcome) for record in records] == [("gone/speed", Outcome.UNCONFIRMED)]
        if leaving:
            with pytest.raises(Superseded):
                await drive.write(10, 5)
        else:
            await drive.write(10, 5)
        assert await drive.read(10) == (7 if leaving else 5)

    on_a_line(story, "gone/speed", gone=True)


def test_a_line_takes_writes_again_after_a_safe_state_that_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(node: Node, seconds: float) -> None:
        raise RuntimeError("a bug")

    async def story(line: ConfiguredLine, records: list[WriteRecord]) -> None:
        monkeypatch.setattr(Node, "suspend", fail)
        with pytest.raises(BaseExceptionGroup):
            await line.safe_state.enter(line.authorisation, "a test", leaving=False)
        await line.nodes["winder"].write(10, 5)
        assert await line.nodes["winder"].read(10) == 5

    on_a_line(story, "winder/speed")


@pytest.mark.parametrize(
    ("allowed", "may_send"), [("*/speed", False), ("winder/speed,force", True), ("winder/force", False)]
)
def test_a_client_may_send_the_safe_state_if_it_may_write_each_of_its_points(allowed: str, may_send: bool) -> None:
    points = '"winder/speed", "winder/force"'
    safe = f'[safe]\nrepeatable = [{points}]\nwrites = {{ "winder/speed" = 0, "winder/force" = 0 }}\n'
    user = f'[service.users.root]\nrole = "write"\nallow_writes = "{allowed}"\n'
    line = ConfiguredLine(read(Source("line.toml", TEXT + safe + user)), outputs=False)
    refusal = line.safe_state.refusal(line.authorisation.access.users[0])
    assert (refusal == "") is may_send, refusal


LIMITED = """
port = "/dev/ttyUSB0?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 2
points.force = { item = "11", minimum = 10, maximum = 500 }
[safe]
repeatable = ["winder/POINT"]
writes = { "winder/POINT" = VALUE }
"""


@pytest.mark.parametrize("point", ["force", "11"])
@pytest.mark.parametrize(
    ("value", "problem"),
    [
        ("900", "force = 900 is above its maximum of 500"),
        ("5", "force = 5 is below its minimum of 10"),
        ("-1", "force = -1 is below its minimum of 10"),
        ("500", None),
        ("10", None),
        ("0", None),  # a stop
    ],
)
def test_a_safe_value_beyond_the_limits_of_its_point_is_rejected_when_the_file_is_read(
    point: str, value: str, problem: str | None
) -> None:
    text = LIMITED.replace("POINT", point).replace("VALUE", value)
    file = read(Source("line.toml", text))
    if problem is None:
        assert ConfiguredLine(file, outputs=False).safe_state.values == {f"winder/{point}": float(value)}
        return
    with pytest.raises(FileError) as rejected:
        ConfiguredLine(file, outputs=False)
    assert str(rejected.value).startswith("line.toml:9: ")
    assert problem in str(rejected.value)


def test_a_safe_state_may_take_as_long_as_the_bound() -> None:
    text = LIMITED.replace("POINT", "force").replace("VALUE", "0")
    assert read(Source("line.toml", f"{text}within = {LONGEST_SAFE_STATE}\n")).safe.within == LONGEST_SAFE_STATE
    with pytest.raises(FileError, match=f"safe.within: must be more than 0 and at most {LONGEST_SAFE_STATE:g} seconds"):
        read(Source("line.toml", f"{text}within = {LONGEST_SAFE_STATE + 0.1}\n"))


def test_a_run_of_values_cannot_be_left_safely_in_one() -> None:
    text = 'port = "/dev/ttyUSB0"\n[nodes.press]\nprotocol = "msc"\naddress = 1\naddress_step = 4\n'
    points = 'points.profile = { item = "3000:40" }\n'
    safe = '[safe]\nrepeatable = "press/profile"\nwrites = { "press/profile" = 0 }\n'
    with pytest.raises(
        FileError, match=r"line.toml:9: safe.writes.press/profile: .* is a run of values; write them one"
    ):
        ConfiguredLine(read(Source("line.toml", text + points + safe)), outputs=False)


def test_a_quantity_is_left_at_one_value_only() -> None:
    text = LIMITED.replace('"winder/POINT"]', '"winder/force", "winder/11"]')
    text = text.replace('"winder/POINT" = VALUE', '"winder/force" = 0, "winder/11" = 20')
    with pytest.raises(FileError, match=r"safe.writes.winder/11: is the same quantity as winder/force; remove one of"):
        ConfiguredLine(read(Source("line.toml", text)), outputs=False)


@pytest.mark.parametrize("value", ["0", "20"])
def test_a_safe_value_whose_write_may_not_be_repeated_is_rejected_also_for_a_stop(value: str) -> None:
    text = LIMITED.replace('repeatable = ["winder/POINT"]\n', "").replace("POINT", "force").replace("VALUE", value)
    with pytest.raises(FileError, match=r'is not repeatable by its protocol; .* add repeatable = \["winder/force"\]'):
        ConfiguredLine(read(Source("line.toml", text)), outputs=False)
