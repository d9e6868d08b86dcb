"""The owner of a shared line keeps its part of the line, whatever its clients ask (R9)."""

from __future__ import annotations

from collections import Counter

import pytest

from busmaster.app.service.rights import READ, RIGHTS, WRITE
from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.shared_backlog import MOST_LEFT
from busmaster.arbiter.transaction import Priority
from tests.arbiter.test_turns import Desk

URGENT, COMMAND, POLL, BACKGROUND = Priority
GUEST, WRITER = RIGHTS[READ].owner_time, RIGHTS[WRITE].owner_time
"""`owner_time` of two kinds of clients."""


def client(desk: Desk, owner_time: float, takes: float = 0.01, user: str | None = None) -> LineClient:
    made = desk.arbiter.add_client(owner_time=owner_time, user=user)
    desk.takes[made] = takes
    return made


def owners_part(desk: Desk, count: int) -> float:
    """The part of the line time that the owner has of so many exchanges; it always has something to poll."""
    begun = len(desk.served)
    for _ in range(count):
        desk.ask(None, 1 - desk.backlog.waiting_of(POLL, None), POLL)
        desk.serve()
    spent = Counter[bool]()
    for who in desk.served[begun:]:
        spent[who is None] += round(1000 * desk.takes.get(who, 0.01))
    return spent[True] / spent.total()


@pytest.mark.parametrize("takes", [0.002, 0.01, 0.1])
@pytest.mark.parametrize("count", [1, 5, 64])
def test_r9_the_owner_keeps_its_part_whatever_the_exchanges_of_guests_take(count: int, takes: float) -> None:
    desk = Desk()
    for _ in range(count):
        desk.ask(client(desk, GUEST, takes), 500, BACKGROUND)
    owners_part(desk, 100 * count)  # each has its first exchange
    assert owners_part(desk, 3000) >= 0.95


@pytest.mark.parametrize("priority", [COMMAND, POLL, BACKGROUND])
@pytest.mark.parametrize("count", [1, 64])
def test_r9_the_owner_keeps_half_of_the_line_against_writers(count: int, priority: Priority) -> None:
    desk = Desk()
    for _ in range(count):
        desk.ask(client(desk, WRITER), 500, priority)
    assert owners_part(desk, 2000) >= 0.45


@pytest.mark.parametrize("count", [1, 64])
def test_r9_the_owner_keeps_its_part_against_urgent_requests_without_end(count: int) -> None:
    desk = Desk()
    for _ in range(count):
        desk.ask(client(desk, WRITER), 500, URGENT)
    owners_part(desk, 2 * count)
    assert owners_part(desk, 2000) >= 0.45


@pytest.mark.parametrize("takes", [0.001, 0.1])
def test_r9_the_owner_keeps_half_of_the_time_if_urgent_requests_take_longer_or_less_long_than_its_own(
    takes: float,
) -> None:
    desk = Desk()
    for _ in range(64):
        desk.ask(client(desk, WRITER, takes), 1000, URGENT)
    owners_part(desk, 500)
    assert 0.45 <= owners_part(desk, 5000) <= 0.75


def test_r9_a_user_with_many_connections_has_one_part_of_the_line() -> None:
    desk = Desk()
    for _ in range(62):
        desk.ask(client(desk, WRITER, user="flood"), 500, URGENT)
    operator = client(desk, WRITER, user="operator")
    owners_part(desk, 500)
    for _ in range(50):  # a tenth of the line: a quarter is the operator's
        desk.ask(None, 1, POLL)
        desk.ask(operator, 1, URGENT)
        assert operator in desk.serve(2)
        owners_part(desk, 9)


def test_r9_what_a_user_has_used_is_kept_while_it_has_another_connection() -> None:
    desk = Desk()
    stays, leaves = client(desk, WRITER, user="one"), client(desk, WRITER, user="one")
    desk.arbiter.remove_client(leaves)
    assert stays.account.clients == 1
    assert client(desk, WRITER, user="one").account is stays.account
    assert sum(desk.backlog._members.values()) == 1


def test_r9_an_urgent_request_goes_at_once_if_its_client_asked_for_little() -> None:
    desk = Desk()
    for _ in range(63):
        desk.ask(client(desk, WRITER), 500, URGENT)
    owners_part(desk, 500)
    operator = client(desk, WRITER)
    for _ in range(5):
        desk.ask(None, 1, POLL)
        desk.ask(operator, 1, URGENT)
        assert operator in desk.serve(2)
        owners_part(desk, 500)


