"""The key of a state: the whole world, with its times taken out into a zone.

A world is made of parts that are there from its beginning to its end, and of what lies in them. The key is what lies
in each attribute of each part, unless that is what lay there at the beginning; whatever is no part (a request, a reply,
a queue) is pickled as a whole. So nothing can be forgotten, and a world is put back by filling its parts again.
"""

from __future__ import annotations

import enum
import io
import pickle
import struct
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from itertools import compress
from operator import is_not
from types import BuiltinFunctionType, FunctionType, MethodType, NoneType
from typing import Any, ClassVar, Final, cast

from busmaster.arbiter.backlog import Backlog, EarliestDeadlineFirst, Fifo
from busmaster.arbiter.clients import OWN, LineClient
from busmaster.arbiter.counters import LineState
from busmaster.arbiter.health import Health
from busmaster.arbiter.schedule import Schedule
from busmaster.arbiter.shared_backlog import SharedBacklog, Turns
from busmaster.arbiter.shared_backlog import _Turn as Turn
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.contract.profile import Profile
from busmaster.contract.timing import ReplyTiming, Timings
from tests.verification.proof.instants import Instant, instant, ticks
from tests.verification.proof.shipped import ANY_STEP, BUDGET, NO_COUNTERS, UNCOUNTED
from tests.verification.proof.wire import Overdue, Ticket
from tests.verification.proof.world import World
from tests.verification.proof.zones import FREE, Zone, widened

LONGEST = 1.5
"""Seconds beyond which it is not told apart how long ago something was, or is to be; or twice R15's wait."""
NEVER_CHANGE: Final = (
    *(NoneType, bool, int, float, str, bytes, enum.Enum, type, FunctionType, BuiltinFunctionType),
    *(Profile, ReplyTiming, Timings),
    Schedule,  # polls are not explored
    *(type(stand_in) for stand_in in (ANY_STEP, BUDGET, NO_COUNTERS, UNCOUNTED)),
)
"""What has no inside that a world could change."""
COME_AND_GO: Final = (Transaction, Overdue, Ticket, Backlog, SharedBacklog, Fifo, EarliestDeadlineFirst, Turns, Turn)
"""What is no part: also a backlog and its queues are made anew, as a line is shared or all that waits fails, and nobody
asks any more what lies in those before."""
_ALTERS: Final = object()
"""What lies there is never left out."""
_MADE_ANEW: Final = (list, deque, dict, set, bytearray)
"""What lies there is usually an empty one of these."""


