"""Modbus RTU: what the emulated unit and a listener make of frames."""

from __future__ import annotations

import math
from itertools import combinations
from random import Random
from typing import Any

import pytest

from busmaster.capture.decode import Decoder
from busmaster.contract.frames import Kind
from busmaster.emulator.traceable import TraceableMemory, traceable_value
from busmaster.errors import InvalidCommand
from busmaster.protocols.modbus.codec import PROFILE, WriteRegisters
from busmaster.protocols.modbus.device import EmulatedModbus, make_device
from busmaster.registry import find
from tests.capture.hearing import HOST, NODE, hear, said
from tests.protocols.modbus_frames import UNIT, frame

REQUEST = frame("11 03 0007 0001")


def heard_by(unit: EmulatedModbus, *chunks: tuple[float, bytes]) -> list[bytes]:
    for start, chunk in chunks:
        if unit.wakeup <= start:
            unit.wake(unit.wakeup)
        unit.hear(chunk, start)
    if unit.wakeup < math.inf:
        unit.wake(unit.wakeup)
    return [said for _, said in unit.outbox]


@pytest.mark.parametrize("cut", range(1, len(REQUEST)))
def test_a_request_in_two_pieces_is_one_and_a_cut_one_is_forgotten_after_a_silence(cut: int) -> None:
    whole = heard_by(EmulatedModbus(UNIT), (0.0, REQUEST[:cut]), (0.0005, REQUEST[cut:]))
    assert whole == heard_by(EmulatedModbus(UNIT), (0.0, REQUEST)) != []
    assert heard_by(EmulatedModbus(UNIT), (0.0, REQUEST[:cut]), (0.1, REQUEST)) == whole


def test_a_unit_lets_pass_what_is_for_others_even_where_its_own_address_stands_in_it() -> None:
    reply_of_another = frame(f"12 03 08 {REQUEST.hex()}")
    assert heard_by(EmulatedModbus(UNIT), (1.0, reply_of_another)) == []
    assert len(heard_by(EmulatedModbus(UNIT), (1.0, reply_of_another), (1.01, REQUEST))) == 1


@pytest.mark.parametrize("bits", list(combinations(range(8), 2)))
def test_damaged_requests_are_not_answered(bits: tuple[int, int]) -> None:
    damaged = bytearray(REQUEST)
    for bit in bits:
        damaged[3] ^= 1 << bit
    assert heard_by(EmulatedModbus(UNIT), (0.0, bytes(damaged))) == []


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("11 2b 0e 01 00", "11 ab 01"),  # a function that it does not have, of another length
        ("11 07", "11 87 01"),
        ("11 03 0000 0000", "11 83 03"),
        ("11 03 0000 007e", "11 83 03"),
        ("11 01 0000 07d1", "11 81 03"),
        ("11 03 03e7 0002", "11 83 02"),
        ("11 05 0000 0001", "11 85 03"),
        ("11 05 03e8 ff00", "11 85 02"),
        ("11 06 03e8 0000", "11 86 02"),
        ("11 0f 0000 0009 01 ff", "11 8f 03"),
        ("11 0f 0000 0000 00", "11 8f 03"),
        ("11 10 0000 0002 02 0001", "11 90 03"),
        ("11 10 0000 0000 00", "11 90 03"),
        ("11 10 03e7 0002 04 0001 0002", "11 90 02"),
    ],
)
def test_what_a_unit_lacks_or_cannot_take_is_an_exception(request_: str, answer: str) -> None:
    assert heard_by(EmulatedModbus(UNIT), (0.0, frame(request_))) == [frame(answer)]


def test_what_goes_to_all_is_done_and_not_answered() -> None:
    unit = EmulatedModbus(UNIT)
    assert heard_by(unit, (0.0, WriteRegisters(2, (7, 8)).open(0, PROFILE.timings).request)) == []
    assert unit.registers[2:4] == [7, 8]


def test_taken_whole_or_heard_byte_by_byte_a_request_gets_the_same_answer() -> None:
    requests = [REQUEST, frame("11 04 0000 0001"), frame("11 03 03de 000b")]
    for request in requests:
        taking, hearing = EmulatedModbus(UNIT), EmulatedModbus(UNIT)
        assert taking.take(request, 1.0)
        hearing.hear(request, 1.0)
        assert taking.outbox == hearing.outbox != []


