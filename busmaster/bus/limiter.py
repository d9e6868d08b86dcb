"""The limits of one line, checked for all writes: under every name of a quantity, and in every way to write it.

A write passes if it is within the limits of each quantity that it changes, at each node that receives it. With a
limited step, one write at a time is in progress, and its step counts from the value left by the previous one. If that
value is not known, it is read first. An urgent write does not wait for this: its step is not limited. A stop is not
limited at all.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Hashable, Iterable, Iterator, Mapping
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import replace
from typing import Any

from busmaster.arbiter.transaction import Priority
from busmaster.bus.limits import Limit
from busmaster.bus.requester import Requester, RequestOptions
from busmaster.contract.exchange import Command
from busmaster.contract.places import Changing
from busmaster.errors import GarbledReply, InvalidCommand, NoReply, NotStarted, Refused, Superseded


class NodeLimits:
    """The limits of one node, and the known values of quantities with a limited step."""

    def __init__(self, node: Requester) -> None:
        self.node = node
        self.limits: list[Limit] = []
        # By limit and not by quantity: two limits of one quantity can have different units.
        self.known: dict[Limit, Any] = {}
        """The last confirmed values, in their own units."""
        self.writing = asyncio.Lock()
        """Held while a write with a limited step is in progress."""
        self.urgent = 0
        """Number of urgent writes so far."""

    def touched_by(self, changes: Mapping[Hashable, Any]) -> list[Limit]:
        return [limit for limit in self.limits if limit.touched_by(changes)]


class Limiter:
    """All limits of one line."""

    def __init__(self) -> None:
        self._of: dict[Requester, NodeLimits] = {}

    def add(self, node: Requester, limit: Limit) -> None:
        """Add a limit. Existing limits stay."""
        self._of.setdefault(node, NodeLimits(node)).limits.append(limit)

    def of(self, node: Requester) -> tuple[Limit, ...]:
        """Return the limits of a node's own quantities."""
        return tuple(self._of[node].limits) if node in self._of else ()

    def drop(self, node: Requester, limit: Limit) -> None:
        """Remove one limit. The others stay."""
        if node in self._of and limit in self._of[node].limits:
            self._of[node].limits.remove(limit)
            # Writes do not update the value while the limit is lifted, so it would be wrong if the limit is added
            # again.
            self._of[node].known.pop(limit, None)

    def forget(self, node: Requester) -> None:
        """Forget the known values of a node that was away: it may have other values now."""
        if node in self._of:
            self._of[node].known.clear()

    def forget_node(self, node: Requester) -> None:
        """Remove all limits of a node that was removed."""
        self._of.pop(node, None)

    def check(self, node: Requester, command: Command[Any]) -> None:
        """Raise InvalidCommand with node and limit for a write that is not allowed. Steps are not checked here."""
        for one in self._reached(node):
            # Not before the loop: a write to a node without limits does not have to declare its changes.
            changes = _changes(node, command)
            for limit in one.touched_by(changes):
                _checked(one.node, limit, changes)

    @asynccontextmanager
    async def passing(
        self,
        node: Requester,
        command: Command[Any],
        options: RequestOptions,
        stop: bool = False,
        within: Requester | None = None,
    ) -> AsyncIterator[RequestOptions]:
        """Check a write, or raise InvalidCommand before anything is sent. Yields its remaining options.

        Raises NotStarted if the current value is needed and cannot be read, and Superseded if an urgent write came
        first. A `stop` passes without a check, and the value after it is not known. `within`: the node of the write's
        sequence, which is the only way to read the value during the sequence.
        """
        urgent = options.priority is Priority.URGENT
        reached = list(self._reached(node))
        if not stop:
            self.check(node, command)
        for one in reached:
            one.urgent += urgent  # a write that was just rejected is not sent, and overtakes nothing
        if not stop:
            reached = [one for one in reached if one.touched_by(_changes(node, command))]
        async with AsyncExitStack() as held:
            if not (urgent or stop) and any(limit.max_step for one in reached for limit in one.limits):
                options = await self._step_by_step(held, node, within, reached, command, options)
            try:
                yield options
            except BaseException:
                # Also after a cancellation or an unknown outcome: the drive may have carried out the write.
                for one in reached:
                    one.known.clear()
                raise
            for one in reached:
                if stop:
                    one.known.clear()
                else:
                    _remember(one, node, command)

    async def _step_by_step(
        self,
        held: AsyncExitStack,
        node: Requester,
        within: Requester | None,
        reached: list[NodeLimits],
        command: Command[Any],
        options: RequestOptions,
    ) -> RequestOptions:
        """Wait for the previous writes, then check the step of this one."""
        began, changes = node.now(), _changes(node, command)
        seen = [one.urgent for one in reached]
        patience = [limit for limit in (options.start_within, options.finish_within) if limit is not None]
        try:
            # The write is not sent before this ends, so both limits of the caller mean NotStarted here.
            async with asyncio.timeout(min(patience, default=None)):
                for one in reached:
                    # In the order of `_reached`, the same for all writes: two writes to all nodes cannot wait for each
                    # other.
                    await held.enter_async_context(one.writing)
                while unknown := _first_unknown(reached, changes):
                    one, limit = unknown
                    asked = within if within is not None and one.node is node else one.node
                    one.known[limit] = await _value_now(asked, limit, command, options)
        except TimeoutError as late:
            # NotStarted is a TimeoutError too, and the one from the read has the exact reason.
            if isinstance(late, NotStarted):
                raise
            raise NotStarted("the current value was not read in time", node=node, command=str(command)) from None
        # R7: an urgent write that came meanwhile supersedes the queued writes, and this one is not queued yet.
        if seen != [one.urgent for one in reached]:
            raise Superseded("overtaken by an urgent write to the same node", node=node, command=str(command))
        self.check(node, command)  # other limits may be held by now
        for one, limit in _steps(reached, changes):
            _check_step(one, limit, changes)
        return _shortened(options, node.now() - began)

    def _reached(self, node: Requester) -> Iterator[NodeLimits]:
        """Yield the limits of the nodes that receive a write: of all nodes for a broadcast."""
        profile = node.profile
        if node.address != profile.broadcast:
            if node in self._of:
                yield self._of[node]
            return
        # Nodes of other protocols on the line do not understand the broadcast.
        heard_by = {profile.name, *profile.shares_line_with}
        yield from (one for one in self._of.values() if one.node.profile.name in heard_by)


