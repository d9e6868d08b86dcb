"""Health of the nodes, and the line time that probes of dead nodes may use (R11)."""

from __future__ import annotations

import enum
from collections.abc import Callable, Iterator, Sequence
from math import inf
from typing import Any

from busmaster.arbiter.counters import NodeCounters
from busmaster.arbiter.learned import Learning
from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings

DOWN_AFTER_FAILURES = 3
DOWN_AFTER_SILENCE = 1.0
FIRST_PROBE_DELAY = 0.5
LONGEST_PROBE_DELAY = 30.0
PROBE_JITTER = 0.2
STEADY = 30.0
"""Seconds a node must stay up before its next death starts again with the first probe delay."""
UP_AFTER_REPLIES = 3
UP_AFTER_CALM = 5.0
"""A SUSPECT node is UP after UP_AFTER_REPLIES replies and this many seconds without a failure, so that a flapping node
is reported once."""

BUDGET_SHARE = 0.02
BUDGET_IDLE_SHARE = 0.25
BUDGET_SHARE_AFTER_RETURN = 0.2
BUDGET_RETURN_PERIOD = 30.0
BUDGET_CAPACITY = 0.5
"""Maximum line time, in seconds, that the budget can hold."""
LONGEST_BUDGET_WAIT = 1.0

CALM_MAX_REPLY_DELAY = 3600.0
"""Seconds of prompt replies after which a raised maximum reply delay is restored."""
SILENT = 2
"""Consecutive attempts without a byte after which no sync read is sent to a node."""
MOST_ANSWERED = 3
"""Number of answered commands stored per node."""
SLOWER, SLOWER_BY = 1.25, 0.001
"""A reply is later than usual if it takes this factor times the slowest one, plus this many seconds."""
SLOWEST_DECAY = 0.002
"""Share of the difference by which the slowest reply time is lowered with each faster reply."""


class Health(enum.Enum):
    """UNKNOWN: no reply yet. SUSPECT: failed lately. DOWN: probed, polls parked.

    OFFLINE: the line is lost. A record never has this value; `Node.health` combines record and line.
    """

    UNKNOWN = "unknown"
    UP = "up"
    SUSPECT = "suspect"
    DOWN = "down"
    OFFLINE = "offline"


UNKNOWN, UP, SUSPECT, DOWN, OFFLINE = Health


