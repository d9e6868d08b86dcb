"""Mentor II (ANSI x3.28-2.5-A4): addresses 1-99, each of their two digits sent twice; parameters as menu and number.

    read    EOT a a a a m m p p ENQ                 answered by STX m m p p data ETX BCC; EOT: no such parameter
    write   EOT a a a a STX m m p p data ETX BCC    answered by ACK or NAK; no reply if it goes to address 0.
                                                    An EOT may be an ACK with one flipped bit: it proves nothing
    then    ACK, BS or NAK alone                    the drive read last sends the next, previous or same parameter

Values are whole numbers: a table defines the position of the decimal point. The line has 7 bits and even parity. If 8
bits are received, the parity bit is dropped.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, ClassVar, NoReturn, TypeVar

from busmaster.contract.arguments import whole_number
from busmaster.contract.exchange import Command, Done, Expect, FrameError, LaterStep, Need, Sizes
from busmaster.contract.profile import Batch, LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand, NoSuchParameter, Refused
from busmaster.wire.checks import bcc
from busmaster.wire.readers import (
    ACK,
    ENQ,
    EOT,
    ETX,
    NAK,
    STX,
    AcknowledgeReader,
    SingleStep,
    TelegramReader,
    telegram_sizes,
)

LONGEST_DATA = 5
"""Characters of a reply's data: sign and 4 digits, or 5 digits."""
LONGEST_BATCH = 8
"""Parameters that `merge_runs` reads in one exchange, so that a command never waits longer for it."""

_BS = b"\x08"
T = TypeVar("T")

_SHORT_COMMANDS = {1: ACK, 0: NAK, -1: _BS}
_SEVEN_BITS = bytes(byte & 0x7F for byte in range(256))  # a port limited to 8N1 has the parity in bit 7
# Refusals of a read: nodes of some other makers send a NAK.
_REFUSALS = {NAK[0]: Refused, EOT[0]: NoSuchParameter}
_PARAMETER = re.compile(r"(\d{1,2})\.(\d{1,2})", re.ASCII)
_VALUE = re.compile(rb"[+-]?\d+")


def with_parity(starts: bytes) -> bytes:
    """Return the same characters, and their forms with the parity bit set."""
    return starts + bytes(byte | 0x80 for byte in starts)


def parse_parameter(text: str) -> tuple[int, int]:
    """Return menu and number of "1.17" or "01.17". Raises InvalidCommand for anything else."""
    try:
        match = _PARAMETER.fullmatch(text)
    except TypeError:  # a number, of which 1.10 would be 1.1
        match = None
    if match is None:
        raise InvalidCommand(f"{text!r} is not a parameter: write menu and number as text, as in '1.17'")
    return int(match[1]), int(match[2])


def _check_parameter(menu: int, number: int) -> None:
    whole_number(menu, 0, 99, "menu")
    whole_number(number, 0, 99, "parameter number")


@dataclass(frozen=True, slots=True)
class Read:
    """Read one parameter: an int. A bit parameter is 0 or 1. Raises InvalidCommand for a number above 99."""

    menu: int
    number: int

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _check_parameter(self.menu, self.number)

    def __str__(self) -> str:
        return f"read {self.menu:02d}.{self.number:02d}"

    @property
    def places(self) -> tuple[Hashable, ...]:
        return ((self.menu, self.number),)

    def shown(self, values: Mapping[Hashable, Any]) -> Any:
        return values[self.menu, self.number]

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {(self.menu, self.number): value}

    def open(self, address: int, timings: Timings) -> Reading:
        """Begin the read. Raises InvalidCommand for the broadcast address: all drives would reply at once."""
        request, header = read_request(address, self.menu, self.number)
        return Reading(request, header, timings.read)


@dataclass(frozen=True, slots=True)
class ReadRun:
    """Read `count` consecutive parameters in one exchange: a tuple of ints.

    `step`: 1 for the next parameter, -1 for the previous one, 0 for the same one again. Every parameter after the first
    costs one request byte. It fails as a whole, with NoSuchParameter if the menu has a gap. Another drive's ACK or NAK
    is the same byte: use it only if each drive forgets its last read when another is addressed.
    Raises InvalidCommand for a run that leaves the menu.
    """

    menu: int
    number: int
    count: int
    step: int = 1

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _check_parameter(self.menu, self.number)
        whole_number(self.count, 1, 100, "count")
        whole_number(self.step, -1, 1, "step")
        whole_number(self.number + self.step * (self.count - 1), 0, 99, "the last parameter number")

    def __str__(self) -> str:
        first = f"read {self.menu:02d}.{self.number:02d}"
        last = self.number + self.step * (self.count - 1)
        return f"{first} to {self.menu:02d}.{last:02d}" if self.step else f"{first}, {self.count} times"

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {(self.menu, self.number + self.step * i): one for i, one in enumerate(value)}

    def open(self, address: int, timings: Timings) -> RunReading:
        """Begin the read. Raises InvalidCommand for the broadcast address."""
        return RunReading(self, address, timings.read)


