"""The option to learn reply times from the nodes instead of using the documented times."""

from __future__ import annotations

from dataclasses import dataclass

from busmaster.contract.timing import Timings


@dataclass(frozen=True, slots=True)
class Learned:
    """Learn a node's reply times from its replies, for reads that can be repeated.

    `document`: the times used until enough replies are known. They are never exceeded, and their maximum reply delay is
    the basis of the promise that no value is attributed to another request (R3, R15). None: the times of the node's
    protocol.
    """

    document: Timings | None = None

    def of(self, document: Timings) -> Learned:
        """Return the same option for nodes of a protocol with these times."""
        return self if self.document is not None else Learned(document)


def documented(timings: Timings | Learned | None) -> Timings | None:
    """Return the times used without learning; None for those of the protocol."""
    return timings.document if isinstance(timings, Learned) else timings


LEARNED = Learned()
"""Learned reply times, never above those of the node's protocol."""


__all__ = [
    "LEARNED",
    "Learned",
    "documented",
]
