"""MSC controllers (IB-11A002 rev E): data variables of 32 bits, 256 flags, the program's status word.

Each command is one packet whose body is an ASCII name, a comma and binary values, most significant byte first.
The reply to a write is an ACK; the reply to a read is an ACK and a packet with the same name. `exchange` implements it.

The controller decides which data addresses and flags exist and may be written. It refuses all others with a NAK.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, TypeVar

from busmaster.contract.arguments import whole_number
from busmaster.contract.exchange import Command, FrameError
from busmaster.contract.profile import Batch, LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand
from busmaster.protocols.msc.exchange import UNITS, PacketExchange, Reply, StalePacketListener, packet
from busmaster.protocols.msc.status import ProgramStatus
from busmaster.wire.readers import ACK

T = TypeVar("T")

BLOCK = 32
"""Number of values of each BREAD or BWRITE."""
FLAGS = 256
HIGHEST_ADDRESS = 0xFFFF
WIDEST_STEP = 4
"""Largest known difference of the addresses of two consecutive values: a value has four bytes."""
LOWEST_VALUE = -(2**31)
HIGHEST_VALUE = 2**31 - 1


class _Reading:
    __slots__ = ()
    writes = False
    idempotent = True


class _Writing:
    """A program may consume a written value, so no write is repeated unless the caller allows it."""

    __slots__ = ()
    writes = True
    idempotent = False


@dataclass(frozen=True, slots=True)
class _AtAddress:
    address: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "address", whole_number(self.address, 0, HIGHEST_ADDRESS, "a data address"))


@dataclass(frozen=True, slots=True)
class _OfFlag:
    flag: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "flag", whole_number(self.flag, 0, FLAGS - 1, "a flag"))


@dataclass(frozen=True, slots=True)
class DataRead(_Reading, _AtAddress):
    """DREAD: the signed 32-bit value at a data address, 0 to 65535 (see the data table of the program's listing)."""

    def __str__(self) -> str:
        return f"read data {self.address}"

    @property
    def places(self) -> tuple[Hashable, ...]:
        return (("data", self.address),)

    def shown(self, values: Mapping[Hashable, Any]) -> Any:
        return values["data", self.address]

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {("data", self.address): value}

    def open(self, address: int, timings: Timings, /) -> PacketExchange[int]:
        return _ask(address, timings, b"DREAD,", self.address.to_bytes(2, "big"), 4, _value_of)


@dataclass(frozen=True, slots=True)
class DataWrite(_Writing, _AtAddress):
    """DWRITE: a signed 32-bit value into a data address."""

    value: int

    def __post_init__(self) -> None:
        _AtAddress.__post_init__(self)
        object.__setattr__(self, "value", _checked_value(self.value))

    def __str__(self) -> str:
        return f"write data {self.address} = {self.value}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return _data_changes(profile, self.address, (self.value,))

    def open(self, address: int, timings: Timings, /) -> PacketExchange[None]:
        return _write_exchange(address, timings, b"DWRITE," + struct.pack(">Hi", self.address, self.value))


@dataclass(frozen=True, slots=True)
class BlockRead(_Reading, _AtAddress):
    """BREAD: the 32 consecutive values from a data address on."""

    def __str__(self) -> str:
        return f"read {BLOCK} values from data {self.address}"

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        """Return its values by their addresses; only the first if the address step is not known."""
        step = _step_of(profile)
        return {("data", self.address + i * (step or 0)): one for i, one in enumerate(value if step else value[:1])}

    def open(self, address: int, timings: Timings, /) -> PacketExchange[tuple[int, ...]]:
        return _ask(address, timings, b"BREAD,", self.address.to_bytes(2, "big"), 4 * BLOCK, _block_of)


@dataclass(frozen=True, slots=True)
class BlockWrite(_Writing, _AtAddress):
    """BWRITE: 32 values from a data address on. Fewer are rejected: padding would overwrite the values after them."""

    values: tuple[int, ...]

    def __post_init__(self) -> None:
        _AtAddress.__post_init__(self)
        object.__setattr__(self, "values", tuple(map(_checked_value, self.values)))
        if len(self.values) != BLOCK:
            raise InvalidCommand(f"a block is {BLOCK} values, not {len(self.values)}: write single values one by one")

    def __str__(self) -> str:
        return f"write {BLOCK} values from data {self.address}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return _data_changes(profile, self.address, self.values)

    def open(self, address: int, timings: Timings, /) -> PacketExchange[None]:
        return _write_exchange(address, timings, b"BWRITE," + struct.pack(f">H{BLOCK}i", self.address, *self.values))


@dataclass(frozen=True, slots=True)
class SetFlag(_Writing, _OfFlag):
    """SFLAG: an output flag or user flag, 0 to 255, on."""

    def __str__(self) -> str:
        return f"set flag {self.flag}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return {("flag", self.flag): True}

    def open(self, address: int, timings: Timings, /) -> PacketExchange[None]:
        return _write_exchange(address, timings, b"SFLAG," + self.flag.to_bytes(2, "big"))


@dataclass(frozen=True, slots=True)
class ClearFlag(_Writing, _OfFlag):
    """CFLAG: an output flag or user flag, 0 to 255, off."""

    def __str__(self) -> str:
        return f"clear flag {self.flag}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return {("flag", self.flag): False}

    def open(self, address: int, timings: Timings, /) -> PacketExchange[None]:
        return _write_exchange(address, timings, b"CFLAG," + self.flag.to_bytes(2, "big"))


@dataclass(frozen=True, slots=True)
class ReadFlag(_Reading, _OfFlag):
    """RFLAG: whether a flag (input, output, timer, motor status or user flag), 0 to 255, is on."""

    def __str__(self) -> str:
        return f"read flag {self.flag}"

    @property
    def places(self) -> tuple[Hashable, ...]:
        return (("flag", self.flag),)

    def shown(self, values: Mapping[Hashable, Any]) -> Any:
        return values["flag", self.flag]

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {("flag", self.flag): value}

    def open(self, address: int, timings: Timings, /) -> PacketExchange[bool]:
        return _ask(address, timings, b"RFLAG,", self.flag.to_bytes(2, "big"), 2, _state_of)


@dataclass(frozen=True, slots=True)
class ReadFlags(_Reading):
    """RFLAGS: the numbers of all flags that are on. Only MSC-850/32 and MSC-250 have it; others reply with a NAK."""

    def __str__(self) -> str:
        return "read all flags"

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {("flag", flag): flag in value for flag in range(FLAGS)}

    def open(self, address: int, timings: Timings, /) -> PacketExchange[frozenset[int]]:
        return _ask(address, timings, b"RFLAGS,", b"", FLAGS // 8, _flags_of)


@dataclass(frozen=True, slots=True)
class ReadStatus(_Reading):
    """RQSTAT: the macroprogram status word. The bytes after it are "not currently used": any are accepted."""

    def __str__(self) -> str:
        return "read program status"

    def open(self, address: int, timings: Timings, /) -> PacketExchange[ProgramStatus]:
        reply = Reply(address, b"RQSTAT,", 8, shortest=2)
        return PacketExchange(packet(address, b"RQSTAT,"), timings, reply, _status_of)


@dataclass(frozen=True, slots=True)
class PickedData(_Reading, _AtAddress):
    """Some of the 32 values of one BREAD, by their places 0 to 31, instead of several DREADs."""

    places: tuple[int, ...]

    def __post_init__(self) -> None:
        _AtAddress.__post_init__(self)
        object.__setattr__(self, "places", tuple(whole_number(place, 0, BLOCK - 1, "a place") for place in self.places))

    def __str__(self) -> str:
        return f"read {len(self.places)} of the {BLOCK} values from data {self.address}"

    def open(self, address: int, timings: Timings, /) -> PacketExchange[tuple[int, ...]]:
        def pick(payload: bytes) -> tuple[int, ...]:
            block = _block_of(payload)
            return tuple(block[place] for place in self.places)

        return _ask(address, timings, b"BREAD,", self.address.to_bytes(2, "big"), 4 * BLOCK, pick)


@dataclass(frozen=True, slots=True)
class PickedFlags(_Reading):
    """Some of the flags of one RFLAGS, instead of several RFLAGs."""

    flags: tuple[int, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "flags", tuple(whole_number(flag, 0, FLAGS - 1, "a flag") for flag in self.flags))

    def __str__(self) -> str:
        return f"read {len(self.flags)} of all flags"

    def open(self, address: int, timings: Timings, /) -> PacketExchange[tuple[bool, ...]]:
        def pick(payload: bytes) -> tuple[bool, ...]:
            on = _flags_of(payload)
            return tuple(flag in on for flag in self.flags)

        return _ask(address, timings, b"RFLAGS,", b"", FLAGS // 8, pick)


@dataclass(frozen=True, slots=True)
class Merging:
    """A Profile's `merge`: neighbouring DREADs as one BREAD, RFLAGs as one RFLAGS.

    `address_step`: difference of the addresses of two consecutive values; without it no DREADs are merged. `all_flags`:
    the controller has RFLAGS (MSC-850/32, MSC-250). Raises InvalidCommand for a step of 0, and for one with which no
    block fits into the addresses.
    """

    address_step: int | None = None
    all_flags: bool = False

    def __post_init__(self) -> None:
        if self.address_step is not None:
            whole_number(self.address_step, 1, HIGHEST_ADDRESS // BLOCK, "address_step")

    def __call__(self, commands: Sequence[Command[Any]]) -> Sequence[Batch]:
        batches = [] if self.address_step is None else _data_batches(commands, self.address_step)
        flags = {i: command.flag for i, command in enumerate(commands) if isinstance(command, ReadFlag)}
        if self.all_flags and len(flags) > 1:
            batches.append(Batch(PickedFlags(tuple(flags.values())), tuple(flags)))
        return batches


def _step_of(profile: Profile) -> int | None:
    """Return the difference of the addresses of two consecutive values; None if it is not known."""
    return profile.merge.address_step if isinstance(profile.merge, Merging) else None


def _data_changes(profile: Profile, first: int, values: Sequence[int]) -> Mapping[Hashable, Any]:
    """Return the values of data addresses after a write; None for an address whose value is not known.

    If the address step is not known, only the first value of a block has a known address. If it is more than 1, the
    addresses between two values contain parts of a value, and so do those before the first.
    """
    step = _step_of(profile)
    widest = step or (1 if len(values) == 1 else WIDEST_STEP)
    places = range(first - widest + 1, first + len(values) * widest)
    changed: dict[Hashable, Any] = {("data", address): None for address in places}
    known = values if step or len(values) == 1 else values[:1]
    changed.update((("data", first + i * widest), value) for i, value in enumerate(known))
    return changed


def _data_batches(commands: Sequence[Command[Any]], step: int) -> list[Batch]:
    waiting = sorted((command.address, i) for i, command in enumerate(commands) if isinstance(command, DataRead))
    batches = []
    while waiting:
        first = waiting[0][0]
        reached = {
            i: (address - first) // step
            for address, i in waiting
            if (address - first) % step == 0 and address - first < BLOCK * step
        }
        waiting = [(address, i) for address, i in waiting if i not in reached]
        # A BREAD always has 32 values: the last one must exist too.
        if len(reached) > 1 and first + (BLOCK - 1) * step <= HIGHEST_ADDRESS:
            batches.append(Batch(PickedData(first, tuple(reached.values())), tuple(reached)))
    return batches


def _ask(
    unit: int, timings: Timings, name: bytes, operands: bytes, payload: int, decode: Callable[[bytes], T]
) -> PacketExchange[T]:
    return PacketExchange(packet(unit, name + operands), timings, Reply(unit, name, payload), decode)


def _write_exchange(unit: int, timings: Timings, body: bytes) -> PacketExchange[None]:
    return PacketExchange(packet(unit, body), timings, None, _nothing)


def _nothing(payload: bytes) -> None:
    return None


def _value_of(payload: bytes) -> int:
    return int.from_bytes(payload, "big", signed=True)


def _block_of(payload: bytes) -> tuple[int, ...]:
    return struct.unpack(f">{BLOCK}i", payload)


def _state_of(payload: bytes) -> bool:
    state = int.from_bytes(payload, "big")
    if state > 1:
        # The checksum was right: without an ACK the packet would be sent again, into other exchanges.
        raise FrameError(f"a flag's state must be 0 or 1, not {state}", send=ACK)
    return state == 1


def _flags_of(payload: bytes) -> frozenset[int]:
    """Return the flags that are on: B1 holds flags 7 to 0 in its bits 7 to 0, B2 flags 15 to 8, and so on."""
    states = int.from_bytes(payload, "little")
    return frozenset(flag for flag in range(FLAGS) if states >> flag & 1)


def _status_of(payload: bytes) -> ProgramStatus:
    return ProgramStatus(int.from_bytes(payload[:2], "big"))


def _checked_value(value: int) -> int:
    return whole_number(value, LOWEST_VALUE, HIGHEST_VALUE, "a value")


_FIRST = ReplyTiming(0.05, 0.5, 1.0, 0.1)
PROFILE = Profile(
    name="msc",
    title="MSC",
    addresses=UNITS,
    line=LineSettings(9600),
    timings=Timings(read=_FIRST, write=_FIRST, packet=ReplyTiming(0.5, 1.0, 1.0, 0.1)),
    probe=ReadStatus(),
    sync_reads=(
        ReadStatus(),
        ReadFlag(0),
    ),  # a reply repeats the name of its command, so these two differ (R15)
    exchange_limit=2.0,  # a packet that is damaged repeatedly is then ACKed, dropped and requested again
    listen=StalePacketListener,  # a packet whose ACK was lost would be repeated five times, into other exchanges
    fixed_rate=True,  # only 9600 baud
)
"""The document contains no times."""
