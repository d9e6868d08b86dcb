"""What is asked of the nodes of each protocol, and the bytes with which they answer.

Each node answers two values in turn, so that a value out of step is a wrong one. Where a protocol's checksum can be
any byte, the last bytes of these replies are an ACK and a NAK (or whatever a world asks for instead).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import Timings
from busmaster.protocols.ct_ansi import codec as ct_ansi
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2 import microflex
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.wire.checks import bcc, sum8, sum16, xor
from tests.verification.registered import Registered, registered, worlds_of

ACK, NAK = b"\x06", b"\x15"
BYTE_19200 = LineSettings(19200).byte_time
READ, READ_THERE, WRITE, WRITE_THERE, READ_UNLIKE, READ_LIKE = range(6)
"""Places in `Kind.commands`: a read and a write of the first node and of the second, a read that echoes otherwise, and
one of the second node that echoes so too. A kind with one node has all of them there."""


@dataclass(frozen=True)
class Kind:
    """One protocol as the worlds use it."""

    profile: Profile
    commands: Sequence[tuple[int, Any]]
    """The node's place and the command."""
    answer: Callable[[bytes, int], bytes]
    """The reply to a request, by the place of the value in `values`; of an MSC, the packet behind the ACK."""
    values: tuple[Any, Any]
    refusal: Callable[[bytes], bytes] = lambda request: NAK
    """The reply that refuses a request."""
    first: int = 1
    """The address of the first node, where nodes have addresses."""
    refuses_check: bool = True
    """Whether a node may refuse `check` too. Not where one refusal is final: of the two sync reads one would be left,
    and nothing could show that a reply to it is an earlier one's whose own was lost (R15)."""

    def right_value(self, command: Any, place: int) -> float:
        """What a read of the reply with that place makes."""
        return float(place if isinstance(command, msc.ReadFlag) else self.values[place])

    @property
    def check(self) -> Any:
        """A read by which a node proves that the line is in sync."""
        return self.commands[READ_UNLIKE][1]


def telegram(request: bytes, value: bytes, check: Callable[[bytes], int], echo: slice) -> bytes:
    body = request[echo] + value + b"\x03"
    return b"\x02" + body + bytes((check(body),))


@dataclass(frozen=True)
class TailsAlike(Kind):
    """Nodes whose replies begin otherwise for each element and end alike: the beginning of one and the end of another
    make a third one with a right checksum."""

    def right_value(self, command: Any, place: int) -> float:
        return float(self.values[place] + 10 * (command.element - 1))


def tails_alike() -> Kind:
    kind = comms(hcp2, (b"15", b"10.8"))

    def answer(request: bytes, place: int) -> bytes:
        if request[6:7] != b"\x05":
            return ACK
        # Element 1 has 15 and 10.8, element 2 has 25 and 20.8.
        return telegram(request, request[5:6] + (b"5", b"0.8")[place], xor, slice(4, 6))

    return TailsAlike(kind.profile, kind.commands, answer, kind.values)


def comms(
    codec: Any, texts: tuple[bytes, bytes], elements: tuple[int, int] = (1, 2), profile: Profile | None = None
) -> Kind:
    def answer(request: bytes, place: int) -> bytes:
        reads = request[6:7] == b"\x05"
        return telegram(request, texts[place], xor, slice(4, 6)) if reads else ACK

    write = codec.Write(elements[0], (5.0,))
    reads = [codec.Read(element) for element in elements]
    first, second = float(texts[0]), float(texts[1])
    return Kind(
        codec.PROFILE if profile is None else profile,
        ((0, reads[0]), (1, reads[0]), (0, write), (1, write), (0, reads[1]), (1, reads[1])),
        answer,
        (first, second),
    )


def mentor_kind(codec: Any = mentor, first: int = 1) -> Kind:
    texts = b"+0001", b"+0002"

    def answer(request: bytes, place: int) -> bytes:
        reads = request[-1:] == b"\x05"
        return telegram(request, texts[place], bcc, slice(5, 9)) if reads else ACK

    write = codec.Write(1, 17, 5)
    reads = codec.Read(1, 17), codec.Read(1, 18)
    return Kind(
        codec.PROFILE,
        ((0, reads[0]), (1, reads[0]), (0, write), (1, write), (0, reads[1]), (1, reads[1])),
        answer,
        (1, 2),
        first=first,
    )


