"""What a line keeps of its rate when frames are lost, flipped or cut.

First ours in virtual time: a saturated HCP2 line of 32 nodes, with the documents' times and with times that it has
learned from 200 replies of each node before the first frame is spoilt. All nodes are asked for the same element, so
that every answer could be taken for another node's, or for different ones, or are polled, too; they answer after 2 ms,
or after 2, 20 and 90 ms; or the adapter hands over what has come every 16 ms. A line that polls alone tells how many
cycles it misses. Then ours and the others on a real pty, with Modbus frames and the same window and retries, and ours
by TCP.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from math import ceil
from random import Random
from statistics import mean

from benchmarks.harness import Claim, Options, Outcome, Table
from benchmarks.modbus_masters import Busmaster, Failed, ModbusMaster, masters, notes
from benchmarks.served_line import ServedLine, value_of
from busmaster import LEARNED
from busmaster.arbiter.events import Event, Polled
from busmaster.arbiter.learned import TRUSTED_AFTER
from busmaster.arbiter.schedule import set_members
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import ROUNDING, Line
from busmaster.emulator.world import World
from busmaster.ext import Poll, Transaction
from busmaster.protocols._comms.mint import LAST_COMMS, EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2

NODES = range(1, 33)
REPLY_TIME = 0.002
IN_FLIGHT = 4
PERIODS = (0.25, 1.0)
VALUES, QUICK_VALUES = 60_000, 300
"""Right values that are waited for, whatever time they take."""
SPOILT: dict[str, dict[str, float]] = {
    "nothing": {},
    "0.1 % lost": {"lost": 0.001},
    "1 % lost": {"lost": 0.01},
    "5 % lost": {"lost": 0.05},
    "1 % flipped": {"flip": 0.01},
    "1 % cut": {"truncated": 0.01},
}
"""What is spoilt, of each frame either way."""
LOST = tuple(SPOILT)[:4]
CYCLES_SPOILT = "1 % lost"
CYCLES_FOR, QUICK_CYCLES_FOR = 480.0, 5.0
"""Seconds: 1,920 cycles of 0.25 s, 480 of 1 s."""
MOST_MISSED = 3
COLUMNS = ("spoilt", "line", "wrong", "documents' times /s", "%", "learned /s", "%")
UNITS = 4
CALLERS = 4
DELAY = {"low": REPLY_TIME}
SHARE_LOST = 0.01
LEARNING = 8.0
"""Seconds in which 200 replies of each unit come."""
ROUNDS = 10
PEER_COLUMNS = ("master", "port", "wrong", "clean /s", "1 % lost /s", "%", "failed")


@dataclass(frozen=True)
class Kind:
    """A kind of line, how it is spoilt, and what is claimed to be kept of its rate with learned times, in percent."""

    name: str
    spoilt: Sequence[str] = LOST
    same: bool = False
    """All nodes are asked for the same element."""
    polled: bool = False
    """All nodes are polled, too: every 0.25 and every 1 s."""
    reply_times: tuple[float, ...] = (REPLY_TIME,)
    """Of one node after the other."""
    batch: float = 0.0
    """Seconds after which its adapter hands over what has come; 0 for at once."""
    claimed: Mapping[str, float] = field(default_factory=dict)


KINDS = (
    Kind(
        "same element",
        tuple(SPOILT),
        same=True,
        claimed={"0.1 % lost": 99.2, "1 % lost": 94.0, "5 % lost": 70.0, "1 % flipped": 94.0, "1 % cut": 93.0},
    ),
    Kind("different elements", tuple(SPOILT), claimed={"0.1 % lost": 99.4, "5 % lost": 75.0}),
    Kind("different, and polls", polled=True, claimed={"0.1 % lost": 99.4, "1 % lost": 95.5, "5 % lost": 75.0}),
    Kind(
        "2, 20 and 90 ms",
        reply_times=(0.002, 0.020, 0.090),
        claimed={"0.1 % lost": 99.0, "1 % lost": 95.0, "5 % lost": 80.0},
    ),
    Kind("batches of 16 ms", batch=0.016, claimed={"0.1 % lost": 99.0, "1 % lost": 93.0, "5 % lost": 68.0}),
)


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table("HCP2 reads of 32 nodes at 57600 baud, in virtual time", COLUMNS)
    for kind in KINDS:
        _keep(kind, options, table, outcome)
    outcome.tables.append(table)
    outcome.tables.append(_cycles(options, outcome))
    outcome.tables.append(_compared(options, outcome))
    return outcome


def _keep(kind: Kind, options: Options, table: Table, outcome: Outcome) -> None:
    """Measure what a line of that kind keeps."""
    clean: dict[bool, float] = {}
    for what in kind.spoilt:
        faults = SPOILT[what]
        lines = {learned: LossyLine(learned, kind) for learned in (False, True)}
        rates = {learned: line.rate(faults, options) for learned, line in lines.items()}
        clean = clean or rates
        wrong = sum(line.wrong for line in lines.values())
        shares = {learned: 100 * rates[learned] / clean[learned] for learned in rates}
        table.row(what, kind.name, wrong, rates[False], shares[False], rates[True], shares[True])
        outcome.wrong += wrong
        outcome.series[f"{what}, {kind.name}"] = {"default": shares[False], "learned": shares[True]}
        if what in kind.claimed and not options.quick:
            text = f"% kept with learned times, {what}, {kind.name}"
            outcome.claims.append(Claim(text, shares[True], kind.claimed[what], at_most=False))


def _cycles(options: Options, outcome: Outcome) -> Table:
    """Count the cycles that a line misses which does nothing but poll its nodes, at 79 % of what it can."""
    table = Table(f"Cycles of 32 nodes every 0.25 s and every 1 s, {CYCLES_SPOILT}", ("times", "cycles", "missed"))
    for learned in (False, True):
        line = LossyLine(learned, Kind("polls alone", polled=True, same=True))
        line.learn(options)
        line.spoil(SPOILT[CYCLES_SPOILT])
        before = line.cycles()
        line.world.run(line.world.now + options.pick(CYCLES_FOR, QUICK_CYCLES_FOR))
        cycles, missed = (now - then for now, then in zip(line.cycles(), before, strict=True))
        table.row("learned" if learned else "the documents'", cycles + missed, missed)
        outcome.wrong += line.wrong
    if not options.quick:
        text = f"of {cycles + missed} cycles missed with learned times, {CYCLES_SPOILT}"
        outcome.claims.append(Claim(text, missed, MOST_MISSED))
    return table


class BatchingLine(Line):
    """Its adapter hands over what has come at each tick of `latency` seconds."""

    def _arrive(self, data: bytes, when: float) -> None:
        if data:
            self._arrivals.append((ceil(when / self.latency - ROUNDING) * self.latency, data))


class LossyLine:
    """A saturated line in virtual time, after learning."""

    def __init__(self, learned: bool, kind: Kind) -> None:
        chance = Random(1)
        delays = [Delay(time) for time in kind.reply_times]
        devices = [EmulatedMint(node, delay=delays[node % len(delays)]) for node in NODES]
        for device in devices:
            device.comms = [_value(device.address, element) for element in range(LAST_COMMS + 1)]
        make = BatchingLine if kind.batch else Line
        self.line = make(hcp2.PROFILE.line, devices, chance=chance, faults=Faults(), latency=kind.batch)
        self.world = World(self.line, on_event=self._on_event, jitter=chance.random)
        self.right = self.wrong = 0
        self._asked = 0
        self._same = kind.same
        timings = LEARNED if learned else None
        self._nodes = [self.world.node(hcp2.PROFILE, node, timings=timings) for node in NODES]
        self._polls = [Poll(f"every {period:g} s", period, phase=0.0) for period in PERIODS if kind.polled]
        for poll in self._polls:
            set_members(poll, [Transaction(node, hcp2.Read(1)) for node in self._nodes])
            self.world.arbiter.add_poll(poll, self.world.now)

    def rate(self, faults: dict[str, float], options: Options) -> float:
        """Right values a second with these faults, once each node has answered often enough."""
        world = self.world
        world.run(1.0)
        for _ in range(IN_FLIGHT):
            self._ask()
        self.learn(options)
        self.spoil(faults)
        before, begun = self.right, world.now
        wanted = options.pick(VALUES, QUICK_VALUES)
        while self.right < before + wanted:
            world.run(world.now + 1.0)
        return (self.right - before) / (world.now - begun)

    def learn(self, options: Options) -> None:
        """Go on until each node has answered so often that its times are trusted."""
        while not options.quick and min(node.counters.ok for node in self._nodes) <= TRUSTED_AFTER:
            self.world.run(self.world.now + 1.0)

    def spoil(self, faults: dict[str, float]) -> None:
        for name, share in faults.items():
            setattr(self.line.faults, name, share)

    def cycles(self) -> tuple[int, int]:
        """Cycles that were run, and that were missed."""
        return sum(poll.cycles for poll in self._polls), sum(poll.missed for poll in self._polls)

    def _ask(self) -> None:
        number = self._asked
        self._asked += 1
        element = 1 if self._same else 1 + number % (LAST_COMMS - 1)
        self.world.request(self._nodes[number % len(self._nodes)], hcp2.Read(element))

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Polled):
            for transaction in event.poll.results:
                self._count(transaction)
        elif isinstance(event, Transaction) and not event.probe:
            self._count(event)
            self._ask()

    def _count(self, transaction: Transaction) -> None:
        command = transaction.command
        assert isinstance(command, hcp2.Read)
        if transaction.error is None:
            right = transaction.value == _value(transaction.node.address, command.element)
            self.right += right
            self.wrong += not right


def _value(node: int, element: int) -> float:
    """Short, as most real values are, and nobody else's."""
    return float(node * 100 + element)


