"""EI-Bisynch: the frames of the manuals, the conformance kit, the emulated instrument and what its users hold."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Hashable
from itertools import cycle
from random import Random
from typing import Any

import pytest

from busmaster import ext
from busmaster.bus.bus import Bus
from busmaster.contract.exchange import MORE, Command, Done, Expect, FrameError
from busmaster.contract.frames import UNEXPECTED, Direction, Frame
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand, NoSuchParameter, Refused, VerifyFailed
from busmaster.protocols.ei_bisynch import PROTOCOL, BisynchInstrument
from busmaster.protocols.ei_bisynch.capture import BisynchDialect
from busmaster.protocols.ei_bisynch.codec import PRINTABLE, PROFILE, Read, ReadRun, Write, is_sendable
from busmaster.protocols.ei_bisynch.device import EmulatedBisynch, make_device
from busmaster.protocols.ei_bisynch.parameters import error_text, mnemonic_of_tag
from busmaster.testing import Case, RoundTrip, answers_of, check_dialect, check_protocol, run_in_virtual_time
from busmaster.wire.checks import xor
from tests.protocols.asking import outcome, single_bytes

ACK, NAK, EOT = b"\x06", b"\x15", b"\x04"
TIMINGS = PROFILE.timings
IDENTITY = bytes.fromhex("02 49 49 3E 32 36 35 30 03 3C")
"""Printed in the technical manual of the 6513: the reply of a 650V to II."""


def reply(name: str, text: str) -> bytes:
    body = f"{name}{text}\x03".encode()
    return b"\x02" + body + bytes((xor(body),))


def named(command: Command[Any], address: int) -> Hashable:
    """A telegram names its parameter and no instrument; a run begins with one."""
    if command.writes:
        return "ACK"
    return command.names[0] if isinstance(command, ReadRun) else getattr(command, "name", None)


CASES = [
    Case(Read("II"), 1, [IDENTITY], 0x2650, request=bytes.fromhex("04 30 30 31 31 49 49 05")),
    Case(Read("PV"), 12, [reply("PV", "16.4")], 16.4, request=b"\x041122PV\x05"),
    Case(Read("1PV"), 12, [reply("1PV", "16.4")], 16.4, request=b"\x0411221PV\x05"),
    Case(Read("SP"), 99, [reply("SP", "-0150.0")], -150.0),
    Case(Read("TI"), 0, [reply("TI", "360.")], 360),
    Case(Read("mA"), 1, [EOT], raises=NoSuchParameter),
    Case(Read("OP"), 1, [NAK], raises=Refused),
    Case(ReadRun(("PV",)), 1, [reply("PV", "20.")], (20,)),
    Case(ReadRun(("PV", "PV", "SL")), 1, [reply("PV", "20."), reply("PV", "21."), reply("SL", "22.")], (20, 21, 22)),
    Case(Write("SL", 450.5), 1, [ACK], request=b"\x040011\x02SL450.5\x03" + bytes((xor(b"SL450.5\x03"),))),
    Case(Write("EE", 0, hexadecimal=True), 1, [ACK]),
    Case(Write("SL", 9999), 1, [NAK], raises=Refused),
]


def test_ei_bisynch_keeps_the_contract() -> None:
    check_protocol(
        PROFILE,
        CASES,
        names=named,
        invalid=[
            lambda: Read("P"),
            lambda: Read("PVX"),
            lambda: Read("P V"),
            lambda: ReadRun(()),
            lambda: ReadRun(("PV",) * 33),
            lambda: ReadRun(("PV", "SLX")),
            lambda: Write("SL", float("nan")),
            lambda: Write("SL", 10**12),
            lambda: Write("SL", 10**400),
            lambda: Write("SL", 1, width=13),
            lambda: Write("SL", 1, width=-1),
            lambda: Write("SW", 65536, hexadecimal=True),
            lambda: Write("SW", 1.5, hexadecimal=True),
            lambda: Write("SL", 12345.5, width=5),
        ],
        round_trips=[
            RoundTrip(3, lambda value: Write("SL", value), Read("SL"), [0, 0.5, 1, 99.9, 100, 1200]),
            RoundTrip(3, lambda value: Write("1SL", value), Read("SL"), [0, 450.5]),
            RoundTrip(3, lambda value: Write("OP", value), Read("OP"), [-100, -0.5, 0, 99.9]),
            RoundTrip(3, lambda value: Write("SW", value, True), Read("SW"), [0, 1, 0x7FFF, 0xABCD, 0xFFFF]),
        ],
        device=answers_of(made(3)),
    )


def made(address: int, **options: Any) -> EmulatedBisynch:
    instrument = make_device(
        address,
        delay=Delay(),
        traceable=None,
        lively=False,
        parameters={"SW": {"hexadecimal": True}, "1S1": {"high": 10}, "WO": {"write_only": True}},
        **options,
    )
    instrument.values[b"mA"] = 1
    return instrument


def test_the_place_of_a_parameter_is_its_channel_and_its_whole_mnemonic() -> None:
    places = {place for name in ("SP", "OP", "PV", "2SP") for place in Read(name).places}
    assert places == {("1", "SP"), ("1", "OP"), ("1", "PV"), ("2", "SP")}
    assert Read("1SP").places == Read("SP").places


def test_a_listener_reads_what_is_sent() -> None:
    check_dialect(PROTOCOL, CASES)


def heard(*frames: bytes) -> list[Frame]:
    """Return what a listener makes of frames, by turns of the host and the instrument."""
    dialect = BisynchDialect()
    return [
        dialect.explain(frame, sender)
        for frame, sender in zip(frames, cycle((Direction.HOST, Direction.NODE)), strict=False)
    ]


def test_a_short_command_after_a_write_refers_to_no_read() -> None:
    frames = heard(enquiry("PV"), reply("PV", "1."), NAK, reply("PV", "2."), selection("SL", "5."), ACK, NAK)
    assert [frame.fault for frame in frames] == [""] * 6 + [UNEXPECTED]
    assert [frame.item for frame in frames[:4]] == ["PV"] * 4


def test_a_short_command_after_an_unexpected_value_refers_to_no_read() -> None:
    frames = heard(selection("SL", "5."), reply("SL", "5."), NAK)
    assert [frame.fault for frame in frames] == ["", "a value is not a reply to a write", UNEXPECTED]


def test_a_listener_accepts_both_rules_of_the_checksum_and_no_other() -> None:
    low = reply("SL", "1.")
    assert low[-1] < 0x20
    checks = (low[-1], low[-1] + 0x20, low[-1] ^ 0x40)
    faults = [heard(enquiry("SL"), low[:-1] + bytes((check,)))[1].fault for check in checks]
    assert [bool(fault) for fault in faults] == [False, False, True]
    [write] = heard(b"\x040033" + low[:-1] + bytes((low[-1] + 0x20,)))
    assert BisynchDialect().command(write, ()) == Write("SL", 1, printable_check=True)


def test_a_listener_makes_a_command_that_sends_the_same_bytes_of_a_write() -> None:
    for text in ("1.", "0001.5", ">0001", ">01", ">00"):
        request = b"\x040033" + reply("SW", text)
        [write] = heard(request)
        assert BisynchDialect().command(write, ()).open(3, TIMINGS).request == request


def test_a_listener_does_not_know_what_the_next_parameter_is_until_it_is_sent() -> None:
    frames = heard(enquiry("PV"), reply("PV", "1."), ACK, reply("SL", "2."), NAK, reply("SL", "3."))
    assert [frame.item for frame in frames] == ["PV", "PV", "SL", "SL", "SL", "SL"]
    assert [frame.fault for frame in frames] == [""] * 6
    dialect = BisynchDialect()
    assert dialect.command(frames[0], [frames[2], frames[4]]) == ReadRun(("PV", "SL", "SL"))
    [read, _, following] = heard(enquiry("PV"), reply("PV", "1."), ACK)
    assert dialect.command(read, [following]) == Read("PV")


@pytest.mark.parametrize(
    ("text", "value"),
    [("16.4", 16.4), ("16.", 16), ("  16.4", 16.4), ("0016.4", 16.4), ("-.5", -0.5), ("16", 16), (">00C0", 0xC0)],
)
def test_numbers_are_read_in_free_and_in_fixed_format(text: str, value: float) -> None:
    read = Read("PV").open(1, TIMINGS).feed(reply("PV", text))
    assert read == Done(value)
    assert isinstance(read, Done)
    assert type(read.value) is type(value)


@pytest.mark.parametrize("text", ["", ".", "-", "1.2.3", ">", ">GG", "16.4C", "nan", "1_0", "> 12"])
def test_data_that_are_not_a_number_are_a_frame_error(text: str) -> None:
    assert outcome(Read("PV").open(1, TIMINGS), [reply("PV", text)]) is FrameError


def test_a_reply_of_another_parameter_or_channel_is_not_taken() -> None:
    for name in ("SP", "PU", "1PV", "2PV"):
        assert outcome(Read("PV").open(1, TIMINGS), single_bytes(reply(name, "16.4"))) is FrameError
    assert outcome(Read("1PV").open(1, TIMINGS), [reply("2PV", "16.4")]) is FrameError
    assert outcome(Read("1PV").open(1, TIMINGS), [reply("PV", "16.4")]) is FrameError


@pytest.mark.parametrize(
    ("write", "text"),
    [
        (Write("SL", 450), "450."),
        (Write("SL", 450.5), "450.5"),
        (Write("SL", -0.0), "0."),
        (Write("SL", -12.5), "-12.5"),
        (Write("SL", True), "1."),
        (Write("SL", -12.5, width=6), "-012.5"),
        (Write("SL", 450, width=6), "00450."),
        (Write("SW", 0xAB, hexadecimal=True), ">00AB"),
        (Write("SW", True, hexadecimal=True), ">01"),
        (Write("SW", 5.0, hexadecimal=True), ">0005"),
    ],
)
def test_a_value_is_sent_as_the_encoding_table_has_it(write: Write, text: str) -> None:
    assert write.text == text
    assert write.number == abs(float(write.value)) * (-1 if text[0] == "-" else 1)


def test_32_is_added_to_a_low_checksum_where_the_instrument_does_so() -> None:
    low = b"SL1.\x03"
    assert xor(low) < 0x20
    plain, printable = (Write("SL", 1, printable_check=p).open(1, TIMINGS).request for p in (False, True))
    assert (plain[-1], printable[-1]) == (xor(low), xor(low) + 0x20)
    frame = b"\x02" + low
    assert Read("SL", True).open(1, TIMINGS).feed(frame + printable[-1:]) == Done(1)
    assert outcome(Read("SL", True).open(1, TIMINGS), [frame + plain[-1:]]) is FrameError
    assert outcome(Read("SL").open(1, TIMINGS), [frame + printable[-1:]]) is FrameError


def test_a_run_requests_the_same_parameter_by_nak_and_the_next_by_ack() -> None:
    exchange = ReadRun(("PV", "PV", "SL")).open(1, TIMINGS)
    assert [(step.sizes, step.sent) for step in exchange.later] == [(exchange.sizes, 1)] * 2
    assert exchange.feed(reply("PV", "1.")) == Expect(TIMINGS.read, exchange.sizes, NAK)
    assert exchange.feed(b"") is MORE
    assert exchange.feed(reply("PV", "2.")) == Expect(TIMINGS.read, exchange.sizes, ACK)
    assert exchange.feed(reply("SL", "3.") + b"\x02") == Done((1, 2, 3), rest=b"\x02")


def test_a_run_that_brings_another_parameter_ends() -> None:
    assert len(ReadRun(("PV",) * 32).names) == 32
    exchange = ReadRun(("PV", "SL")).open(1, TIMINGS)
    exchange.feed(reply("PV", "1."))
    assert outcome(exchange, [reply("SP", "2.")]) is FrameError
    assert outcome(ReadRun(("PV", "SL")).open(1, TIMINGS), [reply("PV", "1.") + ACK]) is FrameError


def test_eot_in_place_of_an_ack_may_be_one_with_a_flipped_bit() -> None:
    assert outcome(Write("SL", 1).open(1, TIMINGS), [EOT]) is FrameError


def test_a_name_without_a_channel_is_the_parameter_of_channel_1() -> None:
    assert Read("PV").places == Read("1PV").places != Read("2PV").places
    assert Write("1SL", 5).changes(PROFILE) == {Read("SL").places[0]: 5.0}


@pytest.mark.parametrize(
    ("tag", "mnemonic"),
    [(0, "a0"), (35, "az"), (36, "b0"), (130, "dm"), (247, "gv"), (935, "zz"), (936, "aA"), (962, "bA"), (1611, "zZ")],
)
def test_tags_have_the_mnemonics_of_the_manuals_algorithm(tag: int, mnemonic: str) -> None:
    assert mnemonic_of_tag(tag) == mnemonic


def test_every_tag_has_a_mnemonic_of_its_own() -> None:
    assert len({mnemonic_of_tag(tag) for tag in range(1612)}) == 1612
    for tag in (-1, 1612):
        with pytest.raises(InvalidCommand, match="0 to 1611"):
            mnemonic_of_tag(tag)


@pytest.mark.parametrize(
    ("code", "text"),
    [
        (0x00C0, "no error"),
        (0x01C7, "mnemonic does not exist"),
        (0x02C2, "checksum"),
        (0x04C8, "write-only"),
        (0x05C8, "read-only"),
        (0x07C8, "invalid format"),
        (0x08C8, "out of range"),
        (8, ">0008: the value is out of range"),
        (0x1234, ">1234: a code that the documents do not define"),
    ],
)
def test_the_codes_of_the_last_error_are_put_into_words(code: int, text: str) -> None:
    assert text in error_text(code)


# the emulated instrument


def says(instrument: EmulatedBisynch, *requests: str | bytes) -> bytes:
    """Return what it answers to the last of these requests, heard byte by byte."""
    data = b""
    for request in requests:
        instrument.outbox.clear()
        instrument.hear(request if isinstance(request, bytes) else bytes.fromhex(request), 0.0)
        data = b"".join(said for _, said in instrument.outbox)
    return data


def enquiry(name: str) -> bytes:
    return b"\x040033" + name.encode() + b"\x05"


def selection(name: str, text: str) -> bytes:
    return b"\x040033" + reply(name, text)


def test_the_identity_is_answered_as_the_manual_prints_it() -> None:
    instrument = made(1)
    instrument.preset("II", 0x2650)
    assert says(instrument, "04 30 30 31 31 49 49 05") == IDENTITY


def test_ack_brings_the_next_parameter_of_the_list_and_nak_the_same() -> None:
    instrument = made(3)
    instrument.preset("SL", 50)
    instrument.preset("PV", 40)
    assert says(instrument, enquiry("PV")) == reply("PV", "40.")
    assert says(instrument, NAK) == reply("PV", "40.")
    assert says(instrument, ACK) == reply("SL", "50.")
    assert says(instrument, enquiry("1PV"), ACK) == reply("1SL", "50.")


def test_after_the_last_parameter_there_is_no_next() -> None:
    assert says(made(3), enquiry("WO")) == EOT  # write-only, and the last of its list
    instrument = made(3)
    assert says(instrument, enquiry("S1"), ACK) == EOT
    assert says(instrument, ACK) == b""
    assert says(make_device(3, lively=False), enquiry("fi"), ACK) == EOT


@pytest.mark.parametrize("ends", [b"\x040044PV\x05", b"x", EOT], ids=["another", "a character", "an EOT"])
def test_short_commands_end_with_anything_else(ends: bytes) -> None:
    assert says(made(3), enquiry("PV"), ends, NAK) == b""


@pytest.mark.parametrize(
    ("request_", "answer", "code"),
    [
        (enquiry("QQ"), EOT, 0x01C7),
        (enquiry("2PV"), EOT, 0x01C7),
        (enquiry("WO"), EOT, 0x04C8),
        (selection("QQ", "1."), NAK, 0x01C7),
        (selection("PV", "1."), NAK, 0x05C8),
        (selection("SL", "1.2.3"), NAK, 0x07C8),
        (selection("SL", "9999."), NAK, 0x08C8),
        (selection("SL", "5.")[:-1] + b"x", NAK, 0x02C2),
        (selection("SL", "5."), ACK, 0x00C0),
        (selection("1SL", ">0005"), ACK, 0x00C0),
    ],
)
def test_what_is_refused_is_told_by_the_last_error(request_: bytes, answer: bytes, code: int) -> None:
    instrument = made(3)
    assert says(instrument, request_) == answer
    assert says(instrument, enquiry("EE")) == reply("EE", f">{code:04X}")
    assert says(instrument, selection("EE", "0."), enquiry("EE")) == reply("EE", ">00C0")


def test_another_instrument_and_a_malformed_address_are_left_alone() -> None:
    for request in ("04 30 30 34 34 50 56 05", "04 30 31 33 33 50 56 05", "04 30 30 33 33 50 05", "50 56 05"):
        assert says(made(3), request) == b""


def test_what_is_taken_whole_is_answered_as_byte_by_byte() -> None:
    for frame in (enquiry("PV"), enquiry("1SL"), selection("SL", "5."), selection("SL", "x"), enquiry("QQ")):
        whole, bytewise = made(3), made(3)
        assert whole.take(frame, 1.0)
        bytewise.hear(frame, 1.0)
        assert [data for _, data in whole.outbox] == [data for _, data in bytewise.outbox]
        assert whole.attentive == bytewise.attentive


def test_short_commands_end_with_a_read_that_is_refused() -> None:
    instrument = made(3)
    for frame in (enquiry("PV"), enquiry("QQ")):
        assert instrument.take(frame, 1.0)
    assert says(instrument, NAK) == b""


def test_parity_is_answered_with_parity() -> None:
    even = bytes(byte | byte.bit_count() % 2 << 7 for byte in enquiry("SL"))
    answer = bytes(byte | byte.bit_count() % 2 << 7 for byte in reply("SL", "20."))
    assert says(made(3), even) == answer
    instrument = made(3)
    for request in (even, enquiry("SL"), even):
        assert instrument.take(request, 1.0)
    assert [data for _, data in instrument.outbox] == [answer, reply("SL", "20."), answer]


def test_a_disguised_reply_is_of_another_parameter() -> None:
    instrument = made(3)
    disguised = instrument.disguise(reply("PV", "40."), Random(1))
    assert disguised[1:3] != b"PV"
    assert disguised[-1] == xor(disguised[1:-1])
    assert instrument.disguise(ACK, Random(1)) == ACK


@pytest.mark.parametrize("value", [10**12, 10**400, float("inf"), "1"])
def test_what_is_no_number_or_needs_too_many_digits_cannot_be_sent(value: object) -> None:
    assert not is_sendable(value)


def test_the_sync_reads_of_an_instrument_with_printable_checks_have_such_checks_too() -> None:
    reads = [(read.name, read.printable_check) for read in PRINTABLE.sync_reads if isinstance(read, Read)]
    assert reads == [(name, True) for name in ("II", "V0", "EE")]


def test_the_longest_reply_to_a_read_has_a_mnemonic_twelve_characters_and_perhaps_a_status() -> None:
    assert Read("PV").open(1, TIMINGS).sizes.longest == len(reply("PV", "-1234567890.") + b" ")


@pytest.mark.parametrize(("text", "value"), [("16.", 16), ("16. ", 16), (" 16", 16), ("16.5 ", 16.5), ("16.0", 16.0)])
def test_a_number_without_decimals_is_a_whole_one_also_with_spaces_around_it(text: str, value: float) -> None:
    done = Read("PV").open(1, TIMINGS).feed(reply("PV", text))
    assert isinstance(done, Done)
    assert (done.value, type(done.value)) == (value, type(value))


def test_an_instrument_carries_100000_traceable_values() -> None:
    EmulatedBisynch(1, traceable=TraceableMemory(1, 10**5))
    with pytest.raises(InvalidCommand, match=r"10\*\*5"):
        EmulatedBisynch(1, traceable=TraceableMemory(1, 10**5 + 1))


@pytest.mark.parametrize("options", [{"address": 100}, {"fixed_width": 13}])
def test_an_instrument_that_cannot_be_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InvalidCommand):
        EmulatedBisynch(**{"address": 1, **options})


def test_the_process_value_follows_the_setpoint() -> None:
    instrument = make_device(1, lively=True, delay=Delay(), traceable=None, lag=10.0)
    start, later, settled = (instrument.value(b"PV", now) for now in (0.0, 10.0, 200.0))
    assert start < later < settled == pytest.approx(instrument.value(b"SP", 200.0))
    assert instrument.value(b"OP", 200.0) == pytest.approx(0.0, abs=1e-3)


def test_the_output_follows_the_error_unless_it_is_in_manual() -> None:
    instrument = make_device(3, lively=False, delay=Delay(), traceable=None)
    instrument.preset("SL", 30)
    assert instrument.value(b"OP", 0.0) == pytest.approx(50.0), "10 degrees below, with a band of 20"
    instrument.preset("XP", 0)
    assert instrument.value(b"OP", 0.0) == 100.0
    instrument.preset("SL", 0)
    assert instrument.value(b"OP", 0.0) == -100.0
    instrument.preset("mA", 1)
    instrument.preset("OP", 25)
    assert instrument.value(b"OP", 1.0) == 25.0


@pytest.mark.parametrize(("value", "text"), [(-0.00001, "0."), (-0.0001, "-0.0001"), (0.00004, "0."), (9.99999, "10.")])
def test_numbers_of_an_instrument_have_four_decimals_and_zero_has_no_sign(value: float, text: str) -> None:
    instrument = made(3)
    instrument.preset("S1", value)
    assert says(instrument, enquiry("S1")) == reply("S1", text)


def test_a_restart_forgets_the_last_error_the_last_read_and_half_a_request() -> None:
    instrument = made(3)
    says(instrument, enquiry("QQ"))
    says(instrument, enquiry("PV"))
    instrument.restart(1.0)
    assert says(instrument, NAK) == b""
    assert says(instrument, enquiry("EE")) == reply("EE", ">00C0")
    says(instrument, enquiry("PV")[:-1])
    instrument.restart(2.0)
    assert says(instrument, b"\x05") == b""


def test_the_values_outlive_a_restart() -> None:
    instrument = made(3)
    says(instrument, selection("SL", "5."))
    instrument.restart(1.0)
    assert says(instrument, enquiry("SL")) == reply("SL", "5.")


def test_an_instrument_fills_its_numbers_with_zeros_by_option() -> None:
    instrument = made(3, fixed_width=6)
    instrument.preset("PV", -1.5)
    assert says(instrument, enquiry("PV")) == reply("PV", "-001.5")
    assert says(instrument, enquiry("EE")) == reply("EE", ">00C0"), "not a word"


def test_an_instrument_with_printable_checks_sends_and_accepts_them() -> None:
    instrument = made(3, printable_check=True)
    body = b"SL5.\x03"
    check = xor(body)
    assert check < 32
    assert says(instrument, b"\x040033\x02" + body + bytes((check + 32,))) == ACK
    assert says(instrument, b"\x040033\x02" + body + bytes((check,))) == NAK
    assert says(instrument, enquiry("SL")) == b"\x02" + body + bytes((check + 32,))


@pytest.mark.parametrize(
    ("settings", "fits", "fails"),
    [
        ({"high": 5}, (5, -99999), (5.1,)),
        ({"low": -1}, (-1, 99999), (-1.1,)),
        ({"low": 3, "high": 3}, (3,), (2, 4)),
        ({"hexadecimal": True}, (0, 0xFFFF), (-1, 0x10000, 0.5)),
        ({"hexadecimal": True, "low": 2, "high": 4}, (2, 4), (1, 5)),
    ],
)
def test_limits_of_a_parameter_apply_to_initial_values_also_of_a_known_parameter(
    settings: dict[str, Any], fits: tuple[float, ...], fails: tuple[float, ...]
) -> None:
    for name in ("ZZ", "dm"):
        instrument = make_device(3, lively=False, parameters={name: settings})
        for value in fits:
            instrument.preset(name, value)
        for value in fails:
            with pytest.raises(InvalidCommand):
                instrument.preset(name, value)


@pytest.mark.parametrize(
    ("item", "values", "reason"),
    [
        ("SL", (1, 2), "use one value for a mnemonic, such as SL"),
        ("S", (1,), "has no 'S'"),
        ("tag1612", (1,), "the last tag is 1611"),
        ("tag1611", (1, 2), "the last tag is 1611"),
        ("SL", (-1,), "SL holds 0 to 1200, not -1"),
        ("SL", (1201,), "SL holds 0 to 1200, not 1201"),
    ],
)
def test_an_initial_value_that_an_instrument_cannot_hold_is_refused(
    item: str, values: tuple[float, ...], reason: str
) -> None:
    with pytest.raises(InvalidCommand, match=reason):
        made(3).preset(item, *values)


def test_initial_values_of_tags_are_those_of_tags_in_a_row() -> None:
    instrument = made(3)
    instrument.preset("tag1610", 1, 2)
    assert says(instrument, enquiry(mnemonic_of_tag(1610))) == reply(mnemonic_of_tag(1610), "1.")
    assert says(instrument, enquiry(mnemonic_of_tag(1611))) == reply(mnemonic_of_tag(1611), "2.")


def test_limits_that_exclude_every_value_are_refused() -> None:
    with pytest.raises(InvalidCommand, match="an upper limit is at least the lower one, 4, not 3"):
        make_device(3, lively=False, parameters={"ZZ": {"low": 4, "high": 3}})


def test_a_read_only_parameter_of_a_file_refuses_a_write() -> None:
    instrument = make_device(3, lively=False, parameters={"ZZ": {"read_only": True}})
    assert says(instrument, selection("ZZ", "1.")) == NAK
    assert says(instrument, enquiry("EE")) == reply("EE", ">05C8")


@pytest.mark.parametrize("text", ["1234567890123.", "1" * 60])
def test_a_value_that_is_too_long_is_not_stored(text: str) -> None:
    instrument = made(3)
    request = selection("SL", text)
    assert says(instrument, request) == (NAK if len(request) <= 32 else b"")
    assert says(instrument, enquiry("SL")) == reply("SL", "20.")
    line = Line(PROFILE.line, [made(3)])
    line.send(request, 0.0)
    assert line.receive(1.0) == (NAK if len(request) <= 32 else b"")


# the handle


def on_a_bus(story: Callable[[BisynchInstrument], Awaitable[None]], device: EmulatedBisynch, **options: Any) -> None:
    async def main() -> None:
        async with Bus(MemoryPort(Line(PROFILE.line, [device], chance=Random(1)))) as bus:
            await story(BisynchInstrument(bus, 3, **options))

    run_in_virtual_time(main())


def counted(furnace: BisynchInstrument) -> int:
    """The exchanges of its line so far."""
    assert isinstance(furnace.bus, Bus)
    return ext.line_statistics(furnace.bus).exchanges


def test_a_refused_write_names_the_instruments_own_reason() -> None:
    async def story(furnace: BisynchInstrument) -> None:
        for item, value, reason in (("PV", 3, "05C8: the parameter is read-only"), ("SL", 5000, "out of range")):
            with pytest.raises(Refused, match=reason) as refusal:
                await furnace.write(item, value)
            assert refusal.value.attempts == 2  # a refusal is confirmed by a second one
        with pytest.raises(Refused, match="01C7"):
            await furnace._prepare_one("QQ", 1)()
        assert "01C7" in await furnace.last_error()
        await furnace.clear_error()
        assert await furnace.last_error() == ">00C0: no error"
        with pytest.raises(NoSuchParameter):
            await furnace.read("QQ")

    on_a_bus(story, made(3))


def test_a_refusal_stays_one_where_the_last_error_cannot_be_read() -> None:
    async def story(furnace: BisynchInstrument) -> None:
        with pytest.raises(Refused) as refusal:
            await furnace.write("PV", 3)
        assert refusal.value.what == "refused"

    instrument = made(3)
    del instrument.parameters[b"EE"]
    on_a_bus(story, instrument)


def test_a_refusal_stays_one_where_the_last_error_is_not_answered() -> None:
    class Reticent(EmulatedBisynch):
        def _answer_read(self, name: bytes, now: float) -> None:
            if name[-2:] != b"EE":
                super()._answer_read(name, now)

    async def story(furnace: BisynchInstrument) -> None:
        with pytest.raises(Refused) as refusal:
            await furnace.write("PV", 3)
        assert refusal.value.what == "refused"

    on_a_bus(story, Reticent(3))


@pytest.mark.parametrize("name", ["SL", "1SL", "target_setpoint"])
def test_decimals_are_of_a_parameter_by_its_mnemonic_or_its_name(name: str) -> None:
    async def story(furnace: BisynchInstrument) -> None:
        await furnace.write(name, 450.06, verify=True)
        assert await furnace.read("SL") == 450.1

    on_a_bus(story, made(3), decimals={name: 1})


def test_values_are_rounded_to_the_decimals_of_the_parameter() -> None:
    async def story(furnace: BisynchInstrument) -> None:
        await furnace.write("target_setpoint", 450.06, verify=True)
        assert await furnace.read("1SL") == await furnace.read("SL") == 450.1
        await furnace.write("1SL", 99, verify=True)
        assert await furnace.read("SL") == 99

    on_a_bus(story, made(3), decimals={"SL": 1})


def test_a_value_that_reads_back_otherwise_is_an_error() -> None:
    async def story(furnace: BisynchInstrument) -> None:
        with pytest.raises(VerifyFailed, match="SP"):
            await furnace.write("SP", 5, verify=True)

    instrument = made(3)
    instrument.parameters[b"SP"] = instrument.parameters[b"SL"]
    on_a_bus(story, instrument)


@pytest.mark.parametrize("options", [{"fixed_width": 8}, {"printable_check": True}])
def test_an_instrument_with_another_format_is_read_and_written(options: dict[str, Any]) -> None:
    async def story(furnace: BisynchInstrument) -> None:
        await furnace.write("SL", 123.5, verify=True)
        await furnace.write("tag247:hex", 0xA000, verify=True)
        assert await furnace.read("SL") == 123.5
        assert await furnace.read("tag247") == 0xA000
        assert await furnace.point("SL,SL").read() == (123.5, 123.5)
        await furnace.write("SL", 1)
        assert await furnace.point("SL,SL").read() == (1, 1)

    instrument = made(3, **options)
    instrument.preset("tag247", 1)
    instrument.parameters[b"gv"] = instrument.parameters[b"SW"]
    on_a_bus(story, instrument, **options)


def test_runs_are_read_in_one_exchange_only_where_that_is_asked_for() -> None:
    async def story(furnace: BisynchInstrument) -> None:
        assert await furnace._read_item("PV,SL,SP") == (20, 20, 20)
        apart = counted(furnace)
        assert await furnace._read_item("PV,SL,SP", chain=True) == (20, 20, 20)
        assert await furnace.point("tag130,tag130").read() == (0, 0)
        assert (apart, counted(furnace)) == (3, 5)

    on_a_bus(story, made(3))


def test_several_values_go_to_tags_in_a_row() -> None:
    async def story(furnace: BisynchInstrument) -> None:
        await furnace.write("tag247", 1, 2, 3)
        assert [await furnace.read(f"tag{tag}") for tag in (247, 248, 249)] == [1, 2, 3]
        with pytest.raises(InvalidCommand, match="begin at a tag"):
            await furnace.write("SL", 1, 2)

    instrument = made(3)
    instrument.preset("tag247", 0, 0, 0)
    on_a_bus(story, instrument)


@pytest.mark.parametrize("item", ["P", "process", "tag1612", "tag", "PV,", "PV:wide", "1:PV"])
def test_an_item_that_does_not_exist_is_refused_with_the_form(item: str) -> None:
    async def story(furnace: BisynchInstrument) -> None:
        with pytest.raises(InvalidCommand, match="no such item"):
            furnace.point(item)

    on_a_bus(story, made(3))
