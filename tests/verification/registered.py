"""What campaigns and proof worlds need of a protocol, derived from what the registry says of it.

A protocol for which nothing was chosen by hand takes part by this alone: its documented items say what can be written,
its sync reads what can be read, the examples of its page which reads take several steps, and its emulated device which
elements a command touches, how it replies, and which damaged requests it refuses.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from random import Random
from typing import Any

from busmaster import Bus, MemoryPort
from busmaster.contract.driver import Driver
from busmaster.contract.exchange import Command
from busmaster.contract.profile import Profile
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.line import Line
from busmaster.emulator.traceable import TraceableMemory
from busmaster.errors import InvalidCommand
from busmaster.registry import NodeKind, make_device, protocols
from busmaster.testing import answers_of
from tests.docs.test_telegrams import EXAMPLES

MODULI = (2**31, 10**9, 10**6, 10**5, 2**16, 10**4)
"""How many traceable values a device may carry: the most that it takes."""
NAMED = re.compile(r"(?!.*\d-\d)[a-z]\w*")
MOST_WRITTEN = 4
PROMPT = Delay(0.002)
SEVEN_BITS = bytes(byte & 0x7F for byte in range(256))


class Spy(TraceableMemory):
    """A memory that notes which elements are read and written, and has `value` in each."""

    def __init__(self, node: int, modulus: int, value: int = 1) -> None:
        super().__init__(node, modulus)
        self.value = value
        self.read_from: list[int] = []
        self.written_to: list[int] = []

    def read(self, element: int) -> int:
        self.read_from.append(element)
        return self.value

    def write(self, element: int, value: float, slack: int = 0) -> None:
        self.written_to.append(element)


@dataclass(frozen=True)
class Registered:
    """One protocol, by its first kind of node."""

    kind: NodeKind

    @property
    def name(self) -> str:
        return self.kind.name

    @property
    def profile(self) -> Profile:
        return self.kind.profile

    @property
    def address(self) -> int:
        return self.profile.addresses[-1]

    @property
    def modulus(self) -> int:
        return _modulus(self.kind)

    @property
    def reads(self) -> Sequence[Command[Any]]:
        """Sync reads, and reads of what can be written."""
        written = [point.command for point in writable(self.kind)]
        return list(dict.fromkeys([*self.profile.sync_reads, *written]))

    @property
    def runs(self) -> Sequence[Command[Any]]:
        """Reads of several steps that the protocol's page shows."""
        built = [one.built() for _, one in EXAMPLES if one.known and one.kind is self.kind]
        reads = [command for command in built if not command.writes]
        return [read for read in reads if len(read.open(self.address, self.profile.timings).later) > 0]

    def write(self, chance: Random, number: int, repeat: bool) -> Command[Any]:
        """Return a write of a number to any item that takes it."""
        return self.write_of(chance.randrange(0, len(writable(self.kind))), number, repeat)

    def write_of(self, place: int, number: int, repeat: bool = False) -> Command[Any]:
        """Return a write of a number to the writable item of a place."""
        command: Any = writable(self.kind)[place].encode(number)
        has_option = any(field.name == "idempotent" for field in fields(command))
        if repeat and has_option:
            command = replace(command, idempotent=True)
        made: Command[Any] = command
        return made

    def device(self, memory: TraceableMemory, address: int | None = None) -> Device:
        at = self.address if address is None else address
        return make_device(self.name, at, traceable=memory, delay=PROMPT)

    def reply(self, request: bytes, value: int, address: int | None = None) -> bytes:
        """Return what a device replies in whose every element is this value."""
        return answers_of(self.device(Spy(0, self.modulus, value), address))(request)

    def refused(self, request: bytes) -> bytes:
        """Return the request with one flipped bit, so that the device refuses it: it says so, and stores nothing."""
        usual = self.reply(request, 1)[:1]
        spy = Spy(0, self.modulus)
        device = self.device(spy)
        address = next(address for address in self.profile.addresses if _is_for(self.kind, address, request))
        for place in range(len(request) - 1, 0, -1):
            for bit in range(7):
                damaged = bytearray(request)
                damaged[place] ^= 1 << bit
                spy = Spy(0, self.modulus)
                device = self.device(spy, address)
                said = answers_of(device)(bytes(damaged))
                if said == device.refusal or (said and said[:1] != usual and not spy.written_to and not spy.read_from):
                    return bytes(damaged)
        raise AssertionError(f"{self.name}: no flipped bit of {request.hex(' ')} is refused")

    def checksum(self, node: int, element: int, number: int) -> int:
        """Return the last byte of what `node` replies to a read of `element` with `number`."""
        request = _request_of(self.kind, element)
        return self.reply(request, number)[-1] if request else number & 0xFF


