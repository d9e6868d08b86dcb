"""A listener that hears both directions, mixed, and is told nothing else."""

from __future__ import annotations

from random import Random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.capture.decode import LONGEST_FRAME, Decoder
from busmaster.contract.frames import Direction, Frame, Kind
from busmaster.errors import InvalidCommand
from busmaster.protocols.mentor import codec as mentor
from busmaster.registry import find, kinds
from busmaster.testing.damage import garbage_chunks
from tests.capture.hearing import HOST, NODE, hear, said, sender_of, vectors


@pytest.mark.parametrize(("protocol", "name", "raw"), vectors())
def test_every_frame_of_the_documents_is_one_frame_with_nothing_wrong(protocol: str, name: str, raw: bytes) -> None:
    (frame,) = Decoder(find(protocol).protocol.dialect()).feed(raw, 0.0, sender_of(name))
    assert frame.raw == raw
    assert frame.fault == ("unexpected" if frame.sender is NODE else "")


def test_hcp_in_both_directions() -> None:
    frames = hear(
        "hcp",
        "04 32 32 02 30 31 05",  # AN00110: read node 2 Comms(1)
        "02 30 31 31 32 33 2E 34 35 36 03 2B",
        "04 31 31 02 39 39 31 2C 32 03 2C 15",  # 99 takes the first value, there is no 100: NAK
        "04 32 32 02 30 31 31 32 33 2E 34 35 36 03 2B 06",
    )
    assert said(frames) == [
        "host 2 read 1",
        "node 2 1 = 123.456",
        "host 1 write 99 = 1,2",
        "node 1 NAK",
        "host 2 write 1 = 123.456",
        "node 2 ACK",
    ]


def test_a_checksum_that_is_a_control_character_ends_its_frame_and_starts_none() -> None:
    frames = hear(
        "hcp2",
        "07 30 32 02 30 31 05 04",  # AN00129: read node 2 Comms(1), the checksum is EOT
        "02 30 31 31 32 33 2E 34 35 36 03 2B",
        "07 46 46 02 36 39 05 08",
        "02 36 39 34 30 39 36 03 07",  # the checksum is BEL, the next byte a true one
        "07 30 30 02 30 31 05 06",
        "15",
    )
    assert said(frames) == [
        "host 2 read 1",
        "node 2 1 = 123.456",
        "host 255 read 105",
        "node 255 105 = 4096",
        "host 0 read 1",
        "node 0 NAK",
    ]


def test_mentor_short_commands_are_the_hosts_only_after_an_answered_read() -> None:
    frames = hear(
        "mentor",
        "04 31 31 32 32 30 31 31 37 05",  # a transcript of an independent CT-ANSI node
        "02 30 31 31 37 2D 30 30 34 37 36 03 3C",
        "06",
        "02 30 31 31 38 2B 30 30 30 30 30 03 30",
        "08",
        "02 30 31 31 37 2D 30 30 34 37 36 03 3C",
        "15",
        "02 30 31 31 37 2D 30 30 34 37 36 03 3C",
        "04 31 31 32 32 02 30 31 31 37 2D 30 34 37 36 03 2C",
        "06",
        "04 31 31 32 32 02 30 31 31 37 2D 30 34 37 36 03 2D",
        "15",
    )
    assert said(frames) == [
        "host 12 read 01.17",
        "node 12 01.17 = -00476",
        "host 12 next 01.18",
        "node 12 01.18 = +00000",
        "host 12 previous 01.17",
        "node 12 01.17 = -00476",
        "host 12 again 01.17",
        "node 12 01.17 = -00476",
        "host 12 write 01.17 = -0476",
        "node 12 ACK",
        "host 12 write 01.17 = -0476 [bad checksum 2D, not 2C]",
        "node 12 NAK",
    ]


def test_a_lone_eot_says_no_such_parameter_and_one_before_digits_is_a_new_request() -> None:
    request = "04 31 31 32 32 31 37 32 33 05"
    answered = hear("mentor", request, "04", "04 31 31 32 32 30 31 31 37 05")
    assert said(answered) == ["host 12 read 17.23", "node 12 EOT", "host 12 read 01.17"]
    at_rest = hear("mentor", request, "04", "|")
    assert said(at_rest) == ["host 12 read 17.23", "node 12 EOT"]
    asked_again = hear("mentor", request, request)
    assert said(asked_again) == ["host 12 read 17.23", "host 12 read 17.23"]


