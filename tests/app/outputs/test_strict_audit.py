"""An output that must have an audit entry on the disk says so when it has, or that it never will."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.outputs.base import Output
from busmaster.app.outputs.files import JsonlOutput
from busmaster.app.outputs.settings import FileSettings, SqliteSettings
from busmaster.app.outputs.spool import Spool
from busmaster.app.outputs.sqlite import SqliteOutput
from busmaster.app.service.record import Outcome, WriteRecord
from tests.app.outputs.cycles import cycle, until
from tests.patience import PATIENCE


def entry(number: int) -> WriteRecord:
    return WriteRecord(0.0, "service", "x", "op", 17, "x", None, number, Outcome.WRITTEN, "", 0.0, "")


def closed_after(output: Output, does: Callable[[], None]) -> None:
    output.start()
    try:
        does()
    finally:
        output.close(PATIENCE)


def test_json_lines_are_synced_before_the_entry_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "x.jsonl"
    synced: list[str] = []
    fsync = os.fsync

    def sync(descriptor: int) -> None:
        fsync(descriptor)
        name = os.readlink(f"/proc/self/fd/{descriptor}")
        synced.append(Path(name).read_text() if os.path.isfile(name) else name)

    monkeypatch.setattr("busmaster.app.outputs.growing_file.os.fsync", sync)
    settings = FileSettings(path=str(path), sync_every=1000.0, audit="strict")
    output = JsonlOutput("jsonl", settings)
    found: list[bool] = []

    def does() -> None:
        output.offer(cycle(1, 1.0))
        until(lambda: output.written == 1)
        assert synced == []  # a cycle waits for `sync_every`
        output.offer_entry(entry(77), lambda why: found.append(not why and "77" in synced[-1]))
        until(lambda: bool(found))
        times = len(synced)
        output.offer(cycle(2, 1.0))
        until(lambda: output.written == 3)
        assert len(synced) == times  # behind an entry a cycle waits as before
        output.offer_entry(entry(78), lambda why: found.append(not why and "78" in synced[-1]))
        until(lambda: len(found) == 2)

    closed_after(output, does)
    assert found == [True, True]
    assert synced[0] == str(tmp_path)  # the name of a new file
    assert synced.count(str(tmp_path)) == 1


def test_without_strict_an_entry_is_not_synced_before_it_is_due(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced: list[int] = []
    monkeypatch.setattr("busmaster.app.outputs.growing_file.os.fsync", synced.append)
    output = JsonlOutput("jsonl", FileSettings(path=str(tmp_path / "x.jsonl"), sync_every=1000.0))

    def does() -> None:
        output.offer(entry(1))
        until(lambda: output.written == 1)
        assert synced == []

    closed_after(output, does)


def test_a_transaction_with_an_entry_is_synced(tmp_path: Path) -> None:
    path = tmp_path / "x.db"
    output = SqliteOutput("sqlite", SqliteSettings(path=str(path), audit="strict"))
    levels: list[str] = []
    connect = output._open

    def traced() -> sqlite3.Connection:
        database = connect()
        database.set_trace_callback(lambda text: levels.append(text) if "synchronous" in text else None)
        return database

    output._open = traced  # type: ignore[method-assign]
    found: list[str] = []

    def does() -> None:
        output.offer(cycle(1, 1.0))
        until(lambda: output.written == 1)
        output.offer_entry(entry(1), found.append)
        until(lambda: bool(found))

    closed_after(output, does)
    assert found == [""]
    assert (levels[0], levels[-1]) == ("pragma synchronous = normal", "pragma synchronous = full")
    with closing(sqlite3.connect(path)) as database:
        assert database.execute("select value from audit").fetchall() == [(1,)]


def test_what_is_dropped_or_left_at_the_end_is_reported_as_that(tmp_path: Path) -> None:
    output = JsonlOutput("jsonl", FileSettings(path=str(tmp_path / "x"), buffer=1, audit="strict"))
    found: list[tuple[int, str]] = []

    def note(number: int, why: str) -> None:
        found.append((number, why))

    for number in (1, 2):  # its thread is not started: nothing is written
        output.offer_entry(entry(number), partial(note, number))
    assert found == [(1, "jsonl dropped it, because its queue was full")]
    output.close(0.0)
    assert found[1:] == [(2, "jsonl ended before it was written")]


def test_each_of_several_entries_that_are_left_at_the_end_is_reported(tmp_path: Path) -> None:
    output = JsonlOutput("jsonl", FileSettings(path=str(tmp_path / "x"), audit="strict"))
    found: list[str] = []
    for number in (1, 2, 3):  # its thread is not started: nothing is written
        output.offer_entry(entry(number), found.append)
    output.close(0.0)
    assert found == ["jsonl ended before it was written"] * 3


def test_each_entry_of_a_batch_is_reported(tmp_path: Path) -> None:
    output = JsonlOutput("jsonl", FileSettings(path=str(tmp_path / "x"), audit="strict"))
    found: list[tuple[int, str]] = []

    def note(number: int, why: str) -> None:
        found.append((number, why))

    for number in (1, 2, 3):  # before its thread is started: they are written at once
        output.offer_entry(entry(number), partial(note, number))
    closed_after(output, lambda: None)
    assert found == [(1, ""), (2, ""), (3, "")]


def test_an_entry_that_is_spilled_is_durable_in_the_spool(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    strict: list[bool] = []

    def noted(*arguments: Any, **options: Any) -> Spool:
        strict.append(options.get("strict", False))
        return Spool(*arguments, **options)

    monkeypatch.setattr("busmaster.app.outputs.spilling.Spool", noted)
    (tmp_path / "folder").mkdir()
    path = tmp_path / "folder" / "x.jsonl"
    output = JsonlOutput("jsonl", FileSettings(path=str(path), spill=str(tmp_path / "spool"), audit="strict"))
    path.mkdir()  # it cannot be written
    found: list[str] = []

    def does() -> None:
        output.offer_entry(entry(5), found.append)
        until(lambda: bool(found))

    closed_after(output, does)
    assert found == [""]
    assert strict == [True]
    with closing(sqlite3.connect(tmp_path / "spool")) as database:
        assert database.execute("select count(*) from waiting").fetchall() == [(1,)]
