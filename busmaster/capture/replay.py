"""Runs a capture through the current readers, and compares the results with the recorded ones.

The clock is not replayed, so decisions that depended on a reply's maximum reply delay are not repeated: unexpected
bytes stay unexpected, and missing replies stay missing.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Any, cast

from busmaster.capture.decode import Decoder
from busmaster.capture.pcapng import Outcome, Packet
from busmaster.contract.driver import Driver, Ending
from busmaster.contract.exchange import Abandonable, Command, FrameError
from busmaster.contract.frames import Direction, Frame, Kind
from busmaster.contract.profile import Profile
from busmaster.errors import InvalidCommand, Refused
from busmaster.registry import Protocol, find

UNREAD = (Outcome.NONE, Outcome.SPOILT, Outcome.CUT_OFF)
"""Outcomes that no reader has decided."""
FAILED = (Outcome.NO_REPLY, Outcome.GARBLED)


@dataclass(slots=True)
class Result:
    """How an exchange ended. `text`: the value as displayed, or the error; "" if not known.

    `values`: the numbers of the replies, from the frames; None if there are none.
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
        """Return True if both are equal: by the displayed value if it is known, else by the numbers.

        Texts of errors are not compared.
        """
        if self.outcome is not Outcome.OK or now.outcome is not Outcome.OK:
            return self.outcome is now.outcome
        return self.text == now.text if self.text else now.values is None or self.values == now.values


@dataclass(frozen=True, slots=True)
class Replayed:
    """One exchange: the recorded result and the current one. `packet` counts from 1, as in Wireshark."""

    packet: int
    micros: int
    node: int | None
    command: str
    recorded: Result
    now: Result

    @property
    def judged(self) -> bool:
        """True if there is a recorded result to compare with."""
        return self.recorded.outcome not in UNREAD

    @property
    def changed(self) -> bool:
        return self.judged and not self.recorded.same_as(self.now)


@dataclass(slots=True)
class _Received:
    """A packet, its position in the capture, and its frame."""

    number: int
    packet: Packet
    frame: Frame

    @property
    def is_request(self) -> bool:
        frame = self.frame
        asks = self.packet.direction is Direction.HOST and frame.kind in (Kind.READ, Kind.WRITE)
        return asks and not frame.continues

    @property
    def exchange(self) -> tuple[int, int]:
        """The exchange it belongs to, as far as the recorder knew it."""
        return self.packet.transaction, self.packet.attempt


