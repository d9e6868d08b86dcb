"""Which replies are overdue, what pays for them, and what goes meanwhile (R15)."""

from __future__ import annotations

from collections.abc import Callable

import pytest

from busmaster.arbiter.health import SILENT, NodeRecord
from busmaster.arbiter.in_sync import MOST_REMEMBERED, InSync
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.errors import GarbledReply, NoReply, Refused, WriteUnconfirmed
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import (
    ACK,
    MAX_REPLY_DELAY,
    NAK,
    TAU,
    WRITE_5,
    Bench,
    lost,
    reply_of,
    request_of,
    right_answer,
    up,
)

REQUEST = 8 * TAU
URGENT, COMMAND, POLL, BACKGROUND = Priority


def write_of(value: int, node: int = 1) -> str:
    return hcp2.Write(1, (value,)).open(node, hcp2.PROFILE.timings).request.hex(" ").upper()


def write(value: int = 5, *, idempotent: bool = False) -> hcp2.Write:
    return hcp2.Write(1, (value,), idempotent=idempotent)


def checks(bench: Bench) -> int:
    return bench.arbiter.statistics(bench.now).sync_reads


def ambiguous(bench: Bench) -> int:
    return bench.arbiter.statistics(bench.now).ambiguous


def confirmed_behind_checks(bench: Bench, asked: Transaction, request: str) -> None:
    """The write is sent when checks have proved that the line is in sync, and its ACK is its own."""
    bench.until_sent()
    assert bench.sent() != request, "nothing is proved yet"
    while bench.asked != request:
        assert not bench.ended(asked)
        bench.answer()
        bench.until_sent()
        bench.sent()
    bench.answer()
    assert (bench.ended(asked), asked.error) == (1, None)


# what is overdue is not believed


def test_r15_a_reply_that_comes_long_after_its_max_reply_delay_is_never_taken_for_the_next_one() -> None:
    bench = Bench()
    node = up(bench)
    lost(bench, node)
    following = bench.ask(node)
    assert bench.sent() == request_of(2), "a check: its answer cannot be the one that is overdue"
    bench.hear(reply_of(1, 55), after=0.002)
    assert following.value is None
    bench.until_sent()
    assert bench.sent() == request_of(1)
    bench.answer(7)
    assert following.value == 7.0


def test_r15_what_waits_anyway_goes_first_if_it_proves_as_much_as_a_check() -> None:
    """Noise makes them wait for the line together."""
    bench = Bench()
    node = up(bench)
    lost(bench, node)
    bench.hear("FF")
    same, unlike = bench.ask(node), bench.ask(node, hcp2.Read(3))
    bench.until_sent()
    assert bench.sent() == request_of(3)
    bench.answer(33)
    assert bench.sent() == request_of(1)
    bench.answer(11)
    assert (unlike.value, same.value, checks(bench)) == (33.0, 11.0, 0)


def test_r15_a_retry_waits_for_what_waits_in_its_class_and_for_no_check() -> None:
    bench = Bench()
    node = up(bench)
    read, other = bench.ask(node), bench.ask(node, hcp2.Read(2))
    bench.sent()
    bench.until_sent()
    assert bench.sent() == request_of(2)
    bench.answer()
    assert bench.sent() == request_of(1)
    bench.answer(7)
    assert (read.value, other.value, checks(bench)) == (7.0, 5.0, 0)


def test_r15_a_read_is_the_check_after_an_unanswered_write() -> None:
    bench = Bench()
    node = up(bench)
    lost(bench, node, write(5))
    following = bench.ask(node, write(6))
    assert bench.sent() == request_of(1), "a read that it has answered before"
    bench.hear(ACK, after=0.002)
    assert following.error is None, "the first write's ACK is nobody's"
    confirmed_behind_checks(bench, following, write_of(6))


def test_r15_a_retry_owes_to_itself() -> None:
    """The ACK of the first attempt says nothing of the second, which a drive may have refused since."""
    bench = Bench()
    node = up(bench)
    again = bench.ask(node, write(5), idempotent=True, retries=1)
    assert bench.sent() == WRITE_5
    assert bench.until_sent() > 0.150
    assert bench.sent() == request_of(1)
    bench.hear(ACK, after=0.002)
    assert not bench.ended(again)
    confirmed_behind_checks(bench, again, WRITE_5)


