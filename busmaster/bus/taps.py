"""The taps of a line (a recorder, or viewers of the traffic). They can be added and removed while it runs."""

from __future__ import annotations

from busmaster.contract.tap import Attempt, Tap
from busmaster.transport.pump import Pump


class Taps:
    """The taps of one line. An untapped line has no extra cost."""

    def __init__(self, pump: Pump, first: Tap | None = None) -> None:
        self._pump = pump
        self._taps: list[Tap] = []
        if first is not None:
            self.add(first)

    def add(self, tap: Tap) -> None:
        """Pass all traffic to `tap` from now on. Of the exchange on the wire it may see only the end."""
        self._taps.append(tap)
        # Only for the first and the last tap: the arbiter numbers the attempts while it is tapped.
        if len(self._taps) == 1:
            self._pump.arbiter.set_tapped(True)
        self._set()

    def remove(self, tap: Tap) -> None:
        """Pass no more traffic to `tap`."""
        self._taps.remove(tap)
        if not self._taps:
            self._pump.arbiter.set_tapped(False)
        self._set()

    def _set(self) -> None:
        match self._taps:
            case []:
                self._pump.tap = None
            case [tap]:
                self._pump.tap = tap
            case taps:
                self._pump.tap = _Several(tuple(taps))


class _Several:
    """Several taps as one."""

    def __init__(self, taps: tuple[Tap, ...]) -> None:
        self._taps = taps

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        for tap in self._taps:
            tap.transmitted(now, data, attempt)

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        for tap in self._taps:
            tap.received(now, data, attempt)

    def attempted(self, attempt: Attempt, /) -> None:
        for tap in self._taps:
            tap.attempted(attempt)
