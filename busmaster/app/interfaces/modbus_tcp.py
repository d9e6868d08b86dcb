"""A line as a Modbus TCP server: its points as registers, and its Modbus RTU units behind the same port.

The server is our own, because that of pymodbus keeps the last request of a connection in one attribute. If one segment
has two requests, the first is lost. It also has no limit on connections or idle time.
"""

from __future__ import annotations

import asyncio
import csv
import io
import ipaddress
import math
import struct
import time
import tomllib
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from decimal import Decimal
from fnmatch import fnmatchcase
from math import inf
from typing import Any, TypeAlias
from weakref import WeakValueDictionary

from busmaster import (
    BacklogFull,
    BusError,
    InvalidCommand,
    LineDown,
    NotStarted,
    Priority,
    Quality,
    Refused,
    Snapshot,
    Superseded,
)
from busmaster.app.bounds import (
    GATEWAY_SEND_WITHIN,
    MOST_GATEWAY_CONNECTIONS,
    MOST_GATEWAY_ON_LINE,
    MOST_GATEWAY_PER_PEER,
    MOST_GATEWAY_UNREAD,
    REQUEST_WITHIN,
)
from busmaster.app.interfaces.followed_groups import FollowedGroups
from busmaster.app.interfaces.following import Following
from busmaster.app.interfaces.reported_refusals import ReportedRefusals
from busmaster.app.service.picture import Row
from busmaster.app.service.record import cut
from busmaster.app.service.refusals import LimitedReport, peer_of
from busmaster.app.service.remote import RemoteBus
from busmaster.app.service.tcp import address_text, listening
from busmaster.app.service.touches import Touches
from busmaster.ext import meant, protocols, read_file

OWN_UNITS = (0, 255)
"""Unit ids of the server itself, by the Modbus TCP guide: with --pass-through only these have the points."""
IDLE = 120.0
"""Seconds without a request, by default: then the connection is closed."""
FINISH_WITHIN = 3.0
"""Seconds in which a unit of the line must have replied. Many Modbus TCP clients wait no longer."""
LOOK_EVERY = 0.25
"""Seconds between two looks for other points of the line."""

# The frames of Modbus TCP

READS = {1: "coil", 2: "discrete", 3: "holding", 4: "input"}
WRITES = {5: "coil", 6: "holding", 15: "coil", 16: "holding"}
TABLES = ("holding", "input", "coil", "discrete")
BIT_TABLES = ("coil", "discrete")
MOST_BITS_READ, MOST_BITS_WRITTEN, MOST_READ, MOST_WRITTEN = 2000, 1968, 125, 123
ADDRESSES = 65536
HEADER = struct.Struct(">HHHB")
LONGEST_PDU = 253
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, DEVICE_FAILURE, DEVICE_BUSY = 1, 2, 3, 4, 6
NO_PATH, NO_REPLY = 10, 11
UNIT_REFUSED = {
    "illegal function": 1,
    "illegal data address": 2,
    "illegal data value": 3,
    "device failure": 4,
    "acknowledged, but it takes long": 5,
    "device busy": 6,
    "memory parity error": 8,
    "gateway path unavailable": 10,
    "gateway target did not respond": 11,
}
"""The exception code of a unit, by the error of the line's owner. Other codes are in its text as numbers."""


class BadFrame(Exception):
    """What a client sent is not Modbus TCP, or too slow: where the next request begins is not known."""


class ExceptionReply(Exception):
    """A request is replied to by an exception code; the text is for the log."""

    def __init__(self, code: int, why: str) -> None:
        super().__init__(why)
        self.code = code


@dataclass(frozen=True, slots=True)
class ReadRequest:
    """Functions 1 to 4."""

    table: str
    first: int
    count: int


@dataclass(frozen=True, slots=True)
class WriteRequest:
    """Functions 5, 6, 15 and 16. `values` are registers, or bits as 0 and 1."""

    table: str
    first: int
    values: tuple[int, ...]


def length_of(header: bytes) -> int:
    """Return how many bytes follow the header of a request. Raises BadFrame."""
    _, protocol, length, _ = HEADER.unpack(header)
    if protocol != 0 or not 2 <= length <= LONGEST_PDU + 1:
        raise BadFrame("not Modbus TCP")
    return int(length) - 1


