"""Five protocols through the conformance kit: what each manual says, and what its checks cannot see."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

from busmaster.contract.exchange import Command
from busmaster.errors import NoSuchParameter, Refused
from busmaster.protocols._comms.device import HCP, HCP2
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from busmaster.testing import Case, Foreign, RoundTrip, answers_of, check_protocol
from tests.protocols.slaves import MscSlave, dc104_slave, mentor_slave

ACK, NAK, EOT = b"\x06", b"\x15", b"\x04"
DECIMALS = [0.0, 1.0, -1.0, 0.5, -0.0001, 123.456, 99999.9999, 1234567, -7654321]
WORDS = tuple(value for bit in range(0, 32, 2) for value in (2**bit - 1, -(2**bit)))


def element_named(command: Command[Any], address: int) -> Hashable:
    """A telegram names its element and no node; an ACK names nothing."""
    return "ACK" if command.writes else getattr(command, "element", None)


def test_hcp_keeps_the_contract() -> None:
    check_protocol(
        hcp.PROFILE,
        [
            Case(hcp.Read(1), 2, [bytes.fromhex("02 30 31 31 32 33 2e 34 35 36 03 2b")], 123.456),
            Case(hcp.Read(4), 13, [bytes.fromhex("02 30 34 30 03 37")], 0.0),
            Case(hcp.Read(99), 0, [bytes.fromhex("02 39 39 2d 30 2e 30 30 30 31 03 31")], -0.0001),
            Case(hcp.Read(1), 1, [bytes.fromhex("02 30 31 31 30 2e 38 03 15")], 10.8),
            Case(hcp.Read(1), 15, [NAK], raises=Refused),
            Case(hcp.Write(12, (5.0,)), 13, [ACK], request=bytes.fromhex("04 44 44 02 31 32 35 03 35")),
            Case(hcp.Write(10, (1234, -45.6, 11.2)), 0, [ACK]),
            Case(hcp.Write(10, (1, 2)), 0, [NAK], raises=Refused),
        ],
        names=element_named,
        invalid=[lambda: hcp.Read(0), lambda: hcp.Read(100), lambda: hcp.Write(99, (1, 2)), lambda: hcp.Write(1, ())],
        round_trips=[
            RoundTrip(3, lambda value: hcp.Write(1, (value,)), hcp.Read(1), DECIMALS),
            RoundTrip(3, lambda value: hcp.Write(98, (0, value)), hcp.Read(99), DECIMALS),
        ],
        device=answers_of(EmulatedMint(3, HCP)),
    )


def test_hcp2_keeps_the_contract() -> None:
    check_protocol(
        hcp2.PROFILE,
        [
            Case(hcp2.Read(1), 2, [bytes.fromhex("02 30 31 31 32 33 2e 34 35 36 03 2b")], 123.456),
            Case(hcp2.Read(105), 255, [bytes.fromhex("02 36 39 34 30 39 36 03 07")], 4096.0),
            Case(hcp2.Read(222), 1, [bytes.fromhex("02 44 45 35 03 37")], 5.0),
            Case(hcp2.Read(109), 7, [bytes.fromhex("02 36 44 31 39 32 03 4b")], 192.0),
            Case(hcp2.Read(16), 7, [NAK], raises=Refused),
            Case(hcp2.Write(1, (5,)), 1, [ACK], request=bytes.fromhex("07 30 31 02 30 31 35 03 34")),
            Case(hcp2.Write(10, (10, 20, 30)), 13, [ACK]),
            Case(hcp2.Write(254, (1, 2)), 13, [NAK], raises=Refused),
        ],
        names=element_named,
        foreign=[
            Foreign(hcp2.Read(10), 1, bytes.fromhex("02 31 30 35 03 37"), "element 16, whose name in decimal is 10"),
        ],
        invalid=[lambda: hcp2.Read(0), lambda: hcp2.Read(256), lambda: hcp2.Write(1, (float("nan"),))],
        round_trips=[RoundTrip(200, lambda value: hcp2.Write(99, (value,)), hcp2.Read(99), DECIMALS)],
        device=answers_of(EmulatedMint(200, HCP2)),
    )


def parameter_named(command: Command[Any], address: int) -> Hashable:
    """A telegram names its parameter and no drive; a run begins with one."""
    return "ACK" if command.writes else (getattr(command, "menu", None), getattr(command, "number", None))


def test_mentor_keeps_the_contract() -> None:
    first = bytes.fromhex("02 30 31 31 37 2d 30 34 37 36 03 2c")
    second = bytes.fromhex("02 30 31 31 38 2b 30 30 30 30 03 20")
    check_protocol(
        mentor.PROFILE,
        [
            Case(mentor.Read(1, 17), 12, [first], -476, request=bytes.fromhex("04 31 31 32 32 30 31 31 37 05")),
            Case(mentor.Read(15, 60), 5, [bytes.fromhex("02 31 35 36 30 35 34 33 32 31 03 30")], 54321),
            Case(mentor.Read(17, 23), 12, [EOT], raises=NoSuchParameter),
            Case(mentor.Read(1, 19), 12, [NAK], raises=Refused),
            Case(mentor.ReadRun(1, 17, 2), 12, [first, second], (-476, 0)),
            Case(mentor.Write(1, 17, -476), 14, [ACK]),
            Case(mentor.Write(1, 17, 9999), 14, [NAK], raises=Refused),
            Case(
                mentor.Write(1, 17, 0),
                0,
                [],
                request=bytes.fromhex("04 30 30 30 30 02 30 31 31 37 2b 30 30 30 30 03 2f"),
            ),
        ],
        names=parameter_named,
        invalid=[
            lambda: mentor.Read(100, 1),
            lambda: mentor.Write(1, 17, 12000),
            lambda: mentor.Write(15, 60, 65536, wide=True),
            lambda: mentor.Read(1, 17).open(0, mentor.PROFILE.timings),
        ],
        round_trips=[
            RoundTrip(14, lambda value: mentor.Write(1, 17, value), mentor.Read(1, 17), range(-9999, 10000, 101)),
            RoundTrip(
                14, lambda value: mentor.Write(15, 60, value, wide=True), mentor.Read(15, 60), [0, 9999, 10000, 65535]
            ),
            RoundTrip(14, lambda value: mentor.Write(4, 26, value), mentor.Read(4, 26), [True, False]),
        ],
        device=mentor_slave(),
    )


def name_and_unit(command: Command[Any], unit: int) -> Hashable:
    """A packet names its unit and its command, and no data address or flag; an ACK names nothing."""
    return "ACK" if command.writes else (type(command), unit)


def test_msc_keeps_the_contract() -> None:
    dread = bytes.fromhex("02 01 00 0a 00 00 44 52 45 41 44 2c 00 00 04 d2 02 6d")
    negative = bytes.fromhex("02 01 00 0a 00 00 44 52 45 41 44 2c ff ff ff ff 05 93")
    flag_on = bytes.fromhex("02 0f 00 08 00 00 52 46 4c 41 47 2c 00 01 01 b0")
    status = bytes.fromhex("02 01 00 0f 00 00 52 51 53 54 41 54 2c 00 41 00 00 00 00 00 00 02 5c")
    flags = bytes.fromhex("02 03 00 27 00 00 52 46 4c 41 47 53 2c 01 02 00 80" + 27 * "00" + "80 03 18")
    block = bytes.fromhex("02 01 00 86 00 00 42 52 45 41 44 2c" + "".join(f"{i:08x}" for i in range(32)) + "04 01")
    damaged = dread[:-1] + b"\x70"
    check_protocol(
        msc.PROFILE,
        [
            Case(msc.DataRead(2008), 1, [ACK, dread], 1234),
            Case(msc.DataRead(2008), 1, [ACK, negative], -1),
            Case(msc.DataRead(2008), 1, [NAK, NAK, NAK, ACK, damaged, damaged, dread], 1234),
            Case(msc.DataRead(2008), 1, [NAK] * 4, raises=Refused),
            Case(msc.DataRead(2008), 1, [flag_on, ACK, flag_on, dread], 1234),
            Case(
                msc.DataRead(2008),
                2,
                [ACK, bytes.fromhex("02 02 00 0a 00 00 44 52 45 41 44 2c 00 00 04 d2 02 6e")],
                1234,
            ),
            Case(msc.BlockRead(2008), 1, [ACK, block], tuple(range(32))),
            Case(msc.ReadFlag(255), 15, [ACK, flag_on], True),
            Case(msc.ReadFlags(), 3, [ACK, flags], {0, 9, 31, 255}),
            Case(msc.ReadStatus(), 1, [ACK, status], 65),
            Case(msc.DataWrite(2008, 1234), 1, [ACK]),
            Case(msc.DataWrite(2008, 1234), 1, [NAK] * 4, raises=Refused),
            Case(msc.BlockWrite(0, (0,) * 32), 1, [ACK]),
            Case(msc.SetFlag(5), 2, [ACK]),
            Case(msc.ClearFlag(5), 2, [ACK]),
        ],
        names=name_and_unit,
        foreign=[
            Foreign(msc.DataRead(2008), 1, dread, "a packet whose request is not this one: the ACK has not come yet"),
            Foreign(msc.DataWrite(2008, 1234), 1, dread, "the same, and it holds no ACK"),
        ],
        invalid=[lambda: msc.DataRead(65536), lambda: msc.BlockWrite(0, (1, 2)), lambda: msc.ReadFlag(256)],
        round_trips=[
            RoundTrip(7, lambda value: msc.DataWrite(2008, value), msc.DataRead(2008), WORDS),
            RoundTrip(7, lambda value: msc.DataWrite(0xFFFF, value), msc.DataRead(0xFFFF), WORDS),
            RoundTrip(7, lambda values: msc.BlockWrite(100, values), msc.BlockRead(100), [WORDS, WORDS[::-1]]),
            RoundTrip(7, msc.SetFlag, msc.ReadFlag(9), [9], read_back=lambda flag: True),
            RoundTrip(7, msc.ClearFlag, msc.ReadFlag(9), [9], read_back=lambda flag: False),
            RoundTrip(7, msc.SetFlag, msc.ReadFlags(), range(256), read_back=lambda flag: set(range(flag + 1))),
        ],
        device=MscSlave(7),
    )


def dc104_parameter_named(command: Command[Any], address: int) -> Hashable:
    return "ACK" if command.writes else getattr(command, "parameter", None)


def test_dc104_keeps_the_contract() -> None:
    check_protocol(
        dc104.PROFILE,
        [
            Case(dc104.Read(1), 0, [bytes.fromhex("02 01 04 d2 d7")], 1234),
            Case(dc104.Read(6), 0, [bytes.fromhex("02 06 00 00 06")], 0),
            Case(dc104.Read(21), 0, [bytes.fromhex("02 15 00 00 15")], 0),
            Case(dc104.Read(255), 0, [bytes.fromhex("02 ff ff ff fd")], 65535),
            Case(dc104.Read(9), 0, [NAK], raises=Refused),
            Case(dc104.Write(170, 21762), 0, [ACK], request=bytes.fromhex("02 55 aa 55 02 56")),
            Case(dc104.Write(170, 1), 0, [NAK], raises=Refused),
        ],
        names=dc104_parameter_named,
        invalid=[lambda: dc104.Read(0), lambda: dc104.Read(256), lambda: dc104.Write(1, 65536)],
        round_trips=[
            RoundTrip(0, lambda value: dc104.Write(5, value), dc104.Read(5), range(0, 65536, 257)),
            RoundTrip(0, lambda value: dc104.Write(255, value), dc104.Read(255), [0, 1, 0x0206, 0xFFFF]),
        ],
        device=dc104_slave(),
    )
