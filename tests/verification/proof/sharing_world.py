"""A line that several programs share, and that is held for sequences of requests, with an adversary (R7, R8, R9)."""

from __future__ import annotations

from math import inf

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.clients import OWN, Hold, LineClient
from busmaster.arbiter.counters import OFFLINE
from busmaster.arbiter.transaction import URGENT, Transaction
from tests.verification.proof.instants import Instant
from tests.verification.proof.wire import Time, Violation, choose
from tests.verification.proof.world import Action, World


class SharingWorld(World):
    """Whoever asks is the program that owns the line, or another; one sequence at a time."""

    def __init__(self, now: Time) -> None:
        super().__init__(now)
        self.arbiter.longest_hold = Arbiter.longest_hold  # each part has all that it will have
        self.clients: tuple[LineClient | None, ...] = (
            None,
            *(self.arbiter.add_client() for _ in range(self.setup.clients)),
        )
        self.sequence: Hold | None = None
        self.held_until: Time = -inf
        """The line is held until then, unless it is let go before."""

    @property
    def ranks(self) -> dict[LineClient, int]:
        every = [OWN, *self.clients, self.sequence]
        return {client: place for place, client in enumerate(every) if client is not None}

    def whose(self) -> LineClient | None:
        return self.clients[choose(len(self.clients))]

    # sequences

    def own_actions(self) -> list[Action]:
        if not self.setup.longest_hold or self.arbiter.state is OFFLINE:
            return []
        if self.sequence is None:
            return [("begin", place) for place in self.setup.commands]
        waits = any(ticket.client is self.sequence for ticket in self.live)
        more = [] if waits or self.sequence.over else [("more", place) for place in self.setup.commands]
        return [*more, ("release",)]

    def do(self, action: Action) -> None:
        if action[0] == "release":
            assert self.sequence is not None
            self.note("releases")
            self.held_until = -inf
            self.arbiter.release(self.sequence, self.now)
            return
        if action[0] == "begin":
            self.note("begins")
            self.sequence = self.arbiter.exclusive(self.nodes[0], self.whose(), self.setup.longest_hold)
        self.note("asks in sequence", action[1])
        self.arbiter.submit(self.made(action[1], self.sequence), self.now)

    def pump(self) -> None:
        super().pump()
        sequence = self.sequence
        if sequence is not None and sequence.over and all(ticket.client is not sequence for ticket in self.live):
            on_wire = self.arbiter._wire.transaction
            if on_wire is None or on_wire.client is not sequence:
                self.sequence = None
                self.held_until = -inf

    def is_held(self) -> bool:
        due: Time = self.arbiter._deadlines.hold
        return type(due) is Instant and not due > self.now + self.setup.longest_hold

    def _judge_turn(self, transaction: Transaction) -> None:
        """Nothing but URGENT and what proves that the line is in sync comes between the requests of a sequence, and
        none of it goes when its time is over."""
        held = type(self.held_until) is Instant
        if transaction.client is not None and transaction.client is self.sequence:
            if self.sequence.over or (held and self.now > self.held_until):
                raise Violation("R9: a request of a sequence that is over is sent")
            if not held:
                self.held_until = self.now + self.sequence.longest
        elif held and transaction.priority is not URGENT and not transaction.check and self.now < self.held_until:
            raise Violation("R9: a request of another comes between those of a sequence")
