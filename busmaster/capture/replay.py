"""A recorded line, run through the master's readers of today: what would they make of the same bytes?

The clock is not replayed, so what a reply's lateness decided is not decided again: strays stay strays, and where
nothing came nothing comes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any

from busmaster.capture.decode import Decoder
from busmaster.capture.frames import Direction, Frame, Kind
from busmaster.capture.pcapng import Outcome, Packet
from busmaster.contract.exchange import Command, Done, Exchange, Expect, FrameError, Step
from busmaster.errors import InvalidCommand, Refused
from busmaster.registry import Protocol, find


@dataclass(slots=True)
class Result:
    """How an exchange ended. `text` is the value as the master showed it, or what was wrong; "" if that is not known.

    `values` are the numbers of the replies, as the frames have them; None if there were none to be had.
    """

    outcome: Outcome
    text: str = ""
    values: list[float] | None = None

    def __str__(self) -> str:
        name = self.outcome.name.lower().replace("_", " ")
        text = self.text or ",".join(f"{value:g}" for value in self.values or ())
        if self.outcome is Outcome.NONE:
            return text
        return f"{name}: {text}" if text else name

    def same_as(self, now: Result) -> bool:
        """By the value as it was shown if that is known, else by the numbers. Wordings of failures do not count."""
        if self.outcome is not Outcome.OK or now.outcome is not Outcome.OK:
            return self.outcome is now.outcome
        return self.text == now.text if self.text else now.values is None or self.values == now.values


@dataclass(frozen=True, slots=True)
class Replayed:
    """One exchange: what was recorded of it, and what comes of its bytes now. `packet` counts from 1, as Wireshark."""

    packet: int
    micros: int
    node: int | None
    command: str
    recorded: Result
    now: Result

    @property
    def judged(self) -> bool:
        """There is something to compare with."""
        return self.recorded.outcome is not Outcome.NONE

    @property
    def changed(self) -> bool:
        return self.judged and not self.recorded.same_as(self.now)


@dataclass(slots=True)
class _Heard:
    """A packet, its place in the capture, and what a listener makes of it."""

    number: int
    packet: Packet
    frame: Frame

    @property
    def is_request(self) -> bool:
        frame = self.frame
        asks = self.packet.direction is Direction.HOST and frame.kind in (Kind.READ, Kind.WRITE)
        return asks and not frame.continues


class _Run:
    """One exchange of today's, fed with what was recorded."""

    def __init__(self, asked: _Heard, command: Command[Any], exchange: Exchange[Any]) -> None:
        self._asked = asked
        self._command = command
        self._exchange = exchange
        self._owed = b""
        self._started = False
        self._over = False
        self._now: Result | None = None
        self._recorded = Result(Outcome.NONE)
        self._values: list[float] = []
        self.note(asked)
        if exchange.request != asked.packet.frame:
            self._now = Result(Outcome.NONE, f"the request would be {exchange.request.hex(' ')}")

    def note(self, heard: _Heard) -> None:
        """Take the recorded outcome and values."""
        packet = heard.packet
        if packet.outcome not in (Outcome.NONE, Outcome.STRAY):
            self._recorded = Result(packet.outcome, packet.comment.removesuffix(" (late)"))
        if heard.frame.kind is Kind.VALUE and not heard.frame.fault:
            self._values += numbers_in(heard.frame.value)

    def node_says(self, heard: _Heard) -> None:
        if self._over:
            return
        self.note(heard)
        if heard.packet.frame and self._now is None:
            self._started = True
            self._attempt(lambda: self._exchange.feed(heard.packet.frame))

    def host_says(self, heard: _Heard) -> bool:
        """True if it is what this exchange says at this point; else the exchange is over."""
        if self._over:
            return False
        if not self._owed and self._now is None:
            self._attempt(lambda: self._exchange.expired(self._started))
        owed, self._owed = self._owed, b""
        self._over = owed != heard.packet.frame
        if not self._over:
            self.note(heard)
        return not self._over

    def end(self) -> Replayed:
        for _ in range(_PATIENCE):
            if self._now is None:
                self._attempt(lambda: self._exchange.expired(self._started))
        now = self._now or Result(Outcome.GARBLED, "it never ends")
        recorded, lead = self._recorded, f"{self._command}: "
        if recorded.outcome is Outcome.OK:
            recorded.values = self._values
            recorded.text = recorded.text.removeprefix(lead) if recorded.text.startswith(lead) else ""
        return _replayed(self._asked, str(self._command), recorded, now)

    def _attempt(self, step: Callable[[], Step[Any]]) -> None:
        try:
            self._follow(step())
        except Refused as refusal:
            self._now = Result(Outcome.REFUSED, refusal.what)
        except FrameError as error:
            self._owed += error.send
            self._now = Result(Outcome.GARBLED if self._started else Outcome.NO_REPLY, error.what)

    def _follow(self, step: Step[Any]) -> None:
        while isinstance(step, Expect):
            self._owed += step.send
            self._started = False
            step = self._exchange.feed(b"")
        if isinstance(step, Done):
            self._owed += step.send
            text = "ok" if step.value is None else repr(step.value)
            self._now = Result(Outcome.OK, text, numbers_of(step.value))


