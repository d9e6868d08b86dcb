"""What of a world is left out of its key, and why it can make no difference.

Each thing that is left out has its argument beside it. `tests/proof/test_key.py` compares worlds that were restored
from their key with those that were not, and shows that a wrong one is noticed.
"""

from __future__ import annotations

from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable
from itertools import count
from math import inf

from busmaster.arbiter import in_step
from busmaster.arbiter.clients import OWN, Hold, LineClient
from busmaster.arbiter.health import SILENT, NodeRecord
from busmaster.arbiter.queues import EarliestDeadlineFirst, Fifo, Queue
from busmaster.arbiter.shared_backlog import SharedBacklog
from busmaster.arbiter.state import EXCHANGE, OFFLINE, SETTLING
from busmaster.arbiter.transaction import BACKGROUND, ENDED, Transaction
from busmaster.arbiter.turns import Turns
from busmaster.arbiter.unasked import QUIET, STRAGGLER_MEMORY
from busmaster.contract.timing import ReplyTiming
from busmaster.errors import LineNoisy
from tests.proof import setups
from tests.proof.instants import Instant, Past, past, ticks
from tests.proof.sharing_world import SharingWorld
from tests.proof.wire import OLD, STRAY, Time
from tests.proof.world import World
from tests.proof.zones import Zone


def noisy() -> LineNoisy:
    return LineNoisy("the line is noisy")


class View:
    """A world, and what its zone says of its times."""

    def __init__(self, world: World, zone: Zone) -> None:
        self.world = world
        self.zone = zone
        self.now: Instant = world.now

    def past(self, time: Time, by: float = 0.0, strictly: bool = False) -> bool:
        """Whether it is surely `by` seconds ago."""
        if type(time) is not Instant:
            return bool(time != inf)
        bound = self.zone[time.base][self.now.base]
        return bound <= 2 * (self.now.offset - time.offset - ticks(by)) + (not strictly)

    def before(self, first: Time, second: Time) -> bool:
        """Whether the one is surely not after the other."""
        if type(first) is Instant and type(second) is Instant:
            return self.zone[first.base][second.base] <= 2 * (second.offset - first.offset) + 1
        if type(first) is Past and type(second) is Past:
            return first.rank <= second.rank
        return type(first) is not Instant and first != inf

    def within_quarantine(self, time: Time, by: float) -> bool:
        """Whether a silence of `by` seconds from `time` on is surely over when the quarantine is, or will be where the
        line is down: it settles as it comes up, for the longest lateness of its nodes."""
        world = self.world
        arbiter = world.arbiter
        if type(time) is not Instant:
            return bool(time != inf)
        if arbiter.state is OFFLINE:
            longest = max(node.lateness for node in world.nodes) + arbiter._leg.latency + arbiter._leg.byte_time
            return by <= longest and self.past(time)
        until: Time = arbiter._quarantine
        if type(until) is not Instant:
            return False
        return self.zone[time.base][until.base] <= 2 * (until.offset - time.offset - ticks(by)) + 1


def transactions(world: World) -> list[Transaction]:
    arbiter = world.arbiter
    every = [t for queue in arbiter.dispatcher.backlog.queues for t in queue]
    every += [t for node in world.nodes for t in arbiter.dispatcher.writes.queues[node]]
    return every if arbiter._wire.transaction is None else [arbiter._wire.transaction, *every]


def longest_quiet(world: World) -> float:
    """No silence after which something is over is longer, whoever is asked next."""
    leg = world.arbiter._leg
    gaps = [t.byte_gap for node in world.nodes for t in _timings(node)]
    return max(QUIET, leg.timing.byte_gap, *gaps) + leg.latency + leg.byte_time


def longest_window(world: World) -> float:
    return max(t.window for node in world.nodes for t in _timings(node)) + world.arbiter._leg.latency


def _timings(node: NodeRecord) -> tuple[ReplyTiming, ReplyTiming, ReplyTiming]:
    return node.timings.read, node.timings.write, node.timings.packet


# what is left out, and why


