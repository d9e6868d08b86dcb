"""The three character protocols as a listener hears them: HCP, HCP2 and Mentor II (PROTOCOLS 2 to 4)."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from busmaster.capture.frames import UNASKED, Frame, Kind
from busmaster.capture.pcapng import Direction
from busmaster.wire.characters import made_of
from busmaster.wire.checks import bcc, xor

STX, ETX, EOT, ENQ, ACK, BEL, BS, NAK = 0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x08, 0x15
_SPACE = 0x20
_LONGEST_FIELD = 90
"""Far more than any telegram may hold (60), so that one too long is still seen whole."""
_ANSWERS = {ACK: Kind.ACK, NAK: Kind.NAK, EOT: Kind.EOT}


def field_end(data: bytes, start: int) -> int:
    """Where the printable characters from `start` end: at a control character, or at the end of what is there."""
    for position in range(start, len(data)):
        if data[position] < _SPACE:
            return position
    return len(data)


def closed_size(data: bytes, start: int) -> int:
    """`Dialect.size` of a telegram whose data begin at `start` and are closed by ETX and a checksum."""
    end = field_end(data, start)
    if end - start > _LONGEST_FIELD:
        return -start - _LONGEST_FIELD
    if end < len(data) and data[end] != ETX:
        return -end
    return end + 2 if end + 2 <= len(data) else 0


def checked(raw: bytes, start: int, check: Callable[[bytes], int]) -> str:
    """What is wrong with the checksum, the last byte, of what is before it from `start` on; empty if it is right."""
    right = check(raw[start:-1])
    return "" if raw[-1] == right else f"bad checksum {raw[-1]:02X}, not {right:02X}"


def characters(field: bytes) -> str:
    return field.decode("ascii", "backslashreplace")


def came_back(raw: bytes) -> Frame:
    """A whole request that was received by the host: an echo that nobody declared, or that differs."""
    return Frame(Kind.NOISE, Direction.NODE, raw, fault="a request, received")


class CommsDialect:
    """What HCP and HCP2 share: a reset byte, the node as two characters, the element as two characters."""

    starts: bytes
    reset: ClassVar[int]
    checked_read: ClassVar[int]
    """Checksum bytes of a read request."""

    def __init__(self) -> None:
        self.starts = bytes((self.reset, STX))
        self._asked: Frame | None = None

    def node(self, field: bytes) -> int | None:
        raise NotImplementedError

    def element(self, field: bytes) -> str:
        """As a decimal number, or as it stands, quoted, if it is none."""
        raise NotImplementedError

    def request_fault(self, raw: bytes) -> str:
        raise NotImplementedError

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        if data[0] in (ACK, NAK):
            size = 1
        elif data[0] == STX:
            end = field_end(data, 1)
            size = -end if end < min(3, len(data)) else closed_size(data, 3)
        elif data[0] == self.reset:
            size = self._request_size(data)
        else:
            size = -1
        return size or (-len(data) if quiet else 0)

    def _request_size(self, data: bytes) -> int:
        end = field_end(data, 1)
        if end == len(data) < 4:
            return 0
        if end != 3 or data[3] != STX:
            return -end
        end = field_end(data, 4)
        if end < min(6, len(data)):
            return -end
        if len(data) > 6 and data[6] == ENQ:
            size = 7 + self.checked_read
            return size if len(data) >= size else 0
        return closed_size(data, 6)

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        if raw[0] != self.reset:
            return self._reply(raw)
        return came_back(raw) if sender is Direction.NODE else self._request(raw)

    def _request(self, raw: bytes) -> Frame:
        kind = Kind.READ if raw[6] == ENQ else Kind.WRITE
        value = "" if kind is Kind.READ else characters(raw[6:-2])
        node, item, fault = self.node(raw[1:3]), self.element(raw[4:6]), self.request_fault(raw)
        if node is None:
            fault = f"no node address: {characters(raw[1:3])!r}"
        frame = Frame(kind, Direction.HOST, raw, node, kind.value, item, value, fault)
        self._asked = frame
        return frame

    def _reply(self, raw: bytes) -> Frame:
        asked, self._asked = self._asked, None
        node = asked.node if asked else None
        fault = "" if asked else UNASKED
        if raw[0] != STX:
            if asked and asked.kind is Kind.READ and raw[0] == ACK:
                fault = "an ACK answers no read"
            return Frame(_ANSWERS[raw[0]], Direction.NODE, raw, node, fault=fault, answers=asked is not None)
        item, value = self.element(raw[1:3]), characters(raw[3:-2])
        if asked and asked.kind is Kind.WRITE:
            fault = "a value answers no write"
        elif asked and asked.item != item:
            fault = f"wrong element: {asked.item} was asked"
        fault = checked(raw, 1, xor) or fault
        return Frame(Kind.VALUE, Direction.NODE, raw, node, "", item, value, fault, asked is not None)


def number(field: bytes, base: int, digits: bytes) -> int | None:
    """The number that these characters spell, or None if one is none of `digits` (a table of `made_of`)."""
    return int(field, base) if field.translate(digits) == field else None


_DECIMAL = made_of(b"0123456789")
_HEXADECIMAL = made_of(b"0123456789ABCDEF")


class HcpDialect(CommsDialect):
    """AN00110: EOT n n STX d d ..., a read without a checksum, a write's from after STX on."""

    reset = EOT
    checked_read = 0

    def node(self, field: bytes) -> int | None:
        return number(field[:1], 16, _HEXADECIMAL) if field[0] == field[1] else None

    def element(self, field: bytes) -> str:
        element = number(field, 10, _DECIMAL)
        return repr(characters(field)) if element is None else str(element)

    def request_fault(self, raw: bytes) -> str:
        return "" if raw[6] == ENQ else checked(raw, 4, xor)


