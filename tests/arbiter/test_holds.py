"""A sequence of requests that the line is held for: nothing but URGENT comes between (R9)."""

from __future__ import annotations

import pytest

from busmaster.arbiter.clients import Hold, LineClient
from busmaster.arbiter.counters import LineState
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.errors import HoldEnded, LineDown, NoReply, Superseded, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import Bench, lost, request_of, up

WRITE = hcp2.Write(1, (5.0,))
LONGEST = 0.5
URGENT, COMMAND, POLL, BACKGROUND = Priority


class Table:
    """A line with two nodes that are up; the first may be held."""

    def __init__(self) -> None:
        self.bench = bench = Bench()
        self.arbiter = bench.arbiter
        self.node, self.there = up(bench), up(bench, 2)
        self.answered: list[Transaction] = []

    def hold(self, client: LineClient | None = None, longest: float = LONGEST) -> Hold:
        return self.arbiter.exclusive(self.node, client, longest)

    def release(self, hold: Hold) -> None:
        self.arbiter.release(hold, self.bench.now)
        self.bench.listen()

    def ask_one_of_each(self, client: LineClient | None = None) -> list[Transaction]:
        """What is not to come between, of each class below URGENT."""
        asked = [
            self.bench.ask(node, hcp2.Read(20 + priority), priority=priority, client=client)
            for node in (self.node, self.there)
            for priority in (COMMAND, POLL, BACKGROUND)
        ]
        return [*asked, self.bench.ask(self.node, hcp2.Write(9, (1.0,)), client=client)]

    def is_silent(self, seconds: float = 0.1) -> bool:
        """Nothing is said for so long."""
        self.bench.wait(seconds)
        return not self.bench.sent()


@pytest.mark.parametrize("client", [None, LineClient()])
@pytest.mark.parametrize("other", [None, LineClient()])
def test_r9_nothing_comes_between_a_write_and_the_read_that_confirms_it(
    client: LineClient | None, other: LineClient | None
) -> None:
    table = Table()
    bench, hold = table.bench, table.hold(client)
    write = bench.ask(table.node, WRITE, client=hold)
    others = table.ask_one_of_each(other)
    bench.served(write)
    assert table.is_silent(), "the line waits for what the program asks next"
    assert table.arbiter.state is LineState.READY
    read = bench.ask(table.node, hcp2.Read(1), client=hold)
    bench.served(read)
    assert read.started > write.ended_at
    assert table.is_silent()
    assert not any(other.attempts for other in others)
    table.release(hold)
    for one in others:
        bench.served(one)
        assert one.error is None


def test_r9_an_urgent_request_comes_between() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    bench.served(bench.ask(table.node, WRITE, client=hold))
    stop = bench.ask(table.there, hcp2.Write(2, (0.0,)), priority=URGENT, client=LineClient())
    bench.served(stop)
    assert stop.error is None
    held = bench.ask(table.node, hcp2.Read(1), client=hold)
    assert bench.served(held).error is None


def test_r7_an_urgent_write_supersedes_those_of_a_sequence_too() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    bench.ask(table.there)
    write = bench.ask(table.node, WRITE, client=hold)
    stop = bench.ask(table.node, hcp2.Write(2, (0.0,)), priority=URGENT)
    assert isinstance(write.error, Superseded)
    bench.served(stop)
    table.release(hold)
    assert table.arbiter.dispatcher.backlog.waiting(COMMAND) == 0


def test_a_sequence_begins_in_its_turn_with_the_first_request_that_is_sent() -> None:
    table = Table()
    bench = table.bench
    before = [bench.ask(table.there, hcp2.Read(n + 1)) for n in range(3)]
    hold = table.hold()
    held = bench.ask(table.node, WRITE, client=hold)
    behind = bench.ask(table.there, hcp2.Read(9))
    for one in before:
        bench.served(one)
        assert not hold.holds
    bench.served(held)
    assert hold.holds
    assert table.is_silent()
    assert not behind.attempts