def test_r9_an_urgent_request_of_a_client_that_asked_too_much_waits_for_one_exchange_more() -> None:
    desk = Desk()
    flood = client(desk, WRITER)
    desk.ask(flood, 500, COMMAND)
    owners_part(desk, 100)
    for _ in range(20):
        desk.ask(None, 3, POLL)
        desk.ask(flood, 1, URGENT)
        waiting = desk.backlog.waiting(URGENT)
        desk.serve(2)
        assert desk.backlog.waiting(URGENT) < waiting


def test_r9_the_owners_urgent_requests_go_before_those_of_all_others() -> None:
    desk = Desk()
    for _ in range(64):
        desk.ask(client(desk, WRITER), 10, URGENT)
    desk.serve(100)
    desk.ask(None, 5, URGENT)
    assert desk.serve(5) == [None] * 5


def test_r9_beside_urgent_requests_the_owners_polls_keep_their_part_beside_its_commands() -> None:
    desk = Desk()
    desk.ask(client(desk, WRITER), 2000, URGENT)
    desk.ask(None, 2000, COMMAND)
    desk.ask(None, 2000, POLL)
    desk.serve(1800)
    commands, polls = (2000 - desk.backlog.waiting_of(priority, None) for priority in (COMMAND, POLL))
    assert commands + polls >= 800
    assert polls >= commands / 9


def test_r9_guests_have_all_that_the_owner_leaves() -> None:
    desk = Desk()
    first, second = client(desk, GUEST), client(desk, GUEST)
    desk.ask(first, 50, BACKGROUND)
    desk.ask(second, 50, BACKGROUND)
    assert Counter(desk.serve(100)) == {first: 50, second: 50}


def test_r9_a_guest_is_not_starved() -> None:
    desk = Desk()
    guest = client(desk, GUEST)
    desk.ask(guest, 30, BACKGROUND)
    owners_part(desk, 1100)
    assert desk.served.count(guest) == 30


def test_r9_a_program_that_connects_anew_for_each_request_has_no_more_of_the_line() -> None:
    desk = Desk()
    served = 0
    for _ in range(2000):
        guest = client(desk, WRITER, user="anew")
        desk.ask(guest, 1, COMMAND)
        while desk.backlog.waiting_of(COMMAND, guest):
            desk.ask(None, 1 - desk.backlog.waiting_of(POLL, None), POLL)
            desk.serve()
            served += 1
        desk.arbiter.remove_client(guest)
    assert desk.served.count(None) / served >= 0.45


def test_r9_accounts_of_users_that_have_gone_are_bounded() -> None:
    desk = Desk()
    for number in range(2 * MOST_LEFT):
        desk.arbiter.remove_client(client(desk, WRITER, user=f"user {number}"))
        desk.arbiter.remove_client(client(desk, WRITER))
    assert len(desk.backlog._left_accounts) == MOST_LEFT
    assert not desk.backlog._accounts


def test_r9_a_client_whose_role_changes_has_the_part_of_the_new_one() -> None:
    desk = Desk()
    changed = client(desk, GUEST)
    desk.arbiter.change_client(changed, 0.0)
    desk.ask(changed, 100, COMMAND)
    owners_part(desk, 100)
    assert desk.served.count(changed) > 80
    assert not desk.backlog._members


def test_r9_requests_of_all_clients_to_new_nodes_have_one_128th_of_the_line() -> None:
    backlog = Desk().arbiter.dispatcher.share()
    client = backlog.new_nodes()
    assert backlog.new_nodes() is client
    assert 1 / (1 + client.owner_time) == 1 / 128


def test_r9_line_time_that_the_owner_used_long_ago_is_not_counted_against_it_beside_urgent_requests() -> None:
    desk = Desk()
    owners_part(desk, 300)  # three seconds alone
    for _ in range(8):
        desk.ask(client(desk, WRITER), 500, URGENT)
    owners_part(desk, 16)
    assert owners_part(desk, 100) >= 0.45


def test_r9_a_user_that_connects_again_has_the_line_time_that_it_had_used() -> None:
    desk = Desk()
    first = client(desk, WRITER, user="one")
    account = first.account
    desk.arbiter.remove_client(first)
    assert client(desk, WRITER, user="one").account is account
    without = client(desk, WRITER)
    account = without.account
    desk.arbiter.remove_client(without)
    assert client(desk, WRITER).account is not account
