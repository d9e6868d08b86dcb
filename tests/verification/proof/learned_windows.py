"""Learned windows (`Setup.learned`): what stands for them, and why that is sound.

What is known of a node may be anything: so nothing is noted, and nothing gone back from. Where a learned window is
awaited, it is any time between the least and the longest one, and another one each time: whatever was learned is among
it. There is no grid. As it ships, the last attempt of a read, writes and what is asked of a node that has not answered
yet have the document's window, and a second of three attempts has twice as much.

Whether a pause was longer than a window is told by any such window. Less than is possible is explored in these: the
pause that ends a reply is the shortest that is learned; the document's times do not come back for a while; how late
a reply is that is no later than usual (`NodeRecord.latest`) is told by the least or the longest window.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, ClassVar, TypeAlias

from busmaster.arbiter.learned import AT_LAST, LEAST_SILENCE, NEVER, Learning
from busmaster.arbiter.on_wire import OnWire, Step
from busmaster.contract.timing import ReplyTiming, Timings
from tests.verification.proof.kinds import KINDS
from tests.verification.proof.setups import Setup
from tests.verification.proof.wire import Outside, choose

StandIn: TypeAlias = tuple[type, str, Callable[..., Any]]
"""Whose attribute is replaced, its name, and by what."""


class AnyTime:
    """Stands for the time until which the line is held back."""

    at: ClassVar[list[float]] = [0.0]
    """Any time from now on, of the run."""
    chosen: ClassVar[list[bool]] = [False]
    """It was waited for in this step."""


@dataclass(frozen=True)
class AnyWindow:
    """Stands for a learned window: any from the least to the longest, in seconds, each time that one is awaited."""

    least: float
    longest: float

    def __radd__(self, start: Any) -> Any:
        """Return any time within it behind `start`: the one that is any time from now on, where it is one of these. An
        event begins one step at the most, and no reply goes on in pieces."""
        ends = AnyTime.at[0]
        if ends < start + self.least or ends > start + self.longest:
            raise Outside
        return ends

    def __lt__(self, time: Any) -> bool:
        """Whether it was over in that time."""
        return bool(time > self.least and (time > self.longest or choose(2)))

    def __mul__(self, number: float) -> AnyWindow:
        return self  # a message, or who has become slower: of both is nothing asked

    __rmul__ = __mul__

    def __format__(self, how: str) -> str:
        return "any"


def learned_windows(setup: Setup) -> list[StandIn]:
    """Return what is replaced where windows are learned."""
    assert setup.in_sync, "only R15 makes learned windows safe"
    assert setup.whole, "how long a reply goes on is no learned window"
    assert setup.learned is not None
    return [
        (Learning, "timings", _any_times(*setup.learned, KINDS[setup.kind]().profile.line.byte_time)),
        (OnWire, "learn", _learns_nothing),
        (Learning, "was_late", _learns_nothing),
        (Learning, "was_away", _learns_nothing),
        (Step, "gap_over", _goes_on if setup.kind == "msc" or setup.pauses else _is_whole),
    ]


def _learns_nothing(*arguments: Any) -> None:
    """What is known of a node may be anything, and is never gone back from."""


def _any_times(least: float, longest: float, byte_time: float) -> Callable[..., Timings]:
    """Return what says with which times a command is opened: nothing depends on the command itself."""
    given: dict[tuple[Timings, int], Timings] = {}

    def timings(learning: Learning, command: object, document: Timings, patience: int) -> Timings:
        if patience == NEVER:
            return document
        found = given.get((document, patience))
        if found is None:
            read = awaited(document.read, patience)
            packet = awaited(document.packet, patience)
            found = given[document, patience] = Timings(read, awaited(document.write, AT_LAST), packet)
        return found

    def awaited(document: ReplyTiming, patience: int) -> ReplyTiming:
        """Return the document's times with a learned silence, and but for the last attempt with any window."""
        pause = min(document.inter_byte_timeout, LEAST_SILENCE * byte_time)
        first, last = min(patience * least, document.window), min(patience * longest, document.window)
        timing = replace(
            document,
            late_after=min(document.late_after, first),
            inter_byte_timeout=pause,
            silence=document.inter_byte_timeout,
        )
        if first < last:
            object.__setattr__(timing, "window", AnyWindow(first, last))  # no number, as it must be
        return timing

    return timings


def _goes_on(step: Step, now: float) -> float:
    """MSC's reader waits for more behind an ACK where a packet is due, and any reader behind a part of a reply. The
    limit for a trickle is left out: it is a whole reply and a pause behind the window."""
    return now + step.timing.inter_byte_timeout + step.latency + step.byte_time


def _is_whole(step: Step, now: float) -> float:
    raise AssertionError("a reply goes on, though these are whole")
