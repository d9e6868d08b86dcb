"""What a line keeps of its rate when frames are lost, flipped or cut.

First ours in virtual time: a saturated HCP2 line of 32 nodes that answer after 2 ms, with the documents' times and with
times that it has learned from 200 replies of each node before the first frame is spoilt; all nodes are asked for the
same element, so that every answer could be taken for another node's, or for different ones. Then ours and the others on
a real pty, with Modbus frames and the same window and retries.
"""

from __future__ import annotations

import asyncio
import time
from collections import Counter
from collections.abc import Callable
from functools import partial
from random import Random

from benchmarks.harness import Claim, Options, Outcome, Table
from benchmarks.modbus_masters import Busmaster, Failed, ModbusMaster, masters, notes
from benchmarks.served_line import ServedLine, value_of
from busmaster.arbiter.events import Event
from busmaster.arbiter.learned import TRUSTED_AFTER
from busmaster.arbiter.transaction import Transaction
from busmaster.contract.learning import LEARNED
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.world import World
from busmaster.protocols._comms.mint import LAST_COMMS, EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2

NODES = range(1, 33)
REPLY_TIME = 0.002
IN_FLIGHT = 4
SPOILT: tuple[tuple[str, dict[str, float], tuple[float | None, float | None]], ...] = (
    ("nothing", {}, (99.9, 99.9)),
    ("0.1 % lost", {"lost": 0.001}, (99.2, 99.4)),
    ("1 % lost", {"lost": 0.01}, (94.0, 95.5)),
    ("5 % lost", {"lost": 0.05}, (70.0, 75.0)),
    ("1 % flipped", {"flip": 0.01}, (94.0, None)),
    ("1 % cut", {"truncated": 0.01}, (93.0, None)),
)
"""What is spoilt, of each frame either way, and what is claimed to be kept with learned times, in percent: of reads of
the same element, and of different ones."""
COLUMNS = ("spoilt", "elements", "wrong", "documents' times /s", "%", "learned /s", "%")
UNITS = 4
CALLERS = 4
DELAY = {"low": REPLY_TIME}
SHARE_LOST = 0.01
PEER_COLUMNS = ("master", "wrong", "clean /s", "1 % lost /s", "%", "failed")


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table("HCP2 reads of 32 nodes at 57600 baud, in virtual time", COLUMNS)
    seconds = options.pick(120.0, 2.0)
    for place, elements in enumerate(("same", "different")):
        clean: dict[bool, float] = {}
        for what, faults, claimed in SPOILT:
            lines = {learned: LossyLine(learned, elements == "same") for learned in (False, True)}
            rates = {learned: line.rate(faults, seconds, options.quick) for learned, line in lines.items()}
            clean = clean or rates
            wrong = sum(line.wrong for line in lines.values())
            shares = {learned: 100 * rates[learned] / clean[learned] for learned in rates}
            table.row(what, elements, wrong, rates[False], shares[False], rates[True], shares[True])
            outcome.wrong += wrong
            outcome.series[f"{what}, {elements}"] = {"default": shares[False], "learned": shares[True]}
            claim = claimed[place]
            if claim is not None and faults and not options.quick:
                what = f"% kept with learned times, {what}, {elements} elements"
                outcome.claims.append(Claim(what, shares[True], claim, at_most=False))
    outcome.tables.append(table)
    outcome.tables.append(_compared(options, outcome))
    return outcome


class LossyLine:
    """A saturated line in virtual time, after learning."""

    def __init__(self, learned: bool, same: bool) -> None:
        chance = Random(1)
        devices = [EmulatedMint(node, delay=Delay(REPLY_TIME)) for node in NODES]
        for device in devices:
            device.comms = [_value(device.address, element) for element in range(LAST_COMMS + 1)]
        self.line = Line(hcp2.PROFILE.line, devices, chance=chance, faults=Faults())
        self.world = World(self.line, on_event=self._on_event, jitter=chance.random)
        self.right = self.wrong = 0
        self._asked = 0
        self._same = same
        timings = LEARNED if learned else None
        self._nodes = [self.world.node(hcp2.PROFILE, node, timings=timings) for node in NODES]

    def rate(self, faults: dict[str, float], seconds: float, quick: bool) -> float:
        """Right values a second, in so many seconds with these faults, once each node has answered often enough."""
        world = self.world
        world.run(1.0)
        for _ in range(IN_FLIGHT):
            self._ask()
        while not quick and min(node.counters.ok for node in self._nodes) <= TRUSTED_AFTER:
            world.run(world.now + 1.0)
        for name, share in faults.items():
            setattr(self.line.faults, name, share)
        before = self.right
        world.run(world.now + seconds)
        return (self.right - before) / seconds

    def _ask(self) -> None:
        number = self._asked
        self._asked += 1
        element = 1 if self._same else 1 + number % (LAST_COMMS - 1)
        self.world.request(self._nodes[number % len(self._nodes)], hcp2.Read(element))

    def _on_event(self, event: Event) -> None:
        if not isinstance(event, Transaction) or event.probe:
            return
        command = event.command
        assert isinstance(command, hcp2.Read)
        if event.error is None:
            right = event.value == _value(event.node.address, command.element)
            self.right += right
            self.wrong += not right
        self._ask()


def _value(node: int, element: int) -> float:
    """Short, as most real values are, and nobody else's."""
    return float(node * 100 + element)


# against the others


def _compared(options: Options, outcome: Outcome) -> Table:
    table = Table(f"Modbus reads of {UNITS} units on a pty, 57600 baud", PEER_COLUMNS, notes=notes(options))
    makers: list[Callable[[], ModbusMaster]] = [*masters(options), partial(Busmaster, learned=True)]
    for maker in makers:
        master = maker()
        with ServedLine(UNITS, delay=DELAY) as line:
            asyncio.run(_measure(master, line, options, table, outcome))
    return table


async def _measure(master: ModbusMaster, line: ServedLine, options: Options, table: Table, outcome: Outcome) -> None:
    counts: Counter[str] = Counter()
    await master.open(line.path)
    callers = [asyncio.create_task(_call(master, number, counts)) for number in range(CALLERS)]
    clean = await _rate(counts, options.pick(10.0, 0.2))  # in which 200 replies of each unit come
    await asyncio.to_thread(line.spoil, lost=SHARE_LOST)
    lossy = await _rate(counts, options.pick(20.0, 0.3))
    for caller in callers:
        caller.cancel()
    await asyncio.gather(*callers, return_exceptions=True)
    await master.close()
    table.row(master.name, counts["wrong"], clean, lossy, 100 * lossy / max(clean, 1e-9), counts["failed"])
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
