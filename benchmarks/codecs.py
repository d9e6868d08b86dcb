"""What a frame costs: building a command, encoding its request, decoding its reply, for each protocol.

Requests are the commands' own, replies those of the emulated devices, in one chunk. Times are the best of several
runs, in a warm cache: on a line that mostly waits they are two to three times as much.
"""

from __future__ import annotations

import timeit
from collections.abc import Callable
from functools import partial
from typing import Any

from benchmarks.harness import Options, Outcome, Table
from busmaster import Timings
from busmaster.contract.exchange import Expect
from busmaster.ext import Command, Profile, make_device
from busmaster.protocols.dc104 import codec as dc104
from busmaster.protocols.hcp import codec as hcp
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.mentor import codec as mentor
from busmaster.protocols.modbus import codec as modbus
from busmaster.protocols.msc import codec as msc
from busmaster.testing import answers_of

CASES: list[tuple[Profile, int, Callable[[], Command[Any]]]] = [
    (hcp.PROFILE, 5, lambda: hcp.Read(12)),
    (hcp.PROFILE, 5, lambda: hcp.Write(12, (123.456,))),
    (hcp2.PROFILE, 5, lambda: hcp2.Read(100)),
    (hcp2.PROFILE, 5, lambda: hcp2.Write(1, (123.456,))),
    (msc.PROFILE, 3, lambda: msc.DataRead(2008)),
    (msc.PROFILE, 3, lambda: msc.DataWrite(2008, -70000)),
    (msc.PROFILE, 3, lambda: msc.BlockRead(2008)),
    (mentor.PROFILE, 12, lambda: mentor.Read(1, 17)),
    (mentor.PROFILE, 12, lambda: mentor.Write(1, 17, -100)),
    (dc104.PROFILE, dc104.PROFILE.addresses[0], lambda: dc104.Read(12)),
    (dc104.PROFILE, dc104.PROFILE.addresses[0], lambda: dc104.Write(12, 300)),
    (modbus.PROFILE, 17, lambda: modbus.ReadRegisters(7, 10)),
    (modbus.PROFILE, 17, lambda: modbus.WriteRegisters(7, (555,))),
]
COLUMNS = ("command", "bytes out", "bytes in", "build us", "encode us", "decode us")


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table("Microseconds a frame", COLUMNS)
    number = options.pick(5000, 300)
    for profile, address, build in CASES:
        command = build()
        device = make_device(profile.name, address)
        sent = command.open(address, profile.timings).request
        reply = answers_of(device)(sent)

        building = _best(build, number)
        encoding = _best(partial(command.open, address, profile.timings), number)
        both = _best(partial(_converse, command, address, profile.timings, reply), number)
        table.row(f"{profile.name} {command}", len(sent), len(reply), building, encoding, both - encoding)
    outcome.tables.append(table)
    return outcome


def _converse(command: Command[Any], address: int, timings: Timings, reply: bytes) -> None:
    exchange = command.open(address, timings)
    step = exchange.feed(reply)
    while isinstance(step, Expect):
        step = exchange.feed(b"")


def _best(call: Callable[[], object], number: int) -> float:
    """Microseconds a call."""
    return min(timeit.repeat(call, number=number, repeat=5)) / number * 1e6
