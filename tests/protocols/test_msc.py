"""MSC commands: the packets of IB-11A002 byte for byte, values, flags, the status word, and merged reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster.contract.driver import Driver, Ending
from busmaster.contract.exchange import Command, FrameError
from busmaster.contract.profile import Batch
from busmaster.errors import InvalidCommand
from busmaster.protocols.msc.codec import (
    PROFILE,
    BlockRead,
    BlockWrite,
    ClearFlag,
    DataRead,
    DataWrite,
    Merging,
    PickedData,
    PickedFlags,
    ReadFlag,
    ReadFlags,
    ReadStatus,
    SetFlag,
)
from busmaster.protocols.msc.exchange import packet
from busmaster.protocols.msc.status import ERRORS, STATUS_BITS, WARNINGS, ProgramStatus
from tests.protocols.asking import vectors

FRAMES = vectors("MSC")
ACK = b"\x06"

REQUESTS: dict[str, tuple[Command[Any], int]] = {
    "DWRITE unit 1 addr 2008 = 1234": (DataWrite(2008, 1234), 1),
    "DREAD unit 1 addr 2008": (DataRead(2008), 1),
    "SFLAG unit 2 flag 5": (SetFlag(5), 2),
    "CFLAG unit 2 flag 5": (ClearFlag(5), 2),
    "RFLAG unit 15 flag 255": (ReadFlag(255), 15),
    "RFLAGS unit 3": (ReadFlags(), 3),
    "RQSTAT unit 1": (ReadStatus(), 1),
    "BREAD unit 1 addr 2008": (BlockRead(2008), 1),
    "BWRITE unit 1 addr 2008 values 0..31": (BlockWrite(2008, tuple(range(32))), 1),
}
REPLIES: dict[str, tuple[Command[Any], int, object]] = {
    "DREAD reply 1234": (DataRead(2008), 1, 1234),
    "DREAD reply -1": (DataRead(2008), 1, -1),
    "RFLAG reply ON": (ReadFlag(255), 15, True),
    "RFLAGS reply flags {0,9,31,255} on": (ReadFlags(), 3, {0, 9, 31, 255}),
    "RQSTAT reply status 65": (ReadStatus(), 1, ProgramStatus.PROGRAM_RUNNING | ProgramStatus.AUTO_START_ENABLED),
    "BREAD reply values 0..31": (BlockRead(2008), 1, tuple(range(32))),
}


def answer(command: Command[Any], unit: int, reply: bytes) -> Any:
    """The value of an exchange that is answered with an ACK and this packet in one chunk."""
    driver = Driver(command.open(unit, PROFILE.timings)).feed(ACK + reply)
    assert driver.sent == []
    assert driver.ending == Ending(driver.ending and driver.ending.value, send=ACK)
    return driver.ending.value


def test_every_frame_of_the_vectors_is_tested() -> None:
    assert FRAMES.keys() == REQUESTS.keys() | REPLIES.keys()


@pytest.mark.parametrize("name", REQUESTS)
def test_a_request_is_sent_as_the_published_packet(name: str) -> None:
    command, unit = REQUESTS[name]
    assert command.open(unit, PROFILE.timings).request == FRAMES[name]


@pytest.mark.parametrize("name", REPLIES)
def test_a_published_packet_gives_its_value(name: str) -> None:
    command, unit, value = REPLIES[name]
    assert answer(command, unit, FRAMES[name]) == value


def test_the_documents_example_packet_has_its_checksum_958() -> None:
    """ "Example packet": write 1234 to address 2008."""
    assert DataWrite(2008, 1234).open(1, PROFILE.timings).request[-2:] == bytes.fromhex("03 be")


@given(st.integers(-(2**31), 2**31 - 1))
def test_any_signed_32_bit_value_is_sent_and_read(value: int) -> None:
    data = value.to_bytes(4, "big", signed=True)
    assert DataWrite(0, value).open(1, PROFILE.timings).request[15:19] == data
    assert answer(DataRead(0), 1, packet(1, b"DREAD," + data)) == value


@given(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=32, max_size=32))
def test_any_block_is_sent_and_read(values: list[int]) -> None:
    data = b"".join(value.to_bytes(4, "big", signed=True) for value in values)
    assert BlockWrite(7, tuple(values)).open(1, PROFILE.timings).request[15:-2] == data
    assert answer(BlockRead(7), 1, packet(1, b"BREAD," + data)) == tuple(values)


@given(st.frozensets(st.integers(0, 255)))
def test_flag_0_is_bit_0_of_the_first_byte_and_flag_255_bit_7_of_the_last(flags: frozenset[int]) -> None:
    states = bytearray(32)
    for flag in flags:
        states[flag // 8] |= 1 << flag % 8
    assert answer(ReadFlags(), 1, packet(1, b"RFLAGS," + states)) == flags


def test_a_flag_is_on_or_off_and_nothing_else() -> None:
    assert answer(ReadFlag(3), 1, packet(1, b"RFLAG,\0\0")) is False
    exchange = ReadFlag(3).open(1, PROFILE.timings)
    exchange.feed(ACK)
    with pytest.raises(FrameError, match="0 or 1, not 2") as error:
        exchange.feed(packet(1, b"RFLAG,\0\2"))
    assert error.value.send == ACK


def test_the_status_word_has_the_documents_sixteen_bits() -> None:
    assert sum(ProgramStatus) == 0xFFFF
    assert ProgramStatus(65).name == "PROGRAM_RUNNING|AUTO_START_ENABLED"
    assert [1 << bit.number for bit in STATUS_BITS] == [1 << number for number in range(16)]


def test_the_errors_of_the_status_word_are_those_that_the_document_calls_so() -> None:
    errors = (8, 9, 11, 12, 13, 14, 15)
    assert sum(1 << number for number in errors) == ERRORS
    assert [bit.number for bit in STATUS_BITS if bit.severity == "error"] == list(errors)
    assert not ERRORS & WARNINGS
    assert [bit.number for bit in STATUS_BITS if bit.severity == "warning"] == [1, 2, 3, 5]


def test_a_status_word_says_what_is_wrong_and_what_it_means() -> None:
    healthy, ill = ProgramStatus(65), ProgramStatus(2 | 64 | 4096 | 8192)
    assert not healthy.errors
    assert not healthy.warnings
    assert healthy.texts == ("the program runs", "the program starts on power-up")
    assert ill.errors == ProgramStatus.BAD_OPCODE | ProgramStatus.STACK_OVERFLOW
    assert ill.warnings == ProgramStatus.BATTERY_LOW
    assert len(ill.texts) == 4
    assert ProgramStatus(0).texts == ()


@pytest.mark.parametrize("tail", [b"", b"\0" * 6, b"\xff" * 7])
def test_what_follows_the_status_word_is_ignored(tail: bytes) -> None:
    """ "[FF] and [AAAA] are not currently used"."""
    assert answer(ReadStatus(), 1, packet(1, b"RQSTAT,\x00\x41" + tail)) == 65


BAD: list[Callable[[], object]] = [
    lambda: DataRead(-1),
    lambda: DataRead(65536),
    lambda: DataRead("2008"),  # type: ignore[arg-type]  # what a caller without a type checker does
    lambda: DataWrite(65536, 0),
    lambda: DataWrite(0, 2**31),
    lambda: DataWrite(0, -(2**31) - 1),
    lambda: DataWrite(0, 1.5),  # type: ignore[arg-type]  # the same
    lambda: BlockRead(65536),
    lambda: BlockWrite(65536, (0,) * 32),
    lambda: BlockWrite(0, (0,) * 31),
    lambda: BlockWrite(0, (0,) * 33),
    lambda: BlockWrite(0, (2**31,) * 32),
    lambda: SetFlag(256),
    lambda: ClearFlag(-1),
    lambda: ReadFlag(True),
]


@pytest.mark.parametrize("build", BAD)
def test_what_cannot_be_sent_is_refused_when_the_command_is_built(build: Callable[[], object]) -> None:
    with pytest.raises(InvalidCommand):
        build()


@pytest.mark.parametrize(
    ("command", "text", "writes"),
    [
        (DataRead(2008), "read data 2008", False),
        (DataWrite(2008, -1), "write data 2008 = -1", True),
        (BlockRead(2008), "read 32 values from data 2008", False),
        (BlockWrite(2008, (1,) * 32), "write 32 values from data 2008", True),
        (SetFlag(5), "set flag 5", True),
        (ClearFlag(5), "clear flag 5", True),
        (ReadFlag(5), "read flag 5", False),
        (ReadFlags(), "read all flags", False),
        (ReadStatus(), "read program status", False),
        (PickedData(2008, (0, 2)), "read 2 of the 32 values from data 2008", False),
        (PickedFlags((1, 2, 3)), "read 3 of all flags", False),
    ],
)
def test_a_command_says_what_it_does(command: Command[Any], text: str, writes: bool) -> None:
    assert str(command) == text
    assert (command.writes, command.idempotent) == (writes, not writes)


def test_the_line_and_the_units_are_the_documents() -> None:
    assert (PROFILE.line.baudrate, PROFILE.line.framing) == (9600, "8N1")
    assert list(PROFILE.addresses) == list(range(1, 16))
    assert PROFILE.listen is not None
    assert PROFILE.exchange_limit == 2.0


# what a write changes


def test_a_value_that_is_written_changes_its_own_address_as_far_as_is_known() -> None:
    assert DataWrite(10, 5).changes(PROFILE) == {("data", 10): 5}
    stepping = replace(PROFILE, merge=Merging(address_step=2))
    assert DataWrite(10, 5).changes(stepping) == {("data", 9): None, ("data", 10): 5, ("data", 11): None}


def test_a_block_that_is_written_changes_whatever_lies_within_four_addresses_of_a_value() -> None:
    """A value has four bytes: its address grows by no more, but by how much is not known."""
    changes = BlockWrite(10, tuple(range(32))).changes(PROFILE)
    assert changes == {("data", address): None for address in range(7, 10 + 32 * 4)} | {("data", 10): 0}
    stepping = replace(PROFILE, merge=Merging(address_step=1))
    assert BlockWrite(10, tuple(range(32))).changes(stepping) == {("data", 10 + n): n for n in range(32)}


# merged reads


def merge(commands: Sequence[Command[Any]], **options: Any) -> Sequence[Batch]:
    return Merging(**options)(commands)


def served(batch: Batch, unit: int, reply: bytes) -> dict[int, Any]:
    return dict(zip(batch.serves, answer(batch.command, unit, reply), strict=True))


def test_neighbouring_values_become_one_block() -> None:
    commands: list[Command[Any]] = [DataRead(2012), ReadStatus(), DataRead(2000), DataRead(2124), DataRead(2012)]
    (batch,) = merge(commands, address_step=4)
    assert batch.command.open(1, PROFILE.timings).request == BlockRead(2000).open(1, PROFILE.timings).request
    data = b"".join(number.to_bytes(4, "big") for number in range(32))
    assert served(batch, 1, packet(1, b"BREAD," + data)) == {0: 3, 2: 0, 3: 31, 4: 3}


def test_a_value_between_the_steps_or_beyond_the_block_stays_alone() -> None:
    assert merge([DataRead(2000), DataRead(2002)], address_step=4) == []
    assert merge([DataRead(2000), DataRead(2128)], address_step=4) == []
    (odd,) = merge([DataRead(2001), DataRead(2005), DataRead(2006)], address_step=4)
    assert odd.serves == (0, 1)
    two = merge([DataRead(0), DataRead(1), DataRead(32), DataRead(33)], address_step=1)
    assert [batch.serves for batch in two] == [(0, 1), (2, 3)]


def test_no_block_runs_beyond_the_last_address() -> None:
    assert merge([DataRead(65535), DataRead(65534)], address_step=1) == []
    assert merge([DataRead(65505), DataRead(65506)], address_step=1) == []
    assert len(merge([DataRead(65504), DataRead(65505)], address_step=1)) == 1


def test_an_address_step_leaves_room_for_a_block() -> None:
    assert Merging(1).address_step == 1
    assert Merging(2047).address_step == 2047
    for step in (-1, 0, 2048):
        with pytest.raises(InvalidCommand, match="address_step"):
            Merging(step)


def test_values_are_not_merged_while_the_address_step_is_unknown() -> None:
    assert merge([DataRead(2000), DataRead(2004)]) == []
    with pytest.raises(InvalidCommand):
        Merging(address_step=0)


def test_flags_are_read_at_once_where_the_controller_can() -> None:
    commands: list[Command[Any]] = [ReadFlag(255), DataRead(0), ReadFlag(0), ReadFlag(8)]
    assert merge(commands) == []
    assert merge(commands[:2], all_flags=True) == []
    (batch,) = merge(commands, all_flags=True)
    assert served(batch, 1, packet(1, b"RFLAGS,\x01" + bytes(30) + b"\x80")) == {0: True, 2: True, 3: False}
