"""EI-Bisynch ASCII (ANSI X3.28-2.5-A4/B1): Eurotherm 800, 900 and 2000 series, Parker SSD 590, 605 and 650.

    read    EOT g g u u [channel] c1 c2 ENQ                     STX [channel] c1 c2 data ETX BCC; EOT: no such parameter
    write   EOT g g u u STX [channel] c1 c2 data ETX BCC        ACK or NAK; the mnemonic EE then holds the reason
    then    ACK or NAK alone                                    the next parameter of the node's list, or the same again

An address is two digits (group and unit), each sent twice. A parameter is a mnemonic of two characters, with the digit
of a channel in front where an instrument has several. Data are a decimal number with a decimal point, or `>` and
hexadecimal digits. The line has 7 bits and even parity, as that of Mentor II, whose framing this protocol shares.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from decimal import Decimal
from functools import lru_cache
from typing import Any, ClassVar, NoReturn

from busmaster.contract.arguments import whole_number
from busmaster.contract.exchange import Done, Expect, FrameError, LaterStep, Need, Sizes
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand
from busmaster.protocols.mentor.codec import ParameterReading, Writing, reset
from busmaster.wire.checks import bcc, xor
from busmaster.wire.readers import ACK, ENQ, ETX, NAK, STX, telegram_sizes

LONGEST_DATA = 12
"""Characters of data. The documents name at most 7, and 10 for totals of recorders."""
MOST_OF_A_RUN = 32
"""Parameters that one exchange reads."""

_NAME = re.compile(r"([0-9]?)([!-~]{2})", re.ASCII)
_NUMBER = re.compile(rb" *([+-]?(?:\d+\.?\d*|\.\d+)) *", re.ASCII)
_HEXADECIMAL = re.compile(rb" *>([0-9A-Fa-f]{1,8}) *", re.ASCII)
_HIGHEST_WORD = 0xFFFF


def check_name(name: str) -> None:
    """Raise InvalidCommand unless `name` is a mnemonic, or the digit of a channel and a mnemonic: "PV", "2PV"."""
    try:
        match = _NAME.fullmatch(name)
    except TypeError:  # a number
        match = None
    if match is None:
        raise InvalidCommand(
            f"{name!r} is not a mnemonic: use its two characters, as in 'PV', after the digit of a channel as in '1PV'"
        )


def place_of(name: str) -> tuple[str, str]:
    """Return channel and mnemonic. A name without a channel means channel 1."""
    return name[:-2] or "1", name[-2:]


@dataclass(frozen=True, slots=True)
class Read:
    """Read one parameter: an int, or a float where the instrument sends decimals.

    `name` is the mnemonic, with the digit of a channel in front if the instrument has several. `printable_check`: the
    instrument adds 32 to a BCC below 32. Raises InvalidCommand for a name of another form.
    """

    name: str
    printable_check: bool = False

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_name(self.name)

    def __str__(self) -> str:
        return f"read {self.name}"

    @property
    def places(self) -> tuple[Hashable, ...]:
        return (place_of(self.name),)

    def shown(self, values: Mapping[Hashable, Any]) -> Any:
        return values[place_of(self.name)]

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {place_of(self.name): value}

    def open(self, address: int, timings: Timings) -> Reading:
        request, header = read_request(address, self.name)
        return _reading(self.printable_check)(request, header, timings.read)


@dataclass(frozen=True, slots=True)
class ReadRun:
    """Read several parameters in one exchange: a tuple.

    The first is requested by address. A NAK requests the same parameter again, if its name is repeated, and an ACK
    requests the next one. So `names` must be in the order of the instrument's own list, and each reply is compared with
    its name. Every parameter after the first costs one byte. Another instrument's ACK or NAK is the same byte: use it
    only if each instrument forgets its last read when another is addressed.
    """

    names: tuple[str, ...]
    printable_check: bool = False

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if type(self.names) is not tuple or not 1 <= len(self.names) <= MOST_OF_A_RUN:
            raise InvalidCommand(f"a run is a tuple of 1 to {MOST_OF_A_RUN} mnemonics, not {self.names!r}")
        for name in self.names:
            check_name(name)

    def __str__(self) -> str:
        return f"read {', '.join(self.names)}"

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {place_of(name): one for name, one in zip(self.names, value, strict=True)}

    def open(self, address: int, timings: Timings) -> RunReading:
        return RunReading(self, address, timings.read)


@dataclass(frozen=True, slots=True)
class Write:
    """Write one parameter.

    A number is sent with its decimal point and without zeros around it (free format). `width` fills it with zeros to
    this number of characters (fixed format). `hexadecimal` sends `>` and four digits, 0 to 65535, or two for a bool.
    Raises InvalidCommand for a value that does not fit.
    """

    name: str
    value: float
    hexadecimal: bool = False
    width: int = 0
    printable_check: bool = False
    idempotent: bool = False
    text: str = field(init=False, repr=False, compare=False)

    writes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        check_name(self.name)
        object.__setattr__(self, "width", whole_number(self.width, 0, LONGEST_DATA, "the width of a number"))
        object.__setattr__(self, "text", self._format())

    def _format(self) -> str:
        if self.hexadecimal:
            if isinstance(self.value, bool):
                return f">{int(self.value):02X}"
            return f">{whole_word(self.value):04X}"
        number = int(self.value) if isinstance(self.value, bool) else self.value
        if not is_sendable(number):
            raise InvalidCommand(f"{self.value!r} is not a number that can be sent")
        digits = f"{abs(Decimal(str(number))):f}"
        # The document: the decimal point is not optional.
        digits = digits.rstrip("0") if "." in digits else f"{digits}."
        sign = "-" if number < 0 else ""
        text = sign + digits.zfill(self.width - len(sign))
        longest = self.width or LONGEST_DATA
        if len(text) > longest:
            raise InvalidCommand(f"{self.value!r} does not fit into {longest} characters")
        return text

    def __str__(self) -> str:
        return f"write {self.name} = {self.text}"

    @property
    def number(self) -> float:
        """The value that a read returns if the instrument stores the written value."""
        return int(self.text[1:], 16) if self.hexadecimal else float(self.text)

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return {place_of(self.name): self.number}

    def open(self, address: int, timings: Timings, /) -> Writing:
        body = (self.name + self.text).encode() + ETX
        check = bcc(body) if self.printable_check else xor(body)
        return Writing(reset(address) + STX + body + bytes((check,)), timings.write)


class Reading(ParameterReading[float]):
    """One attempt to read a parameter, or one step of a run."""

    __slots__ = ()

    check = staticmethod(xor)
    longest = LONGEST_DATA
    sizes: ClassVar[Sizes] = telegram_sizes(echo=2, typical=6, longest=LONGEST_DATA + 1)

    def parse(self, field: bytes) -> float:
        if match := _NUMBER.fullmatch(field):
            # "16." is a whole number, of a parameter without decimals
            return float(match[1]) if match[1].partition(b".")[2] else int(match[1].rstrip(b"."))
        if match := _HEXADECIMAL.fullmatch(field):
            return int(match[1], 16)
        raise FrameError(f"{field!r} is not a number")


class PrintableReading(Reading):
    """The same, where 32 is added to a BCC below 32."""

    __slots__ = ()

    check = staticmethod(bcc)


def _reading(printable_check: bool) -> type[Reading]:
    return PrintableReading if printable_check else Reading


class RunReading:
    """One attempt to read a run: a step for each parameter."""

    __slots__ = ("_kind", "_next", "_step", "_values", "answers", "later", "request", "timing")

    sizes: ClassVar[Sizes] = Reading.sizes
    starts: ClassVar[bytes] = Reading.starts
    closing: ClassVar[int] = 0
    answered: ClassVar[bool] = True

    def __init__(self, run: ReadRun, address: int, timing: ReplyTiming) -> None:
        headers = tuple(map(header_of, run.names))
        self.request, _ = read_request(address, run.names[0])
        self.timing = timing
        self.later: Sequence[LaterStep] = (LaterStep(timing, self.sizes, sent=1),) * (len(headers) - 1)
        self._kind = _reading(run.printable_check)
        self._next = list(reversed(headers[1:]))
        self._step = self._kind(self.request, headers[0], timing)
        self.answers = headers
        self._values: list[float] = []

    @property
    def overdue(self) -> tuple[bytes, ...]:
        """The parameter that was requested last: each further one takes a byte from the host."""
        return self._step.answers

    def feed(self, data: bytes) -> Need | Expect | Done[tuple[float, ...]]:
        step = self._step.feed(data)
        if not isinstance(step, Done):
            return step
        self._values.append(step.value)
        if not self._next:
            return Done(tuple(self._values), rest=step.rest)
        if step.rest:
            raise FrameError("bytes came before the next parameter was requested")
        header = self._next.pop()
        short = NAK if header == self._step.answers[0] else ACK
        self._step = self._kind(short, header, self.timing)
        return Expect(self.timing, self.sizes, short)

    def expired(self, started: bool) -> NoReturn:
        self._step.expired(started)


def whole_word(value: Any) -> int:
    """Return a value as a word of 16 bits. Raises InvalidCommand for any other value, such as a fraction."""
    if isinstance(value, float) and value.is_integer():  # as JSON and scaled points have it
        value = int(value)
    return whole_number(value, 0, _HIGHEST_WORD, "a hexadecimal value")


def is_sendable(value: Any) -> bool:
    """Return True for a finite number whose digits before the decimal point fit. Text is not a number."""
    try:
        return hasattr(value, "__float__") and abs(float(value)) < 10**LONGEST_DATA
    except (ValueError, OverflowError):
        return False


@lru_cache(maxsize=4096)
def read_request(address: int, name: str) -> tuple[bytes, bytes]:
    """Return the read request, and the beginning of its reply."""
    return reset(address) + name.encode() + ENQ, header_of(name)


def header_of(name: str) -> bytes:
    """Return the beginning of the reply to a read: STX and the echoed name."""
    return STX + name.encode()


LINE = LineSettings(9600, bytesize=7, parity="E")
# Both families have these three: the identity, the version of the software, and the last error.
_IN_SYNC = ("II", "V0", "EE")
PROFILE = Profile(
    name="ei-bisynch",
    title="EI-Bisynch",
    addresses=range(100),
    line=LINE,
    other_lines=LINE.at(4800, 19200),
    timings=Timings.uniform(ReplyTiming(late_after=0.1, window=0.25, max_reply_delay=0.5, inter_byte_timeout=0.05)),
    probe=Read("II"),
    sync_reads=tuple(map(Read, _IN_SYNC)),
    acks_are_commands=True,
)
PRINTABLE = replace(
    PROFILE, probe=Read("II", printable_check=True), sync_reads=tuple(Read(name, True) for name in _IN_SYNC)
)
"""Of instruments that add 32 to a BCC below 32."""
