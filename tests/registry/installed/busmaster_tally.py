"""A protocol that another package brings, invented for the tests: counters of a turnstile.

    read    ? node counter CR            answered by = node counter four hexadecimal digits CR
    write   ! node counter digits CR     answered by + CR, or - CR

Node 0 to 9, counter a to z.
"""

from __future__ import annotations

import string
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from busmaster import InvalidCommand, Point, Refused
from busmaster.bus.handle import Handle, unknown_item
from busmaster.contract.arguments import whole_number
from busmaster.contract.exchange import MORE, Command, Done, FrameError, Need, Sizes, no_reply
from busmaster.contract.frames import Direction, Frame, Kind
from busmaster.contract.items import Item
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.emulator.device import Delay, Device, held
from busmaster.emulator.traceable import TraceableMemory
from busmaster.registry import NodeKind, Option, Protocol, everywhere
from busmaster.wire.readers import SingleStep

CR = b"\r"


class Talk(SingleStep):
    """One attempt: the reply begins with `header`, and ends with CR."""

    def __init__(self, request: str, header: str, digits: int, timing: ReplyTiming) -> None:
        super().__init__(request.encode() + CR, timing)
        self.header = header.encode()
        self.starts = self.header[:1] + b"-"
        self.answers = self.overdue = (self.header,)
        self.length = len(header) + digits + 1
        self.sizes = Sizes(self.length, self.length)
        self.heard = b""

    def feed(self, data: bytes, /) -> Need | Done[Any]:
        self.heard += data
        if self.heard.startswith(b"-\r"):
            raise Refused
        if not self.heard.startswith(self.header) and not self.header.startswith(self.heard):
            if self.heard != b"-":
                raise FrameError("wrong echo", heard=self.heard)
            return MORE
        if len(self.heard) < self.length:
            return MORE
        digits = self.heard[len(self.header) : self.length - 1]
        return Done(int(digits, 16) if digits else None, rest=self.heard[self.length :])

    def expired(self, started: bool, /) -> Done[Any]:
        raise FrameError("cut short") if started else no_reply()


@dataclass(frozen=True, slots=True)
class Count:
    """Read a counter."""

    counter: str

    writes: ClassVar[bool] = False
    idempotent: ClassVar[bool] = True

    def __str__(self) -> str:
        return f"read counter {self.counter}"

    def open(self, address: int, timings: Timings, /) -> Talk:
        return Talk(f"?{address}{self.counter}", f"={address}{self.counter}", 4, timings.read)


@dataclass(frozen=True, slots=True)
class Preset:
    """Write a counter."""

    counter: str
    value: int

    writes: ClassVar[bool] = True
    idempotent: ClassVar[bool] = True

    def __post_init__(self) -> None:
        whole_number(self.value, 0, 0xFFFF, "a count")

    def __str__(self) -> str:
        return f"write counter {self.counter} = {self.value}"

    def open(self, address: int, timings: Timings, /) -> Talk:
        return Talk(f"!{address}{self.counter}{int(self.value):04x}", "+", 0, timings.write)


class Turnstile(Handle):
    """Counters a to z; `gate` is the one that "gate" stands for."""

    profile = Profile(
        name="tally",
        title="Tally",
        addresses=range(10),
        line=LineSettings(9600),
        timings=Timings.uniform(
            ReplyTiming(late_after=0.05, window=0.1, max_reply_delay=0.15, inter_byte_timeout=0.02)
        ),
        probe=Count("a"),
        shares_line_with=frozenset({"mentor"}),
    )

    def __init__(self, bus: Any, address: int, *, gate: int = 1, **options: Any) -> None:
        super().__init__(bus, address, **options)
        self.gate = string.ascii_lowercase[gate - 1]

    def point(self, item: str) -> Point[int]:
        counter = self.gate if item == "gate" else item
        if len(counter) != 1 or counter not in string.ascii_lowercase:
            raise unknown_item(item, ("gate",), "a counter, a to z, or gate")
        return Point(self.node, item, Count(counter), encode=lambda value: Preset(counter, value))

    @classmethod
    def items(cls) -> tuple[str, ...]:
        return ("gate",)


class EmulatedTurnstile(Device):
    """Counts in memory."""

    def __init__(self, address: int, *, delay: Delay, gate: int) -> None:
        super().__init__(address, delay=delay)
        self.gate = string.ascii_lowercase[gate - 1]
        self.routes = (b"?%d" % address, b"!%d" % address)
        self.counts = dict.fromkeys(string.ascii_lowercase, 0)
        self._frame = b""

    def preset(self, item: str, *values: float) -> None:
        counter = self.gate if item == "gate" else item
        if counter not in self.counts or len(values) != 1:
            raise InvalidCommand(f"a turnstile has no counter {item!r}")
        self.counts[counter] = held(values[0], 0, 0xFFFF, f"counter {counter}")

    def hear_byte(self, byte: int, now: float) -> None:
        self._frame = bytes((byte,)) if byte in b"?!" else self._frame + bytes((byte,))
        self.attentive = bool(self._frame) and byte != CR[0]
        if not self.attentive:
            frame, self._frame = self._frame, b""
            if frame.startswith(self.routes):
                self.reply(self._answer(frame[:-1].decode()), now)

    def _answer(self, frame: str) -> bytes:
        if frame[2:3] not in self.counts:
            return b"-\r"
        if frame[0] == "?":
            return b"=%s%04x\r" % (frame[1:3].encode(), self.counts[frame[2]])
        self.counts[frame[2]] = int(frame[3:], 16)
        return b"+\r"


class TallyDialect:
    """A frame ends with CR, and its first byte says what it is."""

    starts = b"?!=+-"

    def __init__(self) -> None:
        self._asked: Frame | None = None

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        if data[0] not in self.starts:
            return -1
        return data.find(CR) + 1 or (-len(data) if quiet else 0)

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        text = raw[:-1].decode("ascii", "backslashreplace")
        if text[0] in "?!":
            kind, value = (Kind.READ, "") if text[0] == "?" else (Kind.WRITE, str(int(text[3:], 16)))
            self._asked = Frame(kind, Direction.HOST, raw, int(text[1]), kind.value, text[2:3], value)
            return self._asked
        asked, self._asked = self._asked, None
        kind = {"=": Kind.VALUE, "+": Kind.ACK, "-": Kind.NAK}[text[0]]
        frame = Frame(kind, Direction.NODE, raw, asked.node if asked else None, answers=asked is not None)
        if kind is Kind.VALUE:
            frame.item, frame.value = text[2:3], str(int(text[3:], 16))
        return frame

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        return Count(request.item) if request.kind is Kind.READ else Preset(request.item, int(request.value))


def make_device(
    address: int, /, *, delay: Delay, traceable: TraceableMemory | None, lively: bool, gate: int = 1
) -> Device:
    if traceable is not None:
        raise InvalidCommand("a turnstile has no traceable")
    return EmulatedTurnstile(address, delay=delay, gate=gate)


GATE = Option("gate", "whole", "which counter gate has, 1 for a")


PROTOCOL = Protocol(
    profile=Turnstile.profile,
    kinds=(
        NodeKind(
            "tally",
            Turnstile,
            make_device,
            items="a counter, a to z, or gate",
            documented=(
                *(
                    Item(letter, letter, "how many have passed", access="read/write")
                    for letter in string.ascii_lowercase
                ),
                Item("gate", "", "the counter that gate has", access="read/write"),
            ),
            options=(GATE,),
            emulated=(GATE,),
            whole_numbers=everywhere,
        ),
    ),
    commands={"count": Count, "preset": Preset},
    dialect=TallyDialect,
)
