"""A TOML file with the line of each value, for error messages.

The standard library's reader does not keep places. `places` scans the text a second time. This is simple for a text
that the reader has accepted: only strings, comments and brackets must be distinguished.
"""

from __future__ import annotations

import os
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias

from busmaster import InvalidCommand
from busmaster.app.bounds import LONGEST_TEXT, LONGEST_WORD, MOST_NESTED
from busmaster.ext import read_file

Key: TypeAlias = tuple[str | int, ...]
"""The way to a value: names of tables and keys, numbers of array elements."""

TOKEN = re.compile(
    r"""
      (?P<comment>\#[^\n]*)
    | (?P<string>\"\"\"(?:\\.|[^\\])*?\"\"\"+ | '''.*?'''+ | "(?:\\.|[^"\\\n])*" | '[^'\n]*')
    | (?P<newline>\n)
    | (?P<mark>[\[\]{}=,.])
    | (?P<bare>[^\s\[\]{}=,.\#"']+)
    """,
    re.VERBOSE | re.DOTALL,
)
AT = re.compile(r" \(at (?:line (\d+), column \d+|end of document)\)$")


class FileError(InvalidCommand):
    """Something is wrong in a file. The text begins with the place.

    `file` is the path, `line` counts from 1, `key` is the way to the value ("nodes.winder.address"), and `what` is the
    problem alone. `line` is 0, and `key` "", where the problem is one of the file as a whole. `way` is `key` as a
    tuple.
    """

    def __init__(self, file: str, line: int, key: str, what: str, way: Key = ()) -> None:
        place = f"{file}:{line}" if line else file
        super().__init__(f"{place}: {key}: {what}" if key else f"{place}: {what}")
        self.file = file
        self.line = line
        self.key = key
        self.what = what
        self.way = way


class Source:
    """The values of one file, and where each of them stands."""

    def __init__(self, name: str, text: str) -> None:
        """Read a TOML text. Raises FileError with the line if it is not TOML."""
        self.name = name
        self.text = text
        check_bounds(name, text)
        try:
            self.data: dict[str, Any] = tomllib.loads(text)
        except tomllib.TOMLDecodeError as error:
            found = AT.search(str(error))
            # "at end of document" has no number. TOML has no line ends but these; `splitlines` has more.
            line = (found and found[1]) or text.removesuffix("\n").count("\n") + 1
            what = AT.sub("", str(error))
            raise FileError(name, int(line), "", f"not valid TOML: {what[:1].lower()}{what[1:]}") from None
        self.problems: dict[tuple[str, str], FileError] | None = None
        """Where this is a dict, problems are collected in it, one for each key of a file; see `keep`."""
        self.unread: set[Key] = set()
        """The parts that could not be read to their end, where problems are collected."""
        self._places = places(text.replace("\r\n", "\n"))  # as tomllib itself reads it

    @classmethod
    def read(cls, path: str | os.PathLike[str]) -> Source:
        """Read a file. Raises OSError if it cannot be read, and FileError if it is not TOML."""
        name = os.fspath(path)
        try:
            return cls(name, read_file(path).decode())
        except UnicodeDecodeError as error:
            line = error.object[: error.start].count(b"\n") + 1
            raise FileError(name, line, "", "not valid TOML: the file is not UTF-8") from None

    def beside(self, name: str) -> Path:
        """Return the path of a file that this one names: from its own folder, where it is not absolute."""
        return Path(self.name).parent / name

    def line(self, key: Key) -> int:
        """Return the line of `key`, or of the table that it would belong to."""
        while key and key not in self._places:
            key = key[:-1]
        return self._places.get(key, 1)

    def error(self, key: Key, text: str) -> FileError:
        """Return an error for `key` with its place: "line.toml:12: nodes.winder.address: ..."."""
        shown = "".join(f"[{part + 1}]" if isinstance(part, int) else f".{part}" for part in key).lstrip(".")
        return FileError(self.name, self.line(key) if key else 0, shown, text, key)

    def keep(self, error: FileError) -> None:
        """Collect a problem, and return; raise it where problems are not collected.

        `load` and `open_line` stop at the first problem. `busmaster check` reads on, and reports all of them.
        """
        if self.problems is None:
            raise error
        self.problems.setdefault((error.file, error.key or error.what), error)


