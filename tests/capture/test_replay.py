"""A capture through the readers of today: the same, or what has changed."""

from __future__ import annotations

from collections.abc import Callable
from itertools import count
from pathlib import Path
from typing import TypeAlias

import pytest

from busmaster.capture.assemble import Assembler
from busmaster.capture.pcapng import Outcome, Packet, read_packets
from busmaster.capture.replay import Replayed, replay_packets
from busmaster.contract.exchange import Command
from busmaster.contract.frames import Direction
from busmaster.contract.profile import Profile
from busmaster.contract.tap import Attempt, Verdict
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from tests.capture.hearing import HOST, NODE

ACK, NAK, EOT = "06", "15", "04"
FLAGS_REPLY = "02 03 00 27 00 00 52 46 4C 41 47 53 2C 01 02 00 80" + " 00" * 27 + " 80 03 18"


Turn: TypeAlias = tuple[Direction | Attempt, str]
"""Who says what; an attempt says its request."""


def recorded(*turns: Turn) -> list[Packet]:
    """What a recorder makes of these turns; nobody tells it the master's verdict."""
    packets: list[Packet] = []
    assembler = Assembler(packets.append)
    attempt: Attempt | None = None
    for turn, (sender, frame) in enumerate(turns):
        if isinstance(sender, Attempt):
            attempt, sender = sender, HOST
        assembler.passed(float(turn), bytes.fromhex(frame), sender, attempt)
    assembler.finish(100.0)
    return packets


def overheard(*turns: Turn) -> list[Packet]:
    """What a listener makes of these turns of one protocol, as recorders did that were told of no attempts."""
    packets: list[Packet] = []
    protocol = next(sender.protocol for sender, _ in turns if isinstance(sender, Attempt))
    assembler = Assembler(packets.append, protocol=protocol)
    for turn, (sender, frame) in enumerate(turns):
        assembler.overheard(float(turn), bytes.fromhex(frame), HOST if isinstance(sender, Attempt) else sender)
    assembler.finish(100.0)
    return packets


def exchange(command: Command[object], address: int, profile: Profile, *replies: str) -> list[Turn]:
    asked = Attempt(profile.name, address, command, profile.timings, transaction=next(NUMBERS))
    return [(asked, asked.request.hex()), *((NODE, reply) for reply in replies)]


NUMBERS = count(1)
HCP, HCP2, MSC, MENTOR, DC104 = (p.PROFILE for p in (hcp, hcp2, msc, mentor, dc104))
GOOD = [
    exchange(hcp.Read(1), 2, HCP, "02 30 31 31 32 33 2E 34 35 36 03 2B"),
    exchange(hcp.Write(1, (123.456,)), 2, HCP, ACK),
    exchange(hcp.Write(99, (1.0,)), 1, HCP, NAK),
    exchange(hcp2.Read(105), 255, HCP2, "02 36 39 34 30 39 36 03 07"),
    exchange(hcp2.Write(10, (10.0, 20.0, 30.0)), 13, HCP2, ACK),
    exchange(hcp2.Read(105), 255, HCP2, "02 36 39 34 30", ""),
    exchange(hcp2.Read(105), 255, HCP2, "02 36 39 34 30 39 36 03 08"),
    exchange(hcp2.Read(105), 255, HCP2),
    exchange(dc104.Read(170), 0, DC104, "02 AA 00 05 AF"),
    exchange(dc104.Write(2, 65535), 0, DC104, ACK),
    exchange(dc104.Read(107), 0, DC104, NAK),
    exchange(mentor.Read(1, 17), 12, MENTOR, "02 30 31 31 37 2D 30 34 37 36 03 2C"),
    exchange(mentor.Read(17, 23), 12, MENTOR, EOT),
    exchange(mentor.Write(1, 17, -476), 14, MENTOR, ACK),
    exchange(mentor.Write(1, 17, 4765, high_resolution=True), 14, MENTOR, ACK),
    exchange(mentor.Write(15, 60, 54321, wide=True), 5, MENTOR, NAK),
    exchange(mentor.Write(4, 26, True), 23, MENTOR, ACK),
    exchange(mentor.Write(1, 17, 0), 0, MENTOR),
    [
        *exchange(mentor.ReadRun(1, 17, 2), 12, MENTOR, "02 30 31 31 37 2D 30 34 37 36 03 2C"),
        (HOST, ACK),
        (NODE, "02 30 31 31 38 2B 30 30 30 30 03 20"),
    ],
    [
        *exchange(msc.DataRead(2008), 1, MSC, ACK, "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"),
        (HOST, ACK),
    ],
    exchange(msc.DataWrite(2008, 1234), 1, MSC, ACK),
    [*exchange(msc.SetFlag(5), 2, MSC, NAK), (HOST, "02 02 00 08 00 00 53 46 4C 41 47 2C 00 05 01 A8"), (NODE, ACK)],
    exchange(msc.ClearFlag(5), 2, MSC),
    [*exchange(msc.ReadFlag(255), 15, MSC, ACK, "02 0F 00 08 00 00 52 46 4C 41 47 2C 00 01 01 B0"), (HOST, ACK)],
    [*exchange(msc.ReadFlags(), 3, MSC, ACK, FLAGS_REPLY), (HOST, ACK)],
    [
        *exchange(
            msc.ReadStatus(), 1, MSC, ACK, "02 01 00 0F 00 00 52 51 53 54 41 54 2C 00 41 00 00 00 00 00 00 02 5C"
        ),
        (HOST, ACK),
    ],
    [  # the first packet is hit, the host says NAK, the second is good
        *exchange(msc.DataRead(2008), 1, MSC, ACK, "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D3 02 6D"),
        (HOST, NAK),
        (NODE, "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"),
        (HOST, ACK),
    ],
    exchange(msc.BlockWrite(2008, tuple(range(32))), 1, MSC, ACK),
    exchange(msc.BlockRead(2008), 1, MSC, ACK),
]