@dataclass(frozen=True, slots=True)
class Write:
    """Write one parameter.

    A number is sent as sign and 4 digits (-9999 to 9999), True and False as one digit. `wide`: 5 digits without a sign
    (0 to 65535), for parameters that are wide integers. `high_resolution`: sign and 5 digits (-99999 to 99999), in
    tenths of the parameter's own unit. Raises InvalidCommand for a value that does not fit.
    """

    menu: int
    number: int
    value: int
    wide: bool = False
    high_resolution: bool = False
    idempotent: bool = False
    text: str = field(init=False, repr=False, compare=False)

    writes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _check_parameter(self.menu, self.number)
        object.__setattr__(self, "text", self._format())

    def _format(self) -> str:
        # A drive recognises the form by the number of characters: +12000, with six, would mean 1200.0.
        if self.wide and self.high_resolution:
            raise InvalidCommand("a parameter is written either wide or in high resolution")
        if isinstance(self.value, bool):
            return str(int(self.value))
        if self.wide:
            return f"{whole_number(self.value, 0, 65535, 'a wide value'):05d}"
        if self.high_resolution:
            return f"{whole_number(self.value, -99999, 99999, 'a high-resolution value'):+06d}"
        return f"{whole_number(self.value, -9999, 9999, 'a value that is not declared wide'):+05d}"

    def __str__(self) -> str:
        return f"write {self.menu:02d}.{self.number:02d} = {self.text}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return {(self.menu, self.number): self.value / 10 if self.high_resolution else int(self.value)}

    def open(self, address: int, timings: Timings) -> Writing | Broadcast:
        body = b"%02d%02d%b" % (self.menu, self.number, self.text.encode()) + ETX
        request = reset(address) + STX + body + bytes((bcc(body),))
        return Writing(request, timings.write) if address else Broadcast(request, timings.write)


class ParameterReading(TelegramReader[T]):
    """One attempt to read a parameter, or one step of a run, with data of any form."""

    __slots__ = ()

    check = staticmethod(bcc)
    starts: ClassVar[bytes] = with_parity(STX + NAK + EOT)
    refusals = _REFUSALS

    def feed(self, data: bytes) -> Need | Expect | Done[T]:
        return super().feed(data.translate(_SEVEN_BITS))


class Reading(ParameterReading[int]):
    """One attempt to read a parameter of Mentor II: a whole number."""

    __slots__ = ()

    longest = LONGEST_DATA
    sizes: ClassVar[Sizes] = telegram_sizes(echo=4, typical=LONGEST_DATA, longest=LONGEST_DATA)

    def parse(self, field: bytes) -> int:
        if _VALUE.fullmatch(field) is None:
            raise FrameError(f"{field!r} is not a whole number")
        return int(field)


class RunReading:
    """One attempt to read a run: a step for each parameter."""

    __slots__ = ("_next", "_short", "_step", "_values", "answers", "later", "request", "timing")

    reading: ClassVar[type[ParameterReading[Any]]] = Reading
    """Reader for each step."""
    sizes: ClassVar[Sizes] = Reading.sizes
    starts: ClassVar[bytes] = Reading.starts
    closing: ClassVar[int] = 0
    answered: ClassVar[bool] = True

    def __init__(self, run: ReadRun, address: int, timing: ReplyTiming) -> None:
        headers = tuple(header_of(run.menu, run.number + run.step * i) for i in range(run.count))
        self.request, _ = read_request(address, run.menu, run.number)
        self.timing = timing
        self.later: Sequence[LaterStep] = (LaterStep(timing, self.sizes, sent=1),) * (run.count - 1)
        self._short = _SHORT_COMMANDS[run.step]
        self._next = list(reversed(headers[1:]))
        self._step = self.reading(self.request, headers[0], timing)
        self.answers = headers
        self._values: list[Any] = []

    @property
    def overdue(self) -> tuple[bytes, ...]:
        """The parameter that was requested last: each further one takes a byte from the host."""
        return self._step.answers

    def feed(self, data: bytes) -> Need | Expect | Done[tuple[Any, ...]]:
        step = self._step.feed(data)
        if not isinstance(step, Done):
            return step
        self._values.append(step.value)
        if not self._next:
            return Done(tuple(self._values), rest=step.rest)
        if step.rest:
            raise FrameError("bytes came before the next parameter was requested")
        self._step = self.reading(self._short, self._next.pop(), self.timing)
        return Expect(self.timing, self.sizes, self._short)

    def expired(self, started: bool) -> NoReturn:
        self._step.expired(started)