def test_a_sequence_ends_when_its_time_is_over_and_what_it_asks_then_is_not_sent() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    bench.served(bench.ask(table.node, WRITE, client=hold))
    other = bench.ask(table.there)
    assert table.is_silent(LONGEST / 2)
    bench.wait(LONGEST / 2)
    assert other.attempts == 1
    assert hold.over
    bench.served(other)


def test_a_sequence_that_goes_on_asking_ends_all_the_same() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    began = bench.now
    other = bench.ask(table.there, hcp2.Read(30), priority=BACKGROUND)
    while not other.attempts:
        if hold.over:
            bench.until_sent()
            break
        read = bench.ask(table.node, hcp2.Read(1 + bench.sync_reads), client=hold)
        bench.served(read)
        bench.wait(0.03)
    bench.served(other)
    assert other.started - began <= LONGEST + 0.2


def test_what_waits_of_a_sequence_whose_time_is_over_ends_truthfully() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=0.1)
    bench.served(bench.ask(table.node, WRITE, client=hold))
    unanswered = bench.ask(table.node, WRITE, client=hold, idempotent=True, retries=5)
    waits = bench.ask(table.node, hcp2.Read(1), client=hold)
    parked = bench.ask(table.node, WRITE, client=hold)
    bench.until_sent()
    bench.sent()
    bench.wait(0.3)
    assert isinstance(unanswered.error, WriteUnconfirmed)
    assert unanswered.attempts == 1, "not repeated when others may have come between"
    assert isinstance(waits.error, HoldEnded)
    assert isinstance(parked.error, HoldEnded)
    assert "node 1" in str(waits.error)
    assert "0.1 s" in str(waits.error)
    assert "max_hold" in str(waits.error)
    assert not table.arbiter.dispatcher.writes.queues[table.node]


def test_r7_a_write_of_another_program_that_waits_for_an_earlier_one_outlives_a_sequence() -> None:
    table = Table()
    bench, hold, other = table.bench, table.hold(), table.arbiter.add_client()
    earlier, waits = (
        bench.ask(table.node, WRITE, client=other, priority=priority, idempotent=True, retries=5)
        for priority in (BACKGROUND, COMMAND)
    )
    while waits.phase is not Phase.PARKED:
        bench.until_sent()
        bench.sent()
    held = bench.ask(table.node, WRITE, client=hold)
    while not held.attempts:
        bench.until_sent()
        bench.sent()
    bench.served(held)
    table.release(hold)
    for write in (earlier, waits):
        assert bench.served(write).error is None


def test_what_fails_within_a_sequence_is_repeated_within_it() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    read = bench.ask(table.node, hcp2.Read(1), client=hold)
    others = table.ask_one_of_each()
    bench.until_sent()
    bench.sent()
    bench.until_sent()  # resynchronised; a check, or again
    bench.served(read)
    assert read.error is None
    assert read.attempts == 2
    assert not any(other.attempts for other in others)


def test_r15_only_what_proves_that_the_line_is_in_sync_comes_between() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    lost(bench, table.there, hcp2.Read(1))
    others = table.ask_one_of_each()
    bench.served(others[0])
    first = bench.ask(table.node, hcp2.Read(1), client=hold)
    bench.served(first)
    checks = table.arbiter.statistics(bench.now).sync_reads
    gone = [one.attempts for one in others]
    for n in range(3):
        bench.served(bench.ask(table.node, hcp2.Read(n + 1), client=hold))
    assert [one.attempts for one in others] == gone
    assert table.arbiter.statistics(bench.now).sync_reads >= checks


