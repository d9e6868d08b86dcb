"""Reads captures of EI-Bisynch."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from busmaster.capture.telegrams import (
    ACK,
    ANSWERS,
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
from busmaster.errors import InvalidCommand
from busmaster.protocols.ei_bisynch.codec import Read, ReadRun, Write
from busmaster.wire.checks import bcc, xor

_SEVEN_BITS = bytes(byte & 0x7F for byte in range(256))
_TEXT_AT = 5
_WITH_CHANNEL = re.compile(r"\d(?:[A-Za-z][A-Za-z]|[G-Zg-z].)", re.ASCII)
"""A channel and a mnemonic before data. A digit and a hexadecimal digit may also be a parameter number."""


class BisynchDialect:
    """EOT g g u u name ENQ, EOT g g u u STX name data ETX BCC, and ACK and NAK for next and again.

    Bit 7 is parity or unused, and ignored. ACK and NAK are the instrument's while a request is open, and the host's
    after the reply to a read. 32 may be added to a BCC below 32.
    """

    starts = bytes((EOT, STX))

    def __init__(self) -> None:
        self._asked: Frame | None = None
        self._armed: Frame | None = None
        """The last read with a reply, to which a short command refers."""

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        data = data.translate(_SEVEN_BITS)
        if data[0] in (ACK, NAK):
            size = 1
        elif data[0] == STX:
            end = field_end(data, 1)
            size = -end if end < min(3, len(data)) else closed_size(data, 3)
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
        if end == len(data) and end <= _TEXT_AT + 3:
            return 0
        if end == _TEXT_AT and data[end] == STX:
            start = field_end(data, _TEXT_AT + 1)
            return -start if start < min(_TEXT_AT + 3, len(data)) else closed_size(data, _TEXT_AT + 3)
        if end < len(data) and data[end] == ENQ and end in (_TEXT_AT + 2, _TEXT_AT + 3):
            return end + 1
        return -min(end, _TEXT_AT + 3)

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        data = raw.translate(_SEVEN_BITS)
        if data[0] == EOT and len(data) > 1:
            frame = came_back(data) if sender is Direction.NODE else self._request(data)
        elif data[0] in (ACK, NAK) and self._is_short(sender):
            frame = self._short(data[0])
        else:
            frame = self._reply(data)
        frame.raw = raw
        return frame

    def _is_short(self, sender: Direction) -> bool:
        return sender is Direction.HOST or (
            sender is Direction.UNKNOWN and self._asked is None and self._armed is not None
        )

    def _request(self, data: bytes) -> Frame:
        digits = data[1:_TEXT_AT]
        doubled = digits[0] == digits[1] and digits[2] == digits[3]
        node = number(digits[::2], 10, DECIMAL) if doubled else None
        fault = "" if node is not None else f"no address of an instrument: {characters(digits)!r}"
        if data[_TEXT_AT] == STX:
            name, value = _parts(characters(data[_TEXT_AT + 1 : -2]), "")
            fault = _checked(data, _TEXT_AT + 1) or fault
            frame = Frame(Kind.WRITE, Direction.HOST, data, node, "write", name, value, fault)
        else:
            name = characters(data[_TEXT_AT:-1])
            frame = Frame(Kind.READ, Direction.HOST, data, node, "read", name, fault=fault)
        self._armed = None  # an instrument forgets its last read at any EOT
        self._asked = frame
        return frame

    def _short(self, byte: int) -> Frame:
        again = byte == NAK
        frame = Frame(Kind.READ, Direction.HOST, bytes((byte,)), command="again" if again else "next", continues=True)
        if self._armed is None:
            frame.fault = UNEXPECTED
            return frame
        frame.node = self._armed.node
        frame.item = self._armed.item if again else ""  # the next one is in the instrument's own list
        self._asked = frame
        return frame

    def _reply(self, data: bytes) -> Frame:
        asked, self._asked = self._asked, None
        frame = Frame(ANSWERS.get(data[0], Kind.VALUE), Direction.NODE, data, answers=asked is not None)
        frame.node = asked.node if asked else None
        frame.fault = "" if asked else UNEXPECTED
        reading = asked is not None and asked.kind is Kind.READ
        if data[0] == STX:
            frame.item, frame.value = _parts(characters(data[1:-2]), asked.item if asked else "")
            if asked and not reading:
                frame.fault = "a value is not a reply to a write"
            elif asked and not asked.item:
                asked.item = frame.item
            elif asked and asked.item != frame.item:
                frame.fault = f"wrong parameter: {asked.item} was requested"
            frame.fault = _checked(data, 1) or frame.fault
            if reading:
                self._armed = asked
        elif data[0] == ACK and reading:
            frame.fault = "an ACK is not a reply to a read"
        return frame

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        printable = _adds_32(request.raw.translate(_SEVEN_BITS))
        if request.kind is not Kind.READ:
            return _write(request.item, request.value, printable)
        names = (request.item, *(short.item for short in continued))
        return ReadRun(names) if continued and all(names) else Read(request.item)


def _write(name: str, text: str, printable: bool) -> Write:
    """Return the command that writes this text."""
    if text.startswith(">"):
        value = int(text[1:], 16)
        return Write(name, bool(value) if len(text) == 3 and value < 2 else value, True, printable_check=printable)
    try:
        found = float(text)
    except ValueError:
        raise InvalidCommand(f"{text!r} is not a number") from None
    plain = Write(name, int(found) if found == int(found) else found, printable_check=printable)
    filled = len(text) if len(text) > len(plain.text) and "." in text else 0
    return Write(name, plain.value, width=filled, printable_check=printable)


def _parts(text: str, name: str) -> tuple[str, str]:
    """Return name and data. `name`: the requested name, which shows whether there is a channel."""
    size = len(name) or (3 if _WITH_CHANNEL.match(text) else 2)
    return text[:size], text[size:]


def _checked(data: bytes, start: int) -> str:
    """Return the fault of the BCC. A listener does not know which rule an instrument uses."""
    return "" if data[-1] == bcc(data[start:-1]) else checked(data, start, xor)


def _adds_32(data: bytes) -> bool:
    """Return True if 32 was added to the BCC of a write."""
    return data[0] == EOT and data[_TEXT_AT] == STX and xor(data[_TEXT_AT + 1 : -1]) != data[-1]
