"""`busmaster emulate`: each option reaches the line, its drives or its port. Nothing is served."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.cli import emulate
from busmaster.app.cli.emulate import own_port, serve_for
from busmaster.app.cli.output import Level
from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.errors import LineDown
from busmaster.registry import find
from busmaster.transport.serial_port import SerialPort
from tests.app.cli.conftest import Command

FILE = """
port = "PORT?baudrate=9600"
[nodes.first]
protocol = "hcp2"
address = 1
[nodes.second]
protocol = "hcp2"
address = 2
[emulator]
seed = 5
paced = true
[emulator.nodes.second]
reply_delay = 0.03
faults = { lost = 0.5 }
"""
HCP2 = ("--protocol", "hcp2")


@dataclass
class Served:
    """The lines that were served, with their address and time."""

    line: Line
    link: str | None
    address: tuple[str, int] | None
    seconds: float | None = None


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[Served]:
    """The lines that were to be served."""
    found: list[Served] = []

    @contextmanager
    def serve(line: Line, link: str | None, address: tuple[str, int] | None) -> Iterator[Any]:
        found.append(Served(line, link, address))
        yield SimpleNamespace(path="a port")

    def wait(seconds: float | None) -> None:
        found[-1].seconds = seconds

    monkeypatch.setattr(emulate, "serve", serve)
    monkeypatch.setattr(emulate, "serve_for", wait)
    return found


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "line.toml"
    path.write_text(FILE.replace("PORT", str(tmp_path / "link")))
    return path


def one(busmaster: Command, served: list[Served], *arguments: str) -> Served:
    """What the command serves with these arguments."""
    ran = busmaster("emulate", *arguments)
    assert (ran.status, ran.out, ran.err) == (0, "a port\n", "")
    return served.pop()


# without a file


def test_by_default_there_is_one_node_on_a_terminal_at_the_rate_of_its_protocol(
    busmaster: Command, served: list[Served]
) -> None:
    found = one(busmaster, served, *HCP2)
    assert (found.link, found.address, found.seconds) == (None, None, None)
    assert found.line.settings == find("hcp2").profile.line
    assert found.line.tau == 0.0
    assert [(device.address, device.delay, device.faults) for device in found.line.devices] == [(1, Delay(), Faults())]


@pytest.mark.parametrize(("protocol", "addresses"), [("hcp2", [1]), ("dc104", [0]), ("mentor", [1])])
def test_the_node_is_1_or_the_only_one_of_the_protocol(
    busmaster: Command, served: list[Served], protocol: str, addresses: list[int]
) -> None:
    found = one(busmaster, served, "--protocol", protocol)
    assert [device.address for device in found.line.devices] == addresses


def test_each_option_of_the_line_reaches_it(busmaster: Command, served: list[Served]) -> None:
    found = one(busmaster, served, *HCP2, "--nodes", "3,1-2", "--baud", "9600", "--paced", "--seconds", "2.5")
    assert [device.address for device in found.line.devices] == [3, 1, 2]
    assert found.line.settings == LineSettings(9600)
    assert found.line.tau == LineSettings(9600).byte_time
    assert found.seconds == 2.5


def test_delay_and_all_faults_are_those_of_every_drive(busmaster: Command, served: list[Served]) -> None:
    options = ("--reply-delay", "5-9", "--fault", "lost=0.1", "--fault", "late=0.2")
    devices = list(one(busmaster, served, *HCP2, "--nodes", "1-2", *options).line.devices)
    assert [device.delay for device in devices] == [Delay(0.005, 0.009)] * 2
    assert [device.faults for device in devices] == [Faults(lost=0.1, late=0.2)] * 2


def test_random_numbers_are_those_of_the_seed(busmaster: Command, served: list[Served], file: Path) -> None:
    def drawn(*options: str) -> float:
        return one(busmaster, served, *options).line.chance.random()

    assert drawn(*HCP2) == drawn(*HCP2) == drawn(*HCP2, "--seed", "1")
    assert drawn(*HCP2, "--seed", "0") == drawn(*HCP2, "--seed", "0")
    assert len({drawn(*HCP2, "--seed", seed) for seed in "012"}) == 3
    assert drawn(str(file)) == drawn(*HCP2, "--seed", "5"), "the file's"
    assert drawn(str(file), "--seed", "0") == drawn(*HCP2, "--seed", "0")


@pytest.mark.parametrize(
    ("options", "link", "address"),
    [
        (("--pty",), "", None),
        (("--pty", "/tmp/here"), "/tmp/here", None),
        (("--tcp", "127.0.0.1:0"), None, ("127.0.0.1", 0)),
    ],
)
def test_port_options_name_a_link_or_an_address(
    busmaster: Command,
    served: list[Served],
    file: Path,
    options: tuple[str, ...],
    link: str | None,
    address: tuple[str, int] | None,
) -> None:
    for line in (HCP2, (str(file),)):
        found = one(busmaster, served, *line, *options)
        assert (found.link, found.address) == (link, address)


# with a file


def test_a_file_defines_its_line(busmaster: Command, served: list[Served], file: Path, tmp_path: Path) -> None:
    found = one(busmaster, served, str(file))
    assert (found.link, found.address) == (str(tmp_path / "link"), None)
    assert found.line.settings == LineSettings(9600)
    assert found.line.tau == LineSettings(9600).byte_time, "paced by the file"
    first, second = found.line.devices
    assert (first.delay, first.faults) == (Delay(), Faults())
    assert (second.delay, second.faults) == (Delay(0.03), Faults(lost=0.5))


def test_options_go_before_the_file_for_every_drive(busmaster: Command, served: list[Served], file: Path) -> None:
    found = one(busmaster, served, str(file), "--reply-delay", "5", "--fault", "late=0.2")
    for device in found.line.devices:
        assert (device.delay, device.faults) == (Delay(0.005), Faults(late=0.2))
    file.write_text(file.read_text().replace("paced = true", "paced = false"))
    assert one(busmaster, served, str(file)).line.tau == 0.0
    assert one(busmaster, served, str(file), "--paced").line.tau > 0.0


@pytest.mark.parametrize("options", [HCP2, ("--nodes", "1"), ("--baud", "9600")])
def test_what_the_file_defines_is_no_option(
    busmaster: Command, served: list[Served], file: Path, options: tuple[str, ...]
) -> None:
    ran = busmaster("emulate", str(file), *options)
    assert (ran.status, ran.out, served) == (2, "", [])
    assert "leave out the options for these" in ran.err


def test_a_file_that_run_would_refuse_is_refused(busmaster: Command, served: list[Served], file: Path) -> None:
    file.write_text(file.read_text() + '[groups.fast]\nperiod = 0.1\npoints = ["first/axis9.position"]\n')
    ran = busmaster("emulate", str(file))
    assert (ran.status, served) == (2, [])
    assert "axis9.position" in ran.err


def test_outputs_of_the_file_need_not_be_possible_where_its_line_is_emulated(
    busmaster: Command, served: list[Served], file: Path, tmp_path: Path
) -> None:
    file.write_text(f'{file.read_text()}[outputs.sqlite]\npath = "{tmp_path / "absent" / "line.sqlite"}"\n')
    assert len(one(busmaster, served, str(file)).line.devices) == 2


def test_without_file_and_protocol_there_is_nothing_to_emulate(busmaster: Command) -> None:
    ran = busmaster("emulate")
    assert ran.status == 2
    assert "no drives to emulate; name a LINE.toml, or use --protocol P" in ran.err


@pytest.mark.parametrize("path", ["usb:A500ABC", "/dev/ttyUSB0", "/dev/../dev/ttyUSB0", "/tmp/../dev/ttyUSB0"])
def test_no_link_is_made_in_place_of_a_device(path: str) -> None:
    assert own_port(SerialPort(path, baudrate=9600)) == (None, None)
    assert own_port(SerialPort("/tmp/link", baudrate=9600)) == ("/tmp/link", None)


# serving


def test_a_port_that_cannot_be_had_is_named_with_advice(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    line = Line(LineSettings(9600))
    taken = tmp_path / "taken"
    taken.mkdir()
    with pytest.raises(LineDown) as refused, emulate.serve(line, str(taken), None):
        pass
    assert refused.value.what == f"cannot serve on {taken}: File exists"
    assert refused.value.hint == "name a link that does not exist yet"

    def no_terminals(*_: object) -> None:
        raise OSError("out of pty devices")

    monkeypatch.setattr(emulate, "serve_pty", no_terminals)
    with pytest.raises(LineDown, match="cannot serve on a pseudo-terminal: out of pty devices"):
        emulate.serve(line, None, None)


def test_reports_of_a_terminal_are_warnings_and_its_link_is_the_one_that_is_named(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    notes: list[tuple[str, Level]] = []
    links: list[str | None] = []

    def serve_pty(line: Line, link: str | None, report: Any) -> None:
        links.append(link)
        report("the client has another rate")

    monkeypatch.setattr(emulate, "note", lambda text, level=Level.INFO: notes.append((text, level)))
    monkeypatch.setattr(emulate, "serve_pty", serve_pty)
    for link in ("/tmp/here", "", None):
        emulate.serve(Line(LineSettings(9600)), link, None)
    assert links == ["/tmp/here", None, None]
    assert set(notes) == {("the client has another rate", Level.WARNING)}


def test_it_looks_for_signals_again_and_again_and_ends_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, slept = [100.0], list[float]()

    def sleep(seconds: float) -> None:
        slept.append(round(seconds, 6))
        clock[0] += seconds

    monkeypatch.setattr(emulate, "time", SimpleNamespace(monotonic=lambda: clock[0], sleep=sleep))
    serve_for(0.5)
    assert slept == [0.2, 0.2, 0.1]
