"""Reads and writes files of parameter sets. An error names its line; a file is written whole; a save can be resumed.

A set is TOML with a line for each parameter, whose value is in its unit. While a set is being saved, `FILE.part` beside
it contains the values that were read so far. An interrupted save continues from there.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from types import TracebackType
from typing import Any

from busmaster import InvalidCommand, ext
from busmaster.app.config.points import Scale
from busmaster.app.config.rewriting import toml_text
from busmaster.app.config.source import Source
from busmaster.app.config.table import Table, shown
from busmaster.app.line.configured_line import ConfiguredLine
from busmaster.ext import (
    MOST_MEMBERS,
    Entry,
    Found,
    Handle,
    NodeKind,
    Parameter,
    ParameterSet,
    Value,
    find,
    open_file,
    read_file,
)

FORMAT = 1
PART = ".part"
HEAD = "# The parameters of one node, saved by `busmaster params save`. Values are in their units.\n"
MOST_DECIMALS = 9
ENTRY_KEYS = ("value", "name", "unit", "decimals", "factor", "offset", "minimum", "maximum", "access")


class SetFile:
    """A parameter set that was read from a file, and where each of its values stands."""

    def __init__(self, source: Source, kind: NodeKind, wanted: ParameterSet) -> None:
        self.name = source.name
        self.kind = kind
        self.set = wanted
        self._source = source

    def check(self, handle: Handle) -> None:
        """Raise FileError for a set of another kind of node than the handle's, and for an item that this does not
        have."""
        kind = handle.profile.kind_name
        if kind != self.set.protocol:
            raise self._source.error(
                ("drive", "protocol"),
                f"{handle.node.label} is a {kind}, but the set belongs to a {self.set.protocol}; use a set of a {kind}",
            )
        for item in self.set.entries:
            with Table(self._source).at("parameters", item):
                handle.point(item)

    def check_range(self, item: str) -> None:
        """Raise FileError for a value beyond the range in the file, which must not be written. Values read from a node
        are not checked."""
        parameter, number = self.set.entries[item]
        value = in_unit(parameter, number, self.kind)
        for limit, beyond in (
            ("minimum", parameter.minimum is not None and value < parameter.minimum),
            ("maximum", parameter.maximum is not None and value > parameter.maximum),
        ):
            if beyond:
                what = f"{toml_text(value)} is beyond its {limit} of {toml_text(getattr(parameter, limit))}"
                raise self._source.error(("parameters", item, "value"), what)


def scale_of(parameter: Parameter, kind: NodeKind) -> Scale:
    """Return what the numbers of a parameter mean in its unit. Raises InvalidCommand for an item of no such kind."""
    whole = kind.whole_numbers(parameter.item)
    return Scale.of(parameter.factor, parameter.offset, parameter.decimals, whole=whole)


def in_unit(parameter: Parameter, value: Value, kind: NodeKind) -> Value:
    """Return the value in the parameter's unit, for the number that a handle without decimals reads."""
    if type(value) is bool:
        return value
    scale = scale_of(parameter, kind)
    number: Value = value if scale.trivial else scale.reader()(value)
    return number


# reading


def read_set(path: str) -> SetFile:
    """Read a parameter set. Raises OSError if the file cannot be read, and FileError with file, line and key for an
    error in it."""
    source = Source.read(path)
    table = Table(source)
    table.only("format", "drive", "saved", "parameters")
    return SetFile(source, *_read(table))


def _read(table: Table) -> tuple[NodeKind, ParameterSet]:
    number = table.whole("format")
    if number != FORMAT:
        raise table.error(
            f"the set has format {number}, and this version of busmaster reads {FORMAT}; use another version", "format"
        )
    drive, saved = table.table("drive"), table.table("saved")
    drive.only("protocol", "address", "label", "line", "identity")
    saved.only("time", "by")
    with drive.at("protocol"):
        kind = find(drive.text("protocol"))
    address = drive.whole("address", most=max(kind.profile.addresses))
    identity = drive.table("identity")
    parameters = table.table("parameters")
    if len(parameters.data) > MOST_MEMBERS:
        raise table.error(f"a parameter set must have at most {MOST_MEMBERS} parameters", "parameters")
    wanted = ParameterSet(
        protocol=kind.name,
        address=address,
        label=_text(drive, "label"),
        line=_text(drive, "line"),
        saved=_time(saved),
        by=_text(saved, "by"),
        identity={item: _value(identity, item) for item in identity.data},
        entries={entry.item: Entry(entry, value) for entry, value in _entries(parameters, kind)},
    )
    return kind, wanted


def _text(table: Table, key: str) -> str:
    return table.text(key) if key in table else ""


