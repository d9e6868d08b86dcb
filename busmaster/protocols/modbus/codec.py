"""Modbus RTU: coils, discrete inputs, input registers and holding registers of units 1 to 247.

    read     unit 01|02|03|04 first first count count crc crc    answered by unit function bytes data... crc crc
    write    unit 05|06 address address value value crc crc      answered by the same
             unit 0F|10 first first count count bytes data... crc crc
                                                                 answered by unit function first first count count crc
    refused                                                      answered by unit function+80 code crc crc

Numbers are big-endian, the CRC is not. A write to unit 0 is for all units and has no reply. The reply to a read does
not contain the address of the register.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, Generic, TypeVar

from busmaster.contract.arguments import whole_number
from busmaster.contract.exchange import (
    MORE,
    Command,
    Done,
    FrameError,
    LaterStep,
    Progress,
    Sizes,
    no_reply,
    other_format,
)
from busmaster.contract.profile import Batch, LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand, Refused

T = TypeVar("T")

READS = {"coil": 0x01, "discrete": 0x02, "holding": 0x03, "input": 0x04}
"""The function that reads each table."""
WRITE_COIL, WRITE_REGISTER, WRITE_COILS, WRITE_REGISTERS = 0x05, 0x06, 0x0F, 0x10
ON, OFF = 0xFF00, 0x0000
REFUSED = 0x80
BROADCAST = 0
MOST_BITS_READ, MOST_BITS_WRITTEN = 2000, 1968
MOST_READ, MOST_WRITTEN = 125, 123
"""Registers."""
HIGHEST = 0xFFFF
LISTED = 8
"""Maximum number of values in a command's text. If there are more, the text has their number."""
SILENCE = 0.00175
"""Seconds between frames: 3.5 characters, or this above 19200 baud. Here it is the reply's driver release time."""
EXCEPTIONS = {
    1: "illegal function",
    2: "illegal data address",
    3: "illegal data value",
    4: "device failure",
    5: "acknowledged, but it takes long",
    6: "device busy",
    8: "memory parity error",
    10: "gateway path unavailable",
    11: "gateway target did not respond",
}
"""Meaning of the exception codes."""
HINTS = {5: "try again later", 6: "try again later", 10: "check the gateway", 11: "check the device behind the gateway"}
"""Remedies for some of them."""
TEMPORARY = frozenset({5, 6, 10, 11})
"""Exception codes that refer to the state of the unit or a gateway, not to the request."""


def _crc_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
        table.append(value)
    return table


CRC_TABLE = _crc_table()


def with_crc(body: bytes) -> bytes:
    """Return `body` and its CRC-16, low byte first."""
    crc = 0xFFFF
    for byte in body:
        crc = crc >> 8 ^ CRC_TABLE[(crc ^ byte) & 0xFF]
    return body + crc.to_bytes(2, "little")


def is_sound(frame: bytes) -> bool:
    """Return True if the CRC of a complete frame is right."""
    return with_crc(frame[:-2]) == frame


class Frames:
    """The request of a conversation and the form of its reply: `header`, then `payload` bytes and the CRC.

    Those of a read are cached: building a request takes longer than all other work between the end of a silence and the
    write.
    """

    __slots__ = ("answered", "answers", "header", "refusal", "request", "size", "sizes", "starts")

    def __init__(self, body: bytes, header: bytes, payload: int) -> None:
        self.request = with_crc(body)
        self.header = header
        self.answered = body[0] != BROADCAST
        # It does not contain the register: only R15 distinguishes the replies to two similar reads.
        self.answers = (header,) if self.answered else ()
        self.starts = header[:1] if self.answered else b""
        self.refusal = bytes((body[0], body[1] | REFUSED))
        self.size = len(header) + payload + 2
        self.sizes = Sizes(self.size, self.size) if self.answered else Sizes(0, 0)


