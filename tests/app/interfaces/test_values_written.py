"""Which values REST takes: numbers of any JSON form, true and false for coils, and the names of labels."""

from __future__ import annotations

import contextlib
from collections.abc import AsyncIterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from busmaster import Bus, MemoryPort, ModbusUnit, Service
from busmaster.bus.meaning import Meaning
from busmaster.emulator.line import Line
from busmaster.registry import make_device
from tests.app.interfaces.lines import Page, page, shows
from tests.app.service.lines import until

MODES = {0: "off", 1: "jog", 7: "run", 8: "run"}
ALARMS: dict[str, Any] = {"alarm_if_set": ("FAULT",), "alarm_if_clear": ("READY",)}
BITS = ("FAULT", "READY")
REGISTER, COIL, MODE = (f"/api/points/press/1/{item}" for item in ("holding:5", "coil:5", "holding:6"))


@contextlib.asynccontextmanager
async def press(folder: Path) -> AsyncIterator[tuple[ModbusUnit, Page]]:
    """A served Modbus unit and its page."""
    line = Line(ModbusUnit.profile.line, [make_device("modbus", 1)], paced=False)
    async with Bus(MemoryPort(line)) as bus:
        unit = ModbusUnit(bus, 1)
        mode = replace(unit.point("holding:6"), meaning=Meaning(labels=MODES))
        status = replace(unit.point("holding:7"), meaning=Meaning(bits={"FAULT": 0, "READY": 1}, **ALARMS))
        points = [unit.point("holding:5"), unit.point("coil:5"), mode, *status.bits]
        bus.poll_group("press", period=0.02, points=points)
        async with Service(bus, path=folder / "line.sock"), page(folder) as of:
            await shows(of.line)
            yield unit, of


@pytest.mark.parametrize(
    ("path", "body", "item", "stored"),
    [
        (REGISTER, "7", "holding:5", 7),
        (REGISTER, "7.0", "holding:5", 7),
        (REGISTER, "7e2", "holding:5", 700),
        (COIL, "true", "coil:5", True),
        (COIL, "1", "coil:5", True),
        (COIL, "1.0", "coil:5", True),
        (MODE, '"jog"', "holding:6", 1),
        (MODE, "1", "holding:6", 1),
    ],
)
@pytest.mark.asyncio
async def test_a_value_is_written_in_each_form_that_means_it(
    tmp_path: Path, path: str, body: str, item: str, stored: int
) -> None:
    async with press(tmp_path) as (unit, of):
        headers = {"Content-Type": "application/json"}
        answer = await of.client.put(path, content=f'{{"value": {body}}}', headers=headers)
        assert answer.status_code == 200, answer.text
        assert await unit.read(item) == stored


@pytest.mark.parametrize(
    ("path", "value", "words"),
    [
        (REGISTER, 7.5, "whole number, not 7.5"),
        (REGISTER, True, "whole number, not True"),
        (COIL, 7, "a coil is written 1 or 0, not 7"),
        (COIL, "on", "a coil is written 1 or 0, not 'on'"),
        (MODE, "fast", "'fast' is the label of no value: use 'off', 'jog', 'run'"),
        (MODE, "run", "more than one value"),
    ],
)
@pytest.mark.asyncio
async def test_a_value_that_means_nothing_is_refused_in_plain_words(
    tmp_path: Path, path: str, value: object, words: str
) -> None:
    async with press(tmp_path) as (unit, of):
        answer = await of.client.put(path, json={"value": value})
        assert answer.status_code == 400
        assert words in answer.json()["what"]
        assert [await unit.read(item) for item in ("holding:5", "coil:5", "holding:6")] == [0, False, 0]


@pytest.mark.asyncio
async def test_a_bit_that_is_an_alarm_is_reported_as_set_or_clear(tmp_path: Path) -> None:
    async with press(tmp_path) as (unit, of):
        await unit.write("holding:7", 1)
        alarms = {row.item: row for row in of.line.picture.rows}
        await until(lambda: [alarms[f"holding:7.{name}"].alarm for name in BITS] == ["set", "clear"])
        await unit.write("holding:7", 2)
        await until(lambda: [alarms[f"holding:7.{name}"].alarm for name in BITS] == ["", ""])
