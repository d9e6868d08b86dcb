"""From bytes to packets: one a frame, and each exchange with its outcome."""

from __future__ import annotations

from dataclasses import replace
from itertools import count
from typing import Any

import pytest

from busmaster.capture.assemble import Assembler
from busmaster.capture.pcapng import Outcome, Packet
from busmaster.contract.exchange import Command
from busmaster.contract.frames import Direction
from busmaster.contract.profile import Profile
from busmaster.contract.tap import Attempt, Verdict
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc

READ = bytes.fromhex("07 30 32 02 30 31 05 04")
VALUE = bytes.fromhex("02 30 31 35 03 37")
OTHER = bytes.fromhex("07 46 46 02 36 39 05 08")
ACK, NAK = b"\x06", b"\x15"
NONE, OK, NO_REPLY, GARBLED, REFUSED, UNEXPECTED, *_ = Outcome
HOST, NODE = Direction.HOST, Direction.NODE
READ_PACKET = bytes.fromhex("02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74")
READ_REPLY = bytes.fromhex("02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D")


class Tape:
    """An assembler and what it wrote."""

    def __init__(self, protocol: str = "", echo: bool = False) -> None:
        self.packets: list[Packet] = []
        self.assembler = Assembler(self.packets.append, protocol=protocol, echo=echo, offset=100.0)
        self.attempt: Attempt | None = None
        self._numbers = count(1)

    def asked(
        self, now: float, profile: Profile, command: Command[Any], address: int, before: bytes = b"", **more: Any
    ) -> Attempt:
        """Transmit its request, behind what closes the exchange before."""
        options = {"transaction": next(self._numbers), **more}
        self.attempt = Attempt(profile.name, address, command, profile.timings, **options)
        self.assembler.passed(now, before + self.attempt.request, HOST, self.attempt)
        return self.attempt

    def read(self, now: float) -> Attempt:
        return self.asked(now, hcp2.PROFILE, hcp2.Read(1), 2)

    def sent(self, now: float, data: bytes) -> None:
        self.assembler.passed(now, data, HOST, self.attempt)

    def heard(self, now: float, data: bytes) -> None:
        self.assembler.passed(now, data, NODE, self.attempt)

    def over(self, now: float, verdict: Verdict, result: object, attempt: Attempt | None = None) -> None:
        """Tell how an attempt ended: the one that is on the wire, if none is given."""
        ended = attempt or self.attempt
        assert ended is not None
        if ended is self.attempt:
            self.attempt = None
        ended.end(verdict, result, now)
        self.assembler.attempted(ended)

    def overheard(self, now: float, data: bytes) -> None:
        self.assembler.overheard(now, data)

    def lines(self) -> list[tuple[Direction, bytes, Outcome, str]]:
        self.assembler.finish(9.0)
        return [(packet.direction, packet.frame, packet.outcome, packet.comment) for packet in self.packets]


def test_a_reply_in_pieces_is_one_packet_with_the_time_of_its_first_byte_and_the_requests_node() -> None:
    tape = Tape()
    tape.read(1.0)
    tape.heard(1.002, VALUE[:3])
    tape.heard(1.004, VALUE[3:])
    tape.over(1.004, Verdict.OK, 5.0)
    assert tape.lines() == [(HOST, READ, NONE, ""), (NODE, VALUE, OK, "read element 1: 5.0")]
    assert [(packet.micros, packet.node) for packet in tape.packets] == [(101_000_000, 2), (101_002_000, 2)]
    assert {packet.protocol for packet in tape.packets} == {"hcp2"}


def test_a_verdict_that_is_told_after_the_next_request_goes_to_the_right_exchange() -> None:
    tape = Tape()
    first = tape.read(1.0)
    tape.heard(1.002, VALUE)
    first.end(Verdict.OK, 5.0, 1.002)
    tape.asked(1.0021, hcp2.PROFILE, hcp2.Read(105), 255)
    tape.over(1.002, Verdict.OK, 5.0, first)
    tape.heard(1.004, NAK)
    tape.over(1.0041, Verdict.REFUSED, "refused")
    assert tape.lines() == [
        (HOST, READ, NONE, ""),
        (NODE, VALUE, OK, "read element 1: 5.0"),
        (HOST, OTHER, NONE, ""),
        (NODE, NAK, REFUSED, "read element 105: refused"),
    ]
    assert [(packet.transaction, packet.attempt) for packet in tape.packets] == [(1, 1), (1, 1), (2, 1), (2, 1)]


