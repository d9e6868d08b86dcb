"""A sixth protocol for the conformance kit: two functions of Modbus RTU, their cases, and a slave."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pytest

from busmaster.contract.exchange import MORE, Command, Done, Expect, FrameError, LaterStep, Need, Sizes, no_reply
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.emulator.device import Device
from busmaster.errors import InvalidCommand, Refused
from busmaster.testing import Case, NotConformant, check_protocol

READ, WRITE, EXCEPTION = 3, 6, 0x80


def crc(data: bytes) -> bytes:
    check = 0xFFFF
    for byte in data:
        check ^= byte
        for _ in range(8):
            check = check >> 1 ^ (0xA001 if check & 1 else 0)
    return check.to_bytes(2, "little")


def checked(*data: int) -> bytes:
    return bytes(data) + crc(bytes(data))


class Asking:
    """One attempt: the unit and function are echoed, an exception is three bytes, everything ends in a CRC."""

    sizes = Sizes(7, 7)
    later: Sequence[LaterStep] = ()
    closing = 0
    answered = True

    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        self.request = request
        self.timing = timing
        self.starts = request[:1]
        self.answers: tuple[bytes, ...] = (self.header(),)
        self.buffer = b""

    def header(self) -> bytes:
        """What its good reply begins with: unit, function, and how many bytes."""
        return self.request[:2] + b"\x02"

    @property
    def overdue(self) -> tuple[bytes, ...]:
        return self.answers

    def size(self) -> int:
        return 7

    def value(self, frame: bytes) -> Any:
        return int.from_bytes(frame[3:5], "big")

    def echoed(self, frame: bytes) -> bool:
        return frame[0] == self.request[0] and frame[1] & 0x7F == self.request[1] and frame[2] in (0, 2)

    def sound(self, frame: bytes) -> bool:
        return crc(frame[:-2]) == frame[-2:]

    def feed(self, data: bytes, /) -> Need | Expect | Done[Any]:
        self.buffer += data
        if len(self.buffer) < 3:
            return MORE
        refused = self.buffer[1] & EXCEPTION
        size = 5 if refused else self.size()
        if len(self.buffer) < size:
            return MORE
        frame, rest = self.buffer[:size], self.buffer[size:]
        if not refused and not self.echoed(frame):
            raise FrameError("wrong echo")
        if not self.sound(frame):
            raise FrameError("bad CRC", whole=not refused and not rest)
        if refused:
            if frame[:2] != bytes((self.request[0], self.request[1] | EXCEPTION)):
                raise FrameError("wrong echo")
            raise Refused(f"exception {frame[2]}")
        return Done(self.value(frame), rest=rest)

    def expired(self, started: bool, /) -> Expect | Done[Any]:
        raise FrameError("cut short") if self.buffer else no_reply()


class ReadsPlaces(Asking):
    """A write: the reply is the request."""

    sizes = Sizes(8, 8)

    def header(self) -> bytes:
        return self.request[:6]

    def size(self) -> int:
        return 8

    def value(self, frame: bytes) -> Any:
        return None

    def echoed(self, frame: bytes) -> bool:
        return frame[:6] == self.request[:6]


def word(value: int) -> tuple[int, int]:
    if not 0 <= value <= 0xFFFF:
        raise InvalidCommand(f"{value} is no 16-bit number")
    return value >> 8, value & 0xFF


@dataclass(frozen=True, slots=True)
class ReadRegister:
    register: int
    exchange: type[Asking] = Asking
    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        word(self.register)

    def __str__(self) -> str:
        return f"read register {self.register}"

    def open(self, address: int, timings: Timings, /) -> Asking:
        return self.exchange(checked(address, READ, *word(self.register), 0, 1), timings.read)


@dataclass(frozen=True, slots=True)
class WriteRegister:
    register: int
    value: int
    exchange: type[Asking] = ReadsPlaces
    writes: ClassVar[bool] = True
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        word(self.register)
        word(self.value)

    def __str__(self) -> str:
        return f"write register {self.register} = {self.value}"

    def open(self, address: int, timings: Timings, /) -> Asking:
        return self.exchange(checked(address, WRITE, *word(self.register), *word(self.value)), timings.write)


MODBUS = Profile(
    name="modbus",
    title="Modbus RTU",
    addresses=range(1, 248),
    line=LineSettings(19200, parity="E"),
    timings=Timings.uniform(ReplyTiming(0.05, 0.1, 0.2, 0.02)),
    probe=ReadRegister(0),
    sync_reads=(ReadRegister(0),),
)
REPLY = bytes.fromhex("11 03 02 02 2b 38 f8")
OTHER_UNIT = checked(0x12, READ, 2, 2, 0x2B)
READING = Case(ReadRegister(7), 17, [REPLY], 555)
CASES = [
    READING,
    Case(ReadRegister(7), 18, [OTHER_UNIT], 555),
    Case(WriteRegister(7, 3), 17, [bytes.fromhex("11 06 00 07 00 03 7a 9a")]),
    Case(WriteRegister(7, 4), 17, [checked(17, WRITE, 0, 7, 0, 4)], request=checked(17, WRITE, 0, 7, 0, 4)),
    Case(ReadRegister(9), 17, [bytes.fromhex("11 83 02 c1 34")], raises=Refused),
]


def named(command: Command[Any], address: int) -> Hashable:
    """A reply to a read names the unit, one to a write everything."""
    return address, type(command) if isinstance(command, ReadRegister) else command


class Registers(Device):
    """A Modbus slave that takes each chunk for a whole frame."""

    def __init__(self, address: int) -> None:
        super().__init__(address)
        self.registers: dict[bytes, bytes] = {}

    def hear(self, data: bytes, start: float) -> None:
        unit, function, register = data[0], data[1], data[2:4]
        if unit == self.address and function == WRITE:
            self.registers[register] = data[4:6]
            self.reply(data, start)
        elif unit == self.address:
            self.reply(checked(unit, READ, 2, *self.registers[register]), start)

    def hear_byte(self, byte: int, now: float) -> None:
        raise NotImplementedError


def find(*cases: Case, profile: Profile = MODBUS, **options: Any) -> str:
    """All findings, which there must be."""
    with pytest.raises(NotConformant) as error:
        check_protocol(profile, cases or CASES, **{"names": named, **options})
    assert error.value.findings
    return str(error.value)


def reading_with(exchange: type[Asking], **changes: Any) -> Case:
    return replace(READING, command=ReadRegister(7, exchange), **changes)