def modbus_kind() -> Kind:
    """Eight data bits and no parity, and a silence between frames that is a whole number of ticks."""
    values = 5, 6
    timings = replace(modbus.PROFILE.timings.read, driver_release_time=4 * BYTE_19200)

    def answer(request: bytes, place: int) -> bytes:
        if request[1] == modbus.WRITE_REGISTER:
            return request
        count = int.from_bytes(request[4:6], "big")
        return modbus.with_crc(request[:2] + bytes((2 * count,)) + values[place].to_bytes(2, "big") * count)

    def refusal(request: bytes) -> bytes:
        return modbus.with_crc(bytes((request[0], request[1] | modbus.REFUSED, 2)))

    write = modbus.WriteRegisters(0, (5,))
    reads = modbus.ReadRegisters(0, 1), modbus.ReadRegisters(0, 2)
    return Kind(
        replace(modbus.PROFILE, line=LineSettings(19200), timings=Timings.uniform(timings)),
        ((0, reads[0]), (1, reads[0]), (0, write), (1, write), (0, reads[1]), (1, reads[1])),
        answer,
        values,
        refusal,
        refuses_check=False,
    )


def dc104_kind(values: tuple[int, int]) -> Kind:
    def answer(request: bytes, place: int) -> bytes:
        if request[1] == dc104.WRITE:
            return ACK
        body = bytes((request[2], values[place] >> 8, values[place] & 0xFF))
        return b"\x02" + body + bytes((sum8(body),))

    read, write, unlike = dc104.Read(1), dc104.Write(1, 5), dc104.Read(2)
    return Kind(dc104.PROFILE, ((0, read), (0, read), (0, write), (0, write), (0, unlike), (0, unlike)), answer, values)


def msc_kind() -> Kind:
    values = tuple(next(v for v in range(256) if _data_packet(1, v)[-1] == last) for last in (0x06, 0x15))

    def answer(request: bytes, place: int) -> bytes:
        name = request[6:12]
        if name == b"DREAD,":
            return _data_packet(request[1], values[place])
        return _packet(request[1], b"RFLAG,\x00" + bytes((place,))) if name == b"RFLAG," else b""

    read, write, unlike = msc.DataRead(8), msc.SetFlag(5), msc.ReadFlag(5)
    return Kind(
        msc.PROFILE,
        ((0, read), (1, read), (0, write), (1, write), (0, unlike), (1, unlike)),
        answer,
        (values[0], values[1]),
    )


def _data_packet(unit: int, value: int) -> bytes:
    return _packet(unit, b"DREAD," + value.to_bytes(4, "big"))


def _packet(unit: int, body: bytes) -> bytes:
    counted = bytes((unit, 0, len(body), 0, 0)) + body
    return b"\x02" + counted + sum16(counted).to_bytes(2, "big")


KINDS: dict[str, Callable[[], Kind]] = {
    "hcp2": lambda: comms(hcp2, (b"15", b"10.8")),  # the checksums of element 1 are ACK and NAK
    "hcp2, tails alike": tails_alike,
    "hcp2, other checksums": lambda: comms(hcp2, (b"11", b"17")),  # STX and EOT
    "microflex": lambda: comms(
        hcp2, (b"15", b"10.8"), (microflex.FIRMWARE.number, microflex.TEMPERATURE.number), microflex.PROFILE
    ),
    "hcp": lambda: comms(hcp, (b"15", b"10.8")),
    "mentor": mentor_kind,
    "ct-ansi": lambda: mentor_kind(ct_ansi, 11),
    "modbus": modbus_kind,
    "dc104": lambda: dc104_kind((5, 0x14)),
    "dc104, other checksums": lambda: dc104_kind((1, 3)),
    "msc": msc_kind,
}


def registered_kind(one: Registered) -> Kind:
    """Return a kind of node as the registry has it."""
    commands, answer, values = worlds_of(one)
    return Kind(one.profile, commands, answer, values, first=one.profile.addresses[0])


KINDS |= {one.name: partial(registered_kind, one) for one in registered(tuple(KINDS))}
