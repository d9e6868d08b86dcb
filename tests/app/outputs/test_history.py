"""Past values of a point, read from databases that the output `sqlite` has written."""

from __future__ import annotations

import sqlite3
from contextlib import closing
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import pytest

from busmaster.app.outputs import history
from busmaster.app.outputs.history import History, HistoryFile, Part, PastSample
from busmaster.app.outputs.settings import SqliteSettings
from busmaster.app.outputs.sqlite import VERSION, SqliteOutput
from busmaster.errors import NoReply
from tests.app.outputs.cycles import cycle
from tests.patience import PATIENCE

FIRST = 1_700_000_000.0


def recorded(path: Path, *cycles: Any) -> HistoryFile:
    """The history of cycles that the output has written."""
    output = SqliteOutput("sqlite", SqliteSettings(path=str(path)))
    output.start()
    for one in cycles:
        output.offer(one)
    output.close(PATIENCE)
    assert output.statistics().dropped == 0
    return HistoryFile(str(path))


def with_samples(path: Path, *values: float | str | None, every: float = 1.0) -> HistoryFile:
    """A database with these values of the point 5/1, the first at FIRST; None is an error."""
    found = recorded(path, cycle(1, 0.0))
    with closing(sqlite3.connect(path)) as database, database:
        database.execute("delete from samples")
        rows = [
            (FIRST + every * number, value, "bad" if value is None else "good", "no reply" if value is None else None)
            for number, value in enumerate(values)
        ]
        database.executemany("insert into samples values (?, 1, ?, ?, ?)", rows)
        # Of another point, at the same times: it must not show.
        database.execute("insert into points (node, item, unit) values ('5', '2', '')")
        database.executemany("insert into samples values (?, 2, 99.5, 'good', null)", [(row[0],) for row in rows])
    return found


def test_samples_are_those_that_were_written_with_quality_and_error(tmp_path: Path) -> None:
    found = recorded(tmp_path / "x.db", cycle(1, 12.5, 7), cycle(2, NoReply("no reply"), 8))
    samples = found.read("5/1", "", 0, 1e11, 10).samples
    assert [sample[1:] for sample in samples] == [(12.5, "good", None), (None, "bad", "no reply")]
    assert samples[0].time <= samples[1].time


def test_both_ends_of_the_range_belong_to_it(tmp_path: Path) -> None:
    found = with_samples(tmp_path / "x.db", 0, 1, 2, 3, 4)
    assert [sample.value for sample in found.read("5/1", "", FIRST + 1, FIRST + 3, 10).samples] == [1, 2, 3]
    assert found.read("5/1", "", FIRST + 1.1, FIRST + 1.9, 10) == History()


def test_as_many_samples_as_the_limit_are_returned_as_they_are(tmp_path: Path) -> None:
    found = with_samples(tmp_path / "x.db", 0, 1, 2, 3)
    assert len(found.read("5/1", "", FIRST, FIRST + 3, 4).samples) == 4
    more = found.read("5/1", "", FIRST, FIRST + 3, 3)
    assert not more.samples
    assert sum(part.samples for part in more.parts) == 4


def test_of_more_samples_each_part_has_its_extremes_and_no_sample_is_lost(tmp_path: Path) -> None:
    found = with_samples(tmp_path / "x.db", 5, 9, 1, None, 2, 2, 3, 4)
    assert found.read("5/1", "", FIRST, FIRST + 8, 2).parts == (
        Part(FIRST, FIRST + 3, 1, 9, 4, 1),
        Part(FIRST + 4, FIRST + 7, 2, 4, 4, 0),
    )
    parts = found.read("5/1", "", FIRST, FIRST + 7, 3).parts  # the last sample is at the end of the range
    assert [part.samples for part in parts] == [3, 2, 3]
    assert parts[-1].end == FIRST + 7


def test_parts_without_a_sample_are_left_out_and_texts_have_no_extremes(tmp_path: Path) -> None:
    found = with_samples(tmp_path / "x.db", "[1, 2]", "[1, 3]", "[1, 4]", None)
    assert found.read("5/1", "", FIRST - 1000, FIRST + 1000, 3).parts == (Part(FIRST, FIRST + 3, None, None, 4, 1),)
    assert found.read("5/1", "", FIRST, FIRST + 2, 3).samples[2] == PastSample(FIRST + 2, "[1, 4]", "good", None)


