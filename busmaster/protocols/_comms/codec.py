"""The common part of HCP and HCP2: numbered elements of the comms array, read one at a time and written one or many.

They differ in the addresses of nodes, the numbers of elements and the checksums: see `hcp` and `hcp2`.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from ctypes import c_float
from dataclasses import dataclass, field
from typing import Any, ClassVar, NoReturn

from busmaster.contract.arguments import whole_number
from busmaster.contract.exchange import Sizes
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand, Refused
from busmaster.wire.numbers import LONGEST_LIST, LONGEST_NUMBER, format_list, format_number, parse_number
from busmaster.wire.readers import NAK, AcknowledgeReader, TelegramReader, telegram_sizes

LINE = LineSettings(57600)
OTHER_LINES = LINE.at(9600, 19200, 38400, 115200)
CHECKED = (1, 2, 3, 4, 5, 6, 7, 99)
"""Elements that every controller has: cheap reads whose replies differ (R15)."""
# Taken literally, the 50 ms and the further 100 ms are the maximum reply delay.
TIMINGS = Timings.uniform(ReplyTiming(late_after=0.05, window=0.1, max_reply_delay=0.15, inter_byte_timeout=0.02))
"""Both documents: "normally within 50ms", but other work "could delay the reply by 100mS"."""


@dataclass(frozen=True, slots=True)
class ReadElement:
    """Read one element. Raises InvalidCommand for a number that the protocol does not have."""

    element: int

    last: ClassVar[int]
    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "element", whole_number(self.element, 1, self.last, "element"))

    def __str__(self) -> str:
        return f"read element {self.element}"

    @property
    def places(self) -> tuple[Hashable, ...]:
        return (self.element,)

    def shown(self, values: Mapping[Hashable, Any]) -> Any:
        return values[self.element]

    def place_values(self, value: Any, profile: Profile) -> Mapping[Hashable, Any]:
        return {self.element: value}

    @staticmethod
    def encode(address: int, element: int) -> tuple[bytes, bytes]:
        """Return the request, and the beginning of its reply: STX and the echoed element."""
        raise NotImplementedError

    def open(self, address: int, timings: Timings) -> Reading:
        request, header = self.encode(address, self.element)
        return Reading(request, header, timings.read)


@dataclass(frozen=True, slots=True)
class WriteElements:
    """Write `values` to `element` and those after it, in one telegram.

    Writing Comms 1 to 5 starts a Mint event, even if the value is the same. So the caller decides whether it is
    `idempotent`. Raises InvalidCommand if there is no value, for elements that do not exist, and for values that cannot
    be sent or do not fit into 60 characters.
    """

    element: int
    values: tuple[float, ...]
    idempotent: bool = False
    text: str = field(init=False, repr=False, compare=False)

    last: ClassVar[int]
    hints: ClassVar[Mapping[int, str]] = {}
    """Remedies for refusals, for elements that nodes refuse for special reasons."""
    writes: ClassVar[bool] = True

    def __post_init__(self) -> None:
        values = tuple(self.values)
        if not values:
            raise InvalidCommand("there is no value to write")
        element = whole_number(self.element, 1, self.last, "element")
        whole_number(element + len(values) - 1, 1, self.last, "the last of the elements")
        object.__setattr__(self, "element", element)
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "text", format_list(values))

    def __str__(self) -> str:
        many = len(self.values) - 1
        which = f"elements {self.element}-{self.element + many}" if many else f"element {self.element}"
        return f"write {which} = {self.text}"

    def changes(self, profile: Profile) -> Mapping[Hashable, Any]:
        """Return the values as they are sent: rounded to the digits of the text."""
        return dict(enumerate(map(float, self.text.split(",")), self.element))

    @staticmethod
    def encode(address: int, element: int, text: bytes) -> bytes:
        """Return the request that writes the numbers in this text."""
        raise NotImplementedError

    def open(self, address: int, timings: Timings) -> Writing | WritingMany:
        request = self.encode(address, self.element, self.text.encode())
        if len(self.values) == 1:
            return Writing(request, timings.write, self.hints.get(self.element))
        return WritingMany(request, timings.write)


class Reading(TelegramReader[float]):
    """One attempt to read an element."""

    __slots__ = ()

    longest = LONGEST_NUMBER
    sizes: ClassVar[Sizes] = telegram_sizes(echo=2, typical=7, longest=LONGEST_NUMBER)

    parse = staticmethod(parse_number)


class Writing(AcknowledgeReader):
    """One attempt to write one element. `hint`: the remedy if the node refuses it; None for the usual hint."""

    __slots__ = ("_hint",)

    def __init__(self, request: bytes, timing: ReplyTiming, hint: str | None = None) -> None:
        super().__init__(request, timing)
        self._hint = hint

    def reject(self, heard: bytes) -> NoReturn:
        """Raise the failure that the received byte means."""
        if heard[0] == NAK[0] and self._hint is not None:
            raise Refused(hint=self._hint)
        super().reject(heard)


class WritingMany(AcknowledgeReader):
    """One attempt to write several elements. A NAK is final, because the values before the refused one may be
    stored."""

    __slots__ = ()

    def reject(self, heard: bytes) -> NoReturn:
        """Raise the failure for the received byte. A NAK is Refused and is not confirmed by a second request."""
        if heard[0] == NAK[0]:
            raise Refused(
                "refused; the values before the one refused may be stored",
                confirm=False,
                hint="read the elements back; check that each exists, is writable and within its limits",
            )
        super().reject(heard)


def telegrams(values: Sequence[float]) -> Iterator[tuple[int, tuple[float, ...]]]:
    """Split a list so that each part fits into one telegram: (offset of its first value, its values)."""
    start = used = 0
    for index, value in enumerate(values):
        size = len(format_number(value))
        if index > start and used + 1 + size > LONGEST_LIST:
            yield start, tuple(values[start:index])
            start, used = index, 0
        used += size + (index > start)
    if len(values) > start:
        yield start, tuple(values[start:])


def is_read_back(written: float, read: float) -> bool:
    """Return True if a controller with single-precision numbers returns `read` for `written`, at 4 decimals."""
    return c_float(float(format_number(written))).value == c_float(round(read, 4)).value