class Hcp2Dialect(CommsDialect):
    """AN00129: BEL h h STX e e ..., every request's checksum from after BEL on."""

    reset = BEL
    checked_read = 1

    def node(self, field: bytes) -> int | None:
        return number(field, 16, _HEXADECIMAL)

    def element(self, field: bytes) -> str:
        element = number(field, 16, _HEXADECIMAL)
        return repr(characters(field)) if element is None else str(element)

    def request_fault(self, raw: bytes) -> str:
        return checked(raw, 1, xor)


class MentorDialect:
    """CT-ANSI: EOT a a a a m m p p ENQ, EOT a a a a STX m m p p ..., and NAK, ACK, BS for again, next, previous.

    Bit 7 is parity, or nothing: it is not looked at. ACK and NAK are the drive's while something is asked, and the
    host's short commands after a read that was answered (PROTOCOLS 4.1).
    """

    starts = bytes((EOT, STX))

    def __init__(self) -> None:
        self._asked: Frame | None = None
        self._armed: Frame | None = None
        """The last read that was answered: what a short command refers to."""

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
        """A request; or alone, while something is asked, "no such parameter"."""
        alone = data[1] < _SPACE if len(data) > 1 else quiet or sender is Direction.NODE
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
        node = number(digits[::2], 10, _DECIMAL) if doubled else None
        fault = "" if node is not None else f"no drive address: {characters(digits)!r}"
        if data[5] == STX:
            fault = checked(data, 6, bcc) or fault
            value = characters(data[10:-2])
            frame = Frame(Kind.WRITE, Direction.HOST, data, node, "write", _parameter(data[6:10]), value, fault)
        else:
            frame = Frame(Kind.READ, Direction.HOST, data, node, "read", _parameter(data[5:9]), fault=fault)
        self._armed = None
        self._asked = None if node == 0 else frame
        return frame

    def _rewrite(self, data: bytes) -> Frame:
        """A write without an address, which newer drives take."""
        frame = Frame(Kind.WRITE, Direction.HOST, data, None, "write", _parameter(data[1:5]), characters(data[5:-2]))
        frame.fault = checked(data, 1, bcc)
        if self._armed:
            frame.node = self._armed.node
        self._asked = frame
        return frame

    def _short(self, byte: int) -> Frame:
        step, command = {NAK: (0, "again"), ACK: (1, "next"), BS: (-1, "previous")}[byte]
        frame = Frame(Kind.READ, Direction.HOST, bytes((byte,)), command=command)
        if self._armed is None:
            frame.fault = UNASKED
            return frame
        menu, _, parameter = self._armed.item.partition(".")
        frame.node = self._armed.node
        frame.item = f"{menu}.{int(parameter) + step:02d}" if parameter.isdecimal() else ""
        self._asked = frame
        return frame

    def _reply(self, data: bytes) -> Frame:
        asked, self._asked = self._asked, None
        frame = Frame(_ANSWERS.get(data[0], Kind.VALUE), Direction.NODE, data, answers=asked is not None)
        frame.node = asked.node if asked else None
        frame.fault = "" if asked else UNASKED
        reading = asked is not None and asked.kind is Kind.READ
        if data[0] == STX:
            frame.item, frame.value = _parameter(data[1:5]), characters(data[5:-2])
            if asked and not reading:
                frame.fault = "a value answers no write"
            elif asked and asked.item != frame.item:
                frame.fault = f"wrong parameter: {asked.item} was asked"
            frame.fault = checked(data, 1, bcc) or frame.fault
        elif data[0] == ACK and reading:
            frame.fault = "an ACK answers no read"
        if reading and data[0] != ACK:
            self._armed = asked
        return frame


def _parameter(digits: bytes) -> str:
    if digits.translate(_DECIMAL) != digits:
        return repr(characters(digits))
    return f"{characters(digits[:2])}.{characters(digits[2:])}"


def _plain(data: bytes) -> bytes:
    return data if data.isascii() else bytes(byte & 0x7F for byte in data)
