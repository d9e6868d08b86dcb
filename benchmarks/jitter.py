"""Polls on a fixed grid: how far from it do values come?

One register of each of eight units, every 100 ms. Ours is a poll group; the others get a task that reads one unit
after another and sleeps until the next point of the same grid, from which no sum of sleeps can drift. Ten commands a
second disturb; after a while one unit is dead. A value's delay is from the grid to its end; jitter is how far it lies
from the median of its unit.
"""

from __future__ import annotations

import asyncio
import random
import time
from math import inf, nan
from statistics import median

from benchmarks.harness import Options, Outcome, Table, quantile
from benchmarks.modbus_masters import PROFILE, RETRIES, TIMINGS, Busmaster, Failed, ModbusMaster, masters, notes
from benchmarks.served_line import ServedLine, value_of
from busmaster.protocols.modbus.handle import ModbusUnit

UNITS = 8
REGISTER, WRITTEN = 7, 99
PERIOD = 0.1
DELAY = {"low": 0.002}
COMMAND_EVERY = (0.05, 0.15)
COLUMNS = (
    *("master", "wrong", "not in time %", "jitter p50 ms", "p99 ms"),
    *("one dead: not in time %", "jitter p50 ms", "p99 ms"),
)
DEAD = UNITS
UNTIL_KNOWN = 1.5

Delays = dict[int, list[float]]


class Unit(ModbusUnit):
    profile = PROFILE


def run(options: Options) -> Outcome:
    outcome = Outcome()
    title = f"{UNITS} units polled every {PERIOD * 1000:g} ms, ten commands a second"
    table = Table(title, COLUMNS, notes=notes(options))
    table.notes.append("not in time: of the values that the grid asks for, those after the next was due, or never")
    cycles = options.pick(100, 5)
    for maker in masters(options):
        master = maker()
        with ServedLine(UNITS, delay=DELAY) as line:
            alive, dead, wrong = asyncio.run(_measure(master, line, cycles))
        figures = [*_figures(alive, cycles), *_figures({u: dead[u] for u in dead if u != DEAD}, cycles)]
        table.row(master.name, wrong, *figures)
        outcome.series[master.name] = {"alive": _jitter(alive), "dead": _jitter(dead)}
        outcome.wrong += wrong if isinstance(master, Busmaster) else 0
    outcome.tables.append(table)
    return outcome


def _figures(delays: Delays, cycles: int) -> tuple[float, float, float]:
    """What share of the values came too late or never; and the jitter of the others, in ms."""
    asked = cycles * len(delays)
    jitter = _jitter(delays)
    missing = 100 * (1 - len(jitter) / asked) if asked else nan
    return missing, 1000 * quantile(jitter, 0.5), 1000 * quantile(jitter, 0.99)


def _jitter(delays: Delays) -> list[float]:
    inside = [[delay for delay in values if delay < PERIOD] for values in delays.values()]
    return [abs(delay - middle) for values in inside if values and (middle := median(values)) for delay in values]


async def _measure(master: ModbusMaster, line: ServedLine, cycles: int) -> tuple[Delays, Delays, int]:
    await master.open(line.path)
    await asyncio.sleep(0.2)
    commands = asyncio.create_task(_command(master))
    alive: Delays = {unit: [] for unit in range(1, UNITS + 1)}
    dead: Delays = {unit: [] for unit in range(1, UNITS + 1)}
    if isinstance(master, Busmaster):
        wrong = await _poll_group(master, line, cycles, alive, dead)
    else:
        wrong = await _poll(master, cycles, alive)
        await asyncio.to_thread(line.kill, DEAD)
        await asyncio.sleep(UNTIL_KNOWN)
        wrong += await _poll(master, cycles, dead)
    commands.cancel()
    await asyncio.gather(commands, return_exceptions=True)
    await master.close()
    return alive, dead, wrong


async def _poll_group(master: Busmaster, line: ServedLine, cycles: int, alive: Delays, dead: Delays) -> int:
    """The group goes on while the unit dies: so it does in earnest."""
    bus = master.bus
    assert bus is not None
    units = [Unit(bus, unit, timings=TIMINGS, retries=RETRIES) for unit in range(1, UNITS + 1)]
    group = bus.poll_group("registers", period=PERIOD, points=[unit.point(f"holding:{REGISTER}") for unit in units])
    wrong = 0
    known = inf
    async for snapshot in group:
        if snapshot.cycle == cycles + 1:
            await asyncio.to_thread(line.kill, DEAD)
            known = bus.now() + UNTIL_KNOWN
        for point, sample in snapshot.items():
            if sample.error is not None:
                continue
            wrong += sample.value != value_of(point.node.address, REGISTER)
            if snapshot.cycle <= cycles:
                alive[point.node.address].append(sample.finished - snapshot.due)
            elif snapshot.due > known:
                dead[point.node.address].append(sample.finished - snapshot.due)
        if snapshot.due > known + (cycles - 1) * PERIOD:
            break
    return wrong


async def _poll(master: ModbusMaster, cycles: int, delays: Delays) -> int:
    """A cycle that could not begin before the next was due is left out, as in a poll group."""
    begin = time.perf_counter() + PERIOD
    wrong = 0
    for cycle in range(cycles):
        due = begin + cycle * PERIOD
        if time.perf_counter() > due + PERIOD:
            continue
        await asyncio.sleep(due - time.perf_counter())
        for unit in range(1, UNITS + 1):
            try:
                wrong += await master.read(unit, REGISTER) != value_of(unit, REGISTER)
            except Failed:
                continue
            delays[unit].append(time.perf_counter() - due)
    return wrong


async def _command(master: ModbusMaster) -> None:
    chance = random.Random(1)
    while True:
        await asyncio.sleep(chance.uniform(*COMMAND_EVERY))
        try:
            await master.write(chance.randrange(1, UNITS + 1), WRITTEN, 1)
        except Failed:
            continue
