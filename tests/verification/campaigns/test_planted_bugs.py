"""A campaign that finds nothing is worth what it would have found: bugs are planted in the master, and caught."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from busmaster.arbiter.backlog import Writes
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.in_sync import InSync
from busmaster.arbiter.shared_backlog import SharedBacklog, Turns
from busmaster.contract.exchange import FrameError
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.msc import exchange as msc_exchange
from busmaster.wire import readers
from tests.planted import (
    with_a_cancellation_that_clears_the_exchange,
    without_max_reply_delay,
    without_the_adapter_in_the_max_reply_delay,
    without_the_adapter_in_the_silence,
    without_the_byte_time,
)
from tests.tiers import one_slow
from tests.verification.campaigns.hunt import Hunt
from tests.verification.campaigns.judge import Judge, Totals
from tests.verification.campaigns.kinds import KINDS

SEEDS = range(1, 21)
EACH = 2000
"""Transactions of a hunt. Most are broken off long before."""
EVERY_PROTOCOL = pytest.mark.parametrize("protocol", one_slow(KINDS, pytest.mark.exhaustive))
BUT_MODBUS = [protocol for protocol in KINDS if protocol != "modbus"]
BUT_MSC = ["hcp", "hcp2", "mentor", "dc104"]


def caught(protocol: str, mix: str) -> Totals:
    """What the first hunt found that found a wrong value."""
    for seed in SEEDS:
        totals = Hunt(protocol, mix, seed).run(EACH)
        if totals.confused:
            return totals
    pytest.fail(f"{len(SEEDS)} hunts found no wrong value")


@pytest.fixture(autouse=True)
def wrong_values_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """R1 and R3 are checked at each request too: that would end the hunt before harm is done. And R15 would prevent
    the harm: what is overdue is known whatever the bug."""
    monkeypatch.setattr(Judge, "request_leaves", lambda judge, now: None)
    monkeypatch.setattr(InSync, "add_overdue", lambda in_sync, *overdue: None)


def excusing(feed: Callable[..., Any]) -> Callable[..., Any]:
    """A reader's function, for which a wrong echo is as good as a bad checksum."""

    def read(*arguments: Any) -> Any:
        try:
            return feed(*arguments)
        except FrameError as error:
            error.whole = error.whole or error.what.startswith("wrong echo")
            raise

    return read