# what pays


@pytest.mark.parametrize("delay", [0.102, 0.149])
def test_r15_an_overdue_reply_is_paid_by_its_own_reply_as_unexpected_bytes(delay: float) -> None:
    bench = Bench()
    node = up(bench)
    bench.ask(node, retries=0)
    bench.sent()
    bench.hear(reply_of(1, 5), after=REQUEST + delay)
    bench.until_ready()
    bench.ask(node)
    assert bench.sent() == request_of(1)
    assert checks(bench) == 0


def test_r15_an_overdue_reply_is_paid_by_its_own_reply_on_an_idle_line_however_late() -> None:
    bench = Bench()
    node = up(bench)
    lost(bench, node)
    bench.hear(reply_of(1, 5), after=3.0)
    bench.until_ready()
    bench.ask(node)
    assert bench.sent() == request_of(1)


@pytest.mark.parametrize("behind", [[], [2], [2, 3]])
def test_r15_an_ack_and_the_replies_behind_it_pay_what_is_overdue(behind: list[int]) -> None:
    overdue = [bytes.fromhex(reply_of(element, 5)) for element in behind]
    in_sync = InSync()
    node = up(Bench())
    for key in (bytes.fromhex(ACK), *overdue):
        in_sync.add_overdue((key,), node, 0.0, 0.15)
    payer = in_sync.heard(bytes.fromhex(ACK) + b"".join(overdue), 1.0)
    assert payer is not None
    assert payer.node is node
    assert in_sync.overdue_replies == []


@pytest.mark.parametrize("bytewise", [False, True])
def test_r15_an_overdue_reply_is_paid_by_its_own_reply_in_place_of_another(bytewise: bool) -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, node)
    third = bench.ask(other, hcp2.Read(3), retries=0)
    bench.sent()
    (bench.hear_bytewise if bytewise else bench.hear)(reply_of(1, 55), 0.002)
    assert isinstance(third.error, GarbledReply)
    bench.until_ready()
    before = checks(bench)
    read = bench.ask(node)
    assert bench.sent() == request_of(1), "element 3 is overdue now, and nothing else"
    assert checks(bench) == before
    bench.answer(7)
    assert read.value == 7.0


def test_r15_a_wrong_echo_that_is_not_whole_yet_pays_nothing_before_the_silence() -> None:
    """Its first bytes come; the rest is held up. An urgent read goes no sooner than the silence after the last one."""
    bench = Bench()
    node = up(bench)
    lost(bench, node)
    bench.ask(node, hcp2.Read(3), retries=0)
    bench.sent()
    bench.hear("02 30 31", after=0.100)
    bench.ask(node, priority=URGENT)
    assert bench.sent() == ""
    bench.hear("35 03 37", after=0.040)
    assert bench.sent() == ""
    assert bench.until_sent() == pytest.approx(0.020 + TAU)
    assert bench.sent() == request_of(1)


def test_r15_an_overdue_reply_is_paid_by_the_owing_nodes_answer_to_something_else() -> None:
    """A node answers in the order in which it was asked."""
    bench = Bench()
    node = up(bench)
    lost(bench, node)
    bench.served(bench.ask(node, hcp2.Read(3)))
    before = checks(bench)
    read = bench.ask(node)
    assert bench.sent() == request_of(1)
    bench.answer(7)
    assert (read.value, checks(bench)) == (7.0, before)


def test_r15_an_overdue_reply_is_paid_by_any_nodes_answer_once_its_max_reply_delay_is_over() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, node)
    node.unheard = SILENT
    bench.served(bench.ask(other, hcp2.Read(3)))
    read = bench.ask(other)
    bench.until_sent()
    assert bench.sent() == request_of(1, 2)
    bench.answer(7)
    assert (read.value, checks(bench)) == (7.0, 0)


