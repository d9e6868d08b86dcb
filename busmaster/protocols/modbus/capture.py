"""Reads captures of Modbus RTU. Frames are separated by the lengths that they contain, and verified by their CRC."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

from busmaster.contract.exchange import Command
from busmaster.contract.frames import UNEXPECTED, Direction, Frame, Kind
from busmaster.protocols.modbus.codec import (
    BROADCAST,
    EXCEPTIONS,
    READS,
    REFUSED,
    WRITE_COIL,
    WRITE_COILS,
    WRITE_REGISTER,
    WRITE_REGISTERS,
    ReadBits,
    ReadRegisters,
    WriteCoils,
    WriteRegisters,
    is_sound,
)

TABLES = {function: table for table, function in READS.items()}
SINGLE = {WRITE_COIL: "coil", WRITE_REGISTER: "holding"}
SEVERAL = {WRITE_COILS: "coil", WRITE_REGISTERS: "holding"}
FUNCTIONS = {*TABLES, *SINGLE, *SEVERAL}
HIGHEST_UNIT = 247


class ModbusDialect:
    """A reply has the unit and function of its request, and a frame does not contain its direction.

    After a request, a frame with the same unit and function is its reply, if its CRC is right with a reply's length.
    """

    starts = bytes(range(HIGHEST_UNIT + 1))

    def __init__(self) -> None:
        self._asked: Frame | None = None

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        # By the length in the frame, never by pauses: adapters and networks cause pauses of their own.
        refusing = 0 if sender is Direction.HOST else REFUSED
        if data[0] > HIGHEST_UNIT or (len(data) > 1 and data[1] & ~refusing not in FUNCTIONS):
            return -1
        lengths = self._lengths(data, sender)
        for length in lengths:
            if length <= len(data) and is_sound(data[:length]):
                return length
        if not quiet:
            return 0 if len(data) < max(lengths) else lengths[0]
        return next((length for length in lengths if length <= len(data)), -len(data))

    def _lengths(self, data: bytes, sender: Direction) -> list[int]:
        """Return the possible lengths of the frame, the likelier first.

        A length that is not known yet is longer than `data`.
        """
        reply, request = reply_length(data), request_length(data)
        if sender is Direction.HOST:
            return [request]
        if sender is Direction.NODE or (len(data) > 1 and data[1] & REFUSED):
            return [reply]
        return [reply, request] if self._answers(data) else [request]

    def _answers(self, data: bytes) -> bool:
        """Return True if it may be the reply to the last request."""
        asked = self._asked
        return asked is not None and data[0] == asked.raw[0] and (len(data) < 2 or data[1] & ~REFUSED == asked.raw[1])

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        if sender is Direction.UNKNOWN:
            replies = raw[1] & REFUSED or (self._answers(raw) and len(raw) == reply_length(raw))
            sender = Direction.NODE if replies else Direction.HOST
        frame = self._reply(raw) if sender is Direction.NODE else self._request(raw)
        if not is_sound(raw):
            frame.fault = "bad CRC"
        return frame

    def _request(self, raw: bytes) -> Frame:
        unit, function, first, count = struct.unpack(">BBHH", raw[:6])
        kind, value = Kind.WRITE, ""
        if function in TABLES:
            kind, table = Kind.READ, TABLES[function]
        elif function in SINGLE:
            table, value, count = SINGLE[function], str(count if function == WRITE_REGISTER else int(count > 0)), 1
        else:
            table = SEVERAL[function]
            value = words_text(raw[7:-2]) if function == WRITE_REGISTERS else bits_text(raw[7:-2], count)
        item = f"{table}:{first}" if count == 1 else f"{table}:{first}:{count}"
        frame = Frame(kind, Direction.HOST, raw, unit, kind.value, item, value)
        self._asked = None if unit == BROADCAST else frame  # a write to all has no reply
        return frame

    def _reply(self, raw: bytes) -> Frame:
        asked, self._asked = self._asked, None
        frame = Frame(Kind.ACK, Direction.NODE, raw, raw[0], answers=asked is not None)
        frame.item = asked.item if asked else ""
        if raw[1] & REFUSED:
            frame.kind, frame.command = Kind.NAK, EXCEPTIONS.get(raw[2], f"exception {raw[2]}")
        elif raw[1] in TABLES:
            frame.kind = Kind.VALUE
            data = raw[3:-2]
            frame.value = words_text(data) if raw[1] > READS["discrete"] else bits_text(data, count_of(frame.item))
        if asked is None:
            frame.fault = UNEXPECTED
        elif raw[0] != asked.raw[0] or raw[1] & ~REFUSED != asked.raw[1]:
            frame.fault = f"wrong reply: function {asked.raw[1]} of unit {asked.raw[0]} was requested"
        elif frame.kind is Kind.ACK and raw[2:6] != asked.raw[2:6]:
            frame.fault = "it repeats another write than the requested one"
        elif frame.kind is Kind.VALUE and len(raw) != expected_length(asked.raw):
            frame.fault = f"{raw[2]} bytes of data, not {expected_length(asked.raw) - 5}"
        return frame

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        table, first = request.item.split(":")[:2]
        count = count_of(request.item)
        values = [int(value) for value in request.value.split(",")] if request.value else []
        match request.kind, table:
            case Kind.READ, "coil" | "discrete":
                return ReadBits(int(first), count, table)
            case Kind.READ, _:
                return ReadRegisters(int(first), count, table)
            case _, "coil":
                return WriteCoils(int(first), tuple(value == 1 for value in values))
            case _:
                return WriteRegisters(int(first), tuple(values))


def request_length(data: bytes) -> int:
    """Return the length of the request that begins with `data`; longer than `data` if it is not known yet."""
    if len(data) < 2:
        return len(data) + 1
    if data[1] not in SEVERAL:
        return 8
    return 9 + data[6] if len(data) > 6 else len(data) + 1


def reply_length(data: bytes) -> int:
    """Return the length of the reply that begins with `data`; longer than `data` if it is not known yet."""
    if len(data) < 2:
        return len(data) + 1
    if data[1] & REFUSED:
        return 5
    if data[1] not in TABLES:
        return 8
    return 5 + data[2] if len(data) > 2 else len(data) + 1


def expected_length(request: bytes) -> int:
    """Return the length of the reply to a read request."""
    count = int.from_bytes(request[4:6], "big")
    return 5 + (2 * count if request[1] > READS["discrete"] else (count + 7) // 8)


def count_of(item: str) -> int:
    """Return the number of addresses of an item."""
    _, _, count = item.partition(":")[2].partition(":")
    return int(count or 1)


def words_text(data: bytes) -> str:
    """Return the registers of a data field as decimal numbers between commas."""
    return ",".join(str(word) for word in struct.unpack(f">{len(data) // 2}H", data[: len(data) // 2 * 2]))


def bits_text(data: bytes, count: int) -> str:
    """Return the first `count` bits of a data field as 0 or 1 between commas."""
    states = int.from_bytes(data, "little")
    return ",".join(str(states >> place & 1) for place in range(count))
