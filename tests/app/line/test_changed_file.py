"""What a line that runs makes of a changed file, on an emulated line, in virtual time."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest

from busmaster import MemoryPort
from busmaster.app.config import LineFile, emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.line.configured_line import check_same_line
from busmaster.bus.node import Node
from busmaster.errors import InvalidCommand
from busmaster.testing import run_in_virtual_time
from tests.stories import in_virtual_time

HEAD = 'port = "/dev/ttyUSB0?baudrate=57600"\n'
WINDER = '[nodes.winder]\nprotocol = "hcp2"\naddress = 5\npoints.speed = { item = "10", maximum = 100 }\n'
DRIVE = '[nodes.drive]\nprotocol = "hcp2"\naddress = 6\nreply_time = 0.03\npoints.force = { item = "11" }\n'
SAFE = '[safe]\nrepeatable = "winder/speed"\nwrites = { "winder/speed" = 0 }\n'


def group(name: str, *points: str, period: float = 0.1) -> str:
    return f"[groups.{name}]\nperiod = {period}\npoints = {list(points)!r}\n"


def file(text: str) -> LineFile:
    return read(Source("line.toml", HEAD + text))


def opened(text: str, *, outputs: bool = False) -> ConfiguredLine:
    with_all = file(WINDER + DRIVE)
    return ConfiguredLine(file(text), port=MemoryPort(emulated_line(with_all)), outputs=outputs)


@in_virtual_time
async def test_a_node_that_a_changed_file_adds_is_polled_and_one_that_it_removes_is_unknown() -> None:
    async with opened(WINDER + group("fast", "winder/speed")) as line:
        winder = line.nodes["winder"]
        await line.take(file(DRIVE + WINDER + group("slow", "drive/force") + group("fast", "winder/speed")))
        assert list(line.nodes) == ["drive", "winder"]
        assert line.nodes["winder"] is winder
        assert list(line.groups) == ["slow", "fast"]
        assert Node.of(line.nodes["drive"]).planned().reply_time == 0.03
        [force] = await anext(line.groups["slow"].subscribe())
        assert force == line.point("drive/force")
        await line.take(file(DRIVE + group("slow", "drive/force")))
        assert list(line.groups) == ["slow"]
        with pytest.raises(InvalidCommand, match="no such point 'winder/speed'; use NODE/ITEM, with a node of drive"):
            line.point("winder/speed")


@in_virtual_time
async def test_a_group_that_a_changed_file_does_not_have_ends_and_the_others_go_on() -> None:
    text = WINDER + group("fast", "winder/speed") + group("more", "winder/12")
    async with opened(text) as line:
        fast, more = line.groups["fast"], line.groups["more"]
        stream = more.subscribe()
        await line.take(file(text.replace("winder/12", "winder/13")))
        assert line.groups["fast"] is fast
        assert line.groups["more"] is not more
        assert [point.item for point in line.members("more")] == ["13"]
        async for _ in stream:  # it ends
            pass
        await line.take(file(text.replace("winder/12", "winder/13").replace("0.1", "0.2", 1)))
        assert line.groups["fast"] is not fast
        assert line.groups["fast"].period == 0.2


@in_virtual_time
async def test_the_safe_state_and_the_limits_are_those_of_the_changed_file() -> None:
    async with opened(WINDER) as line:
        assert not line.safe_state
        await line.take(file(f"{WINDER}{SAFE}"))
        assert line.safe_state.values == {"winder/speed": 0}
        assert line.authorisation.safe_state is line.safe_state
        assert line.safe_state.within == 2.0
        await line.take(file(f"{WINDER}{SAFE}within = 1.5\n".replace("= 0 }", "= 5 }")))
        assert line.safe_state.values == {"winder/speed": 5}
        assert line.authorisation.safe_state is line.safe_state
        assert line.safe_state.within == 1.5
        await line.take(file(WINDER))
        assert not line.safe_state


def test_outputs_are_those_of_the_changed_file(tmp_path: Path) -> None:
    text = WINDER + group("fast", "winder/speed")

    def output(name: str) -> str:
        return f'[outputs.jsonl]\npath = "{tmp_path / name}"\n'

    async def story() -> None:
        async with opened(text + output("one.jsonl"), outputs=True) as line:
            await asyncio.sleep(1.0)
            await line.take(file(text + output("two.jsonl")))
            await asyncio.sleep(1.0)
            await line.take(file(text))
            await asyncio.sleep(1.0)

    run_in_virtual_time(story())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["one.jsonl", "two.jsonl"]
    assert all(b"winder" in path.read_bytes() for path in tmp_path.iterdir())


@in_virtual_time
async def test_a_line_that_was_opened_without_outputs_has_none_of_the_changed_file_either() -> None:
    text = WINDER + group("fast", "winder/speed") + '[outputs.jsonl]\npath = "never-written.jsonl"\n'
    async with opened(text) as line:
        await line.take(file(text.replace("never", "not")))
        assert line.outputs.statistics() == ()


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("/dev/ttyUSB0", "/dev/ttyUSB1", "the port"),
        ("baudrate=57600", "baudrate=9600", "the port"),
        ("[nodes.winder]", "strict = true\n[nodes.winder]", "the port"),
        ("address = 5", "address = 7", "node 'winder'"),
        ('"hcp2"\naddress = 6', '"microflex"\naddress = 6', "node 'drive'"),
        ("reply_time = 0.03", "reply_time = 0.04", "node 'drive'"),
        ("[nodes.drive]", "[nodes.reel]", "node 'reel'"),
        ("[nodes.winder]", "[service]\nenabled = false\n[nodes.winder]", r"\[service\]"),
    ],
)
def test_another_port_or_other_settings_of_a_node_need_a_restart(old: str, new: str, what: str) -> None:
    text = HEAD + WINDER + DRIVE
    assert old in text
    before, after = (read(Source("line.toml", each)) for each in (text, text.replace(old, new, 1)))
    with pytest.raises(InvalidCommand, match=f"changes of {what} need a restart"):
        check_same_line(before, after)


@in_virtual_time
async def test_a_changed_file_may_name_a_template_for_a_node_that_had_none() -> None:
    drive = '[nodes.drive]\nprotocol = "microflex"\naddress = 6\n'
    async with ConfiguredLine(file(drive), port=MemoryPort(emulated_line(file(drive))), outputs=False) as line:
        await line.take(file(f'{drive}template = "microflex"\n'))
        assert line.point("drive/speed_measured").unit == line.file.nodes["drive"].points["speed_measured"].unit != ""


@pytest.mark.parametrize(("protocol", "restart"), [("hcp2", False), ("mentor", True)])
def test_decimals_of_a_point_need_a_restart_where_the_handle_applies_them(protocol: str, restart: bool) -> None:
    text = f'[nodes.screw]\nprotocol = "{protocol}"\naddress = 14\npoints.a = {{ item = "%s", factor = 0.1 }}\n'
    text %= "1.17" if restart else "10"
    before, after = file(text), file(text.replace("factor = 0.1", "decimals = 1" if restart else "factor = 0.01"))
    if restart:
        with pytest.raises(InvalidCommand, match="changes of node 'screw' need a restart"):
            check_same_line(before, after)
    else:
        check_same_line(before, after)
