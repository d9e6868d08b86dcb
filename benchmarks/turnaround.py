"""How long the line lies dead between a reply and the next request, and what a transaction costs the processor.

The line is not paced and the responder answers at once, from a process on a core of its own, so that what is measured
is the master. Masters take turns on lines of their own, round by round.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Awaitable, Callable
from statistics import median

from benchmarks.harness import Claim, Options, Outcome, Table, alternate, loops, quantile, run_on
from benchmarks.lines import Kind, Lines
from benchmarks.masters import Bare, Blocking, Master, Ours, Streams
from benchmarks.questions import hcp2_questions
from busmaster.protocols.hcp2 import codec as hcp2

WARM_UP = 100
OTHER_WORK = 500e-6
CPU_US, BARE_CPU_US = 45, 21
"""What is wanted of ours where the bare loop takes that much; a machine that is busy, or slow, stretches both."""
COLUMNS = ("master", "wrong", "us each", "x bare", "CPU us", "dead us p50", "dead us p99")
BUSY_COLUMNS = ("master", "wrong", "us each", "iterations each", "dead us p50", "iterations dead")


def run(options: Options) -> Outcome:
    outcome = Outcome()
    for loop in loops():
        for kind in Kind:
            run_on(loop, _idle(loop, kind, options, outcome))
        run_on(loop, _busy(loop, options, outcome))
    return outcome


def _masters(kind: Kind) -> list[Master]:
    questions = hcp2_questions()
    masters: list[Master] = [Bare(questions), Ours(hcp2.PROFILE, questions), Ours(hcp2.PROFILE, questions, 1)]
    masters += [Streams(questions), Streams(questions, 1)]
    if kind is Kind.PTY:
        masters.append(Blocking(questions))
    return masters


async def _idle(loop: str, kind: Kind, options: Options, outcome: Outcome) -> None:
    """On a loop that has nothing else to do."""
    masters = _masters(kind)
    table = Table(f"Turnaround on a {kind.value}, {loop}", COLUMNS)
    with Lines(len(masters), {ask.request: ask.reply for ask in hcp2_questions()}, kind=kind) as lines:
        for master, port in zip(masters, lines.ports, strict=True):
            await master.open(port)
            await master.run(WARM_UP)
        lines.dead_times()
        runs = {master.name: master.run for master in masters}
        rounds = options.pick(60, 15 if kind is Kind.PTY and loop == "asyncio" else 3)
        timings = await alternate(runs, options.pick(400, 80), rounds)
        dead = lines.dead_times()
        for master in masters:
            await master.close()
    bare = timings[masters[0].name]
    for master, gaps in zip(masters, dead, strict=True):
        own = timings[master.name]
        figures = (own.each * 1e6, own.ratio(bare), own.cpu_each * 1e6)
        table.row(master.name, own.wrong, *figures, median(gaps) * 1e6, quantile(gaps, 0.99) * 1e6)
    outcome.tables.append(table)
    ours = timings[masters[1].name]
    outcome.wrong += ours.wrong
    if kind is Kind.PTY:
        outcome.series[f"dead time, {loop}"] = {m.name: _thinned(d) for m, d in zip(masters, dead, strict=True)}
    if kind is Kind.PTY and loop == "asyncio":
        outcome.claims.append(Claim("time a transaction on a pty, over bare asyncio.Protocol", ours.ratio(bare), 1.3))
        outcome.claims.append(Claim("CPU a transaction on a pty, us", ours.cpu_each * 1e6, CPU_US))
        calm = ours.cpu_in_calm(bare) * 1e6
        text = "CPU a transaction on a pty, us, in the quarter of the rounds in which bare asyncio.Protocol took least"
        outcome.claims.append(Claim(text, calm, CPU_US))
        text = "CPU a transaction on a pty, over bare asyncio.Protocol"
        outcome.claims.append(Claim(text, ours.cpu_ratio(bare), CPU_US / BARE_CPU_US))


async def _busy(loop: str, options: Options, outcome: Outcome) -> None:
    """On a loop of which each iteration also does some other work: then iterations are what counts."""
    masters = [master for master in _masters(Kind.PTY) if not isinstance(master, Blocking)]
    table = Table(f"Turnaround on a pty, {loop}, with {OTHER_WORK * 1e6:g} us of other work an iteration", BUSY_COLUMNS)
    transactions = options.pick(500, 40)
    with Lines(len(masters), {ask.request: ask.reply for ask in hcp2_questions()}) as lines:
        for master, port in zip(masters, lines.ports, strict=True):
            await master.open(port)
            await master.run(WARM_UP)
            lines.dead_times()
            each, iterations, wrong = await _beside_other_work(master.run, transactions)
            dead = median(next(gaps for gaps in lines.dead_times() if gaps))
            iterations_dead = dead / each * iterations
            table.row(master.name, wrong, each * 1e6, iterations, dead * 1e6, iterations_dead)
            if isinstance(master, Ours):
                outcome.wrong += wrong
                if loop == "asyncio" and master is masters[1]:
                    text = "loop iterations from a reply to the next request, busy loop"
                    outcome.claims.append(Claim(text, iterations_dead, 2))
        for master in masters:
            await master.close()
    outcome.tables.append(table)


async def _beside_other_work(run: Callable[[int], Awaitable[int]], transactions: int) -> tuple[float, float, int]:
    iterations = 0

    async def work() -> None:
        nonlocal iterations
        while True:
            until = time.perf_counter() + OTHER_WORK
            while time.perf_counter() < until:
                pass
            iterations += 1
            await asyncio.sleep(0)

    worker = asyncio.create_task(work())
    begun, before = time.perf_counter(), iterations
    wrong = await run(transactions)
    taken, count = time.perf_counter() - begun, iterations - before
    worker.cancel()
    await asyncio.gather(worker, return_exceptions=True)
    return taken / transactions, count / transactions, wrong


def _thinned(values: list[float], most: int = 2000) -> list[float]:
    """At most so many of them, evenly taken from the sorted list: enough to draw its distribution."""
    ordered = sorted(values)
    step = max(1, len(ordered) // most)
    return [round(value, 7) for value in ordered[::step]]
