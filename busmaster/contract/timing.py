"""Reply times of one kind of exchange, and of one node."""

from __future__ import annotations

from dataclasses import dataclass, replace

from busmaster.contract.arguments import seconds
from busmaster.contract.renames import refuse_old_arguments
from busmaster.errors import InvalidCommand


@dataclass(frozen=True, slots=True)
class ReplyTiming:
    """Reply times in seconds, from the request's last byte on the wire.

    Raises `InvalidCommand` unless 0 <= late_after <= window <= max_reply_delay and inter_byte_timeout > 0,
    driver_release_time >= 0.

    `silence` is set if the window is learned. Then the line continues before the maximum reply delay has passed, after
    this many seconds without a byte if any was received, and the reply is overdue until then (R15). None: the line
    waits for the maximum reply delay (R3).
    """

    late_after: float
    """A reply that begins by then is on time."""
    window: float
    """Reply window. A reply that begins after `late_after` is accepted and counted late."""
    max_reply_delay: float
    """Longest time after a request at which the reply can begin (R3). It must exceed the slowest reply. A reply that
    begins after `window` is accepted and counted late too, unless the window is learned."""
    inter_byte_timeout: float
    """Longest pause between two bytes of one frame."""
    driver_release_time: float = 0.0
    """Time for which the node's driver holds the line after its reply."""
    silence: float | None = None
    """With a learned window, the silence that ends a resynchronisation if bytes were received: the documented
    `inter_byte_timeout`, at least 20 ms."""

    def __new__(cls, *args: object, **named: object) -> ReplyTiming:
        """Reject the argument names from before version 0.3, and report the new ones."""
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
        """Time for which the line waits for a reply to begin: the maximum reply delay, or a learned window."""
        return self.max_reply_delay if self.silence is None else self.window

    def with_window(self, window: float) -> ReplyTiming:
        """Return the same times with another window; late_after and max_reply_delay change only as far as necessary."""
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
    """Reply times of one node: `read` and `write` for the first step, `packet` for a packet after its ACK (MSC)."""

    read: ReplyTiming
    write: ReplyTiming
    packet: ReplyTiming

    @classmethod
    def uniform(cls, timing: ReplyTiming) -> Timings:
        """Return the same times for reads, writes and packets."""
        return cls(timing, timing, timing)

    def with_window(self, window: float) -> Timings:
        """Return the same times with another window for every first step. A packet's window is only ever lengthened."""
        packet = self.packet.with_window(max(window, self.packet.window))
        return Timings(self.read.with_window(window), self.write.with_window(window), packet)

    def with_max_reply_delay(self, max_reply_delay: float) -> Timings:
        """Return the same times with at least this maximum reply delay for all three."""
        return Timings(
            self.read.with_max_reply_delay(max_reply_delay),
            self.write.with_max_reply_delay(max_reply_delay),
            self.packet.with_max_reply_delay(max_reply_delay),
        )


__all__ = [
    "ReplyTiming",
    "Timings",
]
