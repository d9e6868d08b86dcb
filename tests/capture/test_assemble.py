"""From bytes to packets: one a frame, and each exchange with its outcome."""

from __future__ import annotations

from busmaster.capture.assemble import Assembler, Verdict
from busmaster.capture.frames import Direction
from busmaster.capture.pcapng import Outcome, Packet

READ = bytes.fromhex("07 30 32 02 30 31 05 04")
VALUE = bytes.fromhex("02 30 31 35 03 37")
OTHER = bytes.fromhex("07 46 46 02 36 39 05 08")
ACK, NAK = b"\x06", b"\x15"
NONE, OK, NO_REPLY, GARBLED, REFUSED, STRAY = Outcome
HOST, NODE = Direction.HOST, Direction.NODE


class Tape:
    """An assembler and what it wrote."""

    def __init__(self, protocol: str = "", echo: bool = False) -> None:
        self.packets: list[Packet] = []
        self.assembler = Assembler(self.packets.append, protocol=protocol, echo=echo, offset=100.0)

    def sent(self, now: float, data: bytes) -> None:
        self.assembler.passed(now, data, HOST)

    def heard(self, now: float, data: bytes) -> None:
        self.assembler.passed(now, data, NODE)

    def overheard(self, now: float, data: bytes) -> None:
        self.assembler.passed(now, data, Direction.UNKNOWN)

    def said(self, now: float, request: bytes, outcome: Outcome | None, comment: str) -> None:
        self.assembler.completed(now, Verdict(request, outcome, comment))

    def lines(self) -> list[tuple[Direction, bytes, Outcome, str]]:
        self.assembler.idle(9.0)
        return [(packet.direction, packet.frame, packet.outcome, packet.comment) for packet in self.packets]


def test_a_reply_in_pieces_is_one_packet_with_the_time_of_its_first_byte_and_the_requests_node() -> None:
    tape = Tape()
    tape.sent(1.0, READ)
    tape.heard(1.002, VALUE[:3])
    tape.heard(1.004, VALUE[3:])
    assert tape.lines() == [(HOST, READ, NONE, ""), (NODE, VALUE, OK, "")]
    assert [(packet.micros, packet.node) for packet in tape.packets] == [(101_000_000, 2), (101_002_000, 2)]
    assert {packet.protocol for packet in tape.packets} == {"hcp2"}


def test_the_masters_verdict_comes_after_the_next_request_and_goes_to_the_right_exchange() -> None:
    tape = Tape()
    tape.sent(1.0, READ)
    tape.heard(1.002, VALUE)
    tape.sent(1.0021, OTHER)
    tape.said(1.0022, READ, OK, "read element 1: 5.0")
    tape.heard(1.004, NAK)
    tape.said(1.0041, OTHER, REFUSED, "read element 105: node 255: refused")
    assert tape.lines() == [
        (HOST, READ, NONE, ""),
        (NODE, VALUE, OK, "read element 1: 5.0"),
        (HOST, OTHER, NONE, ""),
        (NODE, NAK, REFUSED, "read element 105: node 255: refused"),
    ]


def test_the_same_request_twice_running_gets_its_verdicts_in_order() -> None:
    tape = Tape()
    tape.sent(1.0, READ)
    tape.heard(1.002, VALUE)
    tape.sent(1.0021, READ)
    tape.said(1.0022, READ, OK, "first")
    tape.heard(1.004, VALUE)
    tape.said(1.0041, READ, OK, "second")
    assert [comment for *_, comment in tape.lines()] == ["", "first", "", "second"]


def test_a_failed_attempt_ends_in_an_empty_packet_and_the_last_one_carries_the_verdict() -> None:
    tape = Tape()
    tape.sent(1.0, READ)
    tape.sent(1.15, READ)
    tape.said(1.3, READ, NO_REPLY, "read element 1: node 2: no reply within 100 ms, 2 attempts")
    assert tape.lines() == [
        (HOST, READ, NONE, ""),
        (NODE, b"", NO_REPLY, "no reply"),
        (HOST, READ, NONE, ""),
        (NODE, b"", NO_REPLY, "read element 1: node 2: no reply within 100 ms, 2 attempts"),
    ]
    assert [packet.micros for packet in tape.packets] == [101_000_000, 101_150_000, 101_150_000, 101_300_000]


