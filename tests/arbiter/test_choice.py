"""What goes next while something is overdue, and when too much was alike (R15, R7, R9)."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NoReturn

import pytest

from busmaster.arbiter.choice import MOST_BEFORE
from busmaster.arbiter.health import SILENT, Health
from busmaster.arbiter.transaction import Poll, Priority
from busmaster.contract.timing import Timings
from busmaster.errors import GarbledReply, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from tests.arbiter.bench import ACK, NAK, TAU, WRITE_5, Bench, lost, reply_of, request_of, up

REQUEST = 8 * TAU
URGENT, COMMAND, POLL, BACKGROUND = Priority
MOST_ALIKE = 32
WRITE_0 = "07 30 31 02 30 31 30 03 31"


def write(value: int = 5, *, idempotent: bool = False) -> hcp2.Write:
    return hcp2.Write(1, (value,), idempotent=idempotent)


def checks(bench: Bench) -> int:
    return bench.arbiter.statistics(bench.now).sync_reads


# the order of what waits


def test_r15_a_read_never_overtakes_a_write_to_its_node() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other, write(5))
    bench.hear("FF")
    asked = bench.ask(node, write(5))
    behind, beside = bench.ask(node, hcp2.Read(3)), bench.ask(other, hcp2.Read(4))
    bench.until_sent()
    assert bench.answer() == request_of(4, 2)
    assert bench.answer() == WRITE_5
    assert bench.answer() == request_of(3)
    assert (asked.error, beside.value, behind.value) == (None, 5.0, 5.0)


def test_r15_a_read_never_overtakes_a_write_to_its_node_that_waits_behind_others() -> None:
    bench = Bench()
    node, first, other = up(bench), up(bench, 2), up(bench, 3)
    lost(bench, node)
    bench.hear("FF")
    bench.ask(first)
    bench.ask(other, write())
    bench.ask(other, hcp2.Read(3))
    bench.until_sent()
    assert bench.sent() != request_of(3, 3), "the write to its node was asked for first"


def test_r15_a_write_overtakes_nothing() -> None:
    bench = Bench()
    node, other, third = up(bench), up(bench, 2), up(bench, 3)
    lost(bench, other)
    other.unheard = SILENT
    bench.ask(third, hcp2.Read(7))
    assert bench.sent() == request_of(7, 3)
    read, asked = bench.ask(node), bench.ask(third, write(5))
    bench.ask(node, hcp2.Read(4))
    bench.answer()
    assert bench.answer() == request_of(4)
    bench.until_sent()
    assert bench.answer() == request_of(1)
    assert bench.answer() == hcp2.Write(1, (5,)).open(3, hcp2.PROFILE.timings).request.hex(" ").upper()
    assert (read.value, asked.error) == (5.0, None)


def test_r15_a_lower_class_never_goes_first() -> None:
    """A check does, for it is quick and sure; what waits behind its class is neither."""
    bench = Bench()
    node = up(bench)
    lost(bench, node)
    bench.hear("FF")
    bench.ask(node)
    bench.ask(node, hcp2.Read(3), priority=POLL)
    bench.until_sent()
    assert [bench.answer() for _ in range(3)] == [request_of(2), request_of(1), request_of(3)]


def test_r15_before_one_that_was_held_back_go_two_that_wait_anyway_and_a_check_of_who_owes() -> None:
    """Nothing that goes before it proves anything: only the answer of the node that owes does."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other)
    bench.hear("FF")
    for element in (1, 3, 4, 5):
        bench.ask(node, hcp2.Read(element))
    bench.until_sent()
    assert [bench.answer(), bench.answer()] == [request_of(3), request_of(4)]
    bench.until_sent()
    assert bench.sent() == request_of(2, 2)
    bench.hear("FF", after=0.004)
    bench.until_sent()
    assert bench.sent() == request_of(1), "in vain: it goes, and its answer will be ambiguous"


