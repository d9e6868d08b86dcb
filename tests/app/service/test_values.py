"""What a value is said as between programs, that it comes back as it was, and what it is written as."""

from __future__ import annotations

import asyncio
import json
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest

from busmaster import Bus, Hcp2Controller, InvalidCommand, MemoryPort, RemoteBus, Service, connect
from busmaster.app.service.messages import encode_json, value_of
from busmaster.emulator.line import Line
from busmaster.registry import find, make_device
from tests.app.service.lines import Served, on_a_served_line, raw
from tests.patience import PATIENCE


@pytest.mark.parametrize(
    "value", [None, True, 1, 12.5, "a\n", (1, (2, 3)), inf, -inf, frozenset(), frozenset({0, 5, 31}), (frozenset({7}),)]
)
def test_a_value_comes_back_as_it_was(value: Any) -> None:
    assert value_of(json.loads(encode_json(value))) == value


def test_what_is_no_number_comes_back_too() -> None:
    assert str(value_of(json.loads(encode_json((nan,))))) == "(nan,)"


def test_what_cannot_be_said_is_refused() -> None:
    with pytest.raises(TypeError, match="a complex cannot be sent"):
        encode_json(1j)


@pytest.mark.parametrize(
    ("protocol", "item", "written", "refused"),
    [
        ("hcp2", "10", [1, 0], [True, False]),
        ("microflex", "command_word", [1], [True]),
        ("modbus", "holding:5", [1], [True, [True]]),
        ("modbus", "holding:5:2", [[1, 0]], [[True, 0], [1, False], [[True], 0]]),
        ("modbus", "coil:5", [True, 1, False, 0], [2, 0.5, "true"]),
        ("modbus", "coil:5:2", [[True, False], [1, 0]], [[True, 2], True]),
        ("msc", "flag:5", [True, 1, False, 0], [2, -1]),
        ("mentor", "1.21", [True, 1, False], []),  # one digit, where a number has five characters: for a bit
        ("ct-ansi", "1.21", [True, 1, False], []),
    ],
)
def test_true_is_written_where_the_line_has_a_form_for_it_and_is_no_number(
    protocol: str, item: str, written: list[Any], refused: list[Any], tmp_path: Path
) -> None:
    async def run() -> None:
        kind = find(protocol)
        port = MemoryPort(Line(kind.profile.line, [make_device(protocol, 14)], paced=False))
        async with (
            asyncio.timeout(PATIENCE),
            Bus(port) as bus,
            Service(bus, path=tmp_path / "line.sock") as service,
            connect(service.address) as remote,
        ):
            point = kind.handle(bus, 14).point(item)
            bus.poll_group("all", period=1.0, points=[point])
            view = await remote.overview(lambda *_: None)
            for value in written:
                await view.write("all", point.key, value)
                assert await point.read() == (tuple(value) if isinstance(value, list) else value)
            for value in refused:
                with pytest.raises(InvalidCommand):
                    await view.write("all", point.key, value)

    asyncio.run(run())


def test_a_truth_that_is_refused_says_which_number_to_write_and_is_on_record(tmp_path: Path) -> None:
    async def story(line: Served, remote: RemoteBus) -> None:
        line.bus.poll_group("axes", period=1.0, points=[Hcp2Controller(line.bus, 5).point("10")])
        view = await remote.overview(lambda *_: None)
        for value, said in ((True, "True is not a number: write 1"), (False, "False is not a number: write 0")):
            with pytest.raises(InvalidCommand, match=said):
                await view.write("axes", "5/10", value)
        assert line.audit() == [("5/10", "refused")] * 2
        async with raw(line) as client:  # a raw command: `[true]` was written as 1
            await client.ask("node", protocol="hcp2", address=5)
            command = {"command": "write", "element": 10, "values": [True]}
            answer = await client.ask("request", protocol="hcp2", address=5, command=command)
            assert "True is not a number: write 1" in answer["error"]["message"]
        assert await Hcp2Controller(remote, 5).read(10) == 0

    on_a_served_line(tmp_path, story)
