"""Captures byte by byte, and there and back."""

from __future__ import annotations

import io
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.capture.pcapng import CaptureError, CutOff, Outcome, Packet, PcapngWriter, read_packets
from busmaster.contract.frames import Direction
from busmaster.registry import kinds

HEAD = bytes.fromhex(
    "0a0d0d0a 30000000 4d3c2b1a 0100 0000 ffffffffffffffff 0400 0900 6275736d61737465 72 000000 00000000 30000000"
    "01000000 28000000 9d00 0000 00000000 0200 0300 434f4d00 0900 0100 06000000 00000000 28000000"
)
"""Section header and interface description of the pcapng format: little-endian, link type 157, microseconds."""
NODE = Direction.NODE
EMPTY = Packet(0, "", Direction.HOST, b"")


def written(*packets: Packet, port: str = "") -> bytes:
    file = io.BytesIO()
    writer = PcapngWriter(file, port=port)
    for packet in packets:
        writer.write(packet)
    return file.getvalue()


def test_the_head_of_a_file() -> None:
    assert written(port="COM") == HEAD


def test_a_packet_byte_by_byte() -> None:
    ack = Packet(0x0006_2345_6789_ABCD, "hcp2", NODE, b"\x06", 5, Outcome.OK, "done", 3, ("late",), 7, 2, True)
    assert written(ack, port="COM")[len(HEAD) :] == bytes.fromhex(
        "01000000 30000000 9d00 0000 00000000 0200 0300 434f4d00 0300 0400 68637032"  # interface 1: port, protocol
        "0900 0100 06000000 00000000 30000000"
        "06000000 58000000 01000000"  # enhanced packet block, interface 1
        "45230600 cdab8967 0d000000 0d000000"  # time, captured and original length
        "02 02 01 01 0005 00000007 02 01 06 000000"  # our header (HCP2, a node, ok, node 5, request 7.2, joined), ACK
        "0100 0400 646f6e65  0100 0400 6c617465"  # comments
        "0200 0400 01000000  0400 0800 0300000000000000  00000000"  # inbound, dropped, end
        "58000000"
    )


@pytest.mark.parametrize(
    ("capture_id", "name"), [(1, "hcp"), (2, "hcp2"), (3, "microflex"), (4, "msc"), (5, "mentor"), (6, "dc104")]
)
def test_a_file_of_an_older_version_which_names_protocols_by_number_is_read(capture_id: int, name: str) -> None:
    packet = bytes((1, capture_id, Direction.NODE, Outcome.OK, 0, 5, 0x06, 0))
    head = struct.pack("<IIIIIII", 6, 40, 0, 0, 0, 7, 7)
    (read,) = read_packets(io.BytesIO(HEAD + head + packet + struct.pack("<I", 40)))
    assert read == Packet(0, name, Direction.NODE, b"\x06", 5, Outcome.OK)


packets = st.builds(
    Packet,
    micros=st.integers(0, 2**63),
    protocol=st.sampled_from(["", *kinds()]),
    direction=st.sampled_from(Direction),
    frame=st.binary(max_size=250),
    node=st.none() | st.integers(0, 255),
    outcome=st.sampled_from(Outcome),
    comment=st.text(max_size=30),
    dropped=st.integers(0, 2**40),
    notes=st.lists(st.text(max_size=10), max_size=3).map(tuple),
    transaction=st.integers(0, 2**32 - 1),
    attempt=st.integers(0, 255),
    joined=st.booleans(),
)


@pytest.mark.slow
@given(st.lists(packets, max_size=4), st.text(max_size=20))
def test_what_is_written_is_read_back(sequence: list[Packet], port: str) -> None:
    assert list(read_packets(io.BytesIO(written(*sequence, port=port)))) == sequence


def test_closing_statistics_are_skipped_over() -> None:
    file = io.BytesIO()
    writer = PcapngWriter(file)
    writer.finish(1_000_000, 7)
    file.seek(0)
    assert list(read_packets(file)) == []
    assert file.getvalue()[-32:] == bytes.fromhex(
        "00000000 00000000 40420f00 0500 0800 0700000000000000 00000000 28000000"
    )


def test_a_big_endian_file_in_nanoseconds_is_read_too() -> None:
    section = struct.pack(">IIIHHqI", 0x0A0D0D0A, 28, 0x1A2B3C4D, 1, 0, -1, 28)
    interface = struct.pack(">IIHHIHHB3xII", 1, 32, 157, 0, 0, 9, 1, 9, 0, 32)
    ticks = 1_700_000_000_123_456_789
    packet = struct.pack(">IIIIIII7sxI", 6, 40, 0, ticks >> 32, ticks & 0xFFFFFFFF, 7, 7, b"\1\6\2\0\xff\xff\x06", 40)
    (read,) = read_packets(io.BytesIO(section + interface + packet))
    assert read == Packet(1_700_000_000_123_456, "dc104", Direction.HOST, b"\x06")


