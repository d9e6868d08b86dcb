"""A bus: the object that owns one line."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine, Iterable, Mapping, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, TypeVar

import anyio
import anyio._backends._asyncio  # now, not when a line runs: it takes 30 ms

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.counters import LineState, LineStatistics
from busmaster.arbiter.events import CameUnexpected, LineChange, LineChanged, NodeChanged, PortFailed
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.schedule import SLICE
from busmaster.arbiter.tap import Tap
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.bus.alarms import AlarmChanged, Alarms, BusEvent
from busmaster.bus.condition import LineCondition
from busmaster.bus.node import Node
from busmaster.bus.outlook import Outlook
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup, Sample, Stream
from busmaster.bus.reads_after_writes import ReadsAfterWrites
from busmaster.bus.requester import checked_priority, checked_retries
from busmaster.bus.shared_line import SharedLine, running_loop
from busmaster.bus.suitability import check_company, check_settings
from busmaster.bus.taps import Taps
from busmaster.contract.arguments import seconds, whole_number
from busmaster.contract.learning import Learned
from busmaster.contract.profile import Profile
from busmaster.contract.timing import Timings
from busmaster.errors import BusError, InvalidCommand, LineDown
from busmaster.planning import Plan, PlannedGroup
from busmaster.planning.merging import Merge, at_once
from busmaster.transport.endpoints import Endpoint, is_paced
from busmaster.transport.pump import Pump
from busmaster.transport.reconnect import Connection

T = TypeVar("T")

BYTE_TIME_UNTIL_KNOWN = 10 / 9600
EVENT_BUFFER = 256
MOST_CAPACITY = 1_000_000


class Bus:
    """One line and everything on it. Use it in `async with`: entering opens the port, leaving closes it.

    `capacity` bounds the requests that may wait in each priority class (R12). `seed` makes the jitter of probes and
    reconnects repeatable. `tap` sees every byte (see busmaster.capture). `strict`: an answer that could be another
    request's is held until that one would have come (R15), at about a third of the line's rate. Entering raises
    LineDown if the port cannot be opened, or, with `wait_for_port`, goes on as after a loss; once open, a lost port
    fails its callers at once and is opened again by itself, as soon as the same device is back (R13); `events` tells
    of attempts that fail.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        *,
        capacity: int = 1000,
        seed: int | None = None,
        tap: Tap | None = None,
        strict: bool = False,
        wait_for_port: bool = False,
    ) -> None:
        capacity = whole_number(capacity, 1, MOST_CAPACITY, "a bus's capacity")
        if isinstance(endpoint, str):
            raise InvalidCommand(
                f"a bus needs an endpoint, not text: Bus(endpoint({endpoint!r})), or SerialPort, TcpPort, Rfc2217Port"
            )
        self.endpoint = endpoint
        self._wait_for_port = wait_for_port
        # Only probes are spread by it. A seed makes a test run repeatable.
        self._random = random.Random(seed)
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
        self._arbiter.name = endpoint.name
        self._line = line = SharedLine(endpoint.name, self._arbiter)
        line.alarms = Alarms(self._on_event)
        self._pump = line.pump = Pump(
            self._arbiter,
            on_sample=lambda poll, transaction: poll.group.sampled(transaction),
            on_cycle=lambda poll: poll.group.cycle_finished(),
            on_event=self._on_event,
            on_written=self._on_written,
            paced=lambda transport: is_paced(endpoint, transport),
            name=endpoint.name,
        )
        self._taps = Taps(self._pump, tap)
        self._nodes: dict[tuple[str, int], Node] = {}
        self._profiles: dict[str, Profile] = {}
        """Of the protocols on this line, by name."""
        self._groups: dict[str, PollGroup] = {}
        self._reads_after_writes = ReadsAfterWrites(line, self._groups, self._start)
        """Counts of the reads of points with `read_after_write`."""
        line.on_touched.append(self._on_touched)
        self._outlook = Outlook(line, endpoint, self._nodes, self._groups)
        self._streams: list[Stream[BusEvent]] = []
        self._tasks: set[asyncio.Task[None]] = set()
        self._connection: Connection | None = None

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
        self._line.bind(loop)
        # Time that passed before the bus was entered is not time of the line.
        self._arbiter.reset_statistics(self.now())
        connection = Connection(self.endpoint, self._pump, on_failed=self._on_failed, jitter=self._random)
        self._connection = connection
        try:
            await (connection.try_open() if self._wait_for_port else connection.open())
        except BaseException as error:
            # Everything is undone, so that the same bus can be entered again when the port is back.
            self._line.unbind()
            await connection.close()
            self._pump.stop()
            if isinstance(error, BusError):
                error.line = self.endpoint.name
            raise
        self._start(connection.run())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the bus: waiting callers get BusClosed at once; the exchange on the wire may end, in its own window."""
        self._check_loop()
        # First of all, so that callbacks of the groups that end cannot start a new request.
        self._line.closed = True
        for group in self.groups:
            group.close()
        # At once: what waits fails now, and only the exchange on the wire runs out.
        self._arbiter.close(self.now())
        self._pump.turn()
        with anyio.CancelScope(shield=True):  # Task.cancel() comes through all the same
            try:
                await self._pump.run_out()
            finally:
                await self._let_go()  # when cancelled too: the port would stay open and be opened again for ever

    async def _let_go(self) -> None:
        """Close the port, as nothing is on the wire, or nobody waits for its end."""
        assert self._connection is not None
        self._line.unbind()
        try:
            await self._connection.close()
        finally:
            self._pump.turn()
            self._pump.stop()
            for stream in list(self._streams):
                stream.close()
            for task in self._tasks:
                task.cancel()
        # Hooks of the application are cancelled, and their errors belong to the log, not to whoever closes the bus.
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _accept_device(self) -> None:
        """Let the next opening take whatever device has the port's name then, as if the program were started again.

        Without it, only the device that the line was opened on is opened again. A port that is named by a serial
        number (usb:SERIAL) never takes another one. A connection that is up stays as it is.
        """
        if self._connection is not None:
            self._connection.accept_device()

    def _take_only_safe_writes(self) -> Callable[[], None]:
        """End every write that waits as Superseded, and accept none from now on but those that say `safe=True`.

        A write that is on the wire runs out, and is not repeated. Reads and polls go on. What is returned,
        called once, takes writes again: not on a line that is about to be left.
        """
        self._check_loop()
        self._line.only_safe += 1
        self._arbiter.supersede_writes(self.now())
        self._pump.turn()
        return self._line.take_writes_again

    # nodes and groups

    def node(
        self, profile: Profile, address: int, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> Node:
        """Return the node at this address: a protocol and an address are one node, however often it is asked for.

        Raises InvalidCommand for an address that the protocol does not have; for a protocol that cannot share the line
        with those that are on it; and for another profile, timings or retries than the node was first asked with. What
        is None was left open.
        """
        node = self._find_or_add(profile, address, timings, retries)
        node._kept = True
        return node

    def _lend_node(
        self,
        profile: Profile,
        address: int,
        *,
        timings: Timings | Learned | None = None,
        retries: int | None = None,
        budgeted: bool = False,
    ) -> Node:
        """Return the node as `node` does, for somebody who will give it back.

        One that was only ever lent leaves the bus when all who borrowed it have given it back. `budgeted`: if the node
        is new, until its first reply it is asked within the budget of probes only (R11), as a node that is down is.
        """
        node = self._find_or_add(profile, address, timings, retries)
        # A node that the owner or another client uses has proved itself; only a new one is limited.
        if budgeted and not (node._kept or node._borrowers):
            self._arbiter.ask_within_budget(node._record, self.now())
        node._borrowers += 1
        return node

    def _has_node(self, profile: Profile, address: int) -> bool:
        """Return whether the node at this address is on the line."""
        return (profile.name, address) in self._nodes

    def _give_back(self, node: Node) -> None:
        """Take back a node that was lent: nothing of it is polled or asked any more by whoever gives it back."""
        node._borrowers -= 1
        if not (node._kept or node._borrowers):
            del self._nodes[node.profile.name, node.address]
            self._line.forget_node(node, node._record)
            if not any(other.profile.name == node.profile.name for other in self._nodes.values()):
                del self._profiles[node.profile.name]  # another protocol may be spoken on an empty line

    def _find_or_add(
        self, profile: Profile, address: int, timings: Timings | Learned | None, retries: int | None
    ) -> Node:
        self._check_loop()
        profile.check_address(address)
        if timings is not None and not isinstance(timings, Timings | Learned):
            raise InvalidCommand(f"{profile.label(address)}: timings are a Timings or LEARNED, not {timings!r}")
        if retries is not None:
            try:
                retries = checked_retries(retries)
            except InvalidCommand as bad:
                raise InvalidCommand(f"{profile.label(address)}: {bad}") from None
        # Two handles of one node must share its health, queue of writes and limits.
        known = self._nodes.get((profile.name, address))
        if known is not None:
            known._check_shared(profile, timings, retries)
            return known
        if profile.name not in self._profiles:
            # Checked once per protocol: nodes of the same one cannot disagree.
            check_company(profile, self._profiles.values())
            check_settings(profile, self.endpoint)
        if not self._byte_time_known:
            self._arbiter.byte_time = profile.line.byte_time
            self._byte_time_known = True
        node = Node(self._line, self._arbiter.add_node(profile, address, self.now(), timings, retries), timings)
        self._nodes[profile.name, address] = node
        self._profiles.setdefault(profile.name, profile)
        return node

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Return the nodes that are on the line, in the order in which they were first asked for."""
        return tuple(self._nodes.values())

    @property
    def groups(self) -> tuple[PollGroup, ...]:
        """Return the poll groups that run, or rest, in the order in which they were made."""
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
        client: LineClient | None = None,
    ) -> PollGroup:
        """Read `points` every `period` seconds, on a fixed grid, from now on (R10).

        `phase` (seconds, below the period) places the group on the grid; without it, it is placed where it meets the
        other groups least. `merge`: cheaper exchanges to opt in to, such as `protocols.mentor.merge_runs`, beside
        those that the nodes' profiles have; they are taken where they save line time, and no longer once refused.
        Hundreds of points or groups are worked out in slices while the line goes on, and start some milliseconds later.
        `client`, of `SharedLine.add_client`, is the program that pays for the line time; without it, this one does.
        Raises InvalidCommand for a name that is in use, and for times and priorities that are none.
        """
        self._check_loop()
        if self._line.closed or not self.running:
            raise self._line.not_open()
        period = seconds(period, f"poll group {name!r}: a period")
        if phase is not None:
            phase = seconds(phase, f"poll group {name!r}: a phase")
        priority = checked_priority(priority)
        if name in self._groups:
            raise InvalidCommand(f"there is a poll group {name!r} already")
        group = PollGroup(
            self._line,
            name,
            period,
            points,
            phase=phase,
            priority=priority,
            merge=merge,
            on_close=self._forget,
            client=client,
        )
        # After all checks: an error must not leave half a group behind.
        self._arbiter.add_poll(group.poll, self.now())
        self._groups[name] = group
        self._pump.turn()
        return group

    def latest(self, point: Point[T]) -> Sample[T] | None:
        """Return the youngest good sample of this point in any group, unless a write has made it stale."""
        return self._line.latest(point)

    # looking

    def now(self) -> float:
        """Return the time of the bus's clock, in seconds: all its times are of this clock."""
        return self._pump.clock()

    def wall_time(self) -> float:
        """Return the same moment as `now` in seconds since 1970, by the machine's clock."""
        return self.now() + self._line.wall_offset()

    @property
    def running(self) -> bool:
        """Return whether it is open, though its line may be down."""
        return self._line.running

    @property
    def _byte_time(self) -> float:
        """Return tau, the seconds per byte of this line."""
        return self._arbiter.byte_time

    @property
    def state(self) -> LineState:
        """Return what the line does: OFFLINE, READY, in an EXCHANGE, in the HOLDOFF between two, or RESYNCHRONISING."""
        return self._arbiter.state

    @property
    def condition(self) -> LineCondition:
        """Return whether the line is lost while the bus is open, since when, and why."""
        return self._line.condition

    @property
    def _lost_seconds(self) -> float:
        """Return for how long the line was lost since the bus was opened, in all."""
        return self._line.losses.seconds(self.now())

    def as_of_now(self, point: Point[T], sample: Sample[T]) -> Sample[T]:
        """Return a sample of a poll group with the quality that it has now: bad while the line is lost, stale after a
        write to what the point reads. `PollGroup.latest` has it as it was when its cycle ended."""
        return self._line.as_of_now(point, sample)

    def statistics(self) -> LineStatistics:
        """Return an immutable snapshot of the line's counts since it was opened or reset."""
        self._check_loop()
        return replace(self._arbiter.statistics(self.now()), driver=self._pump.driver_errors())

    def reset_statistics(self) -> None:
        """Start all counts of line, nodes and groups again."""
        self._check_loop()
        self._arbiter.reset_statistics(self.now())
        self._pump.reset_driver_errors()
        self._reads_after_writes.reset()
        for group in self._groups.values():
            group.reset_statistics()

    def plan(self, *more: PlannedGroup, could_merge: Sequence[Merge] = ()) -> Plan:
        """Calculate what becomes of the groups that run, and of `more`, by the reply times measured so far.

        It is calculated at once: with hundreds of points that takes some ten milliseconds, in which no line of this
        loop goes on. While a line runs, await `ext.plan_in_steps`.
        """
        self._check_loop()
        return at_once(self._outlook.plan_steps(more, could_merge))

    async def _plan_in_steps(self, *more: PlannedGroup, could_merge: Sequence[Merge] = ()) -> Plan:
        """Do what `plan` does, in steps of less than a millisecond between which exchanges go on."""
        self._check_loop()
        steps = self._outlook.plan_steps(more, could_merge)
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

        It calculates with what is polled, what waits already, every node's probe, each kind of command that was asked
        or polled so far, the programs that are connected, and the longest exclusive sequence that was begun; with nodes
        that are dead, late or trickling; not with a line that is never silent. Reply times that are learned do not
        shorten it: those of the document may come back at any moment.
        """
        self._check_loop()
        return self._outlook.worst_case_wait(checked_priority(priority))

    @property
    def alarms(self) -> Mapping[Point[Any], AlarmChanged | None]:
        """Return what each polled point with limits has left and is not back from; None for those within."""
        return self._line.alarms.states

    def _overheard(self, samples: Mapping[Point[Any], Sample[Any]]) -> None:
        """Take values that another master's requests have brought for what they begin and end of alarms."""
        self._line.alarms.look([point for point in samples if point.meaning.watched], samples)

    def events(self) -> Stream[BusEvent]:
        """Return a stream of what happens from now on.

        Line and nodes tell NodeChanged, LineChanged, PortFailed and others, what is polled tells AlarmChanged.
        """
        self._check_loop()
        self._check_not_closed()
        return Stream(self._streams, EVENT_BUFFER)

    def _check_loop(self) -> None:
        """Raise InvalidCommand where an open bus is used from another thread, or from another event loop."""
        self._line.check_loop()

    # inside

    def _check_not_closed(self) -> None:
        if self._line.closed:
            raise self._line.not_open()

    def _forget(self, group: PollGroup) -> None:
        if self._groups.get(group.name) is group:
            del self._groups[group.name]

    def _on_written(self, write: Transaction, when: float) -> None:
        self._line.touched(write, when)
        self._reads_after_writes.note(write, when)

    def _on_touched(self, record: NodeRecord, when: float) -> None:
        for group in self._groups.values():
            group.report_outdated(record, when)

    def _on_event(self, event: BusEvent) -> None:
        match event:
            case LineChanged(LineChange.DOWN, cause) | PortFailed(cause):
                self._line.losses.lost(self.now(), cause)
            case LineChanged(LineChange.UP):
                self._line.losses.found(self.now())
        if isinstance(event, NodeChanged):
            node = self._nodes.get((event.node.profile.name, event.node.address))
            if node is None or node._record is not event.node:
                return  # it was given back while it was asked something
            # A drive that was away may come back with other values: `max_step` must not trust the ones before.
            if event.after is Health.DOWN and self._line.limiter is not None:
                self._line.limiter.forget(node)
            if event.returning:
                self._start(self._run_hook(node))
        self._line.logbook.note(event, self.now())
        # Unexpected bytes can come thousands of times a second; they are counted and logged instead.
        if not isinstance(event, CameUnexpected):
            for stream in self._streams:
                stream.put(event)

    def _on_failed(self, cause: LineDown) -> None:
        self._arbiter.still_down(cause.what, cause.hint)
        self._on_event(PortFailed(cause.what, cause.hint, cause.__cause__))

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        """Start a task of the bus's own: a task group would tie entering and leaving the bus to one task."""
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _run_hook(self, node: Node) -> None:
        """Run a node's hook. One that fails must not take the bus down: the node's polls resume all the same.

        A node that comes back again while its hook still runs gets another run of it, after that one.
        """
        try:
            async with node._returning:
                if node.on_return is not None:
                    await node.on_return(node)
        except Exception as error:
            self._line.logbook.failed_hook(node.label, error)
        finally:
            self._arbiter.dispatcher.release_node(node._record)
