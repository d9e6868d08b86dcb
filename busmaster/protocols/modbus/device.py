"""An emulated Modbus unit: four tables, and exceptions for missing functions and addresses. Its parser is its own.

The end of a request is known by its length if the function is known, else by the silence after it.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Iterable, Sequence
from typing import Any

from busmaster.emulator.chance import Chance
from busmaster.emulator.device import NEVER, Delay, Device, held
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand

# Nothing here is shared with the codec: otherwise the same misinterpretation on both sides would not be noticed.
BROADCAST = 0
ALL = range(1, 248)
READ_COILS, READ_DISCRETES, READ_HOLDING, READ_INPUTS = 1, 2, 3, 4
WRITE_COIL, WRITE_REGISTER, WRITE_COILS, WRITE_REGISTERS = 5, 6, 15, 16
FIXED = frozenset({READ_COILS, READ_DISCRETES, READ_HOLDING, READ_INPUTS, WRITE_COIL, WRITE_REGISTER})
"""Functions whose requests have eight bytes."""
COUNTED = frozenset({WRITE_COILS, WRITE_REGISTERS})
"""Functions whose requests have the number of the following bytes in their seventh byte."""
MOST = {READ_COILS: 2000, READ_DISCRETES: 2000, READ_HOLDING: 125, READ_INPUTS: 125}
EXCEPTION = 0x80
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE = 1, 2, 3
SHORTEST = 4
PAUSE_CHARACTERS, SHORTEST_PAUSE = 3.5, 0.00175
SIZE = 1000
"""Default size of each table."""
FORMS = {
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "int64": "q",
    "uint64": "Q",
    "float32": "f",
    "float64": "d",
}
TABLES = {"holding": "registers", "input": "inputs", "coil": "coils", "discrete": "discretes"}
ITEM = re.compile(
    rf"(?P<table>{'|'.join(TABLES)}):(?P<first>\d+)(:\d+|:(?P<form>{'|'.join(FORMS)})(?P<swapped>:swapped)?)?",
    re.ASCII,
)
FORM = "holding:100, input:100, coil:5 or discrete:5, with a kind of number behind it where it is one"
LIVE = 0
"""The register, in both tables, that moves on a lively unit: a sine about the middle of its range."""
SWING, TURN = 10_000, 10.0


class Illegal(Exception):
    """The unit refuses. The argument is the exception code."""


class EmulatedModbus(Device):
    """A unit, 1 to 247. Each table has the size of its initial values.

    `functions`: those that it supports; it refuses all others with exception 1. `read_only`: holding registers
    that refuse writes, with exception 3. `lively`: register 0 of both register tables moves. With a `traceable`, it
    provides every register.
    """

    def __init__(
        self,
        address: int,
        registers: Iterable[int] = (0,) * SIZE,
        *,
        inputs: Iterable[int] = (0,) * SIZE,
        coils: Iterable[bool] = (False,) * SIZE,
        discretes: Iterable[bool] = (False,) * SIZE,
        functions: frozenset[int] = FIXED | COUNTED,
        read_only: frozenset[int] = frozenset(),
        lively: bool = False,
        delay: Delay | None = None,
        traceable: TraceableMemory | None = None,
    ) -> None:
        super().__init__(address, delay=delay)
        if address not in ALL:
            raise InvalidCommand(f"a Modbus unit has an address from 1 to 247, not {address}")
        if traceable is not None and traceable.modulus > 2**16:
            raise InvalidCommand(f"a register carries 2**16 traceable values, not {traceable.modulus}")
        if not functions <= FIXED | COUNTED:
            raise InvalidCommand(
                f"an emulated unit knows the functions {sorted(FIXED | COUNTED)}, not {sorted(functions)}"
            )
        self.registers = list(registers)
        self.inputs = list(inputs)
        self.coils = list(coils)
        self.discretes = list(discretes)
        self.functions = functions
        self.read_only = read_only
        self.lively = lively
        self.traceable = traceable
        self.routes = (bytes((address,)), bytes((BROADCAST,)))
        self._frame = b""
        self._heard_until = 0.0

    def preset(self, item: str, *values: float) -> None:
        """Set values in a table from an address on: "holding:100", "input:40:float32:swapped", "coil:5".

        A register that is set does not move. A count after the address is ignored.
        """
        match = ITEM.fullmatch(item)
        if match is None:
            raise InvalidCommand(f"an emulated unit has no {item!r}: use {FORM}")
        table, first = getattr(self, TABLES[match["table"]]), int(match["first"])
        if match["table"] in ("coil", "discrete"):
            held_there: list[int] = [bool(held(value, 0, 1, item)) for value in values]
        else:
            form = match["form"] or "uint16"
            held_there = [word for value in values for word in words_of(value, form, match["swapped"], item)]
            self.lively &= first > LIVE
        if first + len(held_there) > len(table):
            raise InvalidCommand(f"{item} is beyond the {len(table)} addresses of its table: give size")
        table[first : first + len(held_there)] = held_there

    def restart(self, now: float) -> None:
        super().restart(now)
        self._frame = b""

    # Receiving

    def hear_byte(self, byte: int, now: float) -> None:
        """Process a byte, and execute the frame that it completes.

        A frame begins after a silence, or at the end of a frame to this unit. Frames to other units are ignored.
        """
        # up to the start of this byte, of which `now` is the end
        if now - self.tau - self._heard_until > self._pause:
            self._end_of_frame(now)
        self._heard_until = now
        self._frame += bytes((byte,))
        self.attentive = self._frame[0] in (self.address, BROADCAST)
        self.wakeup = NEVER
        if not self.attentive:
            self._frame = self._frame[:1]  # its own address within another unit's frame does not begin a frame
        elif len(self._frame) == self._length(self._frame):
            frame, self._frame, self.attentive = self._frame, b"", False
            self._obey(frame, now)
        else:
            self.wakeup = now + self._pause

    def take(self, frame: bytes, now: float) -> bool:
        start = now - len(frame) * self.tau
        # A request that only silence ends is processed byte by byte.
        if (self._frame and start - self._heard_until <= self._pause) or len(frame) != self._length(frame):
            return False
        self._frame = b""
        self.attentive, self.wakeup = False, NEVER
        self._heard_until = now
        self._obey(frame, now)
        return True

    def wake(self, now: float) -> None:
        """End an incomplete frame: the line has been silent."""
        self._end_of_frame(now)

    def _end_of_frame(self, now: float) -> None:
        frame, self._frame = self._frame, b""
        self.attentive, self.wakeup = False, NEVER
        # An incomplete request is dropped. A missing function is refused after the silence that ends its frame.
        unknown = len(frame) >= SHORTEST and frame[0] == self.address and self._length(frame) is None
        if unknown and crc(frame[:-2]) == frame[-2:]:
            self._reply(bytes((frame[1] | EXCEPTION, ILLEGAL_FUNCTION)), now)

    @property
    def _pause(self) -> float:
        return max(PAUSE_CHARACTERS * self.tau, SHORTEST_PAUSE)

    def _length(self, frame: bytes) -> int | None:
        """Return the length of the request that begins with `frame`.

        It is 0 if it is not known yet, and None if only silence shows it.
        """
        if len(frame) < 2:
            return 0
        if frame[1] not in self.functions:
            return None
        if frame[1] in FIXED:
            return 8
        return 9 + frame[6] if len(frame) > 6 else 0

    # Replying

    def _obey(self, frame: bytes, now: float) -> None:
        """Execute a complete request with a known function, to this unit or to all."""
        if crc(frame[:-2]) != frame[-2:]:
            return
        function, first, count = struct.unpack(">BHH", frame[1:6])
        try:
            if function in MOST:
                answer = self._read(function, first, count, now)
            else:
                self._write(function, first, count, frame[7:-2])
                answer = frame[1:6]
        except Illegal as refusal:
            answer = bytes((function | EXCEPTION, refusal.args[0]))
        if frame[0] != BROADCAST:
            self._reply(answer, now)

    def _read(self, function: int, first: int, count: int, now: float) -> bytes:
        if not 1 <= count <= MOST[function]:
            raise Illegal(ILLEGAL_VALUE)
        if function in (READ_COILS, READ_DISCRETES):
            bits = self.coils if function == READ_COILS else self.discretes
            _check(bits, first, count)
            states = sum(bool(on) << place for place, on in enumerate(bits[first : first + count]))
            data = states.to_bytes((count + 7) // 8, "little")
        else:
            words = self.registers if function == READ_HOLDING else self.inputs
            _check(words, first, count)
            data = struct.pack(f">{count}H", *(self._word(words, first + i, now) for i in range(count)))
        return bytes((function, len(data))) + data

    def _word(self, words: Sequence[int], place: int, now: float) -> int:
        if self.traceable is not None:
            return self.traceable.read(place)
        if self.lively and place == LIVE:
            return 2**15 + round(SWING * math.sin(now / TURN * math.tau))
        return words[place]

    def _write(self, function: int, first: int, count: int, data: bytes) -> None:
        """Store the values of a write. For a single write `count` is the value. Raises Illegal."""
        if function == WRITE_COIL:
            if count not in (0x0000, 0xFF00):
                raise Illegal(ILLEGAL_VALUE)
            self._store_coils(first, [bool(count)])
        elif function == WRITE_REGISTER:
            self._store(first, (count,))
        elif function == WRITE_COILS:
            if not count or len(data) != (count + 7) // 8:
                raise Illegal(ILLEGAL_VALUE)
            states = int.from_bytes(data, "little")
            self._store_coils(first, [bool(states >> place & 1) for place in range(count)])
        else:
            if not count or len(data) != 2 * count:
                raise Illegal(ILLEGAL_VALUE)
            self._store(first, struct.unpack(f">{count}H", data))

    def _store_coils(self, first: int, states: list[bool]) -> None:
        _check(self.coils, first, len(states))
        self.coils[first : first + len(states)] = states

    def _store(self, first: int, values: Sequence[int]) -> None:
        _check(self.registers, first, len(values))
        if not self.read_only.isdisjoint(range(first, first + len(values))):
            raise Illegal(ILLEGAL_VALUE)
        self.registers[first : first + len(values)] = values
        if self.traceable is not None:
            for place, value in enumerate(values, first):
                self.traceable.write(place, value)

    def _reply(self, answer: bytes, now: float) -> None:
        body = bytes((self.address,)) + answer
        self.reply(body + crc(body), now)

    def disguise(self, reply: bytes, chance: Chance) -> bytes:
        """Return the reply as if another unit had sent it."""
        if len(reply) < SHORTEST:
            return reply  # a single byte does not contain a unit
        other = chance.randrange(ALL.start, ALL.stop - 1)
        body = bytes((other + (other >= reply[0]),)) + reply[1:-2]
        if self.traceable is not None and reply[1] in (READ_HOLDING, READ_INPUTS):
            body = body[:3] + self.traceable.elsewhere().to_bytes(2, "big") * ((len(body) - 3) // 2)
        return body + crc(body)


def words_of(value: float, form: str, swapped: str | None, item: str) -> tuple[int, ...]:
    """Return the registers for a number, in the order of their addresses. Raises InvalidCommand."""
    try:
        data = struct.pack(f">{FORMS[form]}", value if form.startswith("float") else _whole(value))
    except (struct.error, OverflowError, ValueError):
        raise InvalidCommand(f"{item} cannot hold {value:g}: it is a register of {form}") from None
    words: tuple[int, ...] = struct.unpack(f">{len(data) // 2}H", data)
    return words[::-1] if swapped else words


def _whole(value: float) -> int:
    if value != int(value):
        raise ValueError(value)
    return int(value)


def _check(table: Sequence[object], first: int, count: int) -> None:
    if first + count > len(table):
        raise Illegal(ILLEGAL_ADDRESS)


def _remainder(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xA001 if byte & 1 else 0)
    return byte


_REMAINDERS = tuple(map(_remainder, range(256)))


def crc(data: bytes) -> bytes:
    """Return the check of a frame, low byte first."""
    check = 0xFFFF
    for byte in data:
        check = check >> 8 ^ _REMAINDERS[check & 0xFF ^ byte]
    return check.to_bytes(2, "little")


def make_device(address: int, *, size: int = SIZE, **options: Any) -> EmulatedModbus:
    """Make a unit whose tables have `size` addresses; if it is lively, its register 0 moves."""
    zeros, off = (0,) * size, (False,) * size
    return EmulatedModbus(address, zeros, inputs=zeros, coils=off, discretes=off, **options)