def test_r15_what_another_node_has_paid_could_still_be_an_answer_of_its_own_node_which_is_checked_itself() -> None:
    """Two that were held up together and let go together may answer in either order."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, node)
    bench.served(bench.ask(other, hcp2.Read(3)))
    read = bench.ask(node)
    bench.until_sent()
    assert bench.answer() == request_of(2), "a check, of that node"
    bench.until_sent()
    assert bench.answer(7) == request_of(1)
    assert (read.value, ambiguous(bench)) == (7.0, 0)


def test_r15_an_overdue_reply_lapses_ten_seconds_after_its_request() -> None:
    for waited, due in ((9.7, request_of(2)), (10.1, request_of(1))):
        bench = Bench()
        node = up(bench)
        lost(bench, node)
        bench.wait(waited - 0.151)
        bench.ask(node)
        assert bench.sent() == due


def test_r15_what_is_overdue_outlives_a_lost_port() -> None:
    """The bytes lie in the network, or in the adapter, and come when the port is back."""
    bench = Bench()
    node = up(bench)
    bench.ask(node)
    bench.sent()
    bench.arbiter.line_down("unplugged", bench.now)
    bench.arbiter.line_up(bench.now + 1.0)
    bench.to(bench.now + 1.0)
    read = bench.ask(node)
    bench.until_sent()
    assert bench.sent() == request_of(2)
    bench.hear(reply_of(1, 55), after=0.002)
    bench.until_sent()
    assert bench.sent() == request_of(1)
    bench.answer(7)
    assert read.value == 7.0


def echoing() -> tuple[Bench, NodeRecord]:
    """A line that echoes, and a node that has answered element 2 on it."""
    bench = Bench(echo=True)
    node = bench.node()
    echoed(bench, bench.ask(node, hcp2.Read(2)), answered_after=0.004)
    return bench, node


def echoed(bench: Bench, asked: Transaction, answered_after: float) -> None:
    """It is asked, its request echoes whole, and it is answered after so many seconds."""
    request = bench.sent()
    bench.hear(request, after=REQUEST)
    bench.hear(right_answer(request), answered_after)
    bench.until_ready()
    assert bench.ended(asked)


def test_r15_what_is_left_of_our_own_request_pays_nothing() -> None:
    """The end of a write to element 1, whose echo was damaged, looks like a reply of element 1."""
    bench, node = echoing()
    bench.ask(node, retries=0)
    bench.hear(bench.sent(), after=REQUEST)
    bench.until_ready()
    bench.ask(node, write(5))
    assert bench.sent() == WRITE_5, "an ACK is not overdue"
    bench.hear("FF")
    bench.hear(WRITE_5[3:], after=0.002)
    following = bench.ask(node)
    bench.until_sent()
    assert bench.sent() == request_of(2), "a check: element 1 is overdue still"
    bench.hear(bench.asked, after=REQUEST)
    bench.hear(reply_of(1, 55), after=0.002)
    assert following.value is None


def test_r15_replies_pay_again_once_an_echo_has_come_whole() -> None:
    bench, node = echoing()
    bench.ask(node, retries=0)
    bench.sent()
    bench.hear("FF", after=0.002)
    bench.until_ready()
    echoed(bench, bench.ask(node, hcp2.Read(3), retries=0), answered_after=0.120)
    before = checks(bench)
    bench.ask(node, hcp2.Read(3))
    assert (bench.sent(), checks(bench)) == (request_of(3), before), "an overdue reply has paid for it"


# an overdue reply that another node's answer paid


def overtaken(bench: Bench) -> NodeRecord:
    """Two nodes that are UP; the first owes element 1, and the other, that is returned, has paid by its answer."""
    node, other = up(bench), up(bench, 2)
    lost(bench, node)
    node.unheard = SILENT
    bench.served(bench.ask(other, hcp2.Read(3)))
    return other


def test_r15_after_another_node_has_paid_a_like_answer_that_is_slower_than_ever_is_not_believed() -> None:
    bench = Bench()
    read = bench.ask(overtaken(bench))
    bench.until_sent()
    assert bench.sent() == request_of(1, 2)
    bench.hear(reply_of(1, 55), after=REQUEST + 0.012)
    assert (read.value, ambiguous(bench)) == (None, 1)


def test_r15_after_another_node_has_paid_a_prompt_answer_is_believed() -> None:
    bench = Bench()
    read = bench.ask(overtaken(bench))
    bench.until_sent()
    bench.sent()
    bench.hear(reply_of(1, 7), after=REQUEST + 0.004)
    assert (read.value, ambiguous(bench)) == (7.0, 0)


@pytest.mark.parametrize(("delays", "value"), [(2.5, None), (3.0, 7.0)])
def test_r15_the_ambiguity_is_over_after_three_times_the_max_reply_delay(delays: float, value: float | None) -> None:
    bench = Bench()
    other = overtaken(bench)
    bench.wait(0.010 + delays * 0.152)
    read = bench.ask(other)
    bench.until_sent()
    bench.sent()
    bench.hear(reply_of(1, 7), after=REQUEST + 0.040)
    assert (read.value, ambiguous(bench)) == (value, value is None)


def test_r15_of_two_answers_in_one_chunk_where_one_may_be_another_nodes_neither_is_believed() -> None:
    bench = Bench()
    read = bench.ask(overtaken(bench))
    bench.until_sent()
    bench.sent()
    bench.hear(reply_of(1, 55) + reply_of(1, 7), after=REQUEST + 0.003)
    assert (read.value, ambiguous(bench)) == (None, 1)


def test_r15_an_ambiguous_answer_with_anything_behind_it_is_not_believed() -> None:
    bench = Bench()
    node = overtaken(bench)
    node.unheard = SILENT - 1
    read = bench.ask(node)
    bench.until_sent()
    bench.sent()
    bench.hear(reply_of(1, 55) + "FF", after=REQUEST + 0.003)
    assert (read.value, ambiguous(bench)) == (None, 1)
    assert node.unheard == 0, "it is alive, and worth a check"


@pytest.mark.parametrize(
    ("command", "reply"), [(hcp2.Read(1), reply_of(1, 55)), (hcp2.Write(1, (5,)), ACK)], ids=["read", "write"]
)
def test_r15_of_two_answers_in_one_chunk_neither_is_believed_though_nothing_is_overdue(
    command: hcp2.Read | hcp2.Write, reply: str
) -> None:
    bench = Bench()
    asked = bench.ask(up(bench), command, retries=0)
    bench.sent()
    bench.hear(reply + reply, after=REQUEST + 0.003)
    assert asked.value is None
    assert isinstance(asked.error, WriteUnconfirmed if command.writes else GarbledReply)


def asked_alike(bench: Bench) -> tuple[Transaction, NodeRecord]:
    """A read on the wire whose answer is like one that was delivered a moment ago."""
    node = up(bench)
    bench.arbiter._in_sync.note_answered((bytes.fromhex("023031"),), bench.now)
    read = bench.ask(node, retries=0)
    assert bench.sent() == request_of(1)
    return read, node


def test_r15_strictly_an_ambiguous_answer_is_held_until_another_would_have_come() -> None:
    bench = Bench(strict=True)
    read, node = asked_alike(bench)
    asked = bench.now
    bench.hear(reply_of(1, 7), after=REQUEST + 0.002)
    held_until = asked + REQUEST + node.latest(0.1) + 2 * TAU  # a second one would have come, with its first byte
    bench.to(held_until - TAU / 2)
    assert not bench.ended(read)
    bench.to(held_until + 0.001)
    assert (read.value, bench.ended(read)) == (7.0, 1)


def test_r15_strictly_a_second_answer_takes_the_first_one_with_it() -> None:
    bench = Bench(strict=True)
    read, _ = asked_alike(bench)
    bench.hear(reply_of(1, 55), after=REQUEST + 0.002)
    bench.hear(reply_of(1, 7), after=0.001)
    assert (read.value, ambiguous(bench)) == (None, 1)


# acknowledgements and refusals are the same from everybody


def test_r15_a_refusal_is_not_certain_while_something_is_overdue() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other, write(5))
    refused = bench.ask(node, hcp2.Read(3), retries=0)
    assert bench.sent() == request_of(3)
    bench.hear(NAK, after=0.002)
    assert not isinstance(refused.error, Refused)


def test_r15_a_write_is_not_refused_by_what_may_be_another_nodes_nak() -> None:
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    lost(bench, other)
    asked = bench.ask(node, write(5))
    assert bench.sent() == WRITE_5, "an ACK is not what is overdue"
    bench.hear(NAK, after=0.002)
    assert isinstance(asked.error, WriteUnconfirmed)


@pytest.mark.parametrize("heard", ["02 30 32 35", "FF", "02 30 31 31 35 03 41"])
def test_r15_the_tail_of_a_garbled_reply_never_confirms_a_write(heard: str) -> None:
    """Its checksum may be 06, and held up until the write is on the wire."""
    bench = Bench()
    node, other = up(bench), up(bench, 2)
    bench.ask(other, retries=0)
    bench.sent()
    bench.hear(heard, after=0.003)
    asked = bench.ask(node, write(5))
    bench.until_sent()
    assert bench.sent() != WRITE_5
    bench.hear(ACK, after=0.002)
    assert not bench.ended(asked)
    confirmed_behind_checks(bench, asked, WRITE_5)


def test_r15_an_unanswered_check_costs_the_first_one_no_more_than_its_max_reply_delay() -> None:
    """With nothing that proves anything the line resynchronises as in R3, and then goes on."""
    bench = Bench()
    node = up(bench)
    read = bench.ask(node, retries=1)
    start = bench.now
    asked = []
    while not bench.ended(read):
        bench.until_sent()
        asked.append(bench.sent())
        bench.wait(MAX_REPLY_DELAY + REQUEST - 0.0001)
        bench.to(bench.arbiter.poll_timeout())
    assert asked == [request_of(1), request_of(2), request_of(1)]
    assert isinstance(read.error, NoReply)
    assert bench.now - start < 3 * (REQUEST + 0.150 + TAU) + 0.01


def test_r15_what_a_node_overdue_that_was_removed_is_not_believed_of_it_once_it_is_added_again() -> None:
    removed, again, other = (
        NodeRecord(hcp2.PROFILE, address, hcp2.PROFILE.timings, 0, "the line") for address in (9, 9, 5)
    )
    overdue = InSync()
    overdue.add_overdue((b"\x02reply",), removed, 0.0, 0.1)
    overdue.answered(other, 1.0, 1.1, 0.0)
    assert not overdue.clashes((b"\x02reply",), 5.0, other), "the channel keeps the order"
    assert overdue.clashes((b"\x02reply",), 5.0, again)
    overdue.answered(again, 6.0, 6.1, 0.0)
    assert not overdue.overdue_replies, "a node answers in the order in which it was asked"


def with_one_answered(bench: Bench) -> NodeRecord:
    """A unit of MSC that has answered."""
    node = bench.node(1, msc.PROFILE)
    bench.wait(2.0)
    bench.ask(node, msc.DataRead(2008))
    bench.sent()
    bench.hear(f"{ACK} 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D", after=0.1)
    bench.sent()
    return node


def with_one_overdue(bench: Bench) -> NodeRecord:
    """A unit of MSC that has answered, and then did not answer: its ACK, or its NAK, may still come."""
    node = with_one_answered(bench)
    bench.ask(node, msc.DataRead(2008), retries=0)
    bench.until_sent()
    bench.sent()
    return node


@pytest.mark.parametrize("idempotent", [False, True])
def test_r15_a_write_is_not_sent_again_for_a_nak_that_may_be_anothers(idempotent: bool) -> None:
    """Two writes have two ACKs, and the second one would confirm the next write."""
    bench = Bench()
    node = with_one_overdue(bench)
    urgent = bench.ask(node, msc.DataWrite(2024, 5), priority=Priority.URGENT, idempotent=idempotent)
    bench.until_sent()
    bench.sent()
    bench.hear(NAK, after=0.010)
    assert not bench.sent()
    if idempotent:  # in an exchange of its own, behind a sync read
        assert not bench.ended(urgent)
    else:
        assert isinstance(urgent.error, WriteUnconfirmed)


def test_r15_a_sync_read_is_not_sent_again_for_a_nak_that_may_be_overdue() -> None:
    """Its two replies would be under way, and one accounted for: the other would confirm a write to another unit."""
    bench = Bench()
    node = with_one_overdue(bench)
    bench.ask(node, msc.DataWrite(2024, 5))
    bench.until_sent()
    assert bench.sent() == "02 01 00 07 00 00 52 51 53 54 41 54 2C 02 13", "a read goes first"
    bench.hear(NAK, after=0.010)
    assert not bench.sent()


def test_r15_a_nak_with_nothing_overdue_is_answered_with_the_same_request() -> None:
    bench = Bench()
    node = bench.node(1, msc.PROFILE)
    bench.wait(2.0)
    asked = bench.ask(node, msc.DataWrite(2024, 5))
    request = bench.sent()
    bench.hear(NAK, after=0.010)
    assert bench.sent() == request
    bench.hear(ACK, after=0.010)
    assert (bench.ended(asked), asked.error) == (1, None)


def test_r15_an_ack_that_may_be_overdue_leaves_the_one_of_its_request_to_come() -> None:
    """The ACK of an earlier write, nearly ten seconds late, begins the packet's step of a read. The write's ACK is no
    longer overdue then, but the read's is: it does not confirm the next write."""
    bench = Bench()
    node = with_one_answered(bench)
    bench.ask(node, msc.DataWrite(2024, 5))
    bench.sent()
    bench.wait(9.5)
    bench.ask(node, msc.DataRead(2008))
    bench.sent()
    bench.hear(ACK, after=0.050)
    bench.until_sent()
    assert bench.sent() == ACK, "the exchange ends without its packet"
    following = bench.ask(node, msc.DataWrite(2024, 6))
    bench.until_sent()
    bench.sent()
    bench.hear(ACK, after=0.001)
    assert not bench.ended(following)


