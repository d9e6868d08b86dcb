"""What of the shipping code is set aside, and why that is sound. Everything else runs as it ships.

- Counters and histograms: nothing that is decided depends on them. They do arithmetic that no zone can tell.
- How long a node's replies take, as it is learned: `NodeRecord.latest` may say whatever the world names.
- Learned windows: see learned_windows.py.
- Health and probes: a failure may be held against a node, or not, and a node that is down is probed at any time, or
  asked for a caller's sake, or not. Without HEALTH no failure is held against anybody.
- How far an overdue reply raises its node's maximum reply delay: to either of two values, or (without RAISED) not at
  all.
- What is overdue (R15), unless the world is `in_sync`: whatever is asked of it, the answer may be yes or no; and what
  goes next may be the first that waits, another, a check, or nothing until any time. So whatever R15 does is among what
  is explored. Checks are one read of each node.
- Whose turn it is, of those who wait in a class: anybody's may be next. What a turn costs is counted by nobody.
- Whether the line has been noisy for too long: with NOISE it may be or not, at each stray byte; without, it never is.
- Where R15 is not set aside, its spans are what the world says. They are shorter: fewer overdue replies at a time.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from math import inf
from typing import Any, ClassVar

from busmaster.arbiter import choice, health, in_sync
from busmaster.arbiter.choice import IDLE, Action, Choice, WaitUntil
from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.dispatcher import Dispatcher
from busmaster.arbiter.health import DOWN, SUSPECT, UP, NodeRecord
from busmaster.arbiter.probes import Probes
from busmaster.arbiter.shared_backlog import URGENT_RUN, Turns
from busmaster.arbiter.transaction import Transaction
from busmaster.arbiter.unexpected import LATE_REPLY_MEMORY, LATE_REPLY_SHARE, LONGEST_MAX_REPLY_DELAY, UnexpectedBytes
from busmaster.contract.exchange import Command
from tests.verification.proof.learned_windows import AnyTime, learned_windows
from tests.verification.proof.setups import HEALTH, HOLDS, NOISE, RAISED, Setup
from tests.verification.proof.wire import choose

RAISED_TO = (0.25, LONGEST_MAX_REPLY_DELAY)


class _Uncounted:
    """Stands for a number or a histogram that nobody reads."""

    def __iadd__(self, other: Any) -> _Uncounted:
        return self

    __add__ = __radd__ = __sub__ = __rsub__ = __iadd__

    def __getitem__(self, place: Any) -> _Uncounted:
        return self

    def __setitem__(self, place: Any, value: Any) -> None:
        pass

    def record(self, *arguments: Any) -> None:
        pass

    append = record

    @property
    def new(self) -> _Uncounted:
        return self

    def __len__(self) -> int:
        return 0

    def __reduce__(self) -> str:
        return "UNCOUNTED"


class _NoCounters:
    """Stands for the counters of a line or a node."""

    entered = 0.0

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return UNCOUNTED

    def __setattr__(self, name: str, value: Any) -> None:
        pass

    def mark(self, *arguments: Any) -> None:
        pass

    def __reduce__(self) -> str:
        return "NO_COUNTERS"


class _Budget:
    """Stands for the budget of probes: it may pay for a caller's request, or not."""

    probe = 0.0
    tokens = 1.0

    def __setattr__(self, name: str, value: Any) -> None:
        pass

    def idle(self, *arguments: Any, **named: Any) -> None:
        pass

    refund = node_returned = idle

    def take(self, *arguments: Any) -> bool:
        return not choose(2)

    def __reduce__(self) -> str:
        return "BUDGET"


UNCOUNTED, NO_COUNTERS, BUDGET = _Uncounted(), _NoCounters(), _Budget()


class AnyStep:
    """Stands for what is overdue on a line: whatever is asked of it, it may say."""

    last: Sequence[bytes] = ()
    before: Sequence[bytes] = ()
    alert = True
    lone_bytes_until = -inf

    def __setattr__(self, name: str, value: Any) -> None:
        pass

    def __reduce__(self) -> str:
        return "ANY_STEP"

    @property
    def overdue_replies(self) -> Sequence[str]:
        return ("an overdue reply",) if choose(2) else ()

    def overdue(self) -> list[Any]:
        return []

    def nothing(self, *arguments: Any) -> None:
        pass

    add_overdue = lapse = forgive = answered = note_answered = answered_twice = heard = came_up = stood_alone = nothing

    def perhaps(self, *arguments: Any, **named: Any) -> bool:
        return bool(choose(2))

    clashes = has_ambiguity = lone_byte_is_overdue = is_overdue = refusals_are_ambiguous = perhaps

    def is_ambiguous(self, *arguments: Any) -> bool:
        return self.holds[0] and bool(choose(2))

    is_to_be_held = is_ambiguous

    def awaited_until(self, *arguments: Any) -> float:
        """Nothing is: no window of these worlds is learned."""
        return -inf

    holds: ClassVar[list[bool]] = [False]
    """Whether an answer may be held until another could have come."""


