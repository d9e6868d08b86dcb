"""What a file says may be written, tried through the file's names, through others, and through none."""

from __future__ import annotations

import asyncio

import pytest

from busmaster.app.config import FileError, LineFile, emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.bus.node import Node, Priority
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import InvalidCommand, NodeDown
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device
from tests.stories import in_virtual_time

HEAD = 'port = "/dev/ttyUSB0?baudrate=57600"\n'
NODE = '[nodes.winder]\nprotocol = "hcp2"\naddress = 5\n'
POINTS = """[nodes.winder.points]
speed = { item = "10", unit = "m/min", factor = 0.06, minimum = 0, maximum = 100, max_step = 60 }
pace = { item = "10" }
ready = { item = "11", writable = false }
"""


SAFE_PLACES = [
    ("hcp", "address = 5", "10"),
    ("hcp2", "address = 5", "10"),
    ("mentor", "address = 14", "1.17"),
    ("ct-ansi", "address = 14", "1.21"),
    ("dc104", "", "12"),
    ("msc", "address = 3", "2008"),
    ("modbus", "address = 17", "holding:40"),
]


def file(points: str) -> LineFile:
    return read(Source("line.toml", HEAD + NODE + points))


def parse(points: str) -> ConfiguredLine:
    return ConfiguredLine(file(points), outputs=False)


def emulated(points: str) -> ConfiguredLine:
    line = Line(hcp2.PROFILE.line, [make_device("hcp2", 5)])
    return ConfiguredLine(file(points), port=MemoryPort(line), outputs=False)


@in_virtual_time
async def test_a_limit_is_in_the_points_unit_and_holds_under_every_alias() -> None:
    async with emulated(POINTS) as line:
        speed, pace = line.point("winder/speed"), line.point("winder/pace")
        await speed.write(60)
        await speed.write(100)
        assert await pace.read() == pytest.approx(1666.6667)
        for work in (
            speed.write(100.01),
            pace.write(1667),
            line.nodes["winder"].write(10, 1667),
            line.point("winder/10").write(1667),
            line.nodes["winder"].node.request(hcp2.Write(9, (1.0, 1667.0))),
        ):
            with pytest.raises(InvalidCommand, match=r"winder: speed = .* m/min is above its maximum of 100 m/min"):
                await work
        with pytest.raises(InvalidCommand, match=r"winder: speed = 39 m/min is too far from 100"):
            await pace.write(650)


@in_virtual_time
async def test_what_is_not_writable_is_so_under_every_name() -> None:
    async with emulated(POINTS) as line:
        assert not line.point("winder/ready").writable
        for work in (line.point("winder/ready").write(1), line.point("winder/11").write(1)):
            with pytest.raises(InvalidCommand, match=r"read-only|writable = false"):
                await work


@in_virtual_time
async def test_a_file_that_is_read_again_holds_its_limits_anew_and_those_of_the_program_stay() -> None:
    async with emulated(POINTS) as line:
        speed = line.point("winder/speed")
        await speed.write(60)
        speed.limit(minimum=30)
        await line.take(
            file(POINTS.replace("maximum = 100", "maximum = 150").replace("max_step = 60", "max_step = 90"))
        )
        speed = line.point("winder/speed")
        await speed.write(150)
        for value, limit in ((151, "maximum of 150"), (20, "minimum of 30"), (59, "max_step is 90")):
            with pytest.raises(InvalidCommand, match=f"winder: .*{limit}"):
                await speed.write(value)
        await line.take(file("[nodes.winder.points]\nspeed = { item = '10' }\n"))
        await line.point("winder/speed").write(9_000)
        with pytest.raises(InvalidCommand, match="minimum of 30"):
            await line.point("winder/speed").write(400)
        await line.point("winder/11").write(1)


@in_virtual_time
async def test_a_write_that_waits_for_its_value_before_is_held_to_the_limits_of_a_file_read_meanwhile() -> None:
    async with emulated(POINTS) as line:
        waiting = asyncio.ensure_future(line.point("winder/speed").write(50))
        await asyncio.sleep(0)
        assert not waiting.done()
        await line.take(file(POINTS.replace("maximum = 100", "maximum = 40")))
        with pytest.raises(InvalidCommand, match="maximum of 40"):
            await waiting
        assert await line.point("winder/speed").read() == 0


SAFE = """[safe]
repeatable = ["winder/speed"]
writes = { "winder/speed" = 0 }
"""


