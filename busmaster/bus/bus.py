"""The bus: the object that owns one line."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Callable, Coroutine, Generator, Iterable, Mapping, Sequence
from dataclasses import replace
from types import TracebackType
from typing import Any, TypeVar

import anyio
import anyio._backends._asyncio  # imported here and not when a line runs: it takes 30 ms

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.clients import LineClient
from busmaster.arbiter.counters import LineState, LineStatistics
from busmaster.arbiter.events import CameUnexpected, LineChange, LineChanged, NodeChanged, PortFailed
from busmaster.arbiter.health import Health, NodeRecord
from busmaster.arbiter.schedule import SLICE
from busmaster.arbiter.transaction import Priority, Transaction
from busmaster.bus.alarms import AlarmChanged, Alarms, BusEvent
from busmaster.bus.bus_like import find_group
from busmaster.bus.condition import LineCondition
from busmaster.bus.node import Node
from busmaster.bus.points import Point
from busmaster.bus.polling import PollGroup, Sample, Stream
from busmaster.bus.reads_after_writes import ReadsAfterWrites
from busmaster.bus.requester import checked_priority, checked_retries
from busmaster.bus.shared_line import SharedLine, Taps, running_loop
from busmaster.bus.suitability import check_company, check_settings
from busmaster.contract.arguments import seconds, whole_number
from busmaster.contract.learning import Learned
from busmaster.contract.profile import LineSettings, Profile
from busmaster.contract.tap import Tap
from busmaster.contract.timing import Timings
from busmaster.errors import BusError, InvalidCommand, LineDown
from busmaster.planning import Plan, PlannedGroup, Read, bounds, plan_steps
from busmaster.planning.merging import Merge, at_once
from busmaster.transport.endpoints import Endpoint, is_paced
from busmaster.transport.pump import Pump
from busmaster.transport.reconnect import Connection

T = TypeVar("T")

BYTE_TIME_UNTIL_KNOWN = 10 / 9600
EVENT_BUFFER = 256
MOST_CAPACITY = 1_000_000


class Outlook:
    """The predictions for one bus: whether its polls fit the line, and how long a request can wait.

    `nodes` and `groups` are the bus's own and always current.
    """

    def __init__(
        self,
        line: SharedLine,
        endpoint: Endpoint,
        nodes: Mapping[tuple[str, int], Node],
        groups: Mapping[str, PollGroup],
    ) -> None:
        self._line = line
        self._endpoint = endpoint
        self._nodes = nodes
        self._groups = groups

    def plan_steps(self, more: Sequence[PlannedGroup], could_merge: Sequence[Merge]) -> Generator[int, None, Plan]:
        """Calculate the load of the groups and of `more`, as `planning.plan_steps` does."""
        groups = []
        # A copy: exchanges continue between two steps, and groups can be made and closed there.
        for group in tuple(self._groups.values()):
            groups.append(group.planned())
            yield len(groups[-1].reads)
        return (
            yield from plan_steps(
                [*groups, *more],
                line=self._settings(),
                receive_latency=self._delay(),
                others=self._asked(),
                could_merge=could_merge,
                sharing=self._line.sharing,
            )
        )

    def worst_case_wait(self, priority: Priority) -> float:
        """Return the longest time, in seconds, until a request of this class, made now, is sent (R9)."""
        arbiter = self._line.arbiter
        backlog = arbiter.dispatcher.backlog
        polls = arbiter.dispatcher.schedule.polls
        polled = sum(len(poll.results) for poll in polls)
        low = sum(len(poll.results) for poll in polls if poll.priority is Priority.BACKGROUND)
        probed = any(node.health is not Health.UP for node in self._nodes.values())
        bound = bounds(
            self._asked(),
            arbiter.byte_time,
            self._delay(),
            polls=1 + max(polled - low, backlog.waiting(Priority.POLL)),
            background=probed + max(low, backlog.waiting(Priority.BACKGROUND)),
            sharing=self._line.sharing,
        )
        longest = max((poll.patience for poll in polls if poll.results), default=1.0)
        return bound.wait(priority, ahead=self._line.ahead(priority), patience=longest)

    def _delay(self) -> float:
        """Return the seconds by which the port can delay an exchange."""
        # `send_delay` could be counted without its part in each silence, but R9's bound may only be too long.
        return self._endpoint.receive_latency + getattr(self._endpoint, "send_delay", 0.0)

    def _settings(self) -> LineSettings:
        if self._endpoint.settings is not None:
            return self._endpoint.settings
        return next((node.profile.line for node in self._nodes.values()), LineSettings(9600))

    def _asked(self) -> list[Read]:
        """Return each kind of command sent to a node, once for all nodes with the same timings."""
        asked = {
            (id(node._record.profile), id(node._record.timings), kind): (node, command)
            for node in self._nodes.values()
            for kind, command in node._kinds.items()
        }
        return [(node.planned(), command) for node, command in asked.values()]


class Bus:
    """One line and the nodes on it. Use it in `async with`: entering opens the port, leaving closes it.

    `capacity`: maximum number of queued requests per priority class (R12). `seed`: makes the jitter of probes and
    reconnects repeatable. `tap`: receives every byte (see busmaster.capture). `strict`: hold each ambiguous reply until
    the other possible reply would have arrived (R15), at about a third of the line's rate. `wait_for_port`: if the port
    cannot be opened, continue as after a loss; without it, entering raises LineDown.

    If an open port is lost, all requests fail at once. The port is reopened automatically when the same device is back
    (R13); `events` reports failed attempts.
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
        # The most frequent wrong call: without this, the error would be one about a missing attribute of str.
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
            # Behind a raw TCP port without a baud rate the first node's protocol decides (see `_find_or_add`).
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
            # The pump calls these within the turn in which the next request has left: they must be short and must not
            # raise.
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
        """The protocols on this line, by name."""
        self._groups: dict[str, PollGroup] = {}
        self._reads_after_writes = ReadsAfterWrites(line, self._groups, self._start)
        """Executes and counts the reads of points with `read_after_write`."""
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
        # None with trio, which anyio supports but asyncio's transports do not.
        loop = running_loop()
        if loop is None:  # a coroutine that runs without asyncio
            raise InvalidCommand(
                f"the bus on {self.endpoint.name} needs asyncio's event loop, which does not run here: "
                "run the program by asyncio.run, or by anyio.run with its asyncio backend, not by trio"
            )
        # Before the port is opened: the pump uses this loop's clock and timers as soon as the port is there.
        self._line.bind(loop)
        # The time before the bus was entered does not count as time of the line.
        self._arbiter.reset_statistics(self.now())
        connection = Connection(self.endpoint, self._pump, on_failed=self._on_failed, jitter=self._random)
        self._connection = connection
        try:
            await (connection.try_open() if self._wait_for_port else connection.open())
        except BaseException as error:
            # Also after a cancellation: `__aexit__` does not run if entering fails, so the port would stay open.
            # Everything is undone, so that the same bus can be entered again when the port is back.
            self._line.unbind()
            await connection.close()
            self._pump.stop()
            if isinstance(error, BusError):
                error.line = self.endpoint.name
            raise
        # Only after the first attempt: its error is raised here, while later ones are only reported as events.
        self._start(connection.run())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        """Close the bus: queued requests fail with BusClosed at once; the exchange on the wire may finish within its
        window."""
        self._check_loop()
        # First, so that callbacks of the closing groups cannot start a new request.
        self._line.closed = True
        # `groups` is a copy: each group that closes removes itself from the dict.
        for group in self.groups:
            group.close()
        # Queued requests fail now; only the exchange on the wire is finished.
        self._arbiter.close(self.now())
        self._pump.turn()
        # A bus is often left because a scope around it was cancelled, for example by a time limit. Without the shield,
        # the first `await` here would be cancelled too, and the exchange on the wire abandoned.
        with anyio.CancelScope(shield=True):  # Task.cancel() comes through all the same
            try:
                # R8: the reply that is still to come would reach the next master of this line.
                await self._pump.run_out()
            finally:
                await self._let_go()  # also after a cancellation, or the port would stay open and be reopened forever

    async def _let_go(self) -> None:
        """Close the port. Nothing is on the wire, or the wait for its end was cancelled."""
        assert self._connection is not None
        self._line.unbind()
        try:
            await self._connection.close()
        finally:
            # Whatever happens to this task: consumers of events would wait for ever, and the reconnecting would
            # continue.
            self._pump.turn()
            self._pump.stop()
            # A copy: a stream that is closed removes itself from the list.
            for stream in list(self._streams):
                stream.close()
            for task in self._tasks:
                task.cancel()
        # Hooks of the application are cancelled. Their errors belong in the log; the code that closes the bus did not
        # cause them.
        await asyncio.gather(*self._tasks, return_exceptions=True)

    def _accept_device(self) -> None:
        """Accept any device that has the port's name at the next opening, as after a restart of the program.

        By default only the device that the line was opened on is reopened. A port given by a serial number (usb:SERIAL)
        never accepts another one. An open connection is not affected.
        """
        # Before the first opening there is no device to forget: any device is accepted then.
        if self._connection is not None:
            self._connection.accept_device()

    def _take_only_safe_writes(self) -> Callable[[], None]:
        """Fail every queued write with Superseded, and accept only writes with `safe=True` from now on.

        A write on the wire is finished, and is not repeated. Reads and polls continue. Call the returned function once
        to accept all writes again; it is not needed on a line that will be closed.
        """
        self._check_loop()
        # Before the queued writes are failed: a caller that is woken by that may write again.
        self._line.only_safe += 1
        self._arbiter.supersede_writes(self.now())
        self._pump.turn()
        return self._line.take_writes_again

    # nodes and groups

    def node(
        self, profile: Profile, address: int, *, timings: Timings | Learned | None = None, retries: int | None = None
    ) -> Node:
        """Return the node at this address. Calls with the same protocol and address return the same node.

        Raises InvalidCommand for an address that the protocol does not have, and for a protocol that cannot share the
        line with those on it. Also if profile, timings or retries differ from those of the first call. None means not
        specified.
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
        """Return the node as `node` does, for a borrower that will give it back.

        A node that was only lent is removed when all borrowers have given it back. `budgeted`: requests to a new node
        use only the probe budget (R11) until its first reply, as for a node that is DOWN.
        """
        node = self._find_or_add(profile, address, timings, retries)
        # A node that the owner or another client uses has already replied; only a new one is limited.
        if budgeted and not (node._kept or node._borrowers):
            self._arbiter.ask_within_budget(node._record, self.now())
        node._borrowers += 1
        return node

    def _has_node(self, profile: Profile, address: int) -> bool:
        """Return True if the node at this address is on the line."""
        return (profile.name, address) in self._nodes

    def _give_back(self, node: Node) -> None:
        """Return a lent node. The borrower no longer polls it or sends requests to it."""
        node._borrowers -= 1
        if not (node._kept or node._borrowers):
            # Otherwise a client that names node after node would fill the line with probes (R11, R12).
            del self._nodes[node.profile.name, node.address]
            self._line.forget_node(node, node._record)
            if not any(other.profile.name == node.profile.name for other in self._nodes.values()):
                del self._profiles[node.profile.name]  # an empty line accepts another protocol

    def _find_or_add(
        self, profile: Profile, address: int, timings: Timings | Learned | None, retries: int | None
    ) -> Node:
        self._check_loop()
        # The arbiter checks the addresses of new nodes only. True and 5.0 would find the nodes 1 and 5 in the dict.
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
        node = Node(
            self._line,
            self._arbiter.add_node(profile.with_default_merge(), address, self.now(), timings, retries),
            timings,
        )
        self._nodes[profile.name, address] = node
        self._profiles.setdefault(profile.name, profile)
        return node

    @property
    def nodes(self) -> tuple[Node, ...]:
        """Return the nodes on the line, in the order in which they were added."""
        return tuple(self._nodes.values())

    @property
    def groups(self) -> tuple[PollGroup, ...]:
        """Return the poll groups, including paused ones, in the order in which they were made."""
        return tuple(self._groups.values())

    def group(self, name: str) -> PollGroup:
        """Return a poll group by its name. Raises InvalidCommand, with the names that exist, for another one."""
        return find_group(self.groups, name)

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
        """Read `points` every `period` seconds on a fixed grid (R10).

        `phase`: position on the grid, in seconds below the period; by default it is chosen for the least overlap with
        the other groups. `merge`: optional cheaper exchanges such as `protocols.mentor.merge_runs`, in addition to
        those of the nodes' profiles. They are used if they save line time, and no longer after a refusal. Hundreds of
        points or groups are prepared in slices while the line runs, and start some milliseconds later. `client` (from
        `SharedLine.add_client`) is charged for the line time; by default this program is.

        Raises InvalidCommand if the name is in use, and for invalid times and priorities.
        """
        self._check_loop()
        # A bus that is being closed is still running, until the exchange on the wire has ended.
        if self._line.closed or not self.running:
            raise self._line.not_open()
        period = seconds(period, f"poll group {name!r}: a period")
        if phase is not None:
            phase = seconds(phase, f"poll group {name!r}: a phase")
        priority = checked_priority(priority)
        if name in self._groups:
            raise InvalidCommand(f"a poll group {name!r} already exists")
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
        # After all checks: an error must not leave a partly created group behind.
        self._arbiter.add_poll(group.poll, self.now())
        self._groups[name] = group
        self._groups_changed()
        self._pump.turn()
        return group

    def latest(self, point: Point[T]) -> Sample[T] | None:
        """Return the newest good sample of this point in any group. None if a write has made it stale."""
        return self._line.latest(point)

    # looking

    def now(self) -> float:
        """Return the time of the bus's clock, in seconds. All times of the bus use this clock."""
        return self._pump.clock()

    def wall_time(self) -> float:
        """Return the current time in seconds since 1970, by the machine's clock."""
        return self._line.wall_offset() + self.now()

    @property
    def running(self) -> bool:
        """Return True while the bus is open, even if its line is down."""
        return self._line.running

    @property
    def _byte_time(self) -> float:
        """Return tau, the seconds per byte of this line."""
        return self._arbiter.byte_time

    @property
    def state(self) -> LineState:
        """Return the state of the line: OFFLINE, READY, EXCHANGE, HOLDOFF (between two exchanges) or
        RESYNCHRONISING."""
        return self._arbiter.state

    @property
    def condition(self) -> LineCondition:
        """Return whether the line is lost while the bus is open, since when, and why."""
        return self._line.condition

    @property
    def _lost_seconds(self) -> float:
        """Return the total time, in seconds, for which the line was lost since the bus was opened."""
        return self._line.losses.seconds(self.now())

    def as_of_now(self, point: Point[T], sample: Sample[T]) -> Sample[T]:
        """Return a poll group's sample with its current quality.

        It is bad while the line is lost, and stale after a write to its quantity. `PollGroup.latest` has the quality at
        the end of the cycle.
        """
        return self._line.as_of_now(point, sample)

    async def statistics(self) -> LineStatistics:
        """Return an immutable snapshot of the line's counters since it was opened or they were reset.

        A coroutine, as on a `RemoteBus`, which has to request them. On a `Bus` it never waits.
        """
        return self._statistics()

    def _statistics(self) -> LineStatistics:
        self._check_loop()
        return replace(self._arbiter.statistics(self.now()), driver=self._pump.driver_errors())

    def reset_statistics(self) -> None:
        """Reset all counters of the line, the nodes and the groups."""
        self._check_loop()
        self._arbiter.reset_statistics(self.now())
        self._pump.reset_driver_errors()
        self._reads_after_writes.reset()
        for group in self._groups.values():
            group.reset_statistics()

    async def plan(self, *more: PlannedGroup, could_merge: Sequence[Merge] = ()) -> Plan:
        """Calculate the load of the running groups and of `more`, with the reply times measured so far.

        It calculates in steps of less than a millisecond, between which exchanges continue. `could_merge`: merges to
        evaluate that no group has enabled.
        """
        return await self._plan_in_steps(more, could_merge)

    def _plan_at_once(self, more: Sequence[PlannedGroup], could_merge: Sequence[Merge] = ()) -> Plan:
        """Do what `plan` does, at once: with hundreds of points, no line of this loop goes on for tens of ms."""
        self._check_loop()
        return at_once(self._outlook.plan_steps(more, could_merge))

    async def _plan_in_steps(
        self, more: Sequence[PlannedGroup], could_merge: Sequence[Merge] = (), *, pause: float = 0.0
    ) -> Plan:
        """Calculate as `plan` does, with a pause, in seconds, between two steps."""
        self._check_loop()
        steps = self._outlook.plan_steps(more, could_merge)
        done = 0
        while True:
            try:
                done += next(steps)
            except StopIteration as end:
                plan: Plan = end.value
                return plan
            # 128 units of about a microsecond: a bus with hundreds of points calculates for tens of milliseconds.
            if done >= SLICE:
                done = 0
                await asyncio.sleep(pause)

    def worst_case_wait(self, priority: Priority = Priority.COMMAND) -> float:
        """Return the longest time, in seconds, until a request of this class, made now, is sent (R9).

        The calculation includes the polls, the queued requests, a probe of each node, and each kind of command sent so
        far. It also includes the connected programs, the longest exclusive sequence so far, and dead, late or slow
        nodes. It does not cover a line that is never silent. Learned reply times do not shorten it, because the
        documented times can be restored at any moment.
        """
        self._check_loop()
        return self._outlook.worst_case_wait(checked_priority(priority))

    @property
    def alarms(self) -> Mapping[Point[Any], AlarmChanged | None]:
        """Return the active alarm of each polled point with limits; None if the value is within its limits."""
        return self._line.alarms.states

    def _overheard(self, samples: Mapping[Point[Any], Sample[Any]]) -> None:
        """Evaluate alarms for values received by listening to another master."""
        self._line.alarms.look([point for point in samples if point.meaning.watched], samples)

    def events(self) -> Stream[BusEvent]:
        """Return a stream of events from now on.

        Line and nodes report NodeChanged, LineChanged, PortFailed and others; polled values report AlarmChanged.
        """
        self._check_loop()
        self._check_not_closed()
        return Stream(self._streams, EVENT_BUFFER)

    def _check_loop(self) -> None:
        """Raise InvalidCommand if an open bus is used from another thread or another event loop."""
        self._line.check_loop()

    # inside

    def _check_not_closed(self) -> None:
        if self._line.closed:
            raise self._line.not_open()

    def _forget(self, group: PollGroup) -> None:
        if self._groups.get(group.name) is group:
            del self._groups[group.name]
            self._groups_changed()

    def _groups_changed(self) -> None:
        for notify in self._line.on_groups:
            notify()

    def _on_written(self, write: Transaction, when: float) -> None:
        # In this order: only points that are already stale are read after the write.
        self._line.touched(write, when)
        self._reads_after_writes.note(write, when)

    def _on_touched(self, record: NodeRecord, when: float) -> None:
        for group in self._groups.values():
            group.report_outdated(record, when)

    def _on_event(self, event: BusEvent) -> None:
        match event:
            case LineChanged(LineChange.DOWN, cause) | PortFailed(cause):
                # Before the event is passed on, so that `condition` is right for consumers.
                self._line.losses.lost(self.now(), cause)
            case LineChanged(LineChange.UP):
                self._line.losses.found(self.now())
        if isinstance(event, NodeChanged):
            node = self._nodes.get((event.node.profile.name, event.node.address))
            if node is None or node._record is not event.node:
                return  # the node was given back during a request
            # A drive that was away may return with other values, so `max_step` must not use the earlier ones.
            if event.after is Health.DOWN and self._line.limiter is not None:
                self._line.limiter.forget(node)
            if event.returning:
                # In a task: this runs in the pump, where user code would delay the next request.
                self._start(self._run_hook(node))
        self._line.logbook.note(event, self.now())
        # Unexpected bytes can arrive thousands of times per second. They are counted and logged instead.
        if not isinstance(event, CameUnexpected):
            # Not a copy: `put` runs no code of the consumers, so none can close its stream here.
            for stream in self._streams:
                stream.put(event)

    def _on_failed(self, cause: LineDown) -> None:
        # Requests that fail from now on name the same cause as the log, and not how the port was lost originally.
        self._arbiter.still_down(cause.what, cause.hint)
        self._on_event(PortFailed(cause.what, cause.hint, cause.__cause__))

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        """Start a background task. A task group would tie entering and leaving the bus to the same task."""
        task = asyncio.ensure_future(work)
        # asyncio has only a weak reference to a task: without this one, it could be collected while it runs.
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _run_hook(self, node: Node) -> None:
        """Run a node's on_return hook. If it fails, the error is logged and the node's polls resume anyway.

        If the node returns again while its hook is running, the hook runs again afterwards.
        """
        try:
            # One hook at a time for each node: two of them would write the same parameters in any order.
            async with node._returning:
                if node.on_return is not None:
                    await node.on_return(node)
        except Exception as error:
            # A node that never polls again because of a bug in a hook would be worse than one without its parameters.
            self._line.logbook.failed_hook(node.label, error)
        finally:
            # Also after a failure or a cancellation: each return holds the polls, and only this call releases them.
            self._arbiter.dispatcher.release_node(node._record)