@EVERY_PROTOCOL
def test_a_max_reply_delay_of_zero_is_caught(protocol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    without_max_reply_delay(monkeypatch)
    assert "WRONG" in caught(protocol, "late").problems[0]


@pytest.mark.parametrize("protocol", one_slow(BUT_MSC, pytest.mark.exhaustive))
def test_a_wrong_echo_that_does_not_resynchronise_is_caught(protocol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(readers, "find_field", excusing(readers.find_field))
    monkeypatch.setattr(dc104.Reading, "feed", excusing(dc104.Reading.feed))
    assert "WRONG" in caught(protocol, "noise").problems[0]


@EVERY_PROTOCOL
def test_a_cancellation_that_clears_the_exchange_is_caught(protocol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    with_a_cancellation_that_clears_the_exchange(monkeypatch)
    assert "WRONG" in caught(protocol, "cancelled").problems[0]


# `excusing` does not reach the reader of Modbus, whose replies name no register
@pytest.mark.parametrize("protocol", one_slow(BUT_MODBUS, pytest.mark.exhaustive))
def test_an_echo_that_is_not_looked_at_is_caught(protocol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The element check removed; for an MSC, that of unit and name."""
    right, read = readers.find_field, dc104.Reading.feed

    def find_field(buffer: bytes, header: bytes, *others: Any) -> bytes | None:
        return right(buffer, buffer[: len(header)], *others) if len(buffer) >= len(header) else None

    def feed(reading: dc104.Reading, data: bytes) -> Any:
        reading._parameter = (reading._buffer + data + b"\0\0")[1]
        return read(reading, data)

    monkeypatch.setattr(readers, "find_field", find_field)
    monkeypatch.setattr(dc104.Reading, "feed", feed)
    monkeypatch.setattr(msc_exchange.Reply, "echoed_by", lambda reply, whole: len(whole) == reply.size)
    assert "WRONG" in caught(protocol, "wrong").problems[0]


# Modbus keeps a silence between frames that is longer than a byte: there this bug does no harm
@pytest.mark.parametrize("protocol", one_slow(BUT_MODBUS, pytest.mark.exhaustive))
def test_a_byte_time_left_out_of_the_max_reply_delay_brings_a_wrong_value(
    protocol: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neighbours are asked the same, or what comes too late would look like nothing that was asked. An overdue reply
    that is seen raises its node's maximum reply delay, which would heal the bug."""
    without_the_byte_time(monkeypatch)
    monkeypatch.setattr(NodeRecord, "raise_max_reply_delay", lambda node, max_reply_delay, until: None)
    assert "WRONG" in caught(protocol, "edges, equal").problems[0]


@pytest.mark.parametrize("protocol", one_slow(BUT_MSC, pytest.mark.exhaustive))
def test_without_r3_a_request_that_leaves_too_early_is_caught_before_it_does_harm(
    protocol: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.undo()
    without_max_reply_delay(monkeypatch)
    assert "R3" in Hunt(protocol, "late", 1).run(EACH).problems[0]


@EVERY_PROTOCOL
def test_an_overdue_reply_that_is_forgotten_is_caught(protocol: str) -> None:
    """R15 removed; R3's assumption does not hold behind this network."""
    assert "WRONG" in caught(protocol, "network, equal").problems[0]


def broken(protocol: str, mix: str) -> str:
    """The first rule that a hunt found broken."""
    for seed in SEEDS:
        totals = Hunt(protocol, mix, seed).run(EACH)
        if totals.problems:
            return totals.problems[0]
    pytest.fail(f"{len(SEEDS)} hunts found nothing wrong")


NOT_MSC = pytest.mark.parametrize("protocol", one_slow(BUT_MSC, pytest.mark.exhaustive))


@NOT_MSC
def test_a_byte_time_left_out_of_the_max_reply_delay_is_caught(protocol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    without_the_byte_time(monkeypatch)
    assert "R1" in broken(protocol, "edges")


@NOT_MSC
def test_an_adapter_left_out_of_the_max_reply_delay_is_caught(protocol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    without_the_adapter_in_the_max_reply_delay(monkeypatch)
    assert "R1" in broken(protocol, "edges, held back") or "R3" in broken(protocol, "edges, held back")


@NOT_MSC
def test_an_adapter_left_out_of_the_silence_is_caught(protocol: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.undo()
    without_the_adapter_in_the_silence(monkeypatch)
    assert "adapter" in broken(protocol, "edges, pushed")


def first_problem(mix: str) -> str:
    """What the first hunt found that found a broken rule."""
    for seed in SEEDS:
        totals = Hunt("hcp2", mix, seed).run(EACH)
        if totals.problems:
            return totals.problems[0]
    pytest.fail(f"{len(SEEDS)} hunts found no broken rule")


def test_r9_a_line_that_is_not_held_is_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(SharedBacklog, "_hold_for", lambda backlog, hold, priority: None)
    assert "comes between the requests of a sequence" in first_problem("shared")


def test_r9_programs_that_go_first_come_first_served_are_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    def longest(turns: Turns) -> object:
        return max(turns._waiting(), key=lambda turn: turn.queue.live)

    monkeypatch.setattr(Turns, "_chosen", longest)
    assert "went before a command of another program" in first_problem("shared")


def test_r7_writes_of_a_program_out_of_order_are_caught(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Writes, "is_first", lambda writes, write: True)
    assert "after a later one" in first_problem("shared, lost")
