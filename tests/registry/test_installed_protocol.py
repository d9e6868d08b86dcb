"""A protocol that an installed package brings is everywhere, with no edit anywhere."""

from __future__ import annotations

import random
import shutil
import sys
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import pytest

from busmaster import Bus, MemoryPort
from busmaster.app.config import emulated_line as line_of_file
from busmaster.app.config.sections import read
from busmaster.app.config.source import FileError, Source
from busmaster.app.line import ConfiguredLine
from busmaster.capture.pcapng import Outcome, Packet, read_packets
from busmaster.capture.recorder import Recorder
from busmaster.capture.replay import replay_packets
from busmaster.contract.frames import Direction
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.registry import discovery, find, kinds, make_device, protocols
from busmaster.testing.fixtures import LineFactory, emulated_line, virtual_time
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.app.cli.conftest import Command, busmaster
from tests.capture.test_dissector import dissect

__all__ = ["busmaster", "emulated_line", "virtual_time"]

HERE = Path(__file__).parent
FILE = """
port = "/dev/ttyS0"
[protocols.tally]
gate = 2
[nodes.west]
protocol = "tally"
address = 3
points = { people = { item = "gate", factor = 0.5 } }
[groups.all]
period = 0.1
points = ["west/people"]
"""


def installed(folder: str, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """With the packages in `folder` as if they were installed."""
    before = set(sys.modules)
    monkeypatch.syspath_prepend(str(HERE / folder))
    forget()
    yield
    monkeypatch.undo()
    forget()
    for name in set(sys.modules) - before:
        if name.startswith("busmaster_"):
            del sys.modules[name]


def forget() -> None:
    discovery.protocols.cache_clear()
    discovery.kinds.cache_clear()


@pytest.fixture
def tally(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from installed("installed", monkeypatch)


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    yield from installed("broken", monkeypatch)


@pytest.fixture
def served(tally: None) -> Iterator[TcpServer]:
    devices = [make_device("tally", address) for address in (1, 3)]
    with serve_tcp(Line(find("tally").profile.line, devices, chance=random.Random(1), paced=False)) as server:
        yield server


TALLY = ("--protocol", "tally")


@pytest.mark.slow
def test_the_command_line_reads_writes_and_finds_its_nodes(served: TcpServer, busmaster: Command) -> None:
    assert busmaster("write", served.path, *TALLY, "--node", "3", "a=7", "gate=65535", "--gate", "4").lines == [
        "a ok",
        "gate ok",
    ]
    assert busmaster("read", served.path, *TALLY, "--node", "3", "a", "d").lines == ["a 7", "d 65535"]
    assert busmaster("write", served.path, *TALLY, "--node", "3", "a=65536").status == 2
    assert busmaster("read", served.path, *TALLY, "--node", "3", "A").status == 2
    found = busmaster("scan", served.path, *TALLY, "--nodes", "1-3", "--timeout", "300")
    assert found.lines == ["1 read counter a: 0", "3 read counter a: 7"]


def test_the_help_names_it_with_its_items_and_options(tally: None, busmaster: Command) -> None:
    said = " ".join(busmaster("read", "--help").out.split())
    assert "tally" in said.partition("One of")[2]
    assert "tally a counter, a to z, or gate" in said.partition("ITEM, by protocol")[2]
    assert "--gate N tally: which counter gate has, 1 for a." in said


def test_its_items_are_listed(tally: None, busmaster: Command) -> None:
    assert [line.split()[0] for line in busmaster("items", "tally", "passed").lines] == [
        "ITEM",
        *"abcdefghijklmnopqrstuvwxyz",
    ]
    assert busmaster("items", "taly").err.endswith("no such protocol 'taly'; did you mean 'tally'?\n")


SCREW = '[nodes.screw]\nprotocol = "mentor"\naddress = 14\n'


def test_it_shares_a_line_with_whom_it_knows_and_then_wants_the_line_said(tally: None) -> None:
    both = FILE + SCREW
    with pytest.raises(FileError, match="no baud rate given"):  # for the two are meant for different lines
        read(Source("line.toml", both))
    file = read(Source("line.toml", both.replace("ttyS0", "ttyS0?baudrate=9600&bytesize=7&parity=E")))
    with pytest.warns(UserWarning, match="tally is meant for 8N1, but /dev/ttyS0 is 7E1"):
        assert list(ConfiguredLine(file, outputs=False).nodes) == ["west", "screw"]
    with pytest.raises(FileError, match="hcp2 and tally nodes cannot share a line"):
        read(Source("line.toml", both.replace('"mentor"', '"hcp2"')))


def test_an_option_of_its_own_is_no_option_of_others(tally: None, busmaster: Command) -> None:
    wrong = busmaster("read", "/dev/null", "--protocol", "hcp2", "--node", "1", "1", "--gate", "2")
    assert wrong.status == 2
    assert "--gate is only for tally; leave it out" in wrong.err


@pytest.mark.slow
def test_the_doctor_asks_its_nodes(served: TcpServer, busmaster: Command) -> None:
    found = busmaster("doctor", served.path, *TALLY, "--nodes", "3", "--timeout", "1000")
    assert found.status == 0
    assert "read counter a: 0" in found.out


def test_it_is_emulated_by_name(tally: None, busmaster: Command) -> None:
    found = busmaster("emulate", *TALLY, "--nodes", "1,3", "--tcp", "127.0.0.1:0", "--seconds", "0.01")
    assert found.status == 0
    assert found.lines[0].startswith("socket://")


def test_a_line_file_has_nodes_of_it_with_its_options(tally: None) -> None:
    file = read(Source("line.toml", FILE))

    async def poll() -> Any:
        async with ConfiguredLine(file, port=MemoryPort(line_of_file(file))) as line:
            await line.point("west/people").write(1.6)  # 3.2 on the line, which carries whole numbers
            value = await line.nodes["west"].point("b").read()
            snapshot = await anext(aiter(line.groups["all"]))
            return value, next(iter(snapshot.values())).value

    assert run_in_virtual_time(poll()) == (3, 1.5)


def test_its_emulated_device_is_as_the_file_says(tally: None) -> None:
    file = read(Source("line.toml", f"{FILE}[emulator.nodes.west]\nvalues = {{ people = 21, c = 5 }}\n"))

    async def ask() -> Any:
        async with ConfiguredLine(file, port=MemoryPort(line_of_file(file))) as line:
            return [await line.point(f"west/{point}").read() for point in ("people", "b", "c", "a")]

    assert run_in_virtual_time(ask()) == [21, 42, 5, 0]
    with pytest.raises(FileError, match=r"line\.toml:13: emulator\.nodes\.west\.values\.C: a turnstile has no counter"):
        line_of_file(read(Source("line.toml", f"{FILE}[emulator.nodes.west]\nvalues.C = 5\n")))


def test_a_wrong_key_in_a_line_file_says_whose_it_is(tally: None) -> None:
    with pytest.raises(FileError, match="is only for nodes of tally, not of hcp2"):
        read(Source("line.toml", FILE.replace('protocol = "tally"', 'protocol = "hcp2"\ngate = 1')))


@pytest.mark.parametrize("declared", ["", "tally"])
def test_a_capture_names_it_by_text_and_is_replayed(tally: None, tmp_path: Path, declared: str) -> None:
    path = tmp_path / "line.pcapng"

    async def talk(tap: Recorder) -> None:
        line = Line(find("tally").profile.line, [make_device("tally", 3)])
        async with Bus(MemoryPort(line), tap=tap) as bus:
            west = find("tally").handle(bus, 3)
            await west.point("a").write(5)
            assert await west.point("a").read() == 5

    with Recorder(path, protocol=declared) as tap:
        run_in_virtual_time(talk(tap))
    with path.open("rb") as file:
        packets = list(read_packets(file))
    assert {packet.protocol for packet in packets} == {"tally"}
    assert [packet.outcome for packet in packets if packet.outcome] == [Outcome.OK, Outcome.OK]
    assert [(str(one.command), one.changed) for one in replay_packets(packets)] == [
        ("write counter a = 5", False),
        ("read counter a", False),
    ]


@pytest.mark.skipif(shutil.which("tshark") is None, reason="tshark is not installed")
def test_wireshark_calls_it_by_the_name_that_a_capture_has_for_it(tally: None, tmp_path: Path) -> None:
    packets = [Packet(0, "tally", Direction.HOST, b"?"), Packet(0, "", Direction.NODE, b"!")]
    assert dissect(tmp_path, packets, "_ws.col.Protocol") == [["tally"], ["unknown"]]


def test_the_fixtures_make_lines_of_it(
    tally: None, virtual_time: Callable[[Coroutine[Any, Any, int]], int], emulated_line: LineFactory
) -> None:
    async def application() -> int:
        async with Bus(MemoryPort(emulated_line("tally", [3]))) as bus:
            return int(await find("tally").handle(bus, 3).point("a").read())

    assert virtual_time(application()) == 0


def test_a_package_whose_protocol_cannot_be_used_is_told_and_the_others_are_there(broken: None) -> None:
    with pytest.warns(UserWarning, match="of busmaster-broken cannot be used") as told:
        found = protocols()
    causes = [str(warning.message) for warning in told]
    assert len(causes) == 6
    for cause, text in zip(
        causes,
        (
            "busmaster_missing",
            "is not a Protocol",
            "capture id 1 is taken",
            "name hcp is taken",
            "option address_step is a whole",
            "option chain is a flag",
        ),
        strict=True,
    ):
        assert text in cause
    assert len(found) == len({protocol.name for protocol in found}) >= 5


def test_without_the_package_it_is_not_there() -> None:
    assert "tally" not in kinds()
