"""Capture files: writes and reads the few pcapng blocks that a serial line needs.

Each packet is one frame on the line. A header of twelve bytes precedes its bytes and contains what an anonymous reply
does not; numbers are big-endian:

    0      version of this header, 2
    1      the protocol's capture id, 0 if it has none
    2      direction: 0 unknown, 1 from a node, 2 from the host (the codes of the packet's own flags option)
    3      outcome of the exchange, see `Outcome`; in the last packet from the node, 0 in the others
    4-5    node; FFFF if unknown or the protocol has none
    6-9    number of the frame's request, from 1 in the order in which they began (each cycle of a poll is a new
           one); 0 if it belongs to none or is not known (a line that was only listened to)
    10     number of the attempt at that request, from 1; 0 as above
    11     1 if the frame arrived in one piece with the end of the previous one, else 0

Version 1 ends before byte 6. The protocol's name is the description of the packet's interface: a file has an interface
for each protocol on the line, all with the name of the port. The oldest files have one interface without a description;
there the id determines the protocol.

A packet's first comment is the result of the exchange, or the reason for the request. Further comments are notes,
"late" or "cancelled". An exchange without a reply ends in a packet with only the header. Times are whole microseconds
since 1970.

The link type is `LINK_TYPE`, one of those reserved for private use.
"""

from __future__ import annotations

import enum
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple, Protocol

from busmaster.contract.frames import Direction
from busmaster.registry import find, kinds

LINK_TYPE = 157
"""LINKTYPE_USER10: private, and not the first one, which other dissectors often use."""
HEADER_VERSION = 2
NO_NODE = 0xFFFF

_HEADERS = {1: struct.Struct(">BBBBH"), HEADER_VERSION: struct.Struct(">BBBBHIBB")}
_SECTION, _INTERFACE, _PACKET, _STATISTICS = 0x0A0D0D0A, 1, 6, 5
_BYTE_ORDER = 0x1A2B3C4D
_COMMENT, _FLAGS, _DROPPED = 1, 2, 4
_APPLICATION, _NAME, _DESCRIPTION, _RESOLUTION, _IF_DROPPED = 4, 2, 3, 9, 5
_MICROSECONDS = 6
_LONGEST_BLOCK = 1 << 20


class CaptureError(ValueError):
    """The file is not a capture, or not one of busmaster."""


class CutOff(CaptureError):
    """The file ends within a block, for example because the recorder was killed or the disk was full."""


class Outcome(enum.IntEnum):
    """How an exchange ended, or that a frame belongs to none (UNEXPECTED). Only a master uses the values from AMBIGUOUS
    on."""

    NONE = 0
    OK = 1
    NO_REPLY = 2
    GARBLED = 3
    REFUSED = 4
    UNEXPECTED = 5
    AMBIGUOUS = 6
    """A correct reply was not delivered, because it could belong to another request."""
    SPOILT = 7
    """The bytes were not parsed: damaged according to the port, too early, or with a wrong echo."""
    CUT_OFF = 8
    """The line was lost."""


@dataclass(slots=True)
class Packet:
    """One frame in a capture. `micros`: microseconds since 1970."""

    micros: int
    protocol: str
    direction: Direction
    frame: bytes
    node: int | None = None
    outcome: Outcome = Outcome.NONE
    comment: str = ""
    dropped: int = 0
    """Events lost by the recorder before this packet."""
    notes: tuple[str, ...] = ()
    """Notes in addition to the comment."""
    transaction: int = 0
    attempt: int = 0
    """Request of the master, and attempt at it; 0 if not known."""
    joined: bool = False
    """It arrived in one piece with the end of the previous frame."""


class Writable(Protocol):
    """An object that bytes can be written to."""

    def write(self, data: bytes, /) -> int: ...


