"""Requests that a rule delays: `eligibility` returns `Wait` for them.

The rule of these tests: no request to a node before a given time.
"""

from __future__ import annotations

from collections.abc import Callable
from math import inf

import pytest

from busmaster.arbiter import dispatcher
from busmaster.arbiter.backlog import SLACK, Delayed
from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.deadlines import Deadlines
from busmaster.arbiter.eligibility import OK, Wait, eligibility
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.errors import BacklogFull, HoldEnded, LineDown, NotStarted
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import Bench, request_of, up

LATER = 0.5
URGENT, COMMAND, POLL, BACKGROUND = Priority


class Table:
    """A line with two nodes that are up. Nothing is sent to the first for LATER seconds."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **of_bench: int) -> None:
        self.bench = bench = Bench(**of_bench)  # type: ignore[arg-type]
        self.slow, self.other = up(bench), up(bench, 2)
        self.until = bench.now + LATER
        self.asked = 0

        def delayed(transaction: Transaction, now: float, *rest: object) -> object:
            verdict = eligibility(transaction, now, *rest)  # type: ignore[arg-type]
            self.asked += 1
            late = transaction.node is self.slow and now < self.until
            return Wait(self.until) if verdict is OK and late else verdict

        monkeypatch.setattr(dispatcher, "eligibility", delayed)

    def then_sent(self) -> str:
        """Return the next request, and have it answered."""
        self.bench.until_sent()
        return self.bench.answer()


@pytest.fixture
def table(monkeypatch: pytest.MonkeyPatch) -> Table:
    return Table(monkeypatch)


@pytest.mark.parametrize("priority", [COMMAND, POLL, BACKGROUND])
def test_a_delayed_request_is_sent_at_its_time_and_others_go_first(table: Table, priority: Priority) -> None:
    bench = table.bench
    delayed = bench.ask(table.slow, priority=priority)
    assert bench.sent() == ""
    bench.ask(table.other, priority=BACKGROUND)
    assert table.then_sent() == request_of(1, 2)
    bench.to(table.until - 0.001)
    assert bench.sent() == ""
    bench.to(table.until)
    assert table.then_sent() == request_of(1)
    assert bench.ended(delayed) == 1
    assert delayed.error is None


def test_a_delayed_request_is_sent_by_a_timer_that_comes_late(table: Table) -> None:
    bench = table.bench
    delayed = bench.ask(table.slow)
    bench.now = table.until + 0.01
    bench.arbiter.handle_timeout(bench.now)
    assert bench.answer() == request_of(1)
    assert bench.ended(delayed) == 1


def test_a_delayed_request_is_not_asked_about_again_before_its_time(table: Table) -> None:
    bench = table.bench
    bench.ask(table.slow)
    asked = table.asked
    for _ in range(20):
        bench.served(bench.ask(table.other))
    assert table.asked == asked + 20
    assert bench.arbiter.poll_timeout() == table.until


def test_delayed_requests_keep_their_order_and_go_before_later_ones(table: Table) -> None:
    bench = table.bench
    for element in (3, 4, 5):
        bench.ask(table.slow, hcp2.Read(element))
    bench.ask(table.other, hcp2.Read(9))
    bench.to(table.until)  # the exchange with the other node is over, unanswered
    bench.ask(table.other, hcp2.Read(10))
    requests = [table.then_sent() for _ in range(5)]
    in_order = [request_of(element) for element in (3, 4, 5)]
    assert [request for request in requests if request in in_order] == in_order


def test_r7_a_later_write_does_not_overtake_a_delayed_one(table: Table) -> None:
    bench = table.bench
    first = bench.ask(table.slow, hcp2.Write(1, (1,)), priority=BACKGROUND)
    bench.wait(0.1)
    second = bench.ask(table.slow, hcp2.Write(1, (2,)))
    assert first.priority is COMMAND, "the later write would wait for a turn of the lower class"
    bench.served(second)
    assert bench.ended(first) == 1
    assert first.last_byte <= second.started


def test_r7_the_end_of_another_programs_write_does_not_send_a_delayed_one_early(table: Table) -> None:
    bench = table.bench
    delayed = bench.ask(table.slow, hcp2.Write(1, (1,)))
    other = bench.ask(table.slow, hcp2.Write(1, (2,)), client=LineClient())
    bench.arbiter.cancel(other, bench.now)
    bench.to(table.until - 0.001)
    assert bench.sent() == ""
    bench.served(delayed)
    assert bench.ended(delayed) == 1


def test_r6_a_delayed_request_whose_caller_has_gone_is_not_sent(table: Table) -> None:
    bench = table.bench
    delayed = [bench.ask(table.slow), bench.ask(table.slow, hcp2.Write(1, (1,)))]
    for transaction in delayed:
        bench.arbiter.cancel(transaction, bench.now)
        assert transaction.phase is Phase.ENDED
    bench.to(table.until + 0.1)
    assert bench.sent() == ""
    assert bench.arbiter.poll_timeout() == inf


def test_r12_a_delayed_request_whose_time_has_passed_is_not_started(table: Table) -> None:
    bench = table.bench
    delayed = bench.ask(table.slow, start_by=bench.now + 0.1)
    bench.wait(0.11)
    assert isinstance(delayed.error, NotStarted)
    bench.to(table.until + 0.1)
    assert bench.sent() == ""


def test_r13_delayed_requests_fail_once_when_the_line_goes_down(table: Table) -> None:
    bench = table.bench
    delayed = [bench.ask(table.slow), bench.ask(table.slow, hcp2.Write(1, (1,)))]
    bench.arbiter.line_down("unplugged", bench.now)
    bench.listen()
    bench.wait(0.1)
    assert [bench.ended(transaction) for transaction in delayed] == [1, 1]
    assert all(isinstance(transaction.error, LineDown) for transaction in delayed)
    bench.arbiter.line_up(bench.now)
    bench.to(table.until + 1.0)
    assert bench.sent() == ""


def test_r12_delayed_requests_count_against_the_limit_of_their_client(monkeypatch: pytest.MonkeyPatch) -> None:
    table = Table(monkeypatch, capacity=3)
    bench, client = table.bench, LineClient()
    bench.arbiter.dispatcher.share()
    waiting = [bench.ask(table.slow, client=client) for _ in range(3)]
    one_more = bench.ask(table.slow, client=client)
    assert isinstance(one_more.error, BacklogFull)
    assert "3 requests are waiting" in str(one_more.error)
    assert bench.ask(table.slow).error is None, "another client has its own limit"
    assert bench.ask(table.slow, priority=POLL, client=client).error is None, "each class has its own limit"
    urgent = [bench.ask(table.slow, priority=URGENT, client=client) for _ in range(4)]
    assert [type(each.error) for each in urgent] == [type(None)] * 3 + [BacklogFull]
    bench.served(waiting[0])


def test_delayed_requests_of_a_sequence_fail_when_it_ends(table: Table) -> None:
    bench = table.bench
    hold = bench.arbiter.exclusive(table.slow, None, 5.0)
    asked = [bench.ask(table.slow, command, client=hold) for command in (hcp2.Read(1), hcp2.Write(1, (1,)))]
    bench.arbiter.release(hold, bench.now)
    bench.listen()
    assert [bench.ended(transaction) for transaction in asked] == [1, 1]
    assert all(isinstance(transaction.error, HoldEnded) for transaction in asked)
    bench.to(table.until + 0.1)
    assert bench.sent() == ""


def test_an_equal_stop_that_is_delayed_is_not_sent_a_second_time(table: Table) -> None:
    bench = table.bench
    stops = [bench.ask(table.slow, hcp2.Write(1, (0,)), stop=True, client=c) for c in (LineClient(), LineClient())]
    bench.served(stops[0])
    bench.wait(0.1)
    assert [bench.ended(stop) for stop in stops] == [1, 1]
    assert bench.sent() == ""


def test_the_places_of_ended_requests_are_released() -> None:
    deadlines = Deadlines()
    delayed, node = Delayed(deadlines), Bench().node()

    def add(node: NodeRecord, until: float, end: Callable[[Transaction], None] = lambda _: None) -> Transaction:
        transaction = Transaction(node, hcp2.Read(1))
        delayed.add(transaction, until)
        end(transaction)
        return transaction

    kept = add(node, 1.0)
    for _ in range(1000):
        add(node, 2.0, lambda transaction: setattr(transaction, "phase", Phase.ENDED))
    assert delayed.live < 100
    assert deadlines.delayed == 1.0
    assert delayed.due(0.9) == []
    assert delayed.due(1.0) == [kept]
    assert delayed.due(2.0) == []
    assert (delayed.live, deadlines.delayed) == (0, inf)


@pytest.mark.parametrize("kept", [1, 300])
def test_ended_delayed_requests_are_removed_however_many_others_wait(kept: int) -> None:
    delayed, node = Delayed(Deadlines()), Bench().node()
    for number in range(kept + 1000):
        transaction = Transaction(node, hcp2.Read(1))
        delayed.add(transaction, 1.0)
        if number >= kept:
            transaction.phase = Phase.ENDED
    assert delayed.live <= 2 * kept + SLACK


def test_nothing_is_kept_of_a_delayed_request_that_was_sent() -> None:
    delayed, node = Delayed(Deadlines()), Bench().node()
    for number in range(3):
        delayed.add(Transaction(node, hcp2.Read(1)), 10.0 + number)
    assert len(delayed.due(11.0)) == 2
    assert len(delayed._places) == delayed.live == 1


def test_many_delayed_requests_are_not_sorted_anew_for_each(monkeypatch: pytest.MonkeyPatch) -> None:
    delayed, node = Delayed(Deadlines()), Bench().node()
    rebuilt: list[int] = []
    keep = Delayed._keep

    def counted(self: Delayed, entries: list[tuple[float, int, Transaction]]) -> None:
        rebuilt.append(len(entries))
        keep(self, entries)

    monkeypatch.setattr(Delayed, "_keep", counted)
    for number in range(1000):
        delayed.add(Transaction(node, hcp2.Read(1)), float(number))
    assert len(rebuilt) <= 5
    assert delayed.live == 1000


def test_r8_a_delayed_write_that_is_woken_early_is_sent_once(table: Table) -> None:
    bench = table.bench
    first, second = (bench.ask(table.slow, hcp2.Write(1, (value,))) for value in (1, 2))
    bench.arbiter.cancel(second, bench.now)  # its end wakes the first, which is delayed again
    bench.served(bench.ask(table.other))
    bench.to(table.until)
    bench.served(first)
    bench.served(bench.ask(table.other))
    assert bench.ended(first) == 1
    assert len(bench.arbiter.dispatcher.backlog) == 0


def test_r8_a_delayed_write_of_a_sequence_that_is_woken_early_ends_once(table: Table) -> None:
    bench = table.bench
    hold = bench.arbiter.exclusive(table.slow, None, 5.0)
    first, second = (bench.ask(table.slow, hcp2.Write(1, (value,)), client=hold) for value in (1, 2))
    bench.arbiter.cancel(second, bench.now)
    bench.served(bench.ask(table.other))
    bench.arbiter.release(hold, bench.now)
    bench.listen()
    assert bench.ended(first) == 1
    assert isinstance(first.error, HoldEnded)


def test_a_request_that_is_delayed_again_for_a_shorter_time_is_returned_once() -> None:
    """The end of another write may release it and delay it anew: its first entry is still there when it has gone."""
    delayed = Delayed(Deadlines())
    transaction = Transaction(Bench().node(), hcp2.Read(1))
    delayed.add(transaction, 5.0)
    delayed.add(transaction, 3.0)
    assert delayed.due(4.0) == [transaction]
    assert delayed.due(6.0) == []