@pytest.mark.parametrize(
    ("data", "complaint"),
    [
        (b"what is this", "not a pcapng file"),
        (b"\x0a", "not a pcapng file"),
        (HEAD[:-10], "cut in mid-block"),
        (HEAD[:51], "cut in mid-block"),
        (HEAD + bytes.fromhex("06000000 ffffff7f"), "damaged"),
        (HEAD.replace(b"\x9d\0", b"\x01\0") + written(EMPTY, port="COM")[len(HEAD) :], "no link type 157"),
    ],
)
def test_a_file_that_is_no_capture_of_ours_is_refused(data: bytes, complaint: str) -> None:
    with pytest.raises(CaptureError, match=complaint):
        list(read_packets(io.BytesIO(data)))


def test_the_packets_before_the_place_where_a_file_is_cut_are_read() -> None:
    """The recorder was killed, or after a loss of power the rest of the file is zeros."""
    packets = [Packet(number, "hcp2", NODE, b"\x06", 5, transaction=number) for number in (1, 2, 3)]
    whole = written(*packets)
    [last] = struct.unpack("<I", whole[-4:])
    for lost in range(1, last):
        for rest in (b"", bytes(400)):
            found: list[Packet] = []
            with pytest.raises(CutOff, match="cut in mid-block"):
                found.extend(read_packets(io.BytesIO(whole[:-lost] + rest)))
            # the last three bytes of a block are zeros anyway
            assert found == packets[: 3 if rest and lost <= 3 else 2], (lost, rest)


def test_a_packet_of_no_known_protocol_is_read_back() -> None:
    assert list(read_packets(io.BytesIO(written(EMPTY)))) == [EMPTY]


@pytest.mark.parametrize(
    "header", ["02 01 01 00 ffff", "01 09 01 00 ffff", "01 01 09 00 ffff", "01 01 01 63 ffff", "01"]
)
def test_a_packet_whose_header_means_nothing_is_refused(header: str) -> None:
    packet = bytes.fromhex(header)
    padded = packet + bytes(-len(packet) % 4)
    length = 32 + len(padded)
    block = struct.pack("<IIIIIII", 6, length, 0, 0, 0, len(packet), len(packet)) + padded + struct.pack("<I", length)
    with pytest.raises(CaptureError, match="header"):
        list(read_packets(io.BytesIO(HEAD + block)))


@pytest.mark.parametrize("wrong", [0x00, 0x01, 0x04, 0x08, 0x80, 0xFF])
def test_a_file_with_any_byte_damaged_is_read_or_refused_in_words(wrong: int) -> None:
    packets = [Packet(9, "hcp2", NODE, b"\x06", 5, Outcome.OK, "done", 3, ("late",), 7, 2)] * 2
    whole = written(*packets, port="COM")
    refused = 0
    for place in range(len(whole)):
        damaged = whole[:place] + bytes((wrong,)) + whole[place + 1 :]
        try:
            list(read_packets(io.BytesIO(damaged)))
        except CaptureError:
            refused += 1
    assert refused


def test_numbers_that_outgrow_the_header_are_cut_and_do_not_end_the_capture() -> None:
    packet = Packet(1, "hcp2", NODE, b"\x06", 5, transaction=2**32 + 7, attempt=300)
    (read,) = read_packets(io.BytesIO(written(packet)))
    assert (read.transaction, read.attempt) == (7, 255)


def test_a_note_without_a_comment_stays_a_note() -> None:
    packet = Packet(1, "hcp2", NODE, b"\x06", 5, notes=("late", "cancelled"))
    assert list(read_packets(io.BytesIO(written(packet)))) == [packet]


def test_captures_that_were_joined_are_read_as_one() -> None:
    """Each section numbers its own interfaces."""
    one, other = (Packet(1, name, NODE, b"\x06", 5) for name in ("msc", "hcp2"))
    assert list(read_packets(io.BytesIO(written(one) + written(other)))) == [one, other]


def test_an_empty_file_is_no_capture() -> None:
    with pytest.raises(CaptureError, match="the file is empty"):
        list(read_packets(io.BytesIO()))


def test_times_in_parts_of_a_power_of_two_are_read() -> None:
    interface = struct.pack("<IIHHIHHB3xII", 1, 32, 157, 0, 0, 9, 1, 0x80 | 10, 0, 32)
    packet = struct.pack("<IIIIIII7sxI", 6, 40, 0, 0, 3 * 1024 + 512, 7, 7, b"\1\6\2\0\xff\xff\x06", 40)
    (read,) = read_packets(io.BytesIO(HEAD[:48] + interface + packet))
    assert read.micros == 3_500_000


def test_a_packet_of_an_interface_that_is_not_there_is_refused() -> None:
    packet = struct.pack("<IIIIIII7sxI", 6, 40, 1, 0, 0, 7, 7, b"\1\6\2\0\xff\xff\x06", 40)
    with pytest.raises(CaptureError, match="no link type 157"):
        list(read_packets(io.BytesIO(HEAD + packet)))
