"""One dead unit of eight: what do the live ones keep?

Eight tasks, one a unit, each read one register after another as fast as they get their turn; after a failure a task
waits 10 ms. Then one unit is taken off the line. Measured is the rate of the live units from two seconds after that
on, against the rate of the same units while all were alive.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter

from benchmarks.harness import Claim, Options, Outcome, Table
from benchmarks.modbus_masters import Busmaster, Failed, ModbusMaster, masters, notes
from benchmarks.served_line import ServedLine, value_of

UNITS = 8
DEAD = 8
REGISTER = 7
DELAY = {"low": 0.002}
PATIENCE_AFTER_FAILURE = 0.01
UNTIL_KNOWN = 2.0
KEPT = 95.0
SHOWN = 0.5
"""Seconds of the line that are kept for the timeline."""
COLUMNS = ("master", "wrong", "all alive /s", "with one dead /s", "failed /s", "% kept by each live unit")


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table(f"{UNITS} units, then one of them dead", COLUMNS, notes=notes(options))
    for maker in masters(options):
        master = maker()
        with ServedLine(UNITS, delay=DELAY) as line:
            asyncio.run(_measure(master, line, options, table, outcome))
    outcome.tables.append(table)
    return outcome


async def _measure(master: ModbusMaster, line: ServedLine, options: Options, table: Table, outcome: Outcome) -> None:
    counts: Counter[str] = Counter()
    await master.open(line.path)
    pollers = [asyncio.create_task(_poll(master, unit, counts)) for unit in range(1, UNITS + 1)]
    await asyncio.sleep(0.3)
    alive = await _rates(counts, options.pick(4.0, 0.4))
    await asyncio.to_thread(line.kill, DEAD)
    await asyncio.sleep(options.pick(UNTIL_KNOWN, 1.5))
    await asyncio.to_thread(line.log)
    dead = await _rates(counts, options.pick(8.0, 0.6))
    log = await asyncio.to_thread(line.log)
    for poller in pollers:
        poller.cancel()
    await asyncio.gather(*pollers, return_exceptions=True)
    await master.close()
    kept = 100 * dead["live"] / alive["live"]
    table.row(master.name, counts["wrong"], alive["right"], dead["right"], dead["failed"], kept)
    shown = [entry for entry in log if entry[0] - log[0][0] < SHOWN]
    outcome.series[master.name] = {"kept": kept, "timeline": shown}
    if isinstance(master, Busmaster):
        outcome.wrong += counts["wrong"]
        if not options.quick:  # too short: one probe more or less shows
            outcome.claims.append(Claim("% of their rate that live units keep", kept, KEPT, at_most=False))


async def _poll(master: ModbusMaster, unit: int, counts: Counter[str]) -> None:
    while True:
        try:
            value = await master.read(unit, REGISTER)
        except Failed:
            counts["failed"] += 1
            await asyncio.sleep(PATIENCE_AFTER_FAILURE)
        else:
            counts["right" if value == value_of(unit, REGISTER) else "wrong"] += 1
            counts["live"] += unit != DEAD


async def _rates(counts: Counter[str], seconds: float) -> dict[str, float]:
    before, begun = counts.copy(), time.perf_counter()
    await asyncio.sleep(seconds)
    taken = time.perf_counter() - begun
    return {kind: (counts[kind] - before[kind]) / taken for kind in ("right", "live", "failed")}