# a caller that has gone (R6)


def cancelled(bench: Bench, write: Transaction) -> None:
    bench.arbiter.cancel(write, bench.now)


def superseded(bench: Bench, write: Transaction) -> None:
    bench.ask(write.node, msc.DataWrite(2024, 0), priority=Priority.URGENT, idempotent=True)


def out_of_time(bench: Bench, write: Transaction) -> None:
    bench.wait(0.060)


@pytest.mark.parametrize("leave", [cancelled, superseded, out_of_time])
def test_r6_a_nak_does_not_repeat_a_write_whose_caller_has_gone(leave: Callable[[Bench, Transaction], None]) -> None:
    bench = Bench()
    node = bench.node(1, msc.PROFILE)
    bench.wait(2.0)
    write = bench.ask(node, msc.DataWrite(2024, 5), idempotent=True, finish_by=bench.now + 0.050)
    request = bench.sent()
    bench.wait(0.010)
    leave(bench, write)
    bench.hear(NAK, after=0.010)
    assert bench.sent() != request
    bench.wait(3.0)
    assert bench.sent() != request


# a node that may be sent nothing


@pytest.mark.parametrize("suspended", [False, True], ids=["removed", "suspended"])
def test_r15_a_node_that_may_be_sent_nothing_is_sent_nothing_though_its_reply_is_overdue(suspended: bool) -> None:
    """The label of a removed node may have gone from the file, its address may be another drive's by now. A suspended
    node may be switched off. Another node's reply clears what is overdue of it."""
    bench = Bench()
    gone, other = up(bench, 9), up(bench, 5)
    lost(bench, gone)
    if suspended:
        bench.arbiter.dispatcher.suspend(gone, bench.now + 60.0)
    else:
        bench.arbiter.remove_node(gone)
    asked = bench.ask(other)
    sent = []
    while not bench.ended(asked):
        bench.until_sent()
        sent.append(bench.answer())
    assert asked.error is None
    assert not [request for request in sent if request.startswith("07 30 39")], "a request to node 9"