def test_each_attempt_has_its_own_verdict_and_why_it_was_asked() -> None:
    tape = Tape()
    tape.asked(1.0, hcp2.PROFILE, hcp2.Read(1), 2, transaction=7, purpose="poll axes")
    tape.over(1.13, Verdict.NO_REPLY, "no reply within 100 ms")
    retry = tape.asked(1.15, hcp2.PROFILE, hcp2.Read(1), 2, transaction=7, number=2, purpose="poll axes")
    retry.late, retry.heard = True, False
    tape.heard(1.22, VALUE)
    tape.over(1.22, Verdict.OK, 5.0)
    assert tape.lines() == [
        (HOST, READ, NONE, "poll axes"),
        (NODE, b"", NO_REPLY, "read element 1: no reply within 100 ms"),
        (HOST, READ, NONE, "poll axes, attempt 2"),
        (NODE, VALUE, OK, "read element 1: 5.0"),
    ]
    assert [packet.micros for packet in tape.packets] == [101_000_000, 101_130_000, 101_150_000, 101_220_000]
    assert [(packet.transaction, packet.attempt) for packet in tape.packets] == [(7, 1), (7, 1), (7, 2), (7, 2)]
    assert tape.packets[-1].notes == ("late", "cancelled")


def test_a_verdict_that_did_not_fit_into_the_recorders_memory_is_told_by_the_attempt_itself() -> None:
    tape = Tape()
    tape.read(1.0).end(Verdict.NO_REPLY, "no reply within 100 ms", 1.1)
    tape.read(1.2)
    assert tape.lines()[1] == (NODE, b"", NO_REPLY, "read element 1: no reply within 100 ms")


def test_an_exchange_that_goes_on_is_not_written_for_all_its_silence() -> None:
    tape = Tape()
    tape.read(1.0)
    tape.assembler.idle(5.0)
    assert tape.packets == []
    tape.heard(6.0, VALUE)
    tape.over(6.0, Verdict.OK, 5.0)
    assert [packet.outcome for packet in tape.packets] == [NONE, OK]


@pytest.mark.parametrize("verdict", [Verdict.AMBIGUOUS, Verdict.SPOILT, Verdict.CUT_OFF])
def test_what_only_a_master_can_say_is_on_the_answer(verdict: Verdict) -> None:
    tape = Tape()
    tape.read(1.0)
    tape.heard(1.002, VALUE)
    tape.over(1.003, verdict, "so it was")
    assert tape.lines()[1] == (NODE, VALUE, Outcome[verdict.name], "read element 1: so it was")


def test_without_a_verdict_the_frames_are_judged() -> None:
    tape = Tape("hcp2")
    for reply in (VALUE, NAK, VALUE[:-1] + b"\x38", VALUE[:3], b"\x02\x30\x32\x35\x03\x34", b""):
        tape.assembler.overheard(1.0, READ, HOST)
        if reply:
            tape.assembler.overheard(1.0, reply, NODE)
    outcomes = [(outcome, comment) for direction, _, outcome, comment in tape.lines() if direction is NODE]
    assert outcomes == [
        (OK, ""),
        (REFUSED, ""),
        (GARBLED, "bad checksum 38, not 37"),
        (GARBLED, "cut short after 3 bytes"),
        (GARBLED, "wrong element: 1 was requested"),
        (NO_REPLY, "no reply"),
    ]


def test_what_comes_while_nothing_is_asked_is_a_stray_whatever_it_looks_like() -> None:
    tape = Tape("hcp2")
    tape.heard(0.5, b"\xff")
    tape.read(1.0)
    tape.heard(1.002, VALUE)
    tape.over(1.0021, Verdict.OK, 5.0)
    tape.heard(1.1, VALUE)
    tape.sent(1.15, ACK)
    tape.heard(1.2, b"\x00")
    assert tape.lines() == [
        (NODE, b"\xff", UNEXPECTED, ""),
        (HOST, READ, NONE, ""),
        (NODE, VALUE, OK, "read element 1: 5.0"),
        (NODE, VALUE, UNEXPECTED, ""),
        (HOST, ACK, NONE, ""),
        (NODE, b"\x00", UNEXPECTED, ""),
    ]
    assert [packet.transaction for packet in tape.packets] == [0, 1, 1, 0, 0, 0]


