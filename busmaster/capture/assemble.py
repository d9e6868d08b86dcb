"""Converts sent and received bytes to the packets of a capture: one per frame, each exchange with its outcome.

The owner of a line knows the exchange of every byte, and how each attempt ended. On a line that is only listened to,
this is inferred from the frames as far as possible.
"""

from __future__ import annotations

from collections.abc import Callable

from busmaster.capture.decode import Decoder
from busmaster.capture.pcapng import Outcome, Packet
from busmaster.contract.frames import UNACKED, UNEXPECTED, Direction, Frame, Kind
from busmaster.contract.tap import Attempt, Verdict
from busmaster.registry import NodeKind, find, protocols


class _Exchange:
    """An exchange whose packets wait for its outcome. `attempt` is None on a line that is only listened to.

    `kind` is that of its node, None if the protocol is not known.
    """

    def __init__(self, kind: NodeKind | None, attempt: Attempt | None = None, request: Frame | None = None) -> None:
        self.kind = kind
        self.attempt = attempt
        self.request = request
        self.packets: list[Packet] = []
        self.last: Frame | None = None
        self.answer: Packet | None = None
        self.released = False

    @property
    def node(self) -> int | None:
        if self.attempt is None:
            return None if self.request is None else self.request.node
        return self.attempt.address if self.kind is None or self.kind.profile.addressed else None

    @property
    def over(self) -> bool:
        """True if no further frame can belong to it."""
        return self.attempt is None or self.attempt.verdict is not None

    @property
    def is_broadcast(self) -> bool:
        return self.kind is not None and self.node is not None and self.node == self.kind.profile.broadcast

    def is_behind(self, frame: Frame) -> bool:
        """Return True if a frame is from a node after the reply, or before any request.

        Only the frames are used.
        """
        if self.attempt is not None and self.request is None:
            return False  # its protocol is not known here, so the frames prove nothing
        if frame.fault == UNEXPECTED or self.request is None or self.released or self.is_broadcast:
            return True
        last = self.last
        if last is None or self.kind is None or self.judge()[0] is Outcome.NO_REPLY:
            return False
        if last.kind is Kind.NOISE:
            # Only the readers of these protocols search noise for the start of a reply.
            return not self.kind.profile.noise_tolerant
        return frame.kind is Kind.NOISE

    def outcome(self) -> tuple[Outcome, str]:
        """Return the outcome of the exchange and its description."""
        attempt = self.attempt
        if attempt is None or attempt.verdict is None:
            return self.judge()
        return Outcome[attempt.verdict.name], str(attempt)

    def judge(self) -> tuple[Outcome, str]:
        """Return the outcome and its description, inferred from the frames only."""
        asked, last = self.request, self.last
        if asked is None:
            return Outcome.NONE, ""
        if last is None:
            return (Outcome.OK, "") if self.is_broadcast else (Outcome.NO_REPLY, "no reply")
        if last.fault == UNACKED:
            return Outcome.NO_REPLY, "no ACK received, only a packet that may be the reply to an older request"
        if last.fault:
            return Outcome.GARBLED, last.fault
        if last.kind in (Kind.NAK, Kind.EOT):
            return Outcome.REFUSED, ""
        if last.kind is Kind.ACK and asked.kind is Kind.READ:
            return Outcome.NO_REPLY, "no packet received after the ACK"
        return Outcome.OK, ""