def test_r15_a_node_whose_suspension_is_over_is_asked_for_its_overdue_reply() -> None:
    bench = Bench()
    node, other = up(bench, 9), up(bench, 5)
    lost(bench, node)
    bench.arbiter.dispatcher.suspend(node, bench.now)
    bench.ask(other)
    bench.until_sent()
    assert bench.sent().startswith("07 30 39"), "a request to node 9"


# the first frame after the line came up


def test_r15_no_write_is_sent_until_a_read_has_ended_what_an_earlier_master_left_unfinished() -> None:
    """Node 2 takes the first byte that is sent for the checksum that it waits for, and sends a NAK 140 ms later. Taken
    for the reply to a write, that would be confirmed by sending the write again: it would be carried out twice."""
    bench = Bench(fresh=True)
    node = bench.node()
    bench.wait(1.0)
    write_5 = bench.ask(node, write(5))
    assert bench.sent() == request_of(1), "a read"
    bench.answer(after=REQUEST + 0.004)
    bench.hear(NAK, after=0.136)
    assert write_5.attempts == 0
    confirmed_behind_checks(bench, write_5, WRITE_5)
    assert write_5.attempts == 1


def test_r15_reads_need_not_wait_for_what_an_earlier_master_left_unfinished() -> None:
    bench = Bench(fresh=True)
    node = bench.node()
    bench.wait(1.0)
    for element in (1, 2, 3):
        read = bench.ask(node, hcp2.Read(element))
        bench.answer(after=REQUEST + 0.004)
        assert read.value == 5.0
    assert checks(bench) == 0