@pytest.mark.parametrize(("kind", "address", "item"), SAFE_PLACES, ids=str)
@in_virtual_time
async def test_no_limit_holds_the_safe_state(kind: str, address: str, item: str) -> None:
    node = f'[nodes.winder]\nprotocol = "{kind}"\n{address}\n[nodes.winder.points]\n'
    text = f'{node}speed = {{ item = "{item}", minimum = 5, maximum = 100, max_step = 1 }}\n{SAFE}'
    parsed = read(Source("line.toml", HEAD + text))
    async with ConfiguredLine(parsed, port=MemoryPort(emulated_line(parsed)), outputs=False) as line:
        await line.point("winder/speed").write(40, priority=Priority.URGENT)
        with pytest.raises(InvalidCommand, match="minimum of 5"):
            await line.point("winder/speed").write(0, priority=Priority.URGENT)
        assert await line.safe_state.enter(line.authorisation, "a test") == {"winder/speed": None}
        assert await line.point("winder/speed").read() == 0


@in_virtual_time
async def test_a_node_that_somebody_has_suspended_is_left_safely_too() -> None:
    async with emulated(f"{POINTS}{SAFE}") as line:
        winder = Node.of(line.nodes["winder"])
        winder.suspend(60.0)
        with pytest.raises(NodeDown, match="suspended"):
            await line.point("winder/speed").write(30)
        assert await line.safe_state.enter(line.authorisation, "a test") == {"winder/speed": None}


@in_virtual_time
async def test_a_file_that_is_read_again_keeps_its_groups_but_those_whose_points_mean_something_else() -> None:
    text = f"{POINTS}[groups.axes]\nperiod = 0.1\npoints = ['winder/speed']\n"
    async with emulated(text) as line:
        await line.point("winder/speed").write(60, priority=Priority.URGENT)
        before = line.groups["axes"]
        await line.take(file(text))
        assert line.groups["axes"] is before
        await line.take(file(text.replace("0.06", "0.6")))
        [speed] = (await anext(line.groups["axes"].subscribe())).values()
        assert speed.value == pytest.approx(600)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[nodes.winder.points]\na = { item = '1', minimum = 2, maximum = 1 }", "minimum of 2 is above its maximum"),
        ("[nodes.winder.points]\na = { item = '1', max_step = 0 }", "max_step is more than 0"),
        ("[nodes.winder.points]\na = { item = '1', decimals = 2 }", "use factor = 0.01"),
        ("timing = { late_after = 50 }", "must be at most 10, in seconds; for 50 ms write 0.05"),
        ("[groups.axes]\nperiod = 1\npoints = []", "a group without points"),
    ],
)
def test_what_means_nothing_is_an_error_that_says_what_to_write(text: str, said: str) -> None:
    with pytest.raises(FileError, match=said):
        parse(text)


RUN = """port = "/dev/ttyUSB0?baudrate=9600"
[nodes.press]
protocol = "msc"
address = 1
address_step = 1
[nodes.press.points]
cams = { item = "2008:3", factor = 0.1 }
cam = { item = "2009", factor = 0.1, maximum = 5 }
"""


def pressing() -> ConfiguredLine:
    parsed = read(Source("line.toml", RUN))
    return ConfiguredLine(parsed, port=MemoryPort(emulated_line(parsed)), outputs=False)


@in_virtual_time
async def test_a_scaled_run_is_written_by_its_scale_and_with_the_options_of_the_caller() -> None:
    async with pressing() as line:
        cams = line.point("press/cams")
        await cams.write([1.5, 5, 0])
        assert await line.nodes["press"].read(2008, 3) == (15, 50, 0)
        assert await cams.read() == (1.5, 5, 0)
        with pytest.raises(InvalidCommand, match="maximum of 5"):
            await cams.write([1.5, 6, 0])
        await cams.write([1.5, 6, 0], safe=True)
        assert await cams.read() == (1.5, 6, 0)


@in_virtual_time
async def test_neither_a_point_that_is_not_writable_nor_a_bit_is_written_as_the_protocols_own_point() -> None:
    text = (
        "[nodes.winder.points]\nready = { item = '11', writable = false }\nstate = { item = '12', bits = { ON = 1 } }\n"
    )
    async with emulated(text) as line:
        before = await line.nodes["winder"].read(11, 2)
        for name in ("winder/ready", "winder/state.ON"):
            with pytest.raises(InvalidCommand, match="read-only"):
                await line.point(name).write(1, safe=True)
        assert await line.nodes["winder"].read(11, 2) == before