def test_r9_sequences_of_one_program_in_a_row_alternate_with_the_requests_of_all_others() -> None:
    table = Table()
    bench = table.bench
    one, other = table.arbiter.add_client(), table.arbiter.add_client()
    own = [bench.ask(table.there, hcp2.Read(n + 1)) for n in range(20)]
    theirs = [bench.ask(table.there, hcp2.Read(n + 1), client=other) for n in range(20)]
    polled = [bench.ask(table.there, hcp2.Read(n + 1), priority=POLL) for n in range(20)]
    for n in range(1, 4):
        hold = table.hold(one)
        bench.served(bench.ask(table.node, WRITE, client=hold))
        bench.wait(0.2)
        bench.served(bench.ask(table.node, hcp2.Read(1), client=hold))
        table.release(hold)
        for queue in (own, theirs, polled):
            assert sum(transaction.attempts for transaction in queue) >= n - 1
    for queue in (own, theirs, polled):
        assert any(bench.ended(transaction) for transaction in queue)


def test_r9_behind_a_sequence_goes_what_waits_in_a_lower_class() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    write = bench.ask(table.node, WRITE, client=hold)
    command = bench.ask(table.there, hcp2.Read(20))
    lower = bench.ask(table.there, hcp2.Read(21), priority=BACKGROUND)
    bench.served(write)
    table.release(hold)
    bench.served(lower)
    bench.served(command)
    assert lower.started < command.started


def test_r9_behind_an_urgent_sequence_of_another_program_goes_what_waits_in_a_lower_class() -> None:
    table = Table()
    bench, program = table.bench, LineClient()
    hold = table.hold(program)
    write = bench.ask(table.node, WRITE, priority=URGENT, client=hold)
    bench.until_sent()
    urgent = bench.ask(table.there, hcp2.Read(20), priority=URGENT, client=program)
    command = bench.ask(table.there, hcp2.Read(21))
    table.release(hold)
    bench.served(urgent)
    assert write.started < command.started < urgent.started


@pytest.mark.parametrize(("program", "priority"), [(LineClient(), COMMAND), (None, URGENT)])
def test_r9_behind_any_other_sequence_the_urgent_request_of_its_program_goes_first(
    program: LineClient | None, priority: Priority
) -> None:
    table = Table()
    bench = table.bench
    bench.served(bench.ask(table.there, hcp2.Read(20), priority=URGENT, client=program))
    hold = table.hold(program)
    bench.ask(table.node, WRITE, priority=priority, client=hold)
    bench.until_sent()
    urgent = bench.ask(table.there, hcp2.Read(20), priority=URGENT, client=program)
    command = bench.ask(table.there, hcp2.Read(21))
    table.release(hold)
    bench.served(command)
    assert urgent.started < command.started


def test_r9_within_a_sequence_urgent_requests_of_users_go_in_turn_though_their_role_has_used_its_part() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    used, first, second = (table.arbiter.add_client(owner_time=127.0, user=user) for user in ("used", "1", "2"))
    bench.served(bench.ask(table.node, WRITE, client=hold))
    before = bench.ask(table.there, hcp2.Read(20), priority=URGENT, client=used)
    bench.until_sent()
    waiting = [bench.ask(table.there, hcp2.Read(n), priority=URGENT, client=c) for n, c in ((21, first), (22, second))]
    for urgent in (before, *waiting):
        bench.served(urgent)
    assert before.started < waiting[0].started < waiting[1].started


def test_r10_polls_that_were_due_meanwhile_are_counted_as_missed() -> None:
    table = Table()
    bench = table.bench
    poll = bench.poll(table.there, 0.05, 7)
    hold = table.hold()
    bench.served(bench.ask(table.node, WRITE, client=hold))
    assert table.is_silent(0.3)
    assert poll.missed >= 4
    table.release(hold)
    cycles = len(bench.cycles)
    bench.until_sent()
    bench.answer()
    assert len(bench.cycles) == cycles + 1


def test_r6_a_caller_of_a_sequence_may_go() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    write = bench.ask(table.node, WRITE, client=hold)
    other = bench.ask(table.there)
    table.arbiter.cancel(write, bench.now)
    table.release(hold)
    bench.answer()
    bench.served(other)
    assert other.error is None