def test_r15_an_urgent_write_goes_at_once_and_its_ack_is_held_until_no_other_can_come() -> None:
    """A stop does not wait for a read. Its ACK may be the reply of a node that was not addressed."""
    bench = Bench(fresh=True)
    node = bench.node()
    bench.wait(1.0)
    stop = bench.ask(node, write(5), priority=URGENT)
    assert bench.sent() == WRITE_5
    bench.hear(ACK, after=REQUEST + 0.004)
    assert not bench.ended(stop)
    bench.wait(0.150)
    assert (bench.ended(stop), stop.error) == (1, None)


def test_r15_an_urgent_write_is_unconfirmed_and_not_sent_again_for_a_nak_that_may_be_anothers() -> None:
    bench = Bench(fresh=True)
    node = bench.node()
    bench.wait(1.0)
    stop = bench.ask(node, write(5), priority=URGENT)
    bench.sent()
    bench.hear(NAK, after=REQUEST + 0.004)
    assert isinstance(stop.error, WriteUnconfirmed)
    bench.wait(3.0)
    assert stop.attempts == 1


def test_r15_a_port_that_comes_back_begins_with_reads_again() -> None:
    bench = Bench()
    node = up(bench)
    bench.arbiter.line_down("unplugged", bench.now)
    bench.arbiter.line_up(bench.now)
    bench.ask(node, write(5))
    bench.until_sent()
    assert bench.sent() == request_of(1)


