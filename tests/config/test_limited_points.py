"""What a file says may be written, tried through the file's names, through others, and through none."""

from __future__ import annotations

import pytest

from busmaster.config import ConfiguredLine, FileError
from busmaster.config.sections import read
from busmaster.config.source import Source
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import InvalidCommand
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.registry import make_device

HEAD = 'port = "/dev/ttyUSB0?baudrate=57600"\n'
NODE = '[nodes.winder]\nprotocol = "hcp2"\naddress = 5\n'
POINTS = """[nodes.winder.points]
speed = { item = "10", unit = "m/min", factor = 0.06, minimum = 0, maximum = 100, max_step = 60 }
pace = { item = "10" }
ready = { item = "11", writable = false }
"""


def parse(points: str) -> ConfiguredLine:
    return ConfiguredLine(read(Source("line.toml", HEAD + NODE + points)), outputs=False)


def emulated(points: str) -> ConfiguredLine:
    line = Line(hcp2.PROFILE.line, [make_device("hcp2", 5)])
    return ConfiguredLine(read(Source("line.toml", HEAD + NODE + points)), port=MemoryPort(line), outputs=False)


@pytest.mark.asyncio
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


@pytest.mark.asyncio
async def test_what_is_not_writable_is_so_under_every_name() -> None:
    async with emulated(POINTS) as line:
        assert not line.point("winder/ready").writable
        for work in (line.point("winder/ready").write(1), line.point("winder/11").write(1)):
            with pytest.raises(InvalidCommand, match=r"read-only|writable = false"):
                await work


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("[nodes.winder.points]\na = { item = '1', minimum = 2, maximum = 1 }", "minimum of 2 is above its maximum"),
        ("[nodes.winder.points]\na = { item = '1', max_step = 0 }", "max_step is more than 0"),
        ("[nodes.winder.points]\na = { item = '1', decimals = 2 }", "write factor = 0.01"),
        ("timing = { nominal = 50 }", "times are in seconds, 10 at most: for 50 ms write 0.05"),
        ("[groups.axes]\nperiod = 1\npoints = []", "a group without points"),
    ],
)
def test_what_means_nothing_is_an_error_that_says_what_to_write(text: str, said: str) -> None:
    with pytest.raises(FileError, match=said):
        parse(text)