def test_r15_nothing_is_picked_for_a_node_that_rests() -> None:
    """It was suspended since it was asked."""
    bench = Bench()
    node, other, third = up(bench), up(bench, 2), up(bench, 3)
    lost(bench, other)
    bench.hear("FF")
    bench.ask(node)
    resting = bench.ask(third, hcp2.Read(3))
    third.suspended_until = bench.now + 60.0
    bench.until_sent()
    assert (bench.sent(), resting.attempts) == (request_of(2, 2), 0)


def test_r12_what_has_waited_too_long_is_not_picked_either() -> None:
    bench = Bench()
    node = up(bench)
    lost(bench, node)
    bench.hear("FF")
    bench.ask(node)
    late = bench.ask(node, hcp2.Read(3), start_by=bench.now + 0.010)
    bench.until_sent()
    assert bench.answer() == request_of(2)
    assert late.attempts == 0


def test_r15_nothing_goes_before_another_to_a_node_that_rests() -> None:
    """Each rest is one of its own: dead, suspended, or waiting for the hook of its return."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    bench.ask(other, hcp2.Read(7))
    asked = bench.ask(node)
    proves, dispatcher = bench.arbiter.dispatcher.proves, bench.arbiter.dispatcher
    assert proves(asked, bench.now)
    node.health = Health.DOWN
    assert not proves(asked, bench.now)
    node.health = Health.UP
    node.holds = 1
    assert proves(asked, bench.now)  # the hook itself may ask the node
    asked.poll = Poll("fast", 0.1)
    assert not proves(asked, bench.now)
    dispatcher.release_node(node)
    assert proves(asked, bench.now)
    node.suspended_until = bench.now + 1.0
    assert not proves(asked, bench.now)
    assert proves(asked, node.suspended_until)


# checks


def test_r15_a_check_asks_a_node_that_answers_and_what_it_has_answered() -> None:
    bench = Bench()
    node, other = bench.node(1), up(bench, 2)
    bench.served(bench.ask(other, hcp2.Read(200)))
    lost(bench, node)
    bench.ask(node)
    assert bench.sent() == request_of(200, 2)


def test_r15_an_item_that_a_drive_has_answered_and_refuses_now_is_not_a_check_any_more() -> None:
    bench = Bench()
    node = up(bench)
    node.answered.clear()
    for element in (200, 201, 202):
        bench.served(bench.ask(node, hcp2.Read(element)))
    node.note_refused(hcp2.Read(201))
    assert [*node.sync_reads()][:2] == [hcp2.Read(200), hcp2.Read(202)]
    assert hcp2.Read(201) not in node.sync_reads()


def test_r15_a_check_is_not_asked_of_a_node_that_is_suspended() -> None:
    bench = Bench()
    node, other = bench.node(1), up(bench, 2)
    lost(bench, node)
    bench.arbiter.dispatcher.suspend(other, bench.now + 10.0)
    bench.ask(node)
    assert bench.sent() == request_of(2, 1)


def test_r15_a_refused_check_is_an_answer_and_is_asked_again() -> None:
    bench = Bench()
    node = up(bench)
    for _ in range(3):
        node.answered.clear()
        lost(bench, node, write(5))
        first = bench.ask(node, write(0))
        assert bench.sent() == request_of(1)
        bench.hear(NAK, after=0.002)
        bench.served(first)
        assert node.health is not Health.DOWN
        bench.wait(11.0)


def test_r15_a_check_that_another_requests_naks_seemed_to_refuse_can_still_prove_something() -> None:
    """Where none is left that is unlike what is overdue, the line would take an overdue reply for the next one."""
    bench = Bench()
    node = up(bench)
    for _ in range(4):
        node.answered.clear()
        lost(bench, node, write(5))
        write_after = bench.ask(node, write(0))
        for _ in range(2):  # a check is asked for twice, as any read is that is refused
            bench.until_sent()
            assert bench.sent().split()[-2] == "05", "a read"
            bench.hear(NAK, after=0.004)
        bench.served(write_after)
        bench.wait(11.0)
        assert set(node.sync_reads()) >= set(hcp2.PROFILE.sync_reads)


def test_r15_what_a_node_has_refused_for_certain_is_no_check() -> None:
    bench = Bench()
    node = up(bench)
    refused = bench.ask(node, hcp2.Read(1))
    while refused.error is None:
        bench.until_sent()
        bench.sent()
        bench.hear(NAK, after=0.004)
    node.answered.clear()
    lost(bench, node, write(5))
    bench.ask(node, write(0))
    assert bench.sent() == request_of(2)
    assert hcp2.Read(1) not in node.sync_reads()
    bench.served(bench.ask(node, hcp2.Read(1)))
    assert hcp2.Read(1) in node.sync_reads()


def test_r15_nobody_waits_for_a_check_and_nothing_counts_it() -> None:
    bench = Bench()
    node = up(bench)
    lost(bench, node)
    bench.events.clear()
    read = bench.ask(node)
    counted = (node.counters.failed, node.counters.unheard)
    assert bench.answer() == request_of(2)
    bench.answer()
    assert [bench.ended(read), len(bench.events)] == [1, 1]
    assert (node.counters.failed, node.counters.unheard) == counted
    assert bench.arbiter.statistics(bench.now).waits[BACKGROUND].count == 0


def test_r15_where_nothing_can_be_asked_that_is_unlike_the_line_resynchronises_and_goes_on() -> None:
    bench = Bench()
    node = bench.node(profile=replace(hcp2.PROFILE, sync_reads=()))
    lost(bench, node)
    read = bench.ask(node, retries=0)
    if not bench.asked:
        bench.until_sent()
    assert bench.sent() == request_of(1)
    bench.answer(7)
    assert not bench.ended(read), "it may be the reply that never came: its own would follow"
    bench.wait(0.150)
    assert read.value == 7.0


def test_r15_of_two_replies_where_the_overdue_one_was_forgiven_neither_is_believed() -> None:
    bench = Bench()
    node = bench.node(profile=replace(hcp2.PROFILE, sync_reads=()))
    lost(bench, node)
    read = bench.ask(node, retries=0)
    bench.until_sent()
    bench.hear(reply_of(1, 55), after=REQUEST + 0.004)
    bench.hear(reply_of(1, 7), after=0.090)
    assert (bench.ended(read), read.value) == (1, None)
    assert isinstance(read.error, GarbledReply)


def test_r15_one_reply_that_stood_alone_is_enough_for_those_that_follow() -> None:
    bench = Bench()
    node = bench.node(profile=replace(hcp2.PROFILE, sync_reads=()))
    lost(bench, node)
    bench.ask(node)
    bench.until_sent()
    bench.answer()
    bench.wait(0.150)
    following = bench.ask(node)
    bench.answer(8)
    assert following.value == 8.0


def test_r15_probes_that_can_only_ask_one_thing_find_a_node_that_is_back() -> None:
    bench = Bench()
    node = bench.node(profile=replace(hcp2.PROFILE, sync_reads=()))
    lost(bench, node)
    for _ in range(4):
        bench.until_sent()
        assert bench.sent() == request_of(1)
        bench.wait(0.2)
    bench.until_sent()
    bench.answer()
    bench.wait(0.150)
    assert node.health is Health.UP


# urgent writes


def test_r15_an_urgent_write_is_sent_at_once_and_repeated_behind_a_check_where_it_may_be() -> None:
    """`disable()` right after an unanswered write: the ACK may be that write's; or its own, and that one's is still to
    come. So both nodes are checked."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other, write(5))
    disable = bench.ask(node, write(0, idempotent=True), priority=URGENT, retries=2)
    assert bench.sent() == WRITE_0
    bench.hear(ACK, after=REQUEST + 0.004)
    assert not bench.ended(disable)
    checked = []
    bench.until_sent()
    while (sent := bench.answer()) != WRITE_0:
        checked.append(sent)
        bench.until_sent()
    assert checked == [request_of(1, 2), request_of(1)]
    assert (bench.ended(disable), disable.error) == (1, None)


