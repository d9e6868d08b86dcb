"""Many lines in one process: does each keep its rate, and what does a transaction cost?

Every line is paced and saturated by two callers; one responder on another core answers for all. `rate alone` is what
one such line reaches in the same run; the CPU a transaction is compared with that of one saturated line that is not
paced, on which the loop never sleeps for long.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from statistics import mean, pstdev

from benchmarks.harness import Claim, Options, Outcome, Table, quantile
from benchmarks.lines import Lines
from benchmarks.masters import Question
from benchmarks.questions import hcp2_questions, wire_time
from busmaster import Bus, Endpoint, LineSettings
from busmaster.protocols.hcp2 import codec as hcp2

SETTINGS = LineSettings(19200)
DELAY = 0.002
CALLERS = 2
SETTLED = 0.2
COUNTS = (1, 2, 4, 8, 16, 32, 64)
COLUMNS = (
    "lines",
    "wrong",
    "/s together",
    "% of limit",
    "slowest, % of alone",
    "CPU us",
    "jitter us",
    "p99 late us",
)


@dataclass
class Tally:
    """Of one line: when each of its transactions was over."""

    ends: list[float] = field(default_factory=list)
    wrong: int = 0

    @property
    def rate(self) -> float:
        return (len(self.ends) - 1) / (self.ends[-1] - self.ends[0])

    @property
    def intervals(self) -> list[float]:
        return [b - a for a, b in zip(self.ends, self.ends[1:], strict=False)]


def run(options: Options) -> Outcome:
    outcome = Outcome()
    questions = hcp2_questions()
    table = Table(f"Lines of {SETTINGS.baudrate} baud, HCP2, reply time {DELAY * 1000:g} ms, one process", COLUMNS)
    limit = 1 / mean(wire_time(ask, SETTINGS, DELAY) for ask in questions)
    seconds = options.pick(4.0, 0.5)
    _, unpaced_cpu = asyncio.run(_measure(1, questions, None, seconds))
    alone = 0.0
    for count in options.pick(COUNTS, (1, 64)):
        tallies, cpu = asyncio.run(_measure(count, questions, SETTINGS, seconds))
        rates = [tally.rate for tally in tallies]
        alone = alone or rates[0]
        worst = 100 * min(rates) / alone
        intervals = [interval for tally in tallies for interval in tally.intervals]
        wrong = sum(tally.wrong for tally in tallies)
        jitter, late = pstdev(intervals), quantile(intervals, 0.99) - 1 / limit
        share = 100 * mean(rates) / limit
        table.row(count, wrong, sum(rates), share, worst, cpu * 1e6, jitter * 1e6, late * 1e6)
        outcome.wrong += wrong
        outcome.series[f"{count} lines"] = {"worst": worst, "cpu": cpu}
        if count == max(COUNTS):
            text = f"slowest of {count} lines, % of its rate alone"
            outcome.claims.append(Claim(text, worst, 95, at_most=False))
            text = f"CPU a transaction on {count} paced lines, over one saturated line that is not paced"
            outcome.claims.append(Claim(text, cpu / unpaced_cpu, 1.5))
    table.notes.append(f"one saturated line that is not paced: {unpaced_cpu * 1e6:.1f} us of CPU a transaction")
    table.notes.append("jitter: deviation of the time between two replies; late: beyond what the wire takes")
    outcome.tables.append(table)
    return outcome


async def _measure(
    count: int, questions: Sequence[Question], settings: LineSettings | None, seconds: float
) -> tuple[list[Tally], float]:
    """What each line did, and seconds of CPU a transaction."""
    replies = {ask.request: ask.reply for ask in questions}
    delay = DELAY if settings is not None else 0.0
    with Lines(count, replies, settings=settings, delay=delay, spin=0.0 if count > 1 else 500e-6) as lines:
        tallies = [Tally() for _ in range(count)]
        stop = asyncio.Event()
        work = [asyncio.create_task(_line(p, questions, t, stop)) for p, t in zip(lines.ports, tallies, strict=True)]
        await asyncio.sleep(SETTLED + count * 0.005)
        for tally in tallies:
            tally.ends.clear()
        cpu = time.process_time()
        await asyncio.sleep(seconds)
        cpu = time.process_time() - cpu
        transactions = sum(len(tally.ends) for tally in tallies)
        stop.set()
        await asyncio.gather(*work)
    return tallies, cpu / transactions


async def _line(port: Endpoint, questions: Sequence[Question], tally: Tally, stop: asyncio.Event) -> None:
    async with Bus(port) as bus:
        await asyncio.gather(
            *(_call(bus, [*questions[number:], *questions[:number]], tally, stop) for number in range(CALLERS))
        )


async def _call(bus: Bus, questions: Sequence[Question], tally: Tally, stop: asyncio.Event) -> None:
    nodes = [(bus.node(hcp2.PROFILE, ask.address), ask.command, ask.value) for ask in questions]
    clock = time.perf_counter
    while not stop.is_set():
        for node, command, value in nodes:
            if await node.request(command) != value:
                tally.wrong += 1
            tally.ends.append(clock())
