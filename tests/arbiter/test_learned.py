"""Windows that are learned from a node's replies: how long is waited, and what keeps that safe (R15)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import Any

import pytest

from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.counters import Mark
from busmaster.arbiter.events import MaxReplyDelayRaised
from busmaster.arbiter.health import SILENT, Health, NodeRecord
from busmaster.arbiter.in_sync import MOST_UNHEARD
from busmaster.arbiter.learned import (
    MARGIN,
    SLOWER,
    TRUSTED_AFTER,
    TRUSTED_AGAIN_AFTER,
    LearnedTimes,
    Learning,
)
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.contract.exchange import Command
from busmaster.contract.learning import LEARNED, Learned
from busmaster.contract.profile import Profile
from busmaster.errors import InvalidCommand, NoReply, WriteUnconfirmed
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.ei_bisynch import codec as ei_bisynch
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import ACK, FIVE, MAX_REPLY_DELAY, NAK, TAU, Bench, lost, reply_of, request_of, up

REQUEST = 8 * TAU
TOOK = 0.004
"""Seconds from the end of a request to its reply, which is handed over at once."""
WINDOW = SLOWER * (TOOK - 5 * TAU) + MARGIN
"""What is learned from that: a reply of six bytes began five bytes before it was handed over."""
TIMINGS = hcp2.PROFILE.timings
WRITE_7 = hcp2.Write(1, (7,)).open(1, TIMINGS).request.hex(" ").upper()


def trained(bench: Bench, address: int = 1, replies: int = TRUSTED_AFTER + 1, took: float = TOOK) -> NodeRecord:
    """A node whose times have been learned; its last read was of an element of its own."""
    node = bench.arbiter.add_node(hcp2.PROFILE, address, bench.now, LEARNED)
    for number in range(replies):
        bench.served(bench.ask(node, hcp2.Read(10 + number % 2)), after=REQUEST + took)
    bench.until_ready()
    assert node.health is Health.UP
    return node


def requests_before(bench: Bench, held: Transaction) -> list[tuple[str, float]]:
    """What is sent until this is, its own request too, and when. Nothing is answered."""
    sent: list[tuple[str, float]] = []
    while not held.attempts:
        bench.until_sent()
        sent.append((bench.sent(), bench.now))
    return sent


def learning(node: NodeRecord) -> Learning:
    assert node.learning is not None
    return node.learning


def trusted(node: NodeRecord) -> bool:
    return all(times.trusted for times in learning(node).times(node.timings))


# how long


@pytest.mark.parametrize("pauses", [(0.007, 0.003), (0.003, 0.007)])
def test_the_longest_pause_within_a_reply_is_learned_wherever_it_is(pauses: tuple[float, float]) -> None:
    bench = Bench()
    node = bench.arbiter.add_node(hcp2.PROFILE, 1, bench.now, LEARNED)
    for _ in range(2):
        read = bench.ask(node)
        bench.until_sent()
        bench.sent()
        for piece, after in zip((FIVE[:6], FIVE[6:12], FIVE[12:]), (REQUEST + TOOK, *pauses), strict=True):
            bench.hear(piece, after)
        assert read.value == 5.0
        bench.until_ready()
        bench.wait(1.0)
    [times] = learning(node).times(node.timings)
    assert times.pause == pytest.approx(0.007)


def test_nothing_is_learned_unless_it_is_asked_for() -> None:
    bench = Bench()
    assert bench.node().learning is None
    own = TIMINGS.with_window(0.2)
    node = bench.arbiter.add_node(hcp2.PROFILE, 2, bench.now, Learned(own))
    assert node.learning is not None
    assert node.timings is own


def test_r15_a_last_attempt_is_not_sent_while_an_overdue_reply_may_meet_its_own() -> None:
    bench = Bench()
    node = trained(bench)
    other = bench.node(2)
    gone = bench.ask(node)
    assert bench.sent() == request_of(1)
    bench.ask(other, hcp2.Read(5), retries=0)
    bench.arbiter.cancel(gone, bench.now)
    assert bench.until_sent() == pytest.approx(REQUEST + WINDOW)
    assert bench.sent() != request_of(5, 2)


@pytest.mark.parametrize("cut", [1, 3, 5])
def test_r3_a_reply_that_pauses_longer_than_ever_is_over_before_another_node_is_asked(cut: int) -> None:
    """Found by a campaign: the rest met the reply of the other, and both together had a right checksum."""
    bench = Bench()
    node, other = trained(bench), bench.node(2)
    bench.ask(node)
    assert bench.sent() == request_of(1)
    bench.ask(other, hcp2.Read(2))
    bench.hear(FIVE[: 3 * cut], after=REQUEST + TOOK)
    heard = bench.now
    bench.wait(TIMINGS.read.inter_byte_timeout - TAU)
    assert bench.sent() == "", "the rest can still come"
    bench.hear(FIVE[3 * cut :], after=0.0)
    rest = bench.now
    bench.until_sent()
    assert rest - heard < TIMINGS.read.inter_byte_timeout < bench.now - rest
    assert node.health is Health.UP


def test_r3_nor_while_the_rest_of_a_reply_with_a_damaged_byte_can_come() -> None:
    bench = Bench()
    node, other = trained(bench), bench.node(2)
    bench.ask(node)
    assert bench.sent() == request_of(1)
    bench.ask(other, hcp2.Read(2))
    bench.wait(REQUEST + TOOK)
    bench.arbiter.byte_marked(Mark.DAMAGED, bench.now)
    marked = bench.now
    bench.until_sent()
    assert bench.now - marked > TIMINGS.read.inter_byte_timeout


def test_r3_nor_while_the_rest_of_what_met_our_request_can_come() -> None:
    bench = Bench(echo=True)
    node, other = bench.arbiter.add_node(hcp2.PROFILE, 1, bench.now, LEARNED), bench.node(2)
    for number in range(TRUSTED_AFTER + 1):
        read = bench.ask(node, hcp2.Read(10 + number % 2))
        bench.until_sent()
        bench.hear(bench.sent(), after=REQUEST)
        bench.answer(after=TOOK)
        assert read.error is None
    bench.until_ready()
    bench.ask(node)
    bench.until_sent()
    assert bench.sent() == request_of(1)
    bench.ask(other, hcp2.Read(2))
    bench.hear(FIVE[:9], after=REQUEST)
    heard = bench.now
    bench.until_sent()
    assert bench.now - heard > TIMINGS.read.inter_byte_timeout


def test_r3_nor_while_the_rest_of_what_came_unexpected_can_come() -> None:
    bench = Bench()
    trained(bench)
    other = bench.node(2)
    bench.hear(FIVE[:9])
    heard = bench.now
    bench.ask(other, hcp2.Read(2))
    bench.until_sent()
    assert bench.now - heard > TIMINGS.read.inter_byte_timeout


# what is lost costs the learned window


def test_a_reply_within_its_window_behind_a_damaged_byte_was_not_late() -> None:
    bench = Bench()
    node = trained(bench)
    bench.ask(node, retries=0)
    bench.sent()
    bench.wait(REQUEST + TOOK / 2)
    bench.arbiter.byte_marked(Mark.DAMAGED, bench.now)
    bench.hear(FIVE, after=TOOK / 2)
    bench.until_ready()
    assert not bench.arbiter._in_sync.overdue_replies
    assert trusted(node)


def test_r15_an_overdue_reply_of_a_node_with_the_documents_window_tells_nothing_of_learned_times() -> None:
    bench = Bench()
    node = trained(bench, replies=2)
    times = learning(node).times(node.timings)
    lost(bench, node)
    bench.hear(FIVE, after=3.0)
    bench.until_ready()
    assert not any(overdue.node for overdue in bench.arbiter._in_sync.overdue_replies)
    assert (learning(node).times(node.timings), node.max_reply_delay) == (times, TIMINGS.read.max_reply_delay)


def test_r15_a_reply_that_is_awaited_lasts_as_long_as_its_bytes_with_one_pause() -> None:
    bench = Bench()
    lost(bench, trained(bench))
    awaited = next(overdue.awaited for overdue in bench.arbiter._in_sync.overdue_replies if overdue.awaited)
    assert awaited.silence == pytest.approx(TIMINGS.read.inter_byte_timeout + TAU)
    longest = hcp2.Read(1).open(1, TIMINGS).sizes.longest
    assert awaited.lasts == pytest.approx(longest * TAU + awaited.silence)


def test_a_lost_reply_costs_its_learned_window_and_a_check_of_its_node() -> None:
    bench = Bench()
    node = trained(bench)
    asked = bench.ask(node)
    assert bench.sent() == request_of(1)
    assert bench.until_sent() == pytest.approx(REQUEST + WINDOW)
    assert bench.sent() == request_of(10), "a check: the lost reply could be the second attempt's"
    bench.answer(after=REQUEST + TOOK)
    assert bench.sent() == request_of(1)
    bench.answer(7, after=REQUEST + TOOK)
    assert asked.value == 7.0
    assert trusted(node)


def test_a_read_of_the_node_that_waits_anyway_goes_in_place_of_a_check_whatever_its_class() -> None:
    bench = Bench()
    node = trained(bench)
    bench.ask(node)
    bench.ask(node, hcp2.Read(3), priority=Priority.BACKGROUND)
    assert bench.sent() == request_of(1)
    bench.until_sent()
    assert (bench.sent(), bench.arbiter.statistics(bench.now).sync_reads) == (request_of(3), 0)


def test_a_read_of_the_node_does_not_go_in_place_of_a_check_before_a_write_that_waits_for_the_node() -> None:
    bench = Bench()
    node = trained(bench)
    bench.ask(node)
    bench.ask(node, hcp2.Write(1, (7,)))
    bench.ask(node, hcp2.Read(3), priority=Priority.BACKGROUND)
    assert bench.sent() == request_of(1)
    bench.until_sent()
    assert (bench.sent(), bench.arbiter.statistics(bench.now).sync_reads) == (request_of(10), 1)


def test_r15_a_last_attempt_does_not_go_in_place_of_a_check() -> None:
    bench = Bench()
    node = trained(bench)
    bench.ask(node)
    bench.ask(node, hcp2.Read(3), retries=0, priority=Priority.BACKGROUND)
    assert bench.sent() == request_of(1)
    bench.until_sent()
    assert (bench.sent(), bench.arbiter.statistics(bench.now).sync_reads) == (request_of(10), 1)


def test_another_node_that_answers_with_another_echo_is_asked_at_once() -> None:
    bench = Bench()
    node, other = trained(bench, 1), trained(bench, 2)
    bench.ask(node)
    unlike = bench.ask(other, hcp2.Read(3))
    bench.until_sent()
    assert bench.sent() == request_of(1)
    bench.until_sent()
    assert bench.sent() == request_of(3, 2)
    bench.answer(9, after=REQUEST + TOOK)
    assert unlike.value == 9.0


@pytest.mark.parametrize("retries", [0, 1, 2, 4])
def test_a_second_attempt_is_awaited_twice_as_long_and_those_behind_and_the_last_as_long_as_the_document_says(
    retries: int,
) -> None:
    bench = Bench()
    node = trained(bench)
    asked = bench.ask(node, retries=retries)
    sent_at = []
    while not bench.ended(asked):
        bench.until_sent()
        if bench.sent() == request_of(1):
            sent_at.append(bench.now)
        else:
            bench.answer(after=REQUEST + TOOK)
            continue
        bench.to(bench.arbiter.poll_timeout())
        sent_at.append(bench.now)
    waited = [end - begin for begin, end in zip(sent_at[::2], sent_at[1::2], strict=True)]
    windows = [WINDOW, 2 * WINDOW][:retries]
    windows += [TIMINGS.read.window] * (retries + 1 - len(windows))
    assert waited == pytest.approx([REQUEST + window for window in windows])
    assert isinstance(asked.error, NoReply)


# what is late is never believed


def test_r15_a_reply_later_than_its_learned_window_is_never_another_nodes() -> None:
    bench = Bench()
    node, other = trained(bench, 1), trained(bench, 2)
    bench.ask(node)
    alike = bench.ask(other)
    bench.sent()
    bench.until_sent()
    assert bench.sent() == request_of(10), "not the same element of another node"
    bench.hear(reply_of(1, 55), after=REQUEST + 0.002)
    assert alike.value is None
    while not bench.ended(alike):
        bench.until_sent()
        bench.answer(7 if bench.sent() == request_of(1, 2) else 5, after=REQUEST + TOOK)
    assert alike.value == 7.0


def test_r15_no_write_leaves_while_a_reply_may_still_come() -> None:
    bench = Bench()
    node, other = trained(bench, 1), trained(bench, 2)
    bench.ask(node, retries=1)
    write = bench.ask(other, hcp2.Write(1, (7,)))
    bench.sent()
    bench.until_sent()
    assert bench.sent() == request_of(10), "its answer shows that nothing is to come"
    bench.answer(after=REQUEST + TOOK)
    bench.until_sent()
    request = bench.sent()
    assert request == hcp2.Write(1, (7,)).open(2, TIMINGS).request.hex(" ").upper()
    bench.hear(ACK, after=REQUEST + TOOK)
    assert bench.ended(write)
    assert write.error is None


def test_r15_no_last_attempt_of_a_read_leaves_in_place_of_a_write_while_a_reply_may_still_come() -> None:
    bench = Bench()
    node, other, third = trained(bench, 1), trained(bench, 2), trained(bench, 3)
    bench.ask(node, retries=1)
    bench.ask(other, hcp2.Write(1, (7,)))
    bench.ask(third, hcp2.Read(3), retries=0)
    repeatable = bench.ask(node, hcp2.Read(4))
    node.unheard = MOST_UNHEARD  # it is taken to be silent, and not asked for a check
    bench.until_sent()
    assert bench.sent() == request_of(1)
    bench.until_sent()
    assert bench.sent() == request_of(4)
    assert repeatable.attempts == 1


def test_r15_where_checks_are_in_vain_a_write_waits_for_the_documents_max_reply_delay() -> None:
    bench = Bench()
    node, other = trained(bench, 1), trained(bench, 2)
    bench.ask(node, retries=1)
    asked = requests_before(bench, bench.ask(other, hcp2.Write(1, (7,))))
    checks = [request_of(element) for element in (10, 11, 2, 3)]
    assert [request for request, _ in asked[:5]] == [request_of(1), *checks], "then it is taken to be silent"
    assert asked[5][1] - (asked[4][1] + REQUEST) >= MAX_REPLY_DELAY - 1e-9


MSC_REPLY = "06 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"
"""MSC: the ACK and the packet of unit 1, read together."""


def trained_msc(bench: Bench, apart: float = 0.0) -> NodeRecord:
    """An MSC unit whose times have been learned; those of its packet only if that comes `apart` from the ACK."""
    node = bench.arbiter.add_node(msc.PROFILE, 1, bench.now, LEARNED)
    for _ in range(TRUSTED_AFTER + 1):
        answered = bench.ask(node, msc.DataRead(2008))
        bench.until_sent()
        bench.sent()
        if apart:
            bench.hear(ACK, after=0.030)
        bench.hear(MSC_REPLY[3:] if apart else MSC_REPLY, after=apart or 0.030)
        assert (bench.ended(answered), bench.sent()) == (1, ACK)
        bench.until_ready()
    return node


def test_r3_nor_while_the_rest_of_a_packet_can_come_that_began_with_its_ack() -> None:
    bench = Bench()
    node = trained_msc(bench, apart=0.003)
    bench.ask(node, msc.DataRead(2008), retries=2)
    bench.until_sent()
    bench.sent()
    bench.ask(bench.node(2, msc.PROFILE), msc.DataRead(2008))
    bench.hear(MSC_REPLY[:30], after=0.030)
    heard = bench.now
    bench.until_sent()
    while bench.sent() in (NAK, ACK):  # it asks for the packet again, and then gives up
        bench.until_sent()
    assert bench.now - heard > msc.PROFILE.timings.packet.inter_byte_timeout


def test_r15_a_write_waits_for_the_packet_too_that_may_come_behind_a_late_ack() -> None:
    bench = Bench()
    node, read = trained_msc(bench), msc.DataRead(2008)
    bench.ask(node, read, retries=1)
    node.unheard = MOST_UNHEARD  # it is taken to be silent, and not asked for a check
    [lost, after, *_] = requests_before(bench, bench.ask(bench.node(2, msc.PROFILE), msc.DataWrite(2024, 5)))
    times = msc.PROFILE.timings
    assert after[1] - lost[1] >= times.read.max_reply_delay + times.packet.max_reply_delay


def test_r15_all_that_owe_are_asked_before_a_write_waits_for_a_max_reply_delay() -> None:
    bench = Bench()
    other = trained(bench, 9)
    nodes = [trained(bench, address) for address in (1, 2, 3)]
    for element, node in enumerate(nodes, 4):
        bench.ask(node, hcp2.Read(element), retries=1)
    write = bench.ask(other, hcp2.Write(1, (7,)))
    for element, node in enumerate(nodes, 4):
        bench.until_sent()
        assert bench.sent() == request_of(element, node.address), "lost"
    held_at = bench.now + REQUEST + WINDOW
    while not write.attempts:
        bench.until_sent()
        if not write.attempts:
            bench.answer(after=REQUEST + TOOK)
    assert write.started - held_at == pytest.approx(3 * (REQUEST + TOOK))


def test_r15_who_has_lost_two_replies_is_asked_for_a_check_before_an_answer_that_would_not_be_believed() -> None:
    bench = Bench()
    node, other = trained(bench, 1), trained(bench, 2)
    lost = [bench.ask(node, hcp2.Read(element)) for element in (1, 3)]
    for number in range(40):  # until the maximum reply delay of both is over, and the other has answered since
        bench.ask(other, hcp2.Read(20 + number))
    to_node = []
    while not all(bench.ended(read) for read in lost):
        bench.until_sent()
        request = bench.sent()
        if request[3:8] == request_of(1)[3:8]:
            to_node.append(request)
        if request[3:8] != request_of(1)[3:8] or len(to_node) > 2:
            bench.answer(after=REQUEST + TOOK)
    assert to_node == [request_of(1), request_of(3), request_of(10), request_of(1), request_of(3)]


def test_r15_a_node_that_was_heard_late_is_asked_for_a_check_before_its_last_attempt() -> None:
    bench = Bench()
    node = trained(bench)
    read = bench.ask(node, retries=1)
    for request in (request_of(element) for element in (1, 10, 11, 2, 3)):
        bench.until_sent()
        assert bench.sent() == request
    bench.hear(reply_of(10, 5), after=0.020)
    bench.until_sent()
    assert bench.sent() != request_of(1), "its answer could be the first attempt's"
    bench.answer(after=REQUEST + TOOK)
    bench.served(read, after=REQUEST + TOOK)
    assert (read.error, read.attempts) == (None, 2)


def test_r15_a_late_reply_pays_nothing_while_somebody_else_owes_one_that_it_could_be() -> None:
    """A drive that answers with another element than it was asked for: the check of its reply is right."""
    bench = Bench()
    node, other = trained(bench, 1), trained(bench, 2)
    read = bench.ask(node)
    bench.ask(other, hcp2.Read(3))
    for request in (request_of(1), request_of(3, 2)):
        bench.until_sent()
        assert bench.sent() == request
    bench.hear(reply_of(1, 77), after=REQUEST + TOOK)  # the other's, for another element
    bench.until_sent()
    assert bench.sent() != request_of(1), "what it was asked for first may still come"
    assert read.value is None


def test_r9_what_goes_before_a_write_takes_no_longer_than_three_exchanges_that_nobody_answers() -> None:
    bench = Bench()
    other = trained(bench, 9)
    nodes = [trained(bench, address, took=0.030) for address in range(1, 8)]
    for element, node in enumerate(nodes, 20):
        bench.ask(node, hcp2.Read(element), retries=1)
    asked = requests_before(bench, bench.ask(other, hcp2.Write(1, (7,))))
    held_at = asked[len(nodes)][1]
    assert len(asked) > len(nodes) + MOST_BEFORE + 1, "more checks than that went, each in vain"
    assert asked[-1][1] - held_at <= MOST_BEFORE * (REQUEST + MAX_REPLY_DELAY)


def test_r9_three_exchanges_at_most_go_before_an_urgent_read() -> None:
    bench = Bench()
    node = trained(bench)
    bench.ask(node, retries=1)
    bench.sent()
    urgent = bench.ask(node, priority=Priority.URGENT, retries=0)
    assert len(requests_before(bench, urgent)) == MOST_BEFORE + 1


def test_r9_an_urgent_write_is_never_held_back_and_its_ack_is_not_believed() -> None:
    bench = Bench()
    node = trained(bench)
    bench.ask(node, retries=1)
    bench.sent()
    urgent = bench.ask(node, hcp2.Write(1, (7,)), priority=Priority.URGENT)
    bench.until_sent()
    assert bench.sent() == WRITE_7
    bench.hear(ACK, after=REQUEST + TOOK)
    assert isinstance(urgent.error, WriteUnconfirmed)


def test_r7_a_write_is_awaited_for_as_long_as_the_document_says() -> None:
    bench = Bench()
    node = trained(bench)
    for value in range(TRUSTED_AFTER + 1):
        bench.served(bench.ask(node, hcp2.Write(2, (value,))), after=REQUEST + TOOK)
    write = bench.ask(node, hcp2.Write(1, (7,), idempotent=True), retries=2)
    bench.until_sent()
    bench.sent()
    length = len(bytes.fromhex(WRITE_7)) * TAU
    assert bench.until_sent() == pytest.approx(length + TIMINGS.write.window)
    assert write.attempts == 1


# back to the document's times


def test_an_overdue_reply_brings_the_documents_times_back_until_enough_replies_have_come() -> None:
    bench = Bench()
    node = trained(bench)
    asked = bench.ask(node)
    bench.sent()
    bench.until_sent()
    bench.sent()
    bench.hear(reply_of(1, 5), after=REQUEST + TOOK)  # in place of the answer to the check
    bench.served(asked, after=REQUEST + TOOK)
    assert learning(node).returns == 1
    assert not trusted(node)
    bench.until_ready()
    for _ in range(TRUSTED_AGAIN_AFTER - 2):  # two replies have come since: a check's, and its own
        assert not trusted(node)
        bench.served(bench.ask(node, hcp2.Read(12)), after=REQUEST + TOOK)
    assert trusted(node)


def test_a_node_that_is_heard_late_while_another_is_asked_is_not_silent() -> None:
    bench = Bench()
    node, other = trained(bench, 1), trained(bench, 2)
    bench.ask(node)
    bench.ask(other, hcp2.Read(3))
    for request in (request_of(1), request_of(3, 2)):
        bench.until_sent()
        assert bench.sent() == request
    node.unheard = SILENT
    bench.hear(reply_of(1, 55), after=REQUEST + 0.002)
    bench.until_sent()
    assert node.unheard == 0


def test_a_reply_later_than_three_quarters_of_its_window_does_so_too() -> None:
    bench = Bench()
    node = trained(bench)
    bench.served(bench.ask(node), after=REQUEST + 0.8 * WINDOW)
    assert not trusted(node)


@pytest.mark.parametrize("writes_window", [TIMINGS.write.window, 2 * TIMINGS.write.window])
def test_a_node_that_has_always_been_as_slow_as_the_document_allows_is_trusted_all_the_same(
    writes_window: float,
) -> None:
    bench = Bench()
    slow = 0.9 * TIMINGS.read.window
    write = replace(TIMINGS.write, window=writes_window, max_reply_delay=writes_window)
    node = bench.arbiter.add_node(hcp2.PROFILE, 1, bench.now, Learned(replace(TIMINGS, write=write)))
    for number in range(TRUSTED_AFTER + 10):
        bench.served(bench.ask(node, hcp2.Read(10 + number % 2)), after=REQUEST + slow)
    assert trusted(node)
    assert learning(node).returns == 0
    bench.ask(node)
    bench.sent()
    waited = bench.until_sent()
    assert waited == pytest.approx(REQUEST + TIMINGS.read.window), (
        "no longer: for what is overdue the line does not wait"
    )


def test_a_node_that_was_away_begins_again() -> None:
    bench = Bench()
    node = trained(bench)
    returns = learning(node).returns
    bench.wait(2.0)
    for _ in range(3):
        bench.ask(node, retries=0)
        bench.sent()
        bench.until_ready()
    assert node.health is Health.DOWN
    for _ in range(2 * TRUSTED_AGAIN_AFTER):
        bench.served(bench.ask(node), after=REQUEST + TOOK)
    assert learning(node).returns == returns + 1
    assert not trusted(node)


def test_a_node_that_has_failed_is_awaited_for_as_long_as_the_document_says() -> None:
    bench = Bench()
    node = trained(bench)
    bench.ask(node, retries=0)
    bench.sent()
    bench.until_ready()
    assert node.health is Health.SUSPECT
    bench.ask(node, hcp2.Read(5), retries=2)
    assert bench.sent() == request_of(5)
    asked = bench.now
    bench.wait(REQUEST + MAX_REPLY_DELAY - 0.0001)
    assert node.counters.no_reply == 1
    bench.wait(0.0002)
    assert node.counters.no_reply == 2
    bench.until_ready()
    assert bench.now - asked < REQUEST + MAX_REPLY_DELAY + 0.001, "nothing is left to wait for"


@pytest.mark.parametrize("latency", [0.0, 0.005])
def test_r3_an_overdue_reply_near_its_max_reply_delay_raises_it_though_the_line_had_gone_on(latency: float) -> None:
    bench = Bench(latency=latency)
    node, other = trained(bench, 1), up(bench, 2)
    asked = bench.ask(node)
    bench.sent()
    out = bench.now + REQUEST
    bench.arbiter.cancel(asked, bench.now)
    while bench.now < out + 0.12:
        bench.served(bench.ask(other, hcp2.Read(6 + int(bench.now * 1000) % 2)), after=REQUEST + TOOK)
    bench.hear(reply_of(1, 5), after=0.005)
    received = bench.now
    bench.until_ready()
    raised = [event for event in bench.events if isinstance(event, MaxReplyDelayRaised)]
    assert [event.node for event in raised] == [node]
    assert raised[0].age == pytest.approx(received - out - 5 * TAU - latency)  # five bytes follow the first


@pytest.mark.parametrize(
    ("profile", "write", "read"),
    [
        (mentor.PROFILE, partial(mentor.Write, 1, 17), mentor.Read(1, 18)),
        (ct_ansi.PROFILE, partial(ct_ansi.Write, 1, 17), ct_ansi.Read(1, 18)),
        (ei_bisynch.PROFILE, partial(ei_bisynch.Write, "SL"), ei_bisynch.Read("PV")),
    ],
    ids=["mentor", "ct-ansi", "ei-bisynch"],
)
def test_the_line_waits_for_a_late_ack_where_it_would_be_a_command_to_another_node(
    profile: Profile, write: Callable[[int], Command[Any]], read: Command[Any]
) -> None:
    """A drive that has just replied sends its next parameter when it receives an ACK, from any sender."""
    bench = Bench()
    node = bench.arbiter.add_node(profile, 14, bench.now, LEARNED)
    other = bench.arbiter.add_node(profile, 25, bench.now)
    learning(node).begin_with([LearnedTimes("Write", False, 0.004, 0.004, 0.0, 0.020, True)])
    for _ in range(TRUSTED_AGAIN_AFTER + 1):
        written = bench.ask(node, write(5))
        bench.until_sent()
        bench.hear(ACK, after=REQUEST + TOOK)
        bench.until_ready()
        assert written.error is None
    assert trusted(node)
    late = bench.ask(node, write(6))
    assert late.timings().write == profile.timings.write, "no learned window, not even a long one"
    bench.ask(other, read)
    bench.until_sent()
    out = bench.now
    bench.sent()
    bench.until_sent()
    assert bench.now - out > profile.timings.write.max_reply_delay


def test_windows_are_not_learned_where_a_damaged_request_is_answered_with_another_element() -> None:
    """One flipped bit in HCP's read request, which has no checksum, and a late reply: another element's value."""
    bench = Bench()
    with pytest.raises(InvalidCommand, match="hcp: reply windows cannot be learned, because a read request"):
        bench.arbiter.add_node(hcp.PROFILE, 1, bench.now, LEARNED)


@pytest.mark.parametrize("took", [0.105, 0.140])
def test_a_node_that_is_always_later_than_the_documents_window_is_never_trusted_and_all_its_values_come(
    took: float,
) -> None:
    """No learned window exceeds the document's: this node would miss each."""
    bench = Bench()
    node = bench.arbiter.add_node(hcp2.PROFILE, 1, bench.now, LEARNED)
    for number in range(TRUSTED_AFTER + 20):
        read = bench.ask(node, hcp2.Read(10 + number % 2))
        bench.until_sent()
        bench.answer(after=REQUEST + took)
        assert (read.value, read.late) == (5.0, True)
    assert node.counters.no_reply == node.counters.garbled == 0
    assert learning(node).times(node.timings) == ()


def test_a_node_that_becomes_later_than_the_documents_window_misses_once_and_is_never_trusted_again() -> None:
    bench = Bench()
    node = trained(bench)
    missed = bench.ask(node, retries=0)
    bench.until_sent()
    bench.sent()
    bench.wait(REQUEST + 0.120)
    assert missed.error is not None, "learned windows end as ever"
    bench.hear(reply_of(1, 5))
    bench.until_ready()
    for number in range(60):
        read = bench.served(bench.ask(node, hcp2.Read(10 + number % 2)), after=REQUEST + 0.120)
        assert (read.value, read.attempts) == (5.0, 1)