def test_r15_an_urgent_write_that_may_not_be_repeated_is_unconfirmed_after_an_ack_that_could_be_anothers() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other, write(5))
    disable = bench.ask(node, write(0), priority=URGENT)
    assert bench.sent() == WRITE_0
    bench.hear(ACK, after=REQUEST + 0.004)
    assert isinstance(disable.error, WriteUnconfirmed)
    assert disable.attempts == 1


def test_r15_an_urgent_write_is_sent_as_soon_as_the_line_has_resynchronised() -> None:
    bench = Bench()
    node = up(bench)
    bench.ask(node, write(5))
    bench.sent()
    bench.ask(node, write(0, idempotent=True), priority=URGENT)
    assert bench.until_sent() == pytest.approx(9 * TAU + 0.150 + TAU)
    assert bench.sent() == WRITE_0


def test_r15_an_ack_that_is_late_confirms_no_urgent_write_however_often_it_is_asked() -> None:
    """One ACK was lost; whatever is said of it, one write more is ACKed than was believed."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other, write(5))
    stop = bench.ask(node, write(0), priority=URGENT)
    bench.sent()
    bench.hear(ACK, after=0.001)
    again = bench.ask(node, write(0), priority=URGENT)
    bench.until_sent()
    assert bench.sent() == WRITE_0
    bench.hear(ACK, after=0.001)
    assert isinstance(stop.error, WriteUnconfirmed)
    assert isinstance(again.error, WriteUnconfirmed)


# one answer like another


def saturated(bench: Bench, count: int, *, pause: float = 0.0) -> list[str]:
    """What goes out while that many equal reads are answered."""
    node = up(bench)
    wanted = [bench.ask(node) for _ in range(2)]
    sent = []
    while len(wanted) < count:
        sent.append(bench.answer())
        if pause:
            bench.until_ready()
            bench.wait(pause)
        wanted.append(bench.ask(node))
    return sent


def test_r15_after_32_answers_alike_without_a_pause_an_unlike_one_is_asked() -> None:
    """One doubled reply would leave every later value wrong, with nothing overdue and no unexpected byte to be seen."""
    sent = saturated(Bench(), 4 * MOST_ALIKE)
    unlike = [place for place, request in enumerate(sent) if request != request_of(1)]
    assert unlike
    assert unlike[0] <= MOST_ALIKE
    assert {later - earlier for earlier, later in pairwise(unlike)} == {MOST_ALIKE}


def test_r15_no_write_is_asked_in_order_to_show_that_a_line_is_in_sync() -> None:
    """An ACK may be anybody's; and one reply too many, which a read meets and is repeated, leaves it unconfirmed."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    for _ in range(MOST_ALIKE + 2):
        bench.ask(node)
    write_to_other = bench.ask(other, write(5))
    bench.ask(node, hcp2.Read(3))
    sent = [bench.answer() for _ in range(MOST_ALIKE + 1)]
    assert set(sent) == {request_of(1), request_of(3)}
    bench.served(write_to_other)
    assert write_to_other.error is None