def request_of(pdu: bytes) -> ReadRequest | WriteRequest:
    """Return the request that a frame carries. Raises ExceptionReply."""
    function = pdu[0]
    if function not in READS and function not in WRITES:
        raise ExceptionReply(ILLEGAL_FUNCTION, f"function {function} is not served")
    if len(pdu) < 5 or (function < 15 and len(pdu) != 5):
        raise ExceptionReply(ILLEGAL_VALUE, "the request has a wrong length")
    first, count = struct.unpack(">HH", pdu[1:5])
    if function in READS:
        _check_span(first, count, MOST_BITS_READ if function < 3 else MOST_READ)
        return ReadRequest(READS[function], first, count)
    if function == 6:
        return WriteRequest("holding", first, (count,))
    if function == 5:
        if count not in (0x0000, 0xFF00):
            raise ExceptionReply(ILLEGAL_VALUE, "a coil is written FF00 or 0000")
        return WriteRequest("coil", first, (int(count != 0),))
    _check_span(first, count, MOST_BITS_WRITTEN if function == 15 else MOST_WRITTEN)
    data, size = pdu[6:], (count + 7) // 8 if function == 15 else 2 * count
    if len(pdu) < 6 or pdu[5] != size or len(data) != size:
        raise ExceptionReply(ILLEGAL_VALUE, "the request has a wrong length")
    if function == 15:
        states = int.from_bytes(data, "little")
        return WriteRequest("coil", first, tuple(states >> place & 1 for place in range(count)))
    return WriteRequest("holding", first, struct.unpack(f">{count}H", data))


def _check_span(first: int, count: int, most: int) -> None:
    if not 1 <= count <= most:
        raise ExceptionReply(ILLEGAL_VALUE, f"one request has 1 to {most} values, not {count}")
    if first + count > ADDRESSES:
        raise ExceptionReply(ILLEGAL_ADDRESS, "the request goes beyond address 65535")


def read_reply(function: int, values: Sequence[int]) -> bytes:
    """Return the reply to a read: of registers, or of bits for functions 1 and 2."""
    if READS[function] in BIT_TABLES:
        size = (len(values) + 7) // 8
        return bytes((function, size)) + sum(on << place for place, on in enumerate(values)).to_bytes(size, "little")
    return struct.pack(f">BB{len(values)}H", function, 2 * len(values), *values)


def exception_reply(function: int, code: int) -> bytes:
    """Return the reply to a request that was not carried out."""
    return bytes((function | 0x80, code))


# The map of points to registers