class Parts:
    """The parts of one world, which is saved and put back again and again."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.parts: list[Any] = []
        self.place_of: dict[int, int] = {}
        """By the part's id."""
        self._find(world)
        self._cells = [(part, name) for part in self.parts for name in _names(part)]
        self._places = range(len(self._cells))
        self._open_ended = [vars(part) for part in self.parts if hasattr(part, "__dict__")]
        self._attributes = sum(map(len, self._open_ended))
        self._values = _reader(self._cells)
        values = self._values()
        times = Counter(map(id, values))
        several = [value for value in values if isinstance(value, list | deque) and times[id(value)] > 1]
        self._shared = {id(value): (value, list(value) if isinstance(value, list) else []) for value in several}
        """What lies in several parts, and what is in it whenever the world is saved: a queue is empty then."""
        self._usual = [self._usual_of(value) for value in values]
        self._empty = _filler(self._cells, values, self._usual)

    def _find(self, value: Any) -> None:
        if isinstance(value, list | tuple):
            for one in value:
                self._find(one)
        elif _is_part(value) and id(value) not in self.place_of:
            self.place_of[id(value)] = len(self.parts)
            self.parts.append(value)
            _TABLE.setdefault(type(value), _reduce_part)
            for name in _names(value):
                self._find(getattr(value, name))

    def _usual_of(self, value: Any) -> Any:
        """Return what is left out of a key where it lies: what is there at the beginning, if no world can change it."""
        if type(value) in _MADE_ANEW and not value and id(value) not in self._shared:
            return type(value)()
        fixed = isinstance(value, NEVER_CHANGE) or id(value) in self.place_of or id(value) in self._shared
        fixed = fixed or (isinstance(value, MethodType) and id(value.__self__) in self.place_of)
        fixed = fixed or (type(value) is tuple and all(self._usual_of(one) is one for one in value))
        return value if fixed else _ALTERS

    def save(self, zone: Zone, exact: bool = False) -> tuple[bytes, Zone]:
        """Return the key of the world, which is simple already, and the zone of the instants that are in it. Instant 0
        is now.

        Unless it is to be `exact`, the zone is widened where it is LONGEST.
        """
        assert sum(map(len, self._open_ended)) == self._attributes, "a part has got one attribute more"
        assert all(map(_is_as_it_was, self._shared.values())), "what several parts hold has changed"
        _PLACES.begin(zone, self.world.now)
        held: list[Any] = []
        values, every_usual = self._values(), self._usual
        for place in compress(self._places, map(is_not, values, every_usual)):
            value, usual = values[place], every_usual[place]
            if type(value) is Instant:
                held += (~place, *_PLACES.place(value))
            elif type(value) is not type(usual) or value != usual:
                held += (place, value)
        _open[0] = self
        into = io.BytesIO()
        pickler = pickle.Pickler(into, 5)
        pickler.dispatch_table = _TABLE
        pickler.dump(held)
        kept = _PLACES.kept
        small = [[FREE if zone[i][j] >= FREE else zone[i][j] + 2 * (a - b) for j, b in kept] for i, a in kept]
        lapse = 2 * self.world.setup.lapse
        return into.getvalue(), small if exact else widened(small, ticks(max(LONGEST, lapse)))

    def restore(self, key: bytes) -> World:
        """Return the world as it was again. Its instants are those of the run that was begun."""
        _open[0] = self
        held = iter(pickle.loads(key))
        self._empty()
        for several, content in self._shared.values():
            several.clear()
            several.extend(content)
        for place in held:
            part, name = self._cells[place if place >= 0 else ~place]
            setattr(part, name, next(held) if place >= 0 else instant(next(held), next(held)))
        return self.world


def _is_as_it_was(shared: tuple[Any, list[Any]]) -> bool:
    return list(shared[0]) == shared[1]


def _is_part(value: Any) -> bool:
    ours = type(value).__module__.split(".")[0] in ("busmaster", "tests")
    return ours and not isinstance(value, (*NEVER_CHANGE, *COME_AND_GO, Instant)) and value is not OWN


def _names(part: Any) -> Iterable[str]:
    slots = [name for kind in type(part).__mro__ for name in kind.__dict__.get("__slots__", ())]
    return [*slots, *getattr(part, "__dict__", ())]


def _reader(cells: Sequence[tuple[Any, str]]) -> Callable[[], tuple[Any, ...]]:
    """Return what reads all these attributes. It is compiled, as `_filler` is: each event needs both."""
    source = ", ".join(f"part{place}.{name}" for place, (_, name) in enumerate(cells))
    names = {f"part{place}": part for place, (part, _) in enumerate(cells)}
    return _compiled(f"def compiled(): return {source}", names)


def _filler(cells: Sequence[tuple[Any, str]], values: Sequence[Any], usual: Sequence[Any]) -> Callable[[], None]:
    """Return what puts into each attribute what lies there usually, if anything does: what is there now, or an empty
    one of its kind, made anew."""
    source = ["def compiled():"]
    names: dict[str, Any] = {}
    for place, ((part, name), value, usually) in enumerate(zip(cells, values, usual, strict=True)):
        if usually is not _ALTERS:
            names |= {f"part{place}": part, f"value{place}": usually}
            source.append(f"    part{place}.{name} = value{place}{'' if usually is value else '.copy()'}")
    return _compiled("\n".join(source), names)


def _compiled(source: str, names: dict[str, Any]) -> Callable[..., Any]:
    exec(source, names)
    return cast("Callable[..., Any]", names["compiled"])


