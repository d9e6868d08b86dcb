"""Modbus RTU at its edges: the least and the most that fits, what is refused and how, CRCs that are wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from busmaster import InvalidCommand, Refused
from busmaster.contract.exchange import MORE, OTHER_FORMAT, Done, FrameError
from busmaster.protocols.modbus.codec import PROFILE, MergedRead, ReadBits, ReadRegisters, WriteCoils, WriteRegisters
from tests.protocols.modbus_frames import UNIT, frame


@pytest.mark.parametrize(
    ("reply", "name", "hint"),
    [
        ("11 83 01 81 35", "illegal function", None),
        ("11 83 02 c1 34", "illegal data address", None),
        ("11 83 03 00 f4", "illegal data value", None),
        ("11 83 04 41 36", "device failure", None),
        ("11 83 05 80 f6", "acknowledged, but it takes long", "try again later"),
        ("11 83 06 c0 f7", "device busy", "try again later"),
        ("11 83 07 01 37", "exception 7", None),
        ("11 83 08 41 33", "memory parity error", None),
        ("11 83 0a c0 f2", "gateway path unavailable", "check the gateway"),
        ("11 83 0b 01 32", "gateway target did not respond", "check the device behind the gateway"),
    ],
)
def test_an_exception_is_a_refusal_with_its_name_that_is_believed_at_once(
    reply: str, name: str, hint: str | None
) -> None:
    with pytest.raises(Refused, match=f"^refused: {name};") as refusal:
        ReadRegisters(7).open(UNIT, PROFILE.timings).feed(bytes.fromhex(reply))
    usual = Refused("refused").hint
    assert (refusal.value.hint, refusal.value.confirm) == (hint or usual, False)
    assert refusal.value.temporary is (hint is not None), "only these four tell of a state that may pass"


@pytest.mark.parametrize(
    "fits",
    [
        lambda: ReadRegisters(0),
        lambda: ReadRegisters(65535),
        lambda: ReadRegisters(65535 - 124, 125),
        lambda: ReadBits(65535 - 1999, 2000),
        lambda: WriteRegisters(0, (0,)),
        lambda: WriteRegisters(0, (65535,) * 123),
        lambda: WriteCoils(0, (True,) * 1968),
    ],
)
def test_the_least_and_the_most_can_be_sent(fits: Callable[[], Any]) -> None:
    command = fits()
    assert len(command.open(UNIT, PROFILE.timings).request) <= 256


@pytest.mark.parametrize(
    "mistake",
    [
        lambda: ReadRegisters(-1),
        lambda: ReadRegisters(-1, 2),
        lambda: ReadRegisters(65536),
        lambda: ReadRegisters(0, 0),
        lambda: ReadRegisters(0, 126),
        lambda: ReadRegisters(65535 - 123, 125),
        lambda: ReadBits(-1),
        lambda: ReadBits(0, 0),
        lambda: ReadBits(0, 2001),
        lambda: WriteRegisters(-1, (1,)),
        lambda: WriteRegisters(0, (-1,)),
        lambda: WriteRegisters(0, (65536,)),
        lambda: WriteRegisters(65535, (1, 2)),
        lambda: WriteCoils(0, (-1,)),  # type: ignore[arg-type]  # that is what is refused
        lambda: WriteCoils(0, (2,)),  # type: ignore[arg-type]  # that is what is refused
        lambda: WriteCoils(65535, (True, False)),
    ],
)
def test_one_less_and_one_more_cannot(mistake: Callable[[], Any]) -> None:
    with pytest.raises(InvalidCommand):
        mistake()


@pytest.mark.parametrize(
    ("command", "text"),
    [
        (ReadRegisters(7), "read holding 7"),
        (ReadRegisters(7, 3, "input"), "read input 7-9"),
        (ReadBits(7, 2), "read coil 7-8"),
        (ReadBits(7, table="discrete"), "read discrete 7"),
        (WriteRegisters(7, (5,)), "write holding 7 = 5"),
        (WriteRegisters(7, tuple(range(8))), "write holding 7-14 = 0, 1, 2, 3, 4, 5, 6, 7"),
        (WriteRegisters(7, (0,) * 9), "write holding 7-15 = 9 values"),
        (WriteCoils(7, (True, False)), "write coil 7-8 = 1, 0"),
    ],
)
def test_a_command_says_what_it_does(command: Any, text: str) -> None:
    assert str(command) == text


@pytest.mark.parametrize("chunks", [1, 2, 3])
def test_a_refusal_is_read_byte_by_byte_and_its_crc_is_looked_at(chunks: int) -> None:
    refused = frame("11 83 02")
    exchange = ReadRegisters(7).open(UNIT, PROFILE.timings)
    for start in range(0, 4, chunks):
        assert exchange.feed(refused[start : min(4, start + chunks)]) is MORE
    with pytest.raises(Refused):
        exchange.feed(refused[4:])
    for damaged in (refused[:-1] + b"\0", refused + b"\0"):
        with pytest.raises(FrameError, match="bad CRC") as failure:
            ReadRegisters(7).open(UNIT, PROFILE.timings).feed(damaged)
        assert not failure.value.whole


def test_a_bad_crc_is_a_whole_frame_unless_something_follows() -> None:
    reply = frame("11 03 02 02 2b")
    damaged = reply[:-1] + bytes((reply[-1] ^ 1,))
    for heard, whole in ((damaged, True), (damaged + b"\0", False)):
        with pytest.raises(FrameError, match="bad CRC") as failure:
            ReadRegisters(7).open(UNIT, PROFILE.timings).feed(heard)
        assert failure.value.whole == whole
    assert ReadRegisters(7).open(UNIT, PROFILE.timings).feed(reply + b"\0\1") == Done((555,), rest=b"\0\1")


def test_a_whole_reply_of_another_function_is_no_reply_in_another_format() -> None:
    def hint(reply: bytes) -> str | None:
        with pytest.raises(FrameError) as error:
            ReadRegisters(7).open(UNIT, PROFILE.timings).feed(reply)
        return error.value.hint

    assert hint(frame("11 03 04 0001 0002")) == OTHER_FORMAT, "two registers in place of one"
    assert hint(frame("11 04 02 0001")) is None


@pytest.mark.parametrize("spans", [(), ((),), ((1,),), ((1, 1), (2, 1, 3))])
def test_a_merged_read_of_no_spans_is_refused(spans: Any) -> None:
    with pytest.raises(InvalidCommand, match="merged read"):
        MergedRead("holding", spans)