def test_r8_what_waits_of_a_sequence_that_is_left_before_it_began_ends_once() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    other = bench.ask(table.there)
    waiting = [bench.ask(table.node, command, client=hold) for command in (WRITE, hcp2.Read(1), WRITE)]
    table.release(hold)
    bench.served(other)
    assert table.is_silent()
    for transaction in waiting:
        assert bench.ended(transaction) == 1
        assert isinstance(transaction.error, HoldEnded)
    assert bench.served(bench.ask(table.node, WRITE)).error is None


def test_a_sequence_that_never_sent_anything_held_nothing() -> None:
    table = Table()
    hold = table.hold()
    table.release(hold)
    assert table.bench.served(table.bench.ask(table.node)).error is None


def test_sequences_that_come_and_go_leave_nothing() -> None:
    table = Table()
    for _ in range(50):
        hold = table.hold()
        table.bench.served(table.bench.ask(table.node, WRITE, client=hold))
        table.bench.served(table.bench.ask(table.node, hcp2.Read(1), client=hold))
        table.release(hold)
    assert all(len(turns._turns) == 1 for turns in table.arbiter.dispatcher.share()._turns)


def test_r8_a_lost_line_ends_what_waits_of_a_sequence_and_what_waits_for_it() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    bench.served(bench.ask(table.node, WRITE, client=hold))
    others = table.ask_one_of_each()
    held = bench.ask(table.node, hcp2.Read(1), client=hold)
    more = bench.ask(table.node, WRITE, client=hold)
    table.arbiter.line_down("pulled out", bench.now)
    bench.listen()
    for transaction in (*others, held, more):
        assert bench.ended(transaction) == 1
        assert isinstance(transaction.error, LineDown)
    table.arbiter.line_up(bench.now)
    table.release(hold)
    bench.until_ready()
    assert bench.served(bench.ask(table.there)).error is None


def test_r9_a_sequence_has_begun_with_the_request_that_left_though_the_line_is_lost_before_it_is_answered() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    bench.ask(table.node, WRITE, client=hold)
    bench.until_sent()
    bench.sent()
    table.arbiter.line_down("pulled out", bench.now)
    table.arbiter.line_up(bench.now)
    other, confirms = bench.ask(table.node), bench.ask(table.node, hcp2.Read(2), client=hold)
    bench.served(confirms)
    assert table.is_silent()
    assert other.attempts == 0
    table.release(hold)
    bench.served(other)


@pytest.mark.parametrize("begins_with", [WRITE, hcp2.Read(1)])
def test_r7_a_sequence_does_not_overtake_an_earlier_write_of_its_program_to_the_node(
    begins_with: hcp2.Write | hcp2.Read,
) -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    earlier = bench.ask(table.node, hcp2.Write(3, (7.0,)), idempotent=True, retries=3)
    first = bench.ask(table.node, begins_with, client=hold)
    second = bench.ask(table.node, WRITE, client=hold)
    bench.until_sent()
    bench.sent()  # the earlier one is lost, and is to be repeated behind the others of its class
    bench.served(second)
    assert bench.ended(earlier) == 1
    assert earlier.error is None
    assert earlier.attempts == 2
    assert earlier.started < first.started < second.started


def test_r7_a_write_of_the_program_that_waited_for_a_sequence_goes_when_it_is_over() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    bench.ask(table.there)
    held = bench.ask(table.node, WRITE, client=hold)
    waits = bench.ask(table.node, hcp2.Write(2, (3.0,)), idempotent=True)
    bench.served(held)
    assert table.is_silent()
    table.release(hold)
    bench.served(waits)
    assert waits.error is None


def test_a_dead_node_is_not_held() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    table.arbiter.dispatcher.suspend(table.node, bench.now + 60.0)
    held = bench.ask(table.node, WRITE, client=hold)
    other = bench.ask(table.there)
    assert bench.ended(held) == 1
    bench.served(other)
    assert not hold.holds