def test_noise_behind_a_reply_leaves_its_outcome_alone() -> None:
    tape = Tape()
    tape.read(1.0)
    tape.heard(1.002, VALUE + b"\x00\x00")
    tape.over(1.002, Verdict.OK, 5.0)
    assert [line[1:3] for line in tape.lines()] == [(READ, NONE), (VALUE, OK), (b"\x00\x00", UNEXPECTED)]


def test_a_reply_behind_noise_is_none_for_no_reader_looks_for_its_start() -> None:
    tape = Tape()
    tape.read(1.0)
    tape.heard(1.002, b"\x05" + NAK)
    tape.over(1.002, Verdict.GARBLED, "not a reply")
    assert [line[1:3] for line in tape.lines()] == [(READ, NONE), (b"\x05", GARBLED), (NAK, UNEXPECTED)]


def test_a_bad_packet_that_is_sent_again_ends_well() -> None:
    tape = Tape()
    tape.asked(1.0, msc.PROFILE, msc.DataRead(2008), 1)
    tape.heard(1.02, ACK + READ_REPLY[:5])
    tape.sent(1.2, NAK)
    tape.heard(1.22, READ_REPLY)
    tape.sent(1.23, ACK)
    tape.over(1.23, Verdict.OK, 1234)
    assert [line[1:3] for line in tape.lines()] == [
        (READ_PACKET, NONE),
        (ACK, NONE),
        (READ_REPLY[:5], NONE),
        (NAK, NONE),
        (READ_REPLY, OK),
        (ACK, NONE),
    ]
    assert {packet.transaction for packet in tape.packets} == {1}


def test_a_request_that_is_said_again_in_the_same_exchange_begins_no_other() -> None:
    tape = Tape()
    request = tape.asked(1.0, msc.PROFILE, msc.SetFlag(5), 2).request
    tape.heard(1.02, NAK)
    tape.sent(1.03, request)
    tape.heard(1.05, ACK)
    tape.over(1.05, Verdict.OK, None)
    assert [line[1:] for line in tape.lines()] == [
        (request, NONE, ""),
        (NAK, NONE, ""),
        (request, NONE, ""),
        (ACK, OK, "set flag 5: ok"),
    ]


def test_a_packet_whose_ack_was_lost_is_no_reply() -> None:
    tape = Tape("msc")
    tape.assembler.overheard(1.0, READ_PACKET, HOST)
    tape.assembler.overheard(1.02, READ_REPLY, NODE)
    tape.assembler.overheard(1.03, ACK, HOST)
    assert [line[2] for line in tape.lines()] == [NONE, NO_REPLY, NONE]


def test_a_reply_after_the_masters_verdict_is_a_stray_that_may_be_late() -> None:
    tape = Tape()
    tape.read(1.0)
    tape.over(1.1, Verdict.NO_REPLY, "no reply within 100 ms")
    tape.heard(1.12, VALUE)
    assert [line[1:] for line in tape.lines()][1:] == [
        (b"", NO_REPLY, "read element 1: no reply within 100 ms"),
        (VALUE, UNEXPECTED, "perhaps a late reply to read element 1"),
    ]


def test_a_broadcast_is_over_when_it_is_sent() -> None:
    everybody = bytes.fromhex("04 30 30 30 30 02 30 31 31 37 2B 30 30 30 30 03 2F")
    tape, overheard = Tape(), Tape("mentor")
    tape.asked(1.0, mentor.PROFILE, mentor.Write(1, 17, 0), 0)
    tape.over(1.1, Verdict.OK, None)
    assert tape.lines() == [(HOST, everybody, OK, "write 01.17 = +0000: ok")]
    assert (tape.packets[0].protocol, tape.packets[0].notes) == ("mentor", ())
    overheard.assembler.overheard(1.0, everybody, HOST)
    assert overheard.lines() == [(HOST, everybody, OK, "")]


def test_the_packet_of_a_broadcast_has_its_outcome_and_why_it_was_sent() -> None:
    tape = Tape()
    stop = tape.asked(1.0, mentor.PROFILE, mentor.Write(1, 17, 0), 0, purpose="safe state", number=2)
    stop.heard = False
    tape.over(1.1, Verdict.OK, None)
    [(*_, comment)] = tape.lines()
    assert comment == "write 01.17 = +0000: ok"
    assert tape.packets[0].notes == ("safe state, attempt 2", "cancelled")


