"""What is overdue, by itself and without a line: whose it is, what pays it, and until when it is awaited (R15)."""

from __future__ import annotations

from collections import deque
from math import inf

import pytest

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.counters import LineCounters
from busmaster.arbiter.events import Event
from busmaster.arbiter.health import SILENT, NodeRecord
from busmaster.arbiter.in_sync import ANY_BYTE, LAPSE, MOST_OVERDUE, Awaited, InSync
from busmaster.arbiter.unexpected import LOOKS, UnexpectedBytes
from busmaster.contract.profile import Profile
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import ACK, BAD_CHECKSUM, FIVE, MAX_REPLY_DELAY, TAU, Bench, reply_of, up

ONE, TWO = b"\x0201", b"\x0202"
"""What replies of elements 1 and 2 begin with."""
READ = Awaited(hcp2.Read(1), window=0.010, silence=0.020)


def living(address: int = 1, profile: Profile = hcp2.PROFILE) -> NodeRecord:
    """A node that has answered before, and is not silent."""
    node = NodeRecord(profile, address, profile.timings, 2)
    node.last_reply = 0.0
    node.slowest = 0.004
    return node


@pytest.mark.parametrize(
    ("heard", "twice"), [("06", True), ("06 06", True), ("05", False), ("15", False), ("06 05", False)]
)
def test_r15_acks_that_nobody_owes_were_said_twice_and_nothing_else_was(heard: str, twice: bool) -> None:
    in_sync = InSync()
    in_sync.recent += [(b"\x06",), (ONE,), (ONE,)]
    assert in_sync.heard(bytes.fromhex(heard), 1.0) is None
    assert (in_sync.has_ambiguity(1.0), [overdue.key for overdue in in_sync.overdue_replies]) == (
        twice,
        [] if twice else [ANY_BYTE],
    )


@pytest.mark.parametrize(
    ("heard", "twice"),
    [
        (reply_of(2, 5), True),
        (reply_of(2, 5) + " " + reply_of(1, 7), True),
        ("06 " + reply_of(2, 5), True),
        (reply_of(3, 5), False),
        (reply_of(3, 5) + " " + reply_of(1, 7), False),
    ],
)
def test_r15_a_reply_like_one_of_the_last_exchanges_was_said_twice_also_beside_an_overdue_one(
    heard: str, twice: bool
) -> None:
    in_sync = InSync()
    in_sync.recent += [(bytes.fromhex(reply_of(2, 5))[:3],), *[(ONE,)] * 20]
    if reply_of(1, 7) in heard:
        in_sync.add_overdue((ONE,), living(), asked=0.0, over=0.150)
    in_sync.heard(bytes.fromhex(heard), 1.0)
    assert in_sync.has_ambiguity(1.0) is twice


def test_r15_a_reply_that_may_have_begun_in_time_is_awaited_until_the_silence_behind_it() -> None:
    in_sync = InSync()
    in_sync.add_overdue((ONE,), living(), asked=0.0, over=0.150, awaited=READ)
    assert in_sync.awaited_until(-inf) == 0.150
    assert in_sync.awaited_until(0.140) == pytest.approx(0.160)
    assert in_sync.awaited_until(0.150) == 0.150, "what comes then is later than it may be"
    assert in_sync.awaited_until(0.140, (TWO,)) == -inf


def test_r15_what_two_nodes_may_have_said_leaves_nobody_owing_it_and_says_nothing_of_what_else_they_owe() -> None:
    in_sync = InSync()
    first, second = living(1), living(2)
    for node in (first, second):
        in_sync.add_overdue((ONE, TWO), node, asked=0.0, over=0.150)
    assert in_sync.heard(bytes.fromhex(FIVE), 1.0) is not None
    overdue = [(overdue.key, overdue.node) for overdue in in_sync.overdue_replies]
    assert overdue == [(TWO, first), (ONE, None), (TWO, second), (ANY_BYTE, None)]


def test_r15_while_it_is_awaited_a_whole_reply_pays_however_short_the_part_that_tells_it_from_others() -> None:
    in_sync = InSync()
    drive, read = living(0, dc104.PROFILE), dc104.Read(5)
    in_sync.add_overdue((b"\x02\x05",), drive, 0.0, 0.2, Awaited(read, 0.01, 0.02))
    payer = in_sync.heard(bytes.fromhex("02 05 01 2C 32"), 0.1)
    assert payer is not None
    assert (payer.node, in_sync.overdue_replies) == (drive, [])