class Writing(AcknowledgeReader):
    """One attempt to write a parameter."""

    __slots__ = ()

    starts: ClassVar[bytes] = with_parity(ACK + NAK + EOT)

    def feed(self, data: bytes) -> Need | Expect | Done[None]:
        data = data.translate(_SEVEN_BITS)
        if data.startswith(EOT):  # not every port checks parity: the write may have been carried out
            raise FrameError("EOT came: there is no such parameter, or it was an ACK with a flipped bit", heard=data)
        return super().feed(data)


class Broadcast(SingleStep):
    """One write to all drives. No drive replies, and the line stays free for as long as a reply would take."""

    __slots__ = ()

    sizes: ClassVar[Sizes] = Sizes(0, 0)
    starts: ClassVar[bytes] = b""
    answered: ClassVar[bool] = False
    answers: ClassVar[tuple[bytes, ...]] = ()
    overdue: ClassVar[tuple[bytes, ...]] = ()

    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        super().__init__(
            request, replace(timing, driver_release_time=max(timing.driver_release_time, timing.late_after))
        )

    def feed(self, data: bytes) -> Need | Expect | Done[None]:
        return Done(None, rest=data)

    def expired(self, started: bool) -> Expect | Done[None]:
        return Done(None)


def merge_runs(commands: Sequence[Command[Any]]) -> list[Batch]:
    """Return batches of neighbouring parameters, each read as a run of at most 8. Single parameters are not merged.

    Short commands are safe only if the drive that was read last is the only one that interprets them (see ReadRun). So
    the profile has no merge by default; `CHAINED` has one.
    """
    wanted: dict[tuple[int, int], int] = {}
    for index, command in enumerate(commands):
        if isinstance(command, Read):
            wanted.setdefault((command.menu, command.number), index)
    batches: list[Batch] = []
    run: list[tuple[int, int]] = []
    for parameter in [*sorted(wanted), None]:
        if run and (parameter != (run[-1][0], run[-1][1] + 1) or len(run) == LONGEST_BATCH):
            if len(run) > 1:
                batches.append(Batch(ReadRun(*run[0], len(run)), tuple(wanted[p] for p in run)))
            run = []
        if parameter is not None:
            run.append(parameter)
    return batches


@lru_cache(maxsize=4096)
def read_request(address: int, menu: int, number: int) -> tuple[bytes, bytes]:
    """Return the read request, and the beginning of its reply. Raises InvalidCommand for address 0."""
    if not address:
        raise InvalidCommand("a read cannot go to all drives: they would all reply at once")
    return reset(address) + b"%02d%02d" % (menu, number) + ENQ, header_of(menu, number)


def header_of(menu: int, number: int) -> bytes:
    """Return the beginning of the reply to a read: STX and the echoed parameter."""
    return STX + b"%02d%02d" % (menu, number)


def reset(address: int) -> bytes:
    """Return the beginning of a request: EOT and the address, each digit twice."""
    tens, units = divmod(address, 10)
    return EOT + b"%d%d%d%d" % (tens, tens, units, units)


LINE = LineSettings(9600, bytesize=7, parity="E")  # ten bits per character, like 8N1
PROFILE = Profile(
    name="mentor",
    title="Mentor II",
    addresses=range(1, 100),
    broadcast=0,
    line=LINE,
    other_lines=LINE.at(4800, 19200, 2400, 38400),  # beyond 9600 with an option module
    timings=Timings.uniform(ReplyTiming(late_after=0.05, window=0.15, max_reply_delay=0.3, inter_byte_timeout=0.05)),
    probe=Read(1, 17),
    # A reply contains its parameter, so these replies differ (R15).
    sync_reads=tuple(Read(1, number) for number in range(17, 22)),
    acks_are_commands=True,
    shares_line_with=frozenset({"ct-ansi"}),  # with addresses that both accept: 11 to 99 without the tens
)
CHAINED = replace(PROFILE, merge=merge_runs)
"""For lines on which short commands are safe: poll groups read neighbouring parameters as runs."""