def test_nobody_answers_a_mentor_broadcast() -> None:
    frames = hear("mentor", "04 30 30 30 30 02 30 31 31 37 2B 30 30 30 30 03 2F", "06")
    assert said(frames) == ["host 0 write 01.17 = +0000", "node ACK [unexpected]"]


def test_a_mentor_read_of_a_missing_parameter_can_be_continued_by_short_commands() -> None:
    frames = hear("mentor", "04 31 31 32 32 31 37 32 33 05", "04", "06")
    assert said(frames) == ["host 12 read 17.23", "node 12 EOT", "host 12 next 17.24"]


def test_a_mentor_forgets_its_last_read_with_any_other_request() -> None:
    frames = hear(
        "mentor",
        "04 31 31 32 32 30 31 31 37 05",
        "02 30 31 31 37 2D 30 30 34 37 36 03 3C",
        "04 30 30 30 30 02 30 31 31 37 2B 30 30 30 30 03 2F",  # to all drives: none replies
        "06",
    )
    assert said(frames)[-2:] == ["host 0 write 01.17 = +0000", "node ACK [unexpected]"]


def test_short_commands_with_different_steps_are_not_a_run() -> None:
    frames = hear(
        "mentor",
        "04 31 31 32 32 30 31 31 37 05",
        "02 30 31 31 37 2D 30 30 34 37 36 03 3C",
        "06",
        "02 30 31 31 38 2B 30 30 30 30 30 03 30",
        "08",
        "02 30 31 31 37 2D 30 30 34 37 36 03 3C",
    )
    read, following, previous = frames[::2]
    command = find("mentor").protocol.dialect().command
    assert command(read, [following]) == mentor.ReadRun(1, 17, 2)
    assert command(read, [following, previous]) == command(read, []) == mentor.Read(1, 17)


def test_a_capture_of_a_parameter_0_is_a_read_and_a_write_of_it() -> None:
    frames = hear("dc104", "02 AA 00 AA", "02 55 00 04 D2 2B")
    command = find("dc104").protocol.dialect().command
    assert [str(command(frame, ())) for frame in frames] == ["read parameter 0", "write parameter 0 = 1234"]


def test_parity_in_bit_7_is_not_looked_at() -> None:
    plain = bytes.fromhex("04 31 31 32 32 30 31 31 37 05")
    with_parity = bytes(byte | (byte.bit_count() % 2 << 7) for byte in plain)
    assert with_parity != plain
    assert said(hear("mentor", with_parity.hex())) == ["host 12 read 01.17"]


def test_the_steps_of_an_msc_read_and_of_a_write() -> None:
    frames = hear(
        "msc",
        "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74",
        "06 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D",  # ACK and packet in one chunk
        "06",
        "02 01 00 0D 00 00 44 57 52 49 54 45 2C 07 D8 00 00 04 D2 03 BE",
        "06",
    )
    assert said(frames) == [
        "host 1 DREAD 2008",
        "node 1 ACK",
        "node 1 2008 = 1234",
        "host 1 ACK",
        "host 1 DWRITE 2008 = 1234",
        "node 1 ACK",
    ]
    assert [frame.answers for frame in frames] == [False, True, True, False, False, True]


def test_an_msc_flag_reply_is_told_from_its_request_by_where_it_comes() -> None:
    """Both have bodies of eight bytes: RFLAG,[FF] and RFLAG,[NN]."""
    request, reply = (
        "02 0F 00 08 00 00 52 46 4C 41 47 2C 00 FF 02 AE",
        "02 0F 00 08 00 00 52 46 4C 41 47 2C 00 01 01 B0",
    )
    frames = hear("msc", request, request, "06", reply, "15", reply, reply, "06", request)
    assert said(frames) == [
        "host 15 RFLAG flag:255",
        "host 15 RFLAG flag:255",  # no ACK came: sent again
        "node 15 ACK",
        "node 15 flag:255 = 1",
        "host 15 NAK",
        "node 15 flag:255 = 1",
        "node 15 flag:255 = 1",  # the host's ACK was lost
        "host 15 ACK",
        "host 15 RFLAG flag:255",
    ]


