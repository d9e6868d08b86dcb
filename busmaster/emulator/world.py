"""Arbiter, line and devices in virtual time, without an event loop: a day of a line in minutes, reproducible.

A world replaces the pump and the port: it passes bytes, time and events between an arbiter and a line. It does not
wait, read a clock or draw random numbers.
"""

from __future__ import annotations

import heapq
from collections.abc import Callable
from itertools import count
from typing import Any

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.events import Event, LineChanged, NodeChanged, Overdue
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.contract.exchange import Command
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.tap import Attempt, Tap
from busmaster.contract.timing import Timings
from busmaster.emulator.line import Line

FOREVER_STEPS = 100_000
"""Steps in one moment of time after which a world is thought to turn in circles."""


class StuckWorldError(RuntimeError):
    """Time does not advance: the arbiter or the line requests calls at the same moment again and again."""


class World:
    """One arbiter on one emulated line. `now` is its time, in seconds.

    `on_event` is called with each event of the arbiter; it may submit, cancel and so on. `record`, if given, is called
    with every step as a line of text: the same seeds give the same transcript.
    The port opens at once; `unplug` and `plug` take it away and give it back. `strict` is the arbiter's (R15); `tap`
    sees what passes, as on a bus.
    """

    def __init__(
        self,
        line: Line,
        *,
        on_event: Callable[[Event], None] | None = None,
        record: Callable[[str], None] | None = None,
        capacity: int = 1000,
        now: float = 0.0,
        jitter: Callable[[], float] = lambda: 0.5,
        strict: bool = False,
        tap: Tap | None = None,
    ) -> None:
        self.line = line
        line.prompt = False  # a world calls `receive` at each of its deadlines
        self.now = now
        self.plugged = False
        self.arbiter = Arbiter(
            line.settings.byte_time,
            now=now,
            echo=line.echo is not None,
            receive_latency=line.latency,
            capacity=capacity,
            jitter=jitter,
            strict=strict,
        )
        self.tap = tap
        if tap is not None:
            self.arbiter.set_tapped(True)
        self._on_event = on_event
        self._record = record
        self._actions: list[tuple[float, int, Callable[[], object]]] = []
        self._order = count()
        self.plug()

    # Requests and actions

    def node(
        self, profile: Profile, address: int, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> NodeRecord:
        """Add a node to the arbiter. Call it once per node."""
        return self.arbiter.add_node(profile, address, self.now, timings, retries)

    def request(
        self, node: NodeRecord, command: Command[Any], priority: Priority = Priority.COMMAND, **options: Any
    ) -> Transaction:
        """Submit a command now; `options` are those of Transaction. Its end comes as an event, perhaps at once."""
        transaction = Transaction(node, command, priority=priority, **options)
        self.arbiter.submit(transaction, self.now)
        return transaction

    def at(self, when: float, action: Callable[[], object]) -> None:
        """Call `action` at that time, after the events of the line and the arbiter at that time."""
        # Of two at one time the first goes first; the functions themselves have no order.
        heapq.heappush(self._actions, (max(when, self.now), next(self._order), action))

    def plug(self) -> None:
        """Bring the port (again)."""
        if not self.plugged:
            self.plugged = True
            self.line.receive(self.now)
            self.arbiter.line_up(self.now, paced=self.line.paced)

    def unplug(self, cause: str = "unplugged") -> None:
        """Remove the port. Bytes from the line are lost until it returns."""
        if self.plugged:
            self.plugged = False
            self.arbiter.line_down(cause, self.now)

    # Time

    def run(self, until: float) -> None:
        """Run to that time."""
        arbiter, line, actions = self.arbiter, self.line, self._actions
        steps = 0
        self._pump()
        while True:
            heard_at = line.next_event()
            due_at = arbiter.poll_timeout()
            now = heard_at if heard_at < due_at else due_at
            if actions and actions[0][0] < now:
                now = actions[0][0]
            if now > until:
                break
            if now > self.now:
                steps, self.now = 0, now
            else:
                steps += 1
                if steps > FOREVER_STEPS:
                    state = arbiter.state.name
                    raise StuckWorldError(f"at {self.now:.6f} s: line {heard_at}, arbiter {due_at} in {state}")
            self._step(self.now, due_at)
        self.now = max(self.now, until)

    def run_until(self, done: Callable[[], bool], limit: float) -> bool:
        """Run until `done()` is true, at most `limit` seconds. Returns True if it became true."""
        end = self.now + limit
        while not done():
            self._pump()
            following = min(self.line.next_event(), self.arbiter.poll_timeout())
            if self._actions:
                following = min(following, self._actions[0][0])
            if following > end:
                self.run(end)
                return done()
            self.run(max(following, self.now))
        return True

    def _step(self, now: float, due_at: float) -> None:
        data = self.line.receive(now)
        if data:
            self._hear(data)
        if due_at <= now:
            self.arbiter.handle_timeout(now)
            self._pump()
        actions = self._actions
        while actions and actions[0][0] <= now:
            heapq.heappop(actions)[2]()
            self._pump()

    def _hear(self, data: bytes) -> None:
        """Pass the bytes from the line to the arbiter."""
        if self.plugged:
            if self._record is not None:
                self._record(f"{self.now:.6f} < {data.hex(' ')}")
            if self.tap is not None:
                self.tap.received(self.now, data, self.arbiter.attempt)
            self.arbiter.data_received(data, self.now)
            self._pump()

    def _send(self, data: bytes) -> None:
        """Send the arbiter's bytes on the line."""
        if self._record is not None:
            self._record(f"{self.now:.6f} > {data.hex(' ')}")
        if self.plugged:
            self.line.send(data, self.now)
            if self.tap is not None:
                self.tap.transmitted(self.now, data, self.arbiter.attempt)

    def _pump(self) -> None:
        """Send the arbiter's bytes on the line, and report its events."""
        arbiter = self.arbiter
        while True:
            data = arbiter.poll_transmit()
            if data is not None:
                self._send(data)
            event = arbiter.poll_event()
            if event is None:
                if data is None:
                    return
                continue
            if type(event) is Attempt:
                if self.tap is not None:
                    self.tap.attempted(event)
                continue
            if self._record is not None:
                self._record(f"{self.now:.6f} {described(event)}")
            if self._on_event is not None:
                self._on_event(event)


def described(event: Event) -> str:
    """Return an event as one line of text, the same on every run."""
    match event:
        case Transaction():
            outcome = event.value if event.error is None else repr(event.error)
            return f"{event.node.label}: {event.command} -> {outcome}"
        case Overdue(transaction, error):
            return f"{transaction.node.label}: {transaction.command} -> {error!r}"
        case LineChanged(change, cause):
            return f"line {change.value} {cause}".rstrip()
        case NodeChanged(node, before, after):
            return f"{node.label}: {before.value} -> {after.value}"
    return type(event).__name__