@pytest.mark.parametrize("record", [recorded, overheard])
@pytest.mark.parametrize("turns", GOOD, ids=range(len(GOOD)))
def test_what_todays_readers_make_of_a_recorded_exchange_is_what_was_recorded(
    turns: list[Turn], record: Callable[..., list[Packet]]
) -> None:
    (one,) = replay_packets(record(*turns))
    assert one.judged
    assert not one.changed, f"was {one.recorded}, is {one.now}"


def test_a_whole_capture_is_cut_into_its_exchanges() -> None:
    everything = list(replay_packets(recorded(*(turn for turns in GOOD for turn in turns))))
    heard = list(replay_packets(packet for turns in GOOD for packet in overheard(*turns)))
    assert len(everything) == len(heard) == len(GOOD)
    assert not any(one.changed for one in everything + heard)
    by_frames = {Outcome.OK, Outcome.NO_REPLY, Outcome.GARBLED, Outcome.REFUSED}
    assert {one.recorded.outcome for one in everything} == by_frames


READ = exchange(hcp2.Read(105), 255, HCP2, "02 36 39 34 30 39 36 03 07")


def only(packets: list[Packet]) -> Replayed:
    (one,) = replay_packets(packets)
    return one


def test_an_outcome_that_differs_is_a_change() -> None:
    packets = recorded(*READ)
    packets[1].outcome, packets[1].comment = Outcome.GARBLED, "read element 105: bad checksum"
    one = only(packets)
    assert one.changed
    assert (one.packet, one.node, one.command) == (1, 255, "read element 105")
    assert str(one.recorded) == "garbled: read element 105: bad checksum"
    assert str(one.now) == "ok: 4096.0"


def test_a_value_that_differs_is_a_change() -> None:
    packets = recorded(*READ)
    packets[1].comment = "read element 105: 4097.0 (late)"
    one = only(packets)
    assert one.changed
    assert str(one.recorded) == "ok: 4097.0"
    packets[1].comment = "read element 105: 4096.0 (late)"
    assert not only(packets).changed


def test_without_a_recorded_value_the_replys_own_numbers_are_compared() -> None:
    packets = recorded(*READ)
    packets[1].comment = "read 2 of the 32 values: (1, 2)"
    assert not only(packets).changed
    assert str(only(packets).recorded) == "ok: 4096"


def test_a_reply_of_zero_is_a_number_as_any_other() -> None:
    one = only(overheard(*exchange(hcp2.Read(105), 255, HCP2, "02 36 39 30 03 3C")))
    assert one.now.values == one.recorded.values == [0.0]
    assert not one.changed


WRITE = Attempt("hcp2", 1, hcp2.Write(1, (5.0,)), HCP2.timings)


def test_a_request_that_would_be_written_otherwise_is_a_change() -> None:
    one = only(overheard((WRITE, "07 30 31 02 30 31 2B 35 03 1F"), (NODE, ACK)))
    assert one.changed
    assert str(one.now) == "the request would be 07 30 31 02 30 31 35 03 34"


def test_a_request_that_no_command_sends_is_a_change_if_it_was_answered() -> None:
    one = only(overheard((WRITE, "07 30 30 02 30 30 05 07"), (NODE, NAK)))
    assert "1 to 255" in str(one.now)
    assert one.changed