def test_a_read_of_several_steps_is_closed_by_what_comes_with_the_next_request() -> None:
    tape = Tape()
    first = tape.asked(1.0, msc.PROFILE, msc.DataRead(2008), 1)
    tape.heard(1.02, ACK + READ_REPLY)
    first.end(Verdict.OK, 1234, 1.02)
    tape.asked(1.0201, msc.PROFILE, msc.DataRead(2008), 1, before=ACK)
    tape.heard(1.04, ACK)
    tape.over(1.9, Verdict.NO_REPLY, "no packet followed the ACK")
    assert tape.lines() == [
        (HOST, READ_PACKET, NONE, ""),
        (NODE, ACK, NONE, ""),
        (NODE, READ_REPLY, OK, "read data 2008: 1234"),
        (HOST, ACK, NONE, ""),
        (HOST, READ_PACKET, NONE, ""),
        (NODE, ACK, NO_REPLY, "read data 2008: no packet followed the ACK"),
    ]
    assert [packet.transaction for packet in tape.packets] == [1, 1, 1, 1, 2, 2]


def test_of_protocols_that_speak_alike_each_frame_has_its_own() -> None:
    """A CT-ANSI drive and a Mentor II answer the same request with the same bytes."""
    tape = Tape()
    reply = bytes.fromhex("02 30 31 31 37 2D 30 34 37 36 03 2C")
    for now, profile, read in (
        (1.0, mentor.PROFILE, mentor.Read(1, 17)),
        (2.0, ct_ansi.PROFILE, ct_ansi.Read(1, 17)),
        (3.0, mentor.PROFILE, mentor.Read(1, 17)),
    ):
        tape.asked(now, profile, read, 12)
        tape.heard(now + 0.01, reply)
        tape.over(now + 0.01, Verdict.OK, -476)
    assert len({packet.frame for packet in tape.packets}) == 2
    assert [packet.protocol for packet in tape.packets] == ["mentor"] * 2 + ["ct-ansi"] * 2 + ["mentor"] * 2


def test_two_protocols_may_share_a_line() -> None:
    tape = Tape()
    for profile, read in ((hcp2.PROFILE, hcp2.Read(1)), (hcp.PROFILE, hcp.Read(1)), (hcp2.PROFILE, hcp2.Read(1))):
        tape.asked(1.0, profile, read, 2)
        tape.heard(1.0, VALUE)
        tape.over(1.0, Verdict.OK, 5.0)
    assert [outcome for _, _, outcome, _ in tape.lines()] == [NONE, OK] * 3
    assert [packet.protocol for packet in tape.packets] == ["hcp2", "hcp2", "hcp", "hcp", "hcp2", "hcp2"]


def test_hcp2_nodes_may_be_declared_as_drives() -> None:
    tape = Tape("microflex")
    tape.read(1.0)
    tape.lines()
    assert tape.packets[0].protocol == "microflex"


def test_a_protocol_that_nobody_knows_here_is_recorded_as_it_passed() -> None:
    tape = Tape()
    tape.asked(1.0, replace(hcp2.PROFILE, name="of my own"), hcp2.Read(1), 2)
    tape.heard(1.01, VALUE[:3])
    tape.heard(1.02, VALUE[3:])
    tape.over(1.02, Verdict.OK, 5.0)
    assert tape.lines() == [
        (HOST, READ, NONE, ""),
        (NODE, VALUE[:3], NONE, ""),
        (NODE, VALUE[3:], OK, "read element 1: 5.0"),
    ]
    assert {(packet.protocol, packet.node) for packet in tape.packets} == {("", 2)}
    assert [packet.micros for packet in tape.packets] == [101_000_000, 101_010_000, 101_020_000]


def test_an_exchange_of_an_unknown_protocol_without_a_verdict_is_not_judged() -> None:
    tape = Tape()
    tape.asked(1.0, replace(hcp2.PROFILE, name="of my own"), hcp2.Read(1), 2)
    tape.heard(1.01, VALUE)
    assert tape.lines() == [(HOST, READ, NONE, ""), (NODE, VALUE, NONE, "")]


def test_overheard_bytes_without_a_known_protocol_have_the_times_at_which_they_passed() -> None:
    tape = Tape()
    tape.overheard(1.0, READ)
    tape.overheard(1.01, VALUE)
    tape.lines()
    assert [(packet.micros, packet.frame) for packet in tape.packets] == [(101_000_000, READ), (101_010_000, VALUE)]