class _Run:
    """A new exchange, run with the recorded bytes.

    With `pauses`, a pause longer than the inter-byte timeout ends a reply for the reader, as for the arbiter. But the
    arbiter may have allowed for an adapter that holds bytes back. Which of the two happened is not recorded.
    """

    def __init__(self, asked: _Received, command: Command[Any], profile: Profile, pauses: bool = False) -> None:
        self.asked = asked
        self._command = command
        self._profile = profile
        self._pauses = pauses
        self._received: list[_Received] = []
        self._last: int | None = None
        """When the node last sent bytes, in microseconds."""
        exchange = command.open(asked.frame.node or 0, profile.timings)
        self._driver = Driver(exchange, noise_tolerant=profile.noise_tolerant)
        self._abandonable = profile.exchange_limit is not None
        self._answered = False
        self._heard = b""
        """Bytes received in one piece, which may continue."""
        self._unsent = b""
        """Bytes that the host must send next."""
        self._closed = False
        self._over = False
        self._differs = ""
        self._given_up: Result | None = None
        """Result if the host's last bytes aborted the exchange instead of continuing it (R9). The bytes are the
        same."""
        self._recorded = Result(Outcome.NONE)
        self._values: list[float] = []
        self.note(asked)
        if exchange.request != asked.packet.frame:
            self._differs = f"the request would be {exchange.request.hex(' ')}"

    def note(self, heard: _Received) -> None:
        """Add the recorded outcome and values."""
        packet = heard.packet
        if packet.outcome not in (Outcome.NONE, Outcome.UNEXPECTED):
            self._recorded = Result(packet.outcome, packet.comment.removesuffix(" (late)"))
        if heard.frame.kind is Kind.VALUE and not heard.frame.fault:
            self._values += numbers_in(heard.frame.value)

    def add_reply(self, heard: _Received) -> None:
        """Pass bytes of the node to the reader, if the exchange has not ended."""
        if self._over and not any(heard.exchange):
            return
        if not self._driver.exchange.answered:
            self.note(heard)
            return  # a broadcast has no reply: bytes behind it are unexpected
        self._received.append(heard)
        self._pause(heard.packet.micros)
        self.note(heard)
        self._given_up = None
        if not heard.packet.joined:  # readers with several steps examine the bytes of one piece together
            self._hand_over()
        self._heard += heard.packet.frame
        self._answered = self._answered or bool(heard.packet.frame)

    def add_request(self, heard: _Received) -> bool:
        """Return True if these are the bytes that this exchange sends next; else the exchange has ended."""
        if self._over or self._differs:
            return False
        self._received.append(heard)
        self._last = None
        frame = heard.packet.frame
        self._hand_over()
        if not self._unsent:
            self._driver.expire()
            self._gather()
        if not self._unsent.startswith(frame):
            self._abandon()
        self._over = not self._unsent.startswith(frame)
        if not self._over:
            self._unsent = self._unsent[len(frame) :]
            self._given_up = self._if_abandoned(frame)
            self.note(heard)
        return not self._over

    def end(self) -> Replayed:
        """Return the recorded and the current result."""
        found = self._end()
        if not found.changed:
            return found
        run = _Run(self.asked, self._command, self._profile, pauses=True)
        for heard in self._received:
            if heard.packet.direction is Direction.HOST:
                run.add_request(heard)
            else:
                run.add_reply(heard)
        by_pauses = run._end()
        # If it ended before the packet with the outcome, it has nothing to compare with.
        return by_pauses if by_pauses.judged and not by_pauses.changed else found

    def _pause(self, now: int) -> None:
        """Report a pause to the reader if it was long enough."""
        last, self._last = self._last, now
        if not self._pauses or last is None or self._over or self._differs:
            return
        self._hand_over()
        if self._driver.ending is None and (now - last) / 1e6 > self._driver.timing.inter_byte_timeout:
            self._driver.expire()
            self._gather()

    def _end(self) -> Replayed:
        self._hand_over()
        self._abandon()
        now = Result(Outcome.NONE, self._differs) if self._differs else result_of(self._driver.run_out())
        recorded, lead = self._recorded, f"{self._command}: "
        if self._given_up is not None and recorded.outcome is self._given_up.outcome:
            now = self._given_up  # a decision by time, which is not replayed
        if self._answered and recorded.outcome in FAILED and now.outcome in FAILED:
            now.outcome = recorded.outcome  # the piece sizes of a later step are not recorded
        if recorded.outcome is Outcome.OK:
            recorded.values = self._values
            recorded.text = recorded.text.removeprefix(lead) if recorded.text.startswith(lead) else ""
        elif recorded.outcome is Outcome.AMBIGUOUS and now.outcome is Outcome.OK:
            now = Result(Outcome.AMBIGUOUS, f"{now.text}, but ambiguous: not delivered")
        return _replayed(self.asked, str(self._command), recorded, now)

    def _hand_over(self) -> None:
        """Pass the received bytes to the reader, in the recorded pieces."""
        heard, self._heard = self._heard, b""
        if heard and not self._differs and not self._over:
            self._driver.feed(heard)
            self._gather()

    def _gather(self) -> None:
        """Store the bytes that the exchange sends next."""
        driver = self._driver
        self._unsent += b"".join(driver.sent)
        driver.sent.clear()
        if driver.ending is not None and not self._closed:
            self._closed = True
            self._unsent += driver.ending.send

    def _if_abandoned(self, data: bytes) -> Result | None:
        """Return the result if the exchange had been aborted with these bytes."""
        if not self._abandonable or self._driver.ending is not None:
            return None
        failure = cast("Abandonable", self._driver.exchange).abandon()
        return result_of(Ending(error=failure)) if isinstance(failure, FrameError) and failure.send == data else None

    def _abandon(self) -> None:
        """Abort the exchange: it would have sent again, but the host had no more time for that (R9)."""
        if self._abandonable and self._unsent and self._driver.ending is None:
            self._driver.abandon()
            self._unsent = b""
            self._gather()