ANY_STEP = AnyStep()


def no_jitter() -> float:
    return 0.5


@contextmanager
def set_aside(setup: Setup) -> Iterator[None]:
    """Replace what is set aside, for as long as one world is explored."""
    undo: list[Callable[[], None]] = []

    def put(owner: Any, name: str, value: Any) -> None:
        before = getattr(owner, name)
        undo.append(lambda: setattr(owner, name, before))
        setattr(owner, name, value)

    put(Dispatcher, "next", _asking(Dispatcher.next))
    put(Dispatcher, "succeeded", _deciding(Dispatcher.succeeded))
    put(Dispatcher, "refused", _deciding(Dispatcher.refused))
    if not setup.in_sync:
        put(Choice, "next", _any_of_all)
        put(UnexpectedBytes, "babbling", _may_be_noisy if setup.may(NOISE) else _is_never_noisy)
        AnyStep.holds[0] = setup.may(HOLDS)
    put(Turns, "_waiting", _in_their_order)
    put(Turns, "_chosen", _anybodys)
    put(Turns, "charge", _counts_nothing)
    put(Turns, "count_run", _counts_nothing)
    put(Turns, "begin_runs", _counts_nothing)
    put(Turns, "shortest_run", _any_run)
    put(in_sync, "LAPSE", setup.lapse)
    put(in_sync, "RECENT", 2)
    put(in_sync, "AMBIGUITY_PERIOD", setup.doubt)
    put(in_sync, "ANSWER_MEMORY", setup.said_memory)
    put(choice, "LONGEST_ALIKE", setup.alike)
    put(choice, "LONGEST_STEADY", setup.alike + 1)
    put(choice.Alike, "_was_untimely", _may_be_untimely)
    put(NodeRecord, "note_reply", _untimed(NodeRecord.note_reply) if setup.in_sync else _notes_nothing)
    put(NodeRecord, "latest", _as_learned(NodeRecord.latest, setup))
    if setup.learned is not None:
        for owner, name, stand_in in learned_windows(setup):
            put(owner, name, stand_in)
    put(UnexpectedBytes, "blame", _may_raise if setup.may(RAISED) else _raises_nothing)
    if not setup.may(RAISED):
        put(UnexpectedBytes, "unanswered", _blames_nobody)
    put(health, "note_failure", _may_fail if setup.may(HEALTH) else _fails_nothing)
    if setup.may(HEALTH):
        put(health, "note_success", _may_be_up)
        put(health, "flaps", lambda node, now: bool(choose(2)))
        put(Probes, "plan", _at_any_time)
        put(Probes, "next", _of_any_node)
    try:
        yield
    finally:
        for step in reversed(undo):
            step()


def _untimed(right: Callable[..., None]) -> Callable[..., None]:
    def note_reply(node: NodeRecord, answers: Sequence[bytes], command: Command[Any], took: float) -> None:
        right(node, answers, command, 0.0)

    return note_reply


class Looked:
    """Whether the line was only looked at in this step: it resynchronises on, until the same time as before, or is
    READY."""

    only: ClassVar[list[bool]] = [False]


class Decided:
    """Whether an answer was taken for one in this step: a value, an acknowledgement, a refusal."""

    by_answer: ClassVar[list[bool]] = [False]


def _deciding(right: Callable[..., None]) -> Callable[..., None]:
    def decide(dispatcher: Dispatcher, transaction: Transaction, *arguments: Any) -> None:
        """A read that is refused once is none: a NAK may be noise before the true reply."""
        if right.__name__ == "succeeded" or transaction.writes or transaction.refusals:
            Decided.by_answer[0] = True
        right(dispatcher, transaction, *arguments)

    return decide


class Asker:
    """Who asks something in the moment in which the line is free: what waits need not be known before."""

    ask: ClassVar[list[Callable[[], None]]] = [lambda: None]
    saturated: ClassVar[list[bool]] = [False]
    """Whether something will be asked as soon as the line is free."""


def _asking(right: Callable[..., Any]) -> Callable[..., Any]:
    def next_(dispatcher: Dispatcher, now: float) -> Any:
        if not len(dispatcher.backlog) and dispatcher.fault is None:
            Asker.ask[0]()
        return right(dispatcher, now)

    return next_


