"""MSC packets, and what the host and a controller say to each other about them (IB-11A002 rev E).

    packet    STX unit length16 sequence16 body checksum16     big-endian; the sum of all bytes from unit to body

The conversation ("Data transfer sequence"):

    host: request packet   ->  ACK: it arrived whole, and a write is done
                               NAK: send it again, at most three times
    (reads)                    then a packet with the same command name
    host: ACK              ->  done
    host: NAK              ->  the packet again, at most five times

Any byte can stand anywhere in a packet, so a reader counts from STX and never searches. Where the count itself is in
doubt (a damaged header, bytes where none belong) the reader is lost: it swallows what comes until the line pauses for a
inter-byte timeout, and speaks only then. So it never talks into a packet, and never takes a byte from the middle of one
for an ACK.

A reply names its command but no data address. So a packet that comes before the request's ACK is never a reply:
it answers something older; it is ACKed and dropped, and the ACK still awaited. If that packet is said twice, the
host's ACK runs into the second one's STX, and unit 6 follows: the byte of an ACK. So behind a dropped packet an ACK
counts only with a pause (for a write) or a packet (for a read) right behind it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Generic, TypeVar

from busmaster.contract.exchange import (
    MORE,
    Done,
    Expect,
    FrameError,
    LaterStep,
    Need,
    Progress,
    Refused,
    Sizes,
    no_reply,
    other_format,
)
from busmaster.contract.timing import Timings
from busmaster.wire.checks import sum16
from busmaster.wire.readers import ACK, NAK, STX

T = TypeVar("T")

HEADER = 6
FRAMING = 8
LONGEST_BODY = 240
LONGEST_PACKET = LONGEST_BODY + FRAMING
LONGEST_HEARD = 2 * LONGEST_PACKET
"""Bytes of a packet that no controller may say, and whose end is awaited all the same: it is told from noise then."""
UNITS = range(1, 16)

RESENDS = 3  # the manual leaves the number to the host
HOST_NAKS = 5  # a controller sends its packet again five times at most
STALE_PACKETS = 6  # one packet, and the five times that it is sent again


def packet(unit: int, body: bytes) -> bytes:
    """Return `body` as a packet to `unit`. The block sequence number "is not presently used": 0."""
    counted = bytes((unit, 0, len(body), 0, 0)) + body
    return STX + counted + sum16(counted).to_bytes(2, "big")


def packet_size(data: bytes | bytearray) -> int | None:
    """Return the bytes of the packet that `data` begins with.

    It is 0 while that cannot be told, and None if no packet begins so.
    """
    if data[0] != STX[0]:
        return None
    if len(data) < 4:
        return 0
    size = claimed_size(data)
    return size if 0 < size <= LONGEST_PACKET else None


def claimed_size(data: bytes | bytearray) -> int:
    """Return the bytes of a packet whose header `data` begins with, be it longer than any may be; 0 if none does."""
    return int.from_bytes(data[2:4], "big") + FRAMING if data[0] == STX[0] and data[1] in UNITS else 0


def is_sound(whole: bytes) -> bool:
    """Return whether the checksum of a whole packet is right."""
    return sum16(whole[1:-2]) == int.from_bytes(whole[-2:], "big")


@dataclass(frozen=True, slots=True)
class Reply:
    """The packet that answers a read: from `unit`, `name` with its comma, then `payload` bytes.

    Other payloads of at least `shortest` bytes are accepted too, if that is given.
    """

    unit: int
    name: bytes
    payload: int
    shortest: int | None = None

    @property
    def size(self) -> int:
        """Bytes of the whole packet."""
        return FRAMING + len(self.name) + self.payload

    def echoed_by(self, whole: bytes) -> bool:
        """Return whether this packet has the length, the unit and the command name of the reply."""
        payload = len(whole) - FRAMING - len(self.name)
        right_length = payload == self.payload if self.shortest is None else payload >= self.shortest
        return right_length and self.named_by(whole)

    def named_by(self, whole: bytes) -> bool:
        """Return whether this packet has the unit and the command name of the reply, of whatever length it is."""
        return whole[1] == self.unit and whole.startswith(self.name, HEADER)

    @property
    def header(self) -> bytes:
        """What every such packet begins with: unit, length and command name tell it from all other replies."""
        length = len(self.name) + self.payload
        return STX + bytes((self.unit, *length.to_bytes(2, "big"), 0, 0)) + self.name

    def payload_of(self, whole: bytes) -> bytes:
        """Return the payload of a whole packet."""
        return whole[HEADER + len(self.name) : -2]


class PacketExchange(Generic[T]):
    """One request packet on the wire; then its ACK; then, if a `reply` is due, that packet and the host's ACK.

    `decode` makes the value of the reply's payload, or of nothing for a write; it may raise FrameError.
    """

    __slots__ = (
        "_acked",
        "_buffer",
        "_decode",
        "_failure",
        "_lost",
        "_naks",
        "_other",
        "_packet_timing",
        "_reply",
        "_resends",
        "_stale",
        "answers",
        "closing",
        "later",
        "request",
        "timing",
    )
    sizes = Sizes(1, LONGEST_PACKET)
    starts = ACK + NAK + STX
    answered = True

    def __init__(self, request: bytes, timings: Timings, reply: Reply | None, decode: Callable[[bytes], T]) -> None:
        self.request = request
        self.timing = timings.write if reply is None else timings.read
        self.later: Sequence[LaterStep] = (
            () if reply is None else (LaterStep(timings.packet, Sizes(reply.size, LONGEST_PACKET)),)
        )
        self.closing = 0 if reply is None else len(ACK)
        self.answers = (ACK,) if reply is None else (reply.header,)
        self._packet_timing = timings.packet
        self._reply = reply
        self._decode = decode
        self._buffer = bytearray()
        self._acked = self._lost = False
        self._resends = self._naks = self._stale = 0
        self._failure: FrameError | Refused = no_reply()
        self._other: FrameError | None = None

    @property
    def overdue(self) -> tuple[bytes, ...]:
        """An ACK, and the packet behind it."""
        return self.answers if self._acked or self._reply is None else (ACK, *self.answers)

    def feed(self, data: bytes, /) -> Progress[T]:
        buffer = self._buffer
        buffer += data
        if not buffer:
            return MORE
        if self._lost:
            return self._swallow()
        if self._acked and self._reply is None:
            raise FrameError("an ACK within other bytes, behind a packet that answers something else")
        if not self._acked:
            if buffer[0] == ACK[0]:  # ACK and packet may arrive in one piece
                del buffer[0]
                return self._accepted()
            if buffer == NAK:
                buffer.clear()
                return self._resend()
        size = packet_size(buffer)
        if size is None:
            return self._swallow()
        if not size or len(buffer) < size:
            return MORE
        return self._take(bytes(buffer[:size]))

    def expired(self, started: bool, /) -> Expect | Done[T]:
        arrived = len(self._buffer)
        if not self._acked and not arrived:
            raise no_reply()
        if self._acked and self._reply is None:
            return Done(self._decode(b""))
        what = f"the packet was cut short after {arrived} bytes"
        if self._lost:
            what = f"{arrived} bytes that are no packet, the first of them {self._buffer[0]:02x}"
        if not self._acked or (self._lost and self._stale):
            raise FrameError(what, send=ACK)
        if not arrived:
            raise self._other or FrameError("no packet followed the ACK", send=ACK)
        # Fewer bytes than any packet has are none: noise, another unit's NAK, the end of one that was asked for again
        # already. A NAK would have the packet that is still to come said twice, into the next exchange.
        return self._ask_again(FrameError(what, send=ACK), NAK if arrived >= FRAMING else b"")

    def abandon(self) -> FrameError | Refused:
        """Return what to fail the attempt with in place of the last Expect's `send`, which must not have been sent.

        This is for an Expect that would say something again (its `send` is not empty) where the exchange has lasted too
        long or something urgent waits. A FrameError's own `send` leaves the device with nothing unacknowledged.
        """
        return self._failure

    def _accepted(self) -> Progress[T]:
        if self._reply is None and not self._stale:
            return Done(self._decode(b""), rest=bytes(self._buffer))
        self._acked = True
        if self._reply is None:
            return self.feed(b"")  # anything behind it?
        return Expect(self._packet_timing, self.later[0].sizes)

    def _resend(self) -> Expect:
        if self._resends == RESENDS:
            # a NAK for a damaged packet looks like one for a request that cannot be met, which this many confirm
            raise Refused(f"refused {1 + RESENDS} times", confirm=False)
        self._resends += 1
        self._failure = Refused()
        return Expect(self.timing, self.sizes, self.request)

    def _swallow(self) -> Need:
        self._lost = True
        heard = len(self._buffer)
        if heard > LONGEST_PACKET:
            size = claimed_size(self._buffer)
            if heard == size and is_sound(bytes(self._buffer)):
                raise other_format(size, f"{size - FRAMING} bytes of data where {LONGEST_BODY} are the most", send=ACK)
            if not heard < size <= LONGEST_HEARD:
                raise FrameError("more bytes without a pause than any packet has")
        return MORE

    def _take(self, whole: bytes) -> Progress[T]:
        # a packet before the ACK is never the reply, however well it fits: a reply names no data address
        reply = self._reply if self._acked else None
        mine = reply is not None and reply.echoed_by(whole)
        if not is_sound(whole):
            # its length may be what was damaged: where it ends is then not known
            if reply is None or len(whole) != reply.size or len(self._buffer) > len(whole):
                return self._swallow()
            return self._ask_again(FrameError("bad checksum", whole=mine, send=ACK))
        del self._buffer[: len(whole)]
        if reply is not None and mine:
            return Done(self._decode(reply.payload_of(whole)), send=ACK, rest=bytes(self._buffer))
        if whole == self.request:
            raise FrameError("the request came back: if this line echoes, declare echo=True", send=ACK)
        if reply is not None and reply.named_by(whole):  # it may be an earlier one's: then the right one follows
            self._other = other_format(len(whole), f"the packet asked for has {reply.size}", send=ACK)
        return self._drop()

    def _ask_again(self, failure: FrameError, send: bytes = NAK) -> Expect:
        if self._naks == HOST_NAKS:
            raise failure
        self._naks += 1
        self._failure = failure
        self._buffer.clear()
        self._lost = False
        return Expect(self._packet_timing, self.later[0].sizes, send)

    def _drop(self) -> Expect:
        failure = FrameError("a packet that answers something else", send=ACK)
        if self._stale == STALE_PACKETS:
            raise failure
        self._stale += 1
        self._failure = failure
        if self._acked:
            return Expect(self._packet_timing, self.later[0].sizes, ACK)
        return Expect(self.timing, self.sizes, ACK)


class StalePacketListener:
    """Reads what arrives while nothing is asked: a packet whose ACK was lost. It is ACKed and dropped, a bad one too.

    Otherwise the controller would send it again, up to five times, into the exchanges of others. The ACK before it may
    come with it, if both are late. One ACK is for all packets that came together. Ready for the next packet whenever
    one has ended.
    """

    __slots__ = ("_buffer",)

    def __init__(self) -> None:
        self._buffer = b""

    def feed(self, data: bytes, /) -> Need | Done[None]:
        heard = buffer = self._buffer + data
        self._buffer = b""
        if not heard:
            return MORE
        send = b""
        while True:
            buffer = buffer.lstrip(ACK)
            size = packet_size(buffer) if buffer else None
            if not size or len(buffer) < size or not is_sound(buffer[:size]):
                break
            buffer = buffer[size:]
            send = ACK
        if send and not buffer:
            return Done(None, send=send)
        if buffer[:1] != STX or len(buffer) > LONGEST_PACKET:
            raise FrameError(f"{len(heard)} unexpected bytes, the first of them {heard[0]:02x}", send=send)
        self._buffer = buffer
        return MORE

    def expired(self) -> Done[None]:
        self._buffer = b""
        return Done(None, send=ACK)
