"""Whatever a device hears, in whatever pieces: it never raises, and says the same as if it had heard it byte by byte.

What it hears are requests to it and to others, with a byte changed or cut off and the checksum set right again, since
what a checksum rejects reaches no farther than the checksum, and any bytes among them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from random import Random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.emulator.device import Device
from busmaster.emulator.line import Line
from busmaster.emulator.traceable import TraceableMemory
from busmaster.protocols._comms.device import HCP
from busmaster.protocols._comms.mint import EmulatedMint, command_handshake, jog_on_comms1, winding
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.dc104.device import EmulatedDc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.microflex_device import EmulatedMicroFlex
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.mentor.device import EVEN_PARITY, EmulatedMentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.modbus.codec import ReadRegisters, WriteRegisters, with_crc
from busmaster.protocols.modbus.device import EmulatedModbus
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.wire.checks import bcc, sum8, sum16, xor
from tests.tiers import one_by_default

Commands = Sequence[Command[Any]]
TAU = 1e-3
ADDRESS, OTHER = 5, 6
SPECIAL = [*range(0x22), 0x30, 0x35, 0x7F, 0x84, 0xAA, 0xFF]
PAUSES = [0.0, 0.004, 0.02, 0.06, 0.3, 2.0]


@dataclass(frozen=True)
class Kind:
    """A device at ADDRESS, what is asked of it, and how the bytes of a frame end with the right checksum."""

    make: Callable[[], Device]
    profile: Profile
    commands: Commands
    seal: Callable[[bytes], bytes]

    def requests(self) -> list[bytes]:
        addresses = [address for address in (ADDRESS, OTHER, self.profile.broadcast) if address is not None]
        if not self.profile.addressed:
            addresses = [0]
        return [
            command.open(address, self.profile.timings).request
            for command in self.commands
            for address in addresses
            if command.writes or address != self.profile.broadcast
        ]


HCP_COMMANDS: Commands = [
    hcp.Read(1),
    hcp.Read(99),
    hcp.Write(1, (-12.5,)),
    hcp.Write(1, (3, 1, 9)),
    hcp.Write(99, (1.5,)),
]
HCP2_COMMANDS: Commands = [
    *(hcp2.Read(1), hcp2.Read(107), hcp2.Read(222), hcp2.Write(108, (128,)), hcp2.Write(118, (25.5,))),
    *(hcp2.Write(1, (2, 1e9, -3)), hcp2.Write(222, (5,)), hcp2.Write(116, (0.25,))),
]
MENTOR_COMMANDS: Commands = [
    *(mentor.Read(1, 17), mentor.Read(3, 2), mentor.Read(15, 60), mentor.Write(1, 17, -476)),
    *(mentor.Write(1, 18, 1234, high_resolution=True), mentor.Write(15, 60, 65535, wide=True)),
]
MSC_COMMANDS: Commands = [
    *(msc.DataRead(2000), msc.DataWrite(2004, -7), msc.BlockRead(2000), msc.BlockWrite(2000, tuple(range(32)))),
    *(msc.SetFlag(200), msc.ClearFlag(200), msc.ReadFlag(200), msc.ReadFlags(), msc.ReadStatus()),
]
DC104_COMMANDS: Commands = [dc104.Read(1), dc104.Read(255), dc104.Write(7, 0x02AA)]
MODBUS_COMMANDS: Commands = [
    ReadRegisters(7),
    ReadRegisters(90, 10),
    WriteRegisters(5, (7,)),
    WriteRegisters(5, (7, 8, 9)),
]


def hcp2_sealed(frame: bytes) -> bytes:
    return frame[:-1] + bytes((xor(frame[1:-1]),))


def mentor_with_parity_sealed(frame: bytes) -> bytes:
    return (frame[:-1] + bytes((bcc(frame[6:-1]),))).translate(EVEN_PARITY)


HCP2_KINDS = {
    "hcp2": lambda: EmulatedMint(ADDRESS, single_precision=True),
    "hcp2, few axes": lambda: EmulatedMint(ADDRESS, axes=2, refuse_reserved=True, all_or_nothing=True),
    "hcp2, events": lambda: EmulatedMint(ADDRESS, events=[jog_on_comms1], fixed_decimals=True),
    "hcp2, handshake": lambda: EmulatedMint(ADDRESS, program=command_handshake, statement=0.05),
    "hcp2, winding": lambda: EmulatedMint(ADDRESS, program=winding, statement=0.05),
    "hcp2, traceable": lambda: EmulatedMint(ADDRESS, traceable=TraceableMemory(ADDRESS)),
    "microflex": lambda: EmulatedMicroFlex(ADDRESS, ripple=0.1),
    "microflex, current": lambda: EmulatedMicroFlex(ADDRESS, current_control=True, refuse_unmapped=True),
}
MENTOR_KINDS = {
    "mentor": lambda: EmulatedMentor(ADDRESS, ripple=0.1),
    "mentor, options": lambda: EmulatedMentor(ADDRESS, short_after_write=True, refuse_malformed=True),
    "mentor, traceable": lambda: EmulatedMentor(ADDRESS, traceable=TraceableMemory(ADDRESS, 10**4)),
}
KINDS = {
    "hcp": Kind(
        lambda: EmulatedMint(ADDRESS, HCP), hcp.PROFILE, HCP_COMMANDS, lambda f: f[:-1] + bytes((xor(f[4:-1]),))
    ),
    **{name: Kind(make, hcp2.PROFILE, HCP2_COMMANDS, hcp2_sealed) for name, make in HCP2_KINDS.items()},
    **{
        name: Kind(make, mentor.PROFILE, MENTOR_COMMANDS, lambda f: f[:-1] + bytes((bcc(f[6:-1]),)))
        for name, make in MENTOR_KINDS.items()
    },
    "mentor, parity": Kind(lambda: EmulatedMentor(ADDRESS), mentor.PROFILE, MENTOR_COMMANDS, mentor_with_parity_sealed),
    **{
        f"msc, {step} a value": Kind(
            partial(EmulatedMsc, ADDRESS, address_step=step, addresses=4096),
            msc.PROFILE,
            MSC_COMMANDS,
            lambda f: f[:-2] + sum16(f[1:-2]).to_bytes(2, "big"),
        )
        for step in (1, 4)
    },
    "dc104": Kind(
        lambda: EmulatedDc104(lively=True), dc104.PROFILE, DC104_COMMANDS, lambda f: f[:-1] + bytes((sum8(f[1:-1]),))
    ),
    "modbus": Kind(lambda: EmulatedModbus(ADDRESS), modbus.PROFILE, MODBUS_COMMANDS, lambda f: with_crc(f[:-2])),
}


@st.composite
def frames(draw: st.DrawFn, kind: Kind) -> bytes:
    """A request as it is, one that was changed, or any bytes."""
    frame = draw(st.sampled_from(kind.requests()))
    match draw(st.sampled_from(["as it is", "changed", "ended otherwise", "cut", "longer", "any"])):
        case "changed":
            for _ in range(draw(st.integers(1, 2))):
                at = draw(st.integers(0, len(frame) - 1))
                byte = draw(st.one_of(st.sampled_from(SPECIAL), st.integers(0, 255)))
                frame = frame[:at] + bytes((byte,)) + frame[at + 1 :]
        case "ended otherwise":
            return frame[:-1] + bytes((draw(st.sampled_from(SPECIAL)),))
        case "cut":
            start = draw(st.integers(0, len(frame) - 1))
            frame = frame[: start + 1] if draw(st.booleans()) else frame[start:]
        case "longer":
            at = draw(st.integers(0, len(frame)))
            frame = frame[:at] + draw(st.binary(min_size=1, max_size=70)) + frame[at:]
        case "any":
            return draw(st.one_of(st.binary(max_size=30), st.lists(st.sampled_from(SPECIAL), max_size=30).map(bytes)))
    return kind.seal(frame) if draw(st.booleans()) else frame


@st.composite
def passages(draw: st.DrawFn, kind: Kind) -> list[tuple[float, bytes, list[int]]]:
    """What passes on the line: the pause before it, the bytes, and where they are cut into pieces."""
    cuts = st.lists(st.integers(0, 60), max_size=4)
    return draw(st.lists(st.tuples(st.sampled_from(PAUSES), frames(kind), cuts), max_size=6))


def pieces(data: bytes, cuts: Sequence[int]) -> list[bytes]:
    at = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    return [data[start:end] for start, end in pairwise(at)]


def made(kind: Kind) -> Device:
    device = kind.make()
    device.tau = TAU
    return device


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
@given(st.data())
@settings(max_examples=50)
def test_a_device_never_raises_and_says_the_same_whatever_pieces_it_hears(name: str, data: st.DataObject) -> None:
    """What it says when it is asked in the end shows that it has taken the same."""
    kind = KINDS[name]
    taking, hearing, bytewise = made(kind), made(kind), made(kind)
    now = 1.0
    for pause, passed, cuts in [*data.draw(passages(kind)), *((5.0, request, []) for request in kind.requests())]:
        now += pause
        for device in (taking, hearing, bytewise):
            while device.wakeup <= now:
                device.wake(device.wakeup)
        end = now + len(passed) * TAU
        if not (passed.startswith(taking.routes) and taking.take(passed, end)):
            taking.hear(passed, now)
        at = now
        for piece in pieces(passed, cuts):
            hearing.hear(piece, at)
            at += len(piece) * TAU
        for number, byte in enumerate(passed, 1):
            bytewise.hear_byte(byte, now + number * TAU)
        now = end
        for device in (taking, hearing):
            assert [said for _, said in device.outbox] == [said for _, said in bytewise.outbox]
            assert [when for when, _ in device.outbox] == pytest.approx([when for when, _ in bytewise.outbox])
            assert device.attentive == bytewise.attentive


@pytest.mark.parametrize("name", one_by_default(KINDS))
@given(st.data())
@settings(max_examples=20)
def test_a_line_bears_any_bytes_in_any_pieces(name: str, data: st.DataObject) -> None:
    """In pieces that follow each other at once a device may answer into the next one: they collide, and no more."""
    kind = KINDS[name]
    line = Line(kind.profile.line, [kind.make(), kind.make()], chance=Random(1))
    now = 0.0
    for pause, passed, cuts in data.draw(passages(kind)):
        now += pause
        for piece in pieces(passed, cuts):
            line.send(piece, now)
        line.receive(now)
    while (due := line.next_event()) < now + 30.0:
        line.receive(due)