def test_r15_no_read_whose_answer_would_not_be_believed_is_asked_in_order_to_show_that_a_line_is_in_sync() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other, hcp2.Read(3))
    for _ in range(MOST_ALIKE + 2):
        bench.ask(node)
    bench.ask(node, hcp2.Read(3))
    sent = [bench.answer() for _ in range(MOST_ALIKE + 1)]
    assert set(sent) == {request_of(1), request_of(2)}, "a check, in place of the one that waits"
    assert bench.arbiter.statistics(bench.now).ambiguous == 0


def test_r15_a_pause_longer_than_the_max_reply_delay_needs_no_check() -> None:
    """In it one reply too many would have shown."""
    bench = Bench()
    node = up(bench)
    for _ in range(3 * MOST_ALIKE):
        bench.wait(0.160)
        bench.ask(node)
        assert bench.answer() == request_of(1)
    assert checks(bench) == 0


@pytest.mark.parametrize("pause", [0.080, 0.130])
def test_r15_pauses_shorter_than_the_max_reply_delay_are_no_proof(pause: float) -> None:
    """A reply too many may come late, as any other may."""
    bench = Bench()
    node = up(bench)
    for _ in range(MOST_ALIKE + 2):
        bench.wait(pause)
        read = bench.ask(node)
        bench.served(read)
    assert checks(bench) == 1


