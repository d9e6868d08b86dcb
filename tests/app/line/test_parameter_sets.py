"""Files of parameter sets: what is wrong is named with its line, and an interrupted save goes on."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from busmaster.app.config.source import FileError
from busmaster.app.line.parameter_sets import PartFile, read_set, write_set
from busmaster.bus.parameters import Entry, Found, Parameter, ParameterSet
from busmaster.errors import InvalidCommand
from busmaster.registry import find

KIND = find("mentor")
WANTED = [Parameter(item="1.17", unit="%", decimals=1), Parameter(item="1.18"), Parameter(item="1.19")]
EMPTY = ParameterSet(protocol="mentor", address=11, saved=datetime(2026, 1, 31, tzinfo=UTC))


def test_a_value_is_written_in_its_unit_and_read_as_the_lines_number(tmp_path: Path) -> None:
    path = str(tmp_path / "a.toml")
    whole = ParameterSet(protocol="mentor", address=11, saved=EMPTY.saved, entries={"1.17": Entry(WANTED[0], -476)})
    write_set(path, whole, KIND)
    assert "value = -47.6" in Path(path).read_text()
    assert read_set(path).set.entries["1.17"].value == -476
    with pytest.raises(InvalidCommand, match="not overwritten"):
        write_set(path, whole, KIND)


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("value = -47.6", "valeu = -47.6", "parameters.1.17.valeu: no such key"),
        ("value = -47.6", 'value = "x"', "parameters.1.17.value: must be a number"),
        ('"mentor"', '"mentr"', "drive.protocol: no such protocol"),
        ("format = 1", "format = 2", "format: the set has format 2"),
    ],
)
def test_what_is_wrong_is_named_with_line_and_key(tmp_path: Path, old: str, new: str, what: str) -> None:
    path = tmp_path / "a.toml"
    entries = {"1.17": Entry(WANTED[0], -476)}
    write_set(str(path), ParameterSet(protocol="mentor", address=11, saved=EMPTY.saved, entries=entries), KIND)
    path.write_text(path.read_text().replace(old, new))
    with pytest.raises(FileError, match=what) as error:
        read_set(str(path))
    assert error.value.line > 0


def test_an_interrupted_save_goes_on_without_the_line_that_was_cut(tmp_path: Path) -> None:
    path = tmp_path / "a.toml"
    with PartFile(str(path), EMPTY, WANTED, KIND) as part:
        part.add(Found(WANTED[0], -476))
        part.add(Found(WANTED[1], why="no such parameter", gap=True))
    beside = tmp_path / "a.toml.part"
    beside.write_bytes(beside.read_bytes() + b'"1.19" = { val')
    with PartFile(str(path), EMPTY, WANTED, KIND) as part:
        assert [one.item for one in part.missing] == ["1.19"]
        part.add(Found(WANTED[2], 3))
    part.finish()
    assert {item: one.value for item, one in read_set(str(path)).set.entries.items()} == {"1.17": -476, "1.19": 3}
    assert not beside.exists()


def test_what_was_begun_with_another_list_is_not_gone_on_with(tmp_path: Path) -> None:
    path = str(tmp_path / "a.toml")
    with PartFile(path, EMPTY, WANTED, KIND):
        pass
    with pytest.raises(InvalidCommand, match="other parameters"):
        PartFile(path, EMPTY, WANTED[:2], KIND)