def test_a_read_that_is_never_answered_within_a_sequence_ends_as_ever() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    read = bench.ask(table.node, hcp2.Read(1), client=hold, retries=0)
    bench.until_sent()
    bench.sent()
    bench.wait(0.3)
    assert isinstance(read.error, NoReply)
    table.release(hold)
    assert bench.served(bench.ask(table.there, hcp2.Read(5))).phase is Phase.ENDED


def test_the_request_of_a_sequence_is_that_of_its_node() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    bench.ask(table.node, hcp2.Read(3), client=hold)
    assert bench.sent() == request_of(3)


def test_r9_no_urgent_sequence_begins_while_the_line_is_held_for_another() -> None:
    table = Table()
    bench = table.bench
    first, second = table.hold(table.arbiter.add_client()), table.hold(table.arbiter.add_client())
    bench.served(bench.ask(table.node, WRITE, client=first))
    begins = bench.ask(table.there, WRITE, priority=URGENT, client=second)
    bench.served(bench.ask(table.node, hcp2.Read(1), client=first))
    assert table.is_silent()
    assert not begins.attempts
    table.release(first)
    bench.served(begins)
    assert second.holds


def test_r9_a_stop_passes_a_held_line_though_it_is_the_first_request_of_a_sequence() -> None:
    table = Table()
    bench = table.bench
    first, second = table.hold(table.arbiter.add_client()), table.hold(table.arbiter.add_client())
    bench.served(bench.ask(table.node, WRITE, client=first))
    bench.served(bench.ask(table.there, WRITE, priority=URGENT, client=second, stop=True))
    assert first.holds
    assert not second.holds
    bench.served(bench.ask(table.node, hcp2.Read(1), client=first))
    table.release(first)
    bench.served(bench.ask(table.there, hcp2.Read(1), client=second))
    assert second.holds


def test_r9_a_stop_waits_for_no_sequence_of_its_own_program_that_may_not_begin() -> None:
    table = Table()
    bench, program = table.bench, table.arbiter.add_client()
    first, second = table.hold(table.arbiter.add_client()), table.hold(program)
    bench.served(bench.ask(table.node, WRITE, client=first))
    write = bench.ask(table.there, WRITE, priority=URGENT, client=second)
    stop = bench.ask(table.there, hcp2.Write(2, (0.0,)), priority=URGENT, client=program, stop=True)
    bench.served(stop)
    assert first.holds
    assert write.started < stop.started
    assert not second.holds


def paused(table: Table) -> Hold:
    """Hold the line for half a second while the owner waits, and begin another sequence, which has to wait."""
    bench = table.bench
    first, second = (table.hold(table.arbiter.add_client(owner_time=1.0)) for _ in range(2))
    write = bench.ask(table.node, WRITE, client=first)
    polled = bench.ask(table.there, hcp2.Read(20), priority=POLL)
    bench.served(write)
    bench.wait(LONGEST)
    assert first.over
    bench.served(polled)
    return second


def test_r9_a_sequence_waits_until_the_owner_has_had_twice_as_long_as_the_last_one() -> None:
    table = Table()
    bench, second = table.bench, paused(table)
    began = bench.now
    begins = bench.ask(table.node, WRITE, client=second)
    assert table.is_silent(LONGEST)
    bench.served(begins)  # nothing else wakes the line
    assert 2 * LONGEST - 0.02 < begins.started - began < 2 * LONGEST + 0.05
    assert second.holds


def test_r9_a_sequence_that_kept_nobody_waiting_delays_no_other() -> None:
    table = Table()
    bench = table.bench
    first, second = (table.hold(table.arbiter.add_client(owner_time=1.0)) for _ in range(2))
    bench.served(bench.ask(table.node, WRITE, client=first))
    bench.wait(LONGEST)
    bench.ask(table.node, WRITE, client=second)
    assert bench.until_sent() < 0.01