def _time(table: Table) -> datetime:
    time = table.data.get("time")
    if not isinstance(time, datetime) or time.tzinfo is None:
        raise table.error("must be a date and time with its zone, such as 2026-01-31T12:00:00Z", "time")
    return time


def _entries(table: Table, kind: NodeKind) -> Iterator[tuple[Parameter, Value]]:
    for item in table.data:
        entry = table.table(item)
        entry.only(*ENTRY_KEYS)
        parameter = Parameter(
            item=item,
            name=_text(entry, "name"),
            unit=_text(entry, "unit"),
            access="read" if "access" in entry and entry.choice("access", ["read"]) else "",
            decimals=entry.whole("decimals", most=MOST_DECIMALS) if "decimals" in entry else 0,
            factor=entry.number("factor") if "factor" in entry else 1,
            offset=entry.number("offset") if "offset" in entry else 0,
            minimum=entry.number("minimum") if "minimum" in entry else None,
            maximum=entry.number("maximum") if "maximum" in entry else None,
        )
        value = _value(entry, "value")
        with entry.at():
            scale = scale_of(parameter, kind)
        with entry.at("value"):
            yield parameter, value if scale.trivial else scale.write(value)


def _value(table: Table, key: str) -> Value:
    if key not in table:
        raise table.error(f"{key!r} is missing; use a number, true or false")
    if isinstance(table.data[key], list):
        raise table.error(f"must be a number, true or false, not {shown(table.data[key])}", key)
    [value] = table.numbers(key)
    return value


# writing


def set_text(one: ParameterSet, kind: NodeKind) -> str:
    """Return a set as its file has it."""
    return "".join((_header(one), *(_line(entry, kind) for entry in one.entries.values())))


def _header(one: ParameterSet) -> str:
    drive = {"protocol": one.protocol, "address": one.address, "label": one.label, "line": one.line}
    lines = "".join(f"{key} = {toml_text(value)}\n" for key, value in drive.items())
    return (
        f"{HEAD}format = {FORMAT}\n\n[drive]\n{lines}identity = {toml_text(dict(one.identity))}\n\n"
        f"[saved]\ntime = {one.saved.isoformat().replace('+00:00', 'Z')}\nby = {toml_text(one.by)}\n\n[parameters]\n"
    )


def _line(entry: Entry, kind: NodeKind) -> str:
    parameter = entry.parameter
    entries: dict[str, Any] = {"value": in_unit(parameter, entry.value, kind)}
    for key in ENTRY_KEYS[1:]:
        value = getattr(parameter, key)
        if value != getattr(_NOTHING, key) and (key != "access" or value == "read"):
            entries[key] = value
    return f"{toml_text(parameter.item)} = {toml_text(entries)}\n"


_NOTHING = Parameter(item="")


def write_set(path: str, one: ParameterSet, kind: NodeKind) -> None:
    """Write a set to a new file, whole: beside it, and then in its place. Raises OSError, and InvalidCommand if there
    is such a file already."""
    check_new(path)
    beside = f"{path}.new"
    try:
        with open(open_file(beside, os.O_WRONLY | os.O_TRUNC), "w", encoding="utf-8") as file:
            file.write(set_text(one, kind))
            file.flush()
            os.fsync(file.fileno())
        os.replace(beside, path)
    except BaseException:
        if os.path.exists(beside):
            os.unlink(beside)
        raise


def check_new(path: str) -> None:
    """Raise InvalidCommand for a file that exists: a set is not overwritten."""
    if os.path.exists(path):
        raise InvalidCommand(f"{path} exists and is not overwritten; choose another name")


