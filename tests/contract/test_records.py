"""What passes between protocols and the arbiter: plain records that nobody changes behind another's back."""

from __future__ import annotations

import importlib
import pkgutil
import sys
from dataclasses import FrozenInstanceError, fields, is_dataclass, replace
from typing import Any

import pytest

import busmaster.contract
import busmaster.protocols
import busmaster.wire
from busmaster.contract.arguments import Between
from busmaster.contract.driver import Ending
from busmaster.contract.exchange import Done, Expect, LaterStep, Sizes
from busmaster.contract.frames import Direction, Frame, Kind
from busmaster.contract.items import Bit, Item
from busmaster.contract.learning import Learned
from busmaster.contract.places import Changing, Placed, ReadsPlaces
from busmaster.contract.profile import Batch, LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.codec import ReadElement, WriteElements
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.exchange import Reply
from tests.docs.test_telegrams import EXAMPLES

TIMING = ReplyTiming(0.05, 0.1, 0.15, 0.02)
COMMANDS: tuple[Any, ...] = (
    hcp.Read(1),
    hcp.Write(1, (5,)),
    hcp2.Read(1),
    hcp2.Write(1, (5,)),
    mentor.Read(1, 17),
    mentor.ReadRun(1, 17, 2),
    mentor.Write(1, 17, 5),
    ct_ansi.Read(1, 17),
    ct_ansi.ReadRun(1, 17, 2),
    ct_ansi.Write(1, 17, 5),
    dc104.Read(1),
    dc104.Write(1, 5),
    modbus.ReadRegisters(0, 2),
    modbus.ReadBits(0, 2),
    modbus.WriteRegisters(0, (1, 2)),
    modbus.WriteCoils(0, (True, False)),
    msc.DataRead(1),
    msc.DataWrite(1, 5),
    msc.BlockRead(1),
    msc.BlockWrite(1, (0,) * 32),
    msc.SetFlag(1),
    msc.ClearFlag(1),
    msc.ReadFlag(1),
    msc.ReadFlags(),
    msc.ReadStatus(),
    msc.PickedData(1, (0, 31)),
    msc.PickedFlags((0, 255)),
)
COMMANDS += tuple(
    {
        type(command): command
        for command in (example.built() for _, example in EXAMPLES if example.known)
        if type(command) not in set(map(type, COMMANDS))
    }.values()
)
"""Those of the pages' examples, of protocols that are not listed here."""
RECORDS: tuple[Any, ...] = (
    *COMMANDS,
    Sizes(1, 2),
    LaterStep(TIMING, Sizes(1, 2)),
    TIMING,
    Timings.uniform(TIMING),
    Learned(),
    LineSettings(9600),
    Batch(hcp.Read(1), (0,)),  # type: ignore[arg-type]  # whatever it serves
    Ending(5),
    Bit(0, "on", "is on"),
    Item("1", "1", "a thing"),
    msc.Merging(1),
    modbus.Merging(),
    modbus.MergedRead("holding", ((0, 1),)),
    Reply(1, b"DREAD,", 4),
)
"""One of each kind that never changes."""
CHANGING = (Expect(TIMING, Sizes(1, 2)), Done(5), Frame(Kind.ACK, Direction.NODE, b"\x06"))
"""Made for each reply and read once, where freezing them would cost each exchange something; and the frame, whose times
the decoder adds."""
BASES = {ReadElement, WriteElements, modbus._Read, msc._AtAddress, msc._OfFlag}
"""What only their heirs are made of."""


def kinds_of_records() -> set[type]:
    """Every dataclass of the contract, the wire and the codecs."""
    names = [
        module.name
        for package in (busmaster.contract, busmaster.wire, busmaster.protocols)
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")
        if not module.name.startswith("busmaster.protocols") or module.name.rpartition(".")[2] in PARTS
    ]
    return {
        kind
        for name in names
        for kind in vars(importlib.import_module(name)).values()
        if isinstance(kind, type) and is_dataclass(kind) and kind.__module__ == name
    }


PARTS = ("codec", "exchange", "blocks")


def name_of(record: Any) -> str:
    return f"{type(record).__module__.removeprefix('busmaster.')}.{type(record).__name__}"