def past_legs(view: View) -> None:
    """`begin` sets all of a leg before any of it is read; outside an exchange only `end`, `out` and what follows are
    read. They are asked only whether they lie ahead: `past()` of now on, `out + quiet` of now on. What the port
    holds moves all of them, so that they stay while it does. A settle ends no sooner than the quarantine: what is over
    by then is not asked for."""
    world = view.world
    arbiter, leg = world.arbiter, world.arbiter._leg
    is_moved = world.setup.may(setups.HELD) or world.setup.may(setups.FROZEN)  # what has been said leaves later
    is_unsaid = bool(world.held or arbiter._wire.output.held or world.frozen)
    leg.first_bytes = b""  # read only by what learns from them: see shipped.py
    if view.past(leg.taint_until):
        leg.taint_until = -inf
    if arbiter.state is not EXCHANGE:
        leg.begun = False
        leg.begun_at = leg.taint_until = -inf
        leg.longest = 0
        if leg._follows is None:
            leg._follows_until = -inf
            lateness = leg.timing.lateness + leg.latency + leg.byte_time
            is_over = view.past(leg.end, lateness) and not is_unsaid
            if is_over or (not is_moved and view.within_quarantine(leg.end, lateness)):
                leg.end = -inf
        elif view.past(leg._follows_until) and arbiter.state is SETTLING:
            pass  # a stray would start it anew
    else:
        if not leg.begun and arbiter._trust.held is None:
            leg.begun_at = -inf  # with its first byte
        leg._follows = None  # by `begin`
        leg._follows_until = -inf
    quiet = longest_quiet(world)
    if not is_unsaid and view.past(leg.out, quiet, strictly=True):
        leg.out = -inf
    if not is_moved and view.past(leg.out) and view.within_quarantine(leg.out, quiet):
        leg.out = -inf


def past_times_that_wait(view: View) -> None:
    """While the port holds what was said, and is asked again and again, its leg lies further and further back. It is to
    be moved to where that leaves, as a whole, so that only its distances count: it need lie no further back than what
    is asked of it until then. The settle begins anew there, too."""
    world, arbiter = view.world, view.world.arbiter
    leg = arbiter._leg
    if world.setup.in_step or not arbiter._wire.output.held:
        return
    if view.past(arbiter._silent_at):
        arbiter._silent_at = -inf
    timing = leg.timing
    reply = timing.window + timing.byte_gap + leg.longest * leg.byte_time
    longest = max(timing.lateness + leg.byte_time, reply, longest_quiet(world)) + leg.latency
    if view.past(leg.end, longest) and view.past(leg.out, longest):
        lasts: Time = leg.out - leg.end
        if type(lasts) is float:
            leg.end = view.now - longest
            leg.out = leg.end + lasts
            if leg.begun and view.past(leg.begun_at, longest):
                leg.begun_at = leg.end


def past_silences(view: View) -> None:
    """Of the last byte is asked whether it is a silence ago, or a window; of the noise, whether it lasts too long,
    while the line is not NOISY already; of the quarantine, whether it is over; of the settle, nothing once it is."""
    world, strays = view.world, view.world.arbiter._unasked
    asked = max(longest_quiet(world), longest_window(world) if world.setup.in_step else 0.0)
    if view.past(strays.last_byte, asked, strictly=True):
        strays.last_byte = -inf
    if not world.setup.in_step and view.within_quarantine(strays.last_byte, asked):  # else it chooses what goes next
        strays.last_byte = -inf
    if world.arbiter.noisy or not world.setup.in_step:  # see shipped.py
        strays._noise_since = -inf if strays._noise_since != inf else inf
    if view.past(world.arbiter._quarantine) or world.arbiter.state is OFFLINE:  # `line_up` sets it
        world.arbiter._quarantine = -inf
    if world.arbiter.state is not SETTLING:
        world.arbiter._silent_at = -inf
    world.arbiter._up_at = -inf  # for nodes that are added later
    if not world.frozen:
        world.arbiter._wire.output.said_at = -inf  # set with what is said next, and read when that is written


def past_stragglers(view: View) -> None:
    """Who was not answered is blamed within STRAGGLER_MEMORY; where nobody's lateness is raised, never."""
    strays = view.world.arbiter._unasked
    if not view.world.setup.in_step:
        strays.run.clear()  # `InStep.heard` alone reads it
    one = strays.unanswered_one
    if one is not None and not (view.world.setup.may(setups.RAISED) and not view.past(one[1], STRAGGLER_MEMORY, True)):
        strays.unanswered_one = None
    if strays._straggler is not None and not strays.run:
        strays._straggler = None  # `silent` forgets it, too
    if strays.unanswered_one is None:
        strays._looked = strays._look_at = -inf


def past_requests(view: View) -> None:
    """Of a request's times only `started` is read, on the wire: where something is owed, or exchanges have a limit.
    `deadline` orders polls and probes alone, and of these there is one at a time; `queued` counts where there is a
    `start_by`, and its order where a sequence may wait for a write that was asked before. Of attempts, whether there
    were any."""
    world = view.world
    owed = world.setup.in_step and bool(world.arbiter._in_step.debts)
    limited = world.kind.profile.exchange_limit is not None or owed
    ranks = _ranks_of_queued(view) if world.setup.longest_hold else {}
    for transaction in transactions(world):
        transaction.queued = ranks.get(transaction, 0.0)
        _past_request(transaction)
        if not (world.setup.may(setups.RAISED) and transaction is world.arbiter._wire.transaction):
            transaction.overdue = False  # it makes a node slower, and `started` sets it
        if not (limited and transaction is world.arbiter._wire.transaction) and not world.frozen:
            transaction.started = -inf


