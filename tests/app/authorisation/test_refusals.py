"""A peer that guesses tokens is slowed down, and nobody else."""

from __future__ import annotations

import asyncio
from collections import Counter

import pytest

from busmaster.app import bounds
from busmaster.app.service.refusals import (
    Logins,
    Refusals,
    failed_text,
    is_interface_name,
    pause_after,
    peer_of,
    wait_text,
)
from busmaster.testing import run_in_virtual_time

HERE, ELSEWHERE = "10.0.0.1", "10.0.0.2"


class Clock:
    def __init__(self) -> None:
        self.now = 1000.0
        self.failed: list[str] = []
        self.logins = Logins(self.failed.append, lambda: self.now)

    def judge(self, name: str | None = None, host: str = HERE) -> float | None:
        return self.logins.judge(host, name)

    def guess(self, count: int) -> None:
        for _ in range(count):
            self.now += self.judge() or 0.0


def test_after_some_failures_each_further_one_costs_twice_the_time() -> None:
    clock = Clock()
    waits = [clock.judge() for _ in range(bounds.FREE_LOGINS)]
    assert waits == [0.0] * bounds.FREE_LOGINS
    for pause in (1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0):
        assert clock.judge() == pause
        clock.now += pause
    assert len(clock.failed) == bounds.FREE_LOGINS + 7
    assert pause_after(10**6) == bounds.LONGEST_LOGIN_PAUSE


def test_during_a_pause_no_login_of_the_peer_is_checked_and_all_count_but_none_lengthens_it() -> None:
    clock = Clock()
    clock.guess(bounds.FREE_LOGINS)
    assert clock.judge() == 1.0
    clock.now += 0.25
    assert clock.judge("scada") == 0.75
    assert clock.judge() == 0.75
    assert clock.failed == [HERE] * (bounds.FREE_LOGINS + 3)
    clock.now += 0.75
    assert clock.judge("scada") is None


def test_a_right_login_from_another_peer_never_waits() -> None:
    clock = Clock()
    clock.guess(20)
    assert clock.judge() == bounds.LONGEST_LOGIN_PAUSE
    assert clock.judge("scada", ELSEWHERE) is None


def test_a_name_that_has_logged_in_from_the_peer_is_not_locked_out() -> None:
    clock = Clock()
    assert clock.judge("scada") is None
    clock.guess(20)
    clock.judge()
    assert clock.judge("scada") is None
    assert clock.judge("other") == bounds.LONGEST_LOGIN_PAUSE
    assert clock.judge() == bounds.LONGEST_LOGIN_PAUSE, "a right login makes no guess free"


def test_failures_are_forgotten_after_a_while() -> None:
    clock = Clock()
    clock.guess(bounds.FREE_LOGINS)
    clock.now += bounds.LOGINS_FORGOTTEN
    assert clock.judge() == 1.0
    clock.now += bounds.LOGINS_FORGOTTEN + 1
    assert clock.judge() == 0.0


def test_what_is_remembered_of_peers_is_bounded_and_the_oldest_is_forgotten() -> None:
    clock = Clock()
    clock.guess(bounds.FREE_LOGINS)
    for number in range(bounds.MOST_LOGIN_PEERS - 1):
        clock.judge(None, f"peer {number}")
    assert clock.judge() == 1.0, "it is not forgotten yet"
    for number in range(2 * bounds.MOST_LOGIN_PEERS):
        clock.judge(None, f"another {number}")
    assert len(clock.logins._peers) == bounds.MOST_LOGIN_PEERS
    assert clock.judge() == 0.0
    for number in range(100):
        clock.judge(f"name {number}")
    assert len(clock.logins._peers[HERE].good) == 16


def test_a_peer_that_goes_on_is_not_the_oldest_and_of_its_names_the_oldest_is_forgotten() -> None:
    clock = Clock()
    for number in range(17):
        clock.judge(f"name {number}")
    for number in range(bounds.MOST_LOGIN_PEERS - 1):
        clock.judge(None, f"peer {number}")
    clock.guess(bounds.FREE_LOGINS + 1)
    clock.judge(None, "one more")
    assert clock.judge() == 2.0, "it is not forgotten"
    assert (clock.judge("name 16"), clock.judge("name 1"), clock.judge("name 0")) == (None, None, 2.0)


def test_a_failed_login_is_counted_for_the_peer_however_its_address_is_written() -> None:
    clock = Clock()
    clock.judge(None, f"::ffff:{HERE}")
    clock.judge(None, HERE)
    clock.judge(None, "2001:db8::1:2:3")
    assert clock.failed == [HERE, HERE, "2001:db8::/64"]