def test_r15_only_an_equal_reply_is_ambiguous_and_only_while_the_overtaken_one_can_come() -> None:
    in_sync = InSync()
    in_sync._ambiguous = [(b"\x01", 10.0)]
    assert in_sync.is_ambiguous((b"\x01", b"\x03"), 5.0)
    assert not in_sync.is_ambiguous((b"\x02",), 5.0)
    assert not in_sync.is_ambiguous((b"\x01",), 11.0)


def test_r15_after_a_duplicate_replies_of_the_last_half_second_are_ambiguous_and_memory_is_bounded() -> None:
    in_sync = InSync()
    keys = [number.to_bytes(2, "big") for number in range(MOST_REMEMBERED + 1)]
    in_sync.note_answered((keys[0],), 0.0)
    in_sync.answered_twice(0.0)
    assert not in_sync.is_ambiguous((keys[0],), 0.0)  # nothing is remembered before the first duplicate
    for key in keys[:-1]:
        in_sync.note_answered((key,), 1.0)
    in_sync.note_answered((keys[0],), 1.25)  # the latest now, so the second is the oldest
    in_sync.note_answered((keys[-1],), 1.25)
    assert not in_sync.is_ambiguous((keys[1],), 1.25)
    assert in_sync.is_ambiguous((b"other", keys[2]), 1.5)
    assert not in_sync.is_ambiguous((keys[2],), 1.75)
    assert in_sync.is_ambiguous((keys[0],), 1.75)
    assert not in_sync.is_ambiguous((keys[0],), 2.0)


def test_r15_thirty_seconds_after_the_last_duplicate_replies_are_no_longer_ambiguous() -> None:
    in_sync = InSync()
    in_sync.answered_twice(0.0)
    in_sync.note_answered((b"\x01",), 29.75)
    assert in_sync.is_ambiguous((b"\x01",), 29.9)
    assert not in_sync.is_ambiguous((b"\x01",), 30.1)


@pytest.mark.parametrize("kind", ["_ambiguous", "_forgiven"])
def test_r15_replies_are_examined_as_long_as_an_overdue_one_may_be_mistaken_for_them(kind: str) -> None:
    in_sync = InSync()
    in_sync.add_overdue((b"\x01",), None, 0.0, 0.15)
    in_sync.overdue_replies = []
    setattr(in_sync, kind, [(b"\x01", 10.0)])
    in_sync.lapse(9.9)
    assert in_sync.alert
    in_sync.lapse(10.0)
    assert not in_sync.alert
