"""Predictions for a bus: whether its polls fit the line, and how long a request can wait."""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence

from busmaster.arbiter.health import Health
from busmaster.arbiter.transaction import Priority
from busmaster.bus.node import Node
from busmaster.bus.polling import PollGroup
from busmaster.bus.shared_line import SharedLine
from busmaster.contract.profile import LineSettings
from busmaster.planning import Plan, PlannedGroup, Read, bounds, plan_steps
from busmaster.planning.merging import Merge
from busmaster.transport.endpoints import Endpoint


class Outlook:
    """The predictions for one bus. `nodes` and `groups` are the bus's own and always current."""

    def __init__(
        self,
        line: SharedLine,
        endpoint: Endpoint,
        nodes: Mapping[tuple[str, int], Node],
        groups: Mapping[str, PollGroup],
    ) -> None:
        self._line = line
        self._endpoint = endpoint
        self._nodes = nodes
        self._groups = groups

    def plan_steps(self, more: Sequence[PlannedGroup], could_merge: Sequence[Merge]) -> Generator[int, None, Plan]:
        """Calculate the load of the groups and of `more`, as `planning.plan_steps` does."""
        groups = []
        for group in tuple(self._groups.values()):
            groups.append(group.planned())
            yield len(groups[-1].reads)
        return (
            yield from plan_steps(
                [*groups, *more],
                line=self._settings(),
                receive_latency=self._delay(),
                others=self._asked(),
                could_merge=could_merge,
                sharing=self._line.sharing,
            )
        )

    def worst_case_wait(self, priority: Priority) -> float:
        """Return the longest time, in seconds, until a request of this class, made now, is sent (R9)."""
        arbiter = self._line.arbiter
        backlog = arbiter.dispatcher.backlog
        polls = arbiter.dispatcher.schedule.polls
        polled = sum(len(poll.results) for poll in polls)
        low = sum(len(poll.results) for poll in polls if poll.priority is Priority.BACKGROUND)
        probed = any(node.health is not Health.UP for node in self._nodes.values())
        bound = bounds(
            self._asked(),
            arbiter.byte_time,
            self._delay(),
            polls=1 + max(polled - low, backlog.waiting(Priority.POLL)),
            background=probed + max(low, backlog.waiting(Priority.BACKGROUND)),
            sharing=self._line.sharing,
        )
        longest = max((poll.patience for poll in polls if poll.results), default=1.0)
        return bound.wait(priority, ahead=self._line.ahead(priority), patience=longest)

    def _delay(self) -> float:
        """Return the seconds by which the port can delay an exchange."""
        # `send_delay` could be counted without its part in each silence, but R9's bound may only be too long.
        return self._endpoint.receive_latency + getattr(self._endpoint, "send_delay", 0.0)

    def _settings(self) -> LineSettings:
        if self._endpoint.settings is not None:
            return self._endpoint.settings
        return next((node.profile.line for node in self._nodes.values()), LineSettings(9600))

    def _asked(self) -> list[Read]:
        """Return each kind of command sent to a node, once for all nodes with the same timings."""
        asked = {
            (id(node._record.profile), id(node._record.timings), kind): (node, command)
            for node in self._nodes.values()
            for kind, command in node._kinds.items()
        }
        return [(node.planned(), command) for node, command in asked.values()]
