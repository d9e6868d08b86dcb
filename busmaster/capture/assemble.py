"""From what was sent and heard to the packets of a capture: one a frame, each exchange with its outcome.

The owner of a line tells whose every byte is, and how each attempt ended. On a line that is only listened to, the
frames say it, as well as they can.
"""

from __future__ import annotations

from collections.abc import Callable

from busmaster.arbiter.tap import Attempt, Verdict
from busmaster.capture.decode import Decoder
from busmaster.capture.frames import UNACKED, UNEXPECTED, Direction, Frame, Kind
from busmaster.capture.pcapng import Outcome, Packet
from busmaster.registry import NodeKind, find, protocols


class _Exchange:
    """One exchange whose packets wait for its outcome. `attempt` is None on a line that is only listened to.

    `kind` is that of its node, None where the protocol is not known here.
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
        """Nothing more can be said of it."""
        return self.attempt is None or self.attempt.verdict is not None

    @property
    def is_broadcast(self) -> bool:
        return self.kind is not None and self.node is not None and self.node == self.kind.profile.broadcast

    def is_behind(self, frame: Frame) -> bool:
        """Return whether a frame is from a node after the answer, or before anything was asked.

        This is judged by the frames alone.
        """
        if self.attempt is not None and self.request is None:
            return False  # its protocol is not known here: the frames say nothing
        if frame.fault == UNEXPECTED or self.request is None or self.released or self.is_broadcast:
            return True
        last = self.last
        if last is None or self.kind is None or self.judge()[0] is Outcome.NO_REPLY:
            return False
        if last.kind is Kind.NOISE:
            # no reader looks for the start of a reply in noise, but for these
            return not self.kind.profile.noise_tolerant
        return frame.kind is Kind.NOISE

    def outcome(self) -> tuple[Outcome, str]:
        """Return how the exchange ended, and that in words."""
        attempt = self.attempt
        if attempt is None or attempt.verdict is None:
            return self.judge()
        return Outcome[attempt.verdict.name], str(attempt)

    def judge(self) -> tuple[Outcome, str]:
        """Return, by the frames alone, how the exchange ended, and that in words."""
        asked, last = self.request, self.last
        if asked is None:
            return Outcome.NONE, ""
        if last is None:
            return (Outcome.OK, "") if self.is_broadcast else (Outcome.NO_REPLY, "no reply")
        if last.fault == UNACKED:
            return Outcome.NO_REPLY, "no ACK came, only a packet that may answer something older"
        if last.fault:
            return Outcome.GARBLED, last.fault
        if last.kind in (Kind.NAK, Kind.EOT):
            return Outcome.REFUSED, ""
        if last.kind is Kind.ACK and asked.kind is Kind.READ:
            return Outcome.NO_REPLY, "nothing came after the ACK"
        return Outcome.OK, ""


class Assembler:
    """Makes packets and hands them to `write`, in order. `now` is in seconds, and `offset` what makes it 1970's.

    `protocol` is what is spoken where nobody says it: on a line that is listened to, and before anything was asked. It
    also names the kind of node, where several speak that protocol. With `echo` what the host sends is received too, and
    left out.
    """

    def __init__(
        self, write: Callable[[Packet], object], *, protocol: str = "", echo: bool = False, offset: float = 0.0
    ) -> None:
        self._write = write
        self._kinds = {spoken.name: spoken.kinds[0] for spoken in protocols()}
        self._kind = find(protocol) if protocol else None
        if self._kind is not None:
            self._kinds[self._kind.protocol.name] = self._kind
        self._echo = echo
        self._echo_pending = b""
        self._sent = b""
        self._offset = offset
        self._decoders: dict[str, Decoder] = {}
        self._asked: Attempt | None = None
        self._told = False
        self._sender = Direction.UNKNOWN
        self._exchange = _Exchange(self._kind)
        self._now = 0.0

    def overheard(self, now: float, data: bytes, sender: Direction = Direction.UNKNOWN) -> None:
        """Take bytes of a line that is only listened to."""
        self._now, self._told = now, False
        self._decode(now, data, sender)

    def passed(self, now: float, data: bytes, sender: Direction, attempt: Attempt | None) -> None:
        """Take bytes of a line of ours, and what was on the wire then: those of the HOST are whole frames."""
        if sender is not self._sender or sender is Direction.HOST:
            self._rest()
        self._now, self._told, self._sender, self._asked = now, True, sender, attempt
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
        """Take it that an attempt is over, and how it ended."""
        if attempt is self._exchange.attempt:  # that of an exchange before was read from the attempt itself
            self._now = max(self._now, attempt.ended_at)
            self._rest()
            self._release()

    def idle(self, now: float) -> None:
        """Hold back nothing that is over: for long nothing has happened."""
        self._now = now
        self._rest()
        if self._exchange.over:  # a master's exchange that goes on is not judged by its silence
            self._release()

    def finish(self, now: float) -> None:
        """Hold back nothing."""
        self._now = now
        self._rest()
        self._release()

    def _begin(self, attempt: Attempt) -> None:
        self._rest()
        self._release()
        self._kind = self._kinds.get(attempt.protocol)
        self._exchange = _Exchange(self._kind, attempt)

    def _take(self, frame: Frame) -> None:
        """Make the packet of one frame."""
        if self._told:
            frame.sender = self._sender  # which its bytes may not tell
        from_host = frame.sender is Direction.HOST
        asks = from_host and frame.kind in (Kind.READ, Kind.WRITE)
        if asks and not self._told:
            self._release()
            self._exchange = _Exchange(self._kind, None, frame)
        exchange = self._exchange
        if asks and exchange.request is None:
            exchange.request = frame
        packet = Packet(self._micros(frame.time), self._name, frame.sender, frame.raw, frame.node, joined=frame.joined)
        unexpected = self._told and self._asked is None and not from_host
        if not (unexpected or exchange.released):
            self._mark(packet)
        if unexpected or (not from_host and exchange.is_behind(frame)):
            packet.outcome = Outcome.UNEXPECTED
            packet.comment = self._overdue_reply()
        elif not from_host:
            exchange.last, exchange.answer = frame, packet
        elif frame.kind is Kind.NAK:
            exchange.last = None  # the host wants it again
        elif frame.fault and not self._told:
            packet.comment = frame.fault
        if exchange.released:
            self._write(packet)
        else:
            exchange.packets.append(packet)

    def _mark(self, packet: Packet) -> None:
        """Say whose packet it is."""
        exchange = self._exchange
        attempt = exchange.attempt
        if packet.node is None:
            packet.node = exchange.node
        if attempt is not None:
            packet.transaction, packet.attempt = attempt.transaction, attempt.number

    def _overdue_reply(self) -> str:
        """Return what a stray may be, "" if that is not known."""
        attempt = self._exchange.attempt
        late = self._told and attempt is not None and attempt.verdict is Verdict.NO_REPLY
        return f"perhaps a late answer to {attempt.command}" if late and attempt is not None else ""

    @property
    def _name(self) -> str:
        return "" if self._kind is None else self._kind.name

    def _strip_echo(self, data: bytes) -> bytes:
        """Return what is not the echo of what was sent last, or before that.

        MSC's closing ACK comes with the next request. An echo that differs is left as it came: the line collided.
        """
        # The last alone is tried first: an echo that never came must not use up the next one.
        for overdue in (self._sent, self._echo_pending):
            length = min(len(overdue), len(data))
            if length and data[:length] == overdue[:length]:
                self._echo_pending, self._sent = overdue[length:], b""
                return data[length:]
        self._echo_pending = b""
        return data

    def _decoder(self) -> Decoder | None:
        """Return the decoder of what is spoken; None where that is not known."""
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
        """Take what the node left unfinished as it is."""
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
        """Write down the outcome: on the last packet from the node, of a broadcast on its own."""
        outcome, comment = exchange.outcome()
        attempt, target = exchange.attempt, exchange.answer
        if exchange.packets and attempt is not None:
            exchange.packets[0].comment = why_asked(attempt)
        if target is None and exchange.packets and (exchange.is_broadcast or outcome is Outcome.OK):
            target = exchange.packets[0]
        elif target is None:
            ended = self._now if attempt is None or attempt.verdict is None else attempt.ended_at
            # Nothing came that could carry the outcome: a packet without bytes does.
            name = "" if exchange.kind is None else exchange.kind.name
            target = Packet(self._micros(ended), name, Direction.NODE, b"", exchange.node)
            self._mark(target)
            exchange.packets.append(target)
        target.notes = tuple(note for note in (target.comment, *asides(attempt)) if note)
        target.outcome, target.comment = outcome, comment

    def _micros(self, now: float) -> int:
        return round((now + self._offset) * 1e6)


def why_asked(attempt: Attempt) -> str:
    """Say of a request what nobody sees in its bytes: "poll axes, attempt 2"; empty for a caller's first attempt."""
    again = f"attempt {attempt.number}" if attempt.number > 1 else ""
    return ", ".join(part for part in (attempt.purpose, again) if part)


def asides(attempt: Attempt | None) -> list[str]:
    """Return what is to be said of how an attempt ended, beside its result."""
    if attempt is None or attempt.verdict is None:
        return []
    return ["late"] * attempt.late + ["cancelled"] * (not attempt.heard)
