"""`busmaster items`: what the documents name, as a table and as JSON."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from busmaster.app.cli import items
from busmaster.ext import Bit, Item
from busmaster.registry import find, kinds
from tests.app.cli.conftest import Command


def test_a_table_has_item_number_unit_access_and_meaning(busmaster: Command) -> None:
    shown = busmaster("items", "microflex")
    assert (shown.status, shown.err) == (0, "")
    assert shown.lines[0].split() == ["ITEM", "NUMBER", "UNIT", "ACCESS", "MEANING"]
    row = next(line for line in shown.lines if line.startswith("bus_voltage"))
    assert row.split() == ["bus_voltage", "126", "V", "read", "DC", "bus", "voltage"]
    assert next(line for line in shown.lines if line.startswith("speed_reference")).split()[1:7] == [
        *("118", "%", "of", "max", "speed", "read/write")
    ]


def test_the_bits_of_a_word_stand_below_it(busmaster: Command) -> None:
    lines = busmaster("items", "msc").lines
    status = lines.index(next(line for line in lines if line.startswith("status ")))
    assert [line.split()[:3] for line in lines[status + 1 : status + 3]] == [
        ["bit", "0", "PROGRAM_RUNNING"],
        ["bit", "1", "BATTERY_LOW"],
    ]
    assert lines[status + 13].split(maxsplit=3)[3] == "error: a bad opcode was found"
    assert all(line.startswith("  bit ") for line in lines[status + 1 :])
    assert len(lines) == status + 17


def test_a_keyword_of_the_devices_own_language_stands_behind_the_meaning(busmaster: Command) -> None:
    assert busmaster("items", "hcp2", "axis0.position").lines[1].endswith("actual position (POS(0))")


def test_json_is_an_object_a_line_with_nulls_for_what_is_not_said(busmaster: Command) -> None:
    rows = [json.loads(line) for line in busmaster("items", "mentor", "--json").lines]
    assert rows[0] == {
        "item": "speed_reference_1",
        "number": "1.17",
        "unit": "%",
        "decimals": 1,
        "access": "read/write",
        "meaning": "speed reference 1, of the maximum speed",
        "keyword": None,
        "bits": [],
    }
    assert (rows[1]["item"], rows[1]["unit"], rows[1]["access"]) == ("serial_address", None, None)
    (word,) = [json.loads(line) for line in busmaster("items", "microflex", "command_word", "--json").lines]
    assert [(bit["bit"], bit["name"], bit["severity"]) for bit in word["bits"]] == [
        (6, "CANCEL", None),
        (7, "ENABLE", None),
    ]


@pytest.mark.parametrize("protocol", list(kinds()))
def test_every_protocol_lists_all_that_it_documents(busmaster: Command, protocol: str) -> None:
    rows = [json.loads(line)["item"] for line in busmaster("items", protocol, "--json").lines]
    assert rows == [item.item for item in find(protocol).documented]
    assert rows


@pytest.mark.parametrize(
    ("words", "found"),
    [
        (("axis3", "ERROR"), ["axis3.axis_error", "axis3.following_error"]),
        (("read/write",), ["1-5", "6-99", "outputs"]),
        (("239",), ["firmware"]),
        (("erraxis",), ["error_axis"]),
    ],
)
def test_words_choose_what_has_all_of_them_somewhere(
    busmaster: Command, words: tuple[str, ...], found: list[str]
) -> None:
    assert [json.loads(line)["item"] for line in busmaster("items", "hcp2", *words, "--json").lines] == found


def test_the_bits_are_searched_too(busmaster: Command) -> None:
    assert busmaster("items", "msc", "opcode").lines[1].startswith("status")


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        (("microflx",), "no such protocol 'microflx'; did you mean 'microflex'?"),
        (("profibus",), "no such protocol 'profibus'; there are ct-ansi, dc104, "),
        (("microflex", "bus_voltagee"), "microflex has no item with 'bus_voltagee'; did you mean 'bus_voltage'?"),
        (("hcp", "speed"), "hcp has no item with 'speed'; there are 1-5, 6-99"),
        ((), "missing argument 'PROTOCOL'"),
    ],
)
def test_what_is_not_there_is_one_line_that_helps_and_status_2(
    busmaster: Command, arguments: tuple[str, ...], complaint: str
) -> None:
    shown = busmaster("items", *arguments)
    assert (shown.status, shown.out) == (2, "")
    assert complaint in shown.err
    assert shown.err.count("\n") == 1


def test_a_protocol_that_documents_nothing_says_what_an_item_is(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(items, "find", lambda name: replace(find(name), documented=()))
    for words in ((), ("speed",), ("speed", "--json")):
        shown = busmaster("items", "dc104", *words)
        assert (shown.status, shown.out) == (0, "")
        assert shown.err == "busmaster: dc104: its documents define no items; use a parameter, 1 to 255\n"


MADE_UP = (
    Item(
        item="speed",
        number="7",
        unit="rpm",
        access="read",
        meaning="how quickly it turns",
        bits=(
            Bit(number=0, name="FAST", meaning="very much so", severity="warning"),
            Bit(number=1, name="SLOW", meaning=""),
        ),
    ),
    Item(item="torque", number="", meaning="how hard it pulls"),
)
"""With everything, and with next to nothing."""


@pytest.fixture
def made_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """The documents of dc104 define these items."""
    monkeypatch.setattr(items, "find", lambda name: replace(find(name), documented=MADE_UP))


@pytest.mark.usefixtures("made_up")
@pytest.mark.parametrize("word", ["SPEED", "7", "rpm", "read", "turns", "fast", "very MUCH", "warning", "slow"])
def test_a_word_is_found_in_every_text_of_an_item_and_its_bits(busmaster: Command, word: str) -> None:
    rows = [json.loads(line)["item"] for line in busmaster("items", "dc104", word, "--json").lines]
    assert rows == ["speed"]


@pytest.mark.usefixtures("made_up")
def test_json_has_null_for_each_fact_that_is_not_defined(busmaster: Command) -> None:
    speed, torque = (json.loads(line) for line in busmaster("items", "dc104", "--json").lines)
    assert speed["bits"] == [
        {"bit": 0, "name": "FAST", "meaning": "very much so", "severity": "warning"},
        {"bit": 1, "name": "SLOW", "meaning": "", "severity": None},
    ]
    assert (torque["number"], torque["unit"], torque["access"], torque["keyword"]) == (None, None, None, None)


@pytest.mark.usefixtures("made_up")
@pytest.mark.parametrize("option", [(), ("--json",)])
def test_words_that_no_item_has_are_wrong_usage_with_the_nearest_item_of_the_first(
    busmaster: Command, option: tuple[str, ...]
) -> None:
    shown = busmaster("items", "dc104", "sped", "torqe", *option)
    assert (shown.status, shown.out) == (2, "")
    assert "dc104 has no item with 'sped torqe'; did you mean 'speed'?" in shown.err


def test_the_help_of_items_says_where_more_is_said(busmaster: Command) -> None:
    for command in ("read", "write", "poll"):
        assert "`busmaster items PROTOCOL`" in busmaster(command, "--help").out
