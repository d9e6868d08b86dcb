"""Programs that share a line take turns within a class (R9), have room of their own (R12), and their own order (R7)."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

import hypothesis.strategies as st
import pytest
from hypothesis import given, settings

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.backlog import Fifo
from busmaster.arbiter.clients import Hold, LineClient
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.shared_backlog import PASSED_BY_EACH, URGENT_RUN, SequenceRule, Turns
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.errors import BacklogFull, Superseded
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import Bench, up

NODE = NodeRecord(hcp2.PROFILE, 1, hcp2.PROFILE.timings, 2)
READ = hcp2.Read(1)
URGENT, COMMAND, POLL, BACKGROUND = Priority
Who = LineClient | None
FLOOD = 10_000


class Desk:
    """The backlog of a shared line, and a clock: each exchange takes as long as its client's do."""

    def __init__(self) -> None:
        self.arbiter = Arbiter(0.001)
        self.backlog = self.arbiter.dispatcher.share()
        self.now = 0.0
        self.takes: dict[Who, float] = {}
        self.served: list[Who] = []

    def client(self, share: float = 1.0, takes: float = 0.01) -> LineClient:
        client = self.arbiter.add_client(share)
        self.takes[client] = takes
        return client

    def ask(self, client: Who, count: int = 1, priority: Priority = COMMAND) -> None:
        for _ in range(count):
            transaction = Transaction(NODE, READ, priority, client=client)
            transaction.queued, transaction.deadline = self.now, self.now + 1.0
            self.backlog.push(transaction)

    def serve(self, count: int = 1) -> list[Who]:
        """So many exchanges. Returns whose."""
        begun = len(self.served)
        for _ in range(count):
            transaction = self.backlog.pop(self.now)
            if transaction is not None:
                transaction.phase = Phase.ENDED
                transaction.attempts += 1
                self.now += self.takes.get(transaction.client, 0.01)
                self.served.append(transaction.client)
        return self.served[begun:]


@pytest.mark.parametrize("priority", Priority)
def test_r9_a_program_with_ten_thousand_requests_delays_anothers_by_one_exchange_beside_that_on_the_wire(
    priority: Priority,
) -> None:
    desk = Desk()
    flood, other = desk.client(), desk.client()
    desk.ask(flood, FLOOD, priority)
    desk.serve(5)
    for _ in range(200):  # it asks while one of the flood's is on the wire
        desk.ask(other, 1, priority)
        waited = desk.serve(2)
        assert other in waited
        assert other not in desk.serve(1)


def test_r9_the_owner_takes_turns_with_the_programs() -> None:
    desk = Desk()
    flood = desk.client()
    desk.ask(flood, FLOOD)
    desk.ask(None, 50)
    assert Counter(desk.serve(100)) == {flood: 50, None: 50}


def test_r9_who_comes_has_saved_nothing_up() -> None:
    desk = Desk()
    first, second = desk.client(), desk.client()
    desk.ask(first, FLOOD)
    desk.serve(1000)
    desk.ask(second, FLOOD)
    assert abs(Counter(desk.serve(100))[second] - 50) <= 1


def test_r9_who_comes_and_asks_for_one_thing_after_the_other_has_saved_nothing_up_either() -> None:
    desk = Desk()
    first, second = desk.client(), desk.client()
    desk.ask(first, FLOOD)
    desk.serve(1000)
    for _ in range(100):
        if not desk.backlog.waiting_of(COMMAND, second):
            desk.ask(second)
        desk.serve(1)
    assert abs(Counter(desk.served[-100:])[second] - 50) <= 1


def test_r9_what_a_program_had_while_nobody_waited_is_not_held_against_it() -> None:
    desk = Desk()
    first, second = desk.client(takes=1.0), desk.client()
    desk.ask(first, 10)
    assert len(desk.serve(11)) == 10
    desk.ask(second, 100)
    desk.ask(first)
    assert first in desk.serve(2)


def test_r9_whose_exchanges_take_longer_lets_the_others_go_before_as_often_as_they_may() -> None:
    desk = Desk()
    slow, quick = desk.client(takes=0.1), desk.client(takes=0.01)
    desk.ask(slow, FLOOD)
    desk.ask(quick, FLOOD)
    served = Counter(desk.serve(300))
    assert served[quick] == PASSED_BY_EACH * served[slow]


def test_r9_line_time_is_shared_evenly_where_one_takes_half_as_long_again() -> None:
    desk = Desk()
    slow, quick = desk.client(takes=0.015), desk.client(takes=0.010)
    desk.ask(slow, FLOOD)
    desk.ask(quick, FLOOD)
    served = Counter(desk.serve(500))
    assert served[quick] * 0.010 == pytest.approx(served[slow] * 0.015, rel=0.02)


