"""The chance that the emulator is handed: it draws from no generator of its own."""

from __future__ import annotations

from typing import Protocol


class Chance(Protocol):
    """What the emulator uses of a seeded `random.Random`, which is handed in: the same seed, the same line."""

    def random(self) -> float:
        """Return a number from 0 to below 1."""
        ...

    def uniform(self, a: float, b: float) -> float:
        """Return a number from `a` to `b`."""
        ...

    def randrange(self, start: int, stop: int) -> int:
        """Return a whole number from `start` to below `stop`."""
        ...

    def getrandbits(self, k: int) -> int:
        """Return a whole number of `k` random bits."""
        ...


class NoChance(Chance):
    """Stands in where no random.Random was handed in: says so as soon as chance is needed."""

    def random(self) -> float:
        raise ValueError("hand a random.Random(seed) to the Line: a delay or a fault on it is random")

    def uniform(self, a: float, b: float) -> float:
        return self.random()

    def randrange(self, start: int, stop: int) -> int:
        return int(self.random())

    def getrandbits(self, k: int) -> int:
        return int(self.random())


__all__ = [
    "Chance",
    "NoChance",
]
