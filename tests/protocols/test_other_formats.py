"""Replies that are right in their check and have another form than the protocol's: no noise makes them."""

from __future__ import annotations

from typing import Any

import pytest

from busmaster.contract.driver import Driver
from busmaster.contract.exchange import OTHER_FORMAT, Command, FrameError
from busmaster.contract.profile import Profile
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.exchange import packet
from busmaster.wire.checks import bcc, sum8, xor


def telegram(echo: str, data: str, check: Any = xor) -> bytes:
    body = f"{echo}{data}\x03".encode()
    return b"\x02" + body + bytes([check(body)])


MICROS = "1234.567800000000000000000"
OTHERS = [
    pytest.param(hcp.PROFILE, hcp.Read(1), telegram("01", MICROS), "26 characters of data where 20", id="hcp, long"),
    pytest.param(hcp.PROFILE, hcp.Read(1), telegram("01", "ON"), "b'ON' is not a number", id="hcp, no number"),
    pytest.param(
        hcp2.PROFILE, hcp2.Read(16), telegram("10", MICROS), "26 characters of data where 20", id="hcp2, long"
    ),
    pytest.param(
        mentor.PROFILE,
        mentor.Read(1, 17),
        telegram("0117", "+001500.0", bcc),
        "9 characters of data where 5",
        id="mentor, long",
    ),
    pytest.param(
        mentor.PROFILE,
        mentor.Read(1, 17),
        telegram("0117", "+47.6", bcc),
        "b'+47.6' is not a whole number",
        id="mentor, with a point",
    ),
    pytest.param(
        mentor.PROFILE,
        mentor.ReadRun(1, 17, 3),
        telegram("0117", "+001500.0", bcc),
        "9 characters of data where 5",
        id="mentor, in a run",
    ),
    pytest.param(
        ct_ansi.PROFILE,
        ct_ansi.Read(1, 17),
        telegram("0117", "+1500.00000000", bcc),
        "14 characters of data where 12",
        id="ct-ansi, long",
    ),
    pytest.param(
        dc104.PROFILE,
        dc104.Read(1),
        b"\x02\x01\0\0\x12\x34" + bytes([sum8(b"\x01\0\0\x12\x34")]),
        "a reply has 5",
        id="dc104, long",
    ),
    pytest.param(
        msc.PROFILE,
        msc.DataRead(2008),
        b"\x06" + packet(1, b"DREAD," + bytes(6)),
        "the requested packet has 18",
        id="msc, long",
    ),
    pytest.param(
        modbus.PROFILE,
        modbus.ReadRegisters(100, 1),
        modbus.with_crc(b"\x01\x03\x04\0\1\0\2"),
        "begin with 01 03 04 in place of 01 03 02",
        id="modbus, more registers",
    ),
    pytest.param(
        modbus.PROFILE,
        modbus.ReadRegisters(100, 1),
        modbus.with_crc(b"\x01\x03\x02\0\1\0\2"),
        "the reply to this has 7",
        id="modbus, more bytes than it says",
    ),
]


def failure(profile: Profile, command: Command[Any], reply: bytes) -> FrameError:
    error = Driver(command.open(1, profile.timings)).feed(reply).run_out().error
    assert isinstance(error, FrameError)
    return error


@pytest.mark.parametrize(("profile", "command", "reply", "why"), OTHERS)
def test_a_reply_of_another_form_is_told_from_a_damaged_one(
    profile: Profile, command: Command[Any], reply: bytes, why: str
) -> None:
    error = failure(profile, command, reply)
    size = len(reply.removeprefix(b"\x06"))
    assert error.what.startswith(f"{size} bytes came, right in their check but of another format: ")
    assert why in error.what
    assert error.hint == OTHER_FORMAT


@pytest.mark.parametrize(("profile", "command", "reply", "why"), OTHERS)
def test_the_same_with_one_bit_flipped_in_its_check_is_damaged(
    profile: Profile, command: Command[Any], reply: bytes, why: str
) -> None:
    assert failure(profile, command, reply[:-1] + bytes([reply[-1] ^ 1])).hint is None
