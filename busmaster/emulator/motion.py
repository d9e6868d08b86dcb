"""Small motion models for positions and speeds. The caller passes the time; the result is exact at any step.

Units are the caller's: positions in counts or user units, speeds in those per second.
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass

from busmaster.emulator.device import NEVER


@dataclass(slots=True)
class Ramp:
    """A speed that moves to `target` by `rate` per second, and its integral, the `position`.

    Its time begins when it is first advanced.
    """

    rate: float
    speed: float = 0.0
    target: float = 0.0
    position: float = 0.0
    now: float = NEVER

    def advance(self, now: float) -> None:
        """Advance to `now`. An earlier time has no effect."""
        if self.now == NEVER:
            self.now = now
        left = now - self.now
        if left <= 0:
            return
        self.now = now
        change = self.target - self.speed
        if change:
            ramp = min(left, abs(change) / self.rate)
            slope = math.copysign(self.rate, change)
            self.position += self.speed * ramp + slope * ramp * ramp / 2
            self.speed = self.target if ramp < left else self.speed + slope * ramp
            left -= ramp
        self.position += self.speed * left


class Motion(enum.IntEnum):
    """An axis's mode of motion. The numbers of AXISMODE are in Mint's help, not in AN00129: these are ours."""

    IDLE = 0
    JOG = 1
    MOVE = 2
    HOME = 3
    FOLLOW = 4
    SWING = 5


class Axis:
    """One axis of a controller: it jogs, follows, swings to and fro, or moves to a target and is idle there."""

    def __init__(self, acceleration: float = 500.0) -> None:
        self.motion = Motion.IDLE
        self.speed = 20.0
        """Of the moves to come, above 0: SPEED."""
        self.error = 0
        self._ramp = Ramp(acceleration)
        self._target = 0.0
        self._arrives = NEVER
        self._swing = (0.0, 1.0, 0.0)

    def jog(self, speed: float, now: float) -> None:
        """Ramp to `speed` and stay there: JOG."""
        self._run(Motion.JOG, speed, now)

    def follow(self, speed: float, now: float) -> None:
        """Follow a master axis, at `speed` as it comes out of the ratio: FOLLOW."""
        self._run(Motion.FOLLOW, speed, now)

    def stop(self, now: float) -> None:
        """Stop immediately at the position of `now`: IDLE."""
        self.position(now)
        self._arrives = NEVER
        self._ramp.speed = self._ramp.target = 0.0
        self.motion = Motion.IDLE

    def place(self, position: float, now: float) -> None:
        """Be idle at a position."""
        self.stop(now)
        self._ramp.position = position

    def move(self, target: float, now: float, motion: Motion = Motion.MOVE) -> None:
        """Go to `target` at `speed`, then be idle: MOVEA and GO (HOME likewise, to 0)."""
        distance = target - self.position(now)
        speed = math.copysign(max(abs(self.speed), 1e-6), distance)
        self._target = target
        self._arrives = now + distance / speed
        self._ramp.speed = self._ramp.target = speed
        self.motion = motion

    def swing(self, amplitude: float, period: float, phase: float, now: float) -> None:
        """Swing to and fro for ever: something to look at. `period` is in seconds, `phase` in turns."""
        self.stop(now)
        self._swing = (amplitude, math.tau / period, phase * math.tau)
        self.motion = Motion.SWING

    def position(self, now: float) -> float:
        """Return the position at `now`."""
        ramp = self._ramp
        if self.motion is Motion.SWING:
            amplitude, omega, phase = self._swing
            ramp.position = amplitude * math.sin(omega * now + phase)
            ramp.now = now
        elif now >= self._arrives:
            ramp.advance(self._arrives)
            self._arrives = NEVER
            ramp.position = self._target
            ramp.speed = ramp.target = 0.0
            self.motion = Motion.IDLE
        ramp.advance(now)
        return ramp.position

    def velocity(self, now: float) -> float:
        """Return how fast it moves at `now`, per second."""
        self.position(now)
        if self.motion is Motion.SWING:
            amplitude, omega, phase = self._swing
            return amplitude * omega * math.cos(omega * now + phase)
        return self._ramp.speed

    def idle(self, now: float) -> bool:
        """Return True if it is in position: IDLE."""
        self.position(now)
        return self.motion is Motion.IDLE

    def _run(self, motion: Motion, speed: float, now: float) -> None:
        self.position(now)
        self._arrives = NEVER
        self._ramp.target = speed
        self.motion = motion


__all__ = [
    "Axis",
    "Motion",
    "Ramp",
]
