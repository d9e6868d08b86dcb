"""Every command of every protocol, said by the master and answered by an emulated device, on a line of real byte times.

The two sides share checksums alone: what both have misread in the same way is for the hex of the other tests to show.
"""

from __future__ import annotations

from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from busmaster.arbiter.transaction import Phase, Transaction
from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.line import Line
from busmaster.emulator.world import World
from busmaster.errors import BusError, NoReply, NoSuchParameter, Refused
from busmaster.protocols._comms.device import HCP
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.dc104.device import EmulatedDc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.mentor.device import EmulatedMentor
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.protocols.msc.status import ProgramStatus
from busmaster.registry import find, make_device
from tests.stories import in_use

BLOCK = tuple(range(-16, 16))
Step = tuple[Command[Any], Any]
"""A command, and what comes of it: a value, None for a write, or the error."""


class Master:
    """A master in virtual time. `ask` returns the value, or raises."""

    def __init__(self, profile: Profile, *devices: Device, **options: Any) -> None:
        self.line = Line(profile.line, devices, chance=Random(1), **options)
        self.transcript: list[str] = []
        self.world = World(self.line, record=self.transcript.append)
        in_use(self.world)
        self.nodes = {device.address: self.world.node(profile, device.address) for device in devices}

    def knows(self, profile: Profile, address: int) -> None:
        self.nodes[address] = self.world.node(profile, address)

    def ask(self, command: Command[Any], address: int | None = None) -> Any:
        node = next(iter(self.nodes.values())) if address is None else self.nodes[address]
        transaction: Transaction = self.world.request(node, command)
        assert self.world.run_until(lambda: transaction.phase is Phase.ENDED, 60.0)
        if transaction.error is not None:
            raise transaction.error
        return transaction.value

    def leaves_off(self) -> None:
        """What it has just said, an ACK, reaches the other side."""
        self.world.run(self.world.now + 0.01)

    def tries(self, steps: list[Step]) -> None:
        for command, expected in steps:
            if isinstance(expected, type) and issubclass(expected, BusError):
                with pytest.raises(expected):
                    self.ask(command)
            else:
                assert self.ask(command) == expected, str(command)