def test_without_a_verdict_the_frames_are_judged() -> None:
    tape = Tape()
    for reply in (VALUE, NAK, VALUE[:-1] + b"\x38", VALUE[:3], b"\x02\x30\x32\x35\x03\x34", b""):
        tape.sent(1.0, READ)
        if reply:
            tape.heard(1.0, reply)
    outcomes = [(outcome, comment) for direction, _, outcome, comment in tape.lines() if direction is NODE]
    assert outcomes == [
        (OK, ""),
        (REFUSED, ""),
        (GARBLED, "bad checksum 38, not 37"),
        (GARBLED, "cut short after 3 bytes"),
        (GARBLED, "wrong element: 1 was asked"),
        (NO_REPLY, "no reply"),
    ]


def test_an_unconfirmed_write_keeps_what_the_frames_say() -> None:
    tape = Tape()
    write = bytes.fromhex("07 30 31 02 30 31 35 03 34")
    tape.sent(1.0, write)
    tape.said(1.1, write, None, "write element 1 = 5: node 1: no reply within 100 ms, 1 attempt")
    assert tape.lines()[1][2:] == (NO_REPLY, "write element 1 = 5: node 1: no reply within 100 ms, 1 attempt")


def test_strays_are_marked_and_never_taken_for_a_reply() -> None:
    tape = Tape()
    tape.heard(0.5, b"\xff")
    tape.sent(1.0, READ)
    tape.heard(1.002, VALUE)
    tape.said(1.0021, READ, OK, "read element 1: 5.0")
    tape.heard(1.1, VALUE)
    tape.heard(1.2, b"\x00")
    assert tape.lines() == [
        (NODE, b"\xff", STRAY, ""),
        (HOST, READ, NONE, ""),
        (NODE, VALUE, OK, "read element 1: 5.0"),
        (NODE, VALUE, STRAY, ""),
        (NODE, b"\x00", STRAY, ""),
    ]


def test_noise_behind_a_reply_leaves_its_outcome_alone() -> None:
    tape = Tape()
    tape.sent(1.0, READ)
    tape.heard(1.002, VALUE + b"\x00\x00")
    tape.sent(1.1, READ)
    assert tape.lines()[1:3] == [(NODE, VALUE, OK, ""), (NODE, b"\x00\x00", STRAY, "")]


def test_a_reply_behind_noise_is_none_for_no_reader_looks_for_its_start() -> None:
    tape = Tape()
    tape.sent(1.0, READ)
    tape.heard(1.002, b"\x05" + NAK)
    assert [line[1:3] for line in tape.lines()] == [(READ, NONE), (b"\x05", GARBLED), (NAK, STRAY)]


def test_a_bad_packet_that_is_sent_again_ends_well() -> None:
    tape = Tape()
    request = bytes.fromhex("02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74")
    reply = bytes.fromhex("02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D")
    tape.sent(1.0, request)
    tape.heard(1.02, ACK + reply[:5])
    tape.sent(1.2, NAK)
    tape.heard(1.22, reply)
    tape.sent(1.23, ACK)
    assert [line[1:3] for line in tape.lines()] == [
        (request, NONE),
        (ACK, NONE),
        (reply[:5], NONE),
        (NAK, NONE),
        (reply, OK),
        (ACK, NONE),
    ]


def test_a_packet_whose_ack_was_lost_is_no_reply() -> None:
    tape = Tape()
    tape.sent(1.0, bytes.fromhex("02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74"))
    tape.heard(1.02, bytes.fromhex("02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"))
    tape.sent(1.03, ACK)
    assert [line[2] for line in tape.lines()] == [NONE, NO_REPLY, NONE]


def test_a_reply_after_the_masters_verdict_is_a_stray() -> None:
    tape = Tape()
    tape.sent(1.0, READ)
    tape.said(1.1, READ, NO_REPLY, "read element 1: node 2: no reply within 100 ms, 1 attempt")
    tape.heard(1.12, VALUE)
    assert [line[1:3] for line in tape.lines()] == [(READ, NONE), (b"", NO_REPLY), (VALUE, STRAY)]


def test_a_broadcast_is_over_when_it_is_sent() -> None:
    tape = Tape()
    everybody = bytes.fromhex("04 30 30 30 30 02 30 31 31 37 2B 30 30 30 30 03 2F")
    tape.sent(1.0, everybody)
    assert tape.lines() == [(HOST, everybody, OK, "")]
    assert tape.packets[0].protocol == "mentor"


