"""The protocols as a campaign sees them: what devices there are, what to ask them, and what an answer shows.

Of seven, what is asked was chosen by hand. Any other takes part as the registry has it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from math import gcd
from random import Random
from typing import Any

from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.emulator.device import Delay, Device
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.dc104.device import EmulatedDc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.modbus.device import SIZE
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.registry import make_device
from busmaster.wire.checks import sum8, sum16, xor
from tests.verification import registered
from tests.verification.campaigns.ledger import Ledger, LedgerMemory

SEVEN_BITS = bytes(byte & 0x7F for byte in range(256))
ETX, ENQ = 0x03, 0x05
MSC_STEP = 4
EEPROM = 1.9
"""How much longer than a slow read a slow write of DC104 takes, whose maximum reply delay is three times as long."""


@dataclass(frozen=True)
class Kind:
    """One protocol. Its few elements are asked of all nodes alike, so that answers can be taken for each other's."""

    name: str
    profile: Profile
    addresses: Sequence[int]
    modulus: int
    step: int
    reads: Sequence[Command[Any]]
    write: Callable[[Random, int, bool], Command[Any]]
    """Of a number; the bool says whether it may be repeated, where the command can say so."""
    runs: Sequence[Command[Any]] = ()
    """Reads of several steps whose later steps carry no address."""
    checksum: Callable[[int, int, int], int] = lambda node, element, number: number & 0xFF
    """The last byte of what `node` answers to a read of `element` with `number`."""
    refused: Callable[[bytes], bytes] | None = None
    """Damages a request so that its device refuses it, where `refused` does not know how."""

    @property
    def max_reply_delay(self) -> float:
        """Of the step that has the shortest."""
        timings = self.profile.timings
        return min(timings.read.max_reply_delay, timings.write.max_reply_delay, timings.packet.max_reply_delay)

    def device(self, ledger: Ledger, address: int) -> Device:
        device = make_device(self.name, address, traceable=LedgerMemory(ledger, address))
        if isinstance(device, EmulatedMsc):
            device.flags |= {flag for flag in range(64) if (flag + address) % 2}
        return device

    def slow_down(self, device: Device, delay: Delay) -> None:
        """How long whatever follows a first answer takes: MSC's packet, DC104's EEPROM."""
        if isinstance(device, EmulatedMsc):
            device.packet_delay = delay
        elif isinstance(device, EmulatedDc104):
            device.eeprom = replace(
                delay, late_reply_delay=(EEPROM * delay.late_reply_delay[0], EEPROM * delay.late_reply_delay[1])
            )


def elements_of(command: Command[Any]) -> tuple[int, ...]:
    """What a command reads or writes, as the devices number it. Empty for what the ledger knows nothing of."""
    match command:
        case hcp.Read(element) | hcp2.Read(element):
            return (element,)
        case hcp.Write(element, values) | hcp2.Write(element, values):
            return tuple(range(element, element + len(values)))
        case mentor.Read(menu, number) | mentor.Write(menu, number) | ct_ansi.Write(menu, number):
            return (menu * 100 + number,)
        case modbus.ReadRegisters(first, count):
            return tuple(range(first, first + count))
        case modbus.WriteRegisters(first, values):
            return tuple(range(first, first + len(values)))
        case mentor.ReadRun(menu, number, count, step):
            return tuple(menu * 100 + number + step * place for place in range(count))
        case msc.DataRead(address) | msc.DataWrite(address):
            return (address,)
        case msc.BlockRead(address) | msc.BlockWrite(address):
            return tuple(address + MSC_STEP * place for place in range(msc.BLOCK))
        case dc104.Read(parameter) | dc104.Write(parameter):
            return (parameter,)
    return registered.elements_of(command) if type(command).__module__ in REGISTERED else ()


