"""Which nodes live, and how much line time the dead ones may cost (R11)."""

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
"""Seconds a node must stay up before its next death starts with the first probe delay again: no flapping."""
UP_AFTER_REPLIES = 3
UP_AFTER_CALM = 5.0
"""A SUSPECT node is UP after so many replies, and seconds, without a failure: one that flaps is reported once."""

BUDGET_SHARE = 0.02
BUDGET_IDLE_SHARE = 0.25
BUDGET_SHARE_AFTER_RETURN = 0.2
BUDGET_RETURN_PERIOD = 30.0
BUDGET_CAPACITY = 0.5
"""Seconds of line time that may be saved up."""
LONGEST_BUDGET_WAIT = 1.0

CALM_MAX_REPLY_DELAY = 3600.0
"""Seconds of prompt replies after which a maximum reply delay that was raised comes down again."""
SILENT = 2
"""Attempts in a row without a byte after which a node is not asked whether it is in sync."""
MOST_ANSWERED = 3
"""Commands that are remembered of a node because it has answered them."""
SLOWER, SLOWER_BY = 1.25, 0.001
"""A reply is later than its node usually is if it takes so many times its slowest one, and so many seconds."""
SLOWEST_DECAY = 0.002
"""By how much of the difference a node's slowest reply is forgotten with each one that is faster."""


class Health(enum.Enum):
    """UNKNOWN was never heard; SUSPECT failed lately; DOWN is probed, and its polls are parked.

    OFFLINE is every node while its line is lost. A record never has it: `Node.health` combines record and line.
    """

    UNKNOWN = "unknown"
    UP = "up"
    SUSPECT = "suspect"
    DOWN = "down"
    OFFLINE = "offline"


UNKNOWN, UP, SUSPECT, DOWN, OFFLINE = Health


class NodeRecord:
    """What the arbiter knows of one node. Changed by the arbiter alone."""

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
        "retries",
        "slowest",
        "stops",
        "suspended_until",
        "timings",
        "told_late",
        "unheard",
        "up_since",
        "usual",
    )

    def __init__(self, profile: Profile, address: int, timings: Timings, retries: int, line: str = "") -> None:
        self.profile = profile
        self.address = address
        self.line = line
        """The name of its line, for errors."""
        self.label = profile.label(address)
        self.timings = timings
        self.retries = retries
        self.learning: Learning | None = None
        """What is learned of its reply times, where that is wished for."""
        self.health = UNKNOWN
        self.budgeted = False
        """Whether it counts as down only because a client named it, and it has never replied."""
        self.failures = 0
        """Transactions in a row that failed without a valid reply."""
        self.failed_at = -inf
        """When the last of its transactions failed so."""
        self.replies = 0
        """Replies in a row since then."""
        self.last_reply = -inf
        self.up_since = -inf
        self.counters = NodeCounters()
        self.probe_delay = FIRST_PROBE_DELAY
        self.probe_at = inf
        self.probed_at = -inf
        self.suspended_until = -inf
        self.has_hook = False
        self.removed = False
        """It is no longer a node of the line, which sends it nothing of its own accord."""
        self.holds = 0
        """Returns whose on_return hook has not ended: its polls wait."""
        self.stops = 0
        """How often it was told to stop: what was decided before must not undo it."""
        self.answered: dict[Sequence[bytes], Command[Any]] = {}
        """A few reads that it has answered, by what their answers look like (R15)."""
        self._refused: set[Command[Any]] = set()
        """The checks that it has refused for certain, and not answered since."""
        self.unheard = 0
        """Attempts in a row that brought nothing."""
        self.slowest = 0.0
        """Seconds to the first byte of about the slowest of its last replies."""
        self.usual: float | None = None
        """Seconds to the first byte of its usual reply, in runs of answers that are alike; None until there was one."""
        self.max_reply_delay_until = inf
        """When a maximum reply delay that was raised comes down again, if all replies are prompt until then."""
        self._before_raised: Timings | None = None
        self.told_late = 0.0
        """Seconds to the first byte of the latest of its replies that was told as a late one."""

    def __repr__(self) -> str:
        return f"<{self.profile.name} {self.label}, {self.health.value}>"

    def note_reply(self, answers: Sequence[bytes], command: Command[Any], took: float) -> None:
        """Note that the node has answered this command rightly, after `took` seconds."""
        self.unheard = 0
        if self._refused:
            self._refused.discard(command)
        # Up at once, down slowly: it decides which answers are believed (R15), and one slow reply among many fast ones
        # is what it must not forget.
        slowest = self.slowest
        self.slowest = took if took > slowest else slowest - SLOWEST_DECAY * (slowest - took)
        if answers not in self.answered and len(self.answered) < MOST_ANSWERED and not command.writes:
            self.answered[answers] = command

    @property
    def silent(self) -> bool:
        """Whether the node does not answer, as far as is known."""
        return self.unheard >= SILENT

    def latest(self, unknown: float) -> float:
        """Return the seconds to the first byte of a reply that is no later than usual; `unknown` if none was timed."""
        return SLOWER * self.slowest + SLOWER_BY if self.slowest else unknown

    def note_refused(self, command: Command[Any]) -> None:
        """Stop using a sync read that was refused for certain. If the node has refused all of them, use all again."""
        if command in self.profile.sync_reads:
            self._refused.add(command)
        # A node that refuses all of them is still better asked than not: a refusal is a reply, too.
        if self._refused.issuperset(self.profile.sync_reads):
            self._refused.clear()
        self.answered = {key: read for key, read in self.answered.items() if read != command}

    def sync_reads(self) -> Iterator[Command[Any]]:
        """Yield cheap reads of this node: those that it has answered, then those of its protocol that it does not
        refuse."""
        yield from self.answered.values()
        for check in self.profile.sync_reads:
            if check not in self._refused:
                yield check

    def raise_max_reply_delay(self, max_reply_delay: float, now: float) -> None:
        """Raise the node's maximum reply delay to at least `max_reply_delay` seconds: it was slower than was
        believed."""
        # The first timings are kept, however often it is raised: prompt replies for an hour restore those.
        if self._before_raised is None:
            self._before_raised = self.timings
        self.timings = self.timings.with_max_reply_delay(max_reply_delay)
        self.max_reply_delay_until = now + CALM_MAX_REPLY_DELAY

    def restore_max_reply_delay(self) -> None:
        """Set the maximum reply delay back to what it was before it was raised."""
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
    """A token bucket of line time, in seconds. `probe`: what a probe costs if it is not answered."""

    __slots__ = ("_earned_at", "_generous_until", "_pause", "probe", "tokens")

    def __init__(self, now: float) -> None:
        self.tokens = BUDGET_CAPACITY
        self.probe = 0.0
        self._earned_at = now
        self._generous_until = -inf
        self._pause = 0.0

    def idle(self, seconds: float, over: bool) -> None:
        """Earn from a pause of the line, which took so many seconds (more) and is `over` or goes on.

        A pause too short for a probe earns nothing: there a probe would delay what comes next.
        """
        before, probe = self._pause, self.probe
        pause = before + seconds
        if self.tokens < BUDGET_CAPACITY and pause > probe:
            # only what is longer than a probe, and only what was not counted when the same pause was looked at before
            earned = BUDGET_IDLE_SHARE * (pause - max(probe, before))
            self.tokens = min(BUDGET_CAPACITY, self.tokens + earned)
        # One that goes on is kept whole: looking at the counters must not cut it into pieces that are worth nothing.
        self._pause = 0.0 if over else pause

    def node_returned(self, now: float) -> None:
        """Note that a node has come back: the bucket fills faster for BUDGET_RETURN_PERIOD seconds."""
        self._earn(now)
        self._generous_until = now + BUDGET_RETURN_PERIOD

    def take(self, cost: float, now: float, beside: float = 0.0) -> bool:
        """Pay for a probe and return True, if the bucket holds it `beside` so much (a full one pays for anything)."""
        self._earn(now)
        # A full bucket pays for any probe: one that costs more than the capacity would otherwise never be sent.
        if self.tokens < min(cost + beside, BUDGET_CAPACITY):
            return False
        self.tokens -= cost
        return True

    def refund(self, seconds: float) -> None:
        """Put so many seconds back into the bucket, as far as they fit."""
        self.tokens = min(BUDGET_CAPACITY, self.tokens + seconds)

    def wait_for(self, cost: float, now: float) -> float:
        """Return the seconds until the bucket holds `cost` at the current share; asked again by then at the latest."""
        share = BUDGET_SHARE_AFTER_RETURN if now < self._generous_until else BUDGET_SHARE
        # At most a second, because the share may rise meanwhile: a node has returned, or the line was idle.
        missing = min(cost, BUDGET_CAPACITY) - self.tokens
        return min(max(missing / share, 0.001), LONGEST_BUDGET_WAIT)

    def _earn(self, now: float) -> None:
        generous = max(0.0, min(now, self._generous_until) - self._earned_at)
        usual = max(0.0, now - self._earned_at - generous)
        earned = BUDGET_SHARE_AFTER_RETURN * generous + BUDGET_SHARE * usual
        self.tokens = min(BUDGET_CAPACITY, self.tokens + earned)
        self._earned_at = now


