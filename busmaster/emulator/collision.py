"""The bits on the wire during simultaneous transmissions. A bit is random if two drivers send different levels.

Only collisions are handled here. A frame that is alone on the line is never split into bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from busmaster.contract.profile import LineSettings
from busmaster.emulator.chance import Chance
from busmaster.emulator.device import Device
from busmaster.emulator.misheard import IDLE, START, parity_bit

ROUNDING = 1e-6
"""Of a bit: times are floats."""


class Collision:
    """The line from `start` on: a level per bit time, and its drivers.

    A transmission that starts off the first one's bit grid is moved to the next bit, never into the past, so that
    received bytes stay as they were.
    """

    def __init__(self, settings: LineSettings, start: float, chance: Chance) -> None:
        self.start = start
        self._chance = chance
        self._bytesize = settings.bytesize
        self._parity = settings.parity
        self._stop_bits = math.ceil(settings.stopbits)
        self._frame_bits = 1 + settings.bytesize + (settings.parity != "N") + self._stop_bits
        self._bit_time = settings.byte_time / self._frame_bits
        self._levels: list[int] = []
        self._driven: list[bool] = []
        self._talks: list[tuple[int, int, Device | None]] = []
        self._decoded: dict[tuple[Device | None, bool], list[tuple[float, float, int]]] = {}
        """The bytes that each listener receives. Cached, because the host reads after each byte."""

    def add(self, start: float, data: bytes, talker: Device | None, hold: float = 0.0) -> None:
        """Transmit `data` from `start` on; the driver then holds the line idle for `hold` seconds.

        If another driver transmits a different bit at the same time, the result is random.
        """
        at = max(0, math.ceil((start - self.start) / self._bit_time - ROUNDING))
        bits = [bit for byte in data for bit in self._encode(byte)]
        self._talks.append((at, at + len(bits), talker))
        bits += [IDLE] * round(hold / self._bit_time)
        missing = at + len(bits) - len(self._levels)
        if missing > 0:
            self._levels += [IDLE] * missing
            self._driven += [False] * missing
        for index, bit in enumerate(bits, at):
            if self._driven[index] and self._levels[index] != bit:
                bit = self._chance.getrandbits(1)
            self._levels[index] = bit
            self._driven[index] = True
        self._decoded.clear()

    def heard(
        self, listener: Device | None, until: float = math.inf, *, echo: bool = False
    ) -> Iterator[tuple[float, int]]:
        """Yield the start time and the value of each byte that ended by `until`.

        `listener` (None: the host) does not receive while it transmits, unless it has an `echo`.
        """
        found = self._decoded.get((listener, echo))
        if found is None:
            found = self._decoded[listener, echo] = list(self._decode(listener, echo))
        latest = until + ROUNDING * self._bit_time
        for began, end, byte in found:
            if end > latest:
                return
            yield began, byte

    def _decode(self, listener: Device | None, echo: bool) -> Iterator[tuple[float, float, int]]:
        """Yield when each byte begins and ends, and the byte."""
        deaf = [] if echo else [(first, last) for first, last, talker in self._talks if talker is listener]
        mask = (1 << self._bytesize) - 1
        levels = self._levels
        at = 0
        while at < len(levels):
            if levels[at] != START:
                at += 1
                continue
            end = at + self._frame_bits
            bits = levels[at + 1 : at + 1 + self._bytesize]
            value = sum(bit << place for place, bit in enumerate(bits)) | mask & -1 << len(bits)
            if not any(first < end and at < last for first, last in deaf):
                yield self.start + at * self._bit_time, self.start + end * self._bit_time, value & mask
            broken = end <= len(levels) and levels[end - self._stop_bits] != IDLE
            at = end
            while broken and at < len(levels) and levels[at] == START:
                at += 1

    def _encode(self, byte: int) -> list[int]:
        data = [byte >> place & 1 for place in range(self._bytesize)]
        parity = [] if self._parity == "N" else [parity_bit(data, self._parity)]
        return [START, *data, *parity, *[IDLE] * self._stop_bits]