def echoed(command: Command[Any], address: int, heard: bytes) -> bool:
    """Whether what the host heard holds the telegram's echo of the command: the least that a value needs."""
    match command:
        case hcp.Read(element):
            return b"\x02%02d" % element in heard
        case hcp2.Read(element):
            return b"\x02%02X" % element in heard
        case mentor.Read(menu, number) | mentor.ReadRun(menu, number):
            return b"\x02%02d%02d" % (menu, number) in heard.translate(SEVEN_BITS)
        case dc104.Read(parameter):
            return bytes((0x02, parameter)) in heard
        case modbus.ReadRegisters(_, count):
            return bytes((address, modbus.READS["holding"], 2 * count)) in heard
        case _ if type(command).__module__ in REGISTERED:
            return registered.echoed(command, address, heard)
        case _:
            name = _NAMES.get(type(command))
            return name is None or (bytes((0x02, address)) in heard and name in heard)


_NAMES: dict[type, bytes] = {
    msc.DataRead: b"DREAD,",
    msc.BlockRead: b"BREAD,",
    msc.ReadFlag: b"RFLAG,",
    msc.ReadFlags: b"RFLAGS,",
    msc.ReadStatus: b"RQSTAT,",
}


def refused(kind: Kind, request: bytes) -> bytes:
    """Return a request so damaged that its device refuses it.

    One bit of the checksum is wrong. Reads of HCP, Mentor II and CT-ANSI have no checksum: there one bit of a digit is,
    which makes it an element or a parameter that no device has. A Modbus unit does not reply to a wrong CRC, but
    refuses a register beyond its table. For a protocol that is not listed here, a flipped bit is looked for that its
    device refuses.
    """
    if kind.refused is not None:
        return kind.refused(request)
    if kind.name == "modbus":
        return modbus.with_crc(request[:2] + SIZE.to_bytes(2, "big") + request[4:-2])
    place, mask = -1, 0x01
    reads = request[-1] == ENQ and request[-2] != ETX
    if reads and kind.name == "hcp":
        place, mask = 5, 0x40
    elif reads and kind.name in ("mentor", "ct-ansi"):
        place, mask = 6, 0x08
    damaged = bytearray(request)
    damaged[place] ^= mask
    return bytes(damaged)


def _comms(write: type[hcp.Write] | type[hcp2.Write]) -> Callable[[Random, int, bool], Command[Any]]:
    def make(chance: Random, number: int, repeat: bool) -> Command[Any]:
        return write(chance.randrange(1, 6), (number,) * chance.choice((1, 1, 1, 3)), idempotent=repeat)

    return make


def _mentor_write(chance: Random, number: int, repeat: bool) -> Command[Any]:
    if chance.random() < 0.2:
        return mentor.Write(15, 60, number, wide=True, idempotent=repeat)
    return mentor.Write(1, chance.randrange(17, 21), number, idempotent=repeat)


def _ct_ansi_write(chance: Random, number: int, repeat: bool) -> Command[Any]:
    return ct_ansi.Write(1, chance.randrange(17, 21), number, idempotent=repeat)


def _modbus_write(chance: Random, number: int, repeat: bool) -> Command[Any]:
    return modbus.WriteRegisters(chance.randrange(0, 5), (number,) * chance.choice((1, 1, 1, 3)), idempotent=repeat)


def _msc_write(chance: Random, number: int, repeat: bool) -> Command[Any]:
    if chance.random() < 0.05:
        return msc.BlockWrite(2008, (number,) * msc.BLOCK)
    return msc.DataWrite(2008 + MSC_STEP * chance.randrange(0, 6), number)


def _dc104_write(chance: Random, number: int, repeat: bool) -> Command[Any]:
    return dc104.Write(chance.randrange(1, 6), number)


def _hcp_checksum(node: int, element: int, number: int) -> int:
    return xor(b"%02d%d\x03" % (element, number))


def _hcp2_checksum(node: int, element: int, number: int) -> int:
    return xor(b"%02X%d\x03" % (element, number))


