"""Equal stops that wait are sent once, and each caller gets the outcome (R7, R9)."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.errors import Superseded, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.wire.readers import ENQ
from tests.arbiter.bench import Bench, up


class Table:
    """A node, and requests that wait behind a read that is on the wire."""

    def __init__(self) -> None:
        self.bench = Bench()
        self.node = up(self.bench)
        self.read = self.bench.ask(self.node, hcp2.Read(9))
        self.bench.until_sent()
        self.requests: list[str] = []

    def client(self) -> LineClient:
        return self.bench.arbiter.add_client(1.0, 1.0)

    def write(self, value: float = 0.0, element: int = 2, stop: bool = True, **how: Any) -> Transaction:
        how.setdefault("client", self.client())
        how.setdefault("priority", Priority.URGENT)
        return self.bench.submit(Transaction(self.node, hcp2.Write(element, (value,)), stop=stop, retries=0, **how))

    def run(self, *until: Transaction, answer: bool = True) -> int:
        """Answer what is sent until all of these have ended. Returns how many writes were sent."""
        self.bench.answer()
        writes = 0
        while any(each.phase is not Phase.ENDED for each in until):
            self.bench.until_sent()
            asked = self.bench.sent()
            writes += bytes.fromhex(asked)[-2] != 5
            self.bench.asked = asked
            if answer:
                self.bench.hear("06", after=0.004)
            else:
                self.bench.wait(0.3)
        return writes


def test_r9_equal_stops_of_many_clients_are_sent_once_and_each_gets_the_outcome() -> None:
    table = Table()
    stops = [table.write() for _ in range(64)]
    assert table.run(*stops) == 1
    assert [(stop.error, stop.attempts, table.bench.ended(stop)) for stop in stops] == [(None, 1, 1)] * 64


def test_r9_equal_stops_are_sent_once_though_one_of_a_sequence_is_between_them() -> None:
    table = Table()
    client = table.client()
    hold = table.bench.arbiter.exclusive(table.node, table.client(), 1.0)
    first, _, second = stops = [table.write(client=each) for each in (client, hold, client)]
    assert table.run(*stops) == 2
    assert first.started == second.started


def test_r9_equal_stops_of_one_client_are_sent_once() -> None:
    table = Table()
    client = table.client()
    assert table.run(*(table.write(client=client) for _ in range(5))) == 1


def test_r7_a_stop_that_is_not_answered_is_unconfirmed_for_each_caller() -> None:
    table = Table()
    stops = [table.write() for _ in range(3)]
    assert table.run(*stops, answer=False) == 1
    assert [type(stop.error) for stop in stops] == [WriteUnconfirmed] * 3
    assert len({id(stop.error) for stop in stops}) == 3


@pytest.mark.parametrize("other", [{"value": 1.0}, {"element": 3}, {"stop": False}])
def test_r7_only_equal_stops_are_sent_once(other: dict[str, Any]) -> None:
    table = Table()
    assert table.run(table.write(), table.write(**other)) == 2


def test_r7_a_stop_behind_an_urgent_write_is_sent_again() -> None:
    table = Table()
    writes = table.write(), table.write(5.0, stop=False), table.write()
    assert table.run(*writes) == 3
    assert writes[2].started > writes[1].started


def test_r7_a_stop_that_comes_while_an_equal_one_is_on_the_wire_is_sent_itself() -> None:
    table = Table()
    first = table.write()
    table.bench.answer()
    table.bench.until_sent()
    second = table.write()
    assert first.phase is Phase.ON_WIRE
    table.bench.answer()
    assert second.phase is not Phase.ENDED
    table.bench.served(second)
    assert second.started > first.started


def test_r6_a_cancelled_caller_hears_nothing_and_the_others_get_the_outcome() -> None:
    table = Table()
    stops = [table.write() for _ in range(3)]
    table.bench.answer()
    table.bench.until_sent()
    for stop in stops[:2]:  # the one on the wire, and one that waits for its outcome
        table.bench.arbiter.cancel(stop, table.bench.now)
    table.bench.answer()
    assert [table.bench.ended(stop) for stop in stops] == [0, 0, 1]
    assert stops[2].error is None
    assert all(stop.phase is Phase.ENDED for stop in stops)


def test_r7_stops_are_sent_themselves_if_the_one_that_was_sent_is_cancelled_before_it_is_repeated() -> None:
    table = Table()
    first = table.bench.submit(
        Transaction(
            table.node, hcp2.Write(2, (0.0,)), Priority.URGENT, idempotent=True, retries=1, stop=True,
            client=table.client(),
        )
    )  # fmt: skip
    second = table.write()
    table.bench.answer()
    table.bench.until_sent()
    table.bench.sent()
    while first.phase is not Phase.QUEUED:
        table.bench.to(table.bench.arbiter.poll_timeout())
    table.bench.arbiter.cancel(first, table.bench.now)
    assert second.phase is Phase.QUEUED
    table.bench.served(second)
    assert second.error is None


def test_r7_a_stop_that_is_refused_on_its_own_is_unconfirmed_because_the_shared_one_may_have_acted() -> None:
    bench = Bench()
    node = up(bench)
    how = {"priority": Priority.URGENT, "stop": True, "idempotent": True}
    bench.ask(node, hcp2.Read(9))
    bench.until_sent()
    first, second = (bench.ask(node, hcp2.Write(2, (0.0,)), client=bench.arbiter.add_client(), **how) for _ in "12")
    bench.answer()
    bench.until_sent()
    bench.sent()
    while first.phase is not Phase.QUEUED:
        bench.to(bench.arbiter.poll_timeout())
    bench.arbiter.cancel(first, bench.now)
    while not bench.ended(second):
        bench.until_sent()
        if bytes.fromhex(bench.sent())[-2] == ENQ[0]:
            bench.answer()
        else:
            bench.hear("15", after=0.004)
    assert second.attempts > 1
    assert isinstance(second.error, WriteUnconfirmed)


def test_r9_an_equal_stop_that_was_sent_itself_ends_with_its_own_outcome() -> None:
    bench = Bench()
    node = up(bench)

    def stop(client: LineClient | None) -> Transaction:
        return bench.ask(
            node, hcp2.Write(1, (0.0,)), priority=Priority.URGENT, stop=True, client=client, idempotent=True, retries=1
        )

    first = stop(bench.arbiter.add_client())
    bench.sent()
    while first.phase is not Phase.QUEUED:
        bench.wait(0.01)
    second = stop(None)  # the owner's, which goes first
    for each in (second, first):
        bench.served(each)
    assert second.started < first.started
    assert (first.attempts, second.attempts) == (2, 1)


def test_stops_to_a_node_are_counted_so_that_a_write_prepared_before_one_is_not_sent() -> None:
    bench = Bench()
    node, other = bench.node(), bench.node(2)
    for count in (1, 2):
        bench.arbiter.note_stop(node)
        assert (node.stops, other.stops) == (count, 0)


def test_r7_all_queued_writes_of_a_line_can_be_superseded() -> None:
    bench = Bench()
    nodes = [up(bench, address) for address in (1, 2)]
    on_wire = bench.ask(nodes[0])
    writes = [
        bench.ask(node, hcp2.Write(1, (5.0,)), priority=priority)
        for node in nodes
        for priority in (Priority.COMMAND, Priority.BACKGROUND)
    ]
    read = bench.ask(nodes[1])
    bench.arbiter.dispatcher.supersede_writes(bench.now)
    bench.listen()
    assert [type(write.error) for write in writes] == [Superseded] * 4
    for transaction in (on_wire, read):
        assert bench.served(transaction).error is None
