"""The random source of the emulator, which is passed in. The emulator has no generator of its own."""

from __future__ import annotations

from typing import Protocol


class Chance(Protocol):
    """The methods of a seeded `random.Random` that the emulator uses: the same seed gives the same line."""

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
    """Used if no random.Random was passed: raises an error as soon as randomness is needed."""

    def random(self) -> float:
        raise ValueError(
            "the Line has no source of chance for a random delay or fault; pass a random.Random(seed) to it"
        )

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
