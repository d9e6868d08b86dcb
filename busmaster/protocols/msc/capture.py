"""Reads captures of MSC."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from busmaster.contract.exchange import Command
from busmaster.contract.frames import UNACKED, UNEXPECTED, Direction, Frame, Kind
from busmaster.protocols.msc import codec
from busmaster.wire.checks import sum16

STX, ACK, NAK = 0x02, 0x06, 0x15
_HEADER = 6
_FRAMING = 8
_LONGEST_BODY = 240
_UNITS = range(1, 16)


class Op(NamedTuple):
    """One MSC command: body lengths of request and reply (0: no reply), and the form of its item."""

    request: int
    reply: int
    item: str


OPS = {
    "DREAD": Op(8, 10, "{}"),
    "DWRITE": Op(13, 0, "{}"),
    "BREAD": Op(8, 134, "{}:32"),
    "BWRITE": Op(137, 0, "{}:32"),
    "CFLAG": Op(8, 0, "flag:{}"),
    "SFLAG": Op(8, 0, "flag:{}"),
    "RFLAG": Op(8, 8, "flag:{}"),
    "RFLAGS": Op(7, 39, "flags"),
    "RQSTAT": Op(7, 15, "status"),
}
_OPEN_ENDED = {"RQSTAT"}
"""The bytes after the status word are "not currently used": replies may have other lengths."""


class MscDialect:
    """Request packet, ACK, reply packet, the host's ACK. The sender of a packet follows from its position in this.

    The length distinguishes a request from a reply for every command except RFLAG; there the conversation does.
    """

    starts = bytes((STX,))

    def __init__(self) -> None:
        self._asked: Frame | None = None
        self._acked = False
        self._answer = b""
        """The reply packet that waits for the host's ACK."""

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        if data[0] in (ACK, NAK):
            return 1
        rest = -len(data) if quiet else 0
        if data[0] != STX or (len(data) > 1 and data[1] not in _UNITS):
            return -1
        if len(data) < 4:
            return rest
        length = int.from_bytes(data[2:4], "big")
        if length > _LONGEST_BODY:
            return -1
        return length + _FRAMING if len(data) >= length + _FRAMING else rest

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        if raw[0] != STX:
            return self._acknowledge(raw, sender)
        name, _, payload = raw[_HEADER:-2].partition(b",")
        command = name.decode("ascii", "backslashreplace")
        if sender is Direction.UNKNOWN:
            sender = self._sender(raw, command)
        frame = Frame(Kind.READ, sender, raw, raw[1], command)
        op = OPS.get(command)
        if op is None:
            frame.fault = f"no command: {command!r}"
        elif sender is Direction.HOST:
            _explain_request(frame, op, payload)
        else:
            frame.item = self._asked.item if self._asked else op.item.format("?")
            frame.value = _value(command, payload)
            if len(raw) - _FRAMING != op.reply and command not in _OPEN_ENDED:
                frame.fault = f"a body of {len(raw) - _FRAMING} bytes, not {op.reply}"
        right, found = sum16(raw[1:-2]), int.from_bytes(raw[-2:], "big")
        if found != right:
            frame.fault = f"bad checksum {found:04X}, not {right:04X}"
        if sender is Direction.HOST:
            self._asked, self._acked, self._answer = frame, False, b""
        else:
            self._replied(frame)
        return frame

    def _sender(self, raw: bytes, command: str) -> Direction:
        op = OPS.get(command)
        length = len(raw) - _FRAMING
        if op is None or op.request == op.reply == length:  # RFLAG's reply is as long as its request
            in_turn = self._answer == raw or (self._asked is not None and self._acked and not self._answer)
            return Direction.NODE if in_turn else Direction.HOST
        as_long = length != op.request if command in _OPEN_ENDED else length == op.reply
        return Direction.NODE if as_long else Direction.HOST

    def _replied(self, frame: Frame) -> None:
        asked = self._asked
        frame.kind = Kind.VALUE
        frame.answers = asked is not None
        if asked is None:
            frame.fault = frame.fault or UNEXPECTED
        elif not self._acked:
            frame.fault = frame.fault or UNACKED
        elif frame.node != asked.node or frame.command != asked.command:
            frame.fault = frame.fault or f"wrong reply: {asked.command} of unit {asked.node} was requested"
        self._answer = frame.raw

    def _acknowledge(self, raw: bytes, sender: Direction) -> Frame:
        if sender is Direction.UNKNOWN:
            sender = Direction.HOST if self._answer else Direction.NODE
        asked = self._asked
        frame = Frame(Kind.ACK if raw[0] == ACK else Kind.NAK, sender, raw, asked.node if asked else None)
        if sender is Direction.HOST:
            frame.fault = "" if self._answer else UNEXPECTED
            self._answer = b""
            if frame.kind is Kind.ACK:
                self._asked = None
        else:
            frame.answers = asked is not None and not self._acked
            frame.fault = "" if frame.answers else UNEXPECTED
            self._acked = frame.kind is Kind.ACK
            if asked and (frame.kind is Kind.NAK or not OPS.get(asked.command, OPS["DWRITE"]).reply):
                self._asked = None
        return frame

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        where = int("".join(filter(str.isdigit, request.item.partition(":")[2 if "flag:" in request.item else 0])) or 0)
        values = [int(value) for value in request.value.split(",")] if request.value else []
        commands: Mapping[str, Callable[[], Command[Any]]] = {
            "DREAD": lambda: codec.DataRead(where),
            "DWRITE": lambda: codec.DataWrite(where, *values),
            "BREAD": lambda: codec.BlockRead(where),
            "BWRITE": lambda: codec.BlockWrite(where, tuple(values)),
            "SFLAG": lambda: codec.SetFlag(where),
            "CFLAG": lambda: codec.ClearFlag(where),
            "RFLAG": lambda: codec.ReadFlag(where),
            "RFLAGS": codec.ReadFlags,
            "RQSTAT": codec.ReadStatus,
        }
        return commands[request.command]()


def _explain_request(frame: Frame, op: Op, payload: bytes) -> None:
    where = int.from_bytes(payload[:2], "big")
    frame.item = op.item.format(where)
    if frame.command in ("SFLAG", "CFLAG"):
        frame.kind, frame.value = Kind.WRITE, str(int(frame.command == "SFLAG"))
    elif not op.reply:
        frame.kind, frame.value = Kind.WRITE, _numbers(payload[2:])
    length = len(frame.raw) - _FRAMING
    if length != op.request:
        frame.fault = f"a body of {length} bytes, not {op.request}"


def _value(command: str, payload: bytes) -> str:
    if command == "RFLAGS":
        return ",".join(str(flag) for flag in range(8 * len(payload)) if payload[flag // 8] >> flag % 8 & 1)
    if command in ("RFLAG", "RQSTAT"):
        return str(int.from_bytes(payload[:2], "big"))
    return _numbers(payload)


def _numbers(payload: bytes) -> str:
    return ",".join(str(number) for number in struct.unpack_from(f">{len(payload) // 4}i", payload))
