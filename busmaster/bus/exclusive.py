"""A node within one exclusive sequence of requests: only urgent requests go between them on its line."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Hashable, Sequence
from contextlib import AbstractAsyncContextManager
from typing import Any, TypeVar, Unpack

from busmaster.bus.limits import Limit
from busmaster.bus.requester import CommandOptions, Requester
from busmaster.bus.samples import Sample
from busmaster.contract.arguments import seconds
from busmaster.contract.bounds import LONGEST_HOLD
from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.errors import Addressed, HoldEnded, InvalidCommand
from busmaster.planning.merging import Merge

T = TypeVar("T")


def checked_hold(max_hold: float, label: str) -> float:
    """Return `max_hold`, in seconds. Raises InvalidCommand with the node's name unless it is above 0 and at most 5."""
    # The arbiter accepts any time. Checked here for the nodes of this process and for those of other programs' lines.
    if not 0 < seconds(max_hold, f"{label}: max_hold") <= LONGEST_HOLD:
        raise InvalidCommand(f"{label}: a line is held for {LONGEST_HOLD:g} s at most (max_hold), not {max_hold!r}")
    return max_hold


class HeldNode(ABC):
    """A node within one exclusive sequence. It behaves like its node, except for `request`."""

    def __init__(self, node: Requester) -> None:
        self._node = node

    @property
    def line(self) -> str:
        return self._node.line

    @property
    def label(self) -> str:
        return self._node.label

    @property
    def address(self) -> int:
        return self._node.address

    @property
    def profile(self) -> Profile:
        return self._node.profile

    @property
    def stops(self) -> int:
        return self._node.stops

    def note_stop(self) -> None:
        self._node.note_stop()

    def now(self) -> float:
        return self._node.now()

    def latest(self, point: Hashable, /) -> Sample[Any] | None:
        return self._node.latest(point)

    def merge_reads(self, merge: Merge, /) -> None:
        self._node.merge_reads(merge)

    def use_sync_reads(self, probe: Command[Any] | None, sync_reads: Sequence[Command[Any]], /) -> None:
        self._node.use_sync_reads(probe, sync_reads)

    def limit(self, limit: Limit, /) -> None:
        self._node.limit(limit)

    def check(self, *commands: Command[Any], stop: bool | None = None) -> None:
        self._node.check(*commands, stop=stop)

    def exclusive(self, *, max_hold: float = 0.5) -> AbstractAsyncContextManager[Requester]:
        """Raise InvalidCommand: sequences cannot be nested."""
        # It would wait for the end of the sequence in which it is requested.
        raise InvalidCommand(f"{self.label}: the line is already held: send it within the running sequence")

    @abstractmethod
    async def request(
        self,
        command: Command[T],
        /,
        *,
        touches: Command[Any] | None = None,
        stops_seen: int | None = None,
        stop: bool = False,
        **options: Unpack[CommandOptions],
    ) -> T:
        """Run one command within the sequence, as `Requester.request` does.

        Raises HoldEnded, and sends nothing, when the line is no longer held.
        """
        ...


def hold_ended(node: Addressed, longest: float, command: Command[Any]) -> HoldEnded:
    """Return the error for a request after the end of its sequence. `longest`: maximum hold time in seconds."""
    what = f"the sequence has ended: its {longest:g} s have passed, or its block was left"
    return HoldEnded(what, node=node, command=str(command))