def result_of(ending: Ending) -> Result:
    """Return the result for a reader's ending."""
    error = ending.error
    if error is None:
        text = "ok" if ending.value is None else repr(ending.value)
        return Result(Outcome.OK, text, numbers_of(ending.value))
    if isinstance(error, Refused):
        return Result(Outcome.REFUSED, error.what)
    if isinstance(error, FrameError):
        return Result(Outcome.NO_REPLY if ending.silent else Outcome.GARBLED, error.what)
    return Result(Outcome.GARBLED, f"a bug in the protocol's reader: {error!r}")


def replay_packets(packets: Iterable[Packet]) -> Iterator[Replayed]:
    """Yield each exchange of a capture, in order."""
    heard = list(listen(packets))
    run: _Run | None = None
    for place, one in enumerate(heard):
        of_run = run is not None and one.exchange == run.asked.exchange
        if one.packet.direction is not Direction.HOST:
            if run is not None and of_run and (any(one.exchange) or one.packet.outcome is not Outcome.UNEXPECTED):
                run.add_reply(one)
            continue
        if (
            (run is not None and of_run and run.add_request(one))
            or not one.is_request
            or (of_run and any(one.exchange))
        ):
            continue
        if run is not None:
            yield run.end()
        run = None
        try:
            run = open_run(heard, place)
        except InvalidCommand as error:
            recorded = Result(recorded_outcome(heard, place))
            yield _replayed(one, one.frame.text, recorded, Result(Outcome.NONE, str(error)))
    if run is not None:
        yield run.end()


def listen(packets: Iterable[Packet]) -> Iterator[_Received]:
    """Yield each packet with its frame."""
    decoders: dict[str, Decoder] = {}
    for number, packet in enumerate(packets, 1):
        if packet.protocol and packet.protocol not in decoders:
            decoders[packet.protocol] = Decoder(find(packet.protocol).protocol.dialect())
        frame = Frame(Kind.NOISE, packet.direction, packet.frame)
        if packet.protocol and packet.frame:
            decoder = decoders[packet.protocol]
            frame = (decoder.feed(packet.frame, packet.micros / 1e6, packet.direction) + decoder.quiet())[-1]
        yield _Received(number, packet, frame)


def open_run(heard: Sequence[_Received], place: int) -> _Run:
    """Return a new exchange for a recorded request. Raises InvalidCommand if no command would send it."""
    asked = heard[place]
    continued = []
    for follower in heard[place + 1 :]:
        if follower.packet.direction is Direction.HOST:
            if not follower.frame.continues:
                break
            continued.append(follower.frame)
    protocol = find(asked.packet.protocol).protocol
    command = command_of(protocol, asked.frame, continued)
    return _Run(asked, command, protocol.profile)


def command_of(protocol: Protocol, request: Frame, continued: Sequence[Frame] = ()) -> Command[Any]:
    """Return the command of a request, with what the host sent later in the same exchange.

    Raises InvalidCommand for a request that no command would send.
    """
    if request.fault:
        raise InvalidCommand(f"{request.text}: {request.fault}")
    try:
        return protocol.dialect().command(request, continued)
    except InvalidCommand:
        raise
    except (KeyError, ValueError) as error:
        raise InvalidCommand(f"no command of ours: {request.text}") from error


def recorded_outcome(heard: Sequence[_Received], place: int) -> Outcome:
    """Return the recorded outcome of the exchange that begins at `place`."""
    outcome = heard[place].packet.outcome
    for follower in heard[place + 1 :]:
        if follower.is_request:
            break
        if follower.packet.outcome is not Outcome.UNEXPECTED:
            outcome = follower.packet.outcome or outcome
    return outcome


def _replayed(asked: _Received, command: str, recorded: Result, now: Result) -> Replayed:
    return Replayed(asked.number, asked.packet.micros, asked.packet.node, command, recorded, now)


def numbers_in(text: str) -> list[float]:
    """Return the numbers among a listener's values."""
    numbers = []
    for part in text.split(","):
        try:
            numbers.append(float(part))
        except ValueError:
            continue
    return numbers


def numbers_of(value: Any) -> list[float] | None:
    """Return a command's value as a list of numbers, or None."""
    if value is None:
        return None
    if isinstance(value, AbstractSet):
        return [float(one) for one in sorted(value)]
    return [float(one) for one in value] if isinstance(value, tuple | list) else [float(value)]