class Conversation(Generic[T]):
    """One attempt. `decode` converts the reply's payload to the value."""

    __slots__ = ("_buffer", "_decode", "_frames", "answered", "answers", "request", "sizes", "starts", "timing")

    later: ClassVar[Sequence[LaterStep]] = ()
    closing: ClassVar[int] = 0

    def __init__(self, frames: Frames, timing: ReplyTiming, decode: Callable[[bytes], T]) -> None:
        self._frames = frames
        self.request = frames.request
        self.answered = frames.answered
        # A write to all has no reply: the line stays free for as long as a reply would take.
        self.timing = (
            timing
            if self.answered
            else replace(timing, driver_release_time=max(timing.driver_release_time, timing.late_after))
        )
        self.answers = frames.answers
        self.starts = frames.starts
        self.sizes = frames.sizes
        self._decode = decode
        self._buffer = b""

    @property
    def overdue(self) -> tuple[bytes, ...]:
        return self.answers

    def feed(self, data: bytes, /) -> Progress[T]:
        buffer = self._buffer = self._buffer + data
        header, size = self._frames.header, self._frames.size
        if buffer.startswith(self._frames.refusal):
            return self._refused(buffer)
        if not buffer.startswith(header) and not header.startswith(buffer):
            what = f"{buffer[: len(header)].hex(' ')} in place of {header.hex(' ')}"
            if buffer.startswith(header[:2]) and is_sound(buffer):
                raise other_format(len(buffer), f"they begin with {what}", heard=buffer)
            raise FrameError(f"wrong echo: {what}", heard=buffer)
        if len(buffer) < size:
            return MORE
        if not is_sound(buffer[:size]):
            if is_sound(buffer):
                raise other_format(len(buffer), f"the reply to this has {size}")
            # After a whole frame the line does not wait for the maximum reply delay (R3).
            raise FrameError("bad CRC", whole=len(buffer) == size)
        return Done(self._decode(buffer[len(header) : size - 2]), rest=buffer[size:])

    def _refused(self, buffer: bytes) -> Progress[T]:
        if len(buffer) < 5:
            return MORE
        if with_crc(buffer[:3]) != buffer:  # exactly: a valid frame followed by a byte 00 has a right CRC too
            raise FrameError("bad CRC")  # not `whole`: it may be a longer reply with a damaged function code
        code = buffer[2]
        name = EXCEPTIONS.get(code, f"exception {code}")
        # The CRC protects a refusal, so it needs no confirmation.
        raise Refused(f"refused: {name}", confirm=False, temporary=code in TEMPORARY, hint=HINTS.get(code))

    def expired(self, started: bool, /) -> Done[T]:
        if not self.answered:
            return Done(self._decode(b""))
        raise FrameError(f"reply cut short after {len(self._buffer)} bytes") if started else no_reply()


@dataclass(frozen=True, slots=True)
class _Read:
    first: int
    count: int = 1
    table: str = ""

    tables: ClassVar[tuple[str, ...]]
    most: ClassVar[int]
    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if self.table not in self.tables:
            raise InvalidCommand(f"there is no table {self.table!r} to read here: use {' or '.join(self.tables)}")
        _check_span(self.first, self.count, self.most)

    def __str__(self) -> str:
        return f"read {_span(self.table, self.first, self.count)}"

    @property
    def places(self) -> tuple[Hashable, ...]:
        return _places(self.table, self.first, self.count)

    def shown(self, values: Mapping[Hashable, Any]) -> Any:
        return tuple(values[place] for place in self.places)

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return dict(zip(self.places, value, strict=True))


@dataclass(frozen=True, slots=True)
class ReadRegisters(_Read):
    """Read `count` registers, 1 to 125, from `first` on: a tuple of ints, 0 to 65535 each."""

    table: str = "holding"

    tables: ClassVar[tuple[str, ...]] = ("holding", "input")
    most: ClassVar[int] = MOST_READ

    def open(self, address: int, timings: Timings, /) -> Conversation[tuple[int, ...]]:
        """Begin the read. Raises InvalidCommand for the broadcast address, which has no reply."""
        return Conversation(self.frames(address), timings.read, self.decoder())

    def frames(self, address: int) -> Frames:
        """Return the frames of the exchange. Raises InvalidCommand for the broadcast address."""
        return _read_frames(address, READS[self.table], self.first, self.count, 2 * self.count)

    def decoder(self) -> Callable[[bytes], tuple[int, ...]]:
        """Return the function that makes the values from the data of a reply."""
        return _registers(self.count)