def check_bounds(name: str, text: str) -> None:
    """Raise FileError, with the line, for texts and numbers that are too long, and for brackets or names that are
    nested too deeply.

    This check comes before the standard library's reader. That reader recurses for each bracket, copies a dotted key
    once for each of its names, and rejects a long number with an error without a line.
    """
    line, brackets, names = 1, 0, 1
    for match in TOKEN.finditer(text):
        kind, token = match.lastgroup, match[0]
        if kind == "string" and len(token) > LONGEST_TEXT:
            raise FileError(name, line, "", f"a text must have at most {LONGEST_TEXT} characters, not {len(token)}")
        if kind == "bare" and len(token) > LONGEST_WORD:
            what = f"a number or a key must have at most {LONGEST_WORD} characters, not {len(token)}"
            raise FileError(name, line, "", what)
        if kind == "mark":
            brackets += {"[": 1, "{": 1, "]": -1, "}": -1}.get(token, 0)
        if kind in ("mark", "newline"):
            names = names + 1 if token == "." else 1
        if max(brackets, names) > MOST_NESTED:
            raise FileError(name, line, "", f"nested more than {MOST_NESTED} levels deep, which no key needs")
        line += token.count("\n")


def places(text: str) -> dict[Key, int]:
    """Return the line, from 1, on which each table, key and array element of a valid TOML text begins."""
    return Walk(text).places


@dataclass(frozen=True, slots=True)
class Pair:
    """Where `key = value` stands in a text, and where its value begins. `section` is the table that it stands in."""

    section: Key
    start: int
    value: int
    end: int


class Walk:
    """What one walk through a valid TOML text finds."""

    def __init__(self, text: str) -> None:
        self.places: dict[Key, int] = {}
        """The line of each table, key and array element, from 1."""
        self.pairs: dict[Key, Pair] = {}
        """Where each key with a value stands; those of inline tables too."""
        self.bodies: dict[Key, int] = {(): 0}
        """Where each table that has a header ends: behind the last pair below that, else behind the header."""
        self._tokens: list[tuple[str, str, int, int]] = []
        self._next = 0
        self._end = 0
        line = 1
        for match in TOKEN.finditer(text):
            kind, token = str(match.lastgroup), match[0]
            if kind != "comment":
                self._tokens.append((kind, token, line, match.start()))
            line += token.count("\n")
        self._tokens.append(("mark", "", line, len(text)))
        self._arrays: dict[Key, int] = {}
        self._file()

    def _file(self) -> None:
        table: Key = ()
        while self._skip() != "":
            if self._peek() == "[":
                table = self._header()
            else:
                self._pair(table)
            self.bodies[table] = self._end

    def _header(self) -> Key:
        """Take `[table]`, or one more `[[element]]`, and return its key."""
        line = self._line()
        brackets = 0
        while self._peek() == "[":
            self._take()
            brackets += 1
        key = self._inside(self._names("]"))
        for _ in range(brackets):
            self._take()
        if brackets == 2:
            self._arrays[key] = number = self._arrays.get(key, -1) + 1
            self.places.setdefault(key, line)
            key = (*key, number)
        for depth in range(len(key)):
            self.places.setdefault(key[: depth + 1], line)
        return key

    def _inside(self, names: Key) -> Key:
        """Return the key of a header's names. A name on the way that is an array of tables means its last element."""
        key: Key = ()
        for name in names[:-1]:
            key = (*key, name)
            if key in self._arrays:
                key = (*key, self._arrays[key])
        return key + names[-1:]

    def _pair(self, table: Key) -> None:
        line, start = self._line(), self._start()
        names = self._names("=")
        self._take()
        for depth in range(len(names)):
            self.places.setdefault((*table, *names[: depth + 1]), line)
        value = self._start()
        self._value((*table, *names))
        self.pairs[(*table, *names)] = Pair(table, start, value, self._end)

    def _value(self, key: Key) -> None:
        opening = self._peek()
        if opening == "[":
            self._members("]", lambda number: self._element((*key, number)))
        elif opening == "{":
            self._members("}", lambda _: self._pair(key))
        else:
            while self._peek() not in ("\n", ",", "]", "}", ""):
                self._take()

    def _members(self, closing: str, member: Callable[[int], None]) -> None:
        self._take()
        number = 0
        while self._skip() != closing:
            if self._peek() == ",":
                self._take()
                continue
            member(number)
            number += 1
        self._take()

    def _element(self, key: Key) -> None:
        self.places[key] = self._line()
        self._value(key)

    def _names(self, end: str) -> Key:
        names: list[str] = []
        while self._peek() != end:
            kind, token = self._take()
            if kind == "string":
                names.append(tomllib.loads(f"name = {token}")["name"])
            elif kind == "bare":
                names.append(token)
        return tuple(names)

    def _skip(self) -> str:
        """Go to the next token that is not a new line, and return it."""
        while self._peek() == "\n":
            self._take()
        return self._peek()

    def _peek(self) -> str:
        return self._tokens[self._next][1]

    def _line(self) -> int:
        return self._tokens[self._next][2]

    def _start(self) -> int:
        return self._tokens[self._next][3]

    def _take(self) -> tuple[str, str]:
        kind, token, _, start = self._tokens[self._next]
        self._end = start + len(token)
        self._next += 1
        return kind, token