def _steps(reached: Iterable[NodeLimits], changes: Mapping[Hashable, Any]) -> Iterator[tuple[NodeLimits, Limit]]:
    """Yield the step limits of what a write changes."""
    return ((one, limit) for one in reached for limit in one.touched_by(changes) if limit.max_step is not None)


def _first_unknown(reached: Iterable[NodeLimits], changes: Mapping[Hashable, Any]) -> tuple[NodeLimits, Limit] | None:
    return next((step for step in _steps(reached, changes) if step[1] not in step[0].known), None)


def _changes(node: Requester, command: Command[Any]) -> Mapping[Hashable, Any]:
    if not isinstance(command, Changing):
        raise InvalidCommand(f"{node.label} has limits, and {command} does not declare its changes")
    return command.changes(node.profile)


def _remember(one: NodeLimits, node: Requester, command: Command[Any]) -> None:
    """Store confirmed values. A write to all nodes is not confirmed, nor is one that a stop interrupted."""
    changes = _changes(node, command)
    for limit in one.touched_by(changes):
        one.known.pop(limit, None)
        if one.node is node and all(changes.get(place) is not None for place in limit.places):
            one.known[limit] = limit.value_after(changes)


def _checked(node: Requester, limit: Limit, changes: Mapping[Hashable, Any]) -> None:
    try:
        # A value that must not be written at all is rejected as such, even if the write changes only a part of it.
        limit.check(limit.value_after(changes) if limit.writable else None)
    except InvalidCommand as refused:
        raise InvalidCommand(f"{node.label}: {refused}") from None


def _check_step(one: NodeLimits, limit: Limit, changes: Mapping[Hashable, Any]) -> None:
    try:
        limit.check_step(one.known[limit], limit.value_after(changes))
    except InvalidCommand as refused:
        raise InvalidCommand(f"{one.node.label}: {refused}") from None


async def _value_now(node: Requester, limit: Limit, command: Command[Any], options: RequestOptions) -> Any:
    try:
        return limit.decode(await node.request(limit.read, priority=options.priority))
    # Raised for the write, these would mean that it was sent. The other errors of a read do not mean that.
    except (NoReply, GarbledReply, Refused) as error:
        what = f"the current value, needed for max_step, could not be read: {error.what}"
        raise NotStarted(what, node=node, command=str(command), hint=error.hint) from error


def _shortened(options: RequestOptions, by: float) -> RequestOptions:
    """Return the options of a request that has already waited."""
    left = {
        name: max(0.0, limit - by)
        for name in ("start_within", "finish_within")
        if (limit := getattr(options, name)) is not None
    }
    return replace(options, **left) if left else options
