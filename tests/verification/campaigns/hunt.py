"""One line under attack, in virtual time: what is asked of it, what goes wrong on it, how it heals.

A hunt is one seed of one protocol and one mix of faults. Clients read, write and go away; poll groups poll; devices die
and the port is lost. At the end all faults heal and progress must resume; then the bus is closed with requests in it.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from itertools import count
from random import Random
from typing import Any

from busmaster.arbiter import learned as learning
from busmaster.arbiter.clients import Hold
from busmaster.arbiter.counters import LineState
from busmaster.arbiter.events import Event, MaxReplyDelayRaised, NodeChanged, Polled
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.schedule import line_time, set_members
from busmaster.arbiter.transaction import Poll, Priority, Transaction
from busmaster.contract.exchange import Command
from busmaster.contract.learning import LEARNED
from busmaster.contract.tap import Tap
from busmaster.emulator.device import Delay
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Echo
from busmaster.emulator.world import World
from tests.verification.campaigns.edges import EdgeLine, crowd
from tests.verification.campaigns.judge import Asked, BrokenRuleError, Judge, Totals
from tests.verification.campaigns.kinds import KINDS, elements_of
from tests.verification.campaigns.ledger import Ledger
from tests.verification.campaigns.mixes import MIXES, PROMPT, Mix
from tests.verification.campaigns.sharing import FLOOD, Sharing
from tests.verification.campaigns.standing import StandingLine, StandingWorld

LONGEST = 1800.0
"""Virtual seconds after which the faults heal, however few transactions there were."""
RECOVERY = 240.0
"""Likewise in which everything must go well again (R11: probes are up to 36 s apart, and paid for)."""
SOON = 1e-6
"""Seconds: the line does what is due before."""
PAUSE = 0.05
"""Seconds after which a client whose request failed at once asks again."""
PERIODS = (0.1, 0.25, 0.5, 1.0)
CONTROL = b"\x02\x03\x04\x06\x15"
"""Checksums that look like something else: an ACK, a NAK, the beginning or the end of a frame."""
SHORT = 10**8
"""Numbers below it have eight digits as a rule: an even number of them, as a control character needs (HCP)."""


def be_hasty() -> None:
    """Learn from a few replies, and forget soon: what is learned is often wrong, and must not matter."""
    learning.TRUSTED_AFTER, learning.TRUSTED_AGAIN_AFTER, learning.EPOCH = 3, 3, 10


class Hunt:
    """One seed of one protocol and mix: `run` it once. `record` gets the transcript, line by line.

    `learned`: the nodes' reply times are learned.
    """

    def __init__(
        self,
        protocol: str,
        mix: str,
        seed: int,
        record: Callable[[str], None] | None = None,
        *,
        strict: bool = False,
        tap: Tap | None = None,
        learned: bool = False,
    ) -> None:
        self.kind = KINDS[protocol]
        self.mix: Mix = MIXES[mix]
        self.name = f"{protocol}/{mix}/{seed}"
        self.random = Random(self.name)
        self._record = record
        self._tap = tap
        chance = self.random
        ledger = self._ledger()
        nodes = chance.randrange(3, 8) if self.mix.equal else chance.randrange(1, 7)
        addresses = chance.sample(self.kind.addresses, min(len(self.kind.addresses), nodes))
        self.devices = [self.kind.device(ledger, address) for address in addresses]
        self.line = self._line(ledger)
        self.line.record = record
        self.world = self._world(strict)
        ledger.now = lambda: self.world.now
        self.judge = Judge(self.kind, self.mix, ledger, self.line, self.world.arbiter)
        self.ledger = ledger
        self.sharing = Sharing(self.name, self.world.arbiter, self.judge.problem) if self.mix.shared else None
        timings = LEARNED if learned and self.kind.profile.checked_requests else None
        if learned:
            be_hasty()
        self.nodes = [self.world.node(self.kind.profile, address, timings=timings) for address in addresses]
        broadcast = self.kind.profile.broadcast
        self.everybody = None if broadcast is None else self.world.node(self.kind.profile, broadcast)
        self.reads = [*self.kind.reads, *(self.kind.runs if self.mix.runs else ())]
        if self.mix.equal:
            self.reads = self.reads[:1]
        self.open: dict[Transaction, None] = {}
        self.polls: list[Poll] = []
        self._names = count(1)
        self._healed = False

    def _ledger(self) -> Ledger:
        kind, edges = self.kind, self.mix.edges
        ledger = Ledger(kind.modulus, kind.step, gaps=self.mix.gaps)
        if edges is not None and edges.sums:
            ledger.modulus = min(kind.modulus, SHORT)
            ledger.prefers = lambda *answer: kind.checksum(*answer) in CONTROL
        return ledger

    def _line(self, ledger: Ledger) -> EdgeLine:
        chance, mix, chunked = self.random, self.mix, self.mix.chunks
        chunk = chance.randrange(1, 4) if chunked else 0
        echo = mix.echo or (Echo() if chance.random() < 0.1 else None)
        latency = chance.choice((0.0, 0.0, 0.004)) if mix.latency is None else mix.latency
        paced = chunked or chance.random() < 0.8
        own = Random(f"{self.name} own")
        behind_network = False
        if mix.edges is not None or mix.stands is not None:
            chunk = own.choice((0, 1, 3))
            behind_network = own.random() < 0.5
        if mix.edges is not None and mix.latency is None:
            latency = own.choice((0.0, 0.016))
        if mix.edges is not None and latency:
            chunk = 1  # no byte is held for longer than that, whatever follows it
        if mix.doubled or mix.stands is not None:  # where talkers collide, a line soon falls into step again
            paced = own.random() < 1 / 3
        if mix.stands is not None:
            behind_network = behind_network or mix.stands.requests + mix.stands.replies > 0
            latency = 0.0
        line = (EdgeLine if mix.stands is None else StandingLine)(
            ledger,
            self.kind.profile.line,
            self.devices,
            edges=mix.edges,
            kind=self.kind,
            own=own,
            chance=Random(f"{self.name} line"),
            echo=echo,
            chunk=chunk,
            latency=latency,
            repeats=self.kind.profile.listen is not None or mix.stands is not None,
            paced=paced,
        )
        line.paced = paced and not behind_network
        return line

    def _world(self, strict: bool) -> World:
        options: dict[str, Any] = {"on_event": self._on_event, "record": self._record, "strict": strict}
        options["tap"] = self._tap
        options["jitter"] = Random(f"{self.name} probes").random
        if self.mix.stands is None:
            return World(self.line, **options)
        assert isinstance(self.line, StandingLine)
        own = Random(f"{self.name} stands")
        self.line.stand_still(self.mix.stands, own)
        return StandingWorld(self.line, self.mix.stands, own, **options)

    @property
    def totals(self) -> Totals:
        return self.judge.totals

    def run(self, transactions: int) -> Totals:
        """Until about so many were on the wire; then heal, recover and close. A broken rule ends it at once."""
        totals, world = self.totals, self.world
        try:
            self._break()
            while totals.transactions < transactions and world.now < LONGEST:
                world.run(world.now + 1.0)
            self._heal()
            self._close()
            self.judge.check_all_ended(len(self.open))
        except BrokenRuleError as broken:
            self.note(f"BROKEN: {broken}")
        self.judge.sum_up(world.now)
        return totals

    def note(self, what: str) -> None:
        if self._record is not None:
            self._record(f"{self.world.now:.6f} {what}")

    # the three acts

    def _break(self) -> None:
        mix, max_reply_delay = self.mix, self.kind.max_reply_delay
        slow = Delay(
            *PROMPT,
            late_replies=mix.slow,
            late_reply_delay=(mix.span[0] * max_reply_delay, mix.span[1] * max_reply_delay),
        )
        for device in self.devices:
            device.delay = slow
            self.kind.slow_down(device, slow)
            if mix.edges is not None:
                crowd(self.kind, device, mix.edges, slow)
            device.faults = mix.faults(mix.device, max_reply_delay)
        self.line.faults = mix.faults(mix.line, max_reply_delay)
        self.line.second, self.line.twice = mix.second, mix.twice
        self.line.repeats = self.line.repeats or mix.twice > 0  # they reply to what was received a second time, too
        for _ in range(self.random.randrange(1, 4)):
            self._add_poll()
        for client in range(self.random.randrange(1, 6)):
            self.world.at(self.random.uniform(0.0, 1.0), partial(self._ask, client))
        if self.sharing is not None:
            for _ in range(FLOOD):
                self.world.at(self.sharing.random.uniform(0.0, 1.0), partial(self._ask, self.sharing.flood))
            self._again(0.5, self._hold_the_line)
        self._again(20.0, self._change_polls)
        if mix.reconnects:
            self._again(mix.reconnects, self._lose_the_port)
        if mix.deaths:
            self._again(mix.deaths, self._kill)
        if mix.doubled:
            self.line.on_doubled = self.judge.doubled
            self._again(mix.doubled, self.line.double_once)

    def _heal(self) -> None:
        """R11, R13: whatever happened, everything goes well again within a bound."""
        world = self.world
        self.note("all faults heal")
        self._healed = True
        self.line.faults = Faults()
        self.line.edges = None
        self.line.second = self.line.twice = 0.0
        if isinstance(world, StandingWorld):
            world.heal()
        self.line.restore(world.now)
        prompt = Delay(*PROMPT)
        for device in self.devices:
            device.faults = Faults()
            device.delay = prompt
            self.kind.slow_down(device, prompt)
        if self.line.echo is not None:
            self.line.echo = Echo()
        world.plug()
        for poll in self.polls[1:]:
            world.arbiter.remove_poll(poll, world.now)
        self.polls = self.polls[:1]
        begun, cycles = world.now, self.polls[0].cycles
        if not world.run_until(lambda: self._all_well(cycles), RECOVERY):
            states = ", ".join(f"{node.label} {node.health.value}" for node in self.nodes)
            errors = [read.error for read in self.polls[0].results if read.error is not None]
            self.judge.problem(f"no progress {RECOVERY:g} s after all faults had healed: {states}; {errors}")
        self.totals.recovery = world.now - begun

    def _all_well(self, cycles: int) -> bool:
        """No request of before is open, all nodes are up, and a later cycle of the first poll than that was good."""
        poll = self.polls[0]
        polled = poll.cycles > cycles + 1 and not poll.running and all(read.error is None for read in poll.results)
        return polled and not self.open and all(node.health is Health.UP for node in self.nodes)

    def _close(self) -> None:
        """R8: requests are in it, and each ends."""
        world = self.world
        for node in self.nodes:
            for priority in Priority:
                self._submit(node, self.random.choice(self.reads), Asked(), priority)
        world.run(world.now + self.random.uniform(0.0, 0.1))
        world.arbiter.close(world.now)
        world.run(world.now + 10.0)
        if world.arbiter.state is not LineState.OFFLINE:
            self.judge.problem(f"R8: closed, and the line is still {world.arbiter.state.name}")

    # clients

    def _ask(self, client: int) -> None:
        """One request of a client, who asks the next one when it has ended."""
        if self._healed:
            return
        chance = self.random
        node = chance.choice(self.nodes)
        asked = Asked(client)
        options: dict[str, Any] = {}
        if chance.random() < self.mix.writes:
            command, node = self._write(node, asked, options)
        else:
            command = chance.choice(self.reads)
        if chance.random() < 0.1:
            options["start_by"] = self.world.now + chance.uniform(0.0, 0.5)
        if chance.random() < 0.1:
            options["retries"] = 0 if command.writes and not command.idempotent else chance.randrange(0, 4)
        priority = chance.choices(tuple(Priority), (1, 7, 1, 1))[0]
        transaction = self._submit(node, command, asked, priority, **options)
        if chance.random() < self.mix.cancel:
            self.world.at(
                self.world.now + chance.expovariate(1 / self.kind.max_reply_delay), partial(self._leave, transaction)
            )

    def _write(self, node: NodeRecord, asked: Asked, options: dict[str, Any]) -> tuple[Command[Any], NodeRecord]:
        chance = self.random
        number = self.ledger.number()
        repeat = chance.random() < 0.3
        command = self.kind.write(chance, number, repeat)
        options["idempotent"] = repeat
        if self.everybody is not None and chance.random() < 0.1:
            node = self.everybody
        asked.written = self.ledger.sending(
            number,
            None if node is self.everybody else node.address,
            elements_of(command),
            None if self.sharing is None else asked.then or self.sharing.client_of(asked.client),
        )
        return command, node

    def _submit(
        self, node: NodeRecord, command: Command[Any], asked: Asked, priority: Priority, **options: Any
    ) -> Transaction:
        asked.elements = elements_of(command)
        backlog = self.world.arbiter.dispatcher.backlog
        if self.sharing is None:
            asked.urgent_ahead = backlog.waiting(Priority.URGENT)
        else:
            client = options.setdefault("client", self.sharing.client_of(asked.client))
            asked.urgent_ahead = backlog.waiting_of(Priority.URGENT, client)
            asked.rivals = len(self.sharing.clients) - 1
        transaction = Transaction(node, command, priority=priority, tag=asked, **options)
        self.open[transaction] = None
        if self._record is not None:
            self.note(f"asked: {node.label}: {command} ({priority.name})")
        self.world.arbiter.submit(transaction, self.world.now)
        return transaction

    def _hold_the_line(self) -> None:
        """A program writes and reads back, perhaps again, with pauses; it may go away in the middle of it."""
        assert self.sharing is not None
        own, node = self.sharing.random, self.sharing.random.choice(self.nodes)
        hold = self.sharing.hold(node)
        steps = own.randrange(2, 5)

        def step(left: int) -> None:
            if not left or hold.over or self._healed:
                self.sharing_ends(hold)
                return
            asked = Asked(then=lambda ended: ends(ended, left))
            options: dict[str, Any] = {"client": hold}
            if left % 2 == steps % 2:
                command, to = self._write(node, asked, options)
            else:
                command, to = own.choice(self.reads), node
            if to is not node:
                self.sharing_ends(hold)
                return
            transaction = self._submit(node, command, asked, Priority.COMMAND, **options)
            if own.random() < 0.05:
                self.world.at(self.world.now + own.uniform(0.0, 0.2), partial(leave, transaction))

        def ends(ended: Transaction, left: int) -> None:
            if ended.error is not None:
                self.sharing_ends(hold)
            else:
                pause = own.choice((0.0, 0.0, own.uniform(0.0, 0.2)))
                self.world.at(self.world.now + pause, partial(step, left - 1))

        def leave(transaction: Transaction) -> None:
            if transaction in self.open:
                self._leave(transaction)
                self.sharing_ends(hold)

        step(steps)

    def sharing_ends(self, hold: Hold) -> None:
        """A sequence lets go of the line."""
        assert self.sharing is not None
        self.sharing.released(hold)
        self.world.arbiter.release(hold, self.world.now)

    def _leave(self, transaction: Transaction) -> None:
        if transaction in self.open:
            del self.open[transaction]
            self.note(f"cancelled: {transaction.node.label}: {transaction.command}")
            self.judge.left(transaction)
            self.world.arbiter.cancel(transaction, self.world.now)
            if transaction.tag.client >= 0:
                self._ask(transaction.tag.client)

    # what the master says

    def _on_event(self, event: Event) -> None:
        match event:
            case Transaction() as transaction:
                self._completed(transaction)
            case Polled(poll):
                self.judge.polled(poll)
            case NodeChanged():
                self.judge.changed(event)
            case MaxReplyDelayRaised():
                self.totals.raised += 1

    def _completed(self, transaction: Transaction) -> None:
        self.judge.ended(transaction)
        if transaction.probe:
            return
        if transaction not in self.open:
            self.judge.problem(f"R8: {transaction.command} ended twice, or for a caller who had gone")
            return
        del self.open[transaction]
        client = transaction.tag.client
        if transaction.tag.then is not None:
            transaction.tag.then(transaction)
        if client < 0:
            return
        if transaction.attempts:
            self._ask(client)
        else:
            self.world.at(self.world.now + PAUSE, partial(self._ask, client))

    # what happens to it

    def _again(self, mean: float, action: Callable[[], None]) -> None:
        """Now and then, until the faults heal."""

        def act() -> None:
            if not self._healed:
                action()
                self.world.at(self.world.now + self.random.expovariate(1 / mean), act)

        self.world.at(self.world.now + self.random.expovariate(1 / mean), act)

    def _add_poll(self) -> None:
        """Its first group reads one element of each node: answers that could be taken for each other's."""
        chance, world = self.random, self.world
        reads = [chance.choice(self.reads)] * len(self.nodes)
        nodes = self.nodes
        if self.polls:
            reads = chance.choices(self.reads, k=chance.randrange(1, 7))
            nodes = chance.choices(self.nodes, k=len(reads))
        members = [
            Transaction(node, read, tag=Asked(elements=elements_of(read)))
            for node, read in zip(nodes, reads, strict=True)
        ]
        tau = self.kind.profile.line.byte_time
        cost = sum(line_time(member.command.open(1, member.node.timings), tau) for member in members)
        period = max(chance.choice(PERIODS), 2 * cost)
        poll = Poll(f"group {next(self._names)}", period, cost=cost)
        set_members(poll, members, chance.choice((Priority.POLL, Priority.POLL, Priority.BACKGROUND)))
        self.polls.append(poll)
        world.arbiter.add_poll(poll, world.now)

    def _change_polls(self) -> None:
        poll = self.random.choice(self.polls)
        if poll is not self.polls[0]:
            self.note(f"removed: {poll.name}")
            self.polls.remove(poll)
            self.world.arbiter.remove_poll(poll, self.world.now)
            self._add_poll()
        elif not poll.running:
            self.note(f"demanded: {poll.name}")
            self.judge.demanded(poll)
            self.world.arbiter.demand(poll, self.world.now)

    def _lose_the_port(self) -> None:
        world = self.world
        world.unplug()
        world.at(world.now, self._check_nothing_is_open)
        world.at(world.now + self.random.uniform(0.001, 1.0), world.plug)

    def _check_nothing_is_open(self) -> None:
        """R13: whatever waited has failed, so many at once."""
        if self.world.arbiter.failing:
            self.world.at(self.world.now + SOON, self._check_nothing_is_open)
        elif self.open:
            self.judge.problem(f"R13: {len(self.open)} requests are still open on a port that is gone")

    def _kill(self) -> None:
        """A device falls silent, or its wire breaks, for a while."""
        device = self.random.choice(self.devices)
        self.note(f"dies: {device!r}")
        if self.random.random() < 0.5:
            device.faults.dead = 1.0
        else:
            self.line.cut(self.world.now, device)
        self.world.at(self.world.now + self.random.uniform(0.2, 10.0), self._revive)

    def _revive(self) -> None:
        self.note("all revive")
        self.line.restore(self.world.now)
        for device in self.devices:
            device.faults.dead = 0.0