class NodeRecord:
    """State of one node. Changed only by the arbiter."""

    __slots__ = (
        "_before_raised",
        "_refused",
        "address",
        "answered",
        "budgeted",
        "counters",
        "failed_at",
        "failures",
        "has_hook",
        "health",
        "holds",
        "label",
        "last_reply",
        "learning",
        "line",
        "max_reply_delay_until",
        "probe_at",
        "probe_delay",
        "probed_at",
        "profile",
        "removed",
        "replies",
        "reported_late",
        "retries",
        "slowest",
        "stops",
        "suspended_until",
        "timings",
        "unheard",
        "up_since",
        "usual",
    )

    def __init__(self, profile: Profile, address: int, timings: Timings, retries: int, line: str = "") -> None:
        self.profile = profile
        self.address = address
        self.line = line
        """Name of its line, for errors."""
        self.label = profile.label(address)
        self.timings = timings
        self.retries = retries
        self.learning: Learning | None = None
        """Learned reply times, if enabled."""
        self.health = UNKNOWN
        self.budgeted = False
        """True if it counts as DOWN only because a client named it and it has never replied."""
        self.failures = 0
        """Consecutive transactions that failed without a valid reply."""
        self.failed_at = -inf
        """When the last of them failed."""
        self.replies = 0
        """Consecutive replies since then."""
        self.last_reply = -inf
        self.up_since = -inf
        self.counters = NodeCounters()
        self.probe_delay = FIRST_PROBE_DELAY
        self.probe_at = inf
        self.probed_at = -inf
        self.suspended_until = -inf
        self.has_hook = False
        self.removed = False
        """It was removed from the line."""
        self.holds = 0
        """Number of returns whose on_return hook is still running. Its polls wait."""
        self.stops = 0
        """Number of stop commands, so that a write decided before a stop cannot undo it."""
        self.answered: dict[Sequence[bytes], Command[Any]] = {}
        """Some reads that it has answered, by the keys of their replies (R15)."""
        self._refused: set[Command[Any]] = set()
        """Sync reads that it has refused with certainty and not answered since."""
        self.unheard = 0
        """Consecutive attempts without a reply."""
        self.slowest = 0.0
        """Time in seconds to the first byte of approximately its slowest recent reply."""
        self.usual: float | None = None
        """Usual time in seconds to its first byte, in runs of similar replies; None before the first one."""
        self.max_reply_delay_until = inf
        """When a raised maximum reply delay is restored, if all replies are prompt until then."""
        self._before_raised: Timings | None = None
        self.reported_late = 0.0
        """Time in seconds to the first byte of the latest reply that was reported as late."""

    def __repr__(self) -> str:
        return f"<{self.profile.name} {self.label}, {self.health.value}>"

    def note_reply(self, answers: Sequence[bytes], command: Command[Any], took: float) -> None:
        """Record a correct reply to this command after `took` seconds."""
        self.unheard = 0
        if self._refused:
            self._refused.discard(command)
        # Raised at once, lowered slowly: it decides which replies are ambiguous (R15), so one slow reply among many
        # fast ones must not be forgotten.
        slowest = self.slowest
        self.slowest = took if took > slowest else slowest - SLOWEST_DECAY * (slowest - took)
        # A node may refuse the protocol's sync reads. A command that it has answered once is certain to work.
        if answers not in self.answered and len(self.answered) < MOST_ANSWERED and not command.writes:
            self.answered[answers] = command

    @property
    def silent(self) -> bool:
        """True if the node is not known to answer."""
        return self.unheard >= SILENT

    def is_left_alone(self, now: float) -> bool:
        """Return True if the line sends it nothing of its own accord: it was removed from the line, or is suspended."""
        return self.removed or now < self.suspended_until

    def latest(self, unknown: float) -> float:
        """Return the longest usual time, in seconds, to the first byte of a reply; `unknown` if none was timed."""
        return SLOWER * self.slowest + SLOWER_BY if self.slowest else unknown

    def note_refused(self, command: Command[Any]) -> None:
        """Stop using a sync read that was refused with certainty. If the node has refused all of them, use all
        again."""
        if command in self.profile.sync_reads:
            self._refused.add(command)
        # A refusal is a reply too, so a node that refuses all of them is still a better choice than a silent one.
        if self._refused.issuperset(self.profile.sync_reads):
            self._refused.clear()
        # A drive can stop supporting an item, for example after another program was loaded.
        self.answered = {key: read for key, read in self.answered.items() if read != command}

    def sync_reads(self) -> Iterator[Command[Any]]:
        """Yield cheap reads of this node: those it has answered, then those of its protocol that it does not refuse."""
        yield from self.answered.values()
        for check in self.profile.sync_reads:
            if check not in self._refused:
                yield check

    def raise_max_reply_delay(self, max_reply_delay: float, now: float) -> None:
        """Raise the node's maximum reply delay to at least `max_reply_delay` seconds."""
        # The timings from before the first raise are kept, however often it is raised: an hour of prompt replies
        # restores them.
        if self._before_raised is None:
            self._before_raised = self.timings
        self.timings = self.timings.with_max_reply_delay(max_reply_delay)
        self.max_reply_delay_until = now + CALM_MAX_REPLY_DELAY

    def restore_max_reply_delay(self) -> None:
        """Restore the maximum reply delay from before it was raised."""
        if self._before_raised is not None:
            self.timings = self._before_raised
        self._before_raised = None
        self.max_reply_delay_until = inf

    @property
    def max_reply_delay(self) -> float:
        """The longest maximum reply delay of its timings, in seconds."""
        timings = self.timings
        return max(timings.read.max_reply_delay, timings.write.max_reply_delay, timings.packet.max_reply_delay)


