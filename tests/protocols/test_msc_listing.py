"""The data table of a listing: what can be read without a guess, and all else counted and named."""

from __future__ import annotations

from pathlib import Path

import pytest

from busmaster.app.config import FileError, emulated_line, load
from busmaster.app.line import ConfiguredLine
from busmaster.app.line.points_table import points_csv, rows
from busmaster.app.line.points_taking import taken
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import InvalidCommand
from busmaster.protocols.msc.listing import read_listing
from tests.stories import in_virtual_time

LISTING = """\
 PRESS.MAC  Macroprogram Listing                          PAGE 1

  0001          array   dim     32
  0002          count   integer

 DATA TABLE

 SYMBOL          ADDRESS    SIZE
 ------          -------    ----
 count           2008
 length          2012       1
 array           0BB8H      dim 32
 speed           $0c1c
 gain            0xC20

 LABEL TABLE
 start           0100
"""
SYMBOLS = {"count": 2008, "length": 2012, "array": 3000, "speed": 3100, "gain": 3104}
LINE = """\
port = "/dev/ttyUSB0?baudrate=9600"
[nodes.press]
protocol = "msc"
address = 1
address_step = 4
symbols = "press.lst"
"""


def table(*lines: str) -> dict[str, int]:
    return read_listing("\n".join(("Data Table", *lines)))


def test_a_data_table_is_read_and_what_is_around_it_is_not() -> None:
    assert read_listing(LISTING) == SYMBOLS
    assert read_listing(LISTING.replace("\n", "\r\n")) == SYMBOLS


def test_a_table_that_goes_on_under_another_title_is_read_on() -> None:
    assert table(
        "a 2008", "", "\f PRESS.MAC listing", " 0001 stop", "Data Table (continued)", "SYMBOL ADDRESS", "b 2012"
    ) == {
        "a": 2008,
        "b": 2012,
    }


@pytest.mark.parametrize(
    ("line", "fault"),
    [
        ("b 07D8", "no name with an address that is decimal, or marked as hexadecimal"),
        ("b 0010", "no name with"),
        ("b", "no name with"),
        ("b 2012 x", "no name with"),
        ("b 2012 4 4", "no name with"),
        ("2012 b", "no name with"),
        ("b 70000", "an address is 0 to 65535"),
        ("b 20000h", "an address is 0 to 65535"),
        ("a 2012", "a is at 2008 already"),
        ("ü 2012", "no name with"),
        ("b ²", "no name with"),
    ],
)
def test_a_line_that_cannot_be_read_is_named_and_nothing_is_guessed(line: str, fault: str) -> None:
    with pytest.raises(InvalidCommand) as caught:
        table("a 2008", line)
    assert f"1 line of its data table cannot be read: line 3, {line!r}: {fault}" in str(caught.value)


def test_the_highest_address_is_65535() -> None:
    assert table("a 0", "b 65535", "c 0FFFFh") == {"a": 0, "b": 65535, "c": 65535}


def test_many_bad_lines_are_counted_and_the_first_are_named() -> None:
    with pytest.raises(
        InvalidCommand, match=r"5 lines of its .*line 3, 'b': .*line 4, 'c': .*line 5, 'd': .*; and 2 more; write"
    ):
        table("a 2008", *"bcdef")


@pytest.mark.parametrize("text", ["", "a 2008", "Data Table", "Data Table\nSYMBOL ADDRESS\n---\n"])
def test_a_listing_without_a_table_is_refused(text: str) -> None:
    with pytest.raises(InvalidCommand, match="it has no data table, or an empty one"):
        read_listing(text)


@in_virtual_time
async def test_what_the_program_calls_its_data_is_polled_and_written_by_name(tmp_path: Path) -> None:
    (tmp_path / "press.lst").write_text(LISTING)
    path = tmp_path / "line.toml"
    path.write_text(
        LINE + '[nodes.press.points]\nlength = { unit = "mm", factor = 0.001 }\n'
        '[groups.all]\nperiod = 0.1\npoints = "press/count,length,array:4"\n'
        "[emulator.nodes.press.values]\ncount = 7\nlength = 12.345\narray = [1, 2, 3, 4]\n"
    )
    file = load(path)
    async with ConfiguredLine(file, port=MemoryPort(emulated_line(file)), outputs=False) as line:
        async for snapshot in line.groups["all"]:
            values = {point.key: sample.value for point, sample in snapshot.items()}
            break
        assert values == {"press/count": 7, "press/length": 12.345, "press/array:4": (1, 2, 3, 4)}
        await line.point("press/count").write(9)
        assert await line.point("press/2008").read() == 9


def test_symbols_are_rows_of_the_table_to_which_units_and_limits_can_be_added(tmp_path: Path) -> None:
    (tmp_path / "press.lst").write_text(LISTING)
    path = tmp_path / "line.toml"
    path.write_text(LINE)
    file = load(path)
    assert {row.point: row.origin for row in rows(file)} == dict.fromkeys(SYMBOLS, "symbols")
    assert taken(file, "points.csv", points_csv(file)).changes == ()
    path.write_text(taken(file, "points.csv", b"node,point,unit,maximum\npress,count,pcs,99\n").text)
    point = load(path).nodes["press"].points["count"]
    assert (point.item, point.unit, point.maximum) == ("count", "pcs", 99)


@pytest.mark.parametrize(
    ("listing", "fault"),
    [
        (None, r"line.toml:6: nodes.press.symbols: .*press.lst cannot be read: No such file"),
        ("Data Table\nstatus 2008\n", r"line.toml:2: nodes.press: 'status' cannot be the name of a symbol"),
        ("Data Table\ncount 07D8\n", r"line.toml:6: nodes.press.symbols: .*press.lst: 1 line of its data table cannot"),
    ],
)
def test_a_listing_that_cannot_be_read_is_an_error_of_the_file(listing: str | None, fault: str, tmp_path: Path) -> None:
    if listing is not None:
        (tmp_path / "press.lst").write_text(listing)
    (tmp_path / "line.toml").write_text(LINE)
    with pytest.raises(FileError, match=fault):
        ConfiguredLine(load(tmp_path / "line.toml"), outputs=False)
