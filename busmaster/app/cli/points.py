"""`busmaster points`: the points of a file as a table, out and in."""

from __future__ import annotations

import shutil
import sys
import textwrap
from collections.abc import Iterator, Mapping, Sequence

import click

from busmaster import InvalidCommand
from busmaster.app.cli.app import OK, WRONG_USAGE
from busmaster.app.cli.lines import file_argument, load
from busmaster.app.cli.output import Level, columns, emit, note
from busmaster.app.config import LineFile
from busmaster.app.line.points_table import COLUMNS, ITEM, LIMITED_BY, NODE, ORIGIN, POINT, entry_text, points_csv, rows
from busmaster.app.line.points_taking import BadRows, taken, write_beside
from busmaster.ext import LONGEST_FILE, read_file


@click.command()
@file_argument()
@click.option("--csv", "as_csv", is_flag=True, help="Print the points as CSV.")
@click.option(
    "--from",
    "table",
    type=click.Path(exists=True, dir_okay=False, allow_dash=True),
    metavar="CSV",
    help="Import the points of this CSV into LINE.toml; - is standard input.",
)
def command(path: str, as_csv: bool, table: str | None) -> int:
    """Show the points of LINE.toml, one per line: their keys, and the template or table that defines them. If the
    terminal is narrower than the table, each point is shown as a list.

    Limits apply to the quantity, for all of its names: the column limited_by lists other points whose limits apply too.
    The columns limited_by and origin are export-only.

    With --csv, the table is printed as CSV, for a spreadsheet. With --from, such a CSV is written into LINE.toml, and
    each change is printed; comments and order are kept. Rows add and change points, and never delete one. If a row has
    an error, nothing is written, and the errors are printed with row and column.
    """
    if as_csv and table is not None:
        raise click.UsageError("--csv exports and --from imports; leave out one of them")
    if table is not None:
        # read to its end first: a program in the same pipe may edit the file too
        data = _standard_input() if table == "-" else read_file(table)
        return take(load(path), path, "standard input" if table == "-" else table, data)
    file = load(path)
    if as_csv:
        print_csv(points_csv(file))
    else:
        emit(*page(file))
    return OK


def _standard_input() -> bytes:
    data = sys.stdin.buffer.read(LONGEST_FILE + 1)
    if len(data) > LONGEST_FILE:
        raise InvalidCommand(f"standard input has more than {LONGEST_FILE} bytes; a table of points must be shorter")
    return data


def page(file: LineFile) -> Iterator[str]:
    """Yield the lines of a table, without columns that are empty."""
    texts = [
        {NODE: row.node, POINT: row.point, ITEM: row.point}
        | {LIMITED_BY: ", ".join(row.limited_by), ORIGIN: row.origin}
        | {key: entry_text(row.entries, key) for key in row.entries}
        for row in rows(file)
    ]
    if not texts:
        yield "the file has no points; define them in [nodes.NAME.points]"
        return
    used = [column for column in COLUMNS if any(text.get(column) for text in texts)]
    table = list(
        columns([[column.upper() for column in used], *([text.get(key, "") for key in used] for text in texts)])
    )
    width = shutil.get_terminal_size().columns
    if sys.stdout.isatty() and max(map(len, table)) > width:
        yield from paragraphs(texts, used, width)
    else:
        yield from table


def paragraphs(texts: Sequence[Mapping[str, str]], used: Sequence[str], width: int) -> Iterator[str]:
    """Yield the points one below the other, for a terminal that is narrower than the table."""
    for text in texts:
        item = "" if text[ITEM] == text[POINT] else f" ({text[ITEM]})"
        yield f"{text[NODE]}/{text[POINT]}{item}"
        line = ", ".join(f"{key} {text[key]}" for key in used if key not in (NODE, POINT, ITEM) and text.get(key))
        yield from textwrap.wrap(line, width, initial_indent="    ", subsequent_indent="    ")


def print_csv(data: bytes) -> None:
    """Print CSV to the letter; on a terminal nothing in it makes it do anything."""
    if sys.stdout.isatty():
        emit(*data.decode().splitlines())
        return
    sys.stdout.flush()
    sys.stdout.buffer.write(data)
    sys.stdout.flush()


def take(file: LineFile, path: str, name: str, data: bytes) -> int:
    """Import a CSV of that name into the file, print the changes, and return the exit status."""
    try:
        taking = taken(file, name, data)
    except BadRows as bad:
        for fault in bad.faults:
            note(fault, Level.ERROR)
        return WRONG_USAGE
    if taking.changes:
        write_beside(path, taking.text)
    emit(*map(str, taking.changes))
    count = len(taking.changes)
    note(f"{path}: {count or 'no'} point{'' if count == 1 else 's'} changed")
    if taking.stay:
        note(f"not in the CSV, unchanged: {', '.join(taking.stay)}")
    return OK