def _is_for(kind: NodeKind, address: int, request: bytes) -> bool:
    return request.startswith(make_device(kind.name, address).routes)


@cache
def _modulus(kind: NodeKind) -> int:
    for modulus in MODULI:
        try:
            make_device(kind.name, kind.profile.addresses[-1], traceable=TraceableMemory(0, modulus))
        except InvalidCommand:
            continue
        return modulus
    raise AssertionError(f"{kind.name}: its emulated device takes no traceable memory")


@cache
def writable(kind: NodeKind) -> tuple[Any, ...]:
    """Return the points of documented items that take every traceable value."""
    address, modulus = kind.profile.addresses[-1], _modulus(kind)
    handle = kind.handle(Bus(MemoryPort(Line(kind.profile.line))), address)
    found = []
    for item in kind.documented:
        point = handle.point(item.item) if NAMED.fullmatch(item.item) else None
        if point is None or point.encode is None:
            continue
        try:
            commands = [point.encode(number) for number in (0, 1, modulus - 1)]
        except InvalidCommand:
            continue
        if all(len(touched(kind, command)[1]) == 1 for command in commands):
            found.append(point)
    assert found, f"{kind.name}: no documented item can be written"
    return tuple(found[:MOST_WRITTEN])


def touched(kind: NodeKind, command: Any) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Return the elements that the emulated device reads and writes for a command, as the device numbers them."""
    address = kind.profile.addresses[-1]
    spy = Spy(address, _modulus(kind))
    reply = answers_of(make_device(kind.name, address, traceable=spy, delay=PROMPT))
    exchange = command.open(address, kind.profile.timings)
    driver = Driver(exchange).feed(reply(exchange.request))
    said = 0
    while driver.ending is None and said < len(driver.sent):
        said += 1
        driver.feed(reply(driver.sent[said - 1]))
    return tuple(spy.read_from), tuple(spy.written_to)


@cache
def _elements(command: Any) -> tuple[int, ...]:
    """Return the elements that a read brings."""
    return touched(_kind_of(type(command).__module__), command)[0]


@cache
def _written_element(kind: NodeKind, place: Any) -> tuple[int, ...]:
    """Return the element behind a place, which any write to it touches."""
    point = next(point for point in writable(kind) if place in point.encode(1).changes(kind.profile))
    return touched(kind, point.encode(1))[1]


@cache
def _request_of(kind: NodeKind, element: int) -> bytes:
    """Return the request of the read that brings one element alone, b"" if there is none."""
    registered = Registered(kind)
    read: Any
    for read in registered.reads:
        if _elements(read) == (element,):
            return bytes(read.open(registered.address, kind.profile.timings).request)
    return b""


@cache
def _kind_of(module: str) -> NodeKind:
    """Return the kind of node whose commands are in a module."""
    return next(p.kinds[0] for p in protocols() if module in {kind.__module__ for kind in p.commands.values()})


def elements_of(command: Any) -> tuple[int, ...]:
    """Return what a command reads or writes, as its device numbers it."""
    if not command.writes:
        return _elements(command)
    kind = _kind_of(type(command).__module__)
    [place] = command.changes(kind.profile)  # of documented items, which can be limited
    return _written_element(kind, place)


def echoed(command: Any, address: int, heard: bytes) -> bool:
    """Whether what the host received holds what a good reply begins with."""
    profile = _kind_of(type(command).__module__).profile
    plain = heard.translate(SEVEN_BITS) if profile.line.bytesize == 7 else heard
    return any(key in plain for key in command.open(address, profile.timings).answers)


def registered(chosen: Sequence[str]) -> list[Registered]:
    """Return the protocols of the registry but those with these names, for which something was chosen by hand."""
    return [Registered(protocol.kinds[0]) for protocol in protocols() if protocol.name not in chosen]


def worlds_of(one: Registered) -> tuple[Sequence[tuple[int, Any]], Callable[[bytes, int], bytes], tuple[int, int]]:
    """Return the commands of a proof world, the replies to them, and the two values that these carry."""
    address = one.profile.addresses[0]
    read, unlike = one.reads[0], one.reads[1]
    write = one.write_of(0, 5)
    values = 1, 2
    several = one.profile.addressed

    @cache
    def answer(request: bytes, place: int) -> bytes:
        node = address + several * (not _is_for(one.kind, address, request))
        return one.reply(request, values[place], node)

    there = int(several)
    commands = (0, read), (there, read), (0, write), (there, write), (0, unlike), (there, unlike)
    return commands, answer, values