def test_r9_sequences_of_the_owner_wait_for_no_pause() -> None:
    table = Table()
    bench, second = table.bench, paused(table)
    begins = bench.ask(table.node, WRITE, client=second)
    own = table.hold()
    bench.served(bench.ask(table.node, hcp2.Write(3, (1.0,)), client=own))
    assert own.holds
    assert not begins.attempts


def test_r9_what_a_program_asks_outside_its_sequence_does_not_wait_for_it() -> None:
    table = Table()
    bench, second = table.bench, paused(table)
    begins = bench.ask(table.node, hcp2.Read(1), client=second)
    bench.served(bench.ask(table.node, hcp2.Read(2), client=second.client))
    assert not begins.attempts


def test_r9_the_second_write_of_a_sequence_that_may_not_begin_waits_too_where_the_first_is_cancelled() -> None:
    table = Table()
    bench, second = table.bench, paused(table)
    first, behind = (bench.ask(table.node, WRITE, client=second) for _ in range(2))
    table.arbiter.cancel(first, bench.now)
    assert table.is_silent(LONGEST)
    bench.served(behind)
    assert second.holds


def test_r9_a_sequence_waits_eight_times_its_pause_at_most_whatever_others_of_its_role_ask() -> None:
    table = Table()
    bench, second = table.bench, paused(table)
    began = bench.now
    begins = bench.ask(table.node, WRITE, client=second)
    for element in range(200):
        bench.ask(table.there, hcp2.Read(1 + element % 50), priority=POLL)
    for client in [table.arbiter.add_client(owner_time=1.0) for _ in range(30)]:
        for element in range(5):
            bench.ask(table.there, hcp2.Read(60 + element), client=client)
    bench.served(begins, after=0.09)
    waited = begins.started - began
    assert 7.5 * LONGEST * 2 < waited < 8.5 * LONGEST * 2


def test_r9_a_sequence_begins_after_its_pause_though_the_timer_comes_late() -> None:
    table = Table()
    bench, second = table.bench, paused(table)
    begins = bench.ask(table.node, WRITE, client=second)
    bench.now += 3 * LONGEST
    table.arbiter.handle_timeout(bench.now)
    bench.listen()
    assert begins.attempts == 1
    assert table.arbiter.poll_timeout() > bench.now


@pytest.mark.parametrize("ends", ["released", "cancelled", "lost"])
def test_r8_a_request_of_a_sequence_that_may_not_begin_ends_once(ends: str) -> None:
    table = Table()
    bench, second = table.bench, paused(table)
    backlog = table.arbiter.dispatcher.backlog
    begins = bench.ask(table.node, WRITE, client=second)
    assert len(backlog) == backlog.waiting_of(COMMAND, second.client) == 1
    match ends:
        case "released":
            table.release(second)
        case "cancelled":
            table.arbiter.cancel(begins, bench.now)
        case _:
            table.arbiter.line_down("pulled out", bench.now)
            table.arbiter.line_up(bench.now)
    bench.listen()
    assert begins.phase is Phase.ENDED
    assert len(backlog) == 0
    assert table.is_silent(3 * LONGEST)
    assert begins.attempts == 0


def hold_and_ask(table: Table, client: LineClient, seconds: float) -> None:
    """Hold the line for so long, with one request behind the other, while the owner waits."""
    bench, hold = table.bench, table.hold(client, longest=5.0)
    begun = bench.now
    while bench.now < begun + seconds:
        bench.served(bench.ask(table.node, hcp2.Read(2), client=hold), after=0.05)
    table.release(hold)


