"""What every scenario shares: how masters are measured in turn, and what a scenario hands back."""

from __future__ import annotations

import asyncio
import importlib.util
import os
import platform
import sys
import time
from collections.abc import Awaitable, Callable, Coroutine, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import metadata
from statistics import median
from typing import Any, TypeVar

T = TypeVar("T")

PEERS = ("pymodbus", "minimalmodbus", "tmodbus", "anymodbus")
VERSIONS = ("busmaster", "pyserial", "pyserial-asyncio", "anyio", "uvloop", *PEERS)


@dataclass(frozen=True)
class Options:
    """`quick`: as few repetitions as still exercise everything."""

    quick: bool = False

    def pick(self, full: T, quick: T) -> T:
        return quick if self.quick else full


@dataclass(frozen=True)
class Claim:
    """What is claimed of a figure, and whether this run shows it."""

    text: str
    measured: float
    limit: float
    at_most: bool = True

    @property
    def met(self) -> bool:
        return self.measured <= self.limit if self.at_most else self.measured >= self.limit

    def __str__(self) -> str:
        sign = "<=" if self.at_most else ">="
        return f"{'met' if self.met else 'NOT MET'}: {self.text}: {self.measured:.4g} (wanted {sign} {self.limit:g})"


@dataclass
class Table:
    title: str
    columns: Sequence[str]
    rows: list[Sequence[object]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def row(self, *cells: object) -> None:
        assert len(cells) == len(self.columns)
        self.rows.append(cells)

    def text(self) -> str:
        cells = [[str(column) for column in self.columns], *([_cell(cell) for cell in row] for row in self.rows)]
        widths = [max(len(row[n]) for row in cells) for n in range(len(self.columns))]
        lines = []
        for first, *others in cells:
            aligned = [cell.rjust(width) for cell, width in zip(others, widths[1:], strict=True)]
            lines.append("  ".join([first.ljust(widths[0]), *aligned]).rstrip())
        lines.insert(1, "  ".join("-" * width for width in widths))
        return "\n".join([self.title, *(f"  {line}" for line in [*lines, *self.notes])])


@dataclass
class Outcome:
    """Of one scenario. `series` are lists of numbers for the plots; `wrong` counts wrong values of ours."""

    tables: list[Table] = field(default_factory=list)
    claims: list[Claim] = field(default_factory=list)
    series: dict[str, Any] = field(default_factory=dict)
    wrong: int = 0

    def as_json(self) -> dict[str, Any]:
        return {
            "tables": [
                {
                    "title": table.title,
                    "rows": [dict(zip(table.columns, row, strict=True)) for row in table.rows],
                    "notes": table.notes,
                }
                for table in self.tables
            ],
            "claims": [
                {"text": c.text, "measured": c.measured, "limit": c.limit, "at_most": c.at_most, "met": c.met}
                for c in self.claims
            ],
            "series": self.series,
            "wrong": self.wrong,
        }


@dataclass
class Timings:
    """Of one master: seconds of time and of processor time a transaction, round by round."""

    taken: list[float] = field(default_factory=list)
    cpu: list[float] = field(default_factory=list)
    wrong: int = 0

    @property
    def each(self) -> float:
        return median(self.taken)

    @property
    def cpu_each(self) -> float:
        return median(self.cpu)

    def ratio(self, other: Timings) -> float:
        """The median of the ratios of the rounds, each with the other's round beside it."""
        return median(a / b for a, b in zip(self.taken, other.taken, strict=True))

    def cpu_ratio(self, other: Timings) -> float:
        """Likewise of the processor time."""
        return median(a / b for a, b in zip(self.cpu, other.cpu, strict=True))

    def cpu_in_calm(self, other: Timings) -> float:
        """The median processor time of the rounds in which the other took least, a quarter of all: it is the other's
        figures that tell which rounds the rest of the machine left alone."""
        by_other = sorted(range(len(other.cpu)), key=other.cpu.__getitem__)
        return median(self.cpu[number] for number in by_other[: -(-len(by_other) // 4)])


async def alternate(
    runs: Mapping[str, Callable[[int], Awaitable[int]]], transactions: int, rounds: int
) -> dict[str, Timings]:
    """Run each in turn, so many rounds of so many transactions, every other round in reverse order."""
    timings = {name: Timings() for name in runs}
    for number in range(rounds):
        order = list(runs.items())
        for name, run in order if number % 2 else reversed(order):
            cpu, begun = time.process_time(), time.perf_counter()
            wrong = await run(transactions)
            taken, cpu = time.perf_counter() - begun, time.process_time() - cpu
            timings[name].taken.append(taken / transactions)
            timings[name].cpu.append(cpu / transactions)
            timings[name].wrong += wrong
    return timings


def quantile(values: Sequence[float], q: float) -> float:
    """nan of nothing."""
    return sorted(values)[min(len(values) - 1, int(q * len(values)))] if values else float("nan")


def installed(name: str) -> bool:
    return importlib.util.find_spec(name) is not None


def loops() -> list[str]:
    return ["asyncio", "uvloop"] if installed("uvloop") else ["asyncio"]


def run_on(loop: str, work: Coroutine[Any, Any, T]) -> T:
    """Run it on a fresh loop of that kind."""
    if loop == "uvloop":
        import uvloop

        with asyncio.Runner(loop_factory=uvloop.new_event_loop) as runner:
            return runner.run(work)
    return asyncio.run(work)


def machine() -> dict[str, Any]:
    """Where the figures come from."""
    versions = {}
    for name in VERSIONS:
        try:
            versions[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return {
        "system": f"{platform.system()} {platform.release()}",
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)),
        "python": f"{platform.python_implementation()} {sys.version.split()[0]}",
        "load": os.getloadavg()[0],
        "versions": versions,
    }


def _processor() -> str:
    try:
        with open("/proc/cpuinfo") as lines:
            names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    except OSError:
        names = []
    return names[0] if names else platform.machine()


def _cell(value: object) -> str:
    """Three figures or more; a dash where there is none."""
    if value is None or value != value:
        return "-"
    if isinstance(value, float):
        return f"{value:.3g}" if abs(value) < 10 else f"{value:.1f}" if abs(value) < 1000 else f"{value:.0f}"
    return str(value)