@pytest.mark.parametrize(
    ("host", "peer"),
    [
        ("10.0.0.1", "10.0.0.1"),
        ("::ffff:10.0.0.1", "10.0.0.1"),
        ("::1", "::1"),
        ("2001:db8::1:2:3", "2001:db8::/64"),
        ("fe80::1%eth0", "fe80::/64"),
        ("?", "?"),
    ],
)
def test_a_peer_is_an_address_or_a_network_of_one_machine(host: str, peer: str) -> None:
    assert peer_of(host) == peer


def test_a_report_names_the_worst_peers_and_counts_the_others() -> None:
    text = failed_text("web", Counter({"a": 1, "b": 5, "c": 2, "d": 1, "e": 1}))
    assert text == "10 failed logins at web: 5 from b, 2 from c, 1 from a and 2 more"
    assert failed_text("web", Counter({"a": 1})) == "1 failed login at web: 1 from a"


def test_refusals_of_an_interface_are_counted_under_the_name_that_it_reports() -> None:
    refusals = Refusals()
    for number in range(20):
        refusals.begin(f"interface{number}", "connections")
    assert len(refusals.at_interfaces) == 16  # with the service, and the last ones as others
    assert refusals.at_interfaces["others", "connections"] == 0
    assert ("interface19", "connections") not in refusals.at_interfaces
    assert refusals.logins == {"service": 0}
    refusals.connections["read"] = 5
    refusals.at_interfaces["interface3", "connections"] = 2
    refusals.at_interfaces["interface4", "requests"] = 4
    assert (refusals.total("connections"), refusals.total("requests")) == (7, 4)


def test_names_of_interfaces_are_bounded_for_refusals_that_were_not_begun_too_and_a_count_is_kept() -> None:
    async def run() -> None:
        refusals = Refusals()
        for number in range(20):
            refusals.note(f"interface{number}", "logins", HERE)
            refusals.note(f"interface{number}", "requests", HERE, 2)
            refusals.begin(f"interface{number}", "logins")  # it restarts, and its refusals stay counted
            refusals.begin(f"interface{number}", "requests")
        assert len(refusals.logins) == 17  # of the service, of 15 interfaces, and of others
        assert (refusals.logins["interface0"], refusals.logins["others"]) == (1, 5)
        assert refusals.at_interfaces["interface0", "requests"] == 2
        assert refusals.at_interfaces["others", "requests"] == 10
        assert (refusals.total("requests"), refusals.total("connections")) == (40, 0)

    run_in_virtual_time(run())


def test_each_kind_of_refusal_has_a_report_of_its_own_with_its_peers() -> None:
    async def run() -> None:
        first, second = list[str](), list[str]()
        refusals = Refusals()
        refusals.on_report.extend([first.append, second.append])
        for role in ("read", "write", "read", "read"):
            refusals.note_connection(role)
        for peer in ("user 1001", "192.0.2.1", "192.0.2.1"):
            refusals.note_rate(peer)
        refusals.note("web", "requests", HERE, 3)
        refusals.note("web", "requests", HERE, 2)
        refusals.note("web", "requests", ELSEWHERE)
        refusals.note("web", "connections", HERE)
        refusals.note("web", "logins", HERE, 2)
        refusals.note("unknown", "logins", HERE)
        places, again = "because no place was free", "because the program connects again and again"
        status = "`busmaster status` shows how many programs use the line"
        at_once = [
            f"1 connection was refused, {places}: 1 of role read. {status}",
            f"1 connection was refused, {again}: 1 from user 1001",
            f"3 requests were refused at web: 3 from {HERE}",
            f"1 connection was refused at web: 1 from {HERE}",
            f"2 failed logins at web: 2 from {HERE}",
            f"1 failed login at unknown: 1 from {HERE}",
        ]
        assert first == at_once
        await asyncio.sleep(61)
        assert sorted(first[len(at_once) :]) == [  # all are due at the same time
            f"2 connections were refused, {again}: 2 from 192.0.2.1",
            f"3 connections were refused, {places}: 2 of role read, 1 of role write. {status}",
            f"3 requests were refused at web: 2 from {HERE}, 1 from {ELSEWHERE}",
        ]
        assert second == first
        assert refusals.connections == {"read": 3, "write": 1, "unknown": 3}
        assert refusals.logins == {"service": 0, "web": 2, "unknown": 1}

    run_in_virtual_time(run())


def test_a_peer_waits_for_a_second_at_least_by_its_text() -> None:
    assert wait_text(0.2).endswith("try again in 1 s")
    assert wait_text(29.6).endswith("try again in 30 s")


@pytest.mark.parametrize(
    ("name", "right"),
    [("web", True), ("modbus-tcp", True), ("my_world2", True), ("service", False), ("", False), ("Web", False)]
    + [(name, False) for name in ('a"b', "a b", "a\n", "a" * 33, "2b")],
)
def test_an_interface_has_a_name_that_metrics_and_logs_can_show(name: str, right: bool) -> None:
    assert is_interface_name(name) is right
