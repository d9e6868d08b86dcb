"""Readers for replies of the character protocols: HCP, HCP2 and Mentor II.

A telegram is STX, the echoed element or parameter, data, ETX and a checksum. Reading is positional: data is printable,
so the first ETX ends it, and the byte after that ETX is the checksum, whatever its value. Acknowledgements are one
byte. The first byte distinguishes the two, and each request has one valid set of first bytes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Generic, NoReturn, TypeVar

from busmaster.contract.exchange import MORE, Done, Expect, FrameError, LaterStep, Need, Sizes, no_reply, other_format
from busmaster.contract.timing import ReplyTiming
from busmaster.errors import Refused
from busmaster.wire.characters import made_of
from busmaster.wire.checks import xor

T = TypeVar("T")

STX = b"\x02"
ETX = b"\x03"
EOT = b"\x04"
ENQ = b"\x05"
ACK = b"\x06"
BEL = b"\x07"
NAK = b"\x15"

_STX = STX[0]
_PRINTABLE = made_of(bytes(range(0x20, 0x7F)))
_ENVELOPE = len(STX + ETX) + 1
_LONGER = 60
"""Characters by which data may be too long while its end is still awaited."""
_REFUSALS: Mapping[int, type[Refused]] = {NAK[0]: Refused}


def find_field(buffer: bytes, header: bytes, longest: int, check: Callable[[bytes], int]) -> bytes | None:
    """Return the data of a complete and valid telegram, which more bytes may follow; None if more bytes are needed.

    `header`: STX and the echo, without an ETX. `longest`: maximum number of data characters. Raises FrameError as soon
    as the bytes cannot become such a telegram; `whole` only if nothing but the checksum is wrong and nothing follows.
    If the data is too long, its end is awaited: its checksum distinguishes another format from a damaged ETX.
    """
    start = len(header)
    if buffer[:start] != header:
        if header.startswith(buffer):
            return None
        raise FrameError(f"wrong echo: {buffer[:start].hex(' ')} in place of {header.hex(' ')}", heard=buffer)
    head, _, tail = buffer.partition(ETX)  # takes two thirds of the time of searching for its position
    field = head[start : start + longest + 1]
    if field.translate(_PRINTABLE) != field:
        raise FrameError("a control character within the data")
    if len(field) > longest:
        _await_end(head, tail, start, longest, check)
        return None
    if not tail:
        return None
    if tail[0] != check(buffer[1 : len(head) + 1]):
        raise FrameError("bad checksum", whole=len(tail) == 1)
    return field


def _await_end(head: bytes, tail: bytes, start: int, longest: int, check: Callable[[bytes], int]) -> None:
    """Return while the end of data that is too long may still arrive, else raise the error."""
    field = head[start:]
    printable = field.translate(_PRINTABLE) == field
    if printable and not tail and len(field) <= longest + _LONGER:
        return
    if printable and tail and tail[0] == check(head[1:] + ETX):
        raise other_format(len(head) + 2, f"{len(field)} characters of data where {longest} are the most")
    raise FrameError(f"more than {longest} characters of data")


def telegram_sizes(echo: int, typical: int, longest: int) -> Sizes:
    """Calculate the length of a telegram in bytes from the characters of its echo and of its data."""
    return Sizes(_ENVELOPE + echo + typical, _ENVELOPE + echo + longest)


class SingleStep:
    """Common part of the exchanges of the character protocols."""

    __slots__ = ("request", "timing")

    refusals: ClassVar[Mapping[int, type[Refused]]] = _REFUSALS
    later: ClassVar[Sequence[LaterStep]] = ()
    closing: ClassVar[int] = 0
    answered: ClassVar[bool] = True

    def __init__(self, request: bytes, timing: ReplyTiming) -> None:
        self.request = request
        self.timing = timing

    def reject(self, heard: bytes) -> NoReturn:
        """Raise Refused or FrameError for bytes that cannot begin a reply."""
        refusal = self.refusals.get(heard[0])
        if refusal is not None:
            raise refusal
        raise FrameError(f"a reply cannot begin with {heard[0]:02x}", heard=heard)


class TelegramReader(SingleStep, Generic[T]):
    """A read: a telegram or a refusal. `header`: the beginning of the telegram, STX and the echo.

    A protocol sets the class attributes. `parse` returns the value of the data field, or raises FrameError.
    """

    __slots__ = ("_buffer", "answers")

    check = staticmethod(xor)
    longest: ClassVar[int]
    sizes: ClassVar[Sizes]
    starts: ClassVar[bytes] = STX + NAK

    def __init__(self, request: bytes, header: bytes, timing: ReplyTiming) -> None:
        self.request = request
        self.timing = timing
        self.answers: tuple[bytes, ...] = (header,)
        self._buffer = b""

    @property
    def overdue(self) -> tuple[bytes, ...]:
        return self.answers

    def parse(self, field: bytes) -> T:
        """Return the value of the data field. Raises FrameError if it is invalid."""
        raise NotImplementedError

    def feed(self, data: bytes) -> Need | Expect | Done[T]:
        buffer = self._buffer = self._buffer + data if self._buffer else data
        if not buffer:
            return MORE
        if buffer[0] != _STX:
            self.reject(buffer)
        header = self.answers[0]
        field = find_field(buffer, header, self.longest, self.check)
        if field is None:
            return MORE
        end = len(header) + len(field) + 2
        try:
            value = self.parse(field)
        except FrameError as error:
            raise other_format(end, error.what, send=error.send, heard=error.heard) from None
        return Done(value) if len(buffer) == end else Done(value, buffer[end:])

    def expired(self, started: bool) -> NoReturn:
        raise FrameError(f"reply cut short after {len(self._buffer)} bytes") if started else no_reply()


class AcknowledgeReader(SingleStep):
    """A write: a single ACK or a refusal."""

    __slots__ = ()

    sizes: ClassVar[Sizes] = Sizes(1, 1)
    starts: ClassVar[bytes] = ACK + NAK
    answers: ClassVar[tuple[bytes, ...]] = (ACK,)
    overdue: ClassVar[tuple[bytes, ...]] = answers

    def feed(self, data: bytes) -> Need | Expect | Done[None]:
        if not data:
            return MORE
        if data[0] != ACK[0]:
            self.reject(data)
        return Done(None, rest=data[1:])

    def expired(self, started: bool) -> NoReturn:
        raise no_reply()


__all__ = [
    "ACK",
    "BEL",
    "ENQ",
    "EOT",
    "ETX",
    "NAK",
    "STX",
    "AcknowledgeReader",
    "SingleStep",
    "TelegramReader",
    "find_field",
    "telegram_sizes",
]
