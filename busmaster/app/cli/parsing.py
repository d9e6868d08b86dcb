"""Parsers of command-line arguments. Each rejects invalid text."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from math import isfinite
from typing import NamedTuple, TypeVar

import click

from busmaster import LEARNED, InvalidCommand
from busmaster.ext import Learned, is_decimal, kinds, read_file

S = TypeVar("S")
T = TypeVar("T")

LONGEST_WINDOW = 60.0
"""Seconds. Maximum reply delay moves with it, and a line is first listened to for that long."""

FROM_FILE = "@"
"""Before the name of a file with the values of an item."""
SEPARATORS = re.compile(r"\s*[,;\t]\s*|\s+")


class Whole(click.IntRange):
    """A whole number. Errors use this name, not "integer"."""

    name = "whole number"


def option_type(parse: Callable[[str], T]) -> Callable[[str], T]:
    """Return a reader for click's `type=`.

    A value that `parse` refuses with InvalidCommand is wrong usage of that option.
    """

    def convert(text: str) -> T:
        try:
            return parse(text)
        except InvalidCommand as error:
            raise click.BadParameter(str(error)) from None

    return convert


def parse_nodes(text: str) -> tuple[int, ...]:
    """Return the addresses of `1-8,255`. Raises InvalidCommand."""
    addresses: dict[int, None] = {}
    for part in text.split(","):
        first, dash, last = (piece.strip() for piece in part.partition("-"))
        if not is_decimal(first) or (dash and not is_decimal(last)):
            raise InvalidCommand(f"{text!r} is not a node list; write it like 1-8,255")
        start, stop = int(first), int(last or first)
        if start > stop:
            raise InvalidCommand(f"the range {part.strip()} is descending; write {stop}-{start}")
        if not any(stop in kind.profile.addresses or stop == kind.profile.broadcast for kind in kinds().values()):
            raise InvalidCommand(f"no protocol has a node {stop}")
        addresses.update(dict.fromkeys(range(start, stop + 1)))
    return tuple(addresses)


def parse_seconds(text: str) -> float:
    """Return a time in seconds, above 0. Raises InvalidCommand for any other."""
    seconds = parse_value(text)
    if not 0 < seconds < float("inf"):
        raise InvalidCommand(f"a time must be above 0, not {text}")
    return seconds


def parse_window(text: str) -> float | Learned:
    """Read a reply window in milliseconds, or `learned`, and return it in seconds.

    Raises InvalidCommand for one that is far too long.
    """
    if text == "learned":
        return LEARNED
    seconds = parse_seconds(text) / 1000
    if seconds > LONGEST_WINDOW:
        raise InvalidCommand(f"a reply window must be at most {LONGEST_WINDOW * 1000:.0f} ms, not {text}")
    return seconds


def parse_items(text: str) -> tuple[str, ...]:
    """Return the items of `--items a,b,c`. Raises InvalidCommand for none."""
    items = tuple(item for item in (part.strip() for part in text.split(",")) if item)
    if not items:
        raise InvalidCommand("--items needs at least one item")
    return tuple(dict.fromkeys(items))


class Assignment(NamedTuple):
    """An item, its new values, and the file of the values, or empty."""

    item: str
    values: tuple[float, ...]
    path: str = ""

    def check_count(self, counted: int) -> None:
        """Raise InvalidCommand unless it has so many values."""
        if len(self.values) != counted:
            where = f"; {self.path} has {len(self.values)}" if self.path else f", not {len(self.values)}"
            raise InvalidCommand(f"{self.item} takes {counted} values{where}")


def parse_assignment(text: str) -> Assignment:
    """Return the item and the numbers of `ITEM=VALUE[,VALUE...]` or `ITEM=@FILE`. Raises InvalidCommand."""
    item, equals, values = text.partition("=")
    item, values = item.strip(), values.strip()
    if not equals or not item or not values:
        raise InvalidCommand(f"{text!r} is not an assignment; write ITEM=VALUE, like 1=123.456")
    if values.startswith(FROM_FILE):
        path = values.removeprefix(FROM_FILE)
        return Assignment(item, numbers_of_file(path), path)
    return Assignment(item, tuple(parse_value(part) for part in values.split(",")))


def numbers_of_file(path: str) -> tuple[float, ...]:
    """Return the numbers of a text file, line by line.

    Numbers are separated by commas, semicolons, tabs or spaces. Empty lines and lines that begin with # are ignored.
    Raises InvalidCommand, with file and line, for what cannot be read or is not a finite number.
    """
    try:
        text = read_file(path).decode("utf-8-sig")
    except OSError as error:
        raise InvalidCommand(f"{path or 'the file'}: {error.strerror}") from None
    except UnicodeDecodeError:
        raise InvalidCommand(f"{path}: it is not a text file in UTF-8") from None
    found = tuple(_numbers(path, text))
    if not found:
        raise InvalidCommand(f"{path}: there is no number in it")
    return found


def _numbers(path: str, text: str) -> Iterator[float]:
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        if "," in line and ";" in line:  # decimal commas would be taken for two numbers each
            raise InvalidCommand(f"{path}:{number}: it has commas and semicolons: write decimals with a point")
        for part in SEPARATORS.split(line.strip()):
            try:
                value = parse_value(part)
            except InvalidCommand:
                raise InvalidCommand(f"{path}:{number}: {part!r} is not a number") from None
            if not isfinite(value):
                raise InvalidCommand(f"{path}:{number}: {part} is not a finite number")
            yield value


def parse_value(text: str) -> float:
    """Return the number; a whole one stays whole. Hexadecimal (0x41) is accepted for words. Raises InvalidCommand."""
    text = text.strip()
    try:
        return int(text, 16) if text.lower().startswith("0x") else int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        raise InvalidCommand(f"{text!r} is not a number") from None


def parsed(parse: Callable[[S], T], value: S) -> T:
    """Return the result of `parse` for an argument. Raises UsageError for an InvalidCommand."""
    try:
        return parse(value)
    except InvalidCommand as error:
        raise click.UsageError(str(error), click.get_current_context()) from None
