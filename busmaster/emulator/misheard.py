"""The bytes that a UART receives if they were sent at another rate or in another framing.

The sender's bits are levels in time; the receiver waits for an edge, and looks at the levels in the middle of each of
its own bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from busmaster.contract.profile import START_BIT, LineSettings

IDLE = 1
START = 0


def misheard(data: bytes, sent: LineSettings, heard: LineSettings) -> Iterator[tuple[int, bool]]:
    """Yield the bytes that a UART with the settings `heard` receives from contiguous bytes sent as `sent`.

    With each byte comes True, or False if its parity or stop bit is wrong.
    """
    wave = _Wave(data, sent)
    bit = 1 / heard.baudrate
    parity = heard.parity != "N"
    began = wave.falling_edge(0.0)
    while began < wave.end:
        if wave.level(began + bit / 2) != START:  # a spike, not a start bit
            began = wave.falling_edge(began + bit / 2)
            continue
        middle = began + (START_BIT + 0.5) * bit
        bits = [wave.level(middle + place * bit) for place in range(heard.bytesize + parity)]
        stop = middle + len(bits) * bit
        whole = wave.level(stop) == IDLE and (not parity or bits[-1] == parity_bit(bits[:-1], heard.parity))
        yield sum(level << place for place, level in enumerate(bits[: heard.bytesize])), whole
        began = wave.falling_edge(stop)


def parity_bit(bits: list[int], parity: str) -> int:
    """Return the parity bit of a byte's bits, for any parity but "N"."""
    odd = sum(bits) & 1
    return {"E": odd, "O": 1 - odd, "M": 1, "S": 0}[parity]


class _Wave:
    """The levels of a line, from 0 to `end` seconds; it is idle before and after."""

    def __init__(self, data: bytes, settings: LineSettings) -> None:
        self._parts = _levels(data, settings)
        """The end of each level, in seconds, and the level; two neighbours always differ."""
        self.end = self._parts[-1][0] if self._parts else 0.0
        self._at = 0

    def level(self, when: float) -> int:
        """Return the level at a time, which must not be before that of an earlier call."""
        parts = self._parts
        while self._at < len(parts) and parts[self._at][0] <= when:
            self._at += 1
        return parts[self._at][1] if self._at < len(parts) else IDLE

    def falling_edge(self, after: float) -> float:
        """Return the time of the next change from idle to the level of a start bit; infinity if there is none."""
        before = IDLE if not after else self.level(after)
        while self._at < len(self._parts):
            level = self._parts[self._at][1]
            if before == IDLE and level == START:
                return self._parts[self._at - 1][0] if self._at else 0.0
            before = level
            self._at += 1
        return math.inf


def _levels(data: bytes, settings: LineSettings) -> list[tuple[float, int]]:
    bit = 1 / settings.baudrate
    parts: list[tuple[float, int]] = []
    for number, byte in enumerate(data):
        bits = [byte >> place & 1 for place in range(settings.bytesize)]
        parity = [] if settings.parity == "N" else [parity_bit(bits, settings.parity)]
        at = number * settings.byte_time
        for place, level in enumerate([START, *bits, *parity, IDLE], 1):
            # the last of them lasts for all stop bits
            ends = at + (settings.byte_time if place == START_BIT + len(bits) + len(parity) + 1 else place * bit)
            if parts and parts[-1][1] == level:
                parts.pop()
            parts.append((ends, level))
    return parts


__all__ = ["IDLE", "START", "misheard", "parity_bit"]
