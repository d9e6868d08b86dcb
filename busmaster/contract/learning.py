"""The wish to have reply times learned from the nodes, instead of awaiting each reply for as long as documents say."""

from __future__ import annotations

from dataclasses import dataclass

from busmaster.contract.timing import Timings


@dataclass(frozen=True, slots=True)
class Learned:
    """Say that a node's reply times are to be learned from its replies, for reads that can be repeated.

    `document`: the times that hold until enough is known, that are never exceeded, and on whose maximum reply delay the
    promise rests that no value is another request's (R3, R15); None for those of the node's protocol.
    """

    document: Timings | None = None

    def of(self, document: Timings) -> Learned:
        """Return the same for nodes of a protocol with these times."""
        return self if self.document is not None else Learned(document)


def documented(timings: Timings | Learned | None) -> Timings | None:
    """Return the times that hold where nothing is learned; None for those of the protocol."""
    return timings.document if isinstance(timings, Learned) else timings


LEARNED = Learned()
"""Reply times learned from the replies, never above those of the node's protocol."""


__all__ = [
    "LEARNED",
    "Learned",
    "documented",
]
