"""DC104-SER: one drive on a line of its own, up to 255 parameters of 16 bits.

    read    STX AA parameter checksum             ->  STX parameter high low checksum, or NAK
    write   STX 55 parameter high low checksum    ->  ACK when the drive has taken and completed it, or NAK

The checksum is the sum, modulo 256, of all bytes between STX and itself ("Reading Command Packet Structure" and
"Writing Command Structure"). No packet carries an address; a reply carries the parameter and no direction byte.
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar

from busmaster.contract.arguments import whole_number
from busmaster.contract.exchange import MORE, Done, FrameError, Need, Sizes, no_reply, other_format
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.wire.checks import sum8
from busmaster.wire.readers import NAK, STX, AcknowledgeReader, SingleStep

READ = 0xAA
WRITE = 0x55
HIGHEST_PARAMETER = 255
HIGHEST_VALUE = 65535


def packet(*between: int) -> bytes:
    """Return a packet of these bytes between STX and checksum, each 0 to 255."""
    return STX + bytes((*between, sum8(bytes(between))))


class Reading(SingleStep):
    """One attempt to read: five bytes with the parameter, or a single NAK."""

    __slots__ = ("_buffer", "_parameter", "answers")

    length: ClassVar[int] = 5
    sizes: ClassVar[Sizes] = Sizes(length, length)
    starts: ClassVar[bytes] = STX + NAK  # the manual defines NAK only for writes; here it is a refusal

    def __init__(self, parameter: int, timing: ReplyTiming) -> None:
        super().__init__(packet(READ, parameter), timing)
        self._parameter = parameter
        self._buffer = b""
        self.answers = (STX + bytes((parameter,)),)

    @property
    def overdue(self) -> tuple[bytes, ...]:
        return self.answers

    def feed(self, data: bytes, /) -> Need | Done[int]:
        buffer = self._buffer = self._buffer + data
        if not buffer:
            return MORE
        if buffer[0] != STX[0]:
            self.reject(buffer)
        if len(buffer) < self.length:
            return MORE
        _, parameter, high, low, check = buffer[: self.length]
        rest = buffer[self.length :]
        if parameter != self._parameter:
            raise FrameError(f"wrong echo: parameter {parameter} in place of {self._parameter}", heard=buffer)
        if check != sum8(bytes((parameter, high, low))):
            if rest and buffer[-1] == sum8(buffer[1:-1]):
                raise other_format(len(buffer), f"a reply has {self.length}")
            # After a whole frame the line does not wait for the maximum reply delay (R3).
            raise FrameError("bad checksum", whole=not rest)
        return Done(high << 8 | low, rest=rest)

    def expired(self, started: bool, /) -> Done[int]:
        raise FrameError(f"reply cut short after {len(self._buffer)} bytes") if self._buffer else no_reply()


class Writing(AcknowledgeReader):
    """One attempt to write: a single ACK or NAK."""

    __slots__ = ()


@dataclass(frozen=True, slots=True)
class Read:
    """Read one parameter, 1 to `maximum`: its value is 0 to 65535.

    A packet can contain parameter 0 too. Both routines of the document exclude it; it requires `minimum=0`.
    """

    parameter: int
    maximum: int = field(default=HIGHEST_PARAMETER, compare=False, repr=False)
    minimum: int = field(default=1, compare=False, repr=False)

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        _check_parameter(self)

    def __str__(self) -> str:
        return f"read parameter {self.parameter}"

    @property
    def places(self) -> tuple[Hashable, ...]:
        return (self.parameter,)

    def shown(self, values: Mapping[Hashable, Any]) -> Any:
        return values[self.parameter]

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {self.parameter: value}

    def open(self, address: int, timings: Timings, /) -> Reading:
        return Reading(self.parameter, timings.read)


@dataclass(frozen=True, slots=True)
class Write:
    """Write 0 to 65535 to one parameter, 1 to `maximum` (0 requires `minimum=0`)."""

    parameter: int
    value: int
    maximum: int = field(default=HIGHEST_PARAMETER, compare=False, repr=False)
    minimum: int = field(default=1, compare=False, repr=False)

    writes: ClassVar[bool] = True
    idempotent: ClassVar[bool] = False

    def __post_init__(self) -> None:
        _check_parameter(self)
        object.__setattr__(self, "value", whole_number(self.value, 0, HIGHEST_VALUE, "a value"))

    def __str__(self) -> str:
        return f"write parameter {self.parameter} = {self.value}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        return {self.parameter: self.value}

    def open(self, address: int, timings: Timings, /) -> Writing:
        return Writing(packet(WRITE, self.parameter, self.value >> 8, self.value & 0xFF), timings.write)


def _check_parameter(command: Read | Write) -> None:
    lowest = whole_number(command.minimum, 0, 1, "minimum")
    highest = whole_number(command.maximum, 1, HIGHEST_PARAMETER, "maximum")
    object.__setattr__(command, "parameter", whole_number(command.parameter, lowest, highest, "a parameter"))


_READ_TIMING = ReplyTiming(late_after=0.05, window=0.1, max_reply_delay=0.2, inter_byte_timeout=0.02)
_WRITE_TIMING = ReplyTiming(late_after=0.5, window=0.5, max_reply_delay=0.6, inter_byte_timeout=0.02)
PROFILE = Profile(
    name="dc104",
    title="DC104-SER",
    addresses=range(1),
    addressed=False,
    line=LineSettings(19200),
    timings=Timings(_READ_TIMING, _WRITE_TIMING, packet=_READ_TIMING),
    probe=Read(1),
    # A reply contains its parameter, so these replies differ (R15).
    sync_reads=tuple(Read(parameter) for parameter in range(1, 9)),
    fixed_rate=True,  # only 19200 baud
)
"""The document contains no times. The reply to a write comes after its completion, EEPROM included, so its window is
longer."""
