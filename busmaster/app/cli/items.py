"""`busmaster items`: what a protocol's documents name."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import click

from busmaster.app.cli.arguments import json_option
from busmaster.app.cli.output import columns, emit, emit_all, json_line, note
from busmaster.app.cli.parsing import option_type
from busmaster.app.cli.protocols import parse_protocol
from busmaster.ext import Bit, Item, NodeKind, find, meant

HEAD = ("ITEM", "NUMBER", "UNIT", "ACCESS", "MEANING")


@click.command()
@click.argument("protocol", type=option_type(parse_protocol))
@click.argument("words", nargs=-1, metavar="[WORD]...")
@json_option
def command(protocol: str, words: tuple[str, ...], as_json: bool) -> None:
    """List the items in the documents of PROTOCOL: item, number, unit, access and meaning, and the bits of words.

    With WORDs, only items that contain all of them are listed: `busmaster items hcp2 axis0 error`. 1-99 stands for each
    of these items. Access is blank if the documents do not define it.
    """
    kind = find(protocol)
    found = [item for item in kind.documented if all(word.lower() in text_of(item).lower() for word in words)]
    if words and kind.documented and not found:
        raise click.UsageError(f"{protocol} has no item with {' '.join(words)!r}; {guess(words, kind)}")
    if not kind.documented:
        note(f"{protocol}: its documents define no items; use {kind.items}")
    elif as_json:
        emit_all(json_line(**fields(item)) for item in found)
    else:
        emit(*page(found))


def text_of(item: Item) -> str:
    """Return all texts of an item, for the search."""
    bits = " ".join(f"{bit.name} {bit.severity} {bit.meaning}" for bit in item.bits)
    return f"{item.item} {item.number} {item.unit} {item.access} {item.meaning} {item.keyword} {bits}"


def guess(words: Sequence[str], kind: NodeKind) -> str:
    """Return a hint with the nearest item, or with all items if none is near."""
    return meant(words[0], (item.item for item in kind.documented))


def page(items: Iterable[Item]) -> Iterator[str]:
    """Yield the lines of a table, with the bits of a word below it."""
    rows = [HEAD]
    bits: dict[int, tuple[Bit, ...]] = {}
    for item in items:
        keyword = f" ({item.keyword})" if item.keyword else ""
        bits[len(rows)] = item.bits
        rows.append((item.item, item.number, item.unit, item.access, item.meaning + keyword))
    for number, line in enumerate(columns(rows)):
        yield line
        yield from columns([bit_row(bit) for bit in bits.get(number, ())])


def bit_row(bit: Bit) -> tuple[str, ...]:
    """Return the cells of one bit."""
    severity = f"{bit.severity}: " if bit.severity else ""
    return f"  bit {bit.number}", bit.name, severity + bit.meaning


def fields(item: Item) -> dict[str, Any]:
    """Return the item for JSON; null for unknown properties."""
    return {
        "item": item.item,
        "number": item.number or None,
        "unit": item.unit or None,
        "decimals": item.decimals,
        "access": item.access or None,
        "meaning": item.meaning,
        "keyword": item.keyword or None,
        "bits": [
            {"bit": bit.number, "name": bit.name, "meaning": bit.meaning, "severity": bit.severity or None}
            for bit in item.bits
        ],
    }
