"""An output that an installed package brings works with no edit anywhere; docs/adding-an-output.md shows it."""

from __future__ import annotations

import asyncio
import importlib
import socket
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from busmaster import MemoryPort, Quality
from busmaster.app.config import FileError, emulated_line
from busmaster.app.config.schema import tables
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine, check
from busmaster.app.outputs import kinds
from busmaster.bus.meaning import Named
from busmaster.errors import InvalidCommand
from tests.app.outputs.cycles import cycle
from tests.app.service.lines import until
from tests.docs.pages import ROOT

HERE = Path(__file__).parent
LINE = """
port = "/dev/ttyS0?baudrate=57600"
[nodes.winder]
protocol = "hcp2"
address = 5
[groups.fast]
period = 0.01
points = ["winder/1"]
"""


@pytest.fixture
def _installed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    broken = tmp_path / "busmaster_broken-1.0.dist-info"
    broken.mkdir()
    (broken / "METADATA").write_text("Metadata-Version: 2.1\nName: busmaster-broken\nVersion: 1.0\n")
    (broken / "entry_points.txt").write_text(
        "[busmaster.outputs]\nabsent = busmaster_absent:X\nnumber = math:pi\ncsv = math:pi\n"
        "other = busmaster_influx:INFLUX\nkind = busmaster_influx:InfluxOutput\n"
        "renamed = math:INFLUX\nunfinished = busmaster_unfinished:X\n"
    )
    (tmp_path / "busmaster_unfinished.py").write_text("X = (\n")
    monkeypatch.syspath_prepend(str(HERE / "installed"))
    monkeypatch.syspath_prepend(str(tmp_path))
    forget()
    yield
    monkeypatch.undo()
    forget()
    sys.modules.pop("busmaster_influx", None)


def forget() -> None:
    for cached in (kinds.find, kinds.kinds, kinds._brought):
        cached.cache_clear()


def test_the_page_shows_the_module_that_is_tested() -> None:
    module = (HERE / "installed" / "busmaster_influx.py").read_text()
    assert f"```python\n{module}```" in (ROOT / "docs" / "adding-an-output.md").read_text()


@pytest.mark.usefixtures("_installed")
@pytest.mark.asyncio
async def test_its_values_are_those_of_the_line() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as telegraf:
        telegraf.bind(("127.0.0.1", 0))
        telegraf.setblocking(False)
        text = f"{LINE}[outputs.influx]\nport = {telegraf.getsockname()[1]}\n"
        file = read(Source("line.toml", text + "[emulator.nodes.winder.values]\n1 = 12.5\n"))
        async with ConfiguredLine(file, port=MemoryPort(emulated_line(file))) as line:
            packet = await asyncio.wait_for(asyncio.get_running_loop().sock_recv(telegraf, 1000), 30)
            [counts] = line.outputs.statistics()
            assert counts.kind == "influx"
    assert packet.decode().startswith("busmaster,point=winder/1 value=12.5 ")


@pytest.mark.usefixtures("_installed")
def test_its_keys_are_checked_when_the_file_is_read(tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    path.write_text(f"{LINE}[outputs.influx]\nport = 70000\nhots = 'x'\n")
    problems = [str(problem) for problem in check(path).problems]
    assert len(problems) == 2
    assert any("outputs.influx.port" in problem and "65535" in problem for problem in problems)
    assert any("hots" in problem and "did you mean 'host'" in problem for problem in problems)


@pytest.mark.usefixtures("_installed")
def test_the_reference_has_its_table() -> None:
    with pytest.warns(UserWarning, match="busmaster-broken"):
        found = {table.header: table for table in tables()}
    assert [key.name for key in found["[outputs.influx]"].keys] == ["enabled", "groups", "buffer", "host", "port"]


@pytest.mark.usefixtures("_installed")
@pytest.mark.parametrize(
    ("name", "error"),
    [
        ("influxx", "did you mean 'influx'\\?; an output of another package must be installed in this environment"),
        (
            "other",
            "the output 'other' of busmaster-broken is an OutputKind of the name 'influx'; use one name",
        ),
        ("kind", "the output 'kind' of busmaster-broken is not an OutputKind but the class InfluxOutput"),
        ("absent", "the output 'absent' of busmaster-broken cannot be imported: No module named 'busmaster_absent'"),
        ("renamed", "the output 'renamed' of busmaster-broken cannot be imported: .* no attribute 'INFLUX'; fix or"),
        ("unfinished", "the output 'unfinished' of busmaster-broken cannot be imported: '\\(' was never closed"),
        ("number", "the output 'number' of busmaster-broken is not an OutputKind but a float"),
    ],
)
def test_one_that_cannot_be_used_is_an_error_that_names_it(name: str, error: str) -> None:
    with pytest.raises((FileError, InvalidCommand), match=error):
        read(Source("line.toml", f"{LINE}[outputs.{name}]\n"))


@pytest.mark.usefixtures("_installed")
def test_a_name_of_this_package_cannot_be_taken() -> None:
    assert kinds.find("csv").about == "Values as lines of a CSV file."
    assert kinds.names().count("csv") == 1


@pytest.mark.usefixtures("_installed")
@pytest.mark.asyncio
async def test_it_is_not_down_when_nobody_receives_and_sends_numbers_only() -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as closed:
        closed.bind(("127.0.0.1", 0))
        port = closed.getsockname()[1]
    reported: list[str] = []
    file = read(Source("line.toml", f"{LINE}[outputs.influx]\nport = {port}\n"))
    async with ConfiguredLine(file, port=MemoryPort(emulated_line(file)), report=reported.append) as line:
        await until(lambda: line.outputs.statistics()[0].written >= 5)
        assert line.outputs.statistics()[0].error == ""
    assert [text for text in reported if "down" in text] == []


@pytest.mark.usefixtures("_installed")
def test_a_value_that_a_write_has_made_stale_is_not_sent() -> None:
    influx = importlib.import_module("busmaster_influx")
    read = cycle(1, 1.0, 2.0)
    qualities = zip(read.samples.items(), (Quality.LATE, Quality.STALE), strict=True)
    samples = {point: sample._replace(quality=quality) for (point, sample), quality in qualities}
    [line] = influx.lines(replace(read, samples=samples))
    assert " value=1.0 " in line


@pytest.mark.usefixtures("_installed")
def test_a_labelled_value_is_sent_as_its_number_and_an_empty_cycle_is_not_sent() -> None:
    influx = importlib.import_module("busmaster_influx")
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as telegraf:
        telegraf.bind(("127.0.0.1", 0))
        telegraf.settimeout(30)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for value in ("text", Named(2, "run"), True):
                influx.send(out, telegraf.getsockname(), cycle(1, value))
        assert [telegraf.recv(1000).decode().split()[1] for _ in range(2)] == ["value=2.0", "value=1.0"]