def test_msc_packets_may_hold_any_byte_and_lists_of_flags_and_values_are_read() -> None:
    flags = bytearray(32)
    for flag in (0, 9, 31, 255):
        flags[flag // 8] |= 1 << flag % 8
    body = b"\x03\x00\x27\x00\x00RFLAGS," + bytes(flags)
    reply = b"\x02" + body + sum(body).to_bytes(2, "big")
    frames = hear("msc", "02 03 00 07 00 00 52 46 4C 41 47 53 2C 01 F5", "06", reply.hex(), "06")
    assert said(frames)[2] == "node 3 flags = 0,9,31,255"
    frames = hear("msc", "02 02 00 08 00 00 53 46 4C 41 47 2C 00 05 01 A8 06")
    assert said(frames) == ["host 2 SFLAG flag:5 = 1", "node 2 ACK"]


def test_an_msc_packet_before_the_ack_answers_something_older() -> None:
    frames = hear(
        "msc",
        "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74",
        "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D",
    )
    assert said(frames)[1] == "node 1 2008 = 1234 [before the ACK]"


def test_dc104_and_its_parameter_whose_reply_looks_like_a_request() -> None:
    frames = hear("dc104", "02 AA 01 AB", "02 01 04 D2 D7", "02 55 01 04 D2 2C", "06", "02 AA 6B 15", "15")
    assert said(frames) == [
        "host read 1",
        "node 1 = 1234",
        "host write 1 = 1234",
        "node ACK",
        "host read 107",
        "node NAK",
    ]
    assert [frame.answers for frame in frames] == [False, True] * 3
    frames = hear("dc104", "02 AA AA 54", "02 AA 00 05 AF", "02 AA AA 54", "|", "02 AA AA 54", "|")
    assert said(frames) == ["host read 170", "node 170 = 5", "host read 170", "host read 170"]


def test_what_is_wrong_with_a_reply_is_said() -> None:
    frames = hear(
        "hcp2",
        "07 30 32 02 30 31 05 04 02 30 31 31 32 33 2E 34 35 36 03 2C",
        "07 30 32 02 30 31 05 04 02 30 32 35 03 34",
        "07 30 32 02 30 31 05 04 06",
        "06",
    )
    assert said(frames)[1::2] == [
        "node 2 1 = 123.456 [bad checksum 2C, not 2B]",
        "node 2 2 = 5 [wrong element: 1 was requested]",
        "node 2 ACK [an ACK is not a reply to a read]",
    ]
    assert said(frames)[-1] == "node ACK [unexpected]"


@pytest.mark.parametrize(
    ("protocol", "frames", "last"),
    [
        ("hcp", "04 31 32 02 30 31 05", "host read 1 [no node address: '12']"),
        ("hcp", "04 31 31 02 41 31 05", "host 1 read 'A1'"),
        ("hcp2", "07 30 61 02 30 31 05 54", "host read 1 [no node address: '0a']"),
        ("hcp2", "07 30 32 02 30 61 05 54", "host 2 read '0a'"),
        ("hcp2", "07 30 31 02 30 31 35 03 34 02 30 31 35 03 37", "node 1 1 = 5 [a value is not a reply to a write]"),
        ("hcp2", "07 30 31 02 30 31 35 03 34 15 15", "node NAK [unexpected]"),
        ("hcp2", "07 30 32 02 30 31 05 04 02 30 32 35 03 35", "node 2 2 = 5 [bad checksum 35, not 34]"),
        ("hcp", "04 31 31 02 39 39 31 2C 32 03 2D", "host 1 write 99 = 1,2 [bad checksum 2D, not 2C]"),
        ("mentor", "04 31 32 33 34 30 31 31 37 05", "host read 01.17 [no drive address: '1234']"),
        ("mentor", "04 31 31 32 32 30 31 41 37 05", "host 12 read '01A7'"),
        ("mentor", "04 31 31 32 32 30 31 31 37 05 06", "node 12 ACK [an ACK is not a reply to a read]"),
        (
            "mentor",
            "04 31 31 32 32 30 31 31 37 05 02 30 31 31 38 2B 30 30 30 30 30 03 30",
            "node 12 01.18 = +00000 [wrong parameter: 01.17 was requested]",
        ),
        (
            "mentor",
            "04 32 32 33 33 02 30 34 32 36 31 03 32 02 30 34 32 36 31 03 32",
            "node 23 04.26 = 1 [a value is not a reply to a write]",
        ),
        ("mentor", "04 31 31 32 32 30 31 31 37 05 15 15", "host 12 again 01.17"),
        ("msc", "02 01 00 05 00 00 48 45 4C 50 2C 01 5B", "host 1 HELP [no command: 'HELP']"),
        ("msc", "02 01 00 07 00 00 44 52 45 41 44 2C 07 01 9B", "host 1 DREAD 7 [a body of 7 bytes, not 8]"),
        ("msc", "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 75", "host 1 DREAD 2008 [bad checksum 0275, not 0274]"),
        (
            "msc",
            "02 02 00 08 00 00 44 52 45 41 44 2C 07 D8 02 75 06 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D",
            "node 1 2008 = 1234 [wrong reply: DREAD of unit 2 was requested]",
        ),
        ("msc", "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D", "node 1 ? = 1234 [unexpected]"),
        ("msc", "06", "node ACK [unexpected]"),
        ("msc", "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74 06 06", "node 1 ACK [unexpected]"),
        (
            "msc",  # a refusal ends the request
            "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74 15 02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D",
            "node 1 ? = 1234 [unexpected]",
        ),
        ("dc104", "02 AA 01 AB 06", "node ACK [an ACK is not a reply to a read]"),
        ("dc104", "02 AA 01 AB 02 02 00 00 02", "node 2 = 0 [wrong parameter: 1 was requested]"),
        ("dc104", "02 55 01 04 D2 2C 02 01 04 D2 D7", "node 1 = 1234 [a value is not a reply to a write]"),
        ("dc104", "02 AA 01 AC", "host read 1 [bad checksum AC, not AB]"),
    ],
)
def test_what_is_wrong_with_a_frame_is_said(protocol: str, frames: str, last: str) -> None:
    assert said(hear(protocol, frames))[-1] == last


def test_a_status_word_may_be_followed_by_anything() -> None:
    """RQSTAT's [FF] and [AAAA] "are not currently used"."""
    reply = "02 01 00 09 00 00 52 51 53 54 41 54 2C 00 41 02 56"
    frames = hear("msc", "02 01 00 07 00 00 52 51 53 54 41 54 2C 02 13", "06", reply)
    assert said(frames)[-1] == "node 1 status = 65"


def test_a_mentor_write_without_an_address_goes_to_the_drive_read_last() -> None:
    decoder = Decoder(find("mentor").protocol.dialect())
    decoder.feed(bytes.fromhex("04 31 31 32 32 30 31 31 37 05"), 0.0, HOST)
    decoder.feed(bytes.fromhex("02 30 31 31 37 2D 30 34 37 36 03 2C"), 0.01, NODE)
    frames = decoder.feed(bytes.fromhex("02 30 31 31 37 2D 30 34 37 36 03 2C"), 0.02, HOST)
    assert said(frames + decoder.feed(b"\x06", 0.03, NODE)) == ["host 12 write 01.17 = -0476", "node 12 ACK"]
    fresh = Decoder(find("mentor").protocol.dialect())
    assert said(fresh.feed(b"\x06", 0.0, HOST)) == ["host next [unexpected]"]


def test_a_cut_reply_ends_at_the_next_request_or_in_silence() -> None:
    request = "07 30 32 02 30 31 05 04"
    cut = said(hear("hcp2", request, "02 30 31 31 32", request))
    assert cut == ["host 2 read 1", "unknown 5 bytes [cut short after 5 bytes]", "host 2 read 1"]
    silent = said(hear("hcp2", request, "02 30 31 31 32", "|"))
    assert silent == cut[:2]


def test_noise_is_one_line_and_the_frame_after_it_is_whole() -> None:
    frames = hear("hcp2", "00 FF 81 41", "07 30 32 02 30 31 05 04")
    assert said(frames) == ["unknown 4 bytes [no frame]", "host 2 read 1"]
    assert [said(hear("hcp2", noise, "|")) for noise in ("FF", "FF FF")] == [
        ["unknown 1 byte [no frame]"],
        ["unknown 2 bytes [no frame]"],
    ]


def test_a_request_with_another_character_in_place_of_its_start_of_text_is_noise() -> None:
    frames = hear("hcp2", "07 30 32 03 30 31 05 05", "|")
    assert {frame.kind for frame in frames} == {Kind.NOISE}


def test_delays_are_from_the_last_byte_of_the_request_to_the_first_of_the_reply() -> None:
    decoder = Decoder(find("hcp2").protocol.dialect())
    decoder.feed(bytes.fromhex("07 30 32 02"), 1.000)
    (asked,) = decoder.feed(bytes.fromhex("30 31 05 04"), 1.010)
    assert decoder.feed(bytes.fromhex("02 30 31"), 1.030) == []
    (reply,) = decoder.feed(bytes.fromhex("35 03 37"), 1.040)
    assert (asked.time, asked.delay) == (1.0, None)
    assert reply.time == 1.03
    assert reply.delay == pytest.approx(0.02)


def test_the_delay_of_a_later_step_is_from_the_end_of_the_step_before() -> None:
    decoder = Decoder(find("msc").protocol.dialect())
    frames_of = {name: raw for protocol, name, raw in vectors() if protocol == "msc"}
    request, packet = frames_of["DREAD unit 1 addr 2008"], frames_of["DREAD reply 1234"]
    frames = decoder.feed(request, 1.0) + decoder.feed(b"\x06", 1.01) + decoder.feed(packet, 1.03)
    assert [frame.delay for frame in frames] == [None, pytest.approx(0.01), pytest.approx(0.02)]


def test_a_frame_that_is_cut_short_has_the_time_of_its_first_byte() -> None:
    decoder = Decoder(find("hcp2").protocol.dialect())
    assert decoder.feed(bytes.fromhex("07 30"), 1.0) + decoder.feed(bytes.fromhex("32"), 1.01) == []
    (cut,) = decoder.quiet()
    assert (cut.time, cut.ended) == (1.0, 1.01)


def test_a_silence_of_the_gap_continues_a_frame_and_a_longer_one_ends_it() -> None:
    def pieces(pause: float) -> list[str]:
        decoder = Decoder(find("hcp2").protocol.dialect(), gap=0.5)
        frames = decoder.feed(bytes.fromhex("07 30 32 02"), 10.0)
        frames += decoder.feed(bytes.fromhex("30 31 05 04"), 10.0 + pause)
        assert decoder.unfinished is (pause > 0.5)
        return said(frames + decoder.quiet())

    assert pieces(0.5) == ["host 2 read 1"]
    assert pieces(0.6) == ["unknown 4 bytes [cut short after 4 bytes]", "unknown 4 bytes [no frame]"]


def test_a_frame_may_take_longer_than_the_gap_if_no_pause_within_it_does() -> None:
    decoder = Decoder(find("hcp").protocol.dialect(), gap=0.5)
    raw = bytes.fromhex("04 32 32 02 30 31 05")
    frames = [frame for number, byte in enumerate(raw) for frame in decoder.feed(bytes((byte,)), 0.4 * number)]
    assert said(frames) == ["host 2 read 1"]
    assert (frames[0].time, frames[0].ended) == (0.0, 0.4 * 6)


def test_a_lone_byte_is_not_reported_as_a_frame_that_was_cut_short() -> None:
    for protocol, start in (("hcp2", "07"), ("msc", "02"), ("mentor", "02")):
        (noise,) = hear(protocol, start, "|")
        assert (noise.kind, noise.fault) == (Kind.NOISE, "no frame")


def test_frames_that_came_in_one_piece_are_marked_and_end_when_it_came() -> None:
    decoder = Decoder(find("hcp2").protocol.dialect())
    request, reply = bytes.fromhex("07 30 32 02 30 31 05 04"), bytes.fromhex("02 30 31 35 03 37")
    frames = decoder.feed(request + reply + b"\xff" + request, 1.0)
    frames += decoder.feed(reply[:2], 2.0)
    frames += decoder.feed(reply[2:] + b"\xff\xff", 2.05) + decoder.quiet()
    assert [(frame.raw, frame.time, frame.ended, frame.joined) for frame in frames] == [
        (request, 1.0, 1.0, False),
        (reply, 1.0, 1.0, True),
        (b"\xff", 1.0, 1.0, True),
        (request, 1.0, 1.0, True),
        (reply, 2.0, 2.05, False),
        (b"\xff\xff", 2.05, 2.05, True),
    ]


def test_endless_noise_comes_in_frames_of_bounded_length() -> None:
    decoder = Decoder(find("hcp2").protocol.dialect())
    frames = [frame for n in range(10) for frame in decoder.feed(b"\xff" * 99, n / 100)]
    assert [len(frame.raw) for frame in frames] == [LONGEST_FRAME] * 3
    assert [frame.time for frame in frames] == [0.0, 0.02, 0.05]
    (rest,) = decoder.quiet()
    assert len(rest.raw) == 990 - 3 * LONGEST_FRAME
    assert decoder.quiet() == []


def test_a_sender_that_is_known_is_believed() -> None:
    decoder = Decoder(find("hcp2").protocol.dialect())
    assert decoder.feed(bytes.fromhex("02 30 31"), 0.0, NODE) == []
    frames = decoder.feed(bytes.fromhex("07 30 32 02 30 31 05 04"), 0.001, HOST)
    assert said(frames) == ["node 3 bytes [cut short after 3 bytes]", "host 2 read 1"]


@pytest.mark.parametrize(
    ("protocol", "request_", "answer"),
    [
        ("hcp2", "07 30 30 02 30 31 05 06", "15"),  # its checksum is ACK
        ("hcp", "04 31 31 02 30 31 31 35 03 06", "06"),
        ("mentor", "04 31 31 32 32 30 31 31 37 05", "04"),
    ],
)
def test_a_request_that_the_host_receives_is_no_answer_to_it(protocol: str, request_: str, answer: str) -> None:
    decoder = Decoder(find(protocol).protocol.dialect())
    decoder.feed(bytes.fromhex(request_), 0.0, HOST)
    echo, reply = decoder.feed(bytes.fromhex(request_ + answer), 0.001, NODE)
    assert (echo.kind, echo.fault, echo.raw) == (Kind.NOISE, "a request, received", bytes.fromhex(request_))
    assert (reply.sender, reply.answers) == (NODE, True)


def test_a_protocol_that_does_not_exist_is_refused_by_name() -> None:
    with pytest.raises(InvalidCommand, match="no such protocol 'hcp3'; did you mean 'hcp'"):
        find("hcp3").protocol.dialect()


CHUNKS = st.lists(
    st.one_of(
        st.sampled_from([raw for _, _, raw in vectors() if len(raw) < 60]),
        st.sampled_from([b"\x02", b"\x03", b"\x04", b"\x05", b"\x06", b"\x07", b"\x08", b"\x15", b"0"]),
        st.binary(max_size=6),
    ),
    max_size=8,
)


@given(protocol=st.sampled_from(sorted(kinds())), chunks=CHUNKS, cut=st.integers(0, 60))
def test_every_byte_is_accounted_for_and_chunks_change_nothing(protocol: str, chunks: list[bytes], cut: int) -> None:
    data = b"".join(chunks)[:240]
    at_once, in_two, bytewise = (
        decode_all(protocol, *parts)
        for parts in ([data], [data[:cut], data[cut:]], [data[at : at + 1] for at in range(len(data))])
    )
    assert b"".join(frame.raw for frame in at_once) == data
    assert said(at_once) == said(in_two) == said(bytewise)
    assert all(frame.fault for frame in at_once if frame.kind is Kind.NOISE)


@pytest.mark.slow
@pytest.mark.parametrize("protocol", sorted(kinds()))
@pytest.mark.parametrize("sender", Direction)
def test_whoever_is_said_to_speak_no_bytes_are_too_odd_for_a_listener(protocol: str, sender: Direction) -> None:
    """Requests with a byte changed, lost or doubled: a capture may hold them, from either side."""
    profile = find(protocol).profile
    rnd = Random(1)
    requests = [check.open(profile.addresses[0], profile.timings).request for check in profile.sync_reads]
    for _ in range(300):
        decoder = Decoder(find(protocol).protocol.dialect())
        said_of_it = [*garbage_chunks(rnd, rnd.choice(requests)), *garbage_chunks(rnd, rnd.choice(requests))]
        frames = [frame for chunk in said_of_it if chunk for frame in decoder.feed(chunk, 0.0, sender)]
        assert b"".join(frame.raw for frame in frames + decoder.quiet()) == b"".join(said_of_it)


def test_a_request_whose_function_is_a_refusals_is_no_frame_of_a_modbus_host() -> None:
    decoder = Decoder(find("modbus").protocol.dialect())
    (frame,) = [*decoder.feed(bytes.fromhex("11 83 00 64 00 02 00 00"), 0.0, Direction.HOST), *decoder.quiet()]
    assert frame.kind is Kind.NOISE


def decode_all(protocol: str, *chunks: bytes) -> list[Frame]:
    decoder = Decoder(find(protocol).protocol.dialect())
    frames = [frame for chunk in chunks for frame in decoder.feed(chunk, 0.0)]
    return frames + decoder.quiet()
