"""What a program pays for reading through the socket of the process that owns the line.

The line is idle but for one reader: the owner itself, and a program that is connected to it, in turn, round by round.
"""

from __future__ import annotations

import asyncio

from benchmarks.apart import Apart
from benchmarks.harness import Claim, Options, Outcome, Table, quantile
from benchmarks.owned_line import UNIT, read
from benchmarks.served_line import ServedLine
from busmaster import connect
from busmaster.protocols.modbus.codec import PROFILE

MOST = 0.4
"""Milliseconds that a remote read may take more than a local one."""
WARM_UP = 20
DELAY = 0.002
"""Seconds, always the same, that the unit takes to reply."""


def run(options: Options) -> Outcome:
    outcome = Outcome()
    local: list[float] = []
    remote: list[float] = []
    with ServedLine(UNIT, delay={"low": DELAY}) as line:
        owner = Apart("benchmarks.owned_line", paced=False)
        try:
            address = owner.ask({"port": line.path})
            asyncio.run(_measure(owner, address, options, local, remote))
        finally:
            owner.close()
    table = Table("A read on an idle line, ms", ("who reads", "reads", "p50", "p99"))
    for who, took in (("the owner", local), ("a program, by its socket", remote)):
        table.row(who, len(took), quantile(took, 0.5) * 1000, quantile(took, 0.99) * 1000)
    outcome.tables.append(table)
    more = (quantile(remote, 0.5) - quantile(local, 0.5)) * 1000
    outcome.claims.append(Claim("what a remote read takes more than a local one, p50, ms", more, MOST))
    outcome.series = {"local": local, "remote": remote}
    return outcome


async def _measure(owner: Apart, address: str, options: Options, local: list[float], remote: list[float]) -> None:
    async with connect(address) as bus:
        node = bus.node(PROFILE, UNIT)
        await read(node, WARM_UP)
        for _ in range(options.pick(40, 2)):
            local += await asyncio.to_thread(owner.ask, {"reads": 25})
            remote += await read(node, 25)
