"""Reads captures of HCP and HCP2: the common part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from busmaster.capture.telegrams import (
    ACK,
    ANSWERS,
    ENQ,
    NAK,
    STX,
    came_back,
    characters,
    checked,
    closed_size,
    field_end,
)
from busmaster.contract.exchange import Command
from busmaster.contract.frames import UNEXPECTED, Direction, Frame, Kind
from busmaster.protocols._comms.codec import ReadElement, WriteElements
from busmaster.wire.checks import xor


class CommsDialect:
    """The frames of both: a reset byte, the node as two characters, the element as two characters."""

    starts: bytes
    reset: ClassVar[int]
    checked_read: ClassVar[int]
    """Checksum bytes of a read request."""
    reads: ClassVar[type[ReadElement]]
    writes: ClassVar[type[WriteElements]]

    def __init__(self) -> None:
        self.starts = bytes((self.reset, STX))
        self._asked: Frame | None = None

    def node(self, field: bytes) -> int | None:
        """Return the node in the field of a request, or None if it is not a node."""
        raise NotImplementedError

    def element(self, field: bytes) -> str:
        """Return the element's decimal number, or the field itself, quoted, if it is not an element."""
        raise NotImplementedError

    def request_fault(self, raw: bytes) -> str:
        """Return the fault of a complete request, or an empty text."""
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
        fault = "" if asked else UNEXPECTED
        if raw[0] != STX:
            if asked and asked.kind is Kind.READ and raw[0] == ACK:
                fault = "an ACK is not a reply to a read"
            return Frame(ANSWERS[raw[0]], Direction.NODE, raw, node, fault=fault, answers=asked is not None)
        item, value = self.element(raw[1:3]), characters(raw[3:-2])
        if asked and asked.kind is Kind.WRITE:
            fault = "a value is not a reply to a write"
        elif asked and asked.item != item:
            fault = f"wrong element: {asked.item} was requested"
        fault = checked(raw, 1, xor) or fault
        return Frame(Kind.VALUE, Direction.NODE, raw, node, "", item, value, fault, asked is not None)

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        if request.kind is Kind.READ:
            return self.reads(int(request.item))
        return self.writes(int(request.item), tuple(float(value) for value in request.value.split(",")))
