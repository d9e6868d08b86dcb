"""One table of the file, read key by key. Errors name file, line and key, and the nearest known name."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

from busmaster import InvalidCommand
from busmaster.app.bounds import LARGEST_WHOLE
from busmaster.app.config.source import FileError, Key, Source
from busmaster.ext import meant, now_called

T = TypeVar("T")


class Table:
    """Every method that reads a value raises FileError for one of another type, and for one that is missing."""

    def __init__(self, source: Source, key: Key = (), data: dict[str, Any] | None = None) -> None:
        self.source = source
        self.key = key
        self.data = source.data if data is None else data

    @property
    def name(self) -> str:
        return str(self.key[-1])

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def only(self, *known: str, advice: str = "") -> None:
        """Refuse other keys. Raises FileError for a key that is none of these. `advice` is added to its text."""
        for key in self.data:
            if key not in known:
                self.source.keep(self.error(f"no such key; {self._meant(key, known)}{advice}", key))

    def _meant(self, key: str, known: tuple[str, ...]) -> str:
        new = now_called(key, known)
        if new is None:
            return meant(key, known)
        return f"renamed to {new!r}; `busmaster migrate {self.source.name} --write` changes all old names of the file"

    def error(self, text: str, *way: str | int) -> FileError:
        """Return an error with the place of this table, or of what `way` leads to in it."""
        return self.source.error((*self.key, *way), text)

    @contextmanager
    def part(self) -> Iterator[None]:
        """Read a part of the file inside that stands for itself: with a problem in it, the others can still be read.

        Raises FileError, unless the problems of the source are collected.
        """
        try:
            yield
        except FileError as error:
            self.source.keep(error)
            self.source.unread.add(self.key)

    @contextmanager
    def at(self, *way: str | int) -> Iterator[None]:
        """Add this place to an error inside: an InvalidCommand becomes a FileError."""
        try:
            yield
        except FileError:
            raise
        except InvalidCommand as error:
            raise self.error(str(error), *way) from None

    # values

    def text(self, key: str) -> str:
        """Read a text."""
        return str(self._take(key, str, "a text in quotes"))

    def flag(self, key: str) -> bool:
        """Read true or false."""
        return bool(self._take(key, bool, "true or false"))

    def whole(self, key: str, *, least: int = 0, most: int = LARGEST_WHOLE) -> int:
        """Read a whole number, `least` to `most`."""
        value: int = self._take(key, int, "a whole number")
        if not least <= value <= most:
            raise self.error(f"must be {least} to {most}, not {value}", key)
        return value

    def number(self, key: str) -> float:
        """Read a finite number."""
        value: float = self._take(key, (int, float), "a number")
        if not -math.inf < value < math.inf:  # TOML has inf and nan
            raise self.error(f"must be finite, not {value}", key)
        return value

    def seconds(self, key: str, *, least: float = 0, most: float) -> float:
        """Read a number of seconds, `least` to `most`."""
        value: float = self._take(key, (int, float), "a number of seconds")
        if not least <= value <= most:
            raise self.error(f"must be a number of seconds, {least:g} to {most:g}, not {value}", key)
        return value

    def choice(self, key: str, known: Iterable[str]) -> str:
        """Read a text that is one of `known`."""
        known, value = tuple(known), self.text(key)
        if value not in known:
            raise self.error(f"no such {key} {value!r}; {meant(value, known)}", key)
        return value

    def texts(self, key: str) -> tuple[str, ...]:
        """Read one text or several."""
        given = self.data.get(key)
        values = [given] if isinstance(given, str) else self._take(key, list, "a list of texts")
        for number, value in enumerate(values):
            if not isinstance(value, str):
                raise self.error(f"must be a text in quotes, not {value!r}", key, number)
        return tuple(values)

    def wholes(self, key: str, *, most: int) -> tuple[int, ...]:
        """Read a list of whole numbers, 0 to `most`."""
        values = self._take(key, list, "a list of whole numbers")
        for number, value in enumerate(values):
            if type(value) is not int or not 0 <= value <= most:
                raise self.error(f"must be a whole number, 0 to {most}, not {shown(value)}", key, number)
        return tuple(values)

    def numbers(self, key: str) -> tuple[float, ...]:
        """Read one finite number, or true or false, or several of them."""
        given = self.data[key]
        values = given if isinstance(given, list) else [given]
        for number, value in enumerate(values):
            if not isinstance(value, int | float) or not math.isfinite(value):
                way = (key, number) if isinstance(given, list) else (key,)
                raise self.error(f"must be a number, true or false, or a list of them, not {shown(value)}", *way)
        return tuple(values)

    # tables

    def table(self, key: str) -> Table:
        """Return the table under this key, an empty one where there is none."""
        path = ".".join(map(str, (*self.key, key)))
        data = self._take(key, dict, f"a table: [{path}]") if key in self.data else {}
        return Table(self.source, (*self.key, key), data)

    def tables(self, key: str) -> Iterator[Table]:
        """Return each of the tables in it: `[nodes.winder]`, `[nodes.press]`."""
        return self.table(key).each()

    def each(self) -> Iterator[Table]:
        """Return each of the tables in this one."""
        for key in self.data:
            with self.part():
                yield self.table(key)

    def read(self, key: str, read: Callable[[Table], T]) -> T:
        """Return what `read` makes of the table under this key.

        Where problems are collected, and there is one, it is read as if the file had left the table out.
        """
        found: list[T] = []
        with self.part():
            table = self.table(key)
            with table.part():
                found.append(read(table))
        return found[0] if found else read(Table(self.source, (*self.key, key), {}))

    def _take(self, key: str, kind: type | tuple[type, ...], meant: str) -> Any:
        if key not in self.data:
            raise self.error(f"{key!r} is missing: {meant}")
        value = self.data[key]
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):  # True is an int to Python
            raise self.error(f"must be {meant}, not {shown(value)}", key)
        return value


def shown(value: object) -> str:
    """Return a value as a message shows it."""
    return {dict: "a table", list: "a list", bool: str(value).lower()}.get(type(value), repr(value))
