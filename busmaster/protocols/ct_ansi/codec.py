"""CT-ANSI of Control Techniques' later drives (Unidrive, Commander; option modules UD70 and UD78).

The frames are those of Mentor II. The data have a decimal point, and up to twelve characters. No drive has an address
whose second digit is 0: such addresses are groups, and 00 is all drives.
"""

from __future__ import annotations

import re
from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from decimal import ROUND_HALF_UP, Decimal
from typing import Any, ClassVar, SupportsFloat

from busmaster.contract.arguments import whole_number
from busmaster.contract.exchange import FrameError, Sizes
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.mentor.codec import Broadcast, ParameterReading, Writing, read_request, reset
from busmaster.wire.checks import bcc
from busmaster.wire.readers import ETX, STX, telegram_sizes

LONGEST_DATA = 12
_NUMBER = re.compile(rb" *([+-]?(?:\d+\.?\d*|\.\d+))", re.ASCII)
_HEXADECIMAL = re.compile(rb" *X([0-9A-Fa-f]+)")  # some products may send spaces or an X: both are accepted


class Reading(ParameterReading[float]):
    """One attempt to read a parameter, or one step of a run: a number with or without a decimal point."""

    __slots__ = ()

    longest = LONGEST_DATA
    sizes: ClassVar[Sizes] = telegram_sizes(echo=4, typical=6, longest=LONGEST_DATA)

    def parse(self, field: bytes) -> float:
        if match := _NUMBER.fullmatch(field):
            return float(match[1]) if b"." in match[1] else int(match[1])
        if match := _HEXADECIMAL.fullmatch(field):
            return int(match[1], 16)
        raise FrameError(f"{field!r} is not a number")


class RunReading(mentor.RunReading):
    """One attempt to read a run."""

    __slots__ = ()

    reading = Reading
    sizes: ClassVar[Sizes] = Reading.sizes


@dataclass(frozen=True, slots=True)
class Read(mentor.Read):
    """Read one parameter: an int, or a float if the drive sends a decimal point."""

    def open(self, address: int, timings: Timings) -> Reading:  # type: ignore[override]  # its value may be a float
        """Begin the read. Raises InvalidCommand for the broadcast address: all drives would reply at once."""
        request, header = read_request(address, self.menu, self.number)
        return Reading(request, header, timings.read)


@dataclass(frozen=True, slots=True)
class ReadRun(mentor.ReadRun):
    """Read `count` consecutive parameters in one exchange: a tuple. Mentor II's ReadRun states when this is safe."""

    def open(self, address: int, timings: Timings) -> RunReading:
        """Begin the read. Raises InvalidCommand for the broadcast address."""
        return RunReading(self, address, timings.read)


@dataclass(frozen=True, slots=True)
class Write:
    """Write one parameter: a number in its shortest exact form, with a decimal point if necessary; a bit as 1 or 0.

    A number with more decimals than fit into twelve characters is rounded to those that fit, half away from zero. Then
    `rounded` is not empty and is logged. Raises InvalidCommand for a value that does not fit even without decimals.
    """

    menu: int
    number: int
    value: float
    idempotent: bool = False
    text: str = field(init=False, repr=False, compare=False)

    writes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        whole_number(self.menu, 0, 99, "menu")
        whole_number(self.number, 0, 99, "parameter number")
        object.__setattr__(self, "text", self._format())

    def _format(self) -> str:
        if isinstance(self.value, bool):
            return str(int(self.value))
        if not is_sendable(self.value):
            raise InvalidCommand(f"{self.value!r} is not a number that can be sent")
        number = Decimal(str(self.value))
        text = _shortest(number)
        if len(text) > LONGEST_DATA:
            # Calculated values have up to 17 digits: 44.400000000000006.
            whole = len(f"{number:+.0f}")
            text = _shortest(number.quantize(Decimal(1).scaleb(min(0, whole + 1 - LONGEST_DATA)), ROUND_HALF_UP))
        if len(text) > LONGEST_DATA:
            raise InvalidCommand(f"{self.value!r} does not fit into {LONGEST_DATA} characters")
        return text

    @property
    def rounded(self) -> str:
        """Return a text for the log if the value was rounded, else ""."""
        if isinstance(self.value, bool) or Decimal(str(self.value)) == Decimal(self.text):
            return ""
        return f"{self} is rounded from {self.value!r}, which has more digits than a telegram"

    def __str__(self) -> str:
        return f"write {self.menu:02d}.{self.number:02d} = {self.text}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return {(self.menu, self.number): float(self.text)}

    def open(self, address: int, timings: Timings, /) -> Writing | Broadcast:
        body = b"%02d%02d%b" % (self.menu, self.number, self.text.encode()) + ETX
        request = reset(address) + STX + body + bytes((bcc(body),))
        return Writing(request, timings.write) if address else Broadcast(request, timings.write)


def _shortest(number: Decimal) -> str:
    """Return the shortest text of a number, with its sign."""
    text = f"{number:+f}"
    if "." in text:
        text = text.rstrip("0").rstrip(".")
    return "+0" if float(text) == 0 else text


def is_sendable(value: SupportsFloat) -> bool:
    """Return True for a number whose digits before the decimal point fit. Text is not a number."""
    try:
        # Text has no __float__, but float() would accept it.
        return hasattr(value, "__float__") and abs(float(value)) < 10**LONGEST_DATA
    except (ValueError, OverflowError):
        return False


LINE = LineSettings(9600, bytesize=7, parity="E")
PROFILE = Profile(
    name="ct-ansi",
    title="CT-ANSI",
    # A second digit of 0 means a group, and no drive replies.
    addresses=tuple(address for address in range(11, 100) if address % 10),
    broadcast=0,
    line=LINE,
    other_lines=LINE.at(4800, 19200, 2400, 38400),
    timings=Timings.uniform(ReplyTiming(late_after=0.05, window=0.15, max_reply_delay=0.3, inter_byte_timeout=0.05)),
    probe=Read(1, 17),
    sync_reads=tuple(Read(1, number) for number in range(17, 22)),
    acks_are_commands=True,
    shares_line_with=frozenset({"mentor"}),
)
