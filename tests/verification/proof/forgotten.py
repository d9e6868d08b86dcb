"""What of a world is left out of its key, and why it can make no difference.

Each thing that is left out has its argument beside it. `tests/verification/proof/test_key.py` compares worlds that were
restored from their key with those that were not, and shows that a wrong one is noticed.
"""

from __future__ import annotations

from collections import OrderedDict, defaultdict, deque
from collections.abc import Callable
from itertools import count
from math import inf

from busmaster.arbiter import in_sync
from busmaster.arbiter.backlog import EarliestDeadlineFirst, Fifo, Queue
from busmaster.arbiter.clients import OWN, Hold, LineClient
from busmaster.arbiter.counters import EXCHANGE, OFFLINE, RESYNCHRONISING
from busmaster.arbiter.health import SILENT, NodeRecord
from busmaster.arbiter.shared_backlog import SharedBacklog, Turns
from busmaster.arbiter.transaction import BACKGROUND, ENDED, Transaction
from busmaster.arbiter.unexpected import LATE_REPLY_MEMORY, QUIET
from busmaster.contract.timing import ReplyTiming
from busmaster.errors import LineNoisy
from tests.verification.proof import setups
from tests.verification.proof.instants import Instant, Past, past, ticks
from tests.verification.proof.sharing_world import SharingWorld
from tests.verification.proof.wire import OLD, STRAY, Time
from tests.verification.proof.world import World
from tests.verification.proof.zones import Zone


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
        line is down: it resynchronises as it comes up, for the longest maximum reply delay of its nodes."""
        world = self.world
        arbiter = world.arbiter
        if type(time) is not Instant:
            return bool(time != inf)
        if arbiter.state is OFFLINE:
            longest = (
                max(node.max_reply_delay for node in world.nodes) + arbiter._step.latency + arbiter._step.byte_time
            )
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
    step = world.arbiter._step
    gaps = [t.inter_byte_timeout for node in world.nodes for t in _timings(node)]
    return max(QUIET, step.timing.inter_byte_timeout, *gaps) + step.latency + step.byte_time


def longest_window(world: World) -> float:
    return max(t.window for node in world.nodes for t in _timings(node)) + world.arbiter._step.latency


def _timings(node: NodeRecord) -> tuple[ReplyTiming, ReplyTiming, ReplyTiming]:
    return node.timings.read, node.timings.write, node.timings.packet


# what is left out, and why


def past_steps(view: View) -> None:
    """`begin` sets all of a step before any of it is read; outside an exchange only `end`, `out` and what follows are
    read. They are asked only whether they lie ahead: `past()` of now on, `out + quiet` of now on. What the port holds
    moves all of them, so that they stay while it does. A resynchronisation ends no sooner than the quarantine: what is
    over by then is not asked for."""
    world = view.world
    arbiter, step = world.arbiter, world.arbiter._step
    is_moved = world.setup.may(setups.HELD) or world.setup.may(setups.FROZEN)  # what has been said leaves later
    is_unsaid = bool(world.held or arbiter._wire.output.held or world.frozen)
    step.first_bytes = b""  # read only by what learns from them: see shipped.py
    if step.timing.silence is None:
        step.heard = False  # read only for a learned window, and `begin` sets both
    if view.past(step.taint_until):
        step.taint_until = -inf
    if arbiter.state is not EXCHANGE:
        step.begun = False
        step.begun_at = step.taint_until = -inf
        step.longest = 0
        if step._follows is None:
            step._follows_until = -inf
            max_reply_delay = step.timing.max_reply_delay + step.latency + step.byte_time
            is_over = view.past(step.end, max_reply_delay) and not is_unsaid
            if is_over or (not is_moved and view.within_quarantine(step.end, max_reply_delay)):
                step.end = -inf
        elif view.past(step._follows_until) and arbiter.state is RESYNCHRONISING:
            pass  # a stray would start it anew
    else:
        if not step.begun and arbiter._trust.held is None:
            step.begun_at = -inf  # with its first byte
        step._follows = None  # by `begin`
        step._follows_until = -inf
    quiet = longest_quiet(world)
    if not is_unsaid and view.past(step.out, quiet, strictly=True):
        step.out = -inf
    if not is_moved and view.past(step.out) and view.within_quarantine(step.out, quiet):
        step.out = -inf


def past_times_that_wait(view: View) -> None:
    """While the port holds what was said, and is asked again and again, its step lies further and further back. It is
    to be moved to where that leaves, as a whole, so that only its distances count: it need lie no further back than
    what is asked of it until then. The resynchronisation begins anew there, too."""
    world, arbiter = view.world, view.world.arbiter
    step = arbiter._step
    if world.setup.in_sync or not arbiter._wire.output.held:
        return
    if view.past(arbiter._silent_at):
        arbiter._silent_at = -inf
    timing = step.timing
    reply = timing.window + timing.inter_byte_timeout + step.longest * step.byte_time
    longest = max(timing.max_reply_delay + step.byte_time, reply, longest_quiet(world)) + step.latency
    if view.past(step.end, longest) and view.past(step.out, longest):
        lasts: Time = step.out - step.end
        if type(lasts) is float:
            step.end = view.now - longest
            step.out = step.end + lasts
            if step.begun and view.past(step.begun_at, longest):
                step.begun_at = step.end


def past_silences(view: View) -> None:
    """Of the last byte is asked whether it is a silence ago, or a window; of the noise, whether it lasts too long,
    while the line is not NOISY already; of the quarantine, whether it is over; of the resynchronisation, nothing once
    it is."""
    world, strays = view.world, view.world.arbiter._unexpected
    asked = max(longest_quiet(world), longest_window(world) if world.setup.in_sync else 0.0)
    if view.past(strays.last_byte, asked, strictly=True):
        strays.last_byte = -inf
    if not world.setup.in_sync and view.within_quarantine(strays.last_byte, asked):  # else it chooses what goes next
        strays.last_byte = -inf
    if world.arbiter.noisy or not world.setup.in_sync:  # see shipped.py
        strays._noise_since = -inf if strays._noise_since != inf else inf
    if view.past(world.arbiter._quarantine) or world.arbiter.state is OFFLINE:  # `line_up` sets it
        world.arbiter._quarantine = -inf
    if world.arbiter.state is not RESYNCHRONISING:
        world.arbiter._silent_at = -inf
    world.arbiter._up_at = -inf  # for nodes that are added later
    if not world.frozen:
        output = world.arbiter._wire.output
        output.sent_at, output.begins = -inf, False  # set with what is said next, and read when that is written


def past_late_replies(view: View) -> None:
    """Who was not answered is blamed within LATE_REPLY_MEMORY; where nobody's maximum reply delay is raised, never."""
    strays = view.world.arbiter._unexpected
    if not view.world.setup.in_sync:
        strays.run.clear()  # `InSync.heard` alone reads it
    one = strays.unanswered_one
    if one is not None and not (view.world.setup.may(setups.RAISED) and not view.past(one[1], LATE_REPLY_MEMORY, True)):
        strays.unanswered_one = None
    if strays._overdue_reply is not None and not strays.run:
        strays._overdue_reply = None  # `silent` forgets it, too
    if strays.unanswered_one is None:
        strays._looked = strays._look_at = -inf


