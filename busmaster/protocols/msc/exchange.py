"""MSC packets, and the conversation of host and controller about them (IB-11A002 rev E).

    packet    STX unit length16 sequence16 body checksum16     big-endian; the sum of all bytes from unit to body

The conversation ("Data transfer sequence"):

    host: request packet   ->  ACK: it arrived whole, and a write is done
                               NAK: send it again, at most three times
    (reads)                    then a packet with the same command name
    host: ACK              ->  done
    host: NAK              ->  the packet again, at most five times

Any byte can occur anywhere in a packet, so a reader counts from STX and never searches. If the count is uncertain (a
damaged header, unexpected bytes), the reader is lost. It drops all bytes until the line pauses for an inter-byte
timeout, and sends only then. So it never sends into a packet, and never interprets a byte within a packet as an ACK.

A reply contains its command but no data address. So a packet before the request's ACK is never its reply, but belongs
to an older request. It is ACKed and dropped, and the reader still waits for the ACK. If that packet is sent twice, the
host's ACK collides with the second one's STX, and the unit number 6 follows, which is also the byte of an ACK. So after
a dropped packet an ACK counts only with a pause (for a write) or a packet (for a read) directly behind it.
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
"""Longest invalid packet whose end is awaited, so that it can be distinguished from noise."""
UNITS = range(1, 16)

RESENDS = 3  # the host chooses this number, according to the manual
HOST_NAKS = 5  # a controller sends its packet again five times at most
STALE_PACKETS = 6  # one packet, and the five times that it is sent again


def packet(unit: int, body: bytes) -> bytes:
    """Return `body` as a packet to `unit`. The block sequence number "is not presently used": 0."""
    counted = bytes((unit, 0, len(body), 0, 0)) + body
    return STX + counted + sum16(counted).to_bytes(2, "big")


def packet_size(data: bytes | bytearray) -> int | None:
    """Return the length of the packet at the beginning of `data`.

    It is 0 if the length is not known yet, and None if `data` does not begin with a packet.
    """
    if data[0] != STX[0]:
        return None
    if len(data) < 4:
        return 0
    size = claimed_size(data)
    return size if 0 < size <= LONGEST_PACKET else None


def claimed_size(data: bytes | bytearray) -> int:
    """Return the length in the packet header at the beginning of `data`, even if it is too long; 0 if there is none."""
    return int.from_bytes(data[2:4], "big") + FRAMING if data[0] == STX[0] and data[1] in UNITS else 0


def is_sound(whole: bytes) -> bool:
    """Return True if the checksum of a complete packet is right."""
    return sum16(whole[1:-2]) == int.from_bytes(whole[-2:], "big")


@dataclass(frozen=True, slots=True)
class Reply:
    """The reply packet of a read: from `unit`, `name` with its comma, then `payload` bytes.

    If `shortest` is given, other payloads of at least this length are accepted too.
    """

    unit: int
    name: bytes
    payload: int
    shortest: int | None = None

    @property
    def size(self) -> int:
        """Length of the complete packet."""
        return FRAMING + len(self.name) + self.payload

    def echoed_by(self, whole: bytes) -> bool:
        """Return True if this packet has the length, the unit and the command name of the reply."""
        payload = len(whole) - FRAMING - len(self.name)
        right_length = payload == self.payload if self.shortest is None else payload >= self.shortest
        return right_length and self.named_by(whole)

    def named_by(self, whole: bytes) -> bool:
        """Return True if this packet has the unit and the command name of the reply, with any length."""
        return whole[1] == self.unit and whole.startswith(self.name, HEADER)

    @property
    def header(self) -> bytes:
        """Beginning of every such packet. Unit, length and command name distinguish it from all other replies."""
        length = len(self.name) + self.payload
        return STX + bytes((self.unit, *length.to_bytes(2, "big"), 0, 0)) + self.name

    def payload_of(self, whole: bytes) -> bytes:
        """Return the payload of a complete packet."""
        return whole[HEADER + len(self.name) : -2]


class PacketExchange(Generic[T]):
    """One request packet on the wire, then its ACK, then for a read the `reply` packet and the host's ACK.

    `decode` converts the reply's payload to the value (for a write it is empty). It may raise FrameError.
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
        """An ACK, and the packet after it."""
        return self.answers if self._acked or self._reply is None else (ACK, *self.answers)

    def feed(self, data: bytes, /) -> Progress[T]:
        buffer = self._buffer
        buffer += data
        if not buffer:
            return MORE
        if self._lost:
            return self._swallow()
        if self._acked and self._reply is None:
            raise FrameError("an ACK within other bytes, after a packet for another request")
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
            what = f"{arrived} bytes that are not a packet, the first of them {self._buffer[0]:02x}"
        if not self._acked or (self._lost and self._stale):
            raise FrameError(what, send=ACK)
        if not arrived:
            raise self._other or FrameError("no packet followed the ACK", send=ACK)
        # Fewer bytes than any packet has are not a packet, but noise, another unit's NAK, or the end of a packet that
        # was already requested again. A NAK would make the unit send the expected packet twice, into the next exchange
        # (docs/proof.md, 15).
        return self._ask_again(FrameError(what, send=ACK), NAK if arrived >= FRAMING else b"")

    def abandon(self) -> FrameError | Refused:
        """Return the error that fails the attempt instead of the last Expect's `send`, which must not have been sent.

        Used for an Expect that would send again (its `send` is not empty), if the exchange has taken too long or an
        urgent request waits. A FrameError's own `send` leaves the device with nothing unacknowledged.
        """
        return self._failure

    def _accepted(self) -> Progress[T]:
        if self._reply is None and not self._stale:
            return Done(self._decode(b""), rest=bytes(self._buffer))
        self._acked = True
        if self._reply is None:
            return self.feed(b"")  # further bytes in the same chunk
        return Expect(self._packet_timing, self.later[0].sizes)

    def _resend(self) -> Expect:
        if self._resends == RESENDS:
            # The NAK for a damaged packet looks like that for an impossible request, which this many NAKs confirm.
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
        # A packet before the ACK is never the reply, even if it fits: a reply does not contain a data address.
        reply = self._reply if self._acked else None
        mine = reply is not None and reply.echoed_by(whole)
        if not is_sound(whole):
            # Its length field may be damaged: then its end is not known.
            if reply is None or len(whole) != reply.size or len(self._buffer) > len(whole):
                return self._swallow()
            return self._ask_again(FrameError("bad checksum", whole=mine, send=ACK))
        del self._buffer[: len(whole)]
        if reply is not None and mine:
            return Done(self._decode(reply.payload_of(whole)), send=ACK, rest=bytes(self._buffer))
        if whole == self.request:
            raise FrameError("the request came back: if this line echoes, declare echo=True", send=ACK)
        if reply is not None and reply.named_by(whole):  # possibly for an earlier request: then the right one follows
            self._other = other_format(len(whole), f"the requested packet has {reply.size}", send=ACK)
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
        failure = FrameError("a packet for another request", send=ACK)
        if self._stale == STALE_PACKETS:
            raise failure
        self._stale += 1
        self._failure = failure
        if self._acked:
            return Expect(self._packet_timing, self.later[0].sizes, ACK)
        return Expect(self.timing, self.sizes, ACK)


class StalePacketListener:
    """Reads bytes between requests: a packet whose ACK was lost. It is ACKed and dropped, even if it is damaged.

    Otherwise the controller would send it again, up to five times, into other exchanges. The unit's ACK before it may
    arrive with it, if both are late. One ACK is sent for all packets that arrived together. It is ready for the next
    packet when one has ended.
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