def test_values_in_another_unit_are_of_another_scale_and_left_out(tmp_path: Path) -> None:
    first = cycle(1, 1.0)
    [(point, sample)] = first.samples.items()
    inches = replace(first, samples={replace(point, unit="in"): sample._replace(value=0.04)})
    found = recorded(tmp_path / "x.db", first, inches)
    assert [one.value for one in found.read("5/1", "", 0, 1e11, 10).samples] == [1.0]
    assert [one.value for one in found.read("5/1", "in", 0, 1e11, 10).samples] == [0.04]
    assert found.read("5/1", "mm", 0, 1e11, 10) == found.read("5/9", "", 0, 1e11, 10) == History()


def test_labels_come_with_the_values(tmp_path: Path) -> None:
    found = with_samples(tmp_path / "x.db", 1, 2)
    with closing(sqlite3.connect(tmp_path / "x.db")) as database, database:
        database.execute("insert into labels values (1, 2, 'run')")
    assert found.read("5/1", "", 0, 1e11, 10).labels == (("2", "run"),)
    assert found.read("5/1", "", 0, 1e11, 1).labels == (("2", "run"),), "beside parts too"


def test_a_read_that_takes_too_long_ends_with_a_proposal(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    found = with_samples(tmp_path / "x.db", *range(1000))
    monkeypatch.setattr(history, "HISTORY_WITHIN", -inf)
    monkeypatch.setattr(history, "STEPS", 1)
    with pytest.raises(TimeoutError, match="request a shorter range"):
        found.read("5/1", "", 0, 1e11, 10)


@pytest.mark.parametrize("version", range(1, VERSION + 1))
def test_a_database_of_each_layout_is_read(tmp_path: Path, version: int) -> None:
    found = with_samples(tmp_path / "x.db", 1)
    with closing(sqlite3.connect(tmp_path / "x.db")) as database:
        database.execute(f"pragma user_version = {version}")
    assert len(found.read("5/1", "", 0, 1e11, 10).samples) == 1


@pytest.mark.parametrize("version", [0, VERSION + 1])
def test_a_database_of_something_else_is_not_read(tmp_path: Path, version: int) -> None:
    found = with_samples(tmp_path / "x.db", 1)
    with closing(sqlite3.connect(tmp_path / "x.db")) as database:
        database.execute(f"pragma user_version = {version}")
    with pytest.raises(OSError, match=r"x\.db is not a database of the output sqlite"):
        found.read("5/1", "", 0, 1e11, 10)


def test_a_file_that_is_not_there_or_is_not_a_database_is_an_error_and_is_not_made(tmp_path: Path) -> None:
    absent = tmp_path / "absent?mode=rwc"
    with pytest.raises(OSError, match="cannot be read: unable to open"):
        HistoryFile(str(absent)).read("5/1", "", 0, 1e11, 10)
    (tmp_path / "text.db").write_text("a text, which SQLite takes for no database" * 100)
    with pytest.raises(OSError, match="cannot be read: file is not a database"):
        HistoryFile(str(tmp_path / "text.db")).read("5/1", "", 0, 1e11, 10)
    assert [path.name for path in tmp_path.iterdir()] == ["text.db"]


def test_it_is_read_while_it_is_written(tmp_path: Path) -> None:
    found = with_samples(tmp_path / "x.db", 1)
    with closing(sqlite3.connect(tmp_path / "x.db")) as writer:
        writer.execute("begin immediate")
        writer.execute("insert into samples values (?, 1, 2, 'good', null)", (FIRST + 1,))
        assert [one.value for one in found.read("5/1", "", 0, 1e11, 10).samples] == [1]
        writer.commit()
        assert [one.value for one in found.read("5/1", "", 0, 1e11, 10).samples] == [1, 2]


def test_a_path_may_have_any_characters(tmp_path: Path) -> None:
    found = recorded(tmp_path / "a b%20c#d.db", cycle(1, 7))
    assert [one.value for one in found.read("5/1", "", 0, 1e11, 10).samples] == [7]


def test_each_part_counts_its_own_errors(tmp_path: Path) -> None:
    found = with_samples(tmp_path / "x.db", None, None, 1, None, 2, 3)
    assert [part.errors for part in found.read("5/1", "", FIRST, FIRST + 6, 2).parts] == [2, 1]