# against the others


def _compared(options: Options, outcome: Outcome) -> Table:
    """Measure ours and the others on a pty, and ours by TCP: the others' clients of such lines take a serial port."""
    table = Table(f"Modbus reads of {UNITS} units, 57600 baud", PEER_COLUMNS, notes=notes(options))
    ours: tuple[Callable[[], ModbusMaster], ...] = (Busmaster, partial(Busmaster, learned=True))
    makers: list[tuple[Callable[[], ModbusMaster], str]] = [(maker, "pty") for maker in (*masters(options), ours[1])]
    makers += [(maker, "TCP") for maker in ours]
    for maker, port in makers:
        master = maker()
        with ServedLine(UNITS, delay=DELAY, tcp=port == "TCP") as line:
            asyncio.run(_measure(master, port, line, options, table, outcome))
    return table


async def _measure(
    master: ModbusMaster, port: str, line: ServedLine, options: Options, table: Table, outcome: Outcome
) -> None:
    counts: Counter[str] = Counter()
    await master.open(line.path)
    callers = [asyncio.create_task(_call(master, number, counts)) for number in range(CALLERS)]
    await asyncio.sleep(options.pick(LEARNING, 0.1))
    clean: list[float] = []
    lossy: list[float] = []
    for _ in range(options.pick(ROUNDS, 1)):  # in turn: what else the machine does changes from one second to the next
        for share, rates in ((0.0, clean), (SHARE_LOST, lossy)):
            await asyncio.to_thread(line.spoil, lost=share)
            rates.append(await _rate(counts, options.pick(2.0, 0.2)))
    for caller in callers:
        caller.cancel()
    await asyncio.gather(*callers, return_exceptions=True)
    await master.close()
    rate, kept = mean(clean), mean(lossy)
    table.row(master.name, port, counts["wrong"], rate, kept, 100 * kept / max(rate, 1e-9), counts["failed"])
    if isinstance(master, Busmaster):
        outcome.wrong += counts["wrong"]


async def _rate(counts: Counter[str], seconds: float) -> float:
    before, begun = counts["right"], time.perf_counter()
    await asyncio.sleep(seconds)
    return (counts["right"] - before) / (time.perf_counter() - begun)


async def _call(master: ModbusMaster, number: int, counts: Counter[str]) -> None:
    unit, register = number % UNITS + 1, 10 * number
    caller = asyncio.current_task()
    assert caller is not None
    while not caller.cancelling():  # pymodbus makes an error of its own of a cancellation
        try:
            value = await master.read(unit, register)
        except Failed:
            counts["failed"] += 1
            await asyncio.sleep(0.01)
        else:
            counts["right" if value == value_of(unit, register) else "wrong"] += 1
