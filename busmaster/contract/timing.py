"""When replies are awaited: the reply times of one kind of exchange, and of one node."""

from __future__ import annotations

from dataclasses import dataclass, replace

from busmaster.contract.arguments import seconds
from busmaster.errors import InvalidCommand


@dataclass(frozen=True, slots=True)
class ReplyTiming:
    """When a reply is awaited, in seconds from the request's last byte on the wire.

    Raises `InvalidCommand` unless 0 <= nominal <= window <= lateness and byte_gap > 0, turnaround >= 0.

    `silence` is set where the window is learned: after so many seconds without a byte the line goes on, though the
    lateness is not over; what may still come is owed until it is (R15). None: the line waits for the lateness (R3).
    """

    nominal: float
    """A reply begun by then is on time."""
    window: float
    """A reply begun by then is accepted, and counted late after `nominal`."""
    lateness: float
    """What has not begun by then never comes: the promise R3 rests on it. A reply begun between `window` and then is
    accepted and counted late, too, unless the window is learned."""
    byte_gap: float
    """The longest pause between two bytes of one frame."""
    turnaround: float = 0.0
    """The node's driver holds the line this long after its reply."""
    silence: float | None = None
    """Where the window is learned, the silence that ends a settle by itself."""

    def __post_init__(self) -> None:
        for name in ("nominal", "window", "lateness", "byte_gap", "turnaround"):
            seconds(getattr(self, name), f"a reply's {name}")
        if not self.nominal <= self.window <= self.lateness:
            raise InvalidCommand(
                f"reply times must satisfy 0 <= nominal <= window <= lateness, "
                f"not {self.nominal:g}, {self.window:g}, {self.lateness:g} s"
            )
        if not self.byte_gap:
            raise InvalidCommand("a reply's byte_gap is above 0 s")

    @property
    def awaited(self) -> float:
        """Until when a reply that has not begun is awaited: the lateness, or the window where that is learned."""
        return self.lateness if self.silence is None else self.window

    def with_window(self, window: float) -> ReplyTiming:
        """Return the same with another reply window; nominal and lateness move only as far as they must."""
        return replace(self, nominal=min(self.nominal, window), window=window, lateness=max(self.lateness, window))

    def with_lateness(self, lateness: float) -> ReplyTiming:
        """Return the same with at least this lateness."""
        return self if lateness <= self.lateness else replace(self, lateness=lateness)


@dataclass(frozen=True, slots=True)
class Timings:
    """The reply times of one node: `read` and `write` for the first leg, `packet` for a packet after its ACK (MSC)."""

    read: ReplyTiming
    write: ReplyTiming
    packet: ReplyTiming

    @classmethod
    def uniform(cls, timing: ReplyTiming) -> Timings:
        """Return the same times for reads, writes and packets."""
        return cls(timing, timing, timing)

    def with_window(self, window: float) -> Timings:
        """Return the same with another window for every first leg; a packet's is only ever lengthened."""
        packet = self.packet.with_window(max(window, self.packet.window))
        return Timings(self.read.with_window(window), self.write.with_window(window), packet)

    def with_lateness(self, lateness: float) -> Timings:
        """Return the same with at least this lateness for each of the three."""
        return Timings(
            self.read.with_lateness(lateness), self.write.with_lateness(lateness), self.packet.with_lateness(lateness)
        )


__all__ = [
    "ReplyTiming",
    "Timings",
]
