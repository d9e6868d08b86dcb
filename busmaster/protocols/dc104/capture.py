"""Reads captures of DC104."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from busmaster.contract.exchange import Command
from busmaster.contract.frames import UNEXPECTED, Direction, Frame, Kind
from busmaster.protocols.dc104.codec import Read, Write
from busmaster.wire.checks import sum8

STX, ACK, NAK = 0x02, 0x06, 0x15


class Dc104Dialect:
    """STX AA parameter check; STX 55 parameter high low check; STX parameter high low check.

    Only the host's packets contain their direction, and a reply for parameter 170 or 85 looks like one of them. Then
    the last request and the checksum decide.
    """

    starts = bytes((STX,))
    _READ, _WRITE = 0xAA, 0x55

    def __init__(self) -> None:
        self._asked: Frame | None = None

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        if data[0] in (ACK, NAK):
            return 1
        if data[0] != STX:
            return -1
        rest = -len(data) if quiet else 0
        if len(data) < 2:
            return rest
        size = self._reply_or_request(data, sender, quiet)
        return size if len(data) >= size else rest

    def _reply_or_request(self, data: bytes, sender: Direction, quiet: bool) -> int:
        request = {self._READ: 4, self._WRITE: 6}.get(data[1])
        if request is None or sender is Direction.NODE:
            return 5
        asked = self._asked
        ambiguous = sender is Direction.UNKNOWN and asked and asked.kind is Kind.READ and asked.item == str(data[1])
        if ambiguous and len(data) < 5 and not quiet:
            return 5
        return 5 if ambiguous and len(data) >= 5 and data[4] == sum8(data[1:4]) else request

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        if len(raw) in (4, 6):
            return self._request(raw)
        asked, self._asked = self._asked, None
        if len(raw) == 1:
            frame = Frame(Kind.ACK if raw[0] == ACK else Kind.NAK, Direction.NODE, raw)
            if asked and asked.kind is Kind.READ and frame.kind is Kind.ACK:
                frame.fault = "an ACK is not a reply to a read"
        else:
            item, value = str(raw[1]), str(int.from_bytes(raw[2:4], "big"))
            frame = Frame(Kind.VALUE, Direction.NODE, raw, item=item, value=value)
            if asked and asked.kind is Kind.WRITE:
                frame.fault = "a value is not a reply to a write"
            elif asked and asked.item != item:
                frame.fault = f"wrong parameter: {asked.item} was requested"
        frame.answers = asked is not None
        frame.fault = (_summed(raw) if len(raw) > 1 else "") or frame.fault or ("" if asked else UNEXPECTED)
        return frame

    def _request(self, raw: bytes) -> Frame:
        kind = Kind.READ if raw[1] == self._READ else Kind.WRITE
        value = "" if kind is Kind.READ else str(int.from_bytes(raw[3:5], "big"))
        frame = Frame(kind, Direction.HOST, raw, None, kind.value, str(raw[2]), value, _summed(raw))
        self._asked = frame
        return frame

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        if request.kind is Kind.READ:
            return Read(int(request.item), minimum=0)
        return Write(int(request.item), int(request.value), minimum=0)


def _summed(raw: bytes) -> str:
    right = sum8(raw[1:-1])
    return "" if raw[-1] == right else f"bad checksum {raw[-1]:02X}, not {right:02X}"