def _past_request(transaction: Transaction) -> None:
    transaction.first_byte = transaction.last_byte = transaction.ended_at = transaction.refused_until = -inf
    transaction.exchanges_ahead = 0
    transaction.settling_ahead = 0.0
    transaction.refused_cycles = 0
    transaction.late = False
    transaction.attempts = min(transaction.attempts, 1)
    transaction.deadline = inf


def _ranks_of_queued(view: View) -> dict[Transaction, Time]:
    """In what order they were asked; times, where that is not known."""
    waiting = list(dict.fromkeys(transactions(view.world)))
    if not all(_ordered(view, a.queued, b.queued) for a in waiting for b in waiting):
        return {one: one.queued for one in waiting}
    return {one: past(sum(not view.before(one.queued, other.queued) for other in waiting), 0) for one in waiting}


def past_nodes(view: View) -> None:
    """Of a node's times, the order of the last replies is read and nothing else: when it is probed is set aside."""
    world = view.world
    replied = [node for node in world.nodes if node.last_reply != -inf]
    replied.sort(key=lambda node: sum(view.before(other.last_reply, node.last_reply) for other in replied))
    if all(_ordered(view, a.last_reply, b.last_reply) for a in replied for b in replied):
        for rank, node in enumerate(replied):
            node.last_reply = past(rank, 0)  # type: ignore[assignment]  # a rank in place of a time
    unheard = SILENT if world.setup.learned is None else in_step.MOST_UNHEARD + 1
    for node in world.nodes:
        node.failed_at = node.up_since = -inf
        node.probe_at = inf
        node.lateness_until = inf  # an hour: coming down again is left out
        node.unheard = min(node.unheard, unheard) if world.setup.in_step else 0  # only R15 asks
        node.replies = 0


def _ordered(view: View, first: Time, second: Time) -> bool:
    return view.before(first, second) or view.before(second, first)


def past_debts(view: View) -> None:
    """Of a debt that has lapsed is asked only how long it was in time, and whether it was so before the request that
    is on the wire. Of doubts, whether they are over, and only of the latest entry of each key: an entry is asked for
    by its key, and all entries of one key are removed together. Of what was said, whether it is SAID_MEMORY ago. Of the
    last exchanges, what would answer them, in no order: that RECENT exchanges later it is forgotten is left out."""
    world, book = view.world, view.world.arbiter._in_step
    if not world.setup.in_step:
        return
    book.recent = deque(sorted(set(map(tuple, book.recent))), book.recent.maxlen)
    on_wire = world.arbiter._wire.transaction
    for debt in book.debts:
        if debt.until != inf and view.past(debt.until):
            debt.until = -inf
        if not (view.past(debt.asked, in_step.LAPSE, strictly=True) and view.past(debt.over)):
            continue
        asked: Time = debt.asked
        over: Time = debt.over
        if type(asked) is Instant and (on_wire is None or view.before(over, on_wire.started)):
            apart = over - asked
            if type(apart) is float:
                asked, over = past(0, 0), past(0, ticks(apart))
                debt.asked, debt.over = asked, over
    book._doubted = _latest_of_each(view, [entry for entry in book._doubted if not view.past(entry[1])])
    book._forgiven = _latest_of_each(view, [entry for entry in book._forgiven if not view.past(entry[1])])
    if book.lone_bytes_until != inf and view.past(book.lone_bytes_until):
        book.lone_bytes_until = -inf
    if view.past(book._doubt_until):
        book._doubt_until = -inf
    while book._said and view.past(book._said[0][1], in_step.SAID_MEMORY, strictly=True):
        book._said.popleft()


def _latest_of_each(view: View, entries: list[tuple[bytes, float]]) -> list[tuple[bytes, float]]:
    """Keep of each key the entry that ends last, as far as the zone orders them. Sorted by key."""
    kept: list[tuple[bytes, float]] = []
    for place, (key, until) in enumerate(entries):
        later = entries[place + 1 :]
        if any(other == key and view.before(until, ends) for other, ends in (*kept, *later)):
            continue
        kept = [entry for entry in kept if entry[0] != key or not view.before(entry[1], until)]
        kept.append((key, until))
    return sorted(kept, key=lambda entry: entry[0])


def past_holds_back(view: View) -> None:
    """Of when the first request went before one that is held back is asked whether it is a lateness ago; it is set anew
    before that where none has gone. When the last byte came is set before it is asked."""
    choice = view.world.arbiter._choice
    choice._last_byte = -inf
    lateness = max(node.lateness for node in view.world.nodes)
    if not choice._gone_before or view.past(choice._held_since, lateness):
        choice._held_since = -inf


