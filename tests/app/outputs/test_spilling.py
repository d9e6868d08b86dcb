"""Store and forward for every output that can be away and come back, and from one output to its successor."""

from __future__ import annotations

import asyncio
import json
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.config import FileError
from busmaster.app.outputs import base, batches
from busmaster.app.outputs.base import Happening
from busmaster.app.outputs.batches import BatchOutput
from busmaster.app.outputs.distributor import Distributor, Wanted
from busmaster.app.outputs.files import CsvOutput, JsonlOutput
from busmaster.app.outputs.mqtt import MqttOutput
from busmaster.app.outputs.settings import FileSettings, MqttSettings, Settings, SqliteSettings
from busmaster.app.outputs.sqlite import SqliteOutput
from busmaster.errors import InvalidCommand
from tests.app.outputs.cycles import BUS, cycle, settled, until
from tests.app.outputs.test_audit import WRITE
from tests.app.outputs.test_distributor import TEXT, opened
from tests.app.outputs.test_spool import spool_at, spooled
from tests.disks import small_disk
from tests.patience import PATIENCE
from tests.ports import free_port


@pytest.fixture(autouse=True)
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Outputs that are down look again soon."""
    for name in ("FIRST_RETRY", "LAST_RETRY"):
        monkeypatch.setattr(base, name, 0.02)


Make = Callable[[Path, Callable[[str], None]], BatchOutput[Any]]


def csv(folder: Path, say: Callable[[str], None]) -> CsvOutput:
    return CsvOutput("csv", FileSettings(path=str(folder / "x"), spill=str(folder / "spool"), buffer=100), say)


def jsonl(folder: Path, say: Callable[[str], None]) -> JsonlOutput:
    return JsonlOutput("jsonl", FileSettings(path=str(folder / "x"), spill=str(folder / "spool"), buffer=100), say)


def sqlite(folder: Path, say: Callable[[str], None]) -> SqliteOutput:
    return SqliteOutput("sqlite", SqliteSettings(path=str(folder / "x"), spill=str(folder / "spool"), buffer=100), say)


def numbers(path: Path) -> list[int]:
    """The values of element 1 that are there, in their order."""
    if path.read_bytes().startswith(b"SQLite"):
        database = sqlite3.connect(path)
        found = [value for [value] in database.execute("select value from history order by rowid")]
        database.close()
        return found
    lines = path.read_text().splitlines()
    if lines[0].startswith("{"):
        cycles = [json.loads(line) for line in lines]
        return [found["samples"]["5/1"]["value"] for found in cycles if "samples" in found]
    return [int(line.split(",")[5]) for line in lines[1:]]


every = pytest.mark.parametrize("make", [csv, jsonl, sqlite])


@pytest.mark.slow
@every
def test_ten_times_what_memory_holds_waits_on_disk_and_is_written_in_order(tmp_path: Path, make: Make) -> None:
    (tmp_path / "x").mkdir()
    output = make(tmp_path, lambda _: None)
    output.start()
    for number in range(1, 1001):
        output.offer(cycle(number, number))
        if number % 50 == 0:
            until(lambda: output.spilled == output.offered)
    counts = output.statistics()
    assert (counts.waiting, counts.spilled, counts.dropped) == (1000, 1000, 0)
    assert "Is a directory" in counts.error
    (tmp_path / "x").rmdir()
    until(lambda: settled(output))
    output.close(PATIENCE)
    assert output.statistics() == type(counts)(output.kind, "written", 1000, 0, 0, "", 0)
    assert numbers(tmp_path / "x") == list(range(1, 1001))


@every
def test_what_could_not_be_written_at_the_end_is_written_by_the_next_process(tmp_path: Path, make: Make) -> None:
    (tmp_path / "x").mkdir()
    output = make(tmp_path, lambda _: None)
    output.start()
    for number in range(1, 51):
        output.offer(cycle(number, number))
    output.close(PATIENCE)
    counts = output.statistics()
    assert (counts.written, counts.dropped, counts.spilled) == (0, 0, 50)
    (tmp_path / "x").rmdir()
    again = make(tmp_path, lambda _: None)
    again.offer(cycle(51, 51))
    again.start()
    until(lambda: again.written == 51)
    again.close(PATIENCE)
    counts = again.statistics()
    assert (counts.written, counts.dropped, counts.spilled, counts.waiting) == (51, 0, 0, 0)
    assert numbers(tmp_path / "x") == list(range(1, 52))


@pytest.mark.parametrize(("hurry", "written"), [(0.0, 1), (PATIENCE, 50)])
def test_what_a_slow_output_cannot_write_until_it_must_end_goes_to_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, hurry: float, written: int
) -> None:
    monkeypatch.setattr(batches, "HURRY", hurry)
    monkeypatch.setattr(batches, "BATCH", 1)

    class Slow(CsvOutput):
        """Its first batch takes until it must end."""

        def commit(self, batch: list[Any]) -> None:
            self._stop.wait(PATIENCE)
            super().commit(batch)

    settings = FileSettings(path=str(tmp_path / "x"), spill=str(tmp_path / "spool"))
    output = Slow("csv", settings)
    for number in range(1, 51):
        output.offer(cycle(number, number))
    output.start()
    until(lambda: len(output._batch) == 1)
    output.close(PATIENCE)
    counts = output.statistics()
    assert (counts.written, counts.dropped, counts.spilled) == (written, 0, 50 - written)
    again = CsvOutput("csv", settings)
    again.start()
    until(lambda: again.written == 50 - written)
    again.close(PATIENCE)
    assert numbers(tmp_path / "x") == list(range(1, 51))


def test_a_slow_output_without_a_spool_writes_all_that_it_can(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batches, "HURRY", 0.0)
    monkeypatch.setattr(batches, "BATCH", 1)
    output = CsvOutput("csv", FileSettings(path=str(tmp_path / "x")))
    for number in range(1, 51):
        output.offer(cycle(number, number))
    output.start()
    output.close(PATIENCE)
    assert (output.statistics().written, numbers(tmp_path / "x")) == (50, list(range(1, 51)))


@every
def test_an_output_that_is_ended_at_once_does_not_write_new_values_before_those_on_disk(
    tmp_path: Path, make: Make
) -> None:
    (tmp_path / "x").mkdir()
    for number in (1, 2):
        output = make(tmp_path, lambda _: None)
        output.offer(cycle(number, number))
        output.start()
        output.close(PATIENCE)
        if number == 1:
            (tmp_path / "x").rmdir()
    last = make(tmp_path, lambda _: None)
    last.start()
    until(lambda: last.spilled == 0 and (tmp_path / "x").exists() and settled(last))
    last.close(PATIENCE)
    assert numbers(tmp_path / "x") == [1, 2]


def test_events_and_writes_survive_on_disk_as_they_were(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()
    output = sqlite(tmp_path, lambda _: None)
    output.offer(Happening(1.5, "", "the line is up"))
    output.offer(WRITE)
    output.start()
    output.close(PATIENCE)
    (tmp_path / "x").rmdir()
    again = sqlite(tmp_path, lambda _: None)
    again.start()
    until(lambda: again.written == 2)
    again.close(PATIENCE)
    database = sqlite3.connect(tmp_path / "x")
    assert database.execute("select * from events").fetchall() == [(1.5, None, "the line is up")]
    [row] = database.execute("select point, before, value, outcome, id from audit").fetchall()
    assert row == ("winder/setpoint", 1.5, 2, "unconfirmed", "a1")


@contextmanager
def locked(path: Path) -> Iterator[None]:
    holder = sqlite3.connect(path, isolation_level=None)
    holder.execute("begin exclusive")
    try:
        yield
    finally:
        holder.execute("rollback")
        holder.close()


def test_a_database_that_another_program_locks_loses_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("busmaster.app.outputs.sqlite.BUSY", 0.01)
    said: list[str] = []
    output = sqlite(tmp_path, said.append)
    output.offer(cycle(1, 1))
    output.start()
    until(lambda: settled(output))
    with locked(tmp_path / "x"):
        for number in range(2, 501):
            output.offer(cycle(number, number))
            if number % 50 == 0:
                until(lambda: output.spilled == output.offered - 1)
    until(lambda: settled(output))
    output.close(PATIENCE)
    assert numbers(tmp_path / "x") == list(range(1, 501))
    assert said == [f"sqlite is down: {tmp_path}/x: database is locked", "sqlite is up again"]


def test_a_spool_that_cannot_be_made_is_told_and_the_output_works_without(tmp_path: Path) -> None:
    said: list[str] = []
    (tmp_path / "spool").mkdir()
    output = csv(tmp_path, said.append)
    output.start()
    output.offer(cycle(1, 1))
    until(lambda: output.written == 1)
    output.close(PATIENCE)
    assert len(said) == 1
    assert "Is a directory" in said[0]


def test_a_spool_with_older_values_in_it_that_another_process_holds_keeps_the_output_down(tmp_path: Path) -> None:
    """What is newer must not overtake them."""
    said: list[str] = []
    other = spool_at(tmp_path, 100, "csv")
    output = csv(tmp_path, said.append)
    output.offer(cycle(1, 1))
    output.start()
    until(lambda: bool(said))
    assert said[0].startswith("csv is down: ")
    assert "does another process use it?" in said[0]
    assert output.written == 0
    other.close()
    until(lambda: output.written == 1)
    output.close(PATIENCE)


def test_a_file_that_holds_something_else_is_left_alone(tmp_path: Path) -> None:
    spool_at(tmp_path, 100, "mqtt").close()
    said: list[str] = []
    output = csv(tmp_path, said.append)
    output.start()
    output.close(PATIENCE)
    assert "contains the stored values of mqtt; use another file for csv" in said[0]
    database = sqlite3.connect(tmp_path / "other")
    database.execute("create table mine (number)")
    database.close()
    output = CsvOutput("csv", FileSettings(path=str(tmp_path / "y"), spill=str(tmp_path / "other")), said.append)
    output.start()
    output.close(PATIENCE)
    assert "is a database of another program" in said[-1]


def test_two_outputs_with_one_file_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"outputs.jsonl.spill: is already the file of sqlite.path"):
        opened(tmp_path, f'{TEXT}spill = "FOLDER/x.db"\n')


# from one to the next


@pytest.mark.asyncio
@pytest.mark.parametrize("other_file", [False, True])
async def test_another_output_of_the_kind_finds_the_spool_of_the_one_before_and_counts_it_once(
    tmp_path: Path, other_file: bool
) -> None:
    pytest.importorskip("aiomqtt", reason="the extra mqtt is not installed")
    told: list[str] = []
    before = MqttSettings(port=free_port(), prefix="a", spill=str(tmp_path / "spool"), buffer=100)
    outputs = Distributor(BUS, told.append)
    outputs.add("mqtt", before)
    outputs.start(())
    [first] = outputs._outputs
    for number in range(1, 301):
        first.offer(cycle(number, number))
        if number % 50 == 0:
            await asyncio.to_thread(until, lambda: first.spilled == first.offered)
    spill = str(tmp_path / ("spool2" if other_file else "spool"))
    after = MqttSettings(port=before.port, prefix="b", spill=spill, buffer=100)
    await outputs.replace({"mqtt": Wanted(after, {})}, ())
    [second] = outputs._outputs
    second.offer(cycle(301, 301))
    found = 1 if other_file else 301
    await asyncio.to_thread(until, lambda: second.statistics().spilled == found)
    [counts] = outputs.statistics()
    assert (counts.written, counts.dropped, counts.waiting, counts.spilled) == (0, 0, found, found)
    await outputs.close()
    assert spooled(tmp_path) == (300 if other_file else 301)
    assert not any("another process" in text for text in told)
    assert sum("300 values stay in" in text for text in told) == other_file


@pytest.mark.asyncio
async def test_no_values_are_reported_to_stay_in_a_spool_that_is_empty(tmp_path: Path) -> None:
    reported: list[str] = []
    settings = FileSettings(path=str(tmp_path / "x"), spill=str(tmp_path / "spool"))
    outputs = Distributor(BUS, reported.append)
    outputs.add("csv", settings)
    outputs.start(())
    await outputs.replace({"csv": Wanted(replace(settings, spill=None), {})}, ())
    await outputs.close()
    await asyncio.sleep(0)
    assert reported == []


@pytest.mark.parametrize("messages", ["point", "cycle"])
def test_cycles_that_wait_on_disk_are_counted_by_their_values(tmp_path: Path, messages: Any) -> None:
    pytest.importorskip("aiomqtt", reason="the extra mqtt is not installed")
    settings = MqttSettings(port=free_port(), messages=messages, spill=str(tmp_path / "spool"))
    output = MqttOutput("mqtt", settings, BUS)

    async def start() -> None:
        output.start()

    asyncio.run(start())
    output.offer(cycle(1, 1, 2, 3))
    until(lambda: output.spilled == 3)
    output.close(PATIENCE)
    assert spooled(tmp_path) == 3


@pytest.mark.asyncio
async def test_values_of_an_earlier_process_are_counted_once_when_the_output_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()  # which keeps the output down
    earlier = csv(tmp_path, lambda _: None)
    earlier.start()
    earlier.offer(cycle(1, 1, 2))
    earlier.close(PATIENCE)
    (tmp_path / "x").rmdir()
    settings = FileSettings(path=str(tmp_path / "x"), spill=str(tmp_path / "spool"))
    outputs = Distributor(BUS)
    outputs.add("csv", settings)
    outputs.start(())
    await asyncio.to_thread(until, lambda: outputs.statistics()[0].written == 2)
    await outputs.replace({"csv": Wanted(replace(settings, buffer=7), {})}, ())
    await outputs.close()
    [counts] = outputs.statistics()
    assert (counts.written, counts.dropped, counts.waiting, counts.spilled) == (2, 0, 0, 0)


@pytest.mark.asyncio
async def test_an_output_that_a_file_does_not_name_any_more_says_what_it_leaves_behind(tmp_path: Path) -> None:
    told: list[str] = []
    outputs = Distributor(BUS, told.append)
    wanted: Settings = FileSettings(path=str(tmp_path / "x"), spill=str(tmp_path / "spool"))
    (tmp_path / "x").mkdir()
    outputs.add("csv", wanted)
    outputs.start(())
    outputs._outputs[0].offer(cycle(1, 1, 2))
    await outputs.replace({}, ())
    await outputs.close()
    assert told[-1] == "csv is ended: 0 written, 0 dropped, 2 kept on disk"


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["csv", "sqlite"])
def test_a_full_disk_costs_nothing_where_what_waits_is_on_another(tmp_path: Path, kind: str) -> None:
    said: list[str] = []
    with small_disk(2000) as disk:
        path, spill = str(disk.folder / "x"), str(tmp_path / "spool")
        output: BatchOutput[Any] = (
            CsvOutput(kind, FileSettings(path=path, spill=spill, buffer=100), said.append)
            if kind == "csv"
            else SqliteOutput(kind, SqliteSettings(path=path, spill=spill, buffer=100), said.append)
        )
        output.offer(cycle(1, 1))
        output.start()
        until(lambda: settled(output))
        disk.fill()
        number = 1
        while not output.error:  # what the file system had set aside for the file is used up
            number += 1
            output.offer(cycle(number, number))
            until(lambda: settled(output) or bool(output.error))
        last = number + 300
        while number < last:
            number += 1
            output.offer(cycle(number, number))
            if number % 50 == 0:
                until(lambda: output.spilled == output.statistics().waiting)
        disk.clear()
        until(lambda: settled(output))
        output.close(PATIENCE)
        assert numbers(disk.folder / "x") == list(range(1, last + 1))
    assert output.dropped == output.lost == 0
    assert "full" in said[0] or "No space left" in said[0]
    assert said[-1] == f"{kind} is up again"


def test_a_disk_that_is_full_again_after_it_took_values_is_told_again() -> None:
    said: list[str] = []
    with small_disk(1000) as disk:
        (disk.folder / "x").mkdir()  # which keeps the output down
        output = csv(disk.folder, said.append)
        output.start()

        def times_full() -> int:
            return sum("disk is full" in text for text in said)

        number = 1
        output.offer(cycle(number, number))
        until(lambda: output.spilled == 1)
        for times in (1, 2):
            disk.fill()
            while times_full() < times:  # until the space that the spool had is used up
                number += 1
                output.offer(cycle(number, number))
                until(lambda: output.spilled == output.statistics().waiting or times_full() == times)  # noqa: B023
            disk.clear()
            until(lambda: output.spilled == output.statistics().waiting)
        output.close(PATIENCE)
    assert output.statistics().spilled > 0


def test_values_on_disk_are_bounded_and_those_that_had_to_go_are_counted(tmp_path: Path) -> None:
    (tmp_path / "x").mkdir()  # which keeps the output down
    output = CsvOutput(
        "csv", FileSettings(path=str(tmp_path / "x"), spill=str(tmp_path / "spool"), spill_values=10, mode=0o600)
    )
    output.start()
    for number in range(1, 26):
        output.offer(cycle(number, number, number))
        if number % 5 == 0:
            until(lambda: output.statistics().waiting == output.spilled == min(10, output.offered))
    counts = output.statistics()
    output.close(PATIENCE)
    assert (counts.written, counts.dropped, counts.waiting, counts.spilled) == (0, 40, 10, 10)
    assert (tmp_path / "spool").stat().st_mode & 0o777 == 0o600
    assert spooled(tmp_path, "csv") == 10


def test_the_reasons_why_the_disk_takes_nothing_are_reported_each_once(tmp_path: Path) -> None:
    said: list[str] = []
    (tmp_path / "x").mkdir()  # which keeps the output down
    output = csv(tmp_path, said.append)
    errors: list[Exception] = []

    class Broken:
        values = 0

        def put(self, records: object) -> int:
            list(records)  # type: ignore[call-overload]  # a wrong argument
            raise errors[-1]

        def close(self) -> None:
            pass

    output._spool = Broken()  # type: ignore[assignment]  # replaced here
    errors.append(sqlite3.OperationalError("disk is full"))
    output.offer(cycle(1, 1))
    output.start()
    until(lambda: len(said) == 2)
    until(lambda: len(output._waiting) == 1)  # it waits in memory, where the oldest are dropped
    errors.append(sqlite3.OperationalError("disk I/O error"))
    until(lambda: len(said) == 3)
    output.close(PATIENCE)
    spool = tmp_path / "spool"
    assert [text for text in said if "down" not in text] == [f"csv: {spool}: {text}" for text in map(str, errors)]
    assert output.dropped == 1


def test_a_folder_for_values_that_wait_is_looked_for_at_the_start(tmp_path: Path) -> None:
    with pytest.raises(InvalidCommand, match=r"the folder .* does not exist"):
        CsvOutput("csv", FileSettings(path=str(tmp_path / "x"), spill=str(tmp_path / "none" / "spool")))


def test_an_empty_file_that_is_no_spool_does_not_keep_the_output_down(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "spool").touch()

    def refused(*_: object, **__: object) -> None:
        raise InvalidCommand("read-only file system")

    monkeypatch.setattr("busmaster.app.outputs.spilling.Spool", refused)
    said: list[str] = []
    output = csv(tmp_path, said.append)
    output.offer(cycle(1, 1))
    output.start()
    until(lambda: output.written == 1)
    output.close(PATIENCE)
    assert said == ["csv: read-only file system"]


def test_while_values_on_disk_are_sent_new_ones_go_behind_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else memory would overflow while a long queue on disk is sent."""
    (tmp_path / "x").mkdir()
    output = csv(tmp_path, lambda _: None)
    output.start()
    for number in range(1, 51):
        output.offer(cycle(number, number))
    output.close(PATIENCE)
    monkeypatch.setattr("busmaster.app.outputs.batches.SPILLED_AT_ONCE", 10)
    (tmp_path / "x").rmdir()
    again = csv(tmp_path, lambda _: None)
    commit = again.commit
    most = 0

    def committed(batch: list[bytes]) -> None:
        nonlocal most
        most = max(most, len(again._waiting))
        commit(batch)
        if again.written < 30:
            for _ in range(10):
                again.offer(cycle(60, 60))

    again.commit = committed  # type: ignore[method-assign]  # replaced here
    again.start()
    until(lambda: again.written >= 50 and settled(again))
    again.close(PATIENCE)
    assert numbers(tmp_path / "x")[:50] == list(range(1, 51))
    assert most <= 10