def _any_of_all(self: Choice, now: float, last_byte: float) -> Action:
    """Choose any time until which to wait, a check of any node, the first that waits, or another of its class."""
    dispatcher = self._dispatcher
    if Asker.saturated[0] or len(dispatcher.backlog):
        nodes = [node for node in dispatcher.nodes if node.health is not DOWN]
        which = choose(2 + len(nodes))
        if which == 1:
            AnyTime.chosen[0] = True
            return WaitUntil(AnyTime.at[0])
        if which > 1:
            node = nodes[which - 2]
            command = node.profile.sync_reads[0]
            return dispatcher.check(node, command, now), command.open(node.address, node.timings)
    transaction = dispatcher.next(now)
    if transaction is None:
        return IDLE
    first = (transaction, transaction.command.open(transaction.node.address, transaction.node.timings))
    if len(dispatcher.backlog) and choose(2):
        other = self._another(first, now, lambda answers, node: False)
        if other is not None:
            dispatcher.backlog.restore(transaction)
            return other
    return first


class Ranks:
    """The order in which those who wait are told: turns that were had make none."""

    of: ClassVar[dict[LineClient, int]] = {}


def _in_their_order(turns: Turns) -> list[Any]:
    waiting = [turn for turn in turns._turns.values() if turn.queue.live]
    return sorted(waiting, key=lambda turn: Ranks.of.get(turn.client, 0))


def _anybodys(turns: Turns) -> Any:
    """What was given back is the next all the same."""
    given_back, turns._next = turns._next, None
    if given_back is not None and given_back.queue.live:
        return given_back
    waiting = turns._waiting()
    return waiting[choose(len(waiting))]


def _counts_nothing(*arguments: Any) -> None:
    pass


def _any_run(turns: Turns) -> int:
    return choose(2) * URGENT_RUN


def _may_be_untimely(*arguments: Any) -> bool:
    """How soon an answer came shows that it is its own, or not."""
    return bool(choose(2))


def _notes_nothing(*arguments: Any) -> None:
    """Which reads are asked to prove that the line is in sync is for the world to say."""


def _as_learned(right: Callable[[NodeRecord, float], float], setup: Setup) -> Callable[..., float]:
    slowest = setup.slowest

    def latest(node: NodeRecord, unknown: float) -> float:
        if setup.learned is not None:
            return setup.learned[choose(2)]
        node.slowest = slowest[choose(len(slowest))]
        said = right(node, unknown)
        node.slowest = 0.0
        return said

    return latest


def _may_raise(strays: UnexpectedBytes, first_byte: float) -> float:
    """That it was late is told to nobody."""
    if strays.unanswered_one is None:
        return 0.0
    node, asked, max_reply_delay = strays.unanswered_one
    strays.unanswered_one = None
    stalled = first_byte > strays._look_at + 0.005
    age = (strays._looked if stalled else first_byte) - asked
    if LATE_REPLY_SHARE * max_reply_delay < age and age <= LATE_REPLY_MEMORY:
        higher = [raised for raised in RAISED_TO if raised > max_reply_delay]
        if higher:
            node.raise_max_reply_delay(higher[choose(len(higher))], first_byte)
    return 0.0


def _may_be_noisy(strays: UnexpectedBytes, now: float) -> bool:
    return bool(choose(2))


def _is_never_noisy(strays: UnexpectedBytes, now: float) -> bool:
    return False


def _blames_nobody(strays: UnexpectedBytes, node: NodeRecord, asked: float, max_reply_delay: float) -> None:
    """The line is not looked at while it resynchronises, either: a look changes nothing else."""


def _raises_nothing(strays: UnexpectedBytes, first_byte: float) -> float:
    return 0.0


def _fails_nothing(node: NodeRecord, now: float, jitter: Callable[[], float]) -> None:
    pass


def _may_fail(node: NodeRecord, now: float, jitter: Callable[[], float]) -> None:
    held_against = choose(3)
    if held_against and node.health is not DOWN:
        node.failures = 1
        node.health = SUSPECT if held_against == 1 else DOWN


def _may_be_up(node: NodeRecord, now: float) -> None:
    node.failures = 0
    if node.health is not SUSPECT or not choose(2):
        node.health = UP


def _at_any_time(probes: Probes) -> None:
    """When a node that is down is probed is for the adversary to say."""


def _of_any_node(probes: Probes, now: float, usable: bool, idle: bool) -> Transaction:
    down = [node for node in probes.nodes if node.health is DOWN]
    return probes._probe(down[choose(len(down))], 0.0, now)