def test_every_kind_of_record_is_looked_at() -> None:
    seen = {type(record) for record in (*RECORDS, *CHANGING)}
    assert kinds_of_records() - seen - BASES == {Profile}


@pytest.mark.parametrize("record", RECORDS, ids=name_of)
def test_a_record_never_changes_has_slots_and_is_equal_to_its_twin(record: Any) -> None:
    twin = replace(record, **{each.name: getattr(record, each.name) for each in fields(record) if each.init})
    assert twin == record
    assert hash(twin) == hash(record)
    assert record != object()
    for each in fields(record):
        with pytest.raises(FrozenInstanceError):
            setattr(record, each.name, None)
    assert "__slots__" in vars(type(record))
    assert not hasattr(record, "__dict__")


@pytest.mark.parametrize("command", COMMANDS, ids=name_of)
def test_what_a_command_shows_makes_it_again(command: Any) -> None:
    assert eval(repr(command), vars(sys.modules[type(command).__module__])) == command  # noqa: S307


@pytest.mark.parametrize("record", CHANGING, ids=name_of)
def test_a_step_has_slots_and_compares_by_value(record: Any) -> None:
    assert replace(record) == record
    assert not hasattr(record, "__dict__")


def test_a_read_can_be_asked_for_its_places_and_what_it_tells_and_a_write_for_what_it_changes() -> None:
    for command in (hcp.Read(1), hcp.Write(1, (5,)), mentor.Read(1, 17), mentor.Write(1, 17, 5)):
        asked = [isinstance(command, kind) for kind in (Placed, ReadsPlaces, Changing)]
        assert asked == [not command.writes, not command.writes, command.writes]


def test_learned_times_stay_within_those_that_they_were_given_and_else_within_the_protocols() -> None:
    protocols, given = (Timings.uniform(replace(TIMING, window=window)) for window in (0.1, 0.12))
    assert Learned().of(protocols) == Learned(protocols)
    assert Learned(given).of(protocols) == Learned(given)


def test_a_profile_never_changes() -> None:
    with pytest.raises(FrozenInstanceError):
        hcp.PROFILE.name = "other"  # type: ignore[misc]  # that is what is refused


def test_a_write_may_be_repeated_only_if_somebody_said_so() -> None:
    for command in COMMANDS:
        assert command.idempotent is not command.writes
        if any(each.name == "idempotent" for each in fields(command)):
            again = replace(command, idempotent=True)
            assert again.idempotent
            assert again != command


# what a record says where nothing else was said


def test_records_say_nothing_that_nobody_told_them() -> None:
    assert LaterStep(TIMING, Sizes(1, 2)).sent == 0
    assert (Expect(TIMING, Sizes(1, 2)).send, Done(5).rest, Done(5).send) == (b"", b"", b"")
    ending = Ending()
    assert (ending.value, ending.send, ending.rest, ending.error, ending.silent) == (None, b"", b"", None, False)
    frame = Frame(Kind.NOISE, Direction.HOST, b"\x00")
    assert (frame.time, frame.ended, frame.earlier, frame.delay) == (0, 0, 0, None)
    assert (frame.answers, frame.continues, frame.joined) == (False, False, False)
    assert TIMING.driver_release_time == 0
    assert Between(1).most == float("inf")
    item = Item("1", "1", "a thing")
    assert Reply(1, b"DREAD,", 4).shortest is None
    assert (item.unit, item.access, item.keyword, item.bits, item.decimals) == ("", "", "", (), 0)


# edges


@pytest.mark.parametrize("rate", [0, -1, True, 9600.0, "9600", None])
def test_a_baud_rate_is_a_whole_number_above_0(rate: Any) -> None:
    with pytest.raises(InvalidCommand, match="above 0"):
        LineSettings(rate)


def test_a_baud_rate_may_be_as_low_as_1() -> None:
    assert LineSettings(1).baudrate == 1


