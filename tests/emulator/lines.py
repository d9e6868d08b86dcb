"""A host for emulated lines: says hex at a time, and tells in hex what came back, and when."""

from __future__ import annotations

from random import Random
from typing import Any

from busmaster.contract.profile import LineSettings
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line

SETTINGS = LineSettings(57600)
TAU = SETTINGS.byte_time


def line_of(*devices: Device, seed: int = 1, **options: Any) -> Line:
    return Line(SETTINGS, devices, chance=Random(seed), **options)


def hexed(data: bytes) -> str:
    return data.hex(" ").upper()


def arrivals(line: Line, until: float) -> list[tuple[float, str]]:
    """What reaches the host by `until`, asked for at every event of the line."""
    found = []
    while (when := line.next_event()) <= until:
        data = line.receive(when)
        if data:
            found.append((when, hexed(data)))
    return found


def ask(line: Line, request: str, now: float = 0.0, seconds: float = 0.5) -> str:
    """All that comes back within `seconds`, as hex."""
    line.send(bytes.fromhex(request), now)
    return " ".join(data for _, data in arrivals(line, now + seconds))


def ask_bytewise(line: Line, request: str, now: float = 0.0, seconds: float = 0.5) -> str:
    """Likewise, but the request leaves byte by byte, so that the device must piece it together."""
    for byte in bytes.fromhex(request):
        line.send(bytes((byte,)), now)
    return " ".join(data for _, data in arrivals(line, now + seconds))