def test_r9_line_time_is_shared_evenly_by_those_who_ask_for_more_when_something_is_done() -> None:
    desk = Desk()
    slow, quick = desk.client(takes=0.015), desk.client(takes=0.010)
    for client in (slow, quick):
        desk.ask(client, 2)
    for _ in range(500):
        [served] = desk.serve()
        desk.ask(served)
    counted = Counter(desk.served)
    assert counted[quick] * 0.010 == pytest.approx(counted[slow] * 0.015, rel=0.02)


@pytest.mark.parametrize("share", [0.1, 0.5, 2.0])
def test_r9_a_share_weighs_the_line_time_of_a_program(share: float) -> None:
    desk = Desk()
    weighed = desk.client(share)
    desk.ask(weighed, FLOOD)
    desk.ask(None, FLOOD)
    served = Counter(desk.serve(1100))
    assert served[weighed] / served[None] == pytest.approx(share, rel=0.05)


@given(
    st.lists(st.tuples(st.sampled_from([0.001, 0.01, 0.1]), st.booleans()), min_size=2, max_size=6),
    st.integers(20, 200),
)
@settings(max_examples=60)
def test_r9_nobody_is_passed_over_more_than_twice_by_each_of_the_others(
    clients: list[tuple[float, bool]], count: int
) -> None:
    """Whatever their exchanges take, and whether they have many waiting or ask the next when one is done."""
    desk = Desk()
    programs = {desk.client(takes=takes): flood for takes, flood in clients}
    for program, flood in programs.items():
        desk.ask(program, count if flood else 1)
    waits = dict.fromkeys(programs, 0)
    for _ in range(count):
        waiting = [program for program in programs if desk.backlog.waiting_of(COMMAND, program)]
        [served] = desk.serve()
        assert served is not None
        for program in waiting:
            waits[program] = 0 if program is served else waits[program] + 1
        assert max(waits.values()) <= PASSED_BY_EACH * (len(programs) - 1)
        if not programs[served]:
            desk.ask(served)


def test_r9_a_program_with_one_long_exchange_is_passed_over_twice_by_another() -> None:
    desk = Desk()
    long, short = desk.client(takes=1.0), desk.client()
    desk.ask(long, 10)
    desk.ask(short, 100)
    assert desk.serve(7) == [long, short, short, long, short, short, long], "as docs/promises.md says"


def test_r9_a_program_cannot_starve_the_others_by_urgent_requests() -> None:
    desk = Desk()
    flood, other = desk.client(), desk.client()
    desk.ask(flood, FLOOD, URGENT)
    desk.ask(other, 10)
    served = desk.serve(10 * (URGENT_RUN + 1))
    assert served.count(other) == 10
    assert served.index(other) == URGENT_RUN == 16, "as docs/promises.md says"


def test_r9_urgent_requests_that_come_one_by_one_yield_as_well() -> None:
    desk = Desk()
    one, other = desk.client(), desk.client()
    desk.ask(other, 10)
    served = []
    for _ in range(2 * (URGENT_RUN + 1)):
        desk.ask(one, 1 - desk.backlog.waiting(URGENT), URGENT)
        served += desk.serve(1)
    assert served == [*[one] * URGENT_RUN, other] * 2


def test_r9_the_owners_urgent_requests_yield_to_nobody() -> None:
    desk = Desk()
    flood, other = desk.client(), desk.client()
    desk.ask(None, 100, URGENT)
    desk.ask(other, 10)
    assert set(desk.serve(100)) == {None}
    desk.ask(flood, 100, URGENT)
    desk.serve(URGENT_RUN)
    desk.ask(None, 1, URGENT)
    assert None in desk.serve(2), "not held back by what another program may not do any more"


def test_r9_urgent_requests_of_another_go_before_those_of_a_flood() -> None:
    desk = Desk()
    flood, other = desk.client(), desk.client()
    desk.ask(flood, FLOOD, URGENT)
    desk.serve(100)
    desk.ask(other, 1, URGENT)
    assert other in desk.serve(1)


def test_what_suits_is_picked_from_whom_had_the_least_and_else_from_another() -> None:
    desk = Desk()
    first, second = desk.client(), desk.client()
    desk.ask(first, 3)
    desk.ask(second, 3)
    assert desk.serve(1) == [first]
    picked = [
        desk.backlog.pick(COMMAND, suits) for suits in (lambda _: True, lambda t: t.client is first, lambda _: False)
    ]
    assert [None if one is None else one.client for one in picked] == [second, first, None]
    assert desk.backlog.waiting(COMMAND) == 3