def test_a_request_that_only_silence_ends_is_heard_and_not_taken() -> None:
    assert not EmulatedModbus(UNIT).take(frame("11 2b 0e 01 00"), 1.0)


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("11 01 0002 0003", "11 01 01 05"),
        ("11 02 0002 0003", "11 02 01 02"),
        ("11 03 0002 0001", "11 03 02 0007"),
        ("11 04 0002 0001", "11 04 02 0009"),
        ("11 05 0003 ff00", "11 05 0003 ff00"),
        ("11 05 0002 0000", "11 05 0002 0000"),
        ("11 0f 0002 0003 01 02", "11 0f 0002 0003"),
        ("11 03 03e7 0001", "11 03 02 0000"),  # the last address
    ],
)
def test_each_function_has_its_own_table(request_: str, answer: str) -> None:
    unit = EmulatedModbus(UNIT)
    unit.coils[2:5], unit.discretes[2:5] = [True, False, True], [False, True, False]
    unit.registers[2], unit.inputs[2] = 7, 9
    assert heard_by(unit, (0.0, frame(request_))) == [frame(answer)]
    if request_.startswith("11 05 0003"):
        assert unit.coils[2:5] == [True, True, True]
    if request_.startswith("11 05 0002"):
        assert unit.coils[2:5] == [False, False, True]
    if request_.startswith("11 0f"):
        assert unit.coils[2:6] == [False, True, False, False]


@pytest.mark.parametrize("function", ["01", "02", "03", "04"])
def test_each_table_has_the_size_that_is_given(function: str) -> None:
    unit = make_device(UNIT, size=7)
    [last, beyond] = heard_by(unit, (0.0, frame(f"11 {function} 0006 0001")), (1.0, frame(f"11 {function} 0007 0001")))
    assert last[:2] == bytes.fromhex(f"11 {function}")
    assert beyond == frame(f"11 8{function[1]} 02")


def test_with_an_oracle_each_register_tells_its_place_and_its_writes() -> None:
    traceable = TraceableMemory(UNIT, 2**16)
    unit = EmulatedModbus(UNIT, traceable=traceable)
    sent = [traceable_value(UNIT, place, 0, 2**16) for place in (2, 3)]
    heard_by(unit, (0.0, WriteRegisters(2, tuple(sent)).open(UNIT, PROFILE.timings).request))
    assert (dict(traceable.writes), traceable.foreign_writes) == ({2: 1, 3: 1}, 0)
    data = b"".join(traceable_value(UNIT, place, int(place < 4), 2**16).to_bytes(2, "big") for place in (2, 3, 4))
    assert heard_by(unit, (1.0, frame("11 03 0002 0003")))[-1] == frame(f"11 03 06 {data.hex()}")


@pytest.mark.parametrize(("request_", "size"), [("11 03 0000 007d", 250), ("11 01 0000 03e8", 125)])
def test_as_much_as_one_reply_carries_can_be_read(request_: str, size: int) -> None:
    assert len(heard_by(EmulatedModbus(UNIT), (0.0, frame(request_)))[0]) == 5 + size


@pytest.mark.parametrize(
    ("request_", "refused"),
    [("11 06 0005 0001", True), ("11 10 0004 0002 04 0001 0002", True), ("11 10 0003 0002 04 0001 0002", False)],
)
def test_a_write_that_includes_a_read_only_register_stores_nothing(request_: str, refused: bool) -> None:
    unit = EmulatedModbus(UNIT, read_only=frozenset({5}))
    [answer] = heard_by(unit, (0.0, frame(request_)))
    assert (answer[1] & 0x80 != 0, answer[2] == 3 and refused) == (refused, refused)
    assert any(unit.registers) is not refused


def test_a_function_that_is_left_out_is_refused_and_the_others_are_there() -> None:
    unit = EmulatedModbus(UNIT, functions=frozenset({4}))
    assert heard_by(unit, (0.0, REQUEST)) == [frame("11 83 01")]
    assert heard_by(unit, (1.0, frame("11 04 0000 0001")))[1:] == [frame("11 04 02 0000")]


@pytest.mark.parametrize("request_", [frame("00 2b 0e 01 00"), frame("11 2b 0e 01 00")[:-1] + b"x"])
def test_an_unknown_function_to_all_or_in_a_damaged_frame_is_not_answered(request_: bytes) -> None:
    assert heard_by(EmulatedModbus(UNIT), (0.0, request_)) == []


