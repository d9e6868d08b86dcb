"""An MSC controller, as IB-11A002 describes it."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.errors import InvalidCommand
from busmaster.protocols.msc.device import COUNT, RUN_FLAG, EmulatedMsc, packet
from tests.emulator.lines import arrivals, ask, ask_bytewise, hexed, line_of

ACK, NAK, SILENCE = "06", "15", ""
DWRITE = "02 01 00 0D 00 00 44 57 52 49 54 45 2C 07 D8 00 00 04 D2 03 BE"  # the example of IB-11A002
DREAD = "02 01 00 08 00 00 44 52 45 41 44 2C 07 D8 02 74"
REPLY = "02 01 00 0A 00 00 44 52 45 41 44 2C 00 00 04 D2 02 6D"
PAUSE = 10.0
"""Longer than a controller waits for anything."""


def request(unit: int, name: str, *operands: int, value: int | None = None) -> str:
    body = f"{name},".encode() + b"".join(operand.to_bytes(2, "big") for operand in operands)
    return hexed(packet(unit, body + (b"" if value is None else value.to_bytes(4, "big", signed=True))))


def answer(line: Line, text: str, now: float, *, bytewise: bool = False) -> str:
    """What comes back to a request; its packet, if it has one, is ACKed, and nothing follows."""
    heard = (ask_bytewise if bytewise else ask)(line, text, now)
    assert ask(line, ACK, now + 0.5, PAUSE) == SILENCE
    return heard


# The packet that IB-11A002 prints, and those that follow from its rules


STATUS = "02 01 00 0F 00 00 52 51 53 54 41 54 2C 00 41 00 00 00 00 00 00 02 5C"  # 65: running, auto start
FLAG_255_ON = "02 0F 00 08 00 00 52 46 4C 41 47 2C 00 01 01 B0"
FLAGS_ON = "02 03 00 27 00 00 52 46 4C 41 47 53 2C 01 02 00 80" + 27 * " 00" + " 80 03 18"  # 0, 9, 31 and 255


@pytest.mark.parametrize("bytewise", [False, True])
@pytest.mark.parametrize(
    ("unit", "text", "heard"),
    [
        (1, DWRITE, ACK),
        (1, DREAD, f"{ACK} {REPLY}"),
        (1, "02 01 00 07 00 00 52 51 53 54 41 54 2C 02 13", f"{ACK} {STATUS}"),
        (2, "02 02 00 08 00 00 53 46 4C 41 47 2C 00 05 01 A8", ACK),  # SFLAG 5; the unit looks like STX
        (2, "02 02 00 08 00 00 43 46 4C 41 47 2C 00 05 01 98", ACK),  # CFLAG 5
        (15, "02 0F 00 08 00 00 52 46 4C 41 47 2C 00 FF 02 AE", f"{ACK} {FLAG_255_ON}"),
        (3, "02 03 00 07 00 00 52 46 4C 41 47 53 2C 01 F5", f"{ACK} {FLAGS_ON}"),
    ],
)
def test_it_answers_the_packets_of_the_document(unit: int, text: str, heard: str, bytewise: bool) -> None:
    controller = EmulatedMsc(unit)
    controller.flags = {0, 9, 31, 255}
    controller.set_value(2008, 1234)
    assert answer(line_of(controller), text, 0.0, bytewise=bytewise) == heard


def test_a_value_written_is_stored_signed_and_read_back() -> None:
    controller = EmulatedMsc(1)
    line = line_of(controller)
    for number, value in enumerate((1234, -1, 0, 2**31 - 1, -(2**31), 0x02020202, 0x06061515)):
        now = number * 100.0
        assert answer(line, request(1, "DWRITE", 2008, value=value), now) == ACK
        assert controller.value(2008) == value
        read = bytes.fromhex(answer(line, request(1, "DREAD", 2008), now + 50))
        assert int.from_bytes(read[13:17], "big", signed=True) == value


@pytest.mark.parametrize("step", [1, 2, 4])
def test_a_block_is_32_values_one_address_step_apart(step: int) -> None:
    controller = EmulatedMsc(4, address_step=step)
    line = line_of(controller)
    values = list(range(-16, 16))
    block = b"BWRITE," + (2008).to_bytes(2, "big") + b"".join(v.to_bytes(4, "big", signed=True) for v in values)
    assert answer(line, hexed(packet(4, block)), 0.0) == ACK
    assert [controller.value(2008 + i * step) for i in range(32)] == values
    read = bytes.fromhex(answer(line, request(4, "BREAD", 2008), 20.0))
    assert read[1:] == packet(4, b"BREAD," + block[9:])
    assert len(read) == 1 + 142


def test_flags_are_set_cleared_and_read() -> None:
    controller = EmulatedMsc(1, read_only_flags=frozenset({7}))
    line = line_of(controller)
    assert answer(line, request(1, "SFLAG", 5), 0.0) == ACK
    assert controller.flags == {5}
    assert answer(line, request(1, "RFLAG", 5), 20.0).endswith("00 01 01 A2")
    assert answer(line, request(1, "CFLAG", 5), 40.0) == ACK
    assert answer(line, request(1, "CFLAG", 5), 60.0) == ACK  # it is off already
    assert answer(line, request(1, "RFLAG", 5), 80.0).endswith("00 00 01 A1")
    assert answer(line, request(1, "SFLAG", 7), 100.0) == NAK  # an input
    assert answer(line, request(1, "CFLAG", 7), 120.0) == NAK
    assert controller.flags == set()


# What it refuses


@pytest.mark.parametrize("bytewise", [False, True])
@pytest.mark.parametrize(
    "text",
    [
        DREAD[:-2] + "75",  # "an incorrect Packet Checksum"
        request(1, "PEEK", 2008),
        hexed(packet(1, b"DREAD")),  # no comma
        hexed(packet(1, b"")),
        hexed(packet(1, b"DREAD,\x07\xd8\x00")),  # a body of another length
        request(1, "DREAD"),
        request(1, "DREAD", 0x7FFD),  # three bytes of the data area are left there
        request(1, "DWRITE", 0xFFFF, value=1),
        request(1, "BREAD", 0x8000 - 31 * 4),  # the last of 32 values is outside
        request(1, "SFLAG", 256),
        request(1, "RFLAG", 256),
        hexed(packet(1, b"BWRITE," + bytes(234))),  # 241 bytes: longer than any body
        hexed(packet(1, b"DWRITE," + bytes(1000))),
    ],
)
def test_it_says_nak_to_what_is_unsound_unknown_or_not_there(text: str, bytewise: bool) -> None:
    controller = EmulatedMsc(1)
    assert answer(line_of(controller), text, 0.0, bytewise=bytewise) == NAK
    assert not any(controller.value(address) for address in range(0, 0x7FFC, 4))


@pytest.mark.parametrize("step", [1, 2, 4])
def test_it_has_as_many_data_addresses_as_are_given(step: int) -> None:
    line = line_of(EmulatedMsc(1, addresses=100, address_step=step))
    assert answer(line, request(1, "DREAD", 100 - step), 0.0).startswith(ACK)
    assert answer(line, request(1, "DREAD", 101 - step), 20.0) == NAK


@pytest.mark.parametrize(("model", "known"), [("MSC-250", True), ("MSC-850/32", True), ("MSC-850", False)])
def test_only_two_models_know_rflags(model: str, known: bool) -> None:
    heard = answer(line_of(EmulatedMsc(1, model=model)), request(1, "RFLAGS"), 0.0)
    assert heard.startswith(ACK if known else NAK)


def test_a_packet_that_is_not_completed_is_refused_after_half_a_second() -> None:
    line = line_of(EmulatedMsc(1, delay=Delay(0.0)))
    line.prompt = False
    line.send(bytes.fromhex(DREAD)[:-1], 0.0)
    [(when, heard)] = arrivals(line, 5.0)
    assert heard == NAK
    assert when == pytest.approx(0.5, abs=0.001)
    assert answer(line, DREAD, 5.0).startswith(ACK)


def test_another_units_packet_that_is_not_completed_is_passed_over() -> None:
    line = line_of(EmulatedMsc(1))
    assert ask(line, "02 02 00 08 00", 0.0, 5.0) == SILENCE
    assert ask(line, "02", 5.0, 5.0) == SILENCE
    assert answer(line, DREAD, 10.0).startswith(ACK)


@pytest.mark.parametrize(
    ("before", "heard"),
    [
        ("00 FF 15 06", ACK),
        ("02 10", ACK),  # there is no unit 16
        ("02 00", ACK),
        ("02 07 00 03 00 00 44 02 01 00 4F", ACK),  # a packet to unit 7 that holds the beginning of one to unit 1
        ("02", SILENCE),  # with what follows it reads as a packet to unit 2, 256 bytes long
    ],
)
def test_noise_and_other_units_packets_in_front_of_a_request(before: str, heard: str) -> None:
    assert ask(line_of(EmulatedMsc(1)), f"{before} {DREAD}")[:2] == heard


def test_what_never_pauses_is_passed_over_after_half_a_second_too() -> None:
    line = line_of(EmulatedMsc(1))
    assert ask(line, f"02 02 F0 00 {3000 * '00 '} {DREAD}", 0.0, 1.0).startswith(ACK)


# Who a packet is for


def test_other_units_hear_requests_and_replies_and_say_nothing() -> None:
    devices = [EmulatedMsc(unit) for unit in range(1, 16)]
    line = line_of(*devices)
    for unit in range(1, 16):
        heard = answer(line, request(unit, "DREAD", 2008), unit * 20.0)
        assert heard == f"{ACK} {hexed(packet(unit, b'DREAD,' + bytes(4)))}"
    assert line.collisions == 0


@pytest.mark.parametrize(
    "body", [b"DREAD," + bytes(4), b"BREAD," + bytes(128), b"RFLAGS," + bytes(32), b"RQSTAT,\x00\x41" + bytes(6)]
)
def test_a_reply_packet_of_its_own_number_is_no_request(body: bytes) -> None:
    for asking in (ask, ask_bytewise):
        assert asking(line_of(EmulatedMsc(5)), hexed(packet(5, body))) == SILENCE


# "The MSC will retransmit the Packet up to 5 times if necessary"


def test_a_packet_is_sent_again_on_each_nak_five_times_at_most() -> None:
    controller = EmulatedMsc(1)
    line = line_of(controller)
    controller.set_value(2008, 1234)
    assert ask(line, DREAD, 0.0) == f"{ACK} {REPLY}"
    for number in range(1, 6):
        assert controller.unacknowledged
        assert ask(line, NAK, number) == REPLY
    assert ask(line, NAK, 6.0, PAUSE) == SILENCE
    assert controller.retransmitted == 5
    assert not controller.unacknowledged


def test_a_packet_is_sent_again_each_second_in_which_no_ack_comes() -> None:
    controller = EmulatedMsc(1, delay=Delay(0.002), packet_delay=Delay(0.0))
    line = line_of(controller)
    line.prompt = False
    line.send(bytes.fromhex(DREAD), 0.0)
    times = [when for when, heard in arrivals(line, 30.0) if heard != ACK]
    gaps = [later - earlier for earlier, later in pairwise(times)]
    assert len(times) == 6
    assert gaps == pytest.approx([1.002 + 18 * line.tau] * 5)
    assert not controller.attentive


def test_nothing_is_sent_again_after_the_hosts_ack() -> None:
    controller = EmulatedMsc(1)
    line = line_of(controller)
    ask(line, DREAD, 0.0)
    assert ask(line, ACK, 0.5, PAUSE) == SILENCE
    assert ask(line, NAK, 20.0, PAUSE) == SILENCE
    assert controller.retransmitted == 0


def test_a_new_request_takes_the_place_of_a_packet_that_was_not_acknowledged() -> None:
    for asking in (ask, ask_bytewise):
        controller = EmulatedMsc(1)
        line = line_of(controller)
        controller.set_value(2008, 7)
        asking(line, DREAD, 0.0)
        assert asking(line, request(1, "RFLAG", 0), 0.6) == f"{ACK} {hexed(packet(1, b'RFLAG,' + bytes(2)))}"
        assert hexed(packet(1, b"RFLAG," + bytes(2))) == ask(line, NAK, 1.1)


def test_a_packet_waits_while_another_units_request_passes() -> None:
    controller = EmulatedMsc(1, delay=Delay(0.0), packet_delay=Delay(0.0))
    line = line_of(controller)
    ask(line, DREAD, 0.0)
    start = line.next_event() - 0.001
    long = request(2, "BWRITE", *range(60))
    assert ask_bytewise(line, long, start, 0.9) == hexed(packet(1, b"DREAD," + bytes(4)))
    assert line.collisions == 0


def test_what_is_refused_left_out_and_damaged_for_a_test() -> None:
    controller = EmulatedMsc(1)
    controller.set_value(2008, 1234)
    controller.naks_ahead, controller.missing_acks_ahead, controller.bad_packets_ahead = 2, 1, 2
    line = line_of(controller)
    damaged = REPLY[:-2] + "6C"
    assert ask(line, DREAD, 0.0) == NAK
    assert ask(line, DREAD, 1.0) == NAK
    assert ask(line, DREAD, 2.0) == damaged  # without its ACK
    assert ask(line, NAK, 2.5) == damaged
    assert ask(line, NAK, 3.0) == REPLY


def test_ack_and_packet_come_apart_or_in_one_piece() -> None:
    line = line_of(EmulatedMsc(1, delay=Delay(0.01), packet_delay=Delay(0.02)))
    line.prompt = False
    line.send(bytes.fromhex(DREAD), 0.0)
    (acked, ack), (replied, _) = arrivals(line, 0.5)
    assert ack == ACK
    assert acked == pytest.approx(0.01 + 17 * line.tau)
    assert replied - acked == pytest.approx(0.02 + 18 * line.tau)


def test_only_the_ack_of_a_late_answer_is_late() -> None:
    controller = EmulatedMsc(1)
    controller.faults.late = 1.0
    line = line_of(controller)
    line.prompt = False
    line.send(bytes.fromhex(DREAD), 0.0)
    (acked, _), (replied, _) = arrivals(line, 0.5)
    assert acked > 0.01
    assert replied - acked == pytest.approx(0.002 + 18 * line.tau)


# Its program, its memory


def test_the_program_counts_while_its_flag_is_on() -> None:
    controller = EmulatedMsc(1, period=0.1)
    line = line_of(controller)

    def count(now: float) -> int:
        return int.from_bytes(bytes.fromhex(answer(line, request(1, "DREAD", COUNT), now))[13:17], "big", signed=True)

    assert count(0.0) == count(20.0) == 0
    answer(line, request(1, "SFLAG", RUN_FLAG), 40.0)
    first = count(60.0)
    assert count(80.0) - first == 200
    controller.set_value(COUNT, 2**31 - 1)
    assert count(80.0 + 20.05) < -(2**31) + 300  # 32 bits
    answer(line, request(1, "CFLAG", RUN_FLAG), 120.0)
    assert count(140.0) == count(160.0)
    controller.status = 0
    answer(line, request(1, "SFLAG", RUN_FLAG), 180.0)
    assert count(200.0) == count(220.0)


def test_a_power_failure_clears_program_and_data_unless_there_is_a_battery() -> None:
    for battery, status, value in ((False, 0b1100, 0), (True, 65, 1234)):
        controller = EmulatedMsc(1, battery=battery)
        controller.set_value(2008, 1234)
        line = line_of(controller)
        ask(line, DREAD, 0.0)
        line.restart(controller, 0.5)
        assert not controller.unacknowledged
        assert controller.value(2008) == value
        assert answer(line, request(1, "RQSTAT"), 1.0).split()[14:16] == ["00", f"{status:02X}"]


def test_the_oracle_holds_data_values_and_counts_writes() -> None:
    traceable = TraceableMemory(5, 2**31)
    line = line_of(EmulatedMsc(5, traceable=traceable))
    sent = traceable_value(5, 2008, 0, 2**31)
    answer(line, request(5, "DWRITE", 2008, value=sent), 0.0)
    assert (traceable.writes[2008], traceable.foreign_writes) == (1, 0)
    block = bytes.fromhex(answer(line, request(5, "BREAD", 2008), 20.0))[13:-2]
    values = [int.from_bytes(block[i : i + 4], "big") for i in range(0, 128, 4)]
    assert values == [traceable_value(5, 2008 + 4 * i, int(i == 0), 2**31) for i in range(32)]


@pytest.mark.parametrize(
    "bad",
    [
        lambda: EmulatedMsc(0),
        lambda: EmulatedMsc(16),
        lambda: EmulatedMsc(1, model="MSC-1000"),
        lambda: EmulatedMsc(1, address_step=3),
        lambda: EmulatedMsc(1, period=0.0009),
        lambda: EmulatedMsc(1, traceable=TraceableMemory(1)),
    ],
)
def test_what_no_msc_is_cannot_be_made(bad: object) -> None:
    assert callable(bad)
    with pytest.raises(InvalidCommand):
        bad()


def test_time_in_which_the_flag_is_off_does_not_count() -> None:
    controller = EmulatedMsc(1, period=0.1)
    line = line_of(controller)
    for now, name in ((0.0, "SFLAG"), (20.0, "CFLAG"), (60.0, "SFLAG")):
        answer(line, request(1, name, RUN_FLAG), now)
    answer(line, request(1, "RQSTAT"), 80.0)
    before = controller.value(COUNT)
    answer(line, request(1, "RQSTAT"), 100.0)
    assert controller.value(COUNT) - before == 200
    assert before < 300, "the 40 seconds between are left out"


def test_time_in_which_the_program_is_stopped_does_not_count() -> None:
    controller = EmulatedMsc(1, period=0.1)
    line = line_of(controller)
    for now, status in ((0.0, 1), (20.0, 0), (60.0, 0), (80.0, 1)):
        controller.status = status
        answer(line, request(1, "SFLAG", RUN_FLAG) if not now else request(1, "RQSTAT"), now)
    before = controller.value(COUNT)
    answer(line, request(1, "RQSTAT"), 100.0)
    assert controller.value(COUNT) - before == 200
    assert before <= 200


def test_the_count_does_not_depend_on_how_often_it_is_read() -> None:
    counts = []
    for step in (1.7, 17.0):
        controller = EmulatedMsc(1, period=1.0)
        controller.flags.add(RUN_FLAG)
        line = line_of(controller)
        for now in (*(number * step for number in range(round(170 / step))), 170.5):
            ask(line, request(1, "RFLAG", 0), now, 0.5)
            ask(line, ACK, now + 0.5, 0.5)
        counts.append(controller.value(COUNT))
    assert counts == [170, 170]


def test_a_power_failure_turns_the_flags_off() -> None:
    controller = EmulatedMsc(1, battery=True)
    controller.flags = {5, RUN_FLAG}
    line = line_of(controller)
    line.restart(controller, 1.0)
    assert answer(line, request(1, "RFLAG", 5), 2.0).endswith("00 00 01 A1")


def test_half_a_packet_is_lost_in_a_power_failure() -> None:
    controller = EmulatedMsc(1)
    line = line_of(controller)
    ask(line, DREAD[:20], 0.0, 0.1)
    line.restart(controller, 0.2)
    assert ask(line, DREAD, 0.25).startswith(ACK)


def test_each_packet_is_sent_again_five_times() -> None:
    controller = EmulatedMsc(1)
    line = line_of(controller)
    for now in (0.0, 100.0):
        ask(line, DREAD, now)
        arrivals(line, now + 50.0)
    assert controller.retransmitted == 10


@pytest.mark.parametrize("step", [1, 4])
def test_the_oracle_counts_the_writes_of_a_block(step: int) -> None:
    traceable = TraceableMemory(5, 2**31)
    line = line_of(EmulatedMsc(5, traceable=traceable, address_step=step))
    sent = [traceable_value(5, 2008 + place * step, 0, 2**31) for place in range(32)]
    block = b"BWRITE," + (2008).to_bytes(2, "big") + b"".join(value.to_bytes(4, "big") for value in sent)
    assert answer(line, hexed(packet(5, block)), 0.0) == ACK
    assert dict(traceable.writes) == {2008 + place * step: 1 for place in range(32)}
    assert traceable.foreign_writes == 0


def test_initial_values_are_data_values_flags_and_the_status() -> None:
    controller = EmulatedMsc(1)
    controller.preset("2008", 5, -(2**31))
    controller.preset("flag:254", 1, 1)
    controller.preset("status", 0x1234)
    assert [controller.value(2008), controller.value(2012)] == [5, -(2**31)]
    assert controller.flags == {254, 255}
    controller.preset("flag:255", 0)
    assert controller.flags == {254}
    controller.preset("flags", 3, 5)
    assert controller.flags == {3, 5}
    controller.preset("flags")
    assert controller.flags == set()
    heard = answer(line_of(controller), request(1, "RQSTAT"), 0.0)
    assert heard.split()[14:16] == ["12", "34"]


@pytest.mark.parametrize(
    ("item", "values"),
    [
        ("flag:255", (1, 1)),
        ("flag:256", (1,)),
        ("flag:5", (2,)),
        ("flag:x", (1,)),
        ("flags", (256,)),
        ("status", (65536,)),
        ("status", (1, 2)),
        ("2008", (2**31,)),
        ("2008", (0.5,)),
        ("32764", (1, 2)),
        ("32765", (1,)),
        ("x", (1,)),
    ],
)
def test_an_initial_value_that_a_controller_cannot_hold_is_refused(item: str, values: tuple[float, ...]) -> None:
    with pytest.raises(InvalidCommand):
        EmulatedMsc(1).preset(item, *values)


# Properties


@given(st.lists(st.binary(max_size=30), max_size=5), st.booleans())
@settings(max_examples=60)
def test_whatever_it_hears_it_listens_again_when_time_has_passed(chunks: list[bytes], acked: bool) -> None:
    controller = EmulatedMsc(1)
    line = line_of(controller)
    for number, chunk in enumerate(chunks):
        line.send(chunk, number * 0.1)
    arrivals(line, 10.0)
    assert controller.attentive is False
    assert ask(line, DREAD, 10.0).startswith(ACK)


def test_a_disguised_packet_comes_from_another_unit_with_a_right_checksum() -> None:
    controller = EmulatedMsc(1)
    line = line_of(controller)
    controller.faults.wrong = 1.0
    heard = bytes.fromhex(ask(line, DREAD))
    assert heard[0] == 0x06
    assert heard[2] in range(2, 16)
    assert heard[1:] == packet(heard[2], b"DREAD," + bytes(4))
    assert ask(line, DWRITE, 0.5) == ACK  # it names nothing
