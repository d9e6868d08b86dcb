"""From what was sent and heard to the packets of a capture: one a frame, each exchange with its outcome.

The outcome is the master's where it came in time, else the listener's own reading of the frames. The master tells it
only after it has sent the next request, so an exchange is held back until then: at most two are.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

from busmaster.capture.decode import Decoder
from busmaster.capture.frames import UNACKED, UNASKED, Direction, Frame, Kind
from busmaster.capture.pcapng import Outcome, Packet
from busmaster.registry import find, kinds

SAME_CALLBACK = 0.005
"""Seconds: a verdict that comes later than this after a request is not of the exchange before it."""
REQUESTS_KEPT = 4096
"""Requests of which is remembered what protocol they speak."""


class Verdict(NamedTuple):
    """What the master made of an exchange. `outcome` None: the frames say it better (an unconfirmed write)."""

    request: bytes
    outcome: Outcome | None
    comment: str


def protocol_of(request: bytes, declared: str = "") -> str:
    """Return the protocol of what a master says, or "" if it begins no exchange: an acknowledgement, say.

    It is the one that is `declared` if that has such a request, else the first that has: they are tried in the order
    in which captures came to know them.
    """
    known = sorted(kinds().values(), key=lambda kind: (not kind.capture_id, kind.capture_id))
    names = (declared, *(kind.name for kind in known))
    return next((name for name in names if name and _is_request(request, name)), "")


def _is_request(said: bytes, protocol: str) -> bool:
    dialect = find(protocol).protocol.dialect()
    if not said or dialect.size(said, Direction.HOST) != len(said):
        return False
    frame = dialect.explain(said, Direction.HOST)
    return frame.kind in (Kind.READ, Kind.WRITE) and not frame.fault and not frame.continues


def _is_broadcast(request: Frame, protocol: str) -> bool:
    return request.node is not None and bool(protocol) and request.node == find(protocol).profile.broadcast


class _Held:
    """One exchange whose packets wait for its verdict."""

    def __init__(self, request: Frame | None, protocol: str = "") -> None:
        self.request = request
        self.broadcast = request is not None and _is_broadcast(request, protocol)
        self.last: Frame | None = None
        self.packets: list[Packet] = []
        self.answer: Packet | None = None
        self.verdict: Verdict | None = None
        self.released = False

    def is_of(self, verdict: Verdict) -> bool:
        return not self.released and self.request is not None and self.request.raw == verdict.request

    def is_stray(self, frame: Frame) -> bool:
        """It came from a node, or from who knows where, after the exchange was over, or before any."""
        if frame.sender is Direction.HOST:
            return False
        if frame.fault == UNASKED or self.request is None or self.released:
            return True
        last = self.last
        over = last is not None and self.judge()[0] is not Outcome.NO_REPLY
        return over and (frame.kind is Kind.NOISE or (last is not None and last.kind is Kind.NOISE))

    def judge(self) -> tuple[Outcome, str]:
        """By the frames alone."""
        asked, last = self.request, self.last
        if asked is None:
            return Outcome.NONE, ""
        if last is None:
            return (Outcome.OK, "") if self.broadcast else (Outcome.NO_REPLY, "no reply")
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

    `protocol` is needed where requests do not tell it: of two kinds of nodes that speak alike, and on a line that is
    listened to. With `echo` what the host sends is received too, and left out.
    """

    def __init__(
        self, write: Callable[[Packet], object], *, protocol: str = "", echo: bool = False, offset: float = 0.0
    ) -> None:
        self._write = write
        kinds()  # they are looked for now, not while the line runs
        self._protocol_of = lru_cache(REQUESTS_KEPT)(partial(protocol_of, declared=protocol))
        self._echo = echo
        self._echo_owed = b""
        self._sent = b""
        self._offset = offset
        self._decoders: dict[str, Decoder] = {}
        self._protocol = ""
        self._previous: _Held | None = None
        self._current = _Held(None)
        self._now = 0.0
        self._speak(protocol)

    def passed(self, now: float, data: bytes, sender: Direction) -> None:
        """Bytes were on the line. From the HOST: whole frames. UNKNOWN: a line that is only listened to."""
        self._now = now
        if sender is Direction.HOST:
            self._rest()
            self._speak(self._protocol_of(data))
            if self._echo:
                self._echo_owed += data
                self._sent = data
        elif self._echo_owed:
            data = self._strip_echo(data)
        if data:
            self._release_previous()
            self._decode(now, data, sender)

    def completed(self, now: float, verdict: Verdict) -> None:
        """The master is done with an exchange."""
        self._now = now
        current, previous = self._current, self._previous
        if previous and current.request and now - current.request.time > SAME_CALLBACK:
            self._release_previous()
        if (previous := self._previous) and previous.is_of(verdict):
            previous.verdict = verdict
            self._release_previous()
        elif current.is_of(verdict):
            current.verdict = verdict
            self._rest()
            self._release_previous()
            self._release(current)

    def take(self, frame: Frame) -> None:
        """One frame, whoever decoded it."""
        packet = Packet(self._micros(frame.time), self._protocol, frame.sender, frame.raw, frame.node)
        if frame.sender is Direction.HOST and frame.kind in (Kind.READ, Kind.WRITE):
            self._previous, self._current = self._current, _Held(frame, self._protocol)
        held = self._current
        if held.is_stray(frame):
            packet.outcome = Outcome.STRAY
        elif frame.sender is not Direction.HOST:
            held.last, held.answer = frame, packet
        elif frame.kind is Kind.NAK:
            held.last = None  # MSC: the packet again
        elif frame.fault:
            packet.comment = frame.fault
        if held.released:
            self._write(packet)
        else:
            held.packets.append(packet)

    def idle(self, now: float) -> None:
        """Nothing has happened for long: nothing is held back any longer."""
        self._now = now
        self._rest()
        self._release_previous()
        self._release(self._current)

    def _speak(self, protocol: str) -> None:
        """The next bytes are of this protocol; of the same as before if it is "" (an acknowledgement)."""
        self._protocol = protocol or self._protocol
        if protocol and protocol not in self._decoders:
            self._decoders[protocol] = Decoder(find(protocol).protocol.dialect())

    def _strip_echo(self, data: bytes) -> bytes:
        """What is not the echo of what was sent last, or before that (MSC's closing ACK comes with the next request).

        An echo that differs is left as it came: the line collided.
        """
        for owed in (self._sent, self._echo_owed):
            length = min(len(owed), len(data))
            if length and data[:length] == owed[:length]:
                self._echo_owed, self._sent = owed[length:], b""
                return data[length:]
        self._echo_owed = b""
        return data

    def _decode(self, now: float, data: bytes, sender: Direction) -> None:
        decoder = self._decoders.get(self._protocol)
        if decoder is None:
            self.take(Frame(Kind.NOISE, sender, data, time=now))
            return
        for frame in decoder.feed(data, now, sender):
            self.take(frame)

    def _rest(self) -> None:
        """What the node left unfinished stays so."""
        decoder = self._decoders.get(self._protocol)
        for frame in decoder.quiet() if decoder else ():
            self.take(frame)

    def _release_previous(self) -> None:
        if self._previous is not None:
            self._release(self._previous)
            self._previous = None

    def _release(self, held: _Held) -> None:
        if held.released:
            return
        held.released = True
        outcome, comment = held.judge()
        if held.verdict is not None:
            outcome, comment = held.verdict.outcome or outcome, held.verdict.comment
        asked, answer = held.request, held.answer
        if asked is not None:
            if answer is None and not held.broadcast:
                answer = Packet(self._end_of(held), held.packets[0].protocol, Direction.NODE, b"", asked.node)
                held.packets.append(answer)
            target = answer or held.packets[0]
            target.outcome, target.comment = outcome, comment
        for packet in held.packets:
            self._write(packet)
        held.packets.clear()

    def _end_of(self, held: _Held) -> int:
        """When an unanswered exchange was over: at the latest when the next began."""
        after = self._current.packets
        return after[0].micros if held is not self._current and after else self._micros(self._now)

    def _micros(self, now: float) -> int:
        return round((now + self._offset) * 1e6)
