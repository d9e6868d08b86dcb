"""The arguments of commands: which text is accepted, its meaning, and which text is refused."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import click
import pytest

from busmaster import LEARNED
from busmaster.app.cli import parsing, protocols
from busmaster.app.cli.parsing import (
    Assignment,
    Whole,
    option_type,
    parse_assignment,
    parse_items,
    parse_nodes,
    parse_seconds,
    parse_value,
    parse_window,
    parsed,
)
from busmaster.app.cli.protocols import Offer, handle_options, item_lines, offers, read_options, take_options
from busmaster.errors import InvalidCommand
from busmaster.registry import Option, kinds
from tests.app.cli.conftest import Command


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (parse_nodes, "5", (5,)),
        (parse_nodes, "1-3, 255", (1, 2, 3, 255)),
        (parse_nodes, "7,2-4,3,7", (7, 2, 3, 4)),
        (parse_nodes, " 4 - 4 ", (4,)),
        (parse_nodes, "0", (0,)),
        (parse_seconds, "0.5", 0.5),
        (parse_seconds, "1e-3", 0.001),
        (parse_window, "20", 0.02),
        (parse_window, "60000", 60.0),
        (parse_window, "learned", LEARNED),
        (parse_items, "1, 10,axis0.idle,,1", ("1", "10", "axis0.idle")),
        (parse_value, " 0x41 ", 65),
        (parse_value, "0XfF", 255),
        (parse_value, "-7", -7),
        (parse_value, "1.5e3", 1500.0),
        (parse_value, "inf", float("inf")),
        (parse_assignment, "1=2.5", Assignment("1", (2.5,))),
        (parse_assignment, " winder/force = 1,0x10 ", Assignment("winder/force", (1, 16))),
    ],
)
def test_an_argument_means_what_it_is(parse: Callable[[str], Any], text: str, value: Any) -> None:
    found = parse(text)
    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("parse", "text", "complaint"),
    [
        (parse_nodes, "", "'' is not a node list; write it like 1-8,255"),
        (parse_nodes, "1-", "is not a node list"),
        (parse_nodes, "-3", "is not a node list"),
        (parse_nodes, "1-x", "is not a node list"),
        (parse_nodes, "1,,2", "is not a node list"),
        (parse_nodes, "1,8-3", "the range 8-3 is descending; write 3-8"),
        (parse_nodes, "1,100000", "no protocol has a node 100000"),
        (parse_nodes, "1-100000", "no protocol has a node 100000"),
        (parse_seconds, "0", "a time must be above 0, not 0"),
        (parse_seconds, "-1", "a time must be above 0, not -1"),
        (parse_seconds, "inf", "a time must be above 0, not inf"),
        (parse_seconds, "nan", "a time must be above 0, not nan"),
        (parse_seconds, "soon", "'soon' is not a number"),
        (parse_window, "60001", "a reply window must be at most 60000 ms, not 60001"),
        (parse_window, "0", "a time must be above 0"),
        (parse_window, "Learned", "is not a number"),
        (parse_items, " , ", "--items needs at least one item"),
        (parse_value, "0x", "'0x' is not a number"),
        (parse_value, "1,5", "is not a number"),
        (parse_assignment, "1", "'1' is not an assignment; write ITEM=VALUE, like 1=123.456"),
        (parse_assignment, "=1", "is not an assignment"),
        (parse_assignment, "1=", "is not an assignment"),
        (parse_assignment, " = 1", "is not an assignment"),
        (parse_assignment, "1=2,,3", "'' is not a number"),
        (parse_assignment, "1=@/none/table", "/none/table: No such file or directory"),
    ],
)
def test_an_argument_that_is_wrong_is_refused_with_the_right_form(
    parse: Callable[[str], Any], text: str, complaint: str
) -> None:
    with pytest.raises(InvalidCommand) as caught:
        parse(text)
    assert complaint in str(caught.value)
    with pytest.raises(click.BadParameter) as bad:
        option_type(parse)(text)
    assert complaint in bad.value.message
    with click.Context(click.Command("read")) as context, pytest.raises(click.UsageError) as usage:
        parsed(parse, text)
    assert complaint in usage.value.message
    assert usage.value.ctx is context  # so the usage of the command is printed, too


def test_a_broadcast_address_is_a_node(monkeypatch: pytest.MonkeyPatch) -> None:
    class Profile:
        addresses = range(1, 9)
        broadcast = 99

    class Kind:
        profile = Profile

    monkeypatch.setattr(parsing, "kinds", lambda: {"one": Kind, "other": Kind})
    assert parse_nodes("8,99") == (8, 99)
    with pytest.raises(InvalidCommand, match="no protocol has a node 98"):
        parse_nodes("98")


@pytest.mark.parametrize(
    ("assignment", "complaint"),
    [
        (Assignment("1.17:3", (1, 2)), "1.17:3 takes 3 values, not 2"),
        (Assignment("1.17:3", (1, 2), "cam.csv"), "1.17:3 takes 3 values; cam.csv has 2"),
    ],
)
def test_a_wrong_number_of_values_is_named_with_their_file(assignment: Assignment, complaint: str) -> None:
    with pytest.raises(InvalidCommand) as caught:
        assignment.check_count(3)
    assert str(caught.value) == complaint
    assignment.check_count(2)


# the options of the protocols


def option(name: str, kind: Any = "flag", text: str = "Do it") -> Option:
    return Option(name, kind, text)


def test_an_option_of_several_protocols_is_offered_once_with_all_of_them() -> None:
    found = {one.option.name: one.kinds for one in handle_options()}
    for name, of in found.items():
        assert of == tuple(kind.name for kind in kinds().values() if name in {one.name for one in kind.options})
    assert len(found) == len(handle_options())
    assert "chain" in {one.option.name for one in read_options()}


def test_an_option_without_a_help_is_not_on_the_command_line() -> None:
    assert offers(lambda kind: [option("shown"), option("hidden", text="")])[0].option.name == "shown"
    assert len(offers(lambda kind: [option("shown"), option("hidden", text="")])) == 1


def test_the_options_that_are_given_are_taken_and_only_for_a_protocol_that_has_them() -> None:
    offered = [
        Offer(option("chain"), ("mentor",)),
        Offer(option("address_step", "whole"), ("msc", "other")),
        Offer(option("mode", "text"), ("msc",)),
    ]
    given = {"chain": False, "address_step": 4, "mode": "fast", "rest": 1}
    assert take_options(offered, "msc", given) == {"address_step": 4, "mode": "fast"}
    assert given == {"rest": 1}
    assert take_options(offered, "other", {"address_step": 4, "mode": None}) == {"address_step": 4}
    assert take_options(offered, "mentor", {"chain": True}) == {"chain": True}
    with pytest.raises(click.UsageError) as caught:
        take_options(offered, "mentor", {"chain": True, "address_step": 4})
    assert caught.value.message == "--address-step is only for msc and other; leave it out"


def test_each_kind_of_option_takes_its_kind_of_value() -> None:
    flag, whole, text = (
        Offer(option(name, kind), ("msc", "mentor")).parameter()
        for name, kind in (("to_be", "flag"), ("step", "whole"), ("mode", "text"))
    )
    assert flag.opts == ["--to-be"]
    assert flag.is_flag
    assert flag.help == "msc, mentor: Do it."
    assert isinstance(whole.type, Whole)
    assert whole.type.min == 1
    assert not whole.is_flag
    assert (text.metavar, text.is_flag, text.type.name) == ("MODE", False, "text")


def test_the_name_of_a_protocol_may_be_written_as_it_is_spoken() -> None:
    for name in kinds():
        assert protocols.parse_protocol(name) == name
    with pytest.raises(InvalidCommand, match="mentor"):
        protocols.parse_protocol("mentr")


def test_the_help_of_protocols_names_all_of_them(busmaster: Command) -> None:
    shown = " ".join(busmaster("scan", "--help").out.split())
    assert f"One of {', '.join(kinds())}." in shown


def test_the_items_of_the_help_are_in_a_column_beside_the_protocols() -> None:
    lines = list(item_lines())
    assert max(map(len, lines)) <= protocols.WIDTH
    starts = [line for line in lines if line[2] != " "]
    assert [line.split()[0] for line in starts] == list(kinds())
    margin = starts[0].index(starts[0].split()[1])
    assert margin == 4 + max(map(len, kinds()))
    assert all(line[:margin].strip() == "" and line[margin] != " " for line in lines if line not in starts)
