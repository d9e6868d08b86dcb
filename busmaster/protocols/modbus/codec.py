"""A sixth protocol, outside the package: Modbus RTU, reading and writing holding registers.

What a protocol needs is here and nothing else: commands, an exchange, a Profile, a handle for those who use it, and a
device for the emulated line. `busmaster.testing.check_protocol` proves it (tests/examples/test_modbus_rtu.py).

    read     unit 03 first first count count crc crc             answered by unit 03 bytes data... crc crc
    write    unit 06 register register value value crc crc       answered by the same
             unit 10 first first count count bytes data... crc   answered by unit 10 first first count count crc crc
    refused                                                      answered by unit function+80 code crc crc

Numbers are big-endian, the CRC is not. A reply does not say which register was read: exactly what busmaster is for.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

from busmaster import Bus, InvalidCommand, MemoryPort, Point, Priority, Refused
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.line import Line
from busmaster.exchange import MORE, Done, FrameError, Leg, ReplyTiming, Sizes, Step, Timings, no_reply
from busmaster.handle import Handle
from busmaster.profile import LineSettings, Profile
from busmaster.wire.integers import whole_number

T = TypeVar("T")

READ, WRITE_ONE, WRITE_MANY = 0x03, 0x06, 0x10
REFUSED = 0x80
BROADCAST = 0
LONGEST_READ, LONGEST_WRITE = 125, 123
HIGHEST = 0xFFFF
SILENCE = 0.00175
"""Seconds between frames: 3.5 characters, or this above 19200 baud. Here it is the reply's turnaround."""
CODES = {1: "illegal function", 2: "illegal data address", 3: "illegal data value", 4: "device failure", 6: "busy"}


def _crc_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = value >> 1 ^ (0xA001 if value & 1 else 0)
        table.append(value)
    return table


CRC_TABLE = _crc_table()


def with_crc(body: bytes) -> bytes:
    """`body` and its CRC-16, low byte first."""
    crc = 0xFFFF
    for byte in body:
        crc = crc >> 8 ^ CRC_TABLE[(crc ^ byte) & 0xFF]
    return body + crc.to_bytes(2, "little")


class Conversation(Generic[T]):
    """One attempt: the reply begins with `header`, then come `payload` bytes of which `decode` makes the value."""

    __slots__ = (
        "_buffer",
        "_decode",
        "_header",
        "_refusal",
        "_size",
        "answered",
        "request",
        "sizes",
        "starts",
        "timing",
    )

    later: ClassVar[Sequence[Leg]] = ()
    closing: ClassVar[int] = 0

    def __init__(
        self, body: bytes, header: bytes, payload: int, timing: ReplyTiming, decode: Callable[[bytes], T]
    ) -> None:
        self.request = with_crc(body)
        self.timing = timing
        self.answered = body[0] != BROADCAST
        self.starts = header[:1]
        self._header = header
        self._refusal = bytes((body[0], body[1] | REFUSED))
        self._size = len(header) + payload + 2
        self.sizes = Sizes(self._size, self._size)
        self._decode = decode
        self._buffer = b""

    def feed(self, data: bytes) -> Step[T]:
        buffer = self._buffer = self._buffer + data
        header, size = self._header, self._size
        if buffer.startswith(self._refusal):
            return self._refused(buffer)
        if not buffer.startswith(header) and not header.startswith(buffer):
            raise FrameError(f"wrong echo: {buffer[: len(header)].hex(' ')} in place of {header.hex(' ')}")
        if len(buffer) < size:
            return MORE
        if with_crc(buffer[: size - 2]) != buffer[:size]:
            raise FrameError("bad CRC", whole=len(buffer) == size)
        return Done(self._decode(buffer[len(header) : size - 2]), rest=buffer[size:])

    def _refused(self, buffer: bytes) -> Step[T]:
        if len(buffer) < 5:
            return MORE
        if with_crc(buffer[:3]) != buffer:
            raise FrameError("bad CRC")  # or a damaged function code before a longer reply: not whole
        raise Refused(f"refused: {CODES.get(buffer[2], f'code {buffer[2]}')}", confirm=False)

    def expired(self, started: bool) -> Done[T]:
        if not self.answered:
            return Done(self._decode(b""))
        raise FrameError(f"reply cut short after {len(self._buffer)} bytes") if started else no_reply()