FORMATS = {
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
ORDERS = ("big", "little")
CURRENT, STALE, BAD, AWAY, NO_VALUE = 0, 1, 2, 3, 4
"""Values of a status register, for the value beside it; a status bit is 0 for CURRENT, else 1."""
COLUMNS = (
    "table",
    "address",
    "registers",
    "type",
    "word_order",
    "byte_order",
    "scale",
    "status",
    "point",
    "unit",
    "write",
)


@dataclass(frozen=True, slots=True)
class Entry:
    """One point at its registers, or at its bit. `status` is the address of its status register, in the same table."""

    point: str
    address: int
    table: str = "holding"
    type: str = "float32"
    word_order: str = "big"
    byte_order: str = "big"
    scale: float = 1.0
    status: int | None = None

    @property
    def size(self) -> int:
        """Return how many addresses it takes."""
        return 1 if self.type == "bit" else struct.calcsize(f">{FORMATS[self.type]}") // 2

    def registers(self, value: Any) -> list[int]:
        """Return the registers, or the bit, of a value. Raises ValueError for one that does not fit."""
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise ValueError(f"{value!r} is not a number")
        if self.type == "bit":
            if value not in (0, 1):
                raise ValueError(f"{value!r} is not 0 or 1")
            return [int(value)]
        number: int | float = int(value) if isinstance(value, int) else value
        if self.scale != 1:
            number = _finite(Decimal(repr(number)) / Decimal(repr(self.scale)))
        try:
            data = struct.pack(f">{FORMATS[self.type]}", number if self.is_float else round(number))
        except (struct.error, OverflowError):
            raise ValueError(f"{value!r} does not fit {self.type}") from None
        if isinstance(number, int) and struct.unpack(f">{FORMATS[self.type]}", data)[0] != number:
            raise ValueError(f"{value!r} is not exact as {self.type}")
        return list(struct.unpack(f">{len(data) // 2}H", self._ordered(data)))

    def value(self, registers: Sequence[int]) -> int | float:
        """Return the value of these registers, or of this bit. Raises ValueError for one that is not a number."""
        if self.type == "bit":
            return registers[0]
        data = self._ordered(struct.pack(f">{len(registers)}H", *registers))
        number: int | float = struct.unpack(f">{FORMATS[self.type]}", data)[0]
        if not math.isfinite(number):
            raise ValueError(f"{number} is not a number that can be written")
        if self.type == "float32":  # 12.3 and not 12.300000190734863, which a limit of 12.3 would refuse
            number = next(
                short for digits in range(6, 10) if struct.pack(">f", short := float(f"{number:.{digits}g}")) == data
            )
        if self.scale != 1:
            number = _finite(Decimal(repr(number)) * Decimal(repr(self.scale)))
        return int(number) if number == int(number) else number

    @property
    def is_float(self) -> bool:
        """Return whether its registers hold a floating-point number."""
        return self.type.startswith("float")

    def _ordered(self, data: bytes) -> bytes:
        """Return the bytes in the order of the entry, and those in its order in the usual one."""
        words = [data[place : place + 2] for place in range(0, len(data), 2)]
        if self.byte_order == "little":
            words = [word[::-1] for word in words]
        return b"".join(words[::-1] if self.word_order == "little" else words)


def _finite(number: Decimal) -> float:
    """Return it as a float. Raises ValueError for one that is beyond all floats."""
    if not math.isfinite(found := float(number)):
        raise ValueError(f"{number:.6g} is not within the range of a float")
    return found


@dataclass(frozen=True, slots=True)
class RegisterMap:
    """All entries. With `last`, a value that is not current is sent with its status register set accordingly."""

    entries: tuple[Entry, ...] = ()
    last: bool = False
    starts: dict[tuple[str, int], tuple[Entry, bool]] = field(default_factory=dict)
    """The entry that begins at an address, and whether it is its status register."""
    covered: dict[tuple[str, int], str] = field(default_factory=dict)
    """The point at each address."""

    @classmethod
    def of(cls, entries: Iterable[Entry], last: bool) -> RegisterMap:
        """Return the map of these entries. Raises InvalidCommand if two use one address, or one has no room."""
        made = cls(tuple(entries), last)
        for entry in made.entries:
            if last and entry.status is None:
                raise InvalidCommand(f'{entry.point}: status is missing: with stale = "last" it is needed')
            made._take(entry, entry.address, entry.size, False)
            if entry.status is not None:
                made._take(entry, entry.status, 1, True)
        return made

    def _take(self, entry: Entry, first: int, size: int, is_status: bool) -> None:
        if not 0 <= first <= ADDRESSES - size:
            raise InvalidCommand(f"{entry.point}: its {size} registers from {first} on are not within 0 to 65535")
        for address in range(first, first + size):
            if (other := self.covered.get((entry.table, address))) is not None:
                raise InvalidCommand(f"{entry.point}: {entry.table} {address} is in use by {other}")
            self.covered[entry.table, address] = entry.point
        self.starts[entry.table, first] = entry, is_status

    def whole(self, table: str, first: int, count: int) -> list[tuple[Entry, bool]]:
        """Return what these addresses hold. Raises ExceptionReply for one without a point, or a part of a value."""
        found = []
        address = first
        while address < first + count:
            if (table, address) not in self.covered:
                raise ExceptionReply(ILLEGAL_ADDRESS, f"{table} {address} is not in the map")
            here = self.starts.get((table, address))
            if here is None:
                raise ExceptionReply(ILLEGAL_VALUE, f"{table} {address} is a part of {self.covered[table, address]}")
            found.append(here)
            address += 1 if here[1] else here[0].size
        if address > first + count:
            raise ExceptionReply(
                ILLEGAL_VALUE, f"{found[-1][0].point} has {found[-1][0].size} registers: use all of them"
            )
        return found


KEYS: dict[str, tuple[type, ...]] = {
    "point": (str,),
    "address": (int,),
    "table": (str,),
    "type": (str,),
    "word_order": (str,),
    "byte_order": (str,),
    "scale": (int, float),
    "status": (int,),
}


def read_map(path: str) -> RegisterMap:
    """Return the map of a file. Raises OSError, and InvalidCommand that names the file and the entry."""
    try:
        table = tomllib.loads(read_file(path).decode())
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidCommand(f"{path}: {error}") from None
    try:
        _check_keys(table, ("stale", "registers"))
        stale = table.get("stale", "exception")
        if stale not in ("exception", "last"):
            raise InvalidCommand(f'stale is "exception" or "last", not {stale!r}')
        entries = table.get("registers")
        if not isinstance(entries, list) or not entries or not all(isinstance(one, dict) for one in entries):
            raise InvalidCommand("there is no [[registers]]: each has one point and its address")
        return RegisterMap.of([_entry(one, number) for number, one in enumerate(entries, 1)], stale == "last")
    except InvalidCommand as error:
        raise InvalidCommand(f"{path}: {error}") from None


def _check_keys(table: Mapping[str, Any], known: Collection[str]) -> None:
    for key in table:
        if key not in known:
            raise InvalidCommand(f"there is no key {key!r}; {meant(key, list(known))}")


def _entry(table: Mapping[str, Any], number: int) -> Entry:
    try:
        _check_keys(table, KEYS)
        for key in ("point", "address"):
            if key not in table:
                raise InvalidCommand(f"{key} is missing")
        for key, value in table.items():
            if isinstance(value, bool) or not isinstance(value, KEYS[key]):
                raise InvalidCommand(f"{key} is not {'a text' if KEYS[key] == (str,) else 'a number'}: {value!r}")
        is_bit = table.get("table") in BIT_TABLES
        entry = Entry(**{"type": "bit" if is_bit else "float32", **table})
        for key, value, known in (
            ("table", entry.table, TABLES),
            ("type", entry.type, ("bit",) if is_bit else tuple(FORMATS)),
            ("word_order", entry.word_order, ORDERS),
            ("byte_order", entry.byte_order, ORDERS),
        ):
            if value not in known:
                raise InvalidCommand(f"{key} is {', '.join(known)}, not {value!r}")
        if not math.isfinite(entry.scale) or entry.scale == 0:
            raise InvalidCommand(f"scale is a number that is not 0, not {entry.scale}")
        if is_bit and entry.scale != 1:
            raise InvalidCommand("a bit has no scale")
    except InvalidCommand as error:
        raise InvalidCommand(f"entry {number}: {error}") from None
    return entry


def automatic_map(points: Iterable[str], type_: str, last: bool) -> RegisterMap:
    """Return a map of all points in their order, in holding registers; with `last`, each before its status register.

    Points beyond address 65535 are left out.
    """
    entries: list[Entry] = []
    address = 0
    for point in points:
        entry = Entry(point, address, type=type_)
        entry = Entry(point, address, type=type_, status=address + entry.size if last else None)
        address += entry.size + last
        if address > ADDRESSES:
            break
        entries.append(entry)
    return RegisterMap.of(entries, last)


def map_as_csv(shown: RegisterMap, rows: Mapping[str, Row], allow: Collection[str]) -> str:
    """Return the map as a table. The last columns are the unit of each point and whether clients can write it."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(COLUMNS)
    for one in shown.entries:
        row = rows.get(one.point)
        write = row is not None and one.table in ("holding", "coil") and row.writable and is_allowed(one.point, allow)
        status = "" if one.status is None else one.status
        where = (one.table, one.address, one.size, one.type, one.word_order, one.byte_order, f"{one.scale:g}", status)
        table.writerow((*where, one.point, "" if row is None else row.unit, "yes" if write else "no"))
    return text.getvalue()


def is_allowed(key: str, patterns: Collection[str]) -> bool:
    """Return whether one of the patterns of --allow names a point."""
    return any(fnmatchcase(key, pattern) for pattern in patterns)


# The points of the line

Identity: TypeAlias = tuple[str, int, str]


@dataclass(slots=True)
class Held:
    """The last good value of a point, when its read began by the line's clock, and what the last cycle brought."""

    group: str
    value: Any = None
    asked: float = -inf
    status: int = NO_VALUE


class Values:
    """The current values of a line's points, from the cycles of its poll groups.

    `fixed` is the map of a file; without it all points are mapped, those that come later behind the others.
    """

    def __init__(
        self,
        line: Following,
        fixed: RegisterMap | None = None,
        *,
        type_: str = "float64",
        last: bool = False,
        warn: Callable[[str], None] = lambda _: None,
    ) -> None:
        self.line = line
        self.map = fixed or RegisterMap()
        self.rows: dict[str, Row] = {}
        """The points by their keys; of a key in two groups, the first."""
        self.known = asyncio.Event()
        """Set once the points of the line are known."""
        self._fixed = fixed
        self._type, self._last, self._warn = type_, last, warn
        self._held: dict[Identity, Held] = {}
        self._touches = Touches()
        self._remote: RemoteBus | None = None
        self._groups = FollowedGroups(line, self._take)
        self._changed = asyncio.Event()
        self._new_rows = True

    async def run(self) -> None:
        """Follow the points until cancelled."""
        ends = (
            self.line.on_picture(self._receive),
            self.line.on_state(self._changed.set),
            self.line.on_touched(self._receive_touched),
        )
        try:
            while True:
                await self._look()
                with suppress(TimeoutError):
                    async with asyncio.timeout(LOOK_EVERY):
                        await self._changed.wait()
                self._changed.clear()
        finally:
            for end in ends:
                end()
            await self._groups.leave()

    def _receive(self, method: str, _params: Mapping[str, Any]) -> None:
        if method in ("rows", "frame"):
            self._new_rows |= method == "rows"
            self._changed.set()

    def _receive_touched(self, params: Mapping[str, Any]) -> None:
        self._touches.note(params)

    async def _look(self) -> None:
        remote = None
        if self.line.is_connected:
            with suppress(LineDown):  # it is being left
                remote = self.line.remote
        if remote is not self._remote:
            self._remote = remote
            await self._groups.leave()
            if remote is not None:  # another owner has another clock; until then the last values stay, as AWAY
                self._touches = Touches()
                self._held.clear()
                self._new_rows = True
        frame = self.line.picture.frame
        if remote is None or frame is None or not self._new_rows:
            return
        rows = self.line.picture.rows
        if len(rows) == frame.points:
            self._new_rows = False
            await self._take_rows(remote, rows)

    async def _take_rows(self, remote: RemoteBus, rows: list[Row]) -> None:
        self.rows = {}
        for row in rows:
            self.rows.setdefault(row.key, row)
        if self._fixed is not None:
            for key in sorted({entry.point for entry in self._fixed.entries} - self.rows.keys()):
                self._warn(f"the map has {key!r}, which is not a point of this line; {meant(key, list(self.rows))}")
        else:
            kept = [entry.point for entry in self.map.entries]
            keys = kept + [key for key in self.rows if key not in set(kept)]
            self.map = automatic_map(keys, self._type, self._last)
            if keys[: len(self.rows)] != list(self.rows):
                self._warn("the points have changed: the addresses stay until this program ends; see --print-map")
            if len(self.map.entries) < len(keys):
                self._warn(f"{len(keys) - len(self.map.entries)} points have no address: 65536 are in use")
        names = {row.group for row in self.rows.values()}
        await self._groups.follow(remote, names)
        self._held = {identity: held for identity, held in self._held.items() if held.group in names}
        self.known.set()

    async def _take(self, name: str, snapshot: Snapshot) -> None:
        for point, sample in snapshot.items():
            identity = point.node.profile.name, point.node.address, point.item
            held = self._held.setdefault(identity, Held(name))
            if held.group != name:
                continue
            if sample.error is not None:
                held.status = BAD
                continue
            held.value = sample.value
            held.asked = sample.finished if sample.started is None else sample.started
            held.status = STALE if sample.quality is Quality.STALE else CURRENT

    def look_up(self, keys: Iterable[str]) -> dict[str, tuple[Any, int]]:
        """Return the last good value of each point and its status, all of one moment."""
        frame, remote = self.line.picture.frame, self._remote
        away = remote is None or not self.line.is_connected or frame is None
        lost = frame.now if frame is not None and frame.state == "offline" else -inf
        old = self._groups.old(remote.now()) if remote is not None and not away else set()
        found: dict[str, tuple[Any, int]] = {}
        for key in keys:
            row = self.rows.get(key)
            held = None if row is None else self._held.get((row.protocol, row.address, row.item))
            if row is None or held is None or held.value is None:
                found[key] = None, AWAY if away else NO_VALUE
            elif away or held.asked <= lost:
                found[key] = held.value, AWAY
            elif held.status != CURRENT:
                found[key] = held.value, held.status
            else:
                is_stale = held.group in old or self._touches.is_stale(row.protocol, row.address, row.item, held.asked)
                found[key] = held.value, STALE if is_stale else CURRENT
        return found


# What clients may do


@dataclass(frozen=True, kw_only=True)
class Rules:
    """`allow` are patterns of points, and `units` ids of units, that may be written; `peers` the addresses of clients
    that may write, None for all."""

    allow: tuple[str, ...] = ()
    units: frozenset[int] = frozenset()
    peers: tuple[ipaddress.IPv4Network | ipaddress.IPv6Network, ...] | None = None
    pass_through: bool = False

    def is_writer(self, peer: str) -> bool:
        """Return whether the client at this address may write anything."""
        if self.peers is None:
            return True
        try:
            address = ipaddress.ip_address(peer.partition("%")[0])
        except ValueError:
            return False
        mapped = getattr(address, "ipv4_mapped", None) or address
        return any(mapped in network for network in self.peers)


Refuse: TypeAlias = Callable[[str, str], None]
"""Called with each refusal: "connections" or "requests", and the peer."""


def _ignore(_kind: str, _peer: str) -> None:
    """Report no refusal."""


class Answers:
    """Replies to requests. `report` is called with a line for each write: its client, and its outcome."""

    def __init__(self, values: Values, rules: Rules, report: Callable[[str], None], refused: Refuse = _ignore) -> None:
        self._values = values
        self._rules = rules
        self._report = report
        self._refused = refused
        self._denied = LimitedReport(report, _denied_text)
        self._turns: WeakValueDictionary[str, asyncio.Semaphore] = WeakValueDictionary()
        """The pass-through requests of each address, while it has any."""

    async def reply(self, peer: str, unit: int, pdu: bytes) -> bytes:
        """Return the reply to a request. Does not raise errors of the line, nor of the request."""
        try:
            request = request_of(pdu)
            to_unit = self._rules.pass_through and unit not in OWN_UNITS
            if isinstance(request, ReadRequest):
                values = await self._read_unit(peer, unit, request) if to_unit else self._read_points(request)
                return read_reply(pdu[0], values)
            await (self._write_unit(peer, unit, request) if to_unit else self._write_points(peer, request))
            return pdu[:5]
        except ExceptionReply as refused:
            return exception_reply(pdu[0], refused.code)

    # points

    def _map(self) -> RegisterMap:
        if not self._values.map.entries:
            raise ExceptionReply(NO_REPLY, "the points of the line are not known yet")
        return self._values.map

    def _read_points(self, request: ReadRequest) -> list[int]:
        map_ = self._map()
        parts = map_.whole(request.table, request.first, request.count)
        values = self._values.look_up({entry.point for entry, _ in parts})
        registers: list[int] = []
        for entry, is_status in parts:
            value, status = values[entry.point]
            if is_status:
                registers.append(int(status != CURRENT) if entry.type == "bit" else status)
                continue
            if self._values.known.is_set() and entry.point not in self._values.rows:
                raise ExceptionReply(NO_PATH, f"{entry.point} is not a point of the line")
            if value is None or (status != CURRENT and not map_.last):
                raise ExceptionReply(NO_REPLY, f"{entry.point} has no current value")
            try:
                registers += entry.registers(value)
            except ValueError as error:
                raise ExceptionReply(DEVICE_FAILURE, f"{entry.point}: {error}") from None
        return registers

    async def _write_points(self, peer: str, request: WriteRequest) -> None:
        self._check_writer(peer, bool(self._rules.allow))
        wanted: list[tuple[Row, int | float]] = []
        place = 0
        for entry, is_status in self._map().whole(request.table, request.first, len(request.values)):
            row = self._values.rows.get(entry.point)
            if row is None:
                raise ExceptionReply(NO_PATH, f"{entry.point} is not a point of the line")
            if is_status or not (row.writable and is_allowed(entry.point, self._rules.allow)):
                self._deny(peer, ILLEGAL_VALUE)
            size = 1 if is_status else entry.size
            try:
                wanted.append((row, entry.value(request.values[place : place + size])))
            except ValueError as error:
                raise ExceptionReply(ILLEGAL_VALUE, f"{entry.point}: {error}") from None
            place += size
        if not self._values.line.is_connected:
            raise ExceptionReply(NO_REPLY, "the line's owner is away")
        for count, (row, value) in enumerate(wanted):
            try:
                await self._values.line.write(row.group, row.key, value)
            except (BusError, InvalidCommand) as error:
                before = f"; of this request {count} of {len(wanted)} points were written" if len(wanted) > 1 else ""
                self._report(f"client {peer}: {row.key} = {value}: {cut(str(error))}{before}")
                raise ExceptionReply(code_of(error), str(error)) from None
            self._report(f"client {peer}: {row.key} = {value}: written")

    # units of the line

    async def _read_unit(self, peer: str, unit: int, request: ReadRequest) -> list[int]:
        kind = "read_bits" if request.table in BIT_TABLES else "read_registers"
        # Clients poll. As commands, reads of four clients took 28 % of the cycles from a group of the owner.
        values = await self._run(peer, unit, Priority.POLL, kind, request.first, request.count, request.table)
        return [int(one) for one in values]

    async def _write_unit(self, peer: str, unit: int, request: WriteRequest) -> None:
        self._check_writer(peer, bool(self._rules.units))
        if unit not in self._rules.units:
            self._deny(peer, ILLEGAL_VALUE)
        write, read = ("write_coils", "read_bits") if request.table == "coil" else ("write_registers", "read_registers")
        what = f"client {peer}: unit {unit}, {len(request.values)} from {request.table} {request.first}"
        try:
            # Without the read that matches the write, all points of the unit would be stale until their next cycle.
            changed = _modbus_commands()[read](request.first, len(request.values), request.table)
            await self._run(peer, unit, Priority.COMMAND, write, request.first, request.values, touches=changed)
        except ExceptionReply as refused:
            self._report(f"{what}: {cut(str(refused))}")
            raise
        self._report(f"{what}: written")

    async def _run(
        self, peer: str, unit: int, priority: Priority, kind: str, *arguments: Any, touches: Any = None
    ) -> Any:
        line = self._values.line
        if not line.is_connected:
            raise ExceptionReply(NO_REPLY, "the line's owner is away")
        if ("modbus", unit) not in line.picture.nodes:
            raise ExceptionReply(NO_PATH, f"the line has no Modbus RTU unit {unit}")
        finish_by = time.monotonic() + FINISH_WITHIN
        # With 128 at a time on the line, a further client got no reply within FINISH_WITHIN. A line carries one at a
        # time, so more than MOST_GATEWAY_ON_LINE would not make it faster.
        turns = self._turns.setdefault(peer_of(peer), asyncio.Semaphore(MOST_GATEWAY_ON_LINE))
        try:
            async with asyncio.timeout(FINISH_WITHIN):
                await turns.acquire()
        except TimeoutError:
            raise ExceptionReply(DEVICE_BUSY, "other requests of this address are on the line") from None
        try:
            command = _modbus_commands()[kind](*arguments)
            node = line.remote.find("modbus", unit)
            left = max(0.0, finish_by - time.monotonic())
            return await node.request(command, touches=touches, priority=priority, finish_within=left)
        except (BusError, InvalidCommand) as error:
            raise ExceptionReply(code_of(error), str(error)) from None
        finally:
            turns.release()

    # refusals

    def _check_writer(self, peer: str, anything: bool) -> None:
        if not anything or self._values.line.read_only or not self._rules.is_writer(peer):
            self._deny(peer, ILLEGAL_FUNCTION)

    def _deny(self, peer: str, code: int) -> None:
        self._denied.note(peer_of(peer))
        self._refused("requests", peer_of(peer))
        raise ExceptionReply(code, "this may not be written")


def _denied_text(counts: Counter[str]) -> str:
    peers = ", ".join(f"{count} from {peer}" for peer, count in counts.most_common(3))
    why = "--allow does not name the point, or --allow-from does not include the client"
    return f"{counts.total()} write requests of Modbus TCP were refused, because {why}: {peers}"


def _modbus_commands() -> Mapping[str, Callable[..., Any]]:
    return next(protocol.commands for protocol in protocols() if protocol.name == "modbus")


def code_of(error: BusError | InvalidCommand) -> int:
    """Return the exception code of what the line's owner raised."""
    match error:
        case InvalidCommand():
            return ILLEGAL_VALUE
        case Refused():
            text = error.what.removeprefix("refused: ")
            number = text.removeprefix("exception ")
            return int(number) if number.isdecimal() else UNIT_REFUSED.get(text, DEVICE_FAILURE)
        case NotStarted() | BacklogFull() | Superseded():
            return DEVICE_BUSY
    return NO_REPLY


# The server


class ModbusTcpServer:
    """Accepts clients, and replies to the requests of each one by one, in their order."""

    def __init__(
        self, answers: Answers, report: Callable[[str], None], refused: Refuse = _ignore, *, idle: float = IDLE
    ) -> None:
        self._answers = answers
        self._idle = idle
        self._refused = refused
        self._open: dict[asyncio.StreamWriter, str] = {}
        """The connections and their peers; the one without a request for the longest time first."""
        self._busy: set[asyncio.StreamWriter] = set()
        """Those whose request has no reply yet."""
        self._replaced: dict[asyncio.StreamWriter, str] = {}
        """Closed connections whose request has no reply yet, and their peers."""
        self._closed = LimitedReport(report, self._closed_text)

    async def accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection until it ends."""
        host = str((writer.get_extra_info("peername") or ("unknown",))[0])
        peer = peer_of(host)
        # A replaced connection still counts: its request is still on the line.
        if sum(other == peer for other in (*self._open.values(), *self._replaced.values())) >= MOST_GATEWAY_PER_PEER:
            self._refuse(writer, peer, f"beyond {MOST_GATEWAY_PER_PEER} of one address")
            return
        if len(self._open) >= MOST_GATEWAY_CONNECTIONS and not self._make_room(peer):
            self._refuse(writer, peer, f"beyond {MOST_GATEWAY_CONNECTIONS}: all have a request on the line")
            return
        self._open[writer] = peer
        writer.transport.set_write_buffer_limits(high=MOST_GATEWAY_UNREAD)
        try:
            await self._serve(reader, writer, host)
        except BadFrame as bad:
            self._refuse(writer, peer, str(bad))
        except TimeoutError:
            self._closed.note(f"no request for {self._idle:g} s")
        except (OSError, asyncio.IncompleteReadError):
            pass  # the client has left
        finally:
            self._open.pop(writer, None)
            self._replaced.pop(writer, None)
            writer.transport.abort()

    def close(self) -> None:
        """End all connections."""
        for writer in self._open:
            writer.transport.abort()

    def _make_room(self, peer: str) -> bool:
        """Close a connection for one more of this peer. Returns False if none may be closed.

        The address with the most connections gives one up, so that a few addresses cannot keep out all others. First
        choice is the one without a request for the longest time. If all have a request on the line, it is the oldest.
        """
        counts = Counter(self._open.values())
        idle = [
            one
            for one, other in self._open.items()
            if one not in self._busy and (other == peer or counts[other] > counts[peer])
        ]
        if idle:
            chosen = max(idle, key=lambda one: counts[self._open[one]])  # of several, the first
            why = f"beyond {MOST_GATEWAY_CONNECTIONS}: the one idle for the longest time"
            self._refuse(chosen, self._open.pop(chosen), why)
            return True
        [(most, count)] = counts.most_common(1)
        if count <= counts[peer] + 1:
            return False
        oldest = next(one for one, other in self._open.items() if other == most)
        self._replaced[oldest] = self._open.pop(oldest)
        self._refuse(oldest, most, f"beyond {MOST_GATEWAY_CONNECTIONS}: one of the address with the most")
        return True

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, host: str) -> None:
        while True:
            async with asyncio.timeout(self._idle):
                begun = await reader.readexactly(1)
            try:
                async with asyncio.timeout(REQUEST_WITHIN):
                    header = begun + await reader.readexactly(HEADER.size - 1)
                    pdu = await reader.readexactly(length_of(header))
            except TimeoutError:
                raise BadFrame(f"half a request for {REQUEST_WITHIN:g} s") from None
            if writer not in self._open:
                return  # another one has its place
            self._open[writer] = self._open.pop(writer)
            transaction, _, _, unit = HEADER.unpack(header)
            self._busy.add(writer)
            try:
                reply = await self._answers.reply(host, unit, pdu)
            finally:
                self._busy.discard(writer)
            writer.write(HEADER.pack(transaction, 0, len(reply) + 1, unit) + reply)
            try:
                async with asyncio.timeout(GATEWAY_SEND_WITHIN):
                    await writer.drain()
            except TimeoutError:
                raise BadFrame(f"replies not read for {GATEWAY_SEND_WITHIN:g} s") from None
            await asyncio.sleep(0)  # a client that sends without pause is served in turn with the others

    def _refuse(self, writer: asyncio.StreamWriter, peer: str, why: str) -> None:
        self._closed.note(why)
        self._refused("connections", peer)
        writer.transport.abort()

    def _closed_text(self, counts: Counter[str]) -> str:
        return f"Modbus TCP connections closed: {'; '.join(f'{many} ({why})' for why, many in counts.most_common())}"


async def serve(
    values: Values,
    rules: Rules,
    listen: tuple[str, int],
    opened: Callable[[str], None],
    report: Callable[[str], None],
    idle: float = IDLE,
) -> None:
    """Follow a line and serve it by Modbus TCP until cancelled. `opened` is called with the server's address.

    Raises InvalidCommand if it cannot listen there.
    """
    refused = ReportedRefusals("modbus-tcp", values.line, "connections", "requests").note
    server = ModbusTcpServer(Answers(values, rules, report, refused), report, refused, idle=idle)
    socket = await asyncio.to_thread(listening, listen)
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(values.run())
        tasks.create_task(values.line.follow())
        accepting = await asyncio.start_server(server.accept, sock=socket, limit=MOST_GATEWAY_UNREAD)
        try:
            opened(address_text(*accepting.sockets[0].getsockname()[:2]))
            await asyncio.get_running_loop().create_future()
        finally:
            # Not `serve_forever`, nor `async with`: from Python 3.12 on, both wait until each client has left.
            accepting.close()
            server.close()


async def map_text(values: Values, allow: Collection[str]) -> str:
    """Return the map of a line as CSV. Raises BusError if no program serves it."""
    text = ""

    async def wait() -> None:
        nonlocal text
        await values.known.wait()
        text = map_as_csv(values.map, values.rows, allow)
        for task in running:
            task.cancel()

    async with asyncio.TaskGroup() as tasks:
        running = [tasks.create_task(values.run()), tasks.create_task(values.line.follow(patient=False))]
        tasks.create_task(wait())
    return text