@dataclass(frozen=True, slots=True)
class ReadBits(_Read):
    """Read `count` coils or discrete inputs, 1 to 2000, from `first` on: a tuple of bools."""

    table: str = "coil"

    tables: ClassVar[tuple[str, ...]] = ("coil", "discrete")
    most: ClassVar[int] = MOST_BITS_READ

    def open(self, address: int, timings: Timings, /) -> Conversation[tuple[bool, ...]]:
        """Begin the read. Raises InvalidCommand for the broadcast address."""
        return Conversation(self.frames(address), timings.read, self.decoder())

    def frames(self, address: int) -> Frames:
        """Return the frames of the exchange. Raises InvalidCommand for the broadcast address."""
        return _read_frames(address, READS[self.table], self.first, self.count, (self.count + 7) // 8)

    def decoder(self) -> Callable[[bytes], tuple[bool, ...]]:
        """Return the function that makes the values from the data of a reply."""

        def decode(payload: bytes) -> tuple[bool, ...]:
            states = int.from_bytes(payload, "little")  # the first is bit 0 of the first byte
            return tuple(bool(states >> place & 1) for place in range(self.count))

        return decode


@dataclass(frozen=True, slots=True)
class MergedRead:
    """Several reads of a table in one exchange: a tuple of the values of each.

    `spans`: the first address and the count of each. Raises InvalidCommand if there is a gap between them, or if
    they are more than one exchange can read.
    """

    table: str
    spans: tuple[tuple[int, int], ...]
    whole: ReadRegisters | ReadBits = field(init=False, repr=False, compare=False)
    """The read that is sent."""

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        kind = ReadBits if self.table in ReadBits.tables else ReadRegisters
        if not self.spans:
            raise InvalidCommand("a merged read has one span or more")
        if any(len(span) != 2 for span in self.spans):
            raise InvalidCommand("a span of a merged read is its first item and their number")
        first = reached = min(self.spans)[0]
        for start, count in sorted(self.spans):
            # no ReadRegisters of each: a group of 500 points is merged in one step of the event loop
            whole_number(start, 0, HIGHEST, "an address")
            whole_number(count, 1, kind.most, "how many")
            if start > reached:
                raise InvalidCommand(f"merged reads have a gap at {self.table} {reached}")
            reached = max(reached, start + count)
        # here and not in `open`, which is called between the end of a silence and the write
        object.__setattr__(self, "whole", kind(first, reached - first, self.table))

    def __str__(self) -> str:
        return str(self.whole)

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        """Return the value of each place."""
        return {
            place: one
            for (first, count), values in zip(self.spans, value, strict=True)
            for place, one in zip(_places(self.table, first, count), values, strict=True)
        }

    def open(self, address: int, timings: Timings, /) -> Conversation[tuple[tuple[Any, ...], ...]]:
        """Begin the read. Raises InvalidCommand for the broadcast address."""
        whole, decode, spans = self.whole, self.whole.decoder(), self.spans

        def divide(payload: bytes) -> tuple[tuple[Any, ...], ...]:
            values = decode(payload)
            return tuple(values[first - whole.first : first - whole.first + count] for first, count in spans)

        return Conversation(whole.frames(address), timings.read, divide)


@dataclass(frozen=True, slots=True)
class Merging:
    """A Profile's `merge`: reads of neighbouring registers, or bits, of a table in one exchange.

    No place is read that no command reads: a unit may lack it, or a read may have an effect there. `registers` and
    `bits`: the most that the unit returns in one reply; 1 merges none. Raises InvalidCommand for more than the standard
    permits.
    """

    registers: int = MOST_READ
    bits: int = MOST_BITS_READ

    def __post_init__(self) -> None:
        whole_number(self.registers, 1, MOST_READ, "registers of a read")
        whole_number(self.bits, 1, MOST_BITS_READ, "bits of a read")

    def most(self, table: str) -> int:
        """Return how many values of a table one read can have."""
        return self.bits if table in ReadBits.tables else self.registers

    def __call__(self, commands: Sequence[Command[Any]]) -> Sequence[Batch]:
        tables: dict[str, list[tuple[int, int, int]]] = {}
        for index, command in enumerate(commands):
            if isinstance(command, ReadRegisters | ReadBits):
                tables.setdefault(command.table, []).append((command.first, command.count, index))
        return [
            Batch(MergedRead(table, tuple(span[:2] for span in run)), tuple(span[2] for span in run), divisible=True)
            for table, spans in tables.items()
            for run in _runs(sorted(spans), self.most(table))
            if len(run) > 1
        ]


def _runs(spans: Sequence[tuple[int, int, int]], most: int) -> Iterator[list[tuple[int, int, int]]]:
    """Divide spans (first, count, ...) in the order of their addresses into runs of at most so many, without a gap."""
    run: list[tuple[int, int, int]] = []
    start = reached = 0
    for span in spans:
        first, end = span[0], span[0] + span[1]
        if run and (first > reached or max(reached, end) - start > most):
            yield run
            run = []
        if not run:
            start = reached = first
        run.append(span)
        reached = max(reached, end)
    if run:
        yield run


@dataclass(frozen=True, slots=True)
class WriteRegisters:
    """Write `values`, 0 to 65535 each and 123 at most, to the holding registers from `first` on.

    One value is written by function 6, several by function 16. The caller decides whether it is `idempotent`, because
    the effect of a register depends on the unit. Raises InvalidCommand for values that do not fit.
    """

    first: int
    values: tuple[int, ...]
    idempotent: bool = False

    writes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        values = (whole_number(value, 0, HIGHEST, "a register's value") for value in self.values)
        object.__setattr__(self, "values", tuple(values))
        _check_span(self.first, len(self.values), MOST_WRITTEN)

    def __str__(self) -> str:
        return f"write {_span('holding', self.first, len(self.values))} = {_listed(self.values)}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return dict(zip(_places("holding", self.first, len(self.values)), self.values, strict=True))

    def open(self, address: int, timings: Timings, /) -> Conversation[None]:
        count = len(self.values)
        if count == 1:
            return _write_exchange(struct.pack(">BBHH", address, WRITE_REGISTER, self.first, self.values[0]), timings)
        header = struct.pack(">BBHH", address, WRITE_REGISTERS, self.first, count)
        return _write_exchange(header, timings, struct.pack(f">B{count}H", 2 * count, *self.values))


@dataclass(frozen=True, slots=True)
class WriteCoils:
    """Write `values`, each on or off and 1968 at most, to the coils from `first` on: one by function 5, more by 15."""

    first: int
    values: tuple[bool, ...]
    idempotent: bool = False

    writes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        wrong = [value for value in self.values if value not in (0, 1)]
        if wrong:
            raise InvalidCommand(f"a coil is written 1 or 0, not {wrong[0]!r}")
        object.__setattr__(self, "values", tuple(map(bool, self.values)))
        _check_span(self.first, len(self.values), MOST_BITS_WRITTEN)

    def __str__(self) -> str:
        return f"write {_span('coil', self.first, len(self.values))} = {_listed(self.values)}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return dict(zip(_places("coil", self.first, len(self.values)), self.values, strict=True))

    def open(self, address: int, timings: Timings, /) -> Conversation[None]:
        count = len(self.values)
        if count == 1:
            return _write_exchange(
                struct.pack(">BBHH", address, WRITE_COIL, self.first, ON if self.values[0] else OFF), timings
            )
        header = struct.pack(">BBHH", address, WRITE_COILS, self.first, count)
        states = sum(on << place for place, on in enumerate(self.values))
        size = (count + 7) // 8
        return _write_exchange(header, timings, bytes((size,)) + states.to_bytes(size, "little"))


@lru_cache(maxsize=4096)
def _read_frames(unit: int, function: int, first: int, count: int, size: int) -> Frames:
    """Return the frames of a read whose reply has `size` bytes. Raises InvalidCommand for the broadcast address."""
    if unit == BROADCAST:
        raise InvalidCommand("a read of all units has no reply: read one unit at a time")
    return Frames(struct.pack(">BBHH", unit, function, first, count), bytes((unit, function, size)), size)


@lru_cache(maxsize=MOST_READ)
def _registers(count: int) -> Callable[[bytes], tuple[int, ...]]:
    """Return the function that converts this many registers to numbers."""
    return struct.Struct(f">{count}H").unpack


def _write_exchange(header: bytes, timings: Timings, data: bytes = b"") -> Conversation[None]:
    """Begin a write: the unit repeats its first six bytes."""
    return Conversation(Frames(header + data, header, 0), timings.write, _nothing)


def _places(table: str, first: int, count: int) -> tuple[Hashable, ...]:
    return tuple((table, number) for number in range(first, first + count))


def _nothing(_: bytes) -> None:
    return None


def _check_span(first: int, count: int, longest: int) -> None:
    whole_number(first, 0, HIGHEST, "an address")
    whole_number(count, 1, longest, "how many")
    whole_number(first + count - 1, 0, HIGHEST, "the last address")


def _listed(values: Sequence[int]) -> str:
    return ", ".join(str(int(value)) for value in values) if len(values) <= LISTED else f"{len(values)} values"


def _span(table: str, first: int, count: int) -> str:
    return f"{table} {first}" if count == 1 else f"{table} {first}-{first + count - 1}"


LINE, NO_PARITY = LineSettings(19200, parity="E"), LineSettings(19200)
PROFILE = Profile(
    name="modbus",
    title="Modbus RTU",
    addresses=range(1, 248),
    line=LINE,  # the standard's default
    other_lines=(
        *NO_PARITY.at(9600, 19200),  # common, although the standard requires a second stop bit without parity
        *LINE.at(9600),
        *NO_PARITY.at(38400, 115200, 57600),
        *LINE.at(38400, 115200, 57600),
        *LineSettings(19200, parity="O").at(19200, 9600),
    ),
    timings=Timings.uniform(
        ReplyTiming(
            late_after=0.05, window=0.2, max_reply_delay=0.4, inter_byte_timeout=0.02, driver_release_time=SILENCE
        )
    ),
    probe=ReadRegisters(0),  # a unit without it refuses, and a refusal is a reply too (R11)
    # Only unit, function and length distinguish replies, so the lengths differ (R15).
    sync_reads=tuple(ReadRegisters(0, count) for count in range(1, 5)),
    broadcast=BROADCAST,
    default_merge=Merging(),
)