_PATIENCE = 16
"""Legs that an exchange may want in which nothing was recorded: MSC sends a request four times."""


def replay(packets: Iterable[Packet]) -> Iterator[Replayed]:
    """Each exchange of a capture, in order."""
    heard = list(listen(packets))
    run: _Run | None = None
    for place, one in enumerate(heard):
        if one.packet.direction is Direction.HOST:
            if run is not None and run.host_says(one):
                continue
            if one.is_request:
                if run is not None:
                    yield run.end()
                run = None
                try:
                    run = open_run(heard, place)
                except InvalidCommand as error:
                    recorded = Result(recorded_outcome(heard, place))
                    yield _replayed(one, one.frame.text, recorded, Result(Outcome.NONE, str(error)))
        elif run is not None and one.packet.outcome is not Outcome.STRAY:
            run.node_says(one)
    if run is not None:
        yield run.end()


def listen(packets: Iterable[Packet]) -> Iterator[_Heard]:
    """Every packet with the frame that it is."""
    decoders: dict[str, Decoder] = {}
    for number, packet in enumerate(packets, 1):
        if packet.protocol and packet.protocol not in decoders:
            decoders[packet.protocol] = Decoder(find(packet.protocol).protocol.dialect())
        frame = Frame(Kind.NOISE, packet.direction, packet.frame)
        if packet.protocol and packet.frame:
            decoder = decoders[packet.protocol]
            frame = (decoder.feed(packet.frame, packet.micros / 1e6, packet.direction) + decoder.quiet())[-1]
        yield _Heard(number, packet, frame)


def open_run(heard: Sequence[_Heard], place: int) -> _Run:
    """Today's exchange for a recorded request. Raises InvalidCommand for one that we would not send."""
    asked = heard[place]
    continued = []
    for follower in heard[place + 1 :]:
        if follower.packet.direction is Direction.HOST:
            if not follower.frame.continues:
                break
            continued.append(follower.frame)
    protocol = find(asked.packet.protocol).protocol
    command = command_of(protocol, asked.frame, continued)
    return _Run(asked, command, command.open(asked.frame.node or 0, protocol.profile.timings))


def command_of(protocol: Protocol, request: Frame, continued: Sequence[Frame] = ()) -> Command[Any]:
    """Return the command that a request speaks, with what the host said in the midst of the same exchange.

    Raises InvalidCommand for a request that no command of ours would send.
    """
    if request.fault:
        raise InvalidCommand(f"{request.text}: {request.fault}")
    try:
        return protocol.dialect().command(request, continued)
    except InvalidCommand:
        raise
    except (KeyError, ValueError) as error:
        raise InvalidCommand(f"no command of ours: {request.text}") from error


def recorded_outcome(heard: Sequence[_Heard], place: int) -> Outcome:
    """Of the exchange that begins there."""
    outcome = heard[place].packet.outcome
    for follower in heard[place + 1 :]:
        if follower.is_request:
            break
        if follower.packet.outcome is not Outcome.STRAY:
            outcome = follower.packet.outcome or outcome
    return outcome


def _replayed(asked: _Heard, command: str, recorded: Result, now: Result) -> Replayed:
    return Replayed(asked.number, asked.packet.micros, asked.packet.node, command, recorded, now)


def numbers_in(text: str) -> list[float]:
    """Of a listener's values, those that are numbers."""
    numbers = []
    for part in text.split(","):
        try:
            numbers.append(float(part))
        except ValueError:
            continue
    return numbers


def numbers_of(value: Any) -> list[float] | None:
    """A command's value as a list of numbers; None for none."""
    if value is None:
        return None
    if isinstance(value, AbstractSet):
        return [float(one) for one in sorted(value)]
    return [float(one) for one in value] if isinstance(value, tuple | list) else [float(value)]
