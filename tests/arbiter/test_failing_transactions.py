"""What waited for a line that is lost, or closed, fails a few at a time; none of it is sent any more."""

from __future__ import annotations

from math import inf

from busmaster.arbiter.counters import LineState
from busmaster.arbiter.dispatcher import AT_ONCE
from busmaster.arbiter.events import Sampled
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.errors import BusClosed, LineDown
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import Bench

MANY = 3 * AT_ONCE


def waiting(bench: Bench) -> list[Transaction]:
    """Behind an exchange that is on the wire."""
    node = bench.node()
    bench.ask(node)
    return [bench.ask(node) for _ in range(MANY)]


def lose(bench: Bench) -> None:
    """The port is gone, and the owner has heard what failed at once."""
    bench.arbiter.line_down("unplugged", bench.now)
    bench.listen()


def told(bench: Bench) -> list[Transaction]:
    return [event for event in bench.events if isinstance(event, Transaction)]


def test_r13_a_lost_line_fails_a_bounded_number_in_one_call_and_the_others_in_the_next_ones_in_order() -> None:
    bench = Bench()
    asked = waiting(bench)
    lose(bench)
    counts = [len(told(bench))]
    while bench.arbiter.poll_timeout() <= bench.now:
        bench.arbiter.handle_timeout(bench.now)
        bench.listen()
        counts.append(len(told(bench)))
    assert counts == [1 + AT_ONCE, 1 + 2 * AT_ONCE, 1 + 3 * AT_ONCE]  # the first was on the wire
    assert told(bench)[1:] == asked
    assert all(isinstance(t.error, LineDown) and "unplugged" in str(t.error) for t in asked)
    assert len({id(t.error) for t in asked}) == MANY
    assert bench.arbiter.poll_timeout() == inf


def test_r13_what_waited_fails_although_the_line_is_back_and_is_never_sent() -> None:
    bench = Bench()
    asked = waiting(bench)
    write = bench.ask(asked[0].node, hcp2.Write(1, (5,)), priority=Priority.BACKGROUND)
    behind = bench.ask(write.node, hcp2.Write(1, (6,)), priority=Priority.BACKGROUND)
    lose(bench)
    bench.arbiter.line_up(bench.now)
    fresh = bench.ask(write.node, hcp2.Write(1, (7,)), priority=Priority.URGENT)
    assert asked[-1].phase is write.phase is behind.phase is Phase.FAILING
    bench.served(fresh)
    assert fresh.attempts == 1
    for transaction in (*asked, write, behind):
        assert (type(transaction.error), transaction.attempts, bench.ended(transaction)) == (LineDown, 0, 1)


def test_r6_a_caller_that_goes_before_its_request_has_failed_is_not_told() -> None:
    bench = Bench()
    asked = waiting(bench)
    lose(bench)
    bench.arbiter.cancel(asked[-1], bench.now)
    assert asked[-1].phase is Phase.ENDED
    bench.wait(0.0)
    assert asked[-1].error is None
    assert [bench.ended(t) for t in asked] == [1] * (MANY - 1) + [0]


def test_r12_a_request_whose_time_is_over_meanwhile_fails_with_the_line_all_the_same() -> None:
    bench = Bench()
    asked = waiting(bench)
    hasty = bench.ask(asked[0].node, start_by=bench.now + 0.001)
    lose(bench)
    bench.now += 0.002
    bench.wait(0.0)
    assert (type(hasty.error), bench.ended(hasty)) == (LineDown, 1)


def test_r8_a_bus_that_is_closed_meanwhile_tells_each_what_it_failed_of() -> None:
    bench = Bench()
    asked = waiting(bench)
    lose(bench)
    bench.arbiter.line_up(bench.now)
    fresh = bench.ask(asked[0].node)
    bench.arbiter.close(bench.now)
    failing = [bench.arbiter.failing]
    bench.wait(0.0)
    assert [*failing, bench.arbiter.failing] == [True, False]
    assert bench.arbiter.state is LineState.OFFLINE
    assert {type(t.error) for t in asked} == {LineDown}
    assert type(fresh.error) is BusClosed
    assert [bench.ended(t) for t in (*asked, fresh)] == [1] * (MANY + 1)


def test_r13_a_poll_of_many_fails_in_pieces_as_one_cycle() -> None:
    bench = Bench()
    poll = bench.poll(bench.node(), 1.0, *(number % 99 + 1 for number in range(MANY)))
    poll.group = object()
    bench.until_sent()
    bench.wait(0.0)
    lose(bench)
    assert (len(bench.cycles), poll.running) == (0, True)
    bench.wait(0.0)
    assert (len(bench.cycles), poll.running) == (1, False)
    assert sum(isinstance(event, Sampled) for event in bench.events) == MANY
    assert {type(t.error) for t in poll.results} == {LineDown}


def test_r13_what_is_asked_while_the_line_is_lost_fails_at_once_and_its_caller_is_told() -> None:
    bench = Bench()
    node = bench.node()
    lose(bench)
    read = Transaction(node, hcp2.Read(1))
    assert bench.arbiter.submit(read, bench.now), "something is to be reported"
    bench.listen()
    assert bench.events[-1] is read
    assert isinstance(read.error, LineDown)


def test_r13_a_line_is_failing_until_its_last_request_has_failed() -> None:
    bench = Bench()
    node = bench.node()
    for _ in range(1 + AT_ONCE + 1):  # the first is on the wire and fails at once
        bench.ask(node)
    lose(bench)
    assert bench.arbiter.failing
    bench.arbiter.handle_timeout(bench.now)
    assert not bench.arbiter.failing