def test_the_outcome_of_a_request_that_no_command_sends_is_not_that_of_the_next_exchange() -> None:
    wrong = (WRITE, "07 30 30 02 30 30 05 07")
    for replies, outcome in (((), Outcome.NO_REPLY), (((NODE, NAK), (NODE, "FF")), Outcome.REFUSED)):
        first, second = replay_packets(overheard(wrong, *replies, *READ))
        assert (first.recorded.outcome, second.recorded.outcome) == (outcome, Outcome.OK)
        assert (first.packet, second.packet) == (1, 2 + max(1, len(replies)))
        assert (first.micros, second.micros) == (0, 1_000_000 * (1 + len(replies)))
    assert [one.packet for one in replay_packets(overheard(*READ, wrong, (NODE, NAK)))] == [1, 3]


NEXT_VALUE = "02 30 31 31 38 2B 30 30 30 30 03 20"
"""Mentor's parameter 1.18 is 0."""


def mentor_read(*replies: str) -> list[Turn]:
    return exchange(mentor.Read(1, 17), 12, MENTOR, *replies)


@pytest.mark.parametrize(
    ("turns", "command", "result"),
    [
        pytest.param(
            [*mentor_read(EOT), (HOST, ACK), (NODE, NEXT_VALUE)], "read 01.17 to 01.18", "refused", id="refused"
        ),
        pytest.param([*mentor_read(), (HOST, ACK)], "read 01.17 to 01.18", "no reply", id="no reply"),
        pytest.param(
            [
                *mentor_read("02 30 31 31 37 2D 30 34 37 36 03 2C"),
                (HOST, ACK),
                (NODE, NEXT_VALUE),
                (HOST, "08"),
                (NODE, "02 30 31 31 37 2D 30 34 37 36 03 2C"),
            ],
            "read 01.17",
            "ok: -476",
            id="forwards and backwards",
        ),
    ],
)
def test_a_short_command_that_no_exchange_of_ours_sends_is_not_an_exchange_of_its_own(
    turns: list[Turn], command: str, result: str
) -> None:
    one = only(overheard(*turns))
    assert (one.packet, one.command) == (1, command)
    assert str(one.now).startswith(result)
    assert not one.changed
    replayed = replay_packets(overheard(*turns, *mentor_read(EOT)))
    assert [each.packet for each in replayed] == [1, 1 + len(overheard(*turns))]


def test_the_outcome_of_a_request_that_no_command_sends_is_that_of_its_last_short_command() -> None:
    wrong = (mentor_read()[0][0], "04 31 32 32 32 30 31 31 37 05")
    one = only(overheard(wrong, (NODE, EOT), (HOST, ACK), (NODE, NEXT_VALUE)))
    assert (one.packet, one.recorded.outcome) == (1, Outcome.OK)
    assert str(one.now) == "read 01.17: no drive address: '1222'"


def test_the_outcome_of_a_request_that_no_command_sends_is_not_lost_with_the_hosts_last_acknowledgement() -> None:
    sent = exchange(msc.ReadFlag(255), 15, MSC)[0][0]
    wrong = (sent, "02 0F 00 08 00 00 52 46 4C 41 47 2C 01 00 01 B0")  # flag 256
    packets = overheard(wrong, (NODE, ACK), (NODE, "02 0F 00 08 00 00 52 46 4C 41 47 2C 00 01 01 B0"), (HOST, ACK))
    assert [packet.outcome for packet in packets] == [Outcome.NONE, Outcome.NONE, Outcome.OK, Outcome.NONE]
    one = only(packets)
    assert (one.now.outcome, one.recorded.outcome) == (Outcome.NONE, Outcome.OK)


def test_a_file_of_the_first_version_which_numbers_no_requests_replays() -> None:
    with (Path(__file__).parent / "version1.pcapng").open("rb") as file:
        exchanges = list(replay_packets(read_packets(file)))
    assert not any(one.changed for one in exchanges)
    assert all(one.judged for one in exchanges)
    assert len(exchanges) == 13
    assert [(one.packet, one.node, str(one.recorded)[:30]) for one in exchanges[:5]] == [
        (1, 1, "ok: ok"),
        (3, 1, "ok: -2.0"),
        (5, 7, "ok: 64.0"),
        (7, 2, "refused"),
        (9, 2, "refused: write element 100 = 3"),
    ]


def test_unexpected_bytes_and_what_comes_before_the_first_request_are_left_out() -> None:
    packets = overheard((NODE, "15"), *READ, (NODE, "02 36 39 34 30 39 36 03 07"))
    assert [packet.outcome for packet in packets] == [Outcome.UNEXPECTED, Outcome.NONE, Outcome.OK, Outcome.UNEXPECTED]
    assert not only(packets).changed