@pytest.mark.parametrize("others", [False, True])
def test_r9_a_sequence_is_charged_whole_in_however_many_pieces_it_asks(others: bool) -> None:
    """Also if another program of the role has a short exchange behind it."""
    table = Table()
    bench = table.bench
    client, other = (table.arbiter.add_client(owner_time=1.0) for _ in range(2))
    hold_and_ask(table, client, 3.0)
    ended = bench.now
    for element in range(1, 101):
        bench.ask(table.there, hcp2.Read(element), priority=POLL)
    if others:
        bench.served(bench.ask(table.node, hcp2.Read(4), priority=URGENT, client=other))
    again = bench.ask(table.node, hcp2.Read(3), client=other if others else client)
    bench.served(again, after=0.05)
    assert again.started > ended + 2.8


def test_r9_an_urgent_request_behind_an_urgent_sequence_does_not_wait_as_long_as_that_held_the_line() -> None:
    table = Table()
    bench, client = table.bench, table.arbiter.add_client(owner_time=1.0)
    hold = table.hold(client, longest=5.0)
    bench.served(bench.ask(table.node, WRITE, client=hold, priority=URGENT))
    bench.wait(2.0)
    table.release(hold)
    for element in range(1, 101):
        bench.ask(table.there, hcp2.Read(element), priority=POLL)
    stop = bench.ask(table.node, hcp2.Read(3), priority=URGENT, client=client)
    assert bench.served(stop, after=0.05).started - stop.queued < 0.3


def test_r9_an_urgent_request_of_an_operator_goes_next_in_a_sequence_whatever_others_have_waiting() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(table.arbiter.add_client(), longest=5.0)
    floods = [table.arbiter.add_client(owner_time=1.0) for _ in range(8)]
    operator = table.arbiter.add_client(owner_time=1.0)
    for client in floods:
        bench.served(bench.ask(table.there, hcp2.Read(2), priority=URGENT, client=client), after=0.05)
    bench.served(bench.ask(table.node, hcp2.Read(2), client=hold))
    for client in floods:
        bench.ask(table.there, hcp2.Read(2), priority=URGENT, client=client)
    bench.until_sent()
    stop = bench.ask(table.there, hcp2.Read(3), priority=URGENT, client=operator)
    bench.answer()
    bench.until_sent()
    assert stop.attempts == 1


def test_r9_a_sequence_that_waits_for_others_keeps_its_place_among_the_programs() -> None:
    """Each sequence of another program, while it lasts, puts it aside."""
    table = Table()
    bench, program = table.bench, table.arbiter.add_client()
    others = [table.arbiter.add_client() for _ in range(3)]
    waits = bench.ask(table.node, hcp2.Read(1), client=table.hold(program))
    for _ in range(20):
        turns = [(hold := table.hold(other), bench.ask(table.node, WRITE, client=hold)) for other in others]
        for hold, write in turns:
            bench.served(write)
            table.release(hold)
        if waits.attempts:
            break
    assert waits.attempts == 1


def test_r9_a_sequence_that_is_left_while_its_first_request_is_on_the_wire_holds_nothing_afterwards() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    bench.ask(table.node, WRITE, client=hold)
    bench.until_sent()
    table.release(hold)
    others = [bench.ask(table.there, client=client) for client in (None, table.arbiter.add_client())]
    begun = bench.now
    for other in others:
        assert bench.served(other).error is None
    assert bench.now - begun < 1.0  # and not after the 5 s for which the sequence could have held the line


def test_r9_while_a_sequence_holds_the_line_only_its_own_requests_are_taken_out_of_turn() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    bench.served(bench.ask(table.node, WRITE, client=hold))
    backlog = table.arbiter.dispatcher.share()
    bench.ask(table.there, hcp2.Read(2))
    assert backlog.take(lambda one: True) is None
    own = bench.ask(table.node, hcp2.Read(3), client=hold)
    assert own.phase is Phase.ON_WIRE