def _msc_checksum(node: int, element: int, number: int) -> int:
    return sum16(bytes((node, 10)) + b"DREAD," + number.to_bytes(4, "big")) & 0xFF


def _modbus_checksum(node: int, element: int, number: int) -> int:
    return modbus.with_crc(bytes((node, modbus.READS["holding"], 2)) + number.to_bytes(2, "big"))[-1]


def _dc104_checksum(node: int, element: int, number: int) -> int:
    return sum8(bytes((element, number >> 8, number & 0xFF)))


_MSC_READS: list[Command[Any]] = [msc.DataRead(2008 + MSC_STEP * place) for place in range(6)]
_COMMS = (1, 2, 3, 4, 5, 99)
KINDS = {
    kind.name: kind
    for kind in (
        Kind(
            "hcp",
            hcp.PROFILE,
            range(16),
            10**9,
            7_654_321,
            [hcp.Read(e) for e in _COMMS],
            _comms(hcp.Write),
            checksum=_hcp_checksum,
        ),
        Kind(
            "hcp2",
            hcp2.PROFILE,
            range(256),
            10**9,
            7_654_321,
            [hcp2.Read(e) for e in _COMMS],
            _comms(hcp2.Write),
            checksum=_hcp2_checksum,
        ),
        Kind(
            "msc",
            msc.PROFILE,
            range(1, 16),
            2**31,
            7_654_321,
            [*_MSC_READS, *_MSC_READS, msc.BlockRead(2008), msc.ReadFlag(5), msc.ReadFlag(6), msc.ReadStatus()],
            _msc_write,
            checksum=_msc_checksum,
        ),
        Kind(
            "mentor",
            mentor.PROFILE,
            range(1, 100),
            10**4,
            3_719,
            [*(mentor.Read(1, number) for number in range(17, 22)), mentor.Read(15, 60)],
            _mentor_write,
            [mentor.ReadRun(1, 17, 4), mentor.ReadRun(1, 20, 3, -1), mentor.ReadRun(1, 17, 2, 0)],
        ),
        Kind(
            "ct-ansi",
            ct_ansi.PROFILE,
            ct_ansi.PROFILE.addresses,
            10**4,
            3_719,
            [*(ct_ansi.Read(1, number) for number in range(17, 22)), ct_ansi.Read(15, 60)],
            _ct_ansi_write,
            [ct_ansi.ReadRun(1, 17, 4), ct_ansi.ReadRun(1, 20, 3, -1), ct_ansi.ReadRun(1, 17, 2, 0)],
        ),
        Kind(
            "modbus",
            modbus.PROFILE,
            range(1, 248),
            2**16,
            25_717,
            # equal lengths, which only R15 tells apart, and others
            [*(modbus.ReadRegisters(first) for first in range(5)), modbus.ReadRegisters(0, 2)],
            _modbus_write,
            checksum=_modbus_checksum,
        ),
        Kind(
            "dc104",
            dc104.PROFILE,
            [0],
            2**16,
            25_717,
            [dc104.Read(p) for p in (1, 2, 3, 6, 21)],
            _dc104_write,
            checksum=_dc104_checksum,
        ),
    )
}


def _step(modulus: int) -> int:
    """Return a step that is prime to the modulus, and keeps numbers apart that follow each other."""
    return next(step for step in range(round(modulus * 0.3719) | 1, modulus, 2) if gcd(step, modulus) == 1)


_OTHERS = registered.registered(tuple(KINDS))
REGISTERED = {kind.__module__ for one in _OTHERS for kind in one.kind.protocol.commands.values()}
"""The modules of the commands of protocols that are not listed above."""
KINDS |= {
    one.name: Kind(
        one.name,
        one.profile,
        one.profile.addresses,
        one.modulus,
        _step(one.modulus),
        one.reads,
        one.write,
        one.runs,
        one.checksum,
        one.refused,
    )
    for one in _OTHERS
}
