"""Dc104Drive over a drive that keeps a table of parameters."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.bus.node import Priority
from busmaster.contract.exchange import Command
from busmaster.errors import InvalidCommand, VerifyFailed
from busmaster.protocols.dc104.codec import Read, Write
from busmaster.protocols.dc104.handle import Dc104Drive
from tests.handles.fake_bus import FakeBus


class Parameters(FakeBus):
    """No parameter is above 1000."""

    def __init__(self) -> None:
        super().__init__(self.obey)
        self.parameters: dict[int, int] = {}

    def obey(self, command: Command[Any]) -> int | None:
        if isinstance(command, Write):
            self.parameters[command.parameter] = min(command.value, 1000)
            return None
        assert isinstance(command, Read)
        return self.parameters.get(command.parameter, 0)


@pytest.fixture
def line() -> Parameters:
    return Parameters()


@pytest.mark.asyncio
async def test_a_written_parameter_is_read_back(line: Parameters) -> None:
    drive = Dc104Drive(line)
    await drive.write(12, 500, verify=True)
    assert await drive.read(12, priority=Priority.URGENT) == 500
    assert line.asked == ["write parameter 12 = 500", "read parameter 12", "read parameter 12"]
    assert repr(drive) == "<Dc104Drive the drive>"


@pytest.mark.asyncio
async def test_a_value_is_read_back_with_the_priority_of_its_write(line: Parameters) -> None:
    await Dc104Drive(line).write(12, 500, 501, verify=True, priority=Priority.BACKGROUND)
    assert [priority for _, _, priority in line.log] == [Priority.BACKGROUND] * 4


@pytest.mark.asyncio
async def test_a_value_that_the_drive_limits_fails_its_verification(line: Parameters) -> None:
    for values in ((1500,), (1500, 7), (7, 1500)):
        limited = 12 + values.index(1500)
        with pytest.raises(VerifyFailed, match=f"parameter {limited} reads 1000 after 1500 was written"):
            await Dc104Drive(line).write(12, *values, verify=True)


@pytest.mark.asyncio
async def test_a_parameter_is_a_point(line: Parameters) -> None:
    point = Dc104Drive(line).point("12")
    await point.write(7)
    assert await point.read() == 7
    assert point == Dc104Drive(line).parameter(12)
    assert point.key == "0/12"


@pytest.mark.asyncio
async def test_what_the_drive_does_not_have_is_never_sent(line: Parameters) -> None:
    drive = Dc104Drive(line, maximum=120)
    with pytest.raises(InvalidCommand):
        await drive.read(121)
    for wrong in (0, 121):
        with pytest.raises(InvalidCommand):
            await drive.write(wrong, 1)
    with pytest.raises(InvalidCommand):
        await drive.write(1, 65536)
    for item in ("121", "0", "x", "-1", ""):
        with pytest.raises(InvalidCommand):
            drive.point(item)
    assert line.asked == []


@pytest.mark.asyncio
async def test_parameter_0_is_there_for_those_who_allow_it(line: Parameters) -> None:
    drive = Dc104Drive(line, allow_zero=True)
    await drive.write(0, 1)
    assert await drive.read(0) == 1
    await drive.point("0").write(1)


def test_there_is_one_drive_a_line(line: Parameters) -> None:
    with pytest.raises(InvalidCommand):
        Dc104Drive(line, 1)
    with pytest.raises(InvalidCommand):
        Dc104Drive(line, maximum=256)