def test_r7_a_sequence_that_waits_for_an_earlier_write_of_its_program_is_not_taken_out_of_turn() -> None:
    table = Table()
    bench, hold = table.bench, table.hold(longest=5.0)
    bench.ask(table.there)  # is on the wire, so that the others wait
    bench.ask(table.node, hcp2.Write(3, (7.0,)))
    behind = bench.ask(table.node, hcp2.Read(3), client=hold)
    backlog = table.arbiter.dispatcher.share()
    assert backlog.take(lambda one: one is behind) is None
    free = bench.ask(table.there, hcp2.Read(4))
    assert backlog.take(lambda one: one is free) is free


def test_r9_a_sequence_after_a_pause_begins_at_once_if_the_one_before_it_kept_nobody_waiting() -> None:
    table = Table()
    bench, second = table.bench, paused(table)
    bench.served(bench.ask(table.node, WRITE, client=second))
    bench.wait(LONGEST)
    assert second.over
    third = table.hold(second.client)
    bench.ask(table.node, WRITE, client=third)
    assert bench.until_sent() < 0.01


def test_r9_a_sequence_that_waited_for_another_begins_when_that_is_over_if_nobody_else_waited() -> None:
    table = Table()
    bench = table.bench
    first, second = (table.hold(table.arbiter.add_client(owner_time=1.0)) for _ in range(2))
    bench.served(bench.ask(table.node, WRITE, client=first))
    behind = bench.ask(table.node, WRITE, client=second)
    attempts = [behind.attempts]
    table.release(first)
    attempts.append(behind.attempts)
    assert attempts == [0, 1]


def test_r9_each_request_of_a_sequence_is_counted_once_when_it_begins() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    bench.ask(table.there)
    writes = [bench.ask(table.node, hcp2.Write(element, (5.0,)), client=hold) for element in (1, 2, 3)]
    for write in writes:
        bench.served(write)
    assert hold.holds
    assert table.arbiter.dispatcher.backlog.waiting(COMMAND) == 0


@pytest.mark.parametrize("requested", ["before the other begins", "while the other holds the line"])
def test_r7_requests_of_a_sequence_that_waits_while_another_begins_and_ends_keep_their_order(requested: str) -> None:
    table = Table()
    bench, second, own = table.bench, paused(table), table.hold()
    reads: list[Transaction] = []
    for moment in ("before the other begins", "while the other holds the line"):
        if requested == moment:
            reads = [bench.ask(table.node, hcp2.Read(element), client=second) for element in range(1, 6)]
        bench.served(bench.ask(table.node, WRITE, client=own))
    table.release(own)
    assert not any(read.attempts for read in reads)
    for read in reads:
        bench.served(read)
    assert sorted(reads, key=lambda read: read.started) == reads


def test_a_sequence_ends_though_its_timer_comes_late() -> None:
    table = Table()
    bench, hold = table.bench, table.hold()
    bench.served(bench.ask(table.node, WRITE, client=hold))
    other = bench.ask(table.there)
    bench.now += LONGEST + 0.3  # the process was suspended
    bench.arbiter.handle_timeout(bench.now)
    assert hold.over
    assert bench.served(other).error is None


def test_r9_an_urgent_request_during_a_sequence_delays_the_next_one_by_its_own_time_only() -> None:
    """The time of the sequence itself counts twice."""
    waited = []
    for takes in (0.004, 0.104):
        table = Table()
        bench, program = table.bench, table.arbiter.add_client(owner_time=1.0)
        first, second = table.hold(program), table.hold(table.arbiter.add_client(owner_time=1.0))
        write, began = bench.ask(table.node, WRITE, client=first), bench.now
        polled = bench.ask(table.there, hcp2.Read(20), priority=POLL)
        bench.served(write)
        bench.served(bench.ask(table.there, hcp2.Read(2), priority=URGENT, client=program), after=takes)
        bench.to(began + 0.4)
        table.release(first)
        begins = bench.ask(table.node, WRITE, client=second)
        bench.served(polled)
        bench.served(begins)
        waited.append(begins.started - began)
    assert waited[1] - waited[0] == pytest.approx(-0.1, abs=1e-6)