@pytest.mark.parametrize(
    ("bits", "parity", "stop", "framing", "length"),
    [
        (5, "N", 1, "5N1", 7),
        (5, "E", 1.5, "5E1.5", 8.5),
        (6, "O", 1, "6O1", 9),
        (7, "M", 1, "7M1", 10),
        (7, "S", 2, "7S2", 11),
        (8, "N", 1, "8N1", 10),
        (8, "N", 2, "8N2", 11),
        (8, "E", 2, "8E2", 12),
    ],
)
def test_a_byte_takes_start_data_parity_and_stop_bits(
    bits: int, parity: str, stop: float, framing: str, length: float
) -> None:
    line = LineSettings(1000, bits, parity, stop)
    assert line.framing == framing
    assert line.byte_time == length / 1000


@pytest.mark.parametrize(
    ("bits", "parity", "stop"),
    [(4, "N", 1), (9, "N", 1), (8, "X", 1), (8, "", 1), (8, "NE", 1), (8, "N", 0), (8, "N", 3), (8, "N", 1.25)],
)
def test_a_framing_that_does_not_exist_is_refused(bits: int, parity: str, stop: float) -> None:
    with pytest.raises(InvalidCommand, match="no such framing"):
        LineSettings(9600, bits, parity, stop)


def test_reply_times_may_be_equal_and_never_out_of_order() -> None:
    assert ReplyTiming(0.0, 0.0, 0.0, 0.01).window == 0
    assert ReplyTiming(0.1, 0.1, 0.1, 0.01).max_reply_delay == 0.1
    assert TIMING.awaited == TIMING.max_reply_delay
    assert replace(TIMING, silence=TIMING.inter_byte_timeout).awaited == TIMING.window, "learned"
    for times in ((0.2, 0.1, 0.3), (0.1, 0.3, 0.2), (0.3, 0.2, 0.1)):
        with pytest.raises(InvalidCommand, match="late_after <= window <= max_reply_delay"):
            ReplyTiming(*times, inter_byte_timeout=0.01)
    for name in ("late_after", "window", "max_reply_delay", "inter_byte_timeout", "driver_release_time"):
        with pytest.raises(InvalidCommand, match=f"a reply's {name} is a time of 0 s or more"):
            replace(TIMING, **{name: -0.001})
    with pytest.raises(InvalidCommand, match="above 0 s"):
        replace(TIMING, inter_byte_timeout=0.0)


def test_another_window_moves_its_neighbours_only_as_far_as_they_must() -> None:
    assert TIMING.with_window(0.07) == ReplyTiming(0.05, 0.07, 0.15, 0.02)
    assert TIMING.with_window(0.03) == ReplyTiming(0.03, 0.03, 0.15, 0.02)
    assert TIMING.with_window(0.4) == ReplyTiming(0.05, 0.4, 0.4, 0.02)
    assert TIMING.with_max_reply_delay(0.1) is TIMING
    assert TIMING.with_max_reply_delay(0.15) is TIMING
    assert TIMING.with_max_reply_delay(0.2) == ReplyTiming(0.05, 0.1, 0.2, 0.02)


def test_a_nodes_times_move_step_by_step_and_a_packets_window_only_grows() -> None:
    first, packet = TIMING, ReplyTiming(0.5, 1.0, 1.0, 0.1)
    timings = Timings(first, first, packet)
    short, long = timings.with_window(0.07), timings.with_window(2.0)
    assert short == Timings(first.with_window(0.07), first.with_window(0.07), packet)
    assert long == Timings(first.with_window(2.0), first.with_window(2.0), packet.with_window(2.0))
    late = timings.with_max_reply_delay(0.5)
    assert late == Timings(first.with_max_reply_delay(0.5), first.with_max_reply_delay(0.5), packet)


def test_a_kind_of_nodes_and_what_listens_to_them_make_no_other_profile() -> None:
    """A handle of another process has the profile of the protocol, and not the names that this process gives."""
    profile = busmaster.protocols.hcp2.codec.PROFILE
    assert replace(profile, kind="winder") == profile
    assert replace(profile, listen=busmaster.protocols.msc.codec.PROFILE.listen) == profile
    assert replace(profile, name="other") != profile


def test_two_protocols_share_a_line_if_one_of_them_lists_the_other() -> None:
    other = replace(hcp2.PROFILE, name="other")
    assert not other.may_share_with(hcp2.PROFILE)
    lists = replace(other, shares_line_with=frozenset(("hcp2",)))
    assert lists.may_share_with(hcp2.PROFILE)
    assert hcp2.PROFILE.may_share_with(lists)