def flaps(node: NodeRecord, now: float) -> bool:
    """Return whether the node came back a short while ago: its next death or return tells nothing about others."""
    return now - node.up_since < STEADY


def note_success(node: NodeRecord, now: float) -> None:
    """Note that a reply of the node came. The caller reports the change of health."""
    node.failures = 0
    # A drive that was away may have been replaced, or may answer slower after power-up.
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
    """Note that a transaction failed without a valid reply. The caller reports the change of health.

    A broadcast fails for what its echo was: that says nothing of a node, and there is none to be probed.
    """
    if node.address == node.profile.broadcast:
        return  # its probe cannot be sent, and would be chosen and paid for again and again
    # Counted per transaction, after its retries: a single lost frame does not count.
    node.failures += 1
    node.failed_at = now
    node.replies = 0
    if node.health is DOWN:
        # Only a failed probe doubles the delay; requests of callers to a dead node do not postpone its probe.
        if now >= node.probe_at:
            _probe_later(node, min(2 * node.probe_delay, LONGEST_PROBE_DELAY), now, jitter)
        return
    # One failure is enough of a node that was never heard: nothing says that it is there, and a
    # line that starts with thirty absent nodes would else wait for each of them three times.
    never_heard = node.health is UNKNOWN
    silent = now - node.last_reply >= DOWN_AFTER_SILENCE
    if never_heard or (node.failures >= DOWN_AFTER_FAILURES and silent):
        # One that has just come back and is gone again goes on with its longer delays, or flapping would cost as much
        # line time as dying for the first time, each time.
        again = min(2 * node.probe_delay, LONGEST_PROBE_DELAY)
        node.health = DOWN
        _probe_later(node, again if flaps(node, now) else FIRST_PROBE_DELAY, now, jitter)
    else:
        node.health = SUSPECT


def _probe_later(node: NodeRecord, delay: float, now: float, jitter: Callable[[], float]) -> None:
    node.probe_delay = delay
    node.probed_at = now
    # Nodes that died together (one fuse, one cable) would else be probed together ever after.
    node.probe_at = now + delay * (1 + PROBE_JITTER * (2 * jitter() - 1))