def test_what_is_given_back_is_the_next_to_go_whoever_waits() -> None:
    desk = Desk()
    first, second = desk.client(), desk.client()
    desk.ask(first, 5)
    desk.ask(second, 5)
    taken = desk.backlog.pop(0.0)
    assert taken is not None
    desk.backlog.restore(taken)
    assert desk.backlog.pop(0.0) is taken


def test_programs_that_come_and_go_leave_nothing() -> None:
    desk = Desk()
    desk.ask(desk.client(), FLOOD)
    for _ in range(500):
        guest = desk.client()
        desk.ask(guest)
        while guest not in desk.serve(1):
            pass
        desk.arbiter.remove_client(guest)
        desk.serve(1)
    assert all(len(turns._turns) <= 2 for turns in desk.backlog._turns)


# on a line


def test_r12_a_program_has_room_of_its_own() -> None:
    bench = Bench(capacity=10)
    record = up(bench)
    flood, other = bench.arbiter.add_client(), bench.arbiter.add_client()
    taken = [bench.ask(record, client=flood) for _ in range(20)]
    assert sum(isinstance(asked.error, BacklogFull) for asked in taken) == 9, "one is on the wire, ten wait"
    assert bench.ask(record, client=other).error is None
    assert bench.ask(record).error is None
    written = [bench.ask(record, hcp2.Write(1, (5.0,)), client=other) for _ in range(20)]
    assert any(isinstance(write.error, BacklogFull) for write in written)
    assert bench.ask(record, hcp2.Write(1, (5.0,))).error is None


def test_r7_a_programs_write_does_not_wait_for_anothers_to_the_same_node() -> None:
    bench = Bench()
    record = up(bench)
    flood, other = bench.arbiter.add_client(), bench.arbiter.add_client()
    many = [bench.ask(record, hcp2.Write(1, (float(n),)), client=flood) for n in range(50)]
    one = bench.ask(record, hcp2.Write(2, (5.0,)), client=other)
    bench.served(one)
    assert sum(write.phase is Phase.ENDED for write in many) <= 2


def test_r7_the_writes_of_each_program_to_a_node_keep_their_order() -> None:
    bench = Bench()
    record = up(bench)
    clients = [None, bench.arbiter.add_client(), bench.arbiter.add_client()]
    writes = [
        bench.ask(record, hcp2.Write(1, (float(n),)), client=clients[n % 3], idempotent=True, retries=3)
        for n in range(30)
    ]
    answered = 0
    while not all(bench.ended(write) for write in writes):
        bench.until_sent()
        answered += 1
        if answered % 4:
            bench.answer()
        else:
            bench.sent()  # lost
            bench.wait(0.3)
    for client in clients:
        started = [write.started for write in writes if write.client is client]
        assert started == sorted(started)


def test_r7_an_urgent_write_of_one_program_supersedes_those_of_all() -> None:
    bench = Bench()
    record = up(bench)
    clients: list[Who] = [None, bench.arbiter.add_client(), bench.arbiter.add_client()]
    bench.ask(record, client=clients[1])
    writes = [bench.ask(record, hcp2.Write(1, (5.0,)), client=client) for client in clients]
    stop = bench.ask(record, hcp2.Write(2, (0.0,)), priority=URGENT, client=clients[2])
    assert all(isinstance(write.error, Superseded) for write in writes)
    bench.served(stop)
    assert stop.error is None


def each_asks(bench: Bench, ask: Callable[[LineClient], Transaction], count: int) -> list[Transaction]:
    return [ask(bench.arbiter.add_client()) for _ in range(count)]


def test_r8_whatever_waits_of_all_programs_ends_when_the_line_is_lost() -> None:
    bench = Bench()
    record = up(bench)
    asked = each_asks(bench, lambda client: bench.ask(record, client=client), 5)
    asked += each_asks(bench, lambda client: bench.ask(record, hcp2.Write(1, (5.0,)), client=client), 5)
    bench.arbiter.line_down("pulled out", bench.now)
    bench.listen()
    assert all(bench.ended(transaction) == 1 for transaction in asked)
    assert len(bench.arbiter.dispatcher.backlog) == 0


