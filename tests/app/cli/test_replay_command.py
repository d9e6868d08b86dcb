"""`busmaster replay`: what it prints, and how it ends."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.cli import main
from busmaster.app.cli.replay import changed_text
from busmaster.capture.pcapng import Outcome, Packet, PcapngWriter
from busmaster.contract.frames import Direction

REQUEST = bytes.fromhex("07 46 46 02 36 39 05 08")
REPLY = bytes.fromhex("02 36 39 34 30 39 36 03 07")


def capture(folder: Path, *outcomes: Outcome) -> str:
    path = folder / "line.pcapng"
    with path.open("wb") as file:
        writer = PcapngWriter(file)
        for outcome in outcomes:
            writer.write(Packet(0, "hcp2", Direction.HOST, REQUEST, 255))
            writer.write(Packet(0, "hcp2", Direction.NODE, REPLY, 255, outcome))
    return str(path)


def test_nothing_has_changed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", capture(tmp_path, Outcome.OK, Outcome.OK, Outcome.NONE, Outcome.SPOILT)]) == 0
    assert capsys.readouterr().out == "4 exchanges: 2 the same, 0 changed, 2 not judged\n"


def test_one_exchange_is_one(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", capture(tmp_path, Outcome.OK)]) == 0
    assert capsys.readouterr().out == "1 exchange: 1 the same, 0 changed\n"


def test_what_has_changed_is_a_line_each(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", capture(tmp_path, Outcome.OK, Outcome.REFUSED)]) == 1
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("packet 3, ")
    assert first.endswith("node 255: read element 105: was refused, is ok: 4096.0")
    assert last == "2 exchanges: 1 the same, 1 changed"


def test_json_has_every_exchange_with_its_time_and_the_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["replay", capture(tmp_path, Outcome.OK, Outcome.REFUSED), "--json"]) == 1
    same, changed, counts = map(json.loads, capsys.readouterr().out.splitlines())
    assert same["time"] == "1970-01-01T00:00:00.000000Z"
    assert (same["packet"], same["node"], same["command"]) == (1, 255, "read element 105")
    assert (same["judged"], same["changed"]) == (True, False)
    assert (changed["recorded"], changed["now"], changed["changed"]) == ("refused", "ok: 4096.0", True)
    assert counts == {"exchanges": 2, "same": 1, "changed": 1, "unjudged": 0}


def test_a_file_that_is_no_capture_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = tmp_path / "notes.txt"
    other.write_text("not a capture at all")
    assert main(["replay", str(other)]) == 2
    assert "not a pcapng file" in capsys.readouterr().err
    assert main(["replay", str(tmp_path / "nowhere")]) == 2
    other.write_text("")
    assert main(["replay", str(other)]) == 2
    assert "the file is empty" in capsys.readouterr().err


def test_a_capture_that_was_cut_off_is_replayed_up_to_that_place(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = Path(capture(tmp_path, Outcome.OK, Outcome.OK))
    path.write_bytes(path.read_bytes()[:-20])
    assert main(["replay", str(path)]) == 0
    said = capsys.readouterr()
    assert said.out == "2 exchanges: 1 the same, 0 changed, 1 not judged\n"
    assert said.err.startswith(f"busmaster: {path}: ")
    assert said.err.endswith(", after packet 3; only the packets before are replayed\n")


def test_one_changed_exchange_among_many_is_status_1_and_exchanges_are_judged_in_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = capture(tmp_path, Outcome.OK, Outcome.OK, Outcome.REFUSED, Outcome.NONE)
    assert main(["replay", path, "--json"]) == 1
    *exchanges, counts = map(json.loads, capsys.readouterr().out.splitlines())
    assert [one["judged"] for one in exchanges] == [True, True, True, False]
    assert counts == {"exchanges": 4, "same": 2, "changed": 1, "unjudged": 1}


def test_the_line_of_a_change_has_its_time_in_microseconds_and_no_node_where_there_is_none() -> None:
    one: Any = SimpleNamespace(packet=7, micros=1_500_001, node=None, command="read 1", recorded="ok: 1", now="refused")
    assert changed_text(one) == "packet 7, 1970-01-01T00:00:01.500001Z, read 1: was ok: 1, is refused"
    one.node = 0
    assert changed_text(one).endswith(", node 0: read 1: was ok: 1, is refused")
