"""When replies are awaited: the reply times of one kind of exchange, and of one node."""

from __future__ import annotations

from dataclasses import dataclass, replace

from busmaster.contract.arguments import seconds
from busmaster.errors import InvalidCommand
from busmaster.renames import refuse_old_arguments


@dataclass(frozen=True, slots=True)
class ReplyTiming:
    """When a reply is awaited, in seconds from the request's last byte on the wire.

    Raises `InvalidCommand` unless 0 <= late_after <= window <= max_reply_delay and inter_byte_timeout > 0,
    driver_release_time >= 0.

    `silence` is set where the window is learned: after so many seconds without a byte the line goes on, though the
    maximum reply delay is not over; what may still come is overdue until it is (R15). None: the line waits for the
    maximum reply delay (R3).
    """

    late_after: float
    """A reply begun by then is on time."""
    window: float
    """A reply begun by then is accepted, and counted late after `late_after`."""
    max_reply_delay: float
    """What has not begun by then never comes: the promise R3 rests on it. A reply begun between `window` and then is
    accepted and counted late, too, unless the window is learned."""
    inter_byte_timeout: float
    """The longest pause between two bytes of one frame."""
    driver_release_time: float = 0.0
    """The node's driver holds the line this long after its reply."""
    silence: float | None = None
    """Where the window is learned, the silence that ends a resynchronisation by itself."""

    def __new__(cls, *args: object, **named: object) -> ReplyTiming:
        """Refuse the names that arguments had before version 0.3, with the new ones."""
        refuse_old_arguments(named, "ReplyTiming")
        return object.__new__(cls)

    def __post_init__(self) -> None:
        for name in ("late_after", "window", "max_reply_delay", "inter_byte_timeout", "driver_release_time"):
            seconds(getattr(self, name), f"a reply's {name}")
        if not self.late_after <= self.window <= self.max_reply_delay:
            raise InvalidCommand(
                f"reply times must satisfy 0 <= late_after <= window <= max_reply_delay, "
                f"not {self.late_after:g}, {self.window:g}, {self.max_reply_delay:g} s"
            )
        if not self.inter_byte_timeout:
            raise InvalidCommand("a reply's inter_byte_timeout is above 0 s")

    @property
    def awaited(self) -> float:
        """Until when a reply that has not begun is awaited: the maximum reply delay, or the window where that is
        learned."""
        return self.max_reply_delay if self.silence is None else self.window

    def with_window(self, window: float) -> ReplyTiming:
        """Return the same with another reply window; late_after and max_reply_delay move only as far as they must."""
        return replace(
            self,
            late_after=min(self.late_after, window),
            window=window,
            max_reply_delay=max(self.max_reply_delay, window),
        )

    def with_max_reply_delay(self, max_reply_delay: float) -> ReplyTiming:
        """Return the same with at least this maximum reply delay."""
        return self if max_reply_delay <= self.max_reply_delay else replace(self, max_reply_delay=max_reply_delay)


@dataclass(frozen=True, slots=True)
class Timings:
    """The reply times of one node: `read` and `write` for the first step, `packet` for a packet after its ACK (MSC)."""

    read: ReplyTiming
    write: ReplyTiming
    packet: ReplyTiming

    @classmethod
    def uniform(cls, timing: ReplyTiming) -> Timings:
        """Return the same times for reads, writes and packets."""
        return cls(timing, timing, timing)

    def with_window(self, window: float) -> Timings:
        """Return the same with another window for every first step; a packet's is only ever lengthened."""
        packet = self.packet.with_window(max(window, self.packet.window))
        return Timings(self.read.with_window(window), self.write.with_window(window), packet)

    def with_max_reply_delay(self, max_reply_delay: float) -> Timings:
        """Return the same with at least this maximum reply delay for each of the three."""
        return Timings(
            self.read.with_max_reply_delay(max_reply_delay),
            self.write.with_max_reply_delay(max_reply_delay),
            self.packet.with_max_reply_delay(max_reply_delay),
        )


__all__ = [
    "ReplyTiming",
    "Timings",
]
