"""Whether a LINE.toml is right: all its problems at once. No port and no output is opened.

The problems are those of `load` and `ConfiguredLine`, which `busmaster run` uses: there is no second set of rules.
Where `run` stops at the first problem, `check` has the source collect them, and reads on. What cannot be known because
of another problem, such as a point of a node that could not be read, is not reported.
"""

from __future__ import annotations

import os
import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from functools import partial
from pathlib import Path

from busmaster import InvalidCommand
from busmaster.app.config.emulated import emulated_line
from busmaster.app.config.names import expanded, listed
from busmaster.app.config.sections import LineFile, read
from busmaster.app.config.source import FileError, Key, Source
from busmaster.app.config.table import Table
from busmaster.app.line.configured_line import ConfiguredLine


@dataclass(frozen=True, slots=True)
class Report:
    """The errors of a file, in the order of its lines, and warnings about settings that `busmaster run` accepts."""

    problems: tuple[FileError, ...]
    warnings: tuple[str, ...]


def check(path: str | os.PathLike[str]) -> Report:
    """Return the problems of a LINE.toml, each with file, line and key, and warnings.

    Raises OSError if it cannot be read. Files that it names are read too: templates, symbols, tokens, certificates.
    """
    try:
        source = Source.read(path)
    except FileError as error:
        return Report((error,), ())
    source.problems = {}
    with warnings.catch_warnings(record=True) as noticed:
        warnings.simplefilter("always")
        file, line = _made(source)
    problems = list(_problems_of(source, line))
    known = [str(one.message) for one in noticed if issubclass(one.category, UserWarning)]
    if file is not None and line is not None and not problems:
        known += _doubts(file, line)
    return Report(tuple(problems), tuple(dict.fromkeys(known)))


def _made(source: Source) -> tuple[LineFile | None, ConfiguredLine | None]:
    """Read a file and make a line of it, as `run` does up to the opening of the port."""
    try:
        file = read(source)
        line = ConfiguredLine(file)
        with file.service.table.part():
            if file.service.enabled:
                file.service.secrets()
        for kind, settings in file.outputs.items():
            table = file.table.table("outputs").table(kind)
            settings.check_files(partial(_part_at, table))
    except FileError as error:  # one that leaves nothing to read on with
        source.keep(error)
        return None, None
    return file, line


@contextmanager
def _part_at(table: Table, key: str) -> Iterator[None]:
    """Report a problem at a key of a table, and go on behind it."""
    with table.part(), table.at(key):
        yield


def _problems_of(source: Source, line: ConfiguredLine | None) -> Iterator[FileError]:
    """Yield the problems that do not only follow from others, by their place in the file."""
    assert source.problems is not None
    unknown = _unread_nodes(source, line)
    for error in sorted(source.problems.values(), key=lambda error: (error.file != source.name, error.line)):
        if not any(_names(text, unknown) for text in _texts(source, error.way)):
            yield error


def _unread_nodes(source: Source, line: ConfiguredLine | None) -> set[str]:
    """Return the names of nodes with errors. References to these nodes cannot be checked."""
    nodes = source.data.get("nodes")
    unknown: set[str] = set()
    for section in nodes if isinstance(nodes, dict) else ():
        with suppress(InvalidCommand):
            names = set(expanded(section))
            unread = any(part[:2] == ("nodes", section) for part in source.unread)
            unknown |= names if unread or line is None else names - set(line.nodes)
    return unknown


def _texts(source: Source, way: Key) -> Iterator[str]:
    """Yield the names that stand where a problem is, outside of [nodes]: in the value, or as its key."""
    if not way or way[0] in ("nodes", "protocols"):
        return
    yield str(way[-1])
    value: object = source.data
    for step in way:
        if isinstance(value, str):
            break  # one text in place of a list of texts
        if not isinstance(value, dict | list):
            return
        try:
            value = value[step]  # type: ignore[index]  # a number leads into a list, a name into a table
        except (KeyError, IndexError, TypeError):
            return
    if isinstance(value, str):
        yield value


def _names(text: str, nodes: set[str]) -> bool:
    """Return whether a text such as "drive4-7/speed", "drive*/speed" or "drive4" names one of the nodes."""
    with suppress(InvalidCommand):
        for part in listed(text.partition("/")[0]):
            if any(fnmatchcase(node, part) for node in nodes) or not nodes.isdisjoint(expanded(part)):
                return True
    return False


def _doubts(file: LineFile, line: ConfiguredLine) -> Iterator[str]:
    """Yield warnings about settings that `run` accepts, but that are probably mistakes."""
    if not line.file.groups:
        yield "nothing is polled, because the file has no poll group; add [groups.NAME]"
    elif not line.plan().fits:
        yield "cycles will be missed; `busmaster plan` shows which, and suggests periods that fit"
    try:
        emulated_line(file)
    except InvalidCommand as error:
        yield f"`busmaster emulate` rejects the file: {error}"
    for kind, settings in file.outputs.items():
        for key in ("path", "spill"):
            path = getattr(settings, key, None)
            if path is not None and (why := _not_writable(time.strftime(path) if key == "path" else path)):
                yield f"outputs.{kind}.{key}: {why}"
    if file.learned is not None and (why := _not_writable(file.learned)):
        yield f"learned: {why}"


def _not_writable(path: str) -> str:
    """Return why this user cannot write a file, "" if it can. It is only a warning: `run` may run as another user."""
    where = Path(path)
    if where.is_dir():
        return f"{where} is a folder; name a file"
    while not where.exists() and where != where.parent:
        where = where.parent
    return "" if os.access(where, os.W_OK) else f"{where} cannot be written by this user; check the permissions"
