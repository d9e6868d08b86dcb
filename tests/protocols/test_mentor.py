"""Mentor II as its guide describes it; frames of the vectors and of docs/protocols/mentor.md."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.contract.exchange import MORE, Command, Done, Expect, FrameError
from busmaster.contract.profile import Batch
from busmaster.errors import InvalidCommand, NoSuchParameter, Refused
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor.codec import CHAINED, PROFILE, Read, ReadRun, Write, merge_runs, parse_parameter
from busmaster.wire.checks import bcc
from tests.protocols.asking import answer, debris, outcome, single_bytes, vectors

FRAMES = vectors("Mentor")
TIMINGS = PROFILE.timings

REQUESTS: dict[str, tuple[int, Read | Write]] = {
    "write drive 14 01.17 = -0476": (14, Write(1, 17, -476)),
    "read drive 12 01.17": (12, Read(1, 17)),
    "hi-res write drive 14 01.17 = +04765": (14, Write(1, 17, 4765, high_resolution=True)),
    "bit write drive 23 04.26... = 1": (23, Write(4, 26, True)),
    "wide integer write drive 5 15.60 = 54321": (5, Write(15, 60, 54321, wide=True)),
    "broadcast write 00 01.17 = +0000": (0, Write(1, 17, 0)),
    "read drive 12 17.23 (unknown -> EOT)": (12, Read(17, 23)),
}
REPLIES = {
    "reply 01.17 = -0476": (Read(1, 17), -476),
    "wide integer reply 15.60 = 54321": (Read(15, 60), 54321),
    "reply 03.02 = +0000": (Read(3, 2), 0),
}
ANOTHER_SPELLING = {"bit write drive 23 04.26 = 01"}
"""A drive takes it, but busmaster writes a bit as one digit: its BCC is in test_checks."""


def reply(parameter: str, text: str) -> bytes:
    body = f"{parameter}{text}\x03".encode()
    return b"\x02" + body + bytes([bcc(body)])


def test_every_frame_of_the_vectors_is_sent_or_read() -> None:
    assert FRAMES.keys() == REQUESTS.keys() | REPLIES.keys() | ANOTHER_SPELLING


@pytest.mark.parametrize("name", REQUESTS)
def test_requests_are_sent_as_the_document_says(name: str) -> None:
    address, command = REQUESTS[name]
    assert command.open(address, TIMINGS).request == FRAMES[name]


@pytest.mark.parametrize("name", REPLIES)
def test_replies_are_read_whole_and_byte_by_byte(name: str) -> None:
    command, value = REPLIES[name]
    assert answer(command.open(1, TIMINGS), FRAMES[name]) == value
    assert answer(command.open(1, TIMINGS), *single_bytes(FRAMES[name])) == value


@pytest.mark.parametrize("frame", [*vectors("CT-ANSI").values(), FRAMES["bit write drive 23 04.26 = 01"]])
def test_the_printed_bccs_of_later_products_follow_the_same_rule(frame: bytes) -> None:
    assert frame[-1] == bcc(frame[frame.index(b"\x02") + 1 : -1])


def test_a_reply_is_read_through_its_parity_bits() -> None:
    frame = FRAMES["reply 01.17 = -0476"]
    even = bytes(byte | (byte.bit_count() % 2) << 7 for byte in frame)
    assert even != frame
    assert even[0] in Read(1, 17).open(12, TIMINGS).starts
    assert answer(Read(1, 17).open(12, TIMINGS), even) == -476
    assert outcome(Write(1, 17, 5).open(12, TIMINGS), [b"\x86"]) == ("value", None)


def test_eot_means_that_there_is_no_such_parameter() -> None:
    for command in (Read(17, 23), ReadRun(17, 23, 2)):
        with pytest.raises(NoSuchParameter):
            command.open(12, TIMINGS).feed(b"\x04")


@pytest.mark.parametrize("heard", ["04", "84"])
def test_eot_in_place_of_an_ack_may_be_one_with_a_flipped_bit(heard: str) -> None:
    """Where the port does not check parity, the write may have been carried out: it is neither refused nor repeated."""
    assert outcome(Write(17, 23, 5).open(12, TIMINGS), [bytes.fromhex(heard)]) is FrameError


def test_nak_is_a_refusal_worth_confirming() -> None:
    for command in (Read(1, 17), Write(1, 17, 5)):
        with pytest.raises(Refused) as refusal:
            command.open(12, TIMINGS).feed(b"\x15")
        assert type(refusal.value) is Refused
        assert refusal.value.confirm


@pytest.mark.parametrize(
    "frame",
    [
        reply("0118", "-0476"),
        reply("0217", "-0476"),
        reply("0117", "-047.6"),
        reply("0117", "-47.6"),
        reply("0117", "4-76"),
        reply("0117", ""),
        reply("0117", "+"),
        b"\x06",
    ],
)
def test_another_parameter_or_no_whole_number_is_a_frame_error(frame: bytes) -> None:
    assert outcome(Read(1, 17).open(12, TIMINGS), [frame]) is FrameError
    assert outcome(Read(1, 17).open(12, TIMINGS), single_bytes(frame)) is FrameError


def test_a_bit_may_come_as_one_digit_or_two() -> None:
    for text in ("1", "01", "+0001"):
        assert answer(Read(4, 26).open(23, TIMINGS), reply("0426", text)) == 1


def test_a_bad_bcc_of_a_whole_reply_needs_no_wait_for_late_replies() -> None:
    with pytest.raises(FrameError) as failure:
        Read(1, 17).open(12, TIMINGS).feed(FRAMES["reply 01.17 = -0476"][:-1] + b"-")
    assert failure.value.whole


@pytest.mark.parametrize(
    ("write", "text"),
    [
        (Write(1, 17, 9999), "+9999"),
        (Write(1, 17, -9999), "-9999"),
        (Write(1, 17, 0), "+0000"),
        (Write(1, 17, 99999, high_resolution=True), "+99999"),
        (Write(1, 17, -5, high_resolution=True), "-00005"),
        (Write(15, 60, 65535, wide=True), "65535"),
        (Write(15, 60, 7, wide=True), "00007"),
        (Write(4, 26, False), "0"),
    ],
)
def test_each_kind_of_value_has_its_own_number_of_characters(write: Write, text: str) -> None:
    assert (
        write.open(5, TIMINGS).request[5:-1] == b"\x02%02d%02d" % (write.menu, write.number) + text.encode() + b"\x03"
    )


@pytest.mark.parametrize(
    "arguments",
    [
        {"value": 10000},
        {"value": -10000},
        {"value": 12000},  # as six characters it would be taken for 1200
        {"value": 5.5},
        {"value": "5"},
        {"value": -1, "wide": True},
        {"value": 65536, "wide": True},
        {"value": 100000, "high_resolution": True},
        {"value": 5, "wide": True, "high_resolution": True},
        {"value": 5, "menu": 100},
        {"value": 5, "number": -1},
    ],
)
def test_a_value_that_does_not_fit_is_refused_before_it_is_sent(arguments: dict[str, Any]) -> None:
    with pytest.raises(InvalidCommand):
        Write(**{"menu": 1, "number": 17, **arguments})


def test_a_run_tells_the_value_of_each_parameter() -> None:
    assert [step.sent for step in ReadRun(1, 17, 3).open(1, PROFILE.timings).later] == [1, 1], (
        "a byte asks for the next"
    )
    assert ReadRun(1, 17, 3).place_values((5, 6, 7), PROFILE) == {(1, 17): 5, (1, 18): 6, (1, 19): 7}
    assert ReadRun(1, 19, 2, step=-1).place_values((5, 6), PROFILE) == {(1, 19): 5, (1, 18): 6}


def test_a_write_says_what_its_parameter_holds_then_in_the_parameters_own_unit() -> None:
    assert Write(1, 17, 4765, high_resolution=True).changes(PROFILE) == {(1, 17): 476.5}
    assert Write(1, 17, -476).changes(PROFILE) == {(1, 17): -476}


def test_a_write_to_all_waits_for_no_answer() -> None:
    exchange = Write(1, 17, 0).open(0, TIMINGS)
    assert not exchange.answered
    assert exchange.expired(False) == Done(None)
    assert exchange.feed(b"\x06") == Done(None, rest=b"\x06")
    assert exchange.timing.driver_release_time == TIMINGS.write.late_after


def test_a_read_never_goes_to_all() -> None:
    for command in (Read(1, 17), ReadRun(1, 17, 2)):
        with pytest.raises(InvalidCommand, match="all drives"):
            command.open(0, TIMINGS)


# runs


def answers(first: int, count: int, step: int = 1) -> list[bytes]:
    return [reply(f"01{first + step * i:02d}", f"{100 + i:+05d}") for i in range(count)]


@pytest.mark.parametrize(("step", "short"), [(1, b"\x06"), (-1, b"\x08"), (0, b"\x15")])
def test_a_run_asks_for_each_further_parameter_with_one_byte(step: int, short: bytes) -> None:
    exchange = ReadRun(1, 17, 3, step).open(12, TIMINGS)
    first, second, third = answers(17, 3, step)
    assert exchange.request == FRAMES["read drive 12 01.17"]
    assert exchange.feed(first) == Expect(TIMINGS.read, exchange.sizes, short)
    assert exchange.feed(b"") is MORE
    assert exchange.feed(second[:4]) is MORE
    assert exchange.feed(second[4:]) == Expect(TIMINGS.read, exchange.sizes, short)
    assert exchange.feed(third) == Done((100, 101, 102))


def test_20_parameters_in_a_run_take_at_most_65_percent_of_the_bytes_of_20_reads() -> None:
    run, single = ReadRun(1, 17, 20).open(12, TIMINGS), Read(1, 17).open(12, TIMINGS)
    together = len(run.request) + run.sizes.typical + sum(step.sent + step.sizes.typical for step in run.later)
    assert together <= 0.65 * 20 * (len(single.request) + single.sizes.typical)


def test_a_run_of_one_is_a_read() -> None:
    assert ReadRun(1, 17, 1).open(12, TIMINGS).feed(answers(17, 1)[0]) == Done((100,))


def test_a_skipped_parameter_in_a_run_is_a_frame_error() -> None:
    exchange = ReadRun(1, 17, 3).open(12, TIMINGS)
    exchange.feed(answers(17, 1)[0])
    assert outcome(exchange, [reply("0119", "+0001")]) is FrameError


def test_a_run_past_the_menus_end_says_that_there_is_no_such_parameter() -> None:
    exchange = ReadRun(1, 17, 3).open(12, TIMINGS)
    exchange.feed(answers(17, 1)[0])
    assert outcome(exchange, [b"\x04"]) is NoSuchParameter


def test_bytes_before_the_next_parameter_was_asked_for_end_the_run() -> None:
    first, second = answers(17, 2)
    assert outcome(ReadRun(1, 17, 2).open(12, TIMINGS), [first + second]) is FrameError


def test_bytes_after_a_run_are_handed_back() -> None:
    exchange = ReadRun(1, 17, 2).open(12, TIMINGS)
    first, second = answers(17, 2)
    exchange.feed(first)
    assert exchange.feed(second + b"\x02") == Done((100, 101), rest=b"\x02")


def test_a_run_that_falls_silent_fails() -> None:
    exchange = ReadRun(1, 17, 2).open(12, TIMINGS)
    first, second = answers(17, 2)
    exchange.feed(first)
    with pytest.raises(FrameError, match="no reply"):
        exchange.expired(False)
    exchange.feed(second[:3])
    with pytest.raises(FrameError, match="cut short after 3"):
        exchange.expired(True)


@pytest.mark.parametrize("arguments", [(1, 17, 0), (1, 17, 84), (1, 17, 19, -1), (1, 17, 2, 2), (100, 1, 2)])
def test_a_run_stays_within_its_menu(arguments: tuple[int, ...]) -> None:
    with pytest.raises(InvalidCommand):
        ReadRun(*arguments)


def test_neighbours_are_merged_into_runs_of_at_most_8() -> None:
    commands: list[Command[Any]] = [
        Read(1, 18),
        Read(4, 26),
        Read(1, 17),
        Read(1, 17),
        hcp2.Read(5),
        *(Read(2, n) for n in range(9)),
    ]
    assert merge_runs(commands) == [Batch(ReadRun(1, 17, 2), (2, 0)), Batch(ReadRun(2, 0, 8), tuple(range(5, 13)))]
    assert merge_runs([]) == []


def test_runs_are_opted_into() -> None:
    assert PROFILE.merge is None
    assert CHAINED.merge is merge_runs


@given(st.lists(st.tuples(st.integers(0, 2), st.integers(0, 30)), max_size=30))
def test_every_batch_serves_what_it_reads(parameters: list[tuple[int, int]]) -> None:
    commands = [Read(*parameter) for parameter in parameters]
    served: list[int] = []
    for batch in merge_runs(commands):
        run = batch.command
        assert isinstance(run, ReadRun)
        read = [Read(run.menu, run.number + i) for i in range(run.count)]
        assert [commands[index] for index in batch.serves] == read
        served += batch.serves
    assert len(served) == len(set(served))


# the rest


@pytest.mark.parametrize(("text", "parameter"), [("1.17", (1, 17)), ("01.17", (1, 17)), ("15.6", (15, 6))])
def test_a_parameter_is_menu_and_number(text: str, parameter: tuple[int, int]) -> None:
    assert parse_parameter(text) == parameter


@pytest.mark.parametrize("text", ["117", "1.", ".17", "1.171", "1,17", "a.b", "1.17 ", "\u0661.17"])
def test_anything_else_is_no_parameter(text: str) -> None:
    with pytest.raises(InvalidCommand, match="is not a parameter"):
        parse_parameter(text)


def test_commands_say_what_they_are() -> None:
    assert str(Read(1, 17)) == "read 01.17"
    assert str(Write(1, 17, -476)) == "write 01.17 = -0476"
    assert str(ReadRun(1, 17, 20)) == "read 01.17 to 01.36"
    assert str(ReadRun(1, 17, 3, -1)) == "read 01.17 to 01.15"
    assert str(ReadRun(1, 17, 3, 0)) == "read 01.17, 3 times"


def test_reads_may_be_repeated_and_writes_only_if_the_caller_says_so() -> None:
    for read in (Read(1, 17), ReadRun(1, 17, 2)):
        assert (read.writes, read.idempotent) == (False, True)
    assert (Write(1, 17, 5).writes, Write(1, 17, 5).idempotent) == (True, False)


@pytest.mark.parametrize(
    "fits",
    [
        lambda: Read(0, 0),
        lambda: Read(99, 99),
        lambda: Write(1, 17, -9999),
        lambda: Write(1, 17, 9999),
        lambda: Write(1, 17, 0, wide=True),
        lambda: Write(1, 17, 65535, wide=True),
        lambda: Write(1, 17, -99999, high_resolution=True),
        lambda: Write(1, 17, 99999, high_resolution=True),
        lambda: ReadRun(1, 0, 100),
        lambda: ReadRun(1, 99, 100, -1),
        lambda: ReadRun(1, 5, 100, 0),
    ],
)
def test_the_least_and_the_most_can_be_sent(fits: Callable[[], Any]) -> None:
    assert fits().open(99, TIMINGS).request


@pytest.mark.parametrize(
    "mistake",
    [
        lambda: Read(-1, 0),
        lambda: Read(0, -1),
        lambda: Read(100, 0),
        lambda: Read(0, 100),
        lambda: Write(-1, 0, 1),
        lambda: Write(0, 100, 1),
        lambda: Write(1, 17, -10000),
        lambda: Write(1, 17, 10000),
        lambda: Write(1, 17, -1, wide=True),
        lambda: Write(1, 17, 65536, wide=True),
        lambda: Write(1, 17, -100000, high_resolution=True),
        lambda: Write(1, 17, 100000, high_resolution=True),
        lambda: ReadRun(1, 0, 0),
        lambda: ReadRun(1, 0, 101),
        lambda: ReadRun(1, 5, 101, 0),
        lambda: ReadRun(1, 1, 100),
        lambda: ReadRun(1, 98, 100, -1),
        lambda: ReadRun(1, 5, 2, 2),
        lambda: ReadRun(1, 5, 2, -2),
    ],
)
def test_one_less_and_one_more_cannot(mistake: Callable[[], Any]) -> None:
    with pytest.raises(InvalidCommand):
        mistake()


def test_the_profile_is_the_designs_table() -> None:
    assert (PROFILE.line.baudrate, PROFILE.line.framing) == (9600, "7E1")
    assert (PROFILE.addresses, PROFILE.broadcast) == (range(1, 100), 0)
    read = PROFILE.timings.read
    assert (read.late_after, read.window, read.max_reply_delay, read.inter_byte_timeout) == (0.05, 0.15, 0.3, 0.05)


@given(debris(*answers(17, 2)), st.sampled_from([Read(1, 17), Write(1, 17, 5)]))
def test_garbage_is_a_frame_error_or_a_refusal_however_it_is_cut(chunks: list[bytes], command: Read | Write) -> None:
    whole = b"".join(chunks)
    together = outcome(command.open(1, TIMINGS), [whole])
    assert outcome(command.open(1, TIMINGS), chunks) == together
    assert outcome(command.open(1, TIMINGS), single_bytes(whole)) == together


@given(debris(*answers(17, 2)))
def test_garbage_in_a_run_is_a_frame_error_or_a_refusal(chunks: list[bytes]) -> None:
    assert outcome(ReadRun(1, 17, 2).open(1, TIMINGS), chunks) in (
        MORE,
        FrameError,
        Refused,
        NoSuchParameter,
        ("value", (100, 101)),
    )