def past_requests(view: View) -> None:
    """Of a request's times only `started` is read, on the wire: where something is overdue, or exchanges have a limit.
    `deadline` orders polls and probes alone, and of these there is one at a time; `queued` counts where there is a
    `start_by`, and its order where a sequence may wait for a write that was asked before. Of attempts, whether there
    were any."""
    world = view.world
    overdue = world.setup.in_sync and bool(world.arbiter._in_sync.overdue_replies)
    limited = world.kind.profile.exchange_limit is not None or overdue
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
    transaction.quiet_time_ahead = 0.0
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
    unheard = SILENT if world.setup.learned is None else in_sync.MOST_UNHEARD + 1
    for node in world.nodes:
        node.failed_at = node.up_since = -inf
        node.probe_at = inf
        node.max_reply_delay_until = inf  # an hour: coming down again is left out
        node.unheard = min(node.unheard, unheard) if world.setup.in_sync else 0  # only R15 asks
        node.replies = 0


def _ordered(view: View, first: Time, second: Time) -> bool:
    return view.before(first, second) or view.before(second, first)


def past_overdue_replies(view: View) -> None:
    """Of an overdue reply that has lapsed is asked only how long it was in time, and whether it was so before the
    request that is on the wire. Of doubts, whether they are over, and only of the latest entry of each key: an entry is
    asked for by its key, and all entries of one key are removed together. Of what was said, whether it is ANSWER_MEMORY
    ago. Of the last exchanges, what would answer them, in no order: that RECENT exchanges later it is forgotten is left
    out."""
    world, book = view.world, view.world.arbiter._in_sync
    if not world.setup.in_sync:
        return
    book.recent = deque(sorted(set(map(tuple, book.recent))), book.recent.maxlen)
    on_wire = world.arbiter._wire.transaction
    for overdue in book.overdue_replies:
        if overdue.until != inf and view.past(overdue.until):
            overdue.until = -inf
        if not (view.past(overdue.asked, in_sync.LAPSE, strictly=True) and view.past(overdue.over)):
            continue
        asked: Time = overdue.asked
        over: Time = overdue.over
        if type(asked) is Instant and (on_wire is None or view.before(over, on_wire.started)):
            apart = over - asked
            if type(apart) is float:
                asked, over = past(0, 0), past(0, ticks(apart))
                overdue.asked, overdue.over = asked, over
    book._ambiguous = _latest_of_each(view, [entry for entry in book._ambiguous if not view.past(entry[1])])
    book._forgiven = _latest_of_each(view, [entry for entry in book._forgiven if not view.past(entry[1])])
    if book.lone_bytes_until != inf and view.past(book.lone_bytes_until):
        book.lone_bytes_until = -inf
    if view.past(book._ambiguous_until):
        book._ambiguous_until = -inf
    answered = {key: when for key, when in book._answered.items() if not _is_past_memory(view, when)}
    book._answered = dict(sorted(answered.items()))


def _is_past_memory(view: View, when: Time) -> bool:
    return view.past(when, in_sync.ANSWER_MEMORY, strictly=True)


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
    """Of when the first request went before one that is held back is asked whether it is a maximum reply delay ago; it
    is set anew before that where none has gone. When the last byte came is set before it is asked."""
    choice = view.world.arbiter._choice
    choice._last_byte = -inf
    max_reply_delay = max(node.max_reply_delay for node in view.world.nodes)
    if not choice._gone_before or view.past(choice._held_since, max_reply_delay):
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
    view.world.overdue = [reply for reply in view.world.overdue if not view.past(reply.hi)]


def past_wire(view: View) -> None:
    """The adversary's own state: what was heard is judged within its exchange; what an attempt was to be answered with,
    while it is on the wire; when a reply may come, until it may."""
    world = view.world
    for reply in world.overdue:
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
    for reply in world.overdue:
        if reply.kind == "reply":
            reply.data = bytes(len(reply.data))
            reply.request = b""
            reply.ticket = None


FORGOTTEN: list[Callable[[View], None]] = [
    past_steps,
    past_times_that_wait,
    past_silences,
    past_late_replies,
    past_requests,
    past_nodes,
    past_overdue_replies,
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
