"""An output that an installed package brings works with no edit anywhere; docs/adding-an-output.md shows it."""

from __future__ import annotations

import asyncio
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from busmaster import MemoryPort
from busmaster.app.config import FileError, emulated_line
from busmaster.app.config.schema import tables
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine, check
from busmaster.app.outputs import kinds
from busmaster.errors import InvalidCommand
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
    )
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
        ("influxx", "did you mean 'influx'"),
        ("absent", "the output 'absent' of busmaster-broken cannot be imported: No module named 'busmaster_absent'"),
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
