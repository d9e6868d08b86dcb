"""The printed vectors, and the rule that only some frames show."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from busmaster.wire.checks import bcc, sum8, sum16, xor


def test_an_hcp_checksum_is_the_xor_of_everything_after_stx_through_etx() -> None:
    assert xor(b"01123.456\x03") == 0x2B  # AN00110: Comms(1) = 123.456


def test_an_hcp_checksum_may_be_any_control_character() -> None:
    values = ("11", "10", "17", "16", "15", "14", "10.8")  # docs/protocols/hcp.md
    assert [xor(b"01" + v.encode() + b"\x03") for v in values] == [0x02, 0x03, 0x04, 0x05, 0x06, 0x07, 0x15]


def test_the_mentor_guide_prints_a_comma() -> None:
    assert bcc(b"0117-0476\x03") == ord(",")


def test_a_bcc_below_32_gets_32_added() -> None:
    assert bcc(b"042601\x03") == 0x02 + 0x20
    assert bcc(b"0117+04765\x03") == 0x1F + 0x20
    assert bcc(b"0125+076.4\x03") == ord("%")  # printed in the UD78 guide


def test_the_printed_comma_proves_that_mentor_sends_no_decimal_point() -> None:
    assert bcc(b"0117-047.6\x03") == 0x22


def test_an_msc_checksum_is_the_sum_of_unit_through_body() -> None:
    assert sum16(b"\x01\x00\x0d\x00\x00DWRITE,\x07\xd8\x00\x00\x04\xd2") == 958  # printed in IB-11A002


def test_the_largest_msc_packet_does_not_overflow() -> None:
    assert sum16(b"\xff" * 243) == 61_965


def test_a_dc104_checksum_is_a_sum_modulo_256() -> None:
    assert sum8(b"\x55\x01\x04\xd2") == 0x2C
    assert sum8(b"\x55\x02\xff\xff") == 0x55


@given(st.binary(max_size=40), st.integers(0, 255))
def test_an_xor_over_a_frame_and_its_checksum_is_zero(data: bytes, last: int) -> None:
    frame = data + bytes([last])
    assert xor(frame + bytes([xor(frame)])) == 0


@given(st.text(alphabet=[chr(c) for c in range(0x20, 0x7F)], max_size=20))
def test_a_bcc_is_never_a_control_character_nor_above_seven_bits(text: str) -> None:
    assert 0x20 <= bcc(text.encode() + b"\x03") <= 0x7F