class Assembler:
    """Creates packets and passes them to `write`, in order. `now` is in seconds; `offset` converts it to seconds since
    1970, and may be changed.

    `protocol`: the protocol if nothing else determines it: on a line that is listened to, and before the first request.
    It also names the kind of node if several use that protocol. `echo`: sent bytes are received too, and are left out.
    """

    def __init__(
        self, write: Callable[[Packet], object], *, protocol: str = "", echo: bool = False, offset: float = 0.0
    ) -> None:
        self._write = write
        self._kinds = {known.name: known.kinds[0] for known in protocols()}
        self._kind = find(protocol) if protocol else None
        if self._kind is not None:
            self._kinds[self._kind.protocol.name] = self._kind
        self._echo = echo
        self._echo_pending = b""
        self._sent = b""
        self.offset = offset
        self._decoders: dict[str, Decoder] = {}
        self._asked: Attempt | None = None
        self._is_sender_known = False
        self._sender = Direction.UNKNOWN
        self._exchange = _Exchange(self._kind)
        self._now = 0.0

    def overheard(self, now: float, data: bytes, sender: Direction = Direction.UNKNOWN) -> None:
        """Process bytes of a line that is only listened to."""
        self._now, self._is_sender_known = now, False
        self._decode(now, data, sender)

    def passed(self, now: float, data: bytes, sender: Direction, attempt: Attempt | None) -> None:
        """Process bytes of an owned line with the attempt on the wire. Bytes of the HOST are whole frames."""
        if sender is not self._sender or sender is Direction.HOST:
            self._rest()
        self._now, self._is_sender_known, self._sender, self._asked = now, True, sender, attempt
        if sender is Direction.HOST and self._echo:
            self._echo_pending += data
            self._sent = data
        elif self._echo_pending:
            data = self._strip_echo(data)
        if attempt is not None and attempt is not self._exchange.attempt:
            request = attempt.request
            if sender is Direction.HOST and data.endswith(request):
                self._decode(now, data[: -len(request)], sender)  # what closes the exchange before
                data = request
            self._begin(attempt)
        self._decode(now, data, sender)

    def attempted(self, attempt: Attempt) -> None:
        """Process the end of an attempt."""
        if attempt is self._exchange.attempt:  # that of an exchange before was read from the attempt itself
            self._rest()
            self._release()

    def idle(self, now: float) -> None:
        """Write everything that is complete: the line has been idle for a long time."""
        self._now = now
        self._rest()
        if self._exchange.over:  # a master's exchange that goes on is not judged by its silence
            self._release()

    def finish(self, now: float) -> None:
        """Write everything."""
        self._now = now
        self._rest()
        self._release()

    def _begin(self, attempt: Attempt) -> None:
        self._rest()
        self._release()
        self._kind = self._kinds.get(attempt.protocol)
        self._exchange = _Exchange(self._kind, attempt)

    def _take(self, frame: Frame) -> None:
        """Create the packet of one frame."""
        if self._is_sender_known:
            frame.sender = self._sender  # its bytes may not show it
        from_host = frame.sender is Direction.HOST
        asks = from_host and frame.kind in (Kind.READ, Kind.WRITE)
        if asks and not self._is_sender_known:
            self._release()
            self._exchange = _Exchange(self._kind, None, frame)
        exchange = self._exchange
        if asks and exchange.request is None:
            exchange.request = frame
        packet = Packet(self._micros(frame.time), self._name, frame.sender, frame.raw, frame.node, joined=frame.joined)
        unexpected = self._is_sender_known and self._asked is None and not from_host
        if not (unexpected or exchange.released):
            self._mark(packet)
        if unexpected or (not from_host and exchange.is_behind(frame)):
            packet.outcome = Outcome.UNEXPECTED
            packet.comment = self._overdue_reply()
        elif not from_host:
            exchange.last, exchange.answer = frame, packet
        elif frame.kind is Kind.NAK:
            exchange.last = None  # the host wants it again
        elif frame.fault and not self._is_sender_known:
            packet.comment = frame.fault
        if exchange.released:
            self._write(packet)
        else:
            exchange.packets.append(packet)

    def _mark(self, packet: Packet) -> None:
        """Set the exchange of a packet."""
        exchange = self._exchange
        attempt = exchange.attempt
        if packet.node is None:
            packet.node = exchange.node
        if attempt is not None:
            packet.transaction, packet.attempt = attempt.transaction, attempt.number

    def _overdue_reply(self) -> str:
        """Return the possible origin of an unexpected frame, or ""."""
        attempt = self._exchange.attempt
        late = self._is_sender_known and attempt is not None and attempt.verdict is Verdict.NO_REPLY
        return f"perhaps a late reply to {attempt.command}" if late and attempt is not None else ""

    @property
    def _name(self) -> str:
        return "" if self._kind is None else self._kind.name

    def _strip_echo(self, data: bytes) -> bytes:
        """Return the bytes that are not the echo of the last or the previous transmission.

        MSC's closing ACK is sent with the next request. An echo that differs is left in: there was a collision.
        """
        # The last transmission is tried first: a missing echo must not use up the next one.
        for overdue in (self._sent, self._echo_pending):
            length = min(len(overdue), len(data))
            if length and data[:length] == overdue[:length]:
                self._echo_pending, self._sent = overdue[length:], b""
                return data[length:]
        self._echo_pending = b""
        return data

    def _decoder(self) -> Decoder | None:
        """Return the decoder of the current protocol; None if it is not known."""
        if self._name and self._name not in self._decoders:
            self._decoders[self._name] = Decoder(find(self._name).protocol.dialect())
        return self._decoders.get(self._name)

    def _decode(self, now: float, data: bytes, sender: Direction) -> None:
        if not data:
            return
        decoder = self._decoder()
        if decoder is None:
            self._take(Frame(Kind.NOISE, sender, data, time=now))
            return
        for frame in decoder.feed(data, now, sender):
            self._take(frame)

    def _rest(self) -> None:
        """Write the bytes that a node left incomplete as they are."""
        decoder = self._decoder()
        for frame in decoder.quiet() if decoder else ():
            self._take(frame)

    def _release(self) -> None:
        exchange = self._exchange
        if exchange.released:
            return
        exchange.released = True
        if exchange.request is not None or exchange.attempt is not None:
            self._conclude(exchange)
        for packet in exchange.packets:
            self._write(packet)
        exchange.packets.clear()

    def _conclude(self, exchange: _Exchange) -> None:
        """Write the outcome: in the last packet from the node; for a broadcast in its own packet."""
        outcome, comment = exchange.outcome()
        attempt, target = exchange.attempt, exchange.answer
        if exchange.packets and attempt is not None:
            exchange.packets[0].comment = why_asked(attempt)
        if target is None and exchange.packets and (exchange.is_broadcast or outcome is Outcome.OK):
            target = exchange.packets[0]
        elif target is None:
            ended = self._now if attempt is None or attempt.verdict is None else attempt.ended_at
            # No packet can carry the outcome, so one without bytes is written.
            name = "" if exchange.kind is None else exchange.kind.name
            target = Packet(self._micros(ended), name, Direction.NODE, b"", exchange.node)
            self._mark(target)
            exchange.packets.append(target)
        target.notes = tuple(note for note in (target.comment, *asides(attempt)) if note)
        target.outcome, target.comment = outcome, comment

    def _micros(self, now: float) -> int:
        return round((now + self.offset) * 1e6)


def why_asked(attempt: Attempt) -> str:
    """Return what a request's bytes do not show: "poll axes, attempt 2"; empty for a caller's first attempt."""
    again = f"attempt {attempt.number}" if attempt.number > 1 else ""
    return ", ".join(part for part in (attempt.purpose, again) if part)


def asides(attempt: Attempt | None) -> list[str]:
    """Return notes on how an attempt ended, in addition to its result."""
    if attempt is None or attempt.verdict is None:
        return []
    return ["late"] * attempt.late + ["cancelled"] * (not attempt.heard)
