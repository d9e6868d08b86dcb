"""`busmaster points`: a table for people, CSV out and in, as commands and as processes."""

from __future__ import annotations

import io
import os
import pty
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from busmaster.app.cli import points
from tests.app.cli.conftest import ENVIRONMENT, Command
from tests.patience import PATIENCE

LINE = """\
port = "/dev/ttyUSB0"

[nodes.w]                       # the winder
protocol = "hcp2"
address = 5

[nodes.w.points]
position = { item = "axis0.position", unit = "°C", factor = 0.001 }
status = { item = "11", bits = { READY = 0, FAULT = 3 } }   # of the program

[nodes.d6-7]
protocol = "microflex"
address = "6-7"
template = "microflex"
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    path = tmp_path / "line.toml"
    path.write_text(LINE)
    return path


def process(*arguments: str | Path, given: bytes = b"", encoding: str = "") -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-m", "busmaster", "points", *map(str, arguments)],
        input=given,
        capture_output=True,
        env=ENVIRONMENT | ({"PYTHONIOENCODING": encoding} if encoding else {}),
        timeout=PATIENCE,
        check=False,
    )


def test_people_see_a_table_with_the_columns_in_which_something_is_said(busmaster: Command, path: Path) -> None:
    shown = busmaster("points", str(path))
    assert (shown.status, shown.err) == (0, "")
    assert shown.lines[0].split() == ["NODE", "POINT", "ITEM", "UNIT", "FACTOR", "BITS", "ALARM_IF_SET", "ORIGIN"]
    assert shown.lines[1].split() == ["w", "position", "axis0.position", "°C", "0.001"]
    temperature = next(line for line in shown.lines if "temperature" in line)
    assert temperature.split() == ["d6-7", "temperature", "temperature", "°C", "microflex"]
    assert len({line.index("temperature") for line in shown.lines[1:] if "temperature" in line}) == 1


@pytest.mark.slow
def test_a_terminal_narrower_than_the_table_shows_the_points_one_below_the_other(path: Path) -> None:
    shown, terminal = pty.openpty()
    with os.fdopen(shown, "rb", buffering=0) as reader:
        environment = ENVIRONMENT | {"COLUMNS": "50"}
        arguments = [sys.executable, "-m", "busmaster", "points", str(path)]
        subprocess.run(arguments, stdout=terminal, env=environment, timeout=PATIENCE, check=True)
        lines = reader.read(65536).decode().splitlines()
        os.close(terminal)
    assert lines[:3] == ["w/position (axis0.position)", "    unit °C, factor 0.001", "w/status (11)"]
    assert max(map(len, lines)) <= 50


@pytest.fixture
def narrow(monkeypatch: pytest.MonkeyPatch) -> io.BytesIO:
    """Standard output is a terminal of 60 columns."""
    monkeypatch.setenv("COLUMNS", "60")
    buffer = io.BytesIO()
    terminal = SimpleNamespace(isatty=lambda: True, flush=lambda: None, buffer=buffer)
    monkeypatch.setattr("busmaster.app.cli.points.sys", SimpleNamespace(stdout=terminal))
    return buffer


@pytest.mark.usefixtures("narrow")
def test_points_that_are_wider_than_the_terminal_are_lists_with_the_item_where_it_is_another_name(
    busmaster: Command, path: Path
) -> None:
    shown = busmaster("points", str(path))
    assert shown.lines[:3] == ["w/position (axis0.position)", "    unit °C, factor 0.001", "w/status (11)"]
    assert "d6-7/temperature" in shown.lines
    assert max(map(len, shown.lines)) <= 60


@pytest.mark.usefixtures("narrow")
def test_points_that_fit_into_the_terminal_are_a_table(busmaster: Command, path: Path) -> None:
    path.write_text('port = "/dev/ttyUSB0"\n[nodes.w]\nprotocol = "hcp2"\naddress = 5\npoints.a = { item = "1" }\n')
    assert [line.split() for line in busmaster("points", str(path)).lines] == [
        ["NODE", "POINT", "ITEM"],
        ["w", "a", "1"],
    ]


@pytest.mark.usefixtures("narrow")
def test_a_table_that_is_just_as_wide_as_the_terminal_is_shown_as_one(
    busmaster: Command, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "1000")
    table = busmaster("points", str(path)).lines
    width = max(map(len, table))
    for columns, shown in ((width, True), (width - 1, False)):
        monkeypatch.setenv("COLUMNS", str(columns))
        assert (busmaster("points", str(path)).lines == table) is shown


def test_csv_on_a_terminal_is_printed_once_and_moves_no_cursor(
    busmaster: Command, path: Path, narrow: io.BytesIO
) -> None:
    path.write_text(LINE.replace('unit = "°C"', 'unit = "\\u001b[31m"'))
    shown = busmaster("points", str(path), "--csv")
    assert "\x1b" not in shown.out
    assert r"\u001b[31m" in shown.out
    assert sum(line.startswith("w,position,") for line in shown.lines) == 1
    assert narrow.getvalue() == b""


def test_csv_is_printed_to_the_letter_and_taken_from_standard_input(
    busmaster: Command, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = busmaster("points", str(path), "--csv")
    assert (out.status, out.err) == (0, "")
    assert out.out.count("w,position,") == 1
    table = out.out.replace("0.001", "0.01")
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(table.encode())))
    shown = busmaster("points", str(path), "--from", "-")
    assert (shown.status, shown.lines) == (0, ["w/position: factor 0.001 -> 0.01"])
    assert shown.err == f"busmaster: {path}: 1 point changed\n"
    before = path.stat()
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(table.encode())))
    shown = busmaster("points", str(path), "--from", "-")
    assert (shown.out, shown.err) == ("", f"busmaster: {path}: no points changed\n")
    assert path.stat().st_ino == before.st_ino
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(b"node,point,factor\nw,status,x\n")))
    shown = busmaster("points", str(path), "--from", "-")
    assert shown.status == 2
    assert shown.err.startswith("busmaster: standard input: row 2, column factor: ")


@pytest.mark.parametrize(("length", "status"), [(100, 0), (101, 2)])
def test_a_table_on_standard_input_may_be_as_long_as_a_file(
    busmaster: Command, path: Path, monkeypatch: pytest.MonkeyPatch, length: int, status: int
) -> None:
    monkeypatch.setattr(points, "LONGEST_FILE", 100)
    table = b"node,point,factor\nw,position,2\n"
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(table.ljust(length, b"\n"))))
    shown = busmaster("points", str(path), "--from", "-")
    assert shown.status == status, shown.err
    assert ("standard input has more than 100 bytes" in shown.err) == (status == 2)


def test_a_program_in_the_same_pipe_can_edit_the_file_before_it_ends_its_table(
    busmaster: Command, path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Pipe(io.BytesIO):
        def read(self, size: int | None = -1, /) -> bytes:
            path.write_text(path.read_text().replace("[nodes.w.points]", '[nodes.w.points]\nspeed = { item = "12" }'))
            return super().read(size)

    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=Pipe(b"node,point,factor\nw,position,2\n")))
    shown = busmaster("points", str(path), "--from", "-")
    assert (shown.status, shown.lines) == (0, ["w/position: factor 0.001 -> 2"])
    assert 'speed = { item = "12" }' in path.read_text()
    assert "factor = 2" in path.read_text()


def test_all_points_that_limit_a_point_are_named(busmaster: Command, path: Path) -> None:
    names = "".join(f'{name} = {{ item = "20", maximum = {limit} }}\n' for name, limit in (("b", 5), ("c", 6)))
    path.write_text(
        f'{LINE}[nodes.v]\nprotocol = "hcp2"\naddress = 9\n[nodes.v.points]\na = {{ item = "20" }}\n{names}'
    )
    row = next(line for line in busmaster("points", str(path)).lines if line.split()[:2] == ["v", "a"])
    assert row.endswith(" b, c")


def test_a_file_without_points_says_so(busmaster: Command, path: Path) -> None:
    path.write_text('port = "/dev/ttyUSB0"\n[nodes.w]\nprotocol = "hcp2"\naddress = 5\n')
    assert busmaster("points", str(path)).lines == ["the file has no points; define them in [nodes.NAME.points]"]


@pytest.mark.slow
def test_out_and_in_again_the_file_is_not_even_written(path: Path) -> None:
    before = path.stat()
    out = process(path, "--csv", encoding="ascii")
    assert (out.returncode, out.stderr) == (0, b"")
    assert "°C".encode() in out.stdout
    back = process(path, "--from", "-", given=out.stdout)
    assert (back.returncode, back.stdout) == (0, b"")
    assert back.stderr.decode() == f"busmaster: {path}: no points changed\n"
    after = path.stat()
    assert (after.st_ino, after.st_mtime_ns) == (before.st_ino, before.st_mtime_ns)


@pytest.mark.slow
def test_points_go_from_one_file_to_another_and_come_out_the_same(path: Path, tmp_path: Path) -> None:
    (tmp_path / "points.csv").write_bytes(process(path, "--csv").stdout)
    other = tmp_path / "other.toml"
    head, _, rest = LINE.partition("[nodes.w.points]")
    other.write_text(f"{head}[nodes.d6-7]{rest.partition('[nodes.d6-7]')[2]}")
    back = process(other, "--from", tmp_path / "points.csv")
    assert back.returncode == 0, back.stderr
    assert [line.partition(" is new")[0] for line in back.stdout.decode().splitlines()] == ["w/position", "w/status"]
    assert process(other, "--csv").stdout == (tmp_path / "points.csv").read_bytes()
    assert "# the winder" in other.read_text()


def test_what_changes_is_shown_and_what_the_csv_has_not_stays(busmaster: Command, path: Path, tmp_path: Path) -> None:
    table = tmp_path / "points.csv"
    table.write_text(
        "\ufeffnode;point;item;factor;maximum\r\nw;position;axis0.position;0.01;\r\nd6-7;speed_reference;;;80\r\n"
    )
    shown = busmaster("points", str(path), "--from", str(table))
    assert shown.status == 0
    assert shown.lines == ["w/position: factor 0.001 -> 0.01", "d6-7/speed_reference: maximum none -> 80"]
    assert shown.err.startswith(
        f"busmaster: {path}: 2 points changed\nbusmaster: not in the CSV, unchanged: w/status, "
    )
    assert path.read_text() == (
        LINE.replace("0.001", "0.01").replace(
            'template = "microflex"\n',
            'template = "microflex"\n\n[nodes.d6-7.points]\nspeed_reference = { maximum = 80 }\n',
        )
    )


def test_a_bad_row_writes_nothing_and_each_is_told(busmaster: Command, path: Path, tmp_path: Path) -> None:
    table = tmp_path / "points.csv"
    table.write_text('node,point,item,maximum\nw,good,20,1\nw,bad,nothing,1\nw,worse,21,"1,5"\n')
    shown = busmaster("points", str(path), "--from", str(table))
    assert (shown.status, shown.out) == (2, "")
    told = shown.err.splitlines()
    assert len(told) == 2
    assert told[0].startswith(f"busmaster: {table}: row 3, column item: no such ")
    assert told[1] == f"busmaster: {table}: row 4, column maximum: 1,5 has a decimal comma; write 1.5"
    assert path.read_text() == LINE


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("--csv", "--from", "-"), "--csv exports and --from imports; leave out one of them"),
        (("--from", "none.csv"), "'none.csv' does not exist"),
    ],
)
def test_wrong_usage_is_told(busmaster: Command, path: Path, arguments: tuple[str, ...], told: str) -> None:
    shown = busmaster("points", str(path), *arguments)
    assert (shown.status, shown.out) == (2, "")
    assert told in shown.err
    assert path.read_text() == LINE


def test_an_escape_sequence_in_a_name_does_not_reach_a_terminal(busmaster: Command, path: Path) -> None:
    path.write_text(LINE.replace('unit = "°C"', 'unit = "\\u001b[31m"'))
    assert "\x1b" not in busmaster("points", str(path)).out
    assert b"\x1b[31m" in process(path, "--csv").stdout