def test_half_a_request_is_lost_in_a_restart() -> None:
    unit = EmulatedModbus(UNIT)
    unit.registers[7] = 5
    unit.hear(REQUEST[:4], 0.0)
    unit.restart(0.0005)
    assert heard_by(unit, (0.0006, REQUEST[4:])) == []
    assert heard_by(unit, (1.0, REQUEST)) == [frame("11 03 02 0005")]


@pytest.mark.parametrize(
    ("item", "values", "table", "stored"),
    [
        ("holding:10", (7, 8), "registers", {10: 7, 11: 8}),
        ("holding:10:2", (7, 8), "registers", {10: 7, 11: 8}),
        ("input:10:int16", (-1,), "inputs", {10: 0xFFFF}),
        ("input:40:float32", (1.5,), "inputs", {40: 0x3FC0, 41: 0}),
        ("input:40:float32:swapped", (1.5,), "inputs", {40: 0, 41: 0x3FC0}),
        ("holding:998:uint32", (65537,), "registers", {998: 1, 999: 1}),
        ("coil:5", (1, 0, 1), "coils", {5: 1, 7: 1}),
        ("discrete:5", (1,), "discretes", {5: 1}),
    ],
)
def test_initial_values_are_those_of_one_table(
    item: str, values: tuple[float, ...], table: str, stored: dict[int, int]
) -> None:
    unit = EmulatedModbus(UNIT)
    unit.preset(item, *values)
    for name in ("registers", "inputs", "coils", "discretes"):
        expected = [stored.get(place, 0) if name == table else 0 for place in range(1000)]
        assert getattr(unit, name) == expected, name


@pytest.mark.parametrize(
    ("item", "value", "reason"),
    [
        ("holding:x", 1, "has no 'holding:x': use holding:100, input:100, coil:5 or discrete:5"),
        ("register:1", 1, "has no 'register:1'"),
        ("holding:999:uint32", 1, "is beyond the 1000 addresses of its table"),
        ("holding:1000", 1, "is beyond the 1000 addresses of its table"),
        ("coil:1", 2, "coil:1 holds a whole number, 0 to 1, not 2"),
        ("holding:1", 65536, "holding:1 cannot hold 65536: it is a register of uint16"),
        ("holding:1:int16", -32769, "it is a register of int16"),
        ("holding:1", 0.5, "cannot hold 0.5"),
    ],
)
def test_an_initial_value_that_a_unit_cannot_hold_is_refused(item: str, value: float, reason: str) -> None:
    unit = EmulatedModbus(UNIT)
    with pytest.raises(InvalidCommand, match=reason):
        unit.preset(item, value)
    assert len(unit.registers) == 1000
    assert not any(unit.registers)


@pytest.mark.parametrize(("item", "moves"), [("holding:0", False), ("holding:1", True), ("coil:0", True)])
def test_a_register_that_is_given_stands_and_others_go_on_moving(item: str, moves: bool) -> None:
    unit = make_device(UNIT, lively=True, size=10)
    unit.preset(item, 1)
    read = frame("11 03 0000 0001")
    seen = {heard_by(unit, (now, read))[-1] for now in (0.5, 1.0, 2.0)}
    assert len(seen) == (3 if moves else 1)


@pytest.mark.parametrize(
    "options",
    [
        {"address": 0},
        {"address": 248},
        {"functions": frozenset({3, 43})},
        {"traceable": TraceableMemory(1, 2**16 + 1)},
    ],
)
def test_a_unit_that_cannot_be_is_refused(options: dict[str, Any]) -> None:
    with pytest.raises(InvalidCommand):
        EmulatedModbus(**{"address": 1, **options})
    EmulatedModbus(247, functions=frozenset({3}), traceable=TraceableMemory(1, 2**16))


@pytest.mark.parametrize("seed", range(20))
def test_a_disguised_reply_comes_from_another_unit_with_a_right_crc(seed: int) -> None:
    answer = frame("11 03 02 0005")
    disguised = EmulatedModbus(UNIT).disguise(answer, Random(seed))
    assert disguised[0] != UNIT
    assert disguised == frame(f"{disguised[0]:02x} 03 02 0005")
    assert EmulatedModbus(UNIT).disguise(b"\x15", Random(seed)) == b"\x15"


# a listener


