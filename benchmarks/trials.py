"""Reads whose values say whose they are, counted right, wrong, failed or cancelled: on a pty, or in virtual time."""

from __future__ import annotations

import asyncio
import random
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

from benchmarks.harness import Claim, Options, Outcome, Table
from benchmarks.modbus_masters import Busmaster, Failed, ModbusMaster, masters, notes
from benchmarks.served_line import REGISTERS, SETTINGS, ServedLine, emulated_units, value_of
from busmaster import MemoryPort
from busmaster.emulator.line import Line
from busmaster.testing.virtual_time import run_in_virtual_time

UNITS = 2
CALLERS = 4
TRIES = 10_000
QUICK_TRIES = 1000
COLUMNS = ("master", "wrong", "right", "failed", "cancelled", "right /s")


def compare(title: str, what: str, delay: Mapping[str, Any], patience: float | None, options: Options) -> Outcome:
    """Every master for so many seconds on the emulated line with these reply times, then ours in virtual time.

    `patience`: callers are cancelled after 0 to so many seconds, evenly spread; None: never.
    """
    outcome = Outcome()
    table = Table(title, COLUMNS, notes=notes(options))
    seconds = options.pick(15.0, 0.5)
    for maker in masters(options):
        master = maker()
        with ServedLine(UNITS, delay=dict(delay)) as line:
            counts, taken = asyncio.run(_for(seconds, master, line.path, patience))
        _row(table, master.name, counts, counts["right"] / taken)
        outcome.series[master.name] = dict(counts)
        outcome.wrong += counts["wrong"] if isinstance(master, Busmaster) else 0
    tries = options.pick(TRIES, QUICK_TRIES)
    counts = run_in_virtual_time(ours_in_virtual_time(tries, delay, patience))
    _row(table, f"busmaster, {tries} tries in virtual time", counts, None)
    outcome.wrong += counts["wrong"]
    outcome.claims.append(Claim(f"wrong values of busmaster, {what}, {tries} tries and more", outcome.wrong, 0))
    outcome.tables.append(table)
    return outcome


def _row(table: Table, name: str, counts: Counter[str], rate: float | None) -> None:
    table.row(name, *(counts[kind] for kind in ("wrong", "right", "failed", "cancelled")), rate)


async def _for(seconds: float, master: ModbusMaster, path: str, patience: float | None) -> tuple[Counter[str], float]:
    counts: Counter[str] = Counter()
    await master.open(path)
    begun = time.perf_counter()
    await _run(master, counts, patience, lambda: time.perf_counter() - begun < seconds)
    taken = time.perf_counter() - begun
    await master.close()
    return counts, taken


async def ours_in_virtual_time(tries: int, delay: Mapping[str, Any], patience: float | None) -> Counter[str]:
    units = emulated_units(UNITS, delay)
    counts: Counter[str] = Counter()
    master = Busmaster()
    await master.open_endpoint(MemoryPort(Line(SETTINGS, units, chance=random.Random(1))))
    await _run(master, counts, patience, lambda: counts.total() < tries)
    await master.close()
    return counts


async def _run(master: ModbusMaster, counts: Counter[str], patience: float | None, going: Callable[[], bool]) -> None:
    await asyncio.gather(*(_call(master, random.Random(seed), counts, patience, going) for seed in range(CALLERS)))


async def _call(
    master: ModbusMaster,
    chance: random.Random,
    counts: Counter[str],
    patience: float | None,
    going: Callable[[], bool],
) -> None:
    while going():
        unit, register = chance.randrange(1, UNITS + 1), chance.randrange(REGISTERS)
        within = None if patience is None else chance.uniform(0, patience)
        try:
            value = await _read(master, unit, register, within)
        except Failed:
            counts["failed"] += 1
        except asyncio.CancelledError:
            counts["cancelled"] += 1
        else:
            counts["right" if value == value_of(unit, register) else "wrong"] += 1


async def _read(master: ModbusMaster, unit: int, register: int, within: float | None) -> int:
    """Raises CancelledError if it was not over in time and was cancelled."""
    if within is None:
        return await master.read(unit, register)
    task = asyncio.ensure_future(master.read(unit, register))
    await asyncio.wait({task}, timeout=within)
    task.cancel()
    return await task