def test_r15_while_it_is_awaited_what_begins_with_a_byte_that_anybody_may_say_pays_nothing() -> None:
    in_sync = InSync()
    drive, read = living(1, msc.PROFILE), msc.DataRead(2008)
    keys = read.open(1, msc.PROFILE.timings).overdue
    in_sync.add_overdue(keys, drive, 0.0, 0.2, Awaited(read, 0.01, 0.02))
    assert in_sync.heard(bytes.fromhex("06 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"), 0.1) is None
    assert [overdue.key for overdue in in_sync.overdue_replies] == [*keys, ANY_BYTE]


def test_r15_while_it_is_awaited_a_damaged_reply_pays_nothing() -> None:
    in_sync = InSync()
    in_sync.add_overdue((ONE,), living(), 0.0, 0.150, READ)
    assert in_sync.heard(bytes.fromhex(BAD_CHECKSUM), 0.1) is None
    assert [overdue.key for overdue in in_sync.overdue_replies] == [ONE, ANY_BYTE]


def test_r15_another_nodes_answer_pays_only_for_a_node_that_is_silent_and_late() -> None:
    for unheard, asked, paid in ((SILENT, 0.150, True), (SILENT - 1, 0.150, False), (SILENT, 0.149, False)):
        in_sync = InSync()
        nodes_overdue = living()
        nodes_overdue.unheard = unheard
        in_sync.add_overdue((ONE,), nodes_overdue, asked=0.0, over=0.150)
        in_sync.answered(living(2), asked, 1.0, 0.1)
        assert (in_sync.ends((ONE,), 1.0) < inf) is paid


def test_r15_only_what_is_like_a_forgiven_reply_is_held_and_only_until_it_would_have_lapsed() -> None:
    in_sync = InSync()
    in_sync.add_overdue((ONE,), living(), asked=1.0, over=1.150)
    in_sync.forgive((ONE,))
    assert in_sync.is_overdue(10.9), "it was forgiven, and may still arrive"
    assert not in_sync.is_overdue(1.0 + LAPSE)
    assert in_sync.is_to_be_held((ONE,), 10.9)
    assert not in_sync.is_to_be_held((TWO,), 10.9)
    assert not in_sync.is_to_be_held((ONE,), 1.0 + LAPSE)


def test_r15_a_forgiven_reply_that_comes_after_all_was_not_said_twice_and_is_held_no_more() -> None:
    in_sync = InSync()
    in_sync.add_overdue((b"\x06",), living(), asked=1.0, over=1.150)
    in_sync.forgive((b"\x06",))
    in_sync.recent.append((b"\x06",))
    assert in_sync.heard(b"\x06", 2.0) is None
    assert (in_sync.has_ambiguity(2.0), in_sync.overdue_replies) == (False, [])
    assert not in_sync.is_to_be_held((b"\x06",), 2.0)


def test_r15_what_is_unlike_the_last_answers_was_not_said_twice() -> None:
    in_sync = InSync()
    in_sync.recent.append((bytes.fromhex(reply_of(1, 5)),))
    assert in_sync.heard(bytes.fromhex(reply_of(2, 7)), 1.0) is None
    assert len(in_sync.overdue_replies) == 1, "more of it may come"


def test_r15_a_line_is_not_strict_unless_it_is_to_be() -> None:
    assert not Arbiter(TAU)._in_sync.alert


@pytest.mark.parametrize("behind", ["", "FF"])
def test_r15_of_several_who_pay_at_once_the_first_is_told(behind: str) -> None:
    in_sync, bench = InSync(), Bench()
    first, second = up(bench, 1), up(bench, 2)
    in_sync.add_overdue((bytes.fromhex(ACK),), first, 0.0, 0.15)
    in_sync.add_overdue((bytes.fromhex(reply_of(2, 5)),), second, 0.0, 0.15)
    payer = in_sync.heard(bytes.fromhex(ACK + reply_of(2, 5) + behind), 1.0)
    assert payer is not None
    assert payer.node is first


def test_r15_what_came_around_a_reply_that_was_sent_twice_may_have_been_a_part_of_an_ack() -> None:
    overdue = InSync()
    overdue.recent.append((b"\x02reply",))
    overdue.heard(b"\xff\x02reply", 1.0)
    assert overdue.has_ambiguity(1.0)
    assert overdue.clashes((b"\x06",), 1.0), "a single byte may still come"


