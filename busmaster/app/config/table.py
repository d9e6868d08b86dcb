"""One table of the file, read key by key: what is wrong with a value is said with its place and its nearest name."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Container, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, Final, Literal, TypeAlias, TypeVar, get_args, get_origin, get_type_hints

from busmaster.app.config.source import FileError, Key, Source
from busmaster.bounds import LARGEST_WHOLE
from busmaster.errors import InvalidCommand
from busmaster.ext import meant, now_called

T = TypeVar("T")
Readers: TypeAlias = Mapping[str, "Callable[[Table, str], Any]"]
"""How keys are read, by name, whose values are more than their type."""


class _Required:
    """Stands for a default where there is none."""


REQUIRED: Final = _Required()


class Table:
    """Every reading raises FileError for a value of another kind, and for one that is missing without a default."""

    def __init__(self, source: Source, key: Key = (), data: dict[str, Any] | None = None) -> None:
        self.source = source
        self.key = key
        self.data = source.data if data is None else data

    @property
    def name(self) -> str:
        return str(self.key[-1])

    def __contains__(self, key: str) -> bool:
        return key in self.data

    def only(self, *known: str) -> None:
        """Refuse other keys. Raises FileError for a key that is none of these."""
        for key in self.data:
            if key not in known:
                self.source.keep(self.key, self.error(f"no such key; {self._meant(key, known)}", key))

    def _meant(self, key: str, known: tuple[str, ...]) -> str:
        new = now_called(key, known)
        if new is None:
            return meant(key, known)
        return f"it is now {new!r}: `busmaster migrate {self.source.name} --write` changes all old names of the file"

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
            self.source.keep(self.key, error)
            self.source.unread.add(self.key)

    @contextmanager
    def at(self, *way: str | int) -> Iterator[None]:
        """Give this place to what is wrong inside: an InvalidCommand becomes a FileError."""
        try:
            yield
        except FileError:
            raise
        except InvalidCommand as error:
            raise self.error(str(error), *way) from None

    # values

    def text(self, key: str, default: T | _Required = REQUIRED) -> str | T:
        """Read a text."""
        value: str | T = self._take(key, str, default, "a text in quotes")
        return value

    def flag(self, key: str, default: bool) -> bool:
        """Read true or false."""
        value: bool = self._take(key, bool, default, "true or false")
        return value

    def whole(
        self, key: str, default: T | _Required = REQUIRED, *, least: int = 0, most: int = LARGEST_WHOLE
    ) -> int | T:
        """Read a whole number, `least` to `most`."""
        value: int | T = self._take(key, int, default, "a whole number")
        if key in self.data and isinstance(value, int) and not least <= value <= most:
            raise self.error(f"must be {least} to {most}, not {value}", key)
        return value

    def number(self, key: str, default: T | _Required = REQUIRED) -> float | T:
        """Read a finite number."""
        value: float | T = self._take(key, (int, float), default, "a number")
        if isinstance(value, float) and not math.isfinite(value):  # TOML has inf and nan
            raise self.error(f"must be finite, not {value}", key)
        return value

    def seconds(self, key: str, default: T | _Required = REQUIRED, *, most: float) -> float | T:
        """Read a number of seconds, 0 to `most`."""
        value: float | T = self._take(key, (int, float), default, "a number of seconds")
        if isinstance(value, int | float) and not 0 <= value <= most:
            raise self.error(f"must be a number of seconds, 0 to {most:g}, not {value}", key)
        return value

    def positive(self, key: str) -> float:
        """Read a number above 0."""
        value = self.number(key)
        if value <= 0:
            raise self.error(f"must be above 0, not {value}", key)
        return value

    def share(self, key: str) -> float:
        """Read a number from 0 to 1."""
        value = self.number(key)
        if not 0 <= value <= 1:
            raise self.error(f"must be 0 to 1, not {value}", key)
        return value

    def choice(self, key: str, known: Iterable[str], default: T | _Required = REQUIRED) -> str | T:
        """Read a text that is one of `known`."""
        known = tuple(known)
        value = self.text(key, default)
        if key in self.data and value not in known:
            raise self.error(f"no such {key} {value!r}; {meant(str(value), known)}", key)
        return value

    def texts(self, key: str, default: T | _Required = REQUIRED) -> tuple[str, ...] | T:
        """Read one text or several."""
        if key in self.data and isinstance(self.data[key], str):
            return (self.data[key],)
        values: list[Any] | T = self._take(key, list, default, "a list of texts")
        if not isinstance(values, list):
            return values
        for number, value in enumerate(values):
            if not isinstance(value, str):
                raise self.error(f"must be a text in quotes, not {value!r}", key, number)
        return tuple(values)

    def wholes(self, key: str, *, most: int = LARGEST_WHOLE) -> tuple[int, ...]:
        """Read a list of whole numbers, 0 to `most`."""
        values = self._take(key, list, REQUIRED, "a list of whole numbers")
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

    def typed(
        self,
        kind: type,
        *others: str,
        readers: Readers | None = None,
        without: Container[str] = (),
        optional: Container[str] = (),
    ) -> dict[str, Any]:
        """Return what the table says of a dataclass's fields, each read as its type wants it, or by its reader.

        The fields `without` cannot be said; those that are `optional` may be missing though they have no default.
        Raises FileError for a key that is neither a field nor one of `others`, and for a field that is missing.
        """
        hints = get_type_hints(kind, include_extras=True)
        parts = [part for part in dataclasses.fields(kind) if part.name not in without]
        self.only(*others, *(part.name for part in parts))
        said: dict[str, Any] = {}
        for part in parts:
            if part.name not in self and (part.default is not dataclasses.MISSING or part.name in optional):
                continue
            own = (readers or {}).get(part.name)
            said[part.name] = own(self, part.name) if own else self._typed(part.name, hints[part.name])
        return said

    def _typed(self, key: str, hint: Any) -> Any:
        if get_origin(hint) is Annotated:
            bare, bounds = get_args(hint)
            if bare is int:
                return self.whole(key, least=int(bounds.least), most=bounds.most)
            value = self._typed(key, bare)
            if not bounds.least <= value <= bounds.most:
                most = " or more" if bounds.most == math.inf else f" to {bounds.most}"
                raise self.error(f"must be {bounds.least}{most}, not {value}", key)
            return value
        if get_origin(hint) is Literal:
            return self.choice(key, get_args(hint))
        kinds = get_args(hint) or (hint,)  # of a union the one that a file can say
        for kind, read in ((bool, lambda name: self.flag(name, False)), (int, self.whole), (float, self.number)):
            if kind in kinds:
                return read(key)
        return self.texts(key) if get_origin(hint) is tuple else self.text(key)

    # tables

    def table(self, key: str) -> Table:
        """Return the table under this key, an empty one where there is none."""
        return Table(self.source, (*self.key, key), self._take(key, dict, {}, f"a table: [{self._path(key)}]"))

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

    def _path(self, key: str) -> str:
        return ".".join(str(part) for part in (*self.key, key))

    def _take(self, key: str, kind: type | tuple[type, ...], default: Any, meant: str) -> Any:
        if key not in self.data:
            if default is REQUIRED:
                raise self.error(f"{key!r} is missing: {meant}")
            return default
        value = self.data[key]
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):  # True is an int to Python
            raise self.error(f"must be {meant}, not {shown(value)}", key)
        return value


def shown(value: object) -> str:
    """Return a value as a message shows it."""
    return {dict: "a table", list: "a list", bool: str(value).lower()}.get(type(value), repr(value))