class ProbeBudget:
    """A token bucket of line time, in seconds. `probe`: cost of a probe without a reply."""

    __slots__ = ("_earned_at", "_generous_until", "_pause", "probe", "tokens")

    def __init__(self, now: float) -> None:
        self.tokens = BUDGET_CAPACITY
        self.probe = 0.0
        self._earned_at = now
        self._generous_until = -inf
        self._pause = 0.0

    def idle(self, seconds: float, over: bool) -> None:
        """Earn from `seconds` of idle time, which is `over` or continues.

        An idle time too short for a probe earns nothing: a probe in it would delay the next request.
        """
        before, probe = self._pause, self.probe
        pause = before + seconds
        # Not in a pause that is shorter than a probe: 1000 pauses of 5 ms do not have room for one probe of 150 ms.
        if self.tokens < BUDGET_CAPACITY and pause > probe:
            # only the part that is longer than a probe and was not counted before
            earned = BUDGET_IDLE_SHARE * (pause - max(probe, before))
            self.tokens = min(BUDGET_CAPACITY, self.tokens + earned)
        # A continuing idle time is kept whole: reading the counters must not cut it into worthless pieces.
        self._pause = 0.0 if over else pause

    def node_returned(self, now: float) -> None:
        """Note that a node has come back: for BUDGET_RETURN_PERIOD seconds the bucket fills faster."""
        self._earn(now)
        self._generous_until = now + BUDGET_RETURN_PERIOD

    def take(self, cost: float, now: float, beside: float = 0.0) -> bool:
        """Pay for a probe and return True, if the bucket holds `cost` and `beside`. A full bucket pays for any
        probe."""
        self._earn(now)
        # A probe that costs more than the capacity would otherwise never be sent.
        if self.tokens < min(cost + beside, BUDGET_CAPACITY):
            return False
        # May become negative, for a probe that costs more than the capacity: the next one then waits longer.
        self.tokens -= cost
        return True

    def refund(self, seconds: float) -> None:
        """Return seconds to the bucket, up to its capacity."""
        self.tokens = min(BUDGET_CAPACITY, self.tokens + seconds)

    def wait_for(self, cost: float, now: float) -> float:
        """Return the seconds until the bucket may hold `cost`, at most LONGEST_BUDGET_WAIT."""
        share = BUDGET_SHARE_AFTER_RETURN if now < self._generous_until else BUDGET_SHARE
        # At most a second, because it may fill faster: a node may return, or the line may be idle.
        missing = min(cost, BUDGET_CAPACITY) - self.tokens
        return min(max(missing / share, 0.001), LONGEST_BUDGET_WAIT)

    def _earn(self, now: float) -> None:
        generous = max(0.0, min(now, self._generous_until) - self._earned_at)
        usual = max(0.0, now - self._earned_at - generous)
        earned = BUDGET_SHARE_AFTER_RETURN * generous + BUDGET_SHARE * usual
        self.tokens = min(BUDGET_CAPACITY, self.tokens + earned)
        self._earned_at = now


def flaps(node: NodeRecord, now: float) -> bool:
    """Return True if the node came back recently: then its next change of health proves nothing about other nodes."""
    return now - node.up_since < STEADY


def note_success(node: NodeRecord, now: float) -> None:
    """Update the health after a reply. The caller reports the change."""
    node.failures = 0
    # A drive that was away may have been replaced, or may be slower after power-up.
    if node.health is DOWN and node.learning is not None and node.up_since > -inf:
        node.learning.was_away()
    if node.health is SUSPECT:
        # Three replies and five seconds: a node that flaps would otherwise report UP and SUSPECT at every cycle.
        node.replies += 1
        if node.replies < UP_AFTER_REPLIES or now - node.failed_at < UP_AFTER_CALM:
            return
    else:
        node.up_since = now
        node.probe_at = inf
    node.health = UP


def note_failure(node: NodeRecord, now: float, jitter: Callable[[], float]) -> None:
    """Update the health after a transaction that failed without a valid reply. The caller reports the change.

    A broadcast can fail because of its echo. That is not a failure of a node, and there is no node to probe.
    """
    if node.address == node.profile.broadcast:
        return  # its probe cannot be sent, and would be selected and paid for again and again
    # Counted per transaction, after its retries: a single lost frame does not count.
    node.failures += 1
    node.failed_at = now
    node.replies = 0
    # It has failed a probe, or a request of a caller that the budget has paid for.
    if node.health is DOWN:
        # Only a failed probe doubles the delay; requests of callers to a dead node do not postpone its probe.
        if now >= node.probe_at:
            _probe_later(node, min(2 * node.probe_delay, LONGEST_PROBE_DELAY), now, jitter)
        return
    # One failure is enough for a node that never replied: a line that starts with thirty absent nodes would otherwise
    # wait for each of them three times.
    never_heard = node.health is UNKNOWN
    silent = now - node.last_reply >= DOWN_AFTER_SILENCE
    if never_heard or (node.failures >= DOWN_AFTER_FAILURES and silent):
        # A node that has just come back and dies again continues with its longer delays. Otherwise a flapping node
        # would use as much line time as a first death each time.
        again = min(2 * node.probe_delay, LONGEST_PROBE_DELAY)
        node.health = DOWN
        _probe_later(node, again if flaps(node, now) else FIRST_PROBE_DELAY, now, jitter)
    else:
        node.health = SUSPECT


def _probe_later(node: NodeRecord, delay: float, now: float, jitter: Callable[[], float]) -> None:
    node.probe_delay = delay
    node.probed_at = now
    # Nodes that died together (one fuse, one cable) would otherwise be probed together from then on.
    node.probe_at = now + delay * (1 + PROBE_JITTER * (2 * jitter() - 1))