def past_waiting(view: View) -> None:
    """Queues are what waits in them, in order; turns of lower classes count where there are such; why a line is down
    is for people."""
    world = view.world
    arbiter, dispatcher = world.arbiter, world.arbiter.dispatcher
    arbiter._cause = ""
    queues = dispatcher.writes.queues
    dispatcher.writes.queues = defaultdict(deque, {node: queues[node] for node in world.nodes})
    if arbiter.noisy:
        dispatcher.fault = noisy
    for queue in dispatcher.backlog.queues:
        _past_queue(queue)
    backlog = dispatcher.backlog
    if not world.setup.may(setups.HEALTH):
        backlog._streak = 0
    backlog._streak_before, backlog._rotated_before = 0, BACKGROUND
    if isinstance(backlog, SharedBacklog) and isinstance(world, SharingWorld):
        _past_turns(view, backlog, world.ranks)


def _past_queue(queue: Queue) -> None:
    if isinstance(queue, Turns):
        for turn in queue._turns.values():
            _past_queue(turn.queue)
    elif isinstance(queue, Fifo):
        queue._entries = deque(queue)
    elif isinstance(queue, EarliestDeadlineFirst):
        assert queue.live < 2
        queue._entries = [(inf, 0, transaction) for transaction in queue]
        queue._order = count(1)


def _past_turns(view: View, backlog: SharedBacklog, ranks: dict[LineClient, int]) -> None:
    """What turns cost is counted by nobody, in what order they were had neither. Of what was taken out last it is asked
    whether a sequence begins with it, in which class, and since when, unless that is longer ago than it may last: then
    it is over as it begins. How it ended is not."""
    backlog._payer = None
    last = backlog._last
    hold = None if last is None else last.client
    if last is None or not isinstance(hold, Hold) or hold.holds or hold.over:
        backlog._last, backlog._attempts, backlog._since = None, 0, -inf
    else:
        if view.past(backlog._since, hold.longest):
            backlog._since = -inf
        if last.phase is ENDED:
            _past_request(last)
            last.queued, last.started, last.tag, last.value, last.error = 0.0, -inf, None, None, None
            last.retried = last.refusals = 0
            last.wanted, last.unsure = True, False
    for turns in backlog._turns:
        kept = [turn for turn in turns._turns.values() if turn.queue.live or turn is turns._next or turn.client is OWN]
        turns._turns = OrderedDict((turn.client, turn) for turn in sorted(kept, key=lambda turn: ranks[turn.client]))


def past_replies(view: View) -> None:
    """A reply that is too late never comes: those behind it, where they keep their order, may."""
    view.world.owed = [reply for reply in view.world.owed if not view.past(reply.hi)]


def past_wire(view: View) -> None:
    """The adversary's own state: what was heard is judged within its exchange; what an attempt was to be answered with,
    while it is on the wire; when a reply may come, until it may."""
    world = view.world
    for reply in world.owed:
        lasts = (len(reply.data) - 1) * world.byte_time if world.setup.whole else 0.0
        if view.past(reply.lo, lasts):
            reply.lo = -inf
    if not world.words_are_read:
        _past_words(world)
    if not world.unread:
        world.unread_by = -inf
    if view.past(world.said_by):
        world.said_by = -inf
    if view.past(world.hold_until):
        world.hold_until = -inf
    if isinstance(world, SharingWorld) and view.past(world.held_until, strictly=True):
        world.held_until = past(0, 0)
    on_wire = world.arbiter._wire.transaction
    if on_wire is None and not world.frozen:
        world.by = None
        world.forged = False
        world.cancels = 1
    for ticket in world.live:
        if (on_wire is None or ticket is not on_wire.tag) and not world.frozen:
            ticket.place = -1
    world.said = b""
    world.ended = []


def _past_words(world: World) -> None:
    """Where nobody reads the words, only that something comes makes a difference, and whether a node has said it. Bytes
    from nowhere that lie unread may be read in the next exchange."""
    if any(origin != STRAY for _, origin in world.unread):
        world.unread = ((0, OLD),)
    for reply in world.owed:
        if reply.kind == "reply":
            reply.data = bytes(len(reply.data))
            reply.request = b""
            reply.ticket = None


FORGOTTEN: list[Callable[[View], None]] = [
    past_legs,
    past_times_that_wait,
    past_silences,
    past_stragglers,
    past_requests,
    past_nodes,
    past_debts,
    past_holds_back,
    past_waiting,
    past_replies,
    past_wire,
]


def simplify(world: World, zone: Zone, forgotten: list[Callable[[View], None]] | None = None) -> None:
    """Drop from a world, in place, what can make no difference."""
    view = View(world, zone)
    for forget in FORGOTTEN if forgotten is None else forgotten:
        forget(view)
