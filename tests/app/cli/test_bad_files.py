"""Files that are wrong on purpose or by accident: none of them ends, blocks or slows down a line that runs."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from busmaster.emulator.serve import TcpServer
from tests.app.cli.conftest import ENVIRONMENT, Command, ended_once, owner, started
from tests.app.cli.test_leaving import polls, told
from tests.patience import PATIENCE


def nested(path: Path, text: str) -> None:
    path.write_text(f"{text}\nnested = {'[' * 250}{']' * 250}\n")


def fifo(path: Path, _: str) -> None:
    path.unlink()
    os.mkfifo(path)


def many_names(path: Path, text: str) -> None:
    path.write_text(f'{text}\n[nodes.a1-99b1-99c1-99]\nprotocol = "hcp2"\naddress = "1-99"\n')


def endless_period(path: Path, text: str) -> None:
    path.write_text(text.replace("period = 0.02", "period = 1e308"))


def long_title(path: Path, text: str) -> None:
    path.write_text(text.replace('title = "Slitter"', f'title = "{"x" * 1_000_000}"'))


BAD: list[tuple[Callable[[Path, str], None], str]] = [
    (nested, "nested more than 16 levels deep"),
    (fifo, "it is a FIFO, a socket or a device: name a regular file"),
    (many_names, "expands to more than 1000 names"),
    (endless_period, "must be a number of seconds, 0 to 86400, not 1e+308"),
    (long_title, "a text must have at most 32768 characters, not 1000002"),
]


@pytest.mark.slow
def test_a_running_line_goes_on_whatever_its_file_has_become(file: Path) -> None:
    text = file.read_text()
    with started("run", str(file), "--plain") as process:
        polls(process)
        for spoil, complaint in BAD:
            spoil(file, text)
            process.send_signal(signal.SIGHUP)
            assert complaint in told(process, "reload failed"), spoil.__name__
            polls(process)
            file.unlink()
            file.write_text(text)
        process.send_signal(signal.SIGHUP)
        told(process, "was reloaded")
        process.terminate()
        process.communicate(timeout=PATIENCE)
    assert process.returncode == 0


@pytest.mark.parametrize(("spoil", "complaint"), BAD)
def test_a_bad_file_is_refused_in_one_sentence(
    busmaster: Command, file: Path, spoil: Callable[[Path, str], None], complaint: str
) -> None:
    spoil(file, file.read_text())
    ran = busmaster("plan", str(file))
    assert ran.status in (1, 2)
    assert complaint in ran.err
    assert len(ran.err) < 500
    assert "Traceback" not in ran.err


@pytest.mark.slow
@pytest.mark.parametrize("key", ["template", "symbols", "learned"])
def test_a_fifo_that_a_file_names_is_not_waited_for(
    busmaster: Command, file: Path, key: str, three_controllers: TcpServer
) -> None:
    os.mkfifo(file.parent / "fifo.toml")
    text = file.read_text()
    if key == "learned":
        file.write_text(f'learned = "{file.parent}/fifo.toml"\ntiming = "learned"\n{text}')
        ran = ended_once(bool, "run", str(file), "--plain")
        assert ran.status == 130
        assert "fifo.toml: it is a FIFO" in ran.err
        return
    protocol, more = ("hcp2", "") if key == "template" else ("msc", "baudrate=9600")
    text = f'port = "{three_controllers.path}"\n[nodes.n]\nprotocol = "{protocol}"\naddress = 1\n'
    file.write_text(f'{text}{key} = "fifo.toml"\n')
    ran = busmaster("plan", str(file))
    assert (ran.status, more in "baudrate=9600") == (2, True)
    assert f"line.toml:5: nodes.n.{key}" in ran.err.replace("slitter", "line")
    assert "it is a FIFO, a socket or a device" in ran.err


def test_a_table_of_points_that_is_too_large_is_not_read(busmaster: Command, file: Path) -> None:
    before = file.read_text()
    table = file.parent / "points.csv"
    with table.open("wb") as large:
        large.truncate(1 << 33)  # a sparse file: as large as a disk, and nothing in it
    ran = busmaster("points", str(file), "--from", str(table))
    assert ran.status != 0
    assert "it has more than 4194304 bytes" in ran.err
    assert file.read_text() == before


@pytest.mark.slow
def test_status_shows_the_lines_whatever_else_is_in_their_folder(
    busmaster: Command, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setitem(ENVIRONMENT, "XDG_RUNTIME_DIR", str(tmp_path))
    folder = tmp_path / "busmaster"
    folder.mkdir(mode=0o700)
    os.mkfifo(folder / "a.line")
    (folder / "b.line").write_text("[" * 100_000)
    with (folder / "c.line").open("wb") as large:
        large.truncate(1 << 33)
    said = {"name": "d", "port": "p", "socket": "s", "pid": 1}
    wrong: dict[str, object] = {"name": 1, "port": None, "socket": 5, "pid": "1"}
    for key, value in wrong.items():
        (folder / f"d-{key}.line").write_text(json.dumps(said | {key: value}))
    (folder / "e.line").write_text(json.dumps(said | {"socket": "a\0b"}))
    os.symlink("/dev/zero", folder / "f.line")
    with owner("serve", str(file)):
        ran = busmaster("status")
    assert "slitter" in ran.out
    assert len([line for line in ran.lines if "busmaster" in line or "slitter" in line]) >= 1
    assert "Traceback" not in ran.err
