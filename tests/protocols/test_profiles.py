"""What each protocol says of itself, as its documents have it: the line, the addresses, the times, the cheap reads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest

from busmaster.bus.bus import Bus
from busmaster.contract.exchange import Done
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import ReplyTiming, Timings
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import InvalidCommand
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.exchange import packet
from busmaster.registry import NodeKind, kinds
from busmaster.testing.virtual_time import run_in_virtual_time
from busmaster.wire.readers import ACK

MINT = ReplyTiming(0.05, 0.1, 0.15, 0.02)
ANSI = ReplyTiming(0.05, 0.15, 0.3, 0.05)
CHECKED = (1, 2, 3, 4, 5, 6, 7, 99)


@pytest.mark.parametrize(
    ("profile", "title", "line", "fixed_rate"),
    [
        (hcp.PROFILE, "Host Comms Protocol", LineSettings(57600, 8, "N", 1), False),
        (hcp2.PROFILE, "Host Comms Protocol 2", LineSettings(57600, 8, "N", 1), False),
        (mentor.PROFILE, "Mentor II", LineSettings(9600, 7, "E", 1), False),
        (ct_ansi.PROFILE, "CT-ANSI", LineSettings(9600, 7, "E", 1), False),
        (dc104.PROFILE, "DC104-SER", LineSettings(19200, 8, "N", 1), True),
        (modbus.PROFILE, "Modbus RTU", LineSettings(19200, 8, "E", 1), False),
        (msc.PROFILE, "MSC", LineSettings(9600, 8, "N", 1), True),
    ],
)
def test_the_line_is_the_documents(profile: Profile, title: str, line: LineSettings, fixed_rate: bool) -> None:
    assert (profile.title, profile.line, profile.fixed_rate) == (title, line, fixed_rate)
    other = profile.wrong_rate(line.baudrate + 1)
    assert bool(other) == fixed_rate
    assert profile.wrong_rate(line.baudrate) == ""


RATES = {1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200}


@pytest.mark.parametrize("kind", kinds().values(), ids=kinds())
def test_other_settings_that_are_tried_have_usual_rates_and_are_tried_once(kind: NodeKind) -> None:
    tried = [kind.profile.line, *kind.profile.other_lines]
    assert {line.baudrate for line in tried} <= RATES
    assert len(set(tried)) == len(tried)


@pytest.mark.parametrize(
    ("profile", "addresses", "broadcast"),
    [
        (hcp.PROFILE, range(16), None),
        (hcp2.PROFILE, range(256), None),
        (mentor.PROFILE, range(1, 100), 0),
        (ct_ansi.PROFILE, [address for address in range(11, 100) if address % 10], 0),
        (dc104.PROFILE, [0], None),
        (modbus.PROFILE, range(1, 248), 0),
        (msc.PROFILE, range(1, 16), None),
    ],
)
def test_the_addresses_are_the_documents_and_no_other_is_taken(
    profile: Profile, addresses: Sequence[int], broadcast: int | None
) -> None:
    assert list(profile.addresses) == list(addresses)
    for address in range(-1, 300):
        if address in addresses or address == broadcast:
            profile.check_address(address)
        else:
            with pytest.raises(InvalidCommand, match=f"address {address} does not exist"):
                profile.check_address(address)


def test_an_address_is_known_by_its_number() -> None:
    """Large numbers that are equal need not be the same object."""
    profile = replace(hcp2.PROFILE, broadcast=1000)
    profile.check_address(int("1000"))


@pytest.mark.parametrize(
    ("profile", "timings"),
    [
        (hcp.PROFILE, Timings(MINT, MINT, MINT)),
        (hcp2.PROFILE, Timings(MINT, MINT, MINT)),
        (mentor.PROFILE, Timings(ANSI, ANSI, ANSI)),
        (ct_ansi.PROFILE, Timings(ANSI, ANSI, ANSI)),
        (modbus.PROFILE, Timings.uniform(ReplyTiming(0.05, 0.2, 0.4, 0.02, 0.00175))),
    ],
)
def test_replies_are_awaited_as_long_as_the_documents_say(profile: Profile, timings: Timings) -> None:
    assert profile.timings == timings


def test_msc_and_dc104_await_each_step_in_its_own_time() -> None:
    first, packet = msc.PROFILE.timings.read, msc.PROFILE.timings.packet
    assert (first, packet) == (ReplyTiming(0.05, 0.5, 1.0, 0.1), ReplyTiming(0.5, 1.0, 1.0, 0.1))
    assert (msc.PROFILE.timings.write, msc.PROFILE.exchange_limit) == (first, 2.0)
    assert dc104.PROFILE.timings.read == dc104.PROFILE.timings.packet == ReplyTiming(0.05, 0.1, 0.2, 0.02)
    assert dc104.PROFILE.timings.write == ReplyTiming(0.5, 0.5, 0.6, 0.02)


@pytest.mark.parametrize(
    ("profile", "probe", "sync_reads"),
    [
        (hcp.PROFILE, hcp.Read(1), [hcp.Read(element) for element in CHECKED]),
        (hcp2.PROFILE, hcp2.Read(1), [hcp2.Read(element) for element in CHECKED]),
        (mentor.PROFILE, mentor.Read(1, 17), [mentor.Read(1, number) for number in (17, 18, 19, 20, 21)]),
        (ct_ansi.PROFILE, ct_ansi.Read(1, 17), [ct_ansi.Read(1, number) for number in (17, 18, 19, 20, 21)]),
        (dc104.PROFILE, dc104.Read(1), [dc104.Read(parameter) for parameter in range(1, 9)]),
        (modbus.PROFILE, modbus.ReadRegisters(0), [modbus.ReadRegisters(0, count) for count in (1, 2, 3, 4)]),
        (msc.PROFILE, msc.ReadStatus(), [msc.ReadStatus(), msc.ReadFlag(0)]),
    ],
)
def test_the_sync_reads_are_those_that_every_node_has(profile: Profile, probe: Any, sync_reads: Sequence[Any]) -> None:
    assert profile.probe == probe
    assert list(profile.sync_reads) == sync_reads
    assert not any(command.writes for command in profile.sync_reads)


@pytest.mark.parametrize(
    ("one", "other", "together"),
    [
        (hcp, hcp2, True),
        (mentor, ct_ansi, True),
        (hcp, mentor, False),
        (modbus, msc, False),
        (dc104, dc104, True),
    ],
)
def test_protocols_share_a_line_only_where_the_documents_let_them(one: Any, other: Any, together: bool) -> None:
    assert one.PROFILE.may_share_with(other.PROFILE) == together
    assert other.PROFILE.may_share_with(one.PROFILE) == together


@pytest.mark.parametrize("profile", [hcp.PROFILE, hcp2.PROFILE, mentor.PROFILE, ct_ansi.PROFILE, modbus.PROFILE])
def test_what_a_profile_does_not_say_is_the_common_case(profile: Profile) -> None:
    assert (profile.retries, profile.noise_tolerant, profile.addressed, profile.exchange_limit) == (
        2,
        False,
        True,
        None,
    )
    assert (profile.listen, profile.merge) == (None, None)
    assert profile.label(5) == "node 5"


def test_a_drive_without_an_address_is_called_the_drive() -> None:
    assert dc104.PROFILE.label(0) == "the drive"


@pytest.mark.parametrize(
    ("command", "address", "starts", "sizes"),
    [
        (hcp.Read(1), 1, b"\x02\x15", (12, 25)),
        (hcp.Write(1, (5,)), 1, b"\x06\x15", (1, 1)),
        (hcp2.Read(1), 1, b"\x02\x15", (12, 25)),
        (hcp2.Write(1, (5,)), 1, b"\x06\x15", (1, 1)),
        (mentor.Read(1, 17), 1, b"\x02\x15\x04\x82\x95\x84", (12, 12)),
        (mentor.Write(1, 17, 1), 1, b"\x06\x15\x04\x86\x95\x84", (1, 1)),
        (mentor.Write(1, 17, 1), 0, b"", (0, 0)),
        (ct_ansi.Read(1, 17), 11, b"\x02\x15\x04\x82\x95\x84", (13, 19)),
        (ct_ansi.Write(1, 17, 1), 0, b"", (0, 0)),
        (modbus.ReadRegisters(0, 2), 17, b"\x11", (9, 9)),
        (modbus.ReadBits(0, 8), 17, b"\x11", (6, 6)),
        (modbus.ReadBits(0, 9), 17, b"\x11", (7, 7)),
        (modbus.WriteRegisters(0, (1,)), 17, b"\x11", (8, 8)),
        (modbus.WriteRegisters(0, (1, 2)), 17, b"\x11", (8, 8)),
        (modbus.WriteRegisters(0, (1,)), 0, b"", (0, 0)),
    ],
)
def test_an_exchange_says_how_its_reply_begins_and_how_long_it_is(
    command: Any, address: int, starts: bytes, sizes: tuple[int, int]
) -> None:
    exchange = command.open(address, Timings.uniform(MINT))
    assert (exchange.starts, (exchange.sizes.typical, exchange.sizes.longest)) == (starts, sizes)
    assert (exchange.answered, bool(exchange.answers)) == (bool(starts), bool(starts))
    assert (exchange.closing, tuple(exchange.later)) == (0, ())


def test_what_a_line_may_merge_or_hear_makes_no_other_protocol() -> None:
    assert mentor.CHAINED == mentor.PROFILE
    assert replace(msc.PROFILE, listen=None) == msc.PROFILE
    assert replace(msc.PROFILE, exchange_limit=None) != msc.PROFILE


@pytest.mark.parametrize(
    "mistake",
    [
        lambda: dc104.Read(1, minimum=-1),
        lambda: dc104.Read(1, minimum=2),
        lambda: dc104.Read(1, maximum=0),
        lambda: dc104.Read(1, maximum=256),
        lambda: dc104.Write(1, -1),
        lambda: dc104.Write(1, 65536),
        lambda: ct_ansi.Write(-1, 17, 1),
        lambda: ct_ansi.Write(100, 17, 1),
        lambda: ct_ansi.Write(1, -1, 1),
        lambda: ct_ansi.Write(1, 100, 1),
        lambda: ct_ansi.Write(1, 17, 1e12),
        lambda: msc.PickedData(0, (-1,)),
        lambda: msc.PickedData(0, (32,)),
        lambda: msc.PickedFlags((-1,)),
        lambda: msc.PickedFlags((256,)),
        lambda: msc.DataRead(-1),
        lambda: msc.SetFlag(-1),
    ],
)
def test_one_less_or_one_more_than_a_document_has_is_refused(mistake: Callable[[], object]) -> None:
    with pytest.raises(InvalidCommand):
        mistake()


def test_a_program_status_has_two_bytes_or_more() -> None:
    for size in (1, 2, 3, 8, 9):
        exchange = msc.ReadStatus().open(1, msc.PROFILE.timings)
        exchange.feed(ACK)
        step = exchange.feed(packet(1, b"RQSTAT," + bytes(size)))
        assert isinstance(step, Done) == (size >= 2), size


@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
def test_the_item_of_the_probe_is_what_the_probe_reads(kind: NodeKind) -> None:
    async def read() -> None:
        async with Bus(MemoryPort(Line(kind.profile.line, []))) as bus:
            handle: Any = kind.handle
            assert handle(bus, kind.profile.addresses[-1]).point(kind.probe_item).command == kind.profile.probe

    run_in_virtual_time(read())


@pytest.mark.parametrize("kind", kinds().values(), ids=lambda kind: kind.name)
def test_further_settings_of_a_line_are_further_ones_each_named_once(kind: NodeKind) -> None:
    every = [kind.profile.line, *kind.profile.other_lines]
    assert len(set(every)) == len(every)
    assert not (kind.profile.fixed_rate and kind.profile.other_lines)


@pytest.mark.parametrize("kind", kinds().values(), ids=kinds())
def test_reply_windows_can_be_learned_unless_read_requests_have_no_checksum(kind: NodeKind) -> None:
    profile = kind.profile
    if profile.name == "hcp":
        with pytest.raises(InvalidCommand, match="hcp: reply windows cannot be learned"):
            profile.check_learnable()
    else:
        profile.check_learnable()
