"""The five protocols as they are tried on real ports: equal reads, one kind of write, values that tell their node."""

from __future__ import annotations

import random
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.traceable import TraceableMemory
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.msc import codec as msc
from busmaster.protocols.msc.device import EmulatedMsc
from busmaster.registry import make_device

PROMPT = Delay(0.002, 0.003)
"""Seconds after which a device answers, always."""
Told = Callable[[str, int, int, int], None]
"""Is told "said" or "took", the node, the element, and the value."""


@dataclass(frozen=True)
class Kind:
    """One protocol: `read` is asked of all its nodes; `write` makes a write of a number. `absent` is no node's address.

    Values are below `modulus`.
    """

    profile: Profile
    addresses: Sequence[int]
    absent: int | None
    modulus: int
    read: Command[Any]
    write: Callable[[int], Command[Any]]


KINDS = {
    "hcp": Kind(hcp.PROFILE, range(1, 5), 9, 10**9, hcp.Read(1), lambda number: hcp.Write(2, (number,))),
    "hcp2": Kind(hcp2.PROFILE, range(1, 5), 9, 10**9, hcp2.Read(1), lambda number: hcp2.Write(2, (number,))),
    "msc": Kind(msc.PROFILE, range(1, 5), 9, 2**31, msc.DataRead(2008), lambda number: msc.DataWrite(2012, number)),
    "mentor": Kind(mentor.PROFILE, range(1, 5), 9, 10**4, mentor.Read(1, 17), lambda n: mentor.Write(1, 18, n)),
    "dc104": Kind(dc104.PROFILE, [0], None, 2**16, dc104.Read(1), lambda number: dc104.Write(2, number)),
}


class Teller(TraceableMemory):
    """The memory of a device whose values say which node has said them, and as the how manieth."""

    def __init__(self, node: int, modulus: int, told: Told) -> None:
        super().__init__(node, modulus)
        self._span = modulus // 10
        self._count = 0
        self._told = told

    def read(self, element: int) -> int:
        self._count += 1
        value = self.node * self._span + self._count % self._span
        self._told("said", self.node, element, value)
        return value

    def write(self, element: int, value: float, slack: int = 0) -> None:
        self._told("took", self.node, element, round(value))


def make_line(protocol: str, told: Told) -> Line:
    """A line without physics, so that it can be saturated. `told` may be called in any thread."""
    kind = KINDS[protocol]
    devices = []
    for address in kind.addresses:
        device = make_device(protocol, address, delay=PROMPT, traceable=Teller(address, kind.modulus, told))
        if isinstance(device, EmulatedMsc):
            device.packet_delay = PROMPT
        devices.append(device)
    return Line(kind.profile.line, devices, paced=False, chance=random.Random(1))
