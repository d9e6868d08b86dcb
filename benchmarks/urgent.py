"""A command on a saturated line: how long until it is carried out?

Eight tasks poll eight units as fast as they get their turn; every now and then a value is written, as urgently as the
master knows how. Measured is the time from the call to the confirmation; of ours also the wait until it is sent. Then
the same with one of the units dead.
"""

from __future__ import annotations

import asyncio
import random
import time
from dataclasses import dataclass, field

from benchmarks.harness import Claim, Options, Outcome, Table, quantile
from benchmarks.modbus_masters import Busmaster, Failed, ModbusMaster, masters, notes
from benchmarks.served_line import SETTINGS, ServedLine, value_of
from busmaster.protocols.modbus.codec import SILENCE

UNITS = 8
DEAD = 8
REGISTER, WRITTEN = 7, 99
DELAY = 0.002
FRAMES = 8 + 7
"""Bytes of a read and its reply."""
EVERY = (0.02, 0.06)
PATIENCE_AFTER_FAILURE = 0.01
COLUMNS = ("master", "wrong", "p50 ms", "p99 ms", "longest ms", "one dead: p50 ms", "p99 ms", "longest ms", "failed")


@dataclass
class Tally:
    """`latencies` of the writes that were confirmed, in seconds."""

    latencies: list[float] = field(default_factory=list)
    wrong: int = 0
    failed: int = 0


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table("From the call of an urgent write to its confirmation", COLUMNS, notes=notes(options))
    for maker in masters(options):
        master = maker()
        with ServedLine(UNITS, delay={"low": DELAY}) as line:
            asyncio.run(_measure(master, line, options, table, outcome))
    outcome.tables.append(table)
    return outcome


async def _measure(master: ModbusMaster, line: ServedLine, options: Options, table: Table, outcome: Outcome) -> None:
    await master.open(line.path)
    alive, dead = Tally(), Tally()
    pollers = [asyncio.create_task(_poll(master, unit, alive)) for unit in range(1, UNITS + 1)]
    await asyncio.sleep(0.3)
    writes = options.pick(300, 20)
    seconds = options.pick(20.0, 0.5)
    await _write(master, writes, seconds, alive)
    waits = list(master.waits) if isinstance(master, Busmaster) else []
    await asyncio.to_thread(line.kill, DEAD)
    await _write(master, writes, seconds, dead)
    for poller in pollers:
        poller.cancel()
    await asyncio.gather(*pollers, return_exceptions=True)
    if isinstance(master, Busmaster):
        _claim(master, waits, outcome)
        outcome.wrong += alive.wrong
    await master.close()
    figures = [1000 * of for tally in (alive, dead) for of in _figures(tally.latencies)]
    table.row(master.name, alive.wrong, *figures, alive.failed + dead.failed)
    outcome.series[master.name] = {"alive": alive.latencies, "dead": dead.latencies}


def _figures(latencies: list[float]) -> tuple[float, float, float]:
    return quantile(latencies, 0.5), quantile(latencies, 0.99), max(latencies, default=float("nan"))


def _claim(master: Busmaster, waits: list[float], outcome: Outcome) -> None:
    exchange = FRAMES * SETTINGS.byte_time + DELAY + SILENCE
    wait = quantile(waits, 0.99)
    outcome.claims.append(Claim("p99 wait of an urgent write, ms", wait * 1000, (exchange + 0.001) * 1000))
    longest = max(master.waits[len(waits) :], default=0.0)
    text = "longest wait of an urgent write with a dead unit, ms, against W_urgent"
    outcome.claims.append(Claim(text, longest * 1000, master.longest_hold * 1000))


async def _poll(master: ModbusMaster, unit: int, tally: Tally) -> None:
    while True:
        try:
            tally.wrong += await master.read(unit, REGISTER) != value_of(unit, REGISTER)
        except Failed:
            await asyncio.sleep(PATIENCE_AFTER_FAILURE)


async def _write(master: ModbusMaster, writes: int, seconds: float, tally: Tally) -> None:
    """So many, but none begun after so many seconds."""
    chance = random.Random(1)
    until = time.perf_counter() + seconds
    for number in range(writes):
        if time.perf_counter() > until:
            return
        await asyncio.sleep(chance.uniform(*EVERY))
        called = time.perf_counter()
        try:
            await master.write(1 + number % (UNITS - 1), WRITTEN, number)
        except Failed:
            tally.failed += 1
        else:
            tally.latencies.append(time.perf_counter() - called)
