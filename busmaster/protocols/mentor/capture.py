"""Reads captures of CT-ANSI, with the short commands of Mentor II."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from busmaster.capture.telegrams import (
    ACK,
    ANSWERS,
    BS,
    DECIMAL,
    ENQ,
    EOT,
    NAK,
    SPACE,
    STX,
    came_back,
    characters,
    checked,
    closed_size,
    field_end,
    number,
)
from busmaster.contract.exchange import Command
from busmaster.contract.frames import UNEXPECTED, Direction, Frame, Kind
from busmaster.protocols.mentor.codec import Read, ReadRun, Write, parse_parameter
from busmaster.wire.checks import bcc

STEPS = {"again": 0, "next": 1, "previous": -1}
"""The short commands, and their steps."""


class MentorDialect:
    """CT-ANSI: EOT a a a a m m p p ENQ, EOT a a a a STX m m p p ..., and NAK, ACK, BS for again, next, previous.

    Bit 7 is parity or unused, and ignored. ACK and NAK are the drive's while a request is open, and the host's short
    commands after the reply to a read.
    """

    starts = bytes((EOT, STX))
    read: ClassVar[type[Read]] = Read
    read_run: ClassVar[type[ReadRun]] = ReadRun

    def __init__(self) -> None:
        self._asked: Frame | None = None
        self._armed: Frame | None = None
        """The last read with a reply, to which a short command refers."""

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        data = _plain(data)
        if data[0] in (ACK, NAK) or (data[0] == BS and self._is_short(sender)):
            size = 1
        elif data[0] == STX:
            end = field_end(data, 1)
            size = -end if end < min(5, len(data)) else closed_size(data, 5)
        elif data[0] == EOT:
            size = self._after_eot(data, sender, quiet)
        else:
            size = -1
        return size or (-len(data) if quiet else 0)

    def _after_eot(self, data: bytes, sender: Direction, quiet: bool) -> int:
        """Return the size of a request, or of a single EOT ("no such parameter") while a request is open."""
        alone = data[1] < SPACE if len(data) > 1 else quiet or sender is Direction.NODE
        if alone and (sender is Direction.NODE or (sender is Direction.UNKNOWN and self._asked)):
            return 1
        end = field_end(data, 1)
        if end == 9 < len(data) and data[9] == ENQ:
            return 10
        if end != 5:
            return 0 if end == len(data) < 10 else -end
        if len(data) > 5 and data[5] != STX:
            return -5
        end = field_end(data, 6)
        return -end if end < min(10, len(data)) else closed_size(data, 10)

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        data = _plain(raw)
        if data[0] == EOT and len(data) > 1:
            frame = came_back(data) if sender is Direction.NODE else self._request(data)
        elif data[0] in (ACK, NAK, BS) and self._is_short(sender):
            frame = self._short(data[0])
        elif data[0] == STX and sender is Direction.HOST:
            frame = self._rewrite(data)
        else:
            frame = self._reply(data)
        frame.raw = raw
        return frame

    def _is_short(self, sender: Direction) -> bool:
        return sender is Direction.HOST or (
            sender is Direction.UNKNOWN and self._asked is None and self._armed is not None
        )

    def _request(self, data: bytes) -> Frame:
        digits = data[1:5]
        doubled = digits[0] == digits[1] and digits[2] == digits[3]
        node = number(digits[::2], 10, DECIMAL) if doubled else None
        fault = "" if node is not None else f"no drive address: {characters(digits)!r}"
        if data[5] == STX:
            fault = checked(data, 6, bcc) or fault
            value = characters(data[10:-2])
            frame = Frame(Kind.WRITE, Direction.HOST, data, node, "write", _parameter(data[6:10]), value, fault)
        else:
            frame = Frame(Kind.READ, Direction.HOST, data, node, "read", _parameter(data[5:9]), fault=fault)
        self._armed = None  # a drive forgets its last read at any EOT
        self._asked = None if node == 0 else frame
        return frame

    def _rewrite(self, data: bytes) -> Frame:
        """Return the frame of a write without an address, which newer drives accept."""
        frame = Frame(Kind.WRITE, Direction.HOST, data, None, "write", _parameter(data[1:5]), characters(data[5:-2]))
        frame.fault = checked(data, 1, bcc)
        if self._armed:
            frame.node = self._armed.node
        self._asked = frame
        return frame

    def _short(self, byte: int) -> Frame:
        step, command = {NAK: (0, "again"), ACK: (1, "next"), BS: (-1, "previous")}[byte]
        frame = Frame(Kind.READ, Direction.HOST, bytes((byte,)), command=command, continues=True)
        if self._armed is None:
            frame.fault = UNEXPECTED
            return frame
        menu, _, parameter = self._armed.item.partition(".")
        frame.node = self._armed.node
        frame.item = f"{menu}.{int(parameter) + step:02d}" if parameter.isdecimal() else ""
        self._asked = frame
        return frame

    def _reply(self, data: bytes) -> Frame:
        asked, self._asked = self._asked, None
        frame = Frame(ANSWERS.get(data[0], Kind.VALUE), Direction.NODE, data, answers=asked is not None)
        frame.node = asked.node if asked else None
        frame.fault = "" if asked else UNEXPECTED
        reading = asked is not None and asked.kind is Kind.READ
        if data[0] == STX:
            frame.item, frame.value = _parameter(data[1:5]), characters(data[5:-2])
            if asked and not reading:
                frame.fault = "a value is not a reply to a write"
            elif asked and asked.item != frame.item:
                frame.fault = f"wrong parameter: {asked.item} was requested"
            frame.fault = checked(data, 1, bcc) or frame.fault
        elif data[0] == ACK and reading:
            frame.fault = "an ACK is not a reply to a read"
        if reading and data[0] != ACK:  # also after EOT: short commands start from a missing parameter too
            self._armed = asked
        return frame

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        menu, number = parse_parameter(request.item)
        if request.kind is not Kind.READ:
            return self.write(menu, number, request.value)
        steps = [STEPS[short.command] for short in continued]
        if not steps or len(set(steps)) > 1:
            return self.read(menu, number)
        return self.read_run(menu, number, 1 + len(steps), steps[0])

    def write(self, menu: int, number: int, text: str) -> Command[None]:
        """Return the command for a write in a capture."""
        # Only sign and number of characters show the form, for a drive too.
        signed = text[:1] in ("+", "-")
        value = bool(int(text)) if len(text) == 1 else int(text)
        return Write(menu, number, value, wide=not signed and len(text) == 5, high_resolution=len(text) == 6)


def _parameter(digits: bytes) -> str:
    if digits.translate(DECIMAL) != digits:
        return repr(characters(digits))
    return f"{characters(digits[:2])}.{characters(digits[2:])}"


def _plain(data: bytes) -> bytes:
    return data if data.isascii() else bytes(byte & 0x7F for byte in data)
