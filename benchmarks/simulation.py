"""How fast the emulated line runs in virtual time: arbiter, line and eight devices, without an event loop.

What a campaign of millions of transactions, and with it every claim about wrong values, costs. Values are the
oracle's: each says whose it is.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from random import Random

from benchmarks.harness import Claim, Options, Outcome, Table
from busmaster.arbiter.events import Completed, Event
from busmaster.emulator.build import make_device
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.oracle import Oracle, oracle_value
from busmaster.emulator.world import World
from busmaster.protocols import hcp2

NODES = range(1, 9)
ELEMENTS = range(1, 100)
IN_FLIGHT = 4
FAULTS: dict[str, Callable[[], Faults]] = {
    "no faults": Faults,
    "one frame in a hundred lost, late, flipped or cut": lambda: Faults(
        lost=0.003, late=0.002, flip=0.003, truncated=0.002
    ),
}
WANTED = {"no faults": 30_000.0}
WANTED_WITH_FAULTS = 15_000.0
COLUMNS = ("line", "wrong", "right", "failed", "transactions /s", "x real time")


def run(options: Options) -> Outcome:
    outcome = Outcome()
    table = Table("HCP2 reads of eight nodes at 57600 baud, in virtual time", COLUMNS)
    for name, faults in FAULTS.items():
        simulation = Simulation(faults(), options.pick(100_000, 5000))
        begun = time.perf_counter()
        simulation.run()
        taken = time.perf_counter() - begun
        rate = simulation.done / taken
        virtual = simulation.world.now / taken
        table.row(name, simulation.wrong, simulation.right, simulation.failed, rate, virtual)
        outcome.wrong += simulation.wrong
        wanted = WANTED.get(name, WANTED_WITH_FAULTS)
        outcome.claims.append(Claim(f"transactions a second in virtual time, {name}", rate, wanted, at_most=False))
    outcome.tables.append(table)
    return outcome


class Simulation:
    """Asks until so many transactions are over; a few wait at any time."""

    def __init__(self, faults: Faults, transactions: int) -> None:
        devices = [make_device("hcp2", node, oracle=Oracle(node)) for node in NODES]
        line = Line(hcp2.PROFILE.line, devices, chance=Random(1), faults=faults)
        self.world = World(line, on_event=self._on_event)
        self.right = self.wrong = self.failed = 0
        self._transactions = transactions
        self._asked = 0
        self._commands = [hcp2.Read(element) for element in ELEMENTS]
        self._nodes = [self.world.node(hcp2.PROFILE, node) for node in NODES]

    @property
    def done(self) -> int:
        return self.right + self.wrong + self.failed

    def run(self) -> None:
        self.world.run(1.0)
        for _ in range(IN_FLIGHT):
            self._ask()
        self.world.run_until(lambda: self.done >= self._transactions, limit=1e9)

    def _ask(self) -> None:
        number = self._asked
        self._asked += 1
        self.world.request(self._nodes[number % len(self._nodes)], self._commands[number % len(self._commands)])

    def _on_event(self, event: Event) -> None:
        if not isinstance(event, Completed):
            return
        transaction = event.transaction
        if transaction.error is not None:
            self.failed += 1
        else:
            command = transaction.command
            assert isinstance(command, hcp2.Read)
            is_right = transaction.value == oracle_value(transaction.node.address, command.element, 0)
            self.right += is_right
            self.wrong += not is_right
        self._ask()