class PcapngWriter:
    """Writes packets to a binary file, which it does not own. The file header is written immediately."""

    def __init__(self, file: Writable, *, port: str = "") -> None:
        self._file = file
        self._port = port
        self._interfaces: dict[str, int] = {}
        self._write(_SECTION, struct.pack("<IHHq", _BYTE_ORDER, 1, 0, -1) + _options((_APPLICATION, b"busmaster")))
        self._interface_of("")  # the statistics at the end refer to interface 0, also in a capture without packets

    def write(self, packet: Packet) -> None:
        """Write one packet."""
        interface = self._interface_of(packet.protocol)
        node = NO_NODE if packet.node is None else packet.node
        capture_id = find(packet.protocol).capture_id if packet.protocol else 0
        head = (HEADER_VERSION, capture_id, packet.direction, packet.outcome, node)
        of = (packet.transaction & 0xFFFFFFFF, min(packet.attempt, 0xFF), packet.joined)
        data = _HEADERS[HEADER_VERSION].pack(*head, *of) + packet.frame
        comments = (packet.comment, *packet.notes) if packet.notes or packet.comment else ()
        options = _options(
            *((_COMMENT, comment.encode()) for comment in comments),
            (_FLAGS, struct.pack("<I", packet.direction) if packet.direction else None),
            (_DROPPED, struct.pack("<Q", packet.dropped) if packet.dropped else None),
        )
        fixed = struct.pack("<IIIII", interface, packet.micros >> 32, packet.micros & 0xFFFFFFFF, len(data), len(data))
        self._write(_PACKET, fixed + _padded(data) + options)

    def finish(self, micros: int, dropped: int) -> None:
        """Write the closing statistics: number of lost events, at `micros` since 1970."""
        fixed = struct.pack("<III", 0, micros >> 32, micros & 0xFFFFFFFF)
        self._write(_STATISTICS, fixed + _options((_IF_DROPPED, struct.pack("<Q", dropped))))

    def _interface_of(self, protocol: str) -> int:
        """Return the number of a protocol's interface, which is written before its first packet."""
        if protocol not in self._interfaces:
            self._interfaces[protocol] = len(self._interfaces)
            options = _options(
                (_NAME, self._port.encode() or None),
                (_DESCRIPTION, protocol.encode() or None),
                (_RESOLUTION, bytes([_MICROSECONDS])),
            )
            self._write(_INTERFACE, struct.pack("<HHI", LINK_TYPE, 0, 0) + options)
        return self._interfaces[protocol]

    def _write(self, kind: int, body: bytes) -> None:
        length = len(body) + 12
        self._file.write(struct.pack("<II", kind, length) + body + struct.pack("<I", length))


def read_packets(file: BinaryIO) -> Iterator[Packet]:
    """Yield the packets of a busmaster capture, in order.

    Raises CaptureError for any other file, and CutOff, after all complete packets, for one that ends within a block.
    """
    interfaces: list[_Interface] = []
    for kind, body, order in _blocks(file):
        try:
            packet = _take_block(kind, body, order, interfaces)
        except (struct.error, IndexError) as error:
            raise CaptureError("a block is too short for its content: the file is damaged") from error
        if packet is not None:
            yield packet


def _take_block(kind: int, body: bytes, order: str, interfaces: list[_Interface]) -> Packet | None:
    """Store an interface, or return the packet of a block."""
    if kind == _SECTION:
        interfaces.clear()
    elif kind == _INTERFACE:
        interfaces.append(_interface(body, order))
    elif kind == _PACKET:
        number, high, low, size, _ = struct.unpack_from(f"{order}IIIII", body)
        if number >= len(interfaces) or interfaces[number].link_type != LINK_TYPE:
            raise CaptureError(f"not a capture of a serial line: no link type {LINK_TYPE}")
        interface = interfaces[number]
        micros = ((high << 32) | low) * 1_000_000 // interface.ticks
        options = list(_read_options(body[20 + size + -size % 4 :], order))
        return _packet(micros, interface.protocol, body[20 : 20 + size], options, order)
    return None