MSC_STEPS: list[Step] = [
    (msc.DataWrite(2008, 1234), None),
    (msc.DataRead(2008), 1234),
    (msc.DataWrite(0, -(2**31)), None),
    (msc.DataRead(0), -(2**31)),
    (msc.DataRead(40_000), Refused),
    (msc.DataWrite(40_000, 1), Refused),
    (msc.BlockWrite(3000, BLOCK), None),
    (msc.BlockRead(3000), BLOCK),
    (msc.DataRead(3004), -15),
    (msc.PickedData(3000, (0, 31)), (-16, 15)),
    (msc.BlockRead(0x7FFC), Refused),
    (msc.SetFlag(0), None),
    (msc.SetFlag(255), None),
    (msc.SetFlag(5), None),
    (msc.ClearFlag(5), None),
    (msc.ReadFlag(255), True),
    (msc.ReadFlag(5), False),
    (msc.ReadFlags(), {0, 255}),
    (msc.PickedFlags((0, 1, 255)), (True, False, True)),
    (msc.ReadStatus(), ProgramStatus.PROGRAM_RUNNING | ProgramStatus.AUTO_START_ENABLED),
]
MENTOR_STEPS: list[Step] = [
    (mentor.Write(1, 17, -476), None),
    (mentor.Read(1, 17), -476),
    (mentor.Write(1, 18, 4765, high_resolution=True), None),
    (mentor.Read(1, 18), 476),
    (mentor.Write(15, 60, 54321, wide=True), None),
    (mentor.Read(15, 60), 54321),
    (mentor.Write(4, 26, True), None),
    (mentor.Read(4, 26), 1),
    (mentor.Read(17, 23), NoSuchParameter),
    (mentor.Write(17, 23, 1), Refused),
    (mentor.Write(1, 17, 1001), Refused),
    (mentor.Write(3, 2, 1), Refused),
    (mentor.ReadRun(1, 17, 20), (-476, 476, *[0] * 18)),
    (mentor.ReadRun(1, 18, 2, step=-1), (476, -476)),
    (mentor.ReadRun(1, 17, 3, step=0), (-476,) * 3),
    (mentor.ReadRun(1, 36, 2), NoSuchParameter),
    (mentor.ReadRun(15, 60, 4), (54321, 0, 0, 0)),
]
DC104_STEPS: list[Step] = [
    (dc104.Write(1, 1234), None),
    (dc104.Read(1), 1234),
    (dc104.Write(170, 65535), None),
    (dc104.Read(170), 65535),
    (dc104.Read(255), 0),
    (dc104.Read(0, minimum=0), Refused),
    (dc104.Write(0, 1, minimum=0), Refused),
]
HCP_STEPS: list[Step] = [
    (hcp.Write(1, (10.8,)), None),  # its checksum is NAK
    (hcp.Read(1), 10.8),
    (hcp.Write(97, (1234, -45.6, 11.2)), None),
    (hcp.Read(98), -45.6),
    (hcp.Read(50), 0),
]
HCP2_STEPS: list[Step] = [
    (hcp2.Write(1, (123.456,)), None),
    (hcp2.Read(1), 123.456),
    (hcp2.Write(98, (7, 8)), None),
    (hcp2.Write(99, (7, 8)), Refused),  # 100 is read-only
    (hcp2.Read(99), 7),
    (hcp2.Write(222, (5,)), None),
    (hcp2.Read(222), 5),
    (hcp2.Read(239), 5628),
]
MICROFLEX_STEPS: list[Step] = [
    (hcp2.Write(108, (128,)), None),
    (hcp2.Read(109), 192),
    (hcp2.Write(118, (-25.5,)), None),
    (hcp2.Read(118), -25.5),
    (hcp2.Write(116, (1,)), Refused),
]
ALL = pytest.mark.parametrize(
    ("protocol", "address", "steps"),
    [
        ("hcp", 1, HCP_STEPS),
        ("hcp2", 255, HCP2_STEPS),
        ("microflex", 7, MICROFLEX_STEPS),
        ("msc", 15, MSC_STEPS),
        ("mentor", 14, MENTOR_STEPS),
        ("dc104", 0, DC104_STEPS),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)


@ALL
def test_every_command_is_understood_on_both_sides(protocol: str, address: int, steps: list[Step]) -> None:
    Master(find(protocol).profile, make_device(protocol, address)).tries(steps)


@ALL
@pytest.mark.parametrize("options", [{"chunk": 1}, {"paced": False}, {"latency": 0.016}], ids=str)
def test_likewise_in_single_bytes_without_pacing_and_behind_a_slow_adapter(
    protocol: str, address: int, steps: list[Step], options: dict[str, Any]
) -> None:
    Master(find(protocol).profile, make_device(protocol, address), **options).tries(steps)


@ALL
def test_a_device_does_not_hear_what_another_is_asked(protocol: str, address: int, steps: list[Step]) -> None:
    if not find(protocol).profile.addressed:
        return
    others = [make_device(protocol, other) for other in (2, 3, 12)]
    master = Master(find(protocol).profile, make_device(protocol, address), *others)
    master.tries(steps)
    assert master.line.collisions == 0
    untouched: dict[str, Command[Any]] = {
        "hcp": hcp.Read(1),
        "hcp2": hcp2.Read(1),
        "microflex": hcp2.Read(118),
        "msc": msc.DataRead(2008),
    }
    for other in others:
        assert master.ask(untouched.get(protocol, mentor.Read(1, 17)), other.address) == 0


words = st.integers(0, 65535)


@given(st.integers(-(2**31), 2**31 - 1), words, words, st.integers(-1000, 1000), st.sampled_from([1, 2, 4]))
@settings(max_examples=30)
def test_every_value_comes_back_as_it_was_written(value: int, wide: int, word: int, speed: int, step: int) -> None:
    press = Master(msc.PROFILE, EmulatedMsc(2, address_step=step, addresses=0x10000))
    block = tuple((value * place) % 2**32 - 2**31 for place in range(32))
    press.tries([(msc.DataWrite(0xFFFF - 4, value), None), (msc.DataRead(0xFFFF - 4), value)])
    press.tries([(msc.BlockWrite(word // 2, block), None), (msc.BlockRead(word // 2), block)])
    drive = Master(mentor.PROFILE, EmulatedMentor(42))
    drive.tries([(mentor.Write(15, 63, wide, wide=True), None), (mentor.Read(15, 63), wide)])
    drive.tries([(mentor.Write(1, 36, speed), None), (mentor.Read(1, 36), speed)])
    motor = Master(dc104.PROFILE, EmulatedDc104())
    motor.tries([(dc104.Write(1 + word % 255, wide), None), (dc104.Read(1 + word % 255), wide)])


def test_a_broadcast_reaches_all_and_the_line_goes_on() -> None:
    drives = [EmulatedMentor(address) for address in (11, 14)]
    master = Master(mentor.PROFILE, *drives)
    master.knows(mentor.PROFILE, 0)
    assert master.ask(mentor.Write(1, 17, 250), 0) is None
    assert [master.ask(mentor.Read(1, 17), drive.address) for drive in drives] == [250, 250]


# HCP and HCP2 on one line


def test_hcp_and_hcp2_controllers_share_a_line() -> None:
    """HCP2 telegrams end in EOT and HCP telegrams in BEL now and then: the other protocol's reset byte."""
    old = [EmulatedMint(address, HCP) for address in range(4)]
    new = [EmulatedMint(address) for address in range(4, 8)]
    master = Master(hcp2.PROFILE, *new)
    for controller in old:
        master.line.add(controller)
        master.knows(hcp.PROFILE, controller.address)
    for number in range(10, 50):
        for address in range(8):
            write = hcp.Write if address < 4 else hcp2.Write
            read = hcp.Read if address < 4 else hcp2.Read
            value = address * 100 + number
            master.ask(write(1 + number, (value,)), address)
            assert master.ask(read(1 + number), address) == value
    assert master.line.collisions == 0
    statistics = master.world.arbiter.statistics(master.world.now)
    assert statistics.unexpected_bytes == 0
    assert statistics.exchanges == statistics.completed == 2 * 8 * 40


# What the protocols promise of MSC and Mentor II


def test_msc_reads_right_through_two_naks_and_four_bad_packets() -> None:
    controller = EmulatedMsc(3)
    controller.set_value(2008, 1234)
    controller.naks_ahead, controller.bad_packets_ahead = 2, 4
    master = Master(msc.PROFILE, controller)
    assert master.ask(msc.DataRead(2008)) == 1234
    master.leaves_off()
    assert controller.retransmitted == 4
    assert not controller.unacknowledged


def test_msc_writes_through_three_naks_and_is_refused_at_the_fourth() -> None:
    controller = EmulatedMsc(3)
    master = Master(msc.PROFILE, controller)
    controller.naks_ahead = 3
    assert master.ask(msc.DataWrite(2008, 5)) is None
    controller.naks_ahead = 4
    with pytest.raises(Refused):
        master.ask(msc.DataWrite(2008, 6))
    assert controller.value(2008) == 5


def test_msc_never_takes_a_packet_whose_ack_was_lost_for_the_answer() -> None:
    controller = EmulatedMsc(3)
    controller.set_value(2008, 1234)
    controller.missing_acks_ahead = 1
    master = Master(msc.PROFILE, controller)
    assert master.ask(msc.DataRead(2008)) == 1234
    master.leaves_off()
    assert not controller.unacknowledged
    counted = master.world.arbiter.statistics(master.world.now)
    assert counted.exchanges - counted.sync_reads == 2, "a packet before its ACK may answer an older request"


def test_a_packet_that_was_never_acknowledged_does_not_come_again_into_other_exchanges() -> None:
    """The host's closing ACK is lost; one second later the controller sends its packet again."""
    first, second = EmulatedMsc(3), EmulatedMsc(4)
    second.set_value(2008, 44)
    master = Master(msc.PROFILE, first, second)
    master.world.run(2.0)
    master.line.send(bytes.fromhex("02 03 00 08 00 00 44 52 45 41 44 2C 07 D8 02 76"), 2.0)  # another master's
    master.world.run(4.5)
    assert not first.unacknowledged
    assert master.ask(msc.DataRead(2008), 4) == 44


def test_twenty_parameters_in_one_run_cost_at_most_65_percent_of_twenty_reads() -> None:
    def line_bytes(*commands: Command[Any]) -> int:
        master = Master(mentor.PROFILE, EmulatedMentor(14))
        for command in commands:
            master.ask(command)
        passed = (entry.split(maxsplit=2) for entry in master.transcript)
        return sum(len(bytes.fromhex(data)) for _, way, data in passed if way in "<>")

    singles = line_bytes(*(mentor.Read(1, 17 + i) for i in range(20)))
    assert singles == 20 * (10 + 12)
    assert line_bytes(mentor.ReadRun(1, 17, 20)) == 10 + 20 * 12 + 19 <= 0.65 * singles


def test_a_dc104_write_is_awaited_until_its_eeprom_is_written() -> None:
    master = Master(dc104.PROFILE, EmulatedDc104(eeprom=Delay(0.4)))
    assert master.ask(dc104.Write(1, 5)) is None
    assert master.ask(dc104.Read(1)) == 5


def test_a_node_that_is_not_there_does_not_answer() -> None:
    for protocol, command in (("msc", msc.ReadStatus()), ("mentor", mentor.Read(1, 17))):
        master = Master(find(protocol).profile, make_device(protocol, 1))
        master.knows(find(protocol).profile, 2)
        with pytest.raises(NoReply):
            master.ask(command, 2)