@dataclass(frozen=True, slots=True)
class ReadRegisters:
    """Read `count` holding registers from `first` on: a tuple of ints, 0 to 65535 each."""

    first: int
    count: int = 1

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _check_span(self.first, self.count, LONGEST_READ)

    def __str__(self) -> str:
        return f"read {_span(self.first, self.count)}"

    def open(self, address: int, timings: Timings) -> Conversation[tuple[int, ...]]:
        """Raises InvalidCommand for the broadcast address: nobody would answer."""
        if address == BROADCAST:
            raise InvalidCommand("nobody answers a read that goes to all: read one unit at a time")
        body = struct.pack(">BBHH", address, READ, self.first, self.count)
        size = 2 * self.count
        return Conversation(
            body, bytes((address, READ, size)), size, timings.read, struct.Struct(f">{self.count}H").unpack
        )


@dataclass(frozen=True, slots=True)
class WriteRegisters:
    """Write `values`, 0 to 65535 each, to the holding registers from `first` on."""

    first: int
    values: tuple[int, ...]
    idempotent: bool = False

    writes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "values", tuple(self.values))
        _check_span(self.first, len(self.values), LONGEST_WRITE)
        for value in self.values:
            whole_number(value, 0, HIGHEST, "a register's value")

    def __str__(self) -> str:
        return f"write {_span(self.first, len(self.values))} = {', '.join(map(str, self.values))}"

    def open(self, address: int, timings: Timings) -> Conversation[None]:
        count = len(self.values)
        if count == 1:
            body = header = struct.pack(">BBHH", address, WRITE_ONE, self.first, self.values[0])
        else:
            header = struct.pack(">BBHH", address, WRITE_MANY, self.first, count)
            body = header + struct.pack(f">B{count}H", 2 * count, *self.values)
        return Conversation(body, header, 0, timings.write, _nothing)


def _nothing(_: bytes) -> None:
    return None


def _check_span(first: int, count: int, longest: int) -> None:
    whole_number(first, 0, HIGHEST, "a register's number")
    whole_number(count, 1, longest, "how many registers")
    whole_number(first + count - 1, 0, HIGHEST, "the last register's number")


def _span(first: int, count: int) -> str:
    return f"register {first}" if count == 1 else f"registers {first}-{first + count - 1}"


PROFILE = Profile(
    name="modbus",
    title="Modbus RTU",
    addresses=range(1, 248),
    line=LineSettings(19200, parity="E"),
    timings=Timings.uniform(ReplyTiming(nominal=0.05, window=0.2, lateness=0.4, byte_gap=0.02, turnaround=SILENCE)),
    probe=ReadRegisters(0),
    broadcast=BROADCAST,
)


class ModbusUnit(Handle):
    """A unit's holding registers. An item is a register's number, "100", or a run of them, "100:4"."""

    profile = PROFILE

    def point(self, item: str) -> Point[Any]:
        first, colon, count = item.partition(":")
        if not first.isdigit() or (colon and not count.isdigit()):
            raise InvalidCommand(f"no such item {item!r}: use a register's number as 100, or a run of them as 100:4")
        if colon:
            return self._point(item, int(first), int(count), tuple, lambda values: values)
        return self._point(item, int(first), 1, lambda values: values[0], lambda value: (value,))

    def _point(
        self,
        item: str,
        first: int,
        count: int,
        decode: Callable[[tuple[int, ...]], Any],
        encode: Callable[[Any], tuple[int, ...]],
    ) -> Point[Any]:
        return Point(
            self.node,
            item,
            ReadRegisters(first, count),
            decode=decode,
            encode=lambda value: WriteRegisters(first, encode(value)),
        )

    async def read(self, first: int, count: int = 1, *, priority: Priority | None = None) -> tuple[int, ...]:
        """Raises Refused for registers that the unit does not have."""
        return await self.node.request(ReadRegisters(first, count), priority=priority)

    async def write(self, first: int, *values: int, priority: Priority | None = None) -> None:
        """Raises WriteUnconfirmed if the answer never came: the unit may or may not have taken it."""
        await self.node.request(WriteRegisters(first, values), priority=priority)