class PartFile:
    """The part of a set that was read so far, for `with`: a file to which each parameter is appended.

    If it exists, the save continues where it stopped. Raises InvalidCommand if it belongs to another node or another
    list, FileError if it cannot be read.
    """

    def __init__(self, path: str, empty: ParameterSet, wanted: Sequence[Parameter], kind: NodeKind) -> None:
        check_new(path)
        self.gaps: dict[str, Found] = {}
        """What came of the parameters that have no value."""
        self._path = path
        self._part = path + PART
        self._kind = kind
        self._wanted = wanted
        self._found: dict[str, Entry] = {}
        digest = hashlib.sha256("\n".join(one.item for one in wanted).encode()).hexdigest()
        self._list = f"# of the list {digest}\n"
        self._set = self._resumed(empty) or empty
        self._file = open(open_file(self._part, os.O_WRONLY | os.O_APPEND), "a", encoding="utf-8")  # noqa: SIM115
        if self._file.tell() == 0:
            self._file.write(self._list + _header(self._set))
            self._file.flush()

    def __enter__(self) -> PartFile:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._file.close()

    @property
    def missing(self) -> tuple[Parameter, ...]:
        """Return the parameters that have not been read yet."""
        return tuple(one for one in self._wanted if one.item not in self._found and one.item not in self.gaps)

    def add(self, found: Found) -> None:
        """Keep what came of one parameter."""
        item = found.parameter.item
        if found.value is None:
            self.gaps[item] = found
            line = f"{toml_text(item)} = {toml_text({'why': found.why, 'gap': found.gap})}\n"
        else:
            self._found[item] = Entry(found.parameter, found.value)
            line = _line(self._found[item], self._kind)
        self._file.write(line)
        self._file.flush()

    def finish(self) -> ParameterSet:
        """Write the set to its file, remove this one, and return the set."""
        entries = {one.item: self._found[one.item] for one in self._wanted if one.item in self._found}
        done = replace(self._set, entries=entries)
        write_set(self._path, done, self._kind)
        os.unlink(self._part)
        return done

    def _resumed(self, empty: ParameterSet) -> ParameterSet | None:
        """Take what an interrupted save has read; None if there is nothing."""
        try:
            data = read_file(self._part)
        except FileNotFoundError:
            return None
        whole = data[: data.rfind(b"\n") + 1]  # a line that was being written is read again
        text = whole.decode(errors="replace")
        other = f"remove {self._part} to start again, or choose another name"
        if "[parameters]\n" not in text:
            os.unlink(self._part)  # it ended before the first parameter
            return None
        if not text.startswith(self._list):
            raise InvalidCommand(f"{self._part} was started with other parameters; {other}")
        source = Source(self._part, text)
        parameters = source.data["parameters"]
        gaps = {item: entry for item, entry in parameters.items() if isinstance(entry, dict) and "why" in entry}
        for item in gaps:
            del parameters[item]
        _, begun = _read(Table(source))
        if (begun.protocol, begun.address, begun.identity) != (empty.protocol, empty.address, empty.identity):
            raise InvalidCommand(f"{self._part} was started with another node ({begun.label}); {other}")
        own = {one.item: one for one in self._wanted}
        if unknown := sorted((begun.entries.keys() | gaps.keys()) - own.keys()):
            raise InvalidCommand(f"{self._part} has a parameter that is not in its list, {unknown[0]}; {other}")
        self._found = {item: Entry(own[item], entry.value) for item, entry in begun.entries.items()}
        for item, entry in gaps.items():
            self.gaps[item] = Found(own[item], why=str(entry["why"]), gap=entry.get("gap") is True)
        os.truncate(self._part, len(whole))
        return replace(begun, entries={})


# the nodes of a line


def line_parameters(
    line: ConfiguredLine, node: str, handle: Handle, items: Sequence[str] = ()
) -> tuple[Parameter, ...]:
    """Return the parameters of a node of a LINE.toml: those in its protocol's document, changed by the file, and those
    that only the file names; with `items`, only these.

    An item may be a point's name in the file. Raises InvalidCommand as `Handle.parameters` does.
    """
    section = line.file.nodes[node]
    kind, points = section.kind, section.points
    described: dict[object, Parameter] = {}
    for point in points.values():
        if kind.width(point.item) == 0:
            continue  # a run of several: each has a parameter of its own
        decimals = point.decimals if kind.takes_decimals and kind.whole_numbers(point.item) else 0
        source = handle.point(point.item)
        described.setdefault(
            source.command,
            Parameter(
                item=point.item,
                name="" if point.name == point.item else point.name,
                unit=point.unit or source.unit,
                access="" if source.writable else "read",
                decimals=decimals,
                factor=point.factor,
                offset=point.offset,
                minimum=point.minimum,
                maximum=point.maximum,
                kept="" if point.writable else "LINE.toml has writable = false",
            ),
        )
    if items:
        names = [points[item].item if item in points else item for item in items]
        listed = handle.parameters(names)
    else:
        listed = ext.listed_parameters(handle)
    known = {handle.point(one.item).command: one for one in listed}
    found = [_described(one, described.get(command)) for command, one in known.items()]
    if not items:
        found += [one for command, one in described.items() if command not in known]
    if not found:
        handle.parameters()  # for its complaint
    if len(found) > MOST_MEMBERS:
        raise InvalidCommand(f"a parameter set must have at most {MOST_MEMBERS} parameters")
    return tuple(found)


def _described(document: Parameter, file: Parameter | None) -> Parameter:
    """Return a parameter with the file's texts, and the document's item and order."""
    if file is None:
        return document
    return replace(
        file,
        item=document.item,
        name=file.name or document.name,
        access=document.access or file.access,
        kept=file.kept or document.kept,
        stage=document.stage,
    )
