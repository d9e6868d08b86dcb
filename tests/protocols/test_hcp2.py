"""HCP2 as AN00129 describes it; frames of the vectors and of docs/protocols/hcp2.md."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.contract.exchange import MORE, Done, FrameError
from busmaster.errors import InvalidCommand, Refused
from busmaster.protocols.hcp2.codec import PROFILE, Read, Write
from busmaster.wire.checks import xor
from tests.protocols.asking import answer, debris, outcome, single_bytes, vectors

FRAMES = vectors("HCP2")
TIMINGS = PROFILE.timings

REQUESTS: dict[str, tuple[int, Read | Write]] = {
    "write node 2 Comms(1)=123.456": (2, Write(1, (123.456,))),
    "read node 2 Comms(1)": (2, Read(1)),
    'write node 13 Comms(10..12)="10,20,30"': (13, Write(10, (10, 20, 30))),
    'write node 1 Comms(38)=1 (element "26")': (1, Write(38, (1,))),
    "read node 255 Comms(105) (axis 0 encoder)": (255, Read(105)),
    "read node 1 Comms(222) (outputs bank 0)": (1, Read(222)),
    "write node 1 Comms(222)=5": (1, Write(222, (5,))),
    'write node 1 Comms(99)="7,8" (99 stored, then NAK)': (1, Write(99, (7, 8))),
    "write node 7 MicroFlex Command Word 108=128 (enable)": (7, Write(108, (128,))),
    "write node 7 MicroFlex Speed Ref 118=-25.5": (7, Write(118, (-25.5,))),
    "read node 7 MicroFlex Status 109": (7, Read(109)),
    "read node 0 Comms(255)": (0, Read(255)),
}
REPLIES = {
    "reply Comms(1)=123.456": (Read(1), 123.456),
    "reply Comms(105)=4096": (Read(105), 4096.0),
    "reply Comms(222)=5": (Read(222), 5.0),
    "reply 109=192": (Read(109), 192.0),
}
NEVER_SENT = {'write node 1 Comms(254)="1,2,3" (NAK)': lambda: Write(254, (1, 2, 3))}


def reply(element: int, text: str) -> bytes:
    body = f"{element:02X}{text}\x03".encode()
    return b"\x02" + body + bytes([xor(body)])


def test_every_frame_of_the_vectors_is_sent_read_or_refused() -> None:
    assert FRAMES.keys() == REQUESTS.keys() | REPLIES.keys() | NEVER_SENT.keys()


@pytest.mark.parametrize("name", REQUESTS)
def test_requests_are_sent_as_the_document_says(name: str) -> None:
    node, command = REQUESTS[name]
    assert command.open(node, TIMINGS).request == FRAMES[name]


@pytest.mark.parametrize("name", REPLIES)
def test_replies_are_read_whole_and_byte_by_byte(name: str) -> None:
    command, value = REPLIES[name]
    assert answer(command.open(1, TIMINGS), FRAMES[name]) == value
    assert answer(command.open(1, TIMINGS), *single_bytes(FRAMES[name])) == value


@pytest.mark.parametrize("name", NEVER_SENT)
def test_a_list_that_runs_past_element_255_is_refused_before_it_is_sent(name: str) -> None:
    with pytest.raises(InvalidCommand, match="last of the elements must be 1 to 255, not 256"):
        NEVER_SENT[name]()


def test_the_checksum_of_a_request_covers_the_node_and_stx() -> None:
    assert Write(1, (5,)).open(1, TIMINGS).request[-1] == 0x34  # 37 would be HCP's


@pytest.mark.parametrize(("element", "check"), [(1, 0x06), (2, 0x05), (3, 0x04), (4, 0x03), (5, 0x02), (17, 0x07)])
def test_the_checksum_of_a_read_may_be_a_control_character(element: int, check: int) -> None:
    assert Read(element).open(0, TIMINGS).request[-2:] == bytes([0x05, check])


@pytest.mark.parametrize("value", range(12, 18))
def test_the_checksum_of_a_write_may_be_a_control_character(value: int) -> None:
    request = Write(1, (value,)).open(1, TIMINGS).request
    assert request == b"\x0701\x0201%d\x03" % value + bytes([value - 10])


@pytest.mark.parametrize("value", ["11", "10", "17", "16", "15", "14", "10.8"])
def test_a_reply_whose_checksum_is_a_control_character_is_read(value: str) -> None:
    frame = reply(1, value)
    assert frame[-1] < 0x20
    assert answer(Read(1).open(1, TIMINGS), *single_bytes(frame)) == float(value)


def test_the_node_and_the_element_are_upper_case_hexadecimal() -> None:
    assert Read(0xAB).open(0xCD, TIMINGS).request == b"\x07CD\x02AB\x05" + bytes([xor(b"CD\x02AB\x05")])


def test_every_other_element_in_the_echo_is_a_frame_error() -> None:
    for command in (Read(1), Read(0x1A), Read(255)):
        for other in range(256):
            if other != command.element:
                assert outcome(command.open(1, TIMINGS), [reply(other, "5")]) is FrameError


def test_a_lower_case_echo_is_a_frame_error() -> None:
    body = b"1a5\x03"
    assert outcome(Read(0x1A).open(1, TIMINGS), [b"\x02" + body + bytes([xor(body)])]) is FrameError


def test_a_write_is_done_with_its_ack() -> None:
    assert Write(1, (5,)).open(1, TIMINGS).feed(b"\x06") == Done(None)


def test_a_nak_to_a_read_or_a_single_value_is_worth_asking_again() -> None:
    for command in (Read(1), Write(100, (5,))):
        with pytest.raises(Refused) as refusal:
            command.open(1, TIMINGS).feed(b"\x15")
        assert refusal.value.confirm


@pytest.mark.parametrize("behind", [b"", b"\x06"])
def test_a_nak_to_several_values_is_final_and_says_that_some_may_be_stored(behind: bytes) -> None:
    with pytest.raises(Refused, match="may be stored") as refusal:
        Write(99, (7, 8)).open(1, TIMINGS).feed(b"\x15" + behind)
    assert not refusal.value.confirm


def test_an_answer_of_the_wrong_kind_is_a_frame_error() -> None:
    assert outcome(Read(1).open(1, TIMINGS), [b"\x06"]) is FrameError
    assert outcome(Write(1, (5,)).open(1, TIMINGS), [reply(1, "5")]) is FrameError
    assert outcome(Write(1, (5, 6)).open(1, TIMINGS), [reply(1, "5")]) is FrameError


def test_a_reply_of_21_characters_is_invalid_data() -> None:
    assert outcome(Read(1).open(1, TIMINGS), [reply(1, "1" * 21)]) is FrameError
    assert answer(Read(1).open(1, TIMINGS), reply(1, "0" * 19 + "1")) == 1.0


@pytest.mark.parametrize("element", [0, 256, -1, 1.0, "1", None, True])
def test_an_element_is_a_whole_number_from_1_to_255(element: int) -> None:
    with pytest.raises(InvalidCommand, match="element"):
        Read(element)
    with pytest.raises(InvalidCommand, match="element"):
        Write(element, (5,))


def test_a_write_needs_values_that_fit() -> None:
    for values in ((), (float("nan"),), (1e20,), (12345,) * 11):
        with pytest.raises(InvalidCommand):
            Write(1, values)


def test_commands_say_what_they_are() -> None:
    assert str(Read(100)) == "read element 100"
    assert str(Write(1, (123.456,))) == "write element 1 = 123.456"
    assert str(Write(10, (10, 20, 30))) == "write elements 10-12 = 10,20,30"


def test_commands_are_values() -> None:
    assert {Read(1), Read(1), Write(1, (5,)), Write(1, (5,))} == {Read(1), Write(1, (5.0,))}
    assert Write(1, [5, 6]) == Write(1, (5, 6))  # type: ignore[arg-type]  # a list is taken, and kept as a tuple


def test_reads_may_be_repeated_and_writes_only_if_the_caller_says_so() -> None:
    assert (Read(1).writes, Read(1).idempotent) == (False, True)
    assert (Write(1, (5,)).writes, Write(1, (5,)).idempotent) == (True, False)
    assert Write(118, (5,), idempotent=True).idempotent


def test_an_exchange_says_what_it_waits_for() -> None:
    read, write = Read(1).open(1, TIMINGS), Write(1, (5,)).open(1, TIMINGS)
    assert (read.timing, read.starts, read.sizes.longest) == (TIMINGS.read, b"\x02\x15", 25)
    assert (write.timing, write.starts, write.sizes.longest) == (TIMINGS.write, b"\x06\x15", 1)
    assert all(e.answered and not e.later and not e.closing for e in (read, write))


def test_the_profile_is_the_designs_table() -> None:
    assert PROFILE.line.framing == "8N1"
    assert PROFILE.line.baudrate == 57600
    assert (PROFILE.addresses, PROFILE.broadcast, PROFILE.merge) == (range(256), None, None)
    read = PROFILE.timings.read
    assert (read.late_after, read.window, read.max_reply_delay, read.inter_byte_timeout) == (0.05, 0.1, 0.15, 0.02)


@given(st.integers(0, 255), st.integers(1, 255), st.floats(-1e9, 1e9))
def test_a_written_telegram_can_be_told_apart_by_position_alone(node: int, element: int, value: float) -> None:
    request = Write(element, (value,)).open(node, TIMINGS).request
    assert request[0] == 0x07
    assert int(request[1:3], 16) == node
    assert int(request[4:6], 16) == element
    assert request.index(b"\x03", 6) == len(request) - 2
    assert xor(request[1:]) == 0


@given(debris(reply(1, "5"), reply(1, "-.5")), st.sampled_from([Read(1), Write(1, (5,))]))
def test_garbage_is_a_frame_error_or_a_refusal_however_it_is_cut(chunks: list[bytes], command: Read | Write) -> None:
    whole = b"".join(chunks)
    together = outcome(command.open(1, TIMINGS), [whole])
    assert outcome(command.open(1, TIMINGS), chunks) == together
    assert outcome(command.open(1, TIMINGS), single_bytes(whole)) == together


@given(st.floats(-1e9, 1e9), st.integers(0, 200), st.integers(1, 255))
def test_any_single_flipped_bit_of_a_reply_is_noticed(value: float, at: int, flip: int) -> None:
    frame = bytearray(reply(7, f"{value:.4f}"))
    frame[at % len(frame)] ^= 1 << flip % 8
    if frame[0] == 0x15:
        return
    assert outcome(Read(7).open(1, TIMINGS), [bytes(frame)]) in (FrameError, MORE)


def test_only_the_refusal_of_a_reference_advises_on_its_source() -> None:
    def failure(command: Write, heard: bytes) -> Exception:
        with pytest.raises((Refused, FrameError)) as raised:
            command.open(7, TIMINGS).feed(heard)
        return raised.value

    usual = Refused().hint
    for reference, source in ((Write(116, (1,)), "TORQUERESOURCE"), (Write(118, (1,)), "SPEEDRESOURCE")):
        refusal = failure(reference, b"\x15")
        assert isinstance(refusal, Refused)
        assert source in (refusal.hint or "")
        assert all(isinstance(failure(reference, bytes([byte])), FrameError) for byte in (0x00, 0x14, 0x16, 0xFF))
    refusal = failure(Write(1, (1,)), b"\x15")
    assert isinstance(refusal, Refused)
    assert refusal.hint == usual
