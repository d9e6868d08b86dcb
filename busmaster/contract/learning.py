"""The wish to have reply times learned from the nodes, instead of always awaiting replies for as long as documents say."""

from __future__ import annotations

from dataclasses import dataclass

from busmaster.contract.timing import Timings


@dataclass(frozen=True, slots=True)
class Learned:
    """Say that a node's reply times are to be learned from its replies, for reads that can be repeated.

    `document`: the times that hold until enough is known, that are never exceeded, and on whose lateness the promise
    rests that no value is another request's (R3, R15); None for those of the node's protocol.
    """

    document: Timings | None = None


LEARNED = Learned()
"""Reply times learned from the replies, never above those of the node's protocol."""
