"""What callers hand in is taken for what it is, or refused in words; names that were mistyped find their neighbours."""

from __future__ import annotations

import builtins
from fractions import Fraction
from math import inf, nan
from typing import Any

import pytest

from busmaster.contract.arguments import guess, host_and_port, is_decimal, meant, nearest, seconds, whole_number
from busmaster.errors import InvalidCommand


class Index:
    """A whole number of somebody's own."""

    def __index__(self) -> int:
        return 5


@pytest.mark.parametrize(
    ("text", "host", "port"), [("127.0.0.1:5020", "127.0.0.1", 5020), ("[::1]:0", "::1", 0), ("a:65535", "a", 65535)]
)
def test_an_address_is_a_host_and_a_port(text: str, host: str, port: int) -> None:
    assert host_and_port(text) == (host, port)


@pytest.mark.parametrize("text", ["5020", ":5020", "host", "host:", "host:-1", "host:65536", "host:5020x"])
def test_an_address_without_a_host_or_a_port_is_refused(text: str) -> None:
    with pytest.raises(InvalidCommand, match="HOST:PORT"):
        host_and_port(text)


@pytest.mark.parametrize("value", [3, 5, 7, Index()])
def test_a_whole_number_is_taken_from_the_lowest_to_the_highest(value: Any) -> None:
    number = whole_number(value, 3, 7, "a place")
    assert type(number) is int
    assert number == (5 if isinstance(value, Index) else value)


@pytest.mark.parametrize("value", [2, 8, -3])
def test_one_beyond_its_range_is_refused_with_the_range(value: int) -> None:
    with pytest.raises(InvalidCommand, match=f"^a place must be 3 to 7, not {value}"):
        whole_number(value, 3, 7, "a place")


@pytest.mark.parametrize("value", [True, False, 5.0, "5", None])
def test_what_is_no_whole_number_is_refused_as_it_was_given(value: Any) -> None:
    with pytest.raises(InvalidCommand, match=f"^a place must be a whole number, not {value!r}"):
        whole_number(value, 0, 7, "a place")


@pytest.mark.parametrize("value", [0, 0.0, 1, 0.5, 1e300, Fraction(1, 2)])
def test_a_time_is_0_s_or_more(value: Any) -> None:
    assert seconds(value, "a pause") == float(value)
    assert type(seconds(value, "a pause")) is float


@pytest.mark.parametrize("value", [-0.001, -1, inf, -inf, nan, 10**310, -(10**310), True, "1", None])
def test_anything_else_is_no_time(value: Any) -> None:
    with pytest.raises(InvalidCommand, match="a pause is a time of 0 s or more, not"):
        seconds(value, "a pause")


def test_a_decimal_has_digits_and_nothing_else() -> None:
    assert all(map(is_decimal, ("0", "12", "007")))
    assert not any(map(is_decimal, ("", "-1", "+1", "1.0", "1e3", "²", "٣", " 1")))


def test_a_mistyped_name_finds_its_neighbour() -> None:
    known = ["mentor", "modbus", "msc"]
    assert nearest("mentr", known) == "mentor"
    assert guess("mentr", known) == "; did you mean 'mentor'?"
    assert meant("mentr", known) == "did you mean 'mentor'?"


def test_a_name_that_is_near_nothing_is_told_what_there_is() -> None:
    known = ["mentor", "modbus"]
    assert nearest("xyz", known) is None
    assert guess("xyz", known) == ""
    assert meant("xyz", known) == "there are mentor, modbus"
    assert meant("xyz", iter(known)) == "there are mentor, modbus"
    assert meant("xyz", []) == "there are none"


def test_the_nearest_of_several_is_meant() -> None:
    assert nearest("gain2", ["gain1", "gain2", "gain3"]) == "gain2"


def test_where_no_file_can_be_opened_a_wrong_name_is_refused_without_a_guess(monkeypatch: pytest.MonkeyPatch) -> None:
    imports = builtins.__import__

    def without_descriptors(name: str, *args: Any, **options: Any) -> Any:
        if name == "difflib":
            raise OSError(24, "Too many open files")
        return imports(name, *args, **options)

    monkeypatch.setattr(builtins, "__import__", without_descriptors)
    assert guess("pres", ["press"]) == ""
