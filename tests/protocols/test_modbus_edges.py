"""Modbus RTU at its edges: the least and the most that fits, what is refused and how, CRCs that are wrong."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from busmaster import InvalidCommand, Refused
from busmaster.contract.exchange import MORE, Done, FrameError
from busmaster.protocols.modbus.codec import (
    EXCEPTIONS,
    PROFILE,
    ReadBits,
    ReadRegisters,
    WriteCoils,
    WriteRegisters,
    with_crc,
)

UNIT = 0x11


@pytest.mark.parametrize(
    ("code", "hint"),
    [
        (1, None),
        (2, None),
        (3, None),
        (4, None),
        (5, "ask again later"),
        (6, "ask again later"),
        (8, None),
        (10, "look at the gateway"),
        (11, "look behind the gateway"),
        (12, None),
    ],
)
def test_a_refusal_says_what_to_do_where_something_can_be_done(code: int, hint: str | None) -> None:
    with pytest.raises(Refused) as refusal:
        ReadRegisters(7).open(UNIT, PROFILE.timings).feed(with_crc(bytes((UNIT, 0x83, code))))
    plain = Refused("refused: it", confirm=False)
    hinted = Refused("refused: it", confirm=False, hint=hint) if hint else plain
    assert (refusal.value.hint, refusal.value.confirm) == (hinted.hint, False)


def test_the_names_of_the_exceptions_are_the_specifications() -> None:
    assert EXCEPTIONS == {
        1: "illegal function",
        2: "illegal data address",
        3: "illegal data value",
        4: "device failure",
        5: "acknowledged, but it takes long",
        6: "device busy",
        8: "memory parity error",
        10: "gateway path unavailable",
        11: "gateway target did not respond",
    }


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
    refused = with_crc(bytes((UNIT, 0x83, 2)))
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
    reply = with_crc(bytes.fromhex("11 03 02 02 2b"))
    damaged = reply[:-1] + bytes((reply[-1] ^ 1,))
    for heard, whole in ((damaged, True), (damaged + b"\0", False)):
        with pytest.raises(FrameError, match="bad CRC") as failure:
            ReadRegisters(7).open(UNIT, PROFILE.timings).feed(heard)
        assert failure.value.whole == whole
    assert ReadRegisters(7).open(UNIT, PROFILE.timings).feed(reply + b"\0\1") == Done((555,), rest=b"\0\1")
