"""HCP as AN00110 describes it; frames of the vectors and of docs/protocols/hcp.md."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.contract.exchange import Done, FrameError
from busmaster.errors import InvalidCommand, Refused
from busmaster.protocols._comms.codec import is_read_back, telegrams
from busmaster.protocols.hcp.codec import PROFILE, Read, Write
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.wire.checks import xor
from busmaster.wire.numbers import LONGEST_LIST, format_list
from tests.protocols.asking import answer, debris, outcome, single_bytes, vectors

FRAMES = vectors("HCP")
TIMINGS = PROFILE.timings

REQUESTS: dict[str, tuple[int, Read | Write]] = {
    "write node 2 Comms(1)=123.456": (2, Write(1, (123.456,))),
    "read node 2 Comms(1)": (2, Read(1)),
    "write node 13 (D) Comms(12)=5": (13, Write(12, (5,))),
    'write node 0 Comms(10..12)="1234,-45.6,11.2"': (0, Write(10, (1234, -45.6, 11.2))),
    "read node 13 Comms(99)": (13, Read(99)),
    "write node 15 Comms(1)=.5": (15, Write(1, (0.5,))),
}
REPLIES = {
    "reply Comms(1)=123.456": (Read(1), 123.456),
    "reply Comms(99)=-0.0001": (Read(99), -0.0001),
    "reply Comms(4)=0": (Read(4), 0.0),
}
NEVER_SENT: dict[str, Callable[[], object]] = {
    'write node 1 Comms(99)="1,2" (2nd value out of range -> NAK)': lambda: Write(99, (1, 2)),
    "read node 1 Comms(00) (-> NAK)": lambda: Read(0),
}


def reply(element: int, text: str) -> bytes:
    body = f"{element:02d}{text}\x03".encode()
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
def test_what_a_controller_must_refuse_is_refused_before_it_is_sent(name: str) -> None:
    with pytest.raises(InvalidCommand, match="element"):
        NEVER_SENT[name]()


@pytest.mark.parametrize(
    ("value", "check"),
    [(11, 0x02), (10, 0x03), (17, 0x04), (16, 0x05), (15, 0x06), (14, 0x07), (10.8, 0x15)],
)
def test_checksums_that_are_control_characters_are_sent_and_read(value: float, check: int) -> None:
    request = Write(1, (value,)).open(1, TIMINGS).request
    assert request == b"\x0411\x0201%g\x03" % value + bytes([check])
    assert answer(Read(1).open(1, TIMINGS), *single_bytes(b"\x02" + request[4:])) == value


def test_a_read_has_no_checksum() -> None:
    assert Read(1).open(15, TIMINGS).request == b"\x04FF\x0201\x05"


def test_every_other_element_in_the_echo_is_a_frame_error() -> None:
    for other in set(range(100)) - {10}:
        assert outcome(Read(10).open(1, TIMINGS), [reply(other, "5")]) is FrameError


def test_the_echo_is_decimal_where_hcp2_has_hexadecimal() -> None:
    assert answer(Read(10).open(1, TIMINGS), reply(10, "5")) == 5.0
    assert outcome(hcp2.Read(10).open(1, hcp2.PROFILE.timings), [reply(10, "5")]) is FrameError


def test_answers_to_writes() -> None:
    assert Write(1, (5,)).open(1, TIMINGS).feed(b"\x06") == Done(None)
    with pytest.raises(Refused) as single:
        Write(1, (5,)).open(1, TIMINGS).feed(b"\x15")
    with pytest.raises(Refused, match="may be stored") as several:
        Write(98, (1, 2)).open(1, TIMINGS).feed(b"\x15")
    assert single.value.confirm
    assert not several.value.confirm


@pytest.mark.parametrize("element", [0, 100, -1])
def test_an_element_is_a_number_from_1_to_99(element: int) -> None:
    with pytest.raises(InvalidCommand, match="1 to 99"):
        Read(element)
    with pytest.raises(InvalidCommand, match="1 to 99"):
        Write(element, (1,))


def test_a_node_is_a_number_from_0_to_15() -> None:
    PROFILE.check_address(15)
    with pytest.raises(InvalidCommand):
        PROFILE.check_address(16)


@given(debris(reply(10, "5"), reply(10, "-.5")), st.sampled_from([Read(10), Write(10, (5, 6))]))
def test_garbage_is_a_frame_error_or_a_refusal_however_it_is_cut(chunks: list[bytes], command: Read | Write) -> None:
    whole = b"".join(chunks)
    together = outcome(command.open(1, TIMINGS), [whole])
    assert outcome(command.open(1, TIMINGS), chunks) == together
    assert outcome(command.open(1, TIMINGS), single_bytes(whole)) == together


@given(st.lists(st.floats(-1e9, 1e9), max_size=40))
def test_a_long_list_is_cut_into_full_telegrams(values: list[float]) -> None:
    parts = list(telegrams(values))
    assert [value for _, part in parts for value in part] == values
    assert [start for start, _ in parts] == [sum(len(p) for _, p in parts[:i]) for i in range(len(parts))]
    for (_, part), (_, following) in pairwise(parts):
        format_list(part)
        assert len(",".join([format_list(part), format_list(following[:1])])) > LONGEST_LIST


def test_ten_values_of_five_characters_fill_one_telegram() -> None:
    assert [len(part) for _, part in telegrams([12345.0] * 21)] == [10, 10, 1]


@pytest.mark.parametrize(
    ("written", "read"),
    [
        (123.456, 123.456),
        (0.12345, 0.1235),
        (16777217, 16777216),
        (0, -0.0),
        (1234567.8912, 1234567.875),
        (0.5, 0.50002),
    ],
)
def test_a_value_kept_in_single_precision_counts_as_stored(written: float, read: float) -> None:
    assert is_read_back(written, read)


@pytest.mark.parametrize(("written", "read"), [(5, 5.0001), (5, 0), (0.0001, 0), (1, 1e300)])
def test_another_value_does_not(written: float, read: float) -> None:
    assert not is_read_back(written, read)