class EmulatedUnit(Device):
    """A unit on the emulated line, written apart from the exchange above: registers 0 to `len(registers)` - 1."""

    def __init__(self, address: int, registers: Sequence[int] = (0,) * 100, *, delay: Delay | None = None) -> None:
        super().__init__(address, delay=delay)
        self.registers = list(registers)
        self.routes = (bytes((address,)), bytes((BROADCAST,)))
        self._frame = b""
        self._heard_until = 0.0

    def hear_byte(self, byte: int, now: float) -> None:
        """A frame begins after a silence, or where one to this unit ended. What is for others is let pass."""
        if self._pause_before(now - self.tau):
            self._frame = b""
        self._heard_until = now
        self._frame += bytes((byte,))
        self.attentive = self._frame[0] in (self.address, BROADCAST)
        if not self.attentive:
            self._frame = self._frame[:1]
        elif len(self._frame) == _length(self._frame):
            frame, self._frame, self.attentive = self._frame, b"", False
            self._obey(frame, now)

    def take(self, frame: bytes, now: float) -> bool:
        if (self._frame and not self._pause_before(now - len(frame) * self.tau)) or len(frame) != _length(frame):
            return False
        self._frame = b""
        self._heard_until = now
        self._obey(frame, now)
        return True

    def restart(self, now: float) -> None:
        super().restart(now)
        self._frame = b""

    def _pause_before(self, start: float) -> bool:
        return start - self._heard_until > max(3.5 * self.tau, SILENCE)

    def _obey(self, frame: bytes, now: float) -> None:
        if with_crc(frame[:-2]) != frame:
            return
        unit, function, first, count = struct.unpack(">BBHH", frame[:6])
        if function == WRITE_ONE:
            answer = self._write(first, (count,), frame[:6])
        elif function == WRITE_MANY:
            answer = self._write(first, struct.unpack(f">{frame[6] // 2}H", frame[7:-2]), frame[:6])
        elif function == READ and count > 0 and first + count <= len(self.registers):
            values = self.registers[first : first + count]
            answer = struct.pack(f">BBB{count}H", unit, function, 2 * count, *values)
        else:
            answer = bytes((unit, function | REFUSED, 2 if function == READ else 1))
        if unit != BROADCAST:
            self.reply(with_crc(answer), now)

    def _write(self, first: int, values: Sequence[int], answer: bytes) -> bytes:
        if first + len(values) > len(self.registers):
            return bytes((answer[0], answer[1] | REFUSED, 2))
        self.registers[first : first + len(values)] = values
        return answer


def _length(frame: bytes) -> int:
    """Of the request that begins like this, as far as that can be told."""
    if frame[1:2] != bytes((WRITE_MANY,)):
        return 8
    return 9 + frame[6] if len(frame) > 6 else 9


async def main() -> None:
    line = Line(PROFILE.line, [EmulatedUnit(17, range(100)), EmulatedUnit(18)])
    async with Bus(MemoryPort(line)) as bus:
        press, oven = ModbusUnit(bus, 17), ModbusUnit(bus, 18)
        print("press:", await press.read(7, 3))
        await oven.write(40, 215, 220)
        print("oven:", await oven.point("40:2").read())
        group = bus.poll_group("temperatures", period=0.1, points=[oven.point("40"), press.point("7")])
        async for snapshot in group:
            print({point.key: sample.value for point, sample in snapshot.items()})
            break
        try:
            await press.read(2000)
        except Refused as refusal:
            print(refusal)


if __name__ == "__main__":
    asyncio.run(main())