class _Interface(NamedTuple):
    """An interface. `ticks`: timestamp units per second. `protocol`: the interface description, "" in older files."""

    link_type: int
    ticks: int
    protocol: str


def _interface(body: bytes, order: str) -> _Interface:
    options = dict(_read_options(body[8:], order))
    resolution = options.get(_RESOLUTION, bytes([_MICROSECONDS]))[0]
    return _Interface(
        struct.unpack_from(f"{order}H", body)[0],
        2 ** (resolution & 0x7F) if resolution & 0x80 else 10**resolution,
        options.get(_DESCRIPTION, b"").decode(errors="replace"),
    )


def _packet(micros: int, protocol: str, data: bytes, options: list[tuple[int, bytes]], order: str) -> Packet:
    header = _HEADERS.get(data[0]) if data else None
    if header is None or len(data) < header.size:
        raise CaptureError("a packet without our header, or of a later version")
    # headers of older versions are shorter: they have no request numbers
    _, capture_id, direction, outcome, node, transaction, attempt, joined = (*header.unpack_from(data), 0, 0, 0)[:8]
    comment, *notes = [value.decode(errors="replace") for code, value in options if code == _COMMENT] or [""]
    dropped = dict(options).get(_DROPPED)
    try:
        return Packet(
            micros,
            protocol or _by_id()[capture_id],
            Direction(direction),
            data[header.size :],
            None if node == NO_NODE else node,
            Outcome(outcome),
            comment,
            0 if dropped is None else struct.unpack(f"{order}Q", dropped)[0],
            tuple(notes),
            transaction,
            attempt,
            bool(joined),
        )
    except (KeyError, ValueError) as error:
        raise CaptureError(f"a packet with a header that means nothing: {data[: header.size].hex(' ')}") from error


def _by_id() -> dict[int, str]:
    """Return the protocols of older files, by id."""
    return {0: "", **{kind.capture_id: kind.name for kind in kinds().values() if kind.capture_id}}


def _blocks(file: BinaryIO) -> Iterator[tuple[int, bytes, str]]:
    """Yield kind, body and byte order ("<" or ">") of each block."""
    order = "<"
    first = True
    while head := file.read(8):
        if len(head) < 8 or (first and head[:4] != struct.pack("<I", _SECTION)):
            raise CaptureError("not a pcapng file") if first else CutOff("the file is cut in mid-block")
        if not any(head[4:]):
            raise CutOff("the file is cut in mid-block")  # a loss of power may leave zeros
        mark = b""
        if head[:4] == struct.pack("<I", _SECTION):
            mark = file.read(4)
            order = "<" if mark == struct.pack("<I", _BYTE_ORDER) else ">"
        kind, length = struct.unpack(f"{order}II", head)
        if length < 12 + len(mark) or length % 4 or length > _LONGEST_BLOCK:
            raise CaptureError(f"a block of {length} bytes: the file is damaged")
        rest = mark + file.read(length - 8 - len(mark))
        if len(rest) != length - 8 or rest[-4:] != head[4:]:  # zeros after the end of the data may complete the length
            raise CutOff("the file is cut in mid-block")
        first = False
        yield kind, rest[:-4], order
    if first:
        raise CaptureError("the file is empty")


def _padded(data: bytes) -> bytes:
    return data + bytes(-len(data) % 4)


def _options(*options: tuple[int, bytes | None]) -> bytes:
    """Return the options that are not None and the end marker; nothing if all are None."""
    given = ((code, value) for code, value in options if value is not None)
    coded = b"".join(struct.pack("<HH", code, len(value)) + _padded(value) for code, value in given)
    return coded + bytes(4) if coded else b""


def _read_options(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    at = 0
    while at + 4 <= len(data):
        code, length = struct.unpack_from(f"{order}HH", data, at)
        if code == 0:
            return
        yield code, data[at + 4 : at + 4 + length]
        at += 4 + length + -length % 4
