"""The least slaves that keep what is written to them: what the host says in, what they answer out.

Written from the manuals alone, so that what is misread on one side is not misread alike on the other.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce
from operator import xor

ACK, NAK = b"\x06", b"\x15"


class MscSlave:
    """32-bit values at consecutive addresses, and 256 flags. It NAKs the first packet it hears."""

    def __init__(self, unit: int) -> None:
        self.unit = unit
        self.data: dict[int, bytes] = {}
        self.flags = [0] * 256
        self.packet = b""
        self.disturbed = True

    def __call__(self, heard: bytes) -> bytes:
        if heard == ACK:
            return b""
        if heard == NAK:
            return self.packet
        if self.disturbed:
            self.disturbed = False
            return NAK
        name, operands = heard[6 : heard.index(b",") + 1], heard[heard.index(b",") + 1 : -2]
        answer = self.obey(name, int.from_bytes(operands[:2], "big"), operands[2:])
        if answer is None:
            return ACK
        body = name + answer
        counted = bytes((self.unit, 0, len(body), 0, 0)) + body
        self.packet = b"\x02" + counted + sum(counted).to_bytes(2, "big")
        return ACK + self.packet

    def obey(self, name: bytes, which: int, values: bytes) -> bytes | None:
        """The reply's values, or None where IB-11A002 says "Packet returned by the MSC: None"."""
        match name:
            case b"DWRITE," | b"BWRITE,":
                for i in range(len(values) // 4):
                    self.data[which + i] = values[4 * i : 4 * i + 4]
            case b"SFLAG," | b"CFLAG,":
                self.flags[which] = int(name == b"SFLAG,")
            case b"DREAD,":
                return self.data[which]
            case b"BREAD,":
                return b"".join(self.data[which + i] for i in range(32))
            case b"RFLAG,":
                return bytes((0, self.flags[which]))
            case b"RFLAGS,":
                rows = (self.flags[first : first + 8] for first in range(0, 256, 8))
                return bytes(sum(on << bit for bit, on in enumerate(row)) for row in rows)
        return None


def dc104_slave() -> Callable[[bytes], bytes]:
    """A write is answered when it is stored."""
    registers: dict[int, bytes] = {}

    def answer(heard: bytes) -> bytes:
        if heard[1] == 0x55:
            registers[heard[2]] = heard[3:5]
            return ACK
        body = heard[2:3] + registers[heard[2]]
        return b"\x02" + body + bytes((sum(body) % 256,))

    return answer


def mentor_slave() -> Callable[[bytes], bytes]:
    """Data is kept as it came, so a reply is what was written: sign and 4 digits, or 5 digits."""
    parameters: dict[bytes, bytes] = {}

    def answer(heard: bytes) -> bytes:
        if heard[5:6] == b"\x02":
            parameters[heard[6:10]] = heard[10:-2]
            return ACK
        body = heard[5:9] + parameters[heard[5:9]] + b"\x03"
        check = reduce(xor, body)
        return b"\x02" + body + bytes((check if check >= 32 else check + 32,))

    return answer
