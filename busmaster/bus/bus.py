"""A bus: the object that owns one line."""

from __future__ import annotations

import asyncio
import random
import warnings
from collections.abc import Coroutine, Generator, Iterable, Sequence
from dataclasses import replace
from math import inf
from threading import current_thread, get_ident
from types import TracebackType
from typing import Any

import anyio
import anyio._backends._asyncio  # now, not when a line runs: it takes 30 ms

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.counters import LineStatistics
from busmaster.arbiter.events import Event, NodeChanged, PortFailed, Strayed
from busmaster.arbiter.health import Health
from busmaster.arbiter.schedule import SLICE, Poll
from busmaster.arbiter.state import LineState
from busmaster.arbiter.transaction import Phase, Priority, Transaction
from busmaster.bus.logbook import Logbook
from busmaster.bus.node import Node, checked_priority, checked_retries
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup, Sample, Stream
from busmaster.contract.arguments import seconds, whole_number
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.timing import Timings
from busmaster.errors import BusClosed, InvalidCommand, LineDown
from busmaster.planning import Plan, PlannedGroup, Read, bounds, plan_steps
from busmaster.planning.merging import Merge, at_once
from busmaster.transport.endpoints import Endpoint, is_paced
from busmaster.transport.pump import Pump, Tap
from busmaster.transport.reconnect import Connection
from busmaster.transport.serial_port import SerialPort

BYTE_TIME_UNTIL_KNOWN = 10 / 9600
EVENT_BUFFER = 256
MOST_CAPACITY = 1_000_000