@pytest.mark.parametrize("why", ["too late", "behind its own write"])
def test_r9_a_turn_in_which_nothing_is_sent_is_no_turn(why: str) -> None:
    """Else a program whose requests all wait for something loses one turn with each, and is passed over for long."""
    arbiter = Arbiter(0.001)
    dispatcher = arbiter.dispatcher
    dispatcher.fault = None
    one, other = arbiter.add_client(), arbiter.add_client()
    node = arbiter.add_node(hcp2.PROFILE, 1, 0.0)

    def ask(client: LineClient, command: hcp2.Read | hcp2.Write, start_by: float = 100.0) -> Transaction:
        transaction = Transaction(node, command, COMMAND, client=client, start_by=start_by)
        dispatcher.submit(transaction, 0.0)
        return transaction

    if why == "too late":
        held = [ask(one, READ, start_by=0.5) for _ in range(10)]
    else:
        first = ask(one, hcp2.Write(1, (1,)))
        assert dispatcher.next(0.0) is first
        dispatcher.started(first, 0.0)
        held = [ask(one, hcp2.Write(1, (n,))) for n in range(10)]
    good = ask(one, READ)
    for _ in range(20):
        ask(other, READ)
    passed = 0
    while (transaction := dispatcher.next(1.0)) is not good:
        assert transaction is not None
        assert transaction.client is other
        passed += 1
        transaction.phase = Phase.ENDED
    assert passed <= PASSED_BY_EACH
    assert {transaction.phase for transaction in held} <= {Phase.ENDED, Phase.PARKED}


def test_r9_a_read_that_is_taken_to_prove_something_counts_for_its_program() -> None:
    desk = Desk()
    one, other = desk.client(), desk.client()
    desk.ask(one, 3)
    desk.ask(other, 3)
    taken = desk.backlog.take(lambda transaction: transaction.client is other)
    assert taken is not None
    taken.phase = Phase.ENDED
    desk.now += 0.1
    assert desk.serve(2) == [one, one]


def test_r9_a_picked_read_counts_for_its_program_also_within_a_sequence() -> None:
    desk = Desk()
    one, other = desk.client(), desk.client()
    desk.ask(one, 3)
    desk.ask(other, 3)
    hold = Hold(NODE, other, 1.0)
    desk.backlog._hold_for(hold, COMMAND)
    desk.ask(hold)
    picked = desk.backlog.pick(COMMAND, lambda _: True)
    assert picked is not None
    picked.phase = Phase.ENDED
    desk.now += 0.1
    desk.backlog.end_hold(hold, desk.now)
    assert desk.serve(2) == [one, one]


def queued(client: LineClient) -> Transaction:
    transaction = Transaction(NODE, READ, COMMAND, client=client)
    transaction.phase = Phase.QUEUED
    return transaction


def test_r9_a_client_that_goes_takes_no_turn_of_another_with_it() -> None:
    turns = Turns(Fifo(), Fifo)
    first, second, gone = LineClient(), LineClient(), LineClient()
    for client in (first, first, second):
        turns.push(queued(client))
    popped = turns.pop()
    turns.charge(first, 1.0)
    turns.give_back(popped)
    turns.forget(gone)
    assert turns.pop() is popped
    turns.charge(first, 1.0)
    turns.give_back(popped)
    turns.forget(second)
    assert turns.pop() is popped


def test_r9_a_request_that_was_set_aside_waits_for_two_of_each_other_at_most() -> None:
    turns = Turns(Fifo(), Fifo)
    other, waits = LineClient(), LineClient()
    turns.admit_sequences(SequenceRule(True, None))
    turns.push(queued(Hold(NODE, waits, 1.0)))
    turns.admit_sequences(None)
    turns.charge(waits, 10.0)
    for _ in range(5):
        turns.push(queued(other))
    served = [turns.pop().client for _ in range(PASSED_BY_EACH + 1)]
    assert served[:-1] == [other] * PASSED_BY_EACH
    assert served[-1] is not other


@pytest.mark.parametrize("push", [Turns.push, Turns.push_front])
def test_r9_no_request_of_a_sequence_that_may_not_begin_is_popped(push: Callable[[Turns, Transaction], None]) -> None:
    turns = Turns(Fifo(), Fifo)
    turns.admit_sequences(SequenceRule(True, None))
    waits, passes = queued(Hold(NODE, LineClient(), 1.0)), queued(LineClient())
    push(turns, waits)
    push(turns, passes)
    assert turns.pop() is passes
    assert turns.live == 0
    turns.admit_sequences(None)
    assert turns.pop() is waits


def test_r9_requests_of_a_sequence_that_may_not_begin_keep_their_order() -> None:
    turns = Turns(Fifo(), Fifo)
    turns.admit_sequences(SequenceRule(True, None))
    first, second, third = (queued(Hold(NODE, LineClient(), 1.0)) for _ in range(3))
    turns.push(second)
    turns.push(third)
    turns.push_front(first)
    assert turns.aside == [first, second, third]


def test_r9_the_time_after_a_sequence_is_not_charged_to_its_program() -> None:
    desk = Desk()
    one, other = desk.client(), desk.client()
    hold = Hold(NODE, one, 1.0)
    desk.backlog._hold_for(hold, COMMAND)
    assert desk.backlog.pop(desk.now) is None
    desk.ask(one, 3)
    desk.ask(other, 3)
    desk.backlog.end_hold(hold, desk.now)
    desk.now += 10.0
    assert desk.serve(2) == [one, other]