def test_an_echo_is_left_out_and_one_that_differs_is_kept() -> None:
    tape = Tape(echo=True)
    tape.read(1.0)
    tape.heard(1.001, READ[:5])
    tape.heard(1.002, READ[5:] + VALUE)
    tape.over(1.002, Verdict.OK, 5.0)
    tape.read(2.0)  # its echo never comes
    tape.over(2.1, Verdict.NO_REPLY, "no reply")
    tape.asked(3.0, hcp2.PROFILE, hcp2.Read(105), 255)
    tape.heard(3.001, OTHER + NAK)
    tape.over(3.001, Verdict.REFUSED, "refused")
    tape.read(4.0)
    tape.heard(4.001, READ[:3] + b"\xff")
    tape.over(4.001, Verdict.SPOILT, "the echo differs")
    assert [line[1:3] for line in tape.lines()] == [
        (READ, NONE),
        (VALUE, OK),
        (READ, NONE),
        (b"", NO_REPLY),
        (OTHER, NONE),
        (NAK, REFUSED),
        (READ, NONE),
        (READ[:3] + b"\xff", Outcome.SPOILT),
    ]


def test_a_line_that_is_only_listened_to_is_recorded_the_same() -> None:
    told, untold = Tape("hcp2"), Tape("hcp2")
    for now, command, address, reply in (
        (1.0, hcp2.Read(1), 2, VALUE),
        (2.0, hcp2.Read(105), 255, NAK),
        (3.0, hcp2.Read(1), 2, VALUE[:4]),
        (4.0, hcp2.Read(1), 2, VALUE),
    ):
        request = told.asked(now, hcp2.PROFILE, command, address).request
        told.heard(now + 0.01, reply)
        untold.overheard(now, request + reply[:1])
        untold.overheard(now + 0.01, reply[1:])
    assert [line[1:3] for line in untold.lines()] == [line[1:3] for line in told.lines()]
    assert {packet.transaction for packet in untold.packets} == {0}


def test_that_nothing_replied_has_the_time_at_which_it_was_known() -> None:
    tape = Tape("hcp2")
    tape.overheard(1.0, READ)
    tape.overheard(2.0, READ)
    tape.assembler.idle(5.0)
    tape.overheard(6.0, READ)
    assert [line[2] for line in tape.lines()] == [NONE, NO_REPLY] * 3
    times = [packet.micros / 1e6 - 100.0 for packet in tape.packets]
    assert times == [1.0, 2.0, 2.0, 5.0, 6.0, 9.0]


def test_a_damaged_request_on_a_line_that_is_only_listened_to_has_its_fault_as_a_comment() -> None:
    tape = Tape("hcp2")
    tape.overheard(1.0, READ[:-1] + b"\x07")
    tape.overheard(1.01, NAK)
    assert [line[2:] for line in tape.lines()] == [(NONE, "bad checksum 07, not 04"), (REFUSED, "")]


def test_a_protocol_without_addresses_has_no_node_in_its_packets() -> None:
    tape = Tape()
    tape.asked(1.0, dc104.PROFILE, dc104.Read(1), dc104.PROFILE.addresses[0])
    tape.heard(1.01, bytes.fromhex("02 01 04 D2 D7"))
    tape.over(1.02, Verdict.OK, 1234)
    tape.asked(2.0, dc104.PROFILE, dc104.Read(1), dc104.PROFILE.addresses[0])
    tape.over(2.1, Verdict.NO_REPLY, "no reply")
    assert [line[2] for line in tape.lines()] == [NONE, OK, NONE, NO_REPLY]
    assert {packet.node for packet in tape.packets} == {None}


def test_an_echo_that_never_came_does_not_use_up_the_next_one() -> None:
    tape = Tape(echo=True)
    reply = bytes.fromhex("02 31 30 33 03 31")
    tape.asked(1.0, hcp.PROFILE, hcp.Write(10, (5.0,)), 1)
    tape.over(1.1, Verdict.NO_REPLY, "no reply")
    read = tape.asked(2.0, hcp.PROFILE, hcp.Read(10), 1).request
    tape.heard(2.001, read[:5])
    tape.heard(2.002, read[5:] + reply)
    tape.over(2.002, Verdict.OK, 3.0)
    assert [line[1:3] for line in tape.lines()][2:] == [(read, NONE), (reply, OK)]


def test_mscs_closing_ack_is_echoed_into_the_next_exchange() -> None:
    tape = Tape(echo=True)
    tape.sent(1.0, ACK)
    request = tape.asked(1.0, msc.PROFILE, msc.DataWrite(2008, 1234), 1).request
    tape.heard(1.02, ACK + request + ACK)
    tape.over(1.02, Verdict.OK, None)
    assert [line[1:3] for line in tape.lines()][-2:] == [(request, NONE), (ACK, OK)]