def test_r15_after_one_doubled_reply_among_equal_reads_at_most_32_values_are_another_requests() -> None:
    """Every reply comes at once; the first is said twice, so that each later one answers the request before its own."""
    bench = Bench()
    node = up(bench)
    waiting = [bench.ask(node) for _ in range(3)]
    on_the_way = [reply_of(1, 0)]
    values: list[tuple[float, int]] = []
    count = 0
    while count < 200:
        if request := bench.sent():
            count += 1
            on_the_way.append(reply_of(int(bytes.fromhex(request)[4:6], 16), count))
            waiting.append(bench.ask(node))
        if on_the_way:
            bench.hear(on_the_way.pop(0), after=0.004)
        else:
            bench.to(bench.arbiter.poll_timeout())
        values += [(read.value, count) for read in waiting if bench.ended(read) and read.value is not None]
        waiting = [read for read in waiting if not bench.ended(read)]
    wrong = [pair for pair in values if pair[0] != pair[1]]
    assert 0 < len(wrong) <= MOST_ALIKE
    assert len(values) > 120


def test_r15_a_node_that_owes_what_it_is_to_be_asked_for_is_asked_something_else_first() -> None:
    """Another node's answer has shown that the line is in sync, but for this node's own: that would not be believed."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, node)
    node.unheard = SILENT - 1
    bench.served(bench.ask(other, hcp2.Read(3)))
    bench.wait(0.010)
    read = bench.ask(node)
    bench.until_sent()
    assert bench.answer() == request_of(2), "a check, of that node"
    bench.until_sent()
    assert bench.answer(7) == request_of(1)
    assert read.value == 7.0


def test_r15_a_node_that_is_likely_to_be_dead_is_not_asked_something_else_first() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, node)
    node.unheard = SILENT
    bench.served(bench.ask(other, hcp2.Read(3)))
    bench.wait(0.010)
    bench.ask(node)
    bench.until_sent()
    assert bench.sent() == request_of(1)


def test_r15_three_answers_of_a_node_that_prove_nothing_are_enough_and_it_is_asked_what_it_was_to_be() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, node)
    node.unheard = SILENT
    bench.served(bench.ask(other, hcp2.Read(3)))
    node.unheard = 0
    bench.until_ready()
    bench.ask(node)
    asked = []
    while request_of(1) not in asked:
        bench.until_sent()
        asked.append(bench.sent())
        bench.hear("FF", after=0.004)
    assert len(asked) == 1 + MOST_BEFORE


def test_r15_after_something_was_said_twice_what_is_unlike_keeps_its_order() -> None:
    bench = Bench()
    node = up(bench)
    bench.hear(reply_of(1, 5))
    bench.until_ready()
    for element in (3, 4, 5):
        bench.ask(node, hcp2.Read(element))
    assert [bench.answer() for _ in range(3)] == [request_of(element) for element in (3, 4, 5)]


def test_r15_after_something_was_said_twice_answers_alike_are_not_asked_for_in_a_row_where_there_is_a_choice() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    bench.hear(reply_of(1, 5))
    bench.until_ready()
    bench.ask(node, hcp2.Read(3))
    bench.ask(other, hcp2.Read(3))
    bench.ask(node, hcp2.Read(4))
    assert [bench.answer(), bench.answer(), bench.answer()] == [request_of(3), request_of(4), request_of(3, 2)]


class Unencodable(hcp2.Read):
    """A bug of a protocol."""

    def open(self, address: int, timings: Timings) -> NoReturn:
        raise RuntimeError("not encoded")


def test_r15_a_read_that_cannot_be_encoded_is_not_chosen_to_go_first_and_fails_when_its_turn_comes() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other, write(5))
    bench.hear("FF")
    first, broken, beside = bench.ask(node, write(5)), bench.ask(other, Unencodable(3)), bench.ask(other, hcp2.Read(4))
    bench.until_sent()
    assert bench.answer() == request_of(4, 2)
    assert bench.answer() == WRITE_5
    bench.wait(0.1)
    assert (first.error, beside.value) == (None, 5.0)
    assert "could not encode it" in str(broken.error)