def test_an_msc_read_is_four_packets_and_its_reply_has_the_outcome() -> None:
    tape = Tape()
    request = bytes.fromhex("02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74")
    reply = bytes.fromhex("02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D")
    tape.sent(1.0, request)
    tape.heard(1.02, ACK + reply)
    tape.sent(1.0201, ACK)
    tape.said(1.0202, request, OK, "read 2008: 1234")
    assert tape.lines() == [
        (HOST, request, NONE, ""),
        (NODE, ACK, NONE, ""),
        (NODE, reply, OK, "read 2008: 1234"),
        (HOST, ACK, NONE, ""),
    ]
    tape.sent(2.0, request)
    tape.heard(2.02, ACK)
    assert tape.lines()[-1] == (NODE, ACK, NO_REPLY, "nothing came after the ACK")


def test_two_protocols_may_share_a_line() -> None:
    tape = Tape()
    hcp = bytes.fromhex("04 32 32 02 30 31 05")
    for request in (READ, hcp, READ):
        tape.sent(1.0, request)
        tape.heard(1.0, VALUE)
    assert [outcome for _, _, outcome, _ in tape.lines()] == [NONE, OK] * 3
    assert [packet.protocol for packet in tape.packets] == ["hcp2", "hcp2", "hcp", "hcp", "hcp2", "hcp2"]


def test_hcp2_nodes_may_be_declared_as_drives() -> None:
    tape = Tape("microflex")
    tape.sent(1.0, READ)
    tape.lines()
    assert tape.packets[0].protocol == "microflex"


def test_an_echo_is_left_out_and_one_that_differs_is_kept() -> None:
    tape = Tape(echo=True)
    tape.sent(1.0, READ)
    tape.heard(1.001, READ[:5])
    tape.heard(1.002, READ[5:] + VALUE)
    tape.sent(2.0, READ)  # its echo never comes
    tape.sent(3.0, OTHER)
    tape.heard(3.001, OTHER + NAK)
    tape.sent(4.0, READ)
    tape.heard(4.001, READ[:3] + b"\xff")
    assert [line[1:3] for line in tape.lines()] == [
        (READ, NONE),
        (VALUE, OK),
        (READ, NONE),
        (b"", NO_REPLY),
        (OTHER, NONE),
        (NAK, REFUSED),
        (READ, NONE),
        (READ[:3] + b"\xff", GARBLED),
    ]


def test_a_line_that_is_only_listened_to_is_recorded_the_same() -> None:
    told, untold = Tape("hcp2"), Tape("hcp2")
    for now, request, reply in ((1.0, READ, VALUE), (2.0, OTHER, NAK), (3.0, READ, VALUE[:4]), (4.0, READ, VALUE)):
        told.sent(now, request)
        told.heard(now + 0.01, reply)
        untold.overheard(now, request + reply[:1])
        untold.overheard(now + 0.01, reply[1:])
    assert [line[1:3] for line in untold.lines()] == [line[1:3] for line in told.lines()]


def test_an_echo_that_never_came_does_not_use_up_the_next_one() -> None:
    tape = Tape(echo=True)
    write, read = bytes.fromhex("04 31 31 02 31 30 35 03 37"), bytes.fromhex("04 31 31 02 31 30 05")
    tape.sent(1.0, write)
    tape.sent(2.0, read)
    tape.heard(2.001, read[:5])
    tape.heard(2.002, read[5:] + bytes.fromhex("02 31 30 33 03 31"))
    assert [line[1:3] for line in tape.lines()][2:] == [(read, NONE), (bytes.fromhex("02 31 30 33 03 31"), OK)]


def test_mscs_closing_ack_is_echoed_into_the_next_exchange() -> None:
    tape = Tape(echo=True)
    request = bytes.fromhex("02 01 00 0D 00 00 44 57 52 49 54 45 2C 07 D8 00 00 04 D2 03 BE")
    tape.sent(1.0, ACK)
    tape.sent(1.0, request)
    tape.heard(1.02, ACK + request + ACK)
    assert [line[1:3] for line in tape.lines()][-2:] == [(request, NONE), (ACK, OK)]