class Bus:
    """One line and everything on it. Use it in `async with`: entering opens the port, leaving closes it.

    `capacity` bounds the requests that may wait in each priority class (R12). `seed` makes the jitter of probes and
    reconnects repeatable. `tap` sees every byte (see busmaster.capture). `strict`: an answer that could be another
    request's is held until that one would have come (R15), at the line time that the README gives. Entering raises
    LineDown if the port cannot be opened; once open, a lost port fails its callers at once and is opened again by
    itself, as soon as the same device is back (R13); `events` tells of attempts that fail.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        capacity: int = 1000,
        seed: int | None = None,
        tap: Tap | None = None,
        strict: bool = False,
    ) -> None:
        capacity = whole_number(capacity, 1, MOST_CAPACITY, "a bus's capacity")
        if isinstance(endpoint, str):
            raise InvalidCommand(
                f"a bus needs an endpoint, not text: Bus(endpoint({endpoint!r})), or SerialPort, TcpPort"
            )
        self.endpoint = endpoint
        self._random = random.Random(seed)
        self._logbook = Logbook(endpoint.name)
        settings = endpoint.settings
        self._byte_time_known = settings is not None
        self._arbiter = Arbiter(
            settings.byte_time if settings is not None else BYTE_TIME_UNTIL_KNOWN,
            echo=endpoint.echo,
            receive_latency=endpoint.receive_latency,
            capacity=capacity,
            jitter=self._random.random,
            strict=strict,
        )
        self.pump = Pump(
            self._arbiter,
            on_sample=lambda poll, transaction: poll.waiter.sampled(transaction),
            on_cycle=lambda poll: poll.waiter.cycle_finished(),
            on_event=self._on_event,
            on_written=lambda transaction: self.touched(transaction, transaction.ended_at),
            paced=lambda transport: is_paced(endpoint, transport),
            tap=tap,
            name=endpoint.name,
        )
        self._nodes: dict[tuple[str, int], Node] = {}
        self._groups: dict[str, PollGroup] = {}
        self._touched: dict[object, float] = {}
        self.last_touched = -inf
        """When the last write to anything ended."""
        self._streams: list[Stream[Event]] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._connection: Connection | None = None
        self._thread = 0
        self.running = False
        self._closed = False

    # opening and closing

    async def __aenter__(self) -> Bus:
        self._check_not_closed()
        if self.running:
            raise InvalidCommand(f"the bus on {self.endpoint.name} is open already: enter it once, and share it")
        loop = running_loop()
        if loop is None:  # awaited, and not by asyncio
            raise InvalidCommand(
                f"the bus on {self.endpoint.name} needs asyncio's event loop, which does not run here: "
                "run the program by asyncio.run, or by anyio.run with its asyncio backend, not by trio"
            )
        self._loop = loop
        self._thread = get_ident()
        self.pump.bind(self._loop)
        self._arbiter.reset_statistics(self.now())
        connection = Connection(self.endpoint, self.pump, on_failed=self._on_failed, jitter=self._random)
        self._connection = connection
        self.running = True
        try:
            await connection.open()
        except BaseException:
            self.running = False
            await connection.close()
            raise
        self._start(connection.run())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Waiting callers get BusClosed at once; the exchange on the wire may end, within its own window."""
        self.check_loop()
        self._closed = True
        for group in self.groups:
            group.close()
        self._arbiter.close(self.now())
        self.pump.turn()
        with anyio.CancelScope(shield=True):  # Task.cancel() comes through all the same
            try:
                await self.pump.run_out()
            finally:
                await self._let_go()

    async def _let_go(self) -> None:
        """Nothing is on the wire, or nobody waits for its end."""
        assert self._connection is not None
        self.running = False
        try:
            await self._connection.close()
        finally:
            self.pump.turn()
            self.pump.stop()
            for stream in list(self._streams):
                stream.close()
            for task in self._tasks:
                task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def accept_device(self) -> None:
        """Let the next opening take whatever device has the port's name then, as if the program were started again.

        Without it, only the device that the line was opened on is opened again. A port that is named by a serial
        number (usb:SERIAL) never takes another one. A connection that is up stays as it is.
        """
        if self._connection is not None:
            self._connection.accept_device()

    # nodes and groups

    def node(
        self, profile: Profile, address: int, *, timings: Timings | None = None, retries: int | None = None
    ) -> Node:
        """Return the node at this address: a protocol and an address are one node, however often it is asked for.

        Raises InvalidCommand for an address that the protocol does not have, and for another profile, timings or
        retries than it was first asked with; what is None was left open.
        """
        self.check_loop()
        profile.check_address(address)
        if timings is not None and not isinstance(timings, Timings):
            raise InvalidCommand(f"{profile.label(address)}: timings are a Timings, not {timings!r}")
        if retries is not None:
            retries = checked_retries(retries, profile.label(address))
        known = self._nodes.get((profile.name, address))
        if known is not None:
            known.check_shared(profile, timings, retries)
            return known
        self._check_framing(profile)
        node = Node(self, self._arbiter.add_node(profile, address, self.now(), timings, retries))
        node.record.waiter = node
        self._nodes[profile.name, address] = node
        return node

    @property
    def nodes(self) -> tuple[Node, ...]:
        return tuple(self._nodes.values())

    @property
    def groups(self) -> tuple[PollGroup, ...]:
        return tuple(self._groups.values())

    def poll_group(
        self,
        name: str,
        *,
        period: float,
        points: Iterable[Point[Any]],
        phase: float | None = None,
        priority: Priority = Priority.POLL,
        merge: Sequence[Merge] = (),
    ) -> PollGroup:
        """Read `points` every `period` seconds, on a fixed grid, from now on (R10).

        `phase` (seconds, below the period) places the group on the grid; without it, it is placed where it meets the
        other groups least. `merge`: cheaper exchanges to opt in to, such as `protocols.mentor.merge_runs`, beside
        those that the nodes' profiles have; they are taken where they save line time, and no longer once refused.
        Hundreds of points or groups are worked out in slices while the line goes on, and start some milliseconds later.
        Raises InvalidCommand for a name that is in use, and for times and priorities that are none.
        """
        self.check_loop()
        if self._closed or not self.running:
            raise self.not_open()
        period = seconds(period, f"poll group {name!r}: a period")
        if phase is not None:
            phase = seconds(phase, f"poll group {name!r}: a phase")
        priority = checked_priority(priority)
        if name in self._groups:
            raise InvalidCommand(f"there is a poll group {name!r} already")
        group = PollGroup(self, name, period, points, phase=phase, priority=priority, merge=merge)
        self._arbiter.add_poll(group.poll, self.now())
        self._groups[name] = group
        self.pump.turn()
        return group

    def remove_group(self, group: PollGroup) -> None:
        """Do what `PollGroup.close` does: its polls end, and what they have on the wire goes unheard."""
        self.check_loop()
        if self._groups.get(group.name) is group:
            del self._groups[group.name]
            self._arbiter.remove_poll(group.poll, self.now())
            self.pump.turn()

    def prepare(self, poll: Poll) -> None:
        """Do what a poll group's new preparation says, while the line goes on."""
        self._arbiter.dispatcher.prepare_poll(poll, self.now())
        self.pump.turn()

    def failed_choice(self, group: str, error: Exception) -> None:
        """Log that a group's exchanges could not be chosen."""
        self._logbook.failed_choice(group, error)

    def demand(self, poll: Poll) -> None:
        """Do what `PollGroup.demand` does."""
        self.check_loop()
        self._arbiter.demand(poll, self.now())
        self.pump.turn()

    def suspend(self, node: Node, seconds: float) -> None:
        """Do what `Node.suspend` does."""
        self.check_loop()
        self._arbiter.dispatcher.suspend(node.record, self.now() + seconds)
        self.pump.turn()

    def latest(self, point: Point[Any]) -> Sample | None:
        """Return the youngest good sample of this point in any group, unless a write has made it stale."""
        youngest = None
        for group in self._groups.values():
            sample = None if group.latest is None else group.latest.samples.get(point)
            if sample is None or sample.error is not None or sample.started is None:
                continue
            if (youngest is None or sample.finished > youngest.finished) and not self.is_stale(point, sample.started):
                youngest = sample
        return youngest

    def touched(self, write: Transaction, when: float) -> None:
        """Note that a write is over: what was asked before is not newer than what it changed."""
        node = write.node
        if isinstance(node.waiter, Node):
            node.waiter.touched = when
        if node.address == node.profile.broadcast:
            for other in self._nodes.values():
                other.touched = self._touched[other] = when
        self._touched[write.touches] = self.last_touched = when

    def is_stale(self, point: Point[Any], started: float) -> bool:
        """Return whether a write to the point's quantity, or to all of its node, has ended since its read began."""
        touched = self._touched
        return max(touched.get(point.quantity, -inf), touched.get(point.node, -inf)) > started

    # looking

    def now(self) -> float:
        """Return the time of the bus's clock, in seconds: all its times are of this clock."""
        return self.pump.clock()

    @property
    def byte_time(self) -> float:
        """Return tau, the seconds per byte of this line."""
        return self._arbiter.byte_time

    @property
    def state(self) -> LineState:
        return self._arbiter.state

    def statistics(self) -> LineStatistics:
        """Return an immutable snapshot of the line's counts since it was opened or reset."""
        self.check_loop()
        return replace(self._arbiter.statistics(self.now()), driver=self.pump.driver_errors())

    def reset_statistics(self) -> None:
        """Start all counts of line, nodes and groups again."""
        self.check_loop()
        self._arbiter.reset_statistics(self.now())
        self.pump.reset_driver_errors()
        for group in self._groups.values():
            group.reset_statistics()

    def plan(self, *more: PlannedGroup, could_merge: Sequence[Merge] = ()) -> Plan:
        """Reckon what becomes of the groups that run, and of `more`, by the reply times measured so far.

        It is reckoned at once: with hundreds of points that takes some ten milliseconds, in which no line of this
        loop goes on. While a line runs, await `plan_in_steps`.
        """
        self.check_loop()
        return at_once(self._planning(more, could_merge))

    async def plan_in_steps(self, *more: PlannedGroup, could_merge: Sequence[Merge] = ()) -> Plan:
        """Do what `plan` does, in steps of less than a millisecond between which exchanges go on."""
        self.check_loop()
        steps = self._planning(more, could_merge)
        done = 0
        while True:
            try:
                done += next(steps)
            except StopIteration as end:
                plan: Plan = end.value
                return plan
            if done >= SLICE:
                done = 0
                await asyncio.sleep(0)

    def worst_case_wait(self, priority: Priority = Priority.COMMAND) -> float:
        """Return how long, in seconds, a request of this class, made now, waits at most until it is sent (R9).

        It reckons with what is polled, what waits already, every node's probe, and each kind of command that was
        asked or polled so far; with nodes that are dead, late or trickling; not with a line that is never silent.
        """
        self.check_loop()
        priority = checked_priority(priority)
        backlog = self._arbiter.dispatcher.backlog
        polls = self._arbiter.dispatcher.schedule.polls
        polled = sum(len(poll.results) for poll in polls)
        low = sum(len(poll.results) for poll in polls if poll.priority is Priority.BACKGROUND)
        probed = any(node.health is not Health.UP for node in self._nodes.values())
        bound = bounds(
            self._asked(),
            self.byte_time,
            self.endpoint.receive_latency,
            polls=1 + max(polled - low, backlog.waiting(Priority.POLL)),
            background=probed + max(low, backlog.waiting(Priority.BACKGROUND)),
        )
        parked = sum(write.phase is Phase.PARKED for node in self._nodes.values() for write in node.record.writes)
        longest = max((poll.patience for poll in polls if poll.results), default=1.0)
        return bound.wait(priority, ahead=backlog.waiting(priority) + parked, patience=longest)

    def events(self) -> Stream[Event]:
        """Return a stream of what happens to line and nodes from now on (NodeChanged, LineChanged, PortFailed, ...)."""
        self.check_loop()
        self._check_not_closed()
        return Stream(self._streams, EVENT_BUFFER)

    # misuse

    def check_loop(self) -> None:
        """Raise InvalidCommand where an open bus is used from another thread, or from another event loop."""
        if self.running and (get_ident() != self._thread or not self._loop.is_running()):
            self._check_elsewhere()

    def _check_elsewhere(self) -> None:
        """Its loop does not run here: right only in its own thread, between two runs of the loop."""
        if get_ident() != self._thread or running_loop() is not None:
            raise InvalidCommand(
                f"the bus on {self.endpoint.name} was used from thread {current_thread().name!r} outside the "
                "event loop that opened it: hand the call to that loop, with portal.call (anyio.from_thread) or "
                "asyncio.run_coroutine_threadsafe"
            )

    def not_open(self, *, node: str | None = None, command: str | None = None) -> BusClosed:
        """Return the error for what needs an open bus, before it is entered or after it was left."""
        if not self._closed:
            return BusClosed("the bus is not open", node=node, command=command)
        hint = "make a new Bus: one is opened and closed once"
        return BusClosed("the bus was closed", node=node, command=command, hint=hint)

    # inside

    def _check_not_closed(self) -> None:
        if self._closed:
            raise self.not_open()

    def _check_framing(self, profile: Profile) -> None:
        settings = self.endpoint.settings
        if settings is None:
            if not self._byte_time_known:
                self._arbiter.byte_time = profile.line.byte_time
                self._byte_time_known = True
        elif not isinstance(self.endpoint, SerialPort) or any(name == profile.name for name, _ in self._nodes):
            return
        elif settings.framing != profile.line.framing:
            warnings.warn(
                f"{profile.name} is meant for {profile.line.framing}, but {self.endpoint.name} is {settings.framing}",
                stacklevel=4,
            )

    def _on_event(self, event: Event) -> None:
        if isinstance(event, NodeChanged) and event.returning and isinstance(event.node.waiter, Node):
            self._start(self._run_hook(event.node.waiter))
        self._logbook.note(event, self.now())
        if not isinstance(event, Strayed):
            for stream in self._streams:
                stream.put(event)

    def _on_failed(self, cause: LineDown) -> None:
        self._on_event(PortFailed(cause.what, cause.hint, cause.__cause__))

    def _settings(self) -> LineSettings:
        if self.endpoint.settings is not None:
            return self.endpoint.settings
        return next((node.profile.line for node in self._nodes.values()), LineSettings(9600))

    def _asked(self) -> list[Read]:
        """Every kind of command that was asked of a node, once for all nodes with the same timings."""
        nodes = self._nodes.values()
        asked = {
            (id(node.record.profile), id(node.record.timings), kind): (node, command)
            for node in nodes
            for kind, command in node.kinds.items()
        }
        return [(node.planned(), command) for node, command in asked.values()]

    def _planning(self, more: Sequence[PlannedGroup], could_merge: Sequence[Merge]) -> Generator[int, None, Plan]:
        groups = []
        for group in self.groups:
            groups.append(group.planned())
            yield len(groups[-1].reads)
        latency = self.endpoint.receive_latency
        return (
            yield from plan_steps(
                [*groups, *more],
                line=self._settings(),
                receive_latency=latency,
                others=self._asked(),
                could_merge=could_merge,
            )
        )

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        """A task of the bus's own: a task group would tie entering and leaving the bus to one task."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _run_hook(self, node: Node) -> None:
        """A hook that fails must not take the bus down: the node's polls resume all the same.

        A node that comes back again while its hook still runs gets another run of it, after that one.
        """
        try:
            async with node.returning:
                if node.on_return is not None:
                    await node.on_return(node)
        except Exception as error:
            self._logbook.failed_hook(node.label, error)
        finally:
            self._arbiter.dispatcher.release_node(node.record)


def running_loop() -> asyncio.AbstractEventLoop | None:
    """Return the event loop of asyncio that runs in this thread, or None."""
    try:
        return asyncio.get_running_loop()
    except RuntimeError:
        return None
