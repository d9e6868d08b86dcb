"""Cycles for the outputs, made without a line."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from busmaster.app.outputs.base import Output
from busmaster.bus.bus import Bus
from busmaster.bus.node import Timeline
from busmaster.bus.points import Point
from busmaster.bus.polling import Quality, Sample, Snapshot
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import NoReply
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from tests.patience import PATIENCE

BUS = Bus(MemoryPort(Line(hcp2.PROFILE.line)))
NODE = Hcp2Controller(BUS, 5)


def point(item: str) -> Point[Any]:
    return NODE.point(item)


def cycle(number: int, *values: Any, group: str = "axes", at: float | None = None) -> Snapshot:
    """A cycle that read these values of elements 1, 2, ...; an exception is what went wrong with one."""
    now = time.monotonic() if at is None else at
    wall = time.time() - time.monotonic() + now + 0.001
    samples = {}
    for element, value in enumerate(values, 1):
        error = value if isinstance(value, NoReply) else None
        quality = Quality.GOOD if error is None else Quality.BAD
        timeline = Timeline(now, now, now, now, 1, 0, 0.0)
        samples[point(str(element))] = Sample(
            None if error else value, error, now, now, now + 0.001, quality, timeline, wall
        )
    return Snapshot(group, number, now, now, now + 0.002, 0, wall, samples)


def settled(output: Output) -> bool:
    """Nothing waits any more."""
    return output.statistics().waiting == 0


def until(condition: Callable[[], bool]) -> None:
    """Wait for a thread, until it has done it."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.002)