def told(verdict: Verdict, result: object, *turns: Turn) -> Replayed:
    """What comes of one exchange of which the master said that."""
    packets: list[Packet] = []
    assembler = Assembler(packets.append)
    attempt = turns[0][0]
    assert isinstance(attempt, Attempt)
    for turn, (sender, frame) in enumerate(turns):
        assembler.passed(float(turn), bytes.fromhex(frame), sender if isinstance(sender, Direction) else HOST, attempt)
    attempt.end(verdict, result, 50.0)
    assembler.attempted(attempt)
    return only(packets)


def read(*replies: str) -> list[Turn]:
    return exchange(hcp2.Read(105), 255, HCP2, *replies)


VALUE = "02 36 39 34 30 39 36 03 07"


def test_the_masters_own_verdict_is_what_counts() -> None:
    one = told(Verdict.NO_REPLY, "no reply", *read(VALUE))
    assert one.changed
    assert (str(one.recorded), str(one.now)) == ("no reply: read element 105: no reply", "ok: 4096.0")


@pytest.mark.parametrize(
    ("replies", "recorded_", "now"),
    [
        ((), Verdict.GARBLED, "no reply"),
        (("02 36 39 34",), Verdict.GARBLED, ""),
        (("02 36 39 34",), Verdict.NO_REPLY, ""),
    ],
)
def test_that_nothing_was_received_and_that_it_was_damaged_differ_if_there_were_no_bytes(
    replies: tuple[str, ...], recorded_: Verdict, now: str
) -> None:
    one = told(recorded_, "whatever", *read(*replies))
    assert one.judged
    assert one.changed is bool(now)
    assert str(one.now).startswith(now)


def test_frames_that_came_in_one_piece_are_read_together() -> None:
    packet = "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"
    for replies, now in (
        ([f"{NAK} {packet}"], "garbled: 19 bytes that are not a packet"),
        ([NAK, packet], "garbled: a packet for another request"),
    ):
        one = told(Verdict.GARBLED, "whatever", *exchange(msc.DataRead(2008), 1, MSC, *replies))
        assert not one.changed
        assert str(one.now).startswith(now)


def test_an_answer_that_was_not_believed_is_read_as_one_and_still_not_believed() -> None:
    one = told(Verdict.AMBIGUOUS, "two replies received, one expected", *read(VALUE))
    assert one.judged
    assert not one.changed
    assert told(Verdict.AMBIGUOUS, "two replies received, one expected", *read(NAK)).changed


@pytest.mark.parametrize("verdict", [Verdict.SPOILT, Verdict.CUT_OFF])
def test_what_no_reader_was_asked_about_is_not_judged(verdict: Verdict) -> None:
    one = told(verdict, "whatever", *read(VALUE))
    assert not one.judged
    assert not one.changed
    assert one.recorded.outcome is Outcome[verdict.name]


BAD_PACKET = "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D3 02 6D"


def test_a_packet_that_was_not_asked_for_again_since_time_was_up_is_judged_so() -> None:
    """R9: the arbiter abandons an exchange that would say NAK, and acknowledges what came."""
    turns = exchange(msc.DataRead(2008), 1, MSC, ACK, BAD_PACKET)
    one = told(Verdict.GARBLED, "bad checksum", *turns, (HOST, ACK))
    assert not one.changed
    assert str(one.now) == "garbled: bad checksum"


def test_an_exchange_in_which_the_host_said_something_else_is_a_change() -> None:
    turns = exchange(msc.SetFlag(5), 2, MSC, NAK)
    one = told(Verdict.OK, None, *turns, (HOST, ACK), (NODE, ACK))
    assert one.judged
    assert one.changed


def test_a_change_is_reported_if_the_outcome_is_recorded_after_what_the_host_would_send_otherwise_today() -> None:
    turns = exchange(msc.SetFlag(5), 2, MSC, NAK)
    one = told(Verdict.OK, None, *turns, (HOST, "02 02 00 08 00 00 53 46 4C 41 47 2C 00 06 01 A9"), (NODE, ACK))
    assert one.changed
    assert (str(one.recorded), str(one.now)) == ("ok: ok", "refused: refused")


def test_a_change_is_reported_if_the_pauses_of_its_steps_do_not_lead_to_the_recorded_outcome() -> None:
    repeated = next(turns for turns in GOOD if (HOST, NAK) in turns)
    packets = overheard(*repeated)
    answer = next(packet for packet in packets if packet.outcome is Outcome.OK)
    answer.comment = "read data 2008: 4097"
    one = only(packets)
    assert one.changed
    assert (str(one.recorded), str(one.now)) == ("ok: 4097", "ok: 1234")


def test_a_pause_that_ended_the_reply_is_no_change_whatever_the_host_sent_then() -> None:
    turns = exchange(msc.DataRead(2008), 1, MSC, ACK, "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D")
    again = (HOST, "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74")
    one = told(Verdict.NO_REPLY, "no reply", *turns, again, (NODE, NAK))
    assert one.judged
    assert not one.changed
