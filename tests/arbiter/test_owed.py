"""What is owed, by itself and without a line: whose it is, what pays it, and until when it is awaited (R15)."""

from __future__ import annotations

from math import inf

import pytest

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.health import SILENT, NodeRecord
from busmaster.arbiter.in_step import ANY_BYTE, LAPSE, Awaited, InStep
from busmaster.contract.profile import Profile
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.msc import codec as msc
from tests.arbiter.bench import ACK, BAD_CHECKSUM, FIVE, TAU, Bench, reply_of, up

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
    in_step = InStep()
    in_step.recent += [(b"\x06",), (ONE,), (ONE,)]
    assert in_step.heard(bytes.fromhex(heard), 1.0) is None
    assert (in_step.doubts(1.0), [debt.key for debt in in_step.debts]) == (twice, [] if twice else [ANY_BYTE])


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
    in_step = InStep()
    in_step.recent += [(bytes.fromhex(reply_of(2, 5))[:3],), *[(ONE,)] * 20]
    if reply_of(1, 7) in heard:
        in_step.owe((ONE,), living(), asked=0.0, over=0.150)
    in_step.heard(bytes.fromhex(heard), 1.0)
    assert in_step.doubts(1.0) is twice


def test_r15_a_reply_that_may_have_begun_in_time_is_awaited_until_the_silence_behind_it() -> None:
    in_step = InStep()
    in_step.owe((ONE,), living(), asked=0.0, over=0.150, awaited=READ)
    assert in_step.awaited_until(-inf) == 0.150
    assert in_step.awaited_until(0.140) == pytest.approx(0.160)
    assert in_step.awaited_until(0.150) == 0.150, "what comes then is later than it may be"
    assert in_step.awaited_until(0.140, (TWO,)) == -inf


def test_r15_what_two_nodes_may_have_said_leaves_nobody_owing_it_and_says_nothing_of_what_else_they_owe() -> None:
    in_step = InStep()
    first, second = living(1), living(2)
    for node in (first, second):
        in_step.owe((ONE, TWO), node, asked=0.0, over=0.150)
    assert in_step.heard(bytes.fromhex(FIVE), 1.0) is not None
    owed = [(debt.key, debt.node) for debt in in_step.debts]
    assert owed == [(TWO, first), (ONE, None), (TWO, second), (ANY_BYTE, None)]


def test_r15_while_it_is_awaited_a_whole_reply_pays_however_short_the_part_that_tells_it_from_others() -> None:
    in_step = InStep()
    drive, read = living(0, dc104.PROFILE), dc104.Read(5)
    in_step.owe((b"\x02\x05",), drive, 0.0, 0.2, Awaited(read, 0.01, 0.02))
    payer = in_step.heard(bytes.fromhex("02 05 01 2C 32"), 0.1)
    assert payer is not None
    assert (payer.node, in_step.debts) == (drive, [])


def test_r15_while_it_is_awaited_what_begins_with_a_byte_that_anybody_may_say_pays_nothing() -> None:
    in_step = InStep()
    drive, read = living(1, msc.PROFILE), msc.DataRead(2008)
    keys = read.open(1, msc.PROFILE.timings).owed
    in_step.owe(keys, drive, 0.0, 0.2, Awaited(read, 0.01, 0.02))
    assert in_step.heard(bytes.fromhex("06 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"), 0.1) is None
    assert [debt.key for debt in in_step.debts] == [*keys, ANY_BYTE]


def test_r15_while_it_is_awaited_a_damaged_reply_pays_nothing() -> None:
    in_step = InStep()
    in_step.owe((ONE,), living(), 0.0, 0.150, READ)
    assert in_step.heard(bytes.fromhex(BAD_CHECKSUM), 0.1) is None
    assert [debt.key for debt in in_step.debts] == [ONE, ANY_BYTE]


def test_r15_another_nodes_answer_pays_only_for_a_node_that_is_silent_and_late() -> None:
    for unheard, asked, paid in ((SILENT, 0.150, True), (SILENT - 1, 0.150, False), (SILENT, 0.149, False)):
        in_step = InStep()
        owing = living()
        owing.unheard = unheard
        in_step.owe((ONE,), owing, asked=0.0, over=0.150)
        in_step.answered(living(2), asked, 1.0, 0.1)
        assert (in_step.ends((ONE,), 1.0) < inf) is paid


def test_r15_only_what_is_like_a_forgiven_reply_is_held_and_only_until_it_would_have_lapsed() -> None:
    in_step = InStep()
    in_step.owe((ONE,), living(), asked=1.0, over=1.150)
    in_step.forgive((ONE,))
    assert in_step.is_to_be_held((ONE,), 10.9)
    assert not in_step.is_to_be_held((TWO,), 10.9)
    assert not in_step.is_to_be_held((ONE,), 1.0 + LAPSE)


def test_r15_a_forgiven_reply_that_comes_after_all_was_not_said_twice_and_is_held_no_more() -> None:
    in_step = InStep()
    in_step.owe((b"\x06",), living(), asked=1.0, over=1.150)
    in_step.forgive((b"\x06",))
    in_step.recent.append((b"\x06",))
    assert in_step.heard(b"\x06", 2.0) is None
    assert (in_step.doubts(2.0), in_step.debts) == (False, [])
    assert not in_step.is_to_be_held((b"\x06",), 2.0)


def test_r15_what_is_unlike_the_last_answers_was_not_said_twice() -> None:
    in_step = InStep()
    in_step.recent.append((bytes.fromhex(reply_of(1, 5)),))
    assert in_step.heard(bytes.fromhex(reply_of(2, 7)), 1.0) is None
    assert len(in_step.debts) == 1, "more of it may come"


def test_r15_a_line_is_not_strict_unless_it_is_to_be() -> None:
    assert not Arbiter(TAU)._in_step.alert


@pytest.mark.parametrize("behind", ["", "FF"])
def test_r15_of_several_who_pay_at_once_the_first_is_told(behind: str) -> None:
    in_step, bench = InStep(), Bench()
    first, second = up(bench, 1), up(bench, 2)
    in_step.owe((bytes.fromhex(ACK),), first, 0.0, 0.15)
    in_step.owe((bytes.fromhex(reply_of(2, 5)),), second, 0.0, 0.15)
    payer = in_step.heard(bytes.fromhex(ACK + reply_of(2, 5) + behind), 1.0)
    assert payer is not None
    assert payer.node is first


def test_r15_what_came_around_a_reply_that_was_sent_twice_may_have_been_a_part_of_an_ack() -> None:
    owed = InStep()
    owed.recent.append((b"\x02reply",))
    owed.heard(b"\xff\x02reply", 1.0)
    assert owed.doubts(1.0)
    assert owed.clashes((b"\x06",), 1.0), "a single byte may still come"
