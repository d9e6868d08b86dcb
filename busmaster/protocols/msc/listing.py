"""The data table of a macroprogram's listing: the names of the program's data, and their addresses.

According to the document (IB-11A002), a listing has a "Data Table" with an entry for each symbol or array, and its
address in the data area. The document shows no example, and none is known elsewhere. So only this is assumed:

- The table begins below a line with the words "Data Table". Lines without a digit, such as headings, may come first.

- An entry is a line with a name, an address, and optionally the number of its values ("32", or "dim 32").

- An address is decimal, or hexadecimal with an H behind it, or with a $ or 0x in front. An ambiguous address (007, 7D8)
  is rejected.

- The table ends with the file, or with a title: a line that ends in the word "table" or "listing".
"""

from __future__ import annotations

import re
from collections.abc import Iterator

from busmaster.errors import InvalidCommand

TITLE = re.compile(r"\bdata table\b", re.IGNORECASE)
OTHER_TITLE = re.compile(r"\b(table|listing)\W*$", re.IGNORECASE)
ENTRY = re.compile(
    r"""
    (?P<name>[A-Za-z_][A-Za-z0-9_]*)
    [\s:|]+ (?: (?P<decimal>0|[1-9][0-9]*) | (?:\$|0[xX])(?P<marked>[0-9A-Fa-f]+) | (?P<hex>[0-9][0-9A-Fa-f]*)[hH] )
    (?: [\s|]+ (?:dim[\s|]+)? (?P<count>[1-9][0-9]*) )?
    """,
    re.VERBOSE | re.IGNORECASE,
)
HIGHEST = 0xFFFF
MOST_TOLD = 3


def read_listing(text: str) -> dict[str, int]:
    """Return the address of each symbol of a listing's data table.

    Raises InvalidCommand for a listing without a data table, and for lines that cannot be read, with their number and
    the first of them.
    """
    symbols: dict[str, int] = {}
    bad: list[str] = []
    for number, line in _table(text):
        fault = _take(line, symbols)
        if fault:
            bad.append(f"line {number}, {line!r}: {fault}")
    if bad:
        more = f"; and {len(bad) - MOST_TOLD} more" if len(bad) > MOST_TOLD else ""
        lines = "1 line" if len(bad) == 1 else f"{len(bad)} lines"
        raise InvalidCommand(
            f"{lines} of its data table cannot be read: {'; '.join(bad[:MOST_TOLD])}{more}; write the symbols as a "
            "table: { NAME = ADDRESS }"
        )
    if not symbols:
        raise InvalidCommand("it has no data table, or an empty one: its entries must be below the words Data Table")
    return symbols


def _table(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines of data tables, with their numbers: from the first that has a digit, without rules and blanks."""
    inside = begun = False
    for number, line in enumerate(text.splitlines(), 1):
        line = line.strip()
        if TITLE.search(line):
            inside, begun = True, False
        elif OTHER_TITLE.search(line):
            inside = False
        elif inside and any(map(str.isalnum, line)):
            begun = begun or any(map(str.isdigit, line))
            if begun:
                yield number, line


def _take(line: str, symbols: dict[str, int]) -> str:
    """Store the symbol of one line. Returns its fault, or "" if there is none."""
    found = ENTRY.fullmatch(line)
    if found is None:
        return "no name with an address that is decimal, or marked as hexadecimal"
    name, digits = found["name"], found["marked"] or found["hex"]
    address = int(digits, 16) if digits else int(found["decimal"])
    if address > HIGHEST:
        return f"an address is 0 to {HIGHEST}"
    if symbols.setdefault(name, address) != address:
        return f"{name} is at {symbols[name]} already"
    return ""