class _Places:
    """Where each instant that is kept stands in the zone: a base each, and offsets from it."""

    def __init__(self) -> None:
        self._zone: Zone = []
        self._of: dict[int, tuple[int, int]] = {}
        """Of each of the zone's instants that was met: its place among those kept, and the offset of that."""
        self.kept: list[tuple[int, int]] = []

    def begin(self, zone: Zone, now: Instant) -> None:
        self._zone = zone
        self._of.clear()
        self.kept.clear()
        self.place(now)

    def place(self, time: Instant) -> tuple[int, int]:
        known = self._of.get(time.base)
        if known is None:
            known = self._of[time.base] = self._found(time.base, time.offset)
        return known[0], time.offset - known[1]

    def _found(self, base: int, offset: int) -> tuple[int, int]:
        """An instant at a fixed distance from one that is kept is told by that one."""
        row = self._zone[base]
        for place, (other, at) in enumerate(self.kept):
            bound = row[other]
            if bound & 1 and bound < FREE and self._zone[other][base] == 2 - bound:
                return place, at - (bound >> 1)
        self.kept.append((base, offset))
        return len(self.kept) - 1, offset


_PLACES = _Places()


def _reduce_instant(time: Instant) -> tuple[Any, ...]:
    return instant, _PLACES.place(time)


_shared: list[Any] = []
_share_of: dict[Any, int] = {}


def _recall(place: int) -> Any:
    return _shared[place]


def _reduce_shared(value: Any) -> tuple[Any, ...]:
    place = _share_of.get(id(value))
    if place is None:
        place = next((at for at, other in enumerate(_shared) if type(other) is type(value) and other == value), None)
        if place is None:
            place = len(_shared)
            _shared.append(value)
        if _shared[place] is value:
            _share_of[id(value)] = place
    return _recall, (place,)


def _reduce_struct(value: struct.Struct) -> tuple[Any, ...]:
    return struct.Struct, (value.format,)


def _reduce_member(member: Any) -> str:
    return str(member.name)


_open: list[Any] = [None]
"""The Parts of the world that is saved or put back."""


def _part(place: int) -> Any:
    return _open[0].parts[place]


def _reduce_part(value: Any) -> Any:
    """Others of its kind may come and go: these are no parts."""
    place = _open[0].place_of.get(id(value))
    if place is not None:
        return _part, (place,)
    return "OWN" if value is OWN else object.__reduce_ex__(value, 5)


class _Slotted:
    """A kind of which many come and go: pickled by what lies in its slots, without their names."""

    every: ClassVar[list[_Slotted]] = []

    def __init__(self, kind: type) -> None:
        self.kind = kind
        names = list(_names(object.__new__(kind)))
        several = ", ".join(f"one.{name}" for name in names)
        self.read = _compiled(f"def compiled(one): return {several},", {})
        self.fill = _compiled(f"def compiled(one, values): {several}, = values", {})
        self.place = len(self.every)
        self.every.append(self)

    def reduce(self, one: Any) -> Any:
        try:
            return _refilled, (self.place, self.read(one))
        except AttributeError:  # not all of them are filled
            return object.__reduce_ex__(one, 5)


def _refilled(place: int, values: tuple[Any, ...]) -> Any:
    slotted = _Slotted.every[place]
    one: Any = object.__new__(slotted.kind)
    slotted.fill(one, values)
    return one


_TABLE: dict[type, Callable[[Any], Any]] = {
    LineClient: _reduce_part,
    Instant: _reduce_instant,
    Profile: _reduce_shared,
    ReplyTiming: _reduce_shared,
    Timings: _reduce_shared,
    struct.Struct: _reduce_struct,
    LineState: _reduce_member,
    Priority: _reduce_member,
    Phase: _reduce_member,
    Health: _reduce_member,
    **{kind: _Slotted(kind).reduce for kind in COME_AND_GO},
}


def share(commands: Any) -> None:
    """Commands are values that never change: they are pickled by their place."""
    for command in commands:
        _TABLE[type(command)] = _reduce_shared
