"""How fast the emulated line runs in virtual time: a saturated line of 32 nodes, without an event loop.

What a campaign of millions of transactions, and with it every claim about wrong values, costs. Commands keep the line
busy, polls go on beside them, the health of the nodes is watched and statistics are taken once a second. Every value
says whose it is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from random import Random

from benchmarks.harness import Claim, Options, Outcome, Table
from busmaster.arbiter.events import Event, Polled
from busmaster.arbiter.schedule import set_members
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.world import World
from busmaster.ext import Poll, Transaction
from busmaster.protocols._comms.mint import LAST_COMMS, EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2

NODES = range(1, 33)
ELEMENTS = range(1, LAST_COMMS + 1)
REPLY_TIME = 0.002
IN_FLIGHT = 4
PERIODS = (0.25, 1.0)
DAY = 86_400.0
FAULTS: dict[str, Callable[[], Faults]] = {
    "no faults": Faults,
    "one frame in a hundred lost, late, flipped or cut": lambda: Faults(
        lost=0.003, late=0.002, flip=0.003, truncated=0.002
    ),
}
WANTED = {"no faults": 30_000.0}
WANTED_WITH_FAULTS = 15_000.0
WANTED_FOR_A_DAY = 10.0
"""Minutes."""
COLUMNS = ("line", "wrong", "right", "failed", "transactions /s", "x real time", "a day takes, min")


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table("HCP2 reads of 32 nodes at 57600 baud, replies after 2 ms, in virtual time", COLUMNS)
    for name, faults in FAULTS.items():
        simulation = Simulation(faults(), options.pick(1800.0, 30.0))
        begun = time.perf_counter()
        simulation.run()
        taken = time.perf_counter() - begun
        rate = simulation.done / taken
        virtual = simulation.world.now / taken
        day = DAY / virtual / 60
        table.row(name, simulation.wrong, simulation.right, simulation.failed, rate, virtual, day)
        outcome.wrong += simulation.wrong
        wanted = WANTED.get(name, WANTED_WITH_FAULTS)
        outcome.claims.append(Claim(f"transactions a second in virtual time, {name}", rate, wanted, at_most=False))
        if name in WANTED:
            outcome.claims.append(Claim("minutes for a day of the saturated line", day, WANTED_FOR_A_DAY))
    outcome.tables.append(table)
    return outcome


class Simulation:
    """`seconds` of a line that is never idle."""

    def __init__(self, faults: Faults, seconds: float) -> None:
        chance = Random(1)
        devices = [EmulatedMint(node, delay=Delay(REPLY_TIME)) for node in NODES]
        for device in devices:
            device.comms = [value_of(device.address, element) for element in range(LAST_COMMS + 1)]
        line = Line(hcp2.PROFILE.line, devices, chance=chance, faults=faults)
        self.world = World(line, on_event=self._on_event, jitter=chance.random)
        self.right = self.wrong = self.failed = 0
        self._seconds = seconds
        self._asked = 0
        self._commands = [hcp2.Read(element) for element in ELEMENTS]
        self._nodes = [self.world.node(hcp2.PROFILE, node) for node in NODES]

    @property
    def done(self) -> int:
        return self.right + self.wrong + self.failed

    def run(self) -> None:
        world = self.world
        for period in PERIODS:
            poll = Poll(f"every {period:g} s", period, phase=0.0)
            set_members(poll, [Transaction(node, self._commands[0]) for node in self._nodes])
            world.arbiter.add_poll(poll, world.now)
        world.run(1.0)
        for _ in range(IN_FLIGHT):
            self._ask()
        while world.now < self._seconds:
            world.run(world.now + 1.0)
            world.arbiter.statistics(world.now)

    def _ask(self) -> None:
        number = self._asked
        self._asked += 1
        self.world.request(self._nodes[number % len(self._nodes)], self._commands[number % len(self._commands)])

    def _on_event(self, event: Event) -> None:
        if isinstance(event, Transaction):
            self._count(event)
            if not event.probe:
                self._ask()
        elif isinstance(event, Polled):
            for transaction in event.poll.results:
                self._count(transaction)

    def _count(self, transaction: Transaction) -> None:
        if transaction.error is not None:
            self.failed += 1
            return
        command = transaction.command
        assert isinstance(command, hcp2.Read)
        if transaction.value == value_of(transaction.node.address, command.element):
            self.right += 1
        else:
            self.wrong += 1


def value_of(node: int, element: int) -> float:
    """Short, as most real values are, and nobody else's."""
    return float(node * 100 + element)