def test_a_reply_that_begins_at_the_last_moment_is_over_by_the_documents_silence_alone() -> None:
    in_sync = InSync()
    awaited = Awaited(hcp2.Read(1), window=0.010, silence=0.050, lasts=0.080)
    in_sync.add_overdue((b"\x02\x05",), None, 0.0, 0.2, awaited)
    assert in_sync.awaited_until(last_byte=0.1) == 0.2
    assert in_sync.awaited_until(last_byte=0.19) == pytest.approx(0.24)
    assert in_sync.awaited_until(last_byte=0.21) == pytest.approx(0.26)  # it began before 0.2
    assert in_sync.awaited_until(last_byte=0.29) == 0.2  # too late to be a part of it


def test_the_line_is_read_often_for_an_overdue_reply_for_a_second_and_then_rests() -> None:
    """However long the line has been open: times are compared, and not their ratio."""
    bench = Bench()
    record = up(bench)
    bench.wait(1000.0)
    bench.ask(record, retries=0)
    bench.sent()
    bench.wait(0.5)
    assert bench.arbiter.poll_timeout() - bench.now <= MAX_REPLY_DELAY / LOOKS
    bench.wait(1.0)
    assert bench.arbiter.poll_timeout() == inf


def test_overdue_replies_are_bounded_and_the_oldest_are_forgotten_first() -> None:
    in_sync = InSync()
    for number in range(MOST_OVERDUE + 5):
        in_sync.add_overdue((b"%d" % number,), None, float(number), float(number))
    keys = [overdue.key for overdue in in_sync.overdue_replies]
    assert keys == [b"%d" % number for number in range(5, MOST_OVERDUE + 5)]


def test_r15_a_byte_that_another_single_byte_follows_clears_no_overdue_reply() -> None:
    """Neither stands alone, so both may be the middle of something else."""
    for other, cleared in ((b"\x07", False), (b"\x02\x01", True), (b"\x02whole", True)):
        in_sync = InSync()
        in_sync.add_overdue((bytes.fromhex(ACK),), None, 0.0, 0.15)
        in_sync.add_overdue((other,), None, 0.0, 0.15)
        payer = in_sync.heard(bytes.fromhex(ACK) + other, 1.0)
        left = [overdue.key for overdue in in_sync.overdue_replies if overdue.key != ANY_BYTE]
        assert (payer is not None, left == []) == (cleared, cleared)


def test_a_node_is_no_longer_asked_for_an_overdue_reply_that_has_lapsed() -> None:
    in_sync, record = InSync(), up(Bench())
    in_sync.add_overdue((b"\x02\x05",), record, 0.0, 0.15)
    [overdue] = in_sync.overdue_replies
    overdue.until = 5.0
    assert [*in_sync.nodes_overdue(None, 4.9)] == [record]
    assert [*in_sync.nodes_overdue(None, 5.0)] == []


def test_what_was_ambiguous_is_forgotten_when_nothing_of_it_can_arrive_any_more() -> None:
    in_sync = InSync()
    in_sync.recent.append((b"\x02reply",))
    in_sync.heard(b"\xff\x02reply", 1.0)
    assert in_sync.has_ambiguity(1.0)
    in_sync.lapse(1.1)
    assert in_sync.alert
    in_sync.lapse(100.0)
    assert not in_sync.alert, "each reply would be examined for ever"


def test_r15_a_byte_that_is_repeated_clears_the_overdue_reply_that_it_is() -> None:
    for times in (1, 2, 3):
        in_sync = InSync()
        in_sync.add_overdue((bytes.fromhex(ACK),), None, 0.0, 0.15)
        assert in_sync.heard(bytes.fromhex(ACK) * times, 1.0) is not None


def test_r15_what_was_ambiguous_until_now_says_nothing_of_what_comes_later() -> None:
    for until, known in ((2.0, True), (1.0, False)):
        in_sync = InSync()
        in_sync.recent.append((TWO,))
        in_sync._forgiven.append((TWO, until))
        in_sync.heard(bytes.fromhex(reply_of(2, 5)), 1.5)
        assert in_sync.has_ambiguity(1.5) is not known


def test_r15_a_reply_that_stood_alone_ends_what_was_forgiven_of_its_key_and_of_any_key() -> None:
    in_sync = InSync()
    in_sync._forgiven += [(ANY_BYTE, 5.0), (ONE, 5.0), (TWO, 5.0)]
    in_sync.stood_alone((ONE,))
    assert in_sync._forgiven == [(TWO, 5.0)]


def test_r3_bytes_before_the_first_read_of_the_line_raise_no_max_reply_delay() -> None:
    """They may have lain unread for any time."""
    events: deque[Event] = deque()
    node = living()
    unexpected = UnexpectedBytes(events, LineCounters(0.0))
    unexpected.unanswered(node, 0.0, 0.15)
    unexpected.blame(0.149)
    assert not events