def test_a_listener_tells_requests_from_replies() -> None:
    frames = hear(
        "modbus",
        frame("11 03 0064 0002").hex(),
        frame("11 03 04 0001 ffff").hex(),
        frame("11 06 0001 0003").hex(),
        frame("11 06 0001 0003").hex(),
        frame("11 0f 0013 000a 02 cd 01").hex(),
        frame("11 8f 02").hex(),
        frame("00 05 0001 ff00").hex(),
        frame("11 01 0000 0018").hex(),
        frame("11 01 03 05 00 80").hex(),  # eight bytes, as a request has
        frame("11 04 0005 0001").hex(),
        frame("11 04 0005 0001").hex(),  # asked again
        frame("11 04 02 0007").hex(),
        frame("00 06 0001 0003").hex(),
        frame("00 06 0001 0003").hex(),  # not a reply: a write to all has none
    )
    bits = ",".join("101" + "0" * 20 + "1")
    assert said(frames) == [
        "host 17 read holding:100:2",
        "node 17 holding:100:2 = 1,65535",
        "host 17 write holding:1 = 3",
        "node 17 ACK",
        "host 17 write coil:19:10 = 1,0,1,1,0,0,1,1,1,0",
        "node 17 NAK",
        "host 0 write coil:1 = 1",
        "host 17 read coil:0:24",
        f"node 17 coil:0:24 = {bits}",
        "host 17 read input:5",
        "host 17 read input:5",
        "node 17 input:5 = 7",
        "host 0 write holding:1 = 3",
        "host 0 write holding:1 = 3",
    ]


@pytest.mark.parametrize(
    ("request_", "reply", "heard"),
    [
        ("11 01 0013 000a", "11 01 02 cd 01", ("read coil:19:10", "coil:19:10 = 1,0,1,1,0,0,1,1,1,0")),
        ("11 02 00c4 0003", "11 02 01 05", ("read discrete:196:3", "discrete:196:3 = 1,0,1")),
        ("11 02 00c4 0001", "11 02 01 01", ("read discrete:196", "discrete:196 = 1")),
        (
            "11 02 0000 0009",
            "11 02 01 05",
            ("read discrete:0:9", "discrete:0:9 = 1,0,1,0,0,0,0,0,0 [1 bytes of data, not 2]"),
        ),
        ("11 04 0008 0002", "11 04 04 000a ffff", ("read input:8:2", "input:8:2 = 10,65535")),
        ("11 05 00ac ff00", "11 05 00ac ff00", ("write coil:172 = 1", "ACK")),
        ("11 05 00ac 0000", "11 05 00ac 0000", ("write coil:172 = 0", "ACK")),
        ("11 10 0001 0002 04 000a 0102", "11 10 0001 0002", ("write holding:1:2 = 10,258", "ACK")),
    ],
)
def test_a_listener_reads_each_function(request_: str, reply: str, heard: tuple[str, str]) -> None:
    decoder = Decoder(find("modbus").protocol.dialect())
    frames = [*decoder.feed(frame(request_), 0.0, HOST), *decoder.feed(frame(reply), 0.01, NODE)]
    assert said(frames) == [f"host 17 {heard[0]}", f"node 17 {heard[1]}"]


def test_a_listener_says_what_is_wrong_with_a_frame() -> None:
    request = "11 03 0064 0001"
    assert said(hear("modbus", frame(request).hex(), "11 03 02 00 01 00 00", "|"))[1].endswith("[bad CRC]")
    assert said(hear("modbus", frame("11 03 02 0001").hex(), "|")) == ["unknown 7 bytes [cut short after 7 bytes]"]
    another = said(hear("modbus", frame("11 06 0001 0003").hex(), frame("11 06 0001 0004").hex()))
    assert "it repeats another write" in another[1]
    assert "4 bytes of data, not 2" in said(hear("modbus", frame(request).hex(), frame("11 03 04 0001 0002").hex()))[1]


@pytest.mark.parametrize(("code", "name"), [("02", "illegal data address"), ("2b", "exception 43")])
def test_a_listener_names_the_exception_of_a_refusal(code: str, name: str) -> None:
    frames = hear("modbus", frame("11 03 0064 0001").hex(), frame(f"11 83 {code}").hex())
    assert (frames[1].kind, frames[1].command) == (Kind.NAK, name)


@pytest.mark.parametrize("reply", ["12 03 02 0001", "11 04 02 0001", "12 83 02"])
def test_a_reply_of_another_unit_or_function_is_wrong(reply: str) -> None:
    decoder = Decoder(find("modbus").protocol.dialect())
    decoder.feed(frame("11 03 0064 0001"), 0.0, HOST)
    [found] = decoder.feed(frame(reply), 0.01, NODE)
    assert found.fault == "wrong reply: function 3 of unit 17 was requested"
