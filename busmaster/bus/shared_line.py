"""State shared by the nodes and poll groups of one bus: the line, its clocks, and which values writes have made
stale."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Hashable
from math import inf
from threading import current_thread, get_ident
from typing import Any

from busmaster.arbiter.arbiter import Arbiter
from busmaster.arbiter.clients import Hold, LineClient
from busmaster.arbiter.counters import LineState
from busmaster.arbiter.health import NodeRecord
from busmaster.arbiter.transaction import Phase, Poll, Priority, Transaction
from busmaster.bus.alarms import Alarms
from busmaster.bus.answers import Answer, composed
from busmaster.bus.condition import PRESENT, LineCondition, LossLog
from busmaster.bus.limiter import Limiter
from busmaster.bus.logbook import Logbook
from busmaster.bus.points import Point
from busmaster.bus.requester import Requester
from busmaster.bus.samples import Quality, Sample
from busmaster.bus.snapshots import Snapshot
from busmaster.contract.places import Changing, Placed
from busmaster.contract.tap import Attempt, Tap
from busmaster.errors import BusClosed, GarbledReply, InvalidCommand
from busmaster.planning import Sharing
from busmaster.transport.clock import TimeOfDay
from busmaster.transport.pump import Pump

# Not None, which `running_loop` returns outside of a loop: a request there would pass the check for an open bus.
NO_LOOP = object()
"""In place of the event loop of a bus that is not open."""
running_loop = asyncio._get_running_loop
"""Return the event loop that runs in this thread, or None. One call of a C function: it runs for every request."""


class Taps:
    """The taps of one line: a recorder, or viewers of the traffic. They can be added and removed while it runs.

    An untapped line has no extra cost.
    """

    def __init__(self, pump: Pump, first: Tap | None = None) -> None:
        self._pump = pump
        self._taps: list[Tap] = []
        if first is not None:
            self.add(first)

    def add(self, tap: Tap) -> None:
        """Pass all traffic to `tap` from now on. Of the exchange on the wire it may see only the end."""
        self._taps.append(tap)
        # Only for the first and the last tap: the arbiter numbers the attempts while it is tapped.
        if len(self._taps) == 1:
            self._pump.arbiter.set_tapped(True)
        self._set()

    def remove(self, tap: Tap) -> None:
        """Pass no more traffic to `tap`."""
        self._taps.remove(tap)
        if not self._taps:
            self._pump.arbiter.set_tapped(False)
        self._set()

    def _set(self) -> None:
        match self._taps:
            case []:
                self._pump.tap = None
            case [tap]:
                self._pump.tap = tap
            case taps:
                self._pump.tap = _Several(tuple(taps))


class _Several:
    """Several taps as one."""

    def __init__(self, taps: tuple[Tap, ...]) -> None:
        self._taps = taps

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        for tap in self._taps:
            tap.transmitted(now, data, attempt)

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        for tap in self._taps:
            tap.received(now, data, attempt)

    def attempted(self, attempt: Attempt, /) -> None:
        for tap in self._taps:
            tap.attempted(attempt)


class SharedLine:
    """The line of one bus. `name` is its port's name."""

    def __init__(self, name: str, arbiter: Arbiter) -> None:
        self.name = name
        self.arbiter = arbiter
        self.pump: Pump
        self.alarms: Alarms
        self.logbook = Logbook(name)
        self.losses = LossLog()
        self.limiter: Limiter | None = None
        """None while no limit is set."""
        self.clients = 0
        """Number of other programs that share the line."""
        self.closed = False
        self.only_safe = 0
        """Number of callers that currently allow only writes of the safe state."""
        self.thread = 0
        """Thread of its event loop; 0 while the bus is not open."""
        self.loop: object = NO_LOOP
        """Its event loop while the bus is open."""
        self.on_stop: list[Callable[[NodeRecord], None]] = []
        """Called immediately when a node is stopped."""
        self.on_groups: list[Callable[[], None]] = []
        """Called when a poll group was added or has ended."""
        self.on_touched: list[Callable[[NodeRecord, float], None]] = []
        """Called immediately when a write has ended, with the node and the time."""
        self.latest_of: dict[str, Snapshot] = {}
        """The latest snapshot of each poll group, by the group's name."""
        self.answers_of: dict[str, list[Answer]] = {}
        """Replies of the last cycle, by the group's name."""
        self.last_touched = -inf
        """When the last write to any node ended."""
        self._all_touched = -inf
        # By node, (node, command) or (node, place), because not every write declares which values it changes.
        self._touched: dict[object, float] = {}
        self._written: dict[NodeRecord, float] = {}
        self._time_of_day = TimeOfDay(self.now)

    def take_writes_again(self) -> None:
        """Accept all writes again, unless another caller still allows only safe writes."""
        self.only_safe -= 1

    @property
    def running(self) -> bool:
        """True while the bus is open, even if its line is down."""
        return self.thread != 0

    def bind(self, loop: asyncio.AbstractEventLoop) -> None:
        """Open the bus: it is used from this thread and by this loop from now on."""
        self.pump.bind(loop)
        # With `wait_for_port` the bus can run for a long time before its port exists, and until then its values are bad
        # for this reason.
        self.losses.lost(self.now(), "its port is not open yet")
        # Last: other threads use the clock and the losses as soon as the bus is running.
        self.thread, self.loop = get_ident(), loop

    def unbind(self) -> None:
        """Mark the bus as not open."""
        self.thread, self.loop = 0, NO_LOOP

    # what holds now

    @property
    def condition(self) -> LineCondition:
        """Return whether the line is lost while the bus is open, since when, and why. Thread-safe."""
        # A bus that was never opened, or is closed, has lost nothing.
        lost = self.running and self.arbiter.state is LineState.OFFLINE
        return self.losses.condition if lost else PRESENT

    def as_of_now(self, point: Point[Any], sample: Sample[Any]) -> Sample[Any]:
        """Return a sample with its current quality, possibly long after it was read.

        While the line is lost it is bad, with the reason as its error. After a write to its quantity it is stale. Every
        consumer that shows a value later than its cycle uses this. Thread-safe.
        """
        # Its own error stays while the line is lost: it is the reason why this read failed.
        if sample.error is not None:
            return sample
        # Read once: this also runs in the threads of outputs, and the line can return between two reads.
        condition = self.condition
        if condition.is_lost:
            return sample._replace(value=None, error=condition.error, quality=Quality.BAD)
        if sample.quality.is_current and sample.started is not None and self.is_stale(point, sample.started):
            return sample._replace(quality=Quality.STALE)
        # The same object if nothing has changed: MQTT recognises changed values by that.
        return sample

    def is_outdated(self, point: Point[Any], asked: float) -> bool:
        """Return True if a good value requested at `asked` has been stale or bad at any time since."""
        return self.losses.condition.since > asked or self.is_stale(point, asked)

    # time

    def now(self) -> float:
        """Return the time of the bus's clock, in seconds. All times of the bus use this clock."""
        return self.pump.clock()

    def wall_offset(self) -> float:
        """Return the offset from the bus's clock to seconds since 1970, by the machine's clock."""
        return self._time_of_day.offset()

    # polls

    def prepare(self, poll: Poll) -> None:
        """Run the new preparation of a poll group while the line continues."""
        self.arbiter.dispatcher.prepare_poll(poll, self.now())
        self.pump.turn()

    def demand(self, poll: Poll) -> None:
        """Implement `PollGroup.demand`."""
        self.check_loop()
        # With `turn`, because the cycle would otherwise leave only with the next event of the line.
        self.arbiter.demand(poll, self.now())
        self.pump.turn()

    def remove_poll(self, poll: Poll) -> None:
        """Remove a poll. The reply of its exchange on the wire is ignored."""
        self.arbiter.remove_poll(poll, self.now())
        self.pump.turn()

    def latest(self, point: Point[Any]) -> Sample[Any] | None:
        """Return the newest good sample of this point in any group; None if it is stale or the line is lost."""
        if self.condition.is_lost:
            return None
        youngest = None
        for snapshot in self.latest_of.values():
            sample = snapshot.samples.get(point)
            # A failed read in one group must not hide the good value of another group.
            if sample is None or sample.error is not None or sample.started is None:
                continue
            if (youngest is None or sample.finished > youngest.finished) and not self.is_stale(point, sample.started):
                youngest = sample
        return youngest

    def held(self, node: NodeRecord, point: Point[Any]) -> Any:
        """Return the value that a point would have read last, whichever point or batch read it.

        None if it is not known, or may have been written since.
        """
        answers = [answer for cycle in self.answers_of.values() for answer in cycle if answer.node is point.node]
        # Each group has its own list: after sorting, the last match is the newest value.
        answers.sort(key=lambda answer: answer.started)
        found = [raw for one in answers if not self.is_stale(point, one.started) for raw in one.found(point.command)]
        # A write makes values stale by the name of the quantity. The same value may be read under another name, as part
        # of a batch.
        if not found:
            untouched = (one for one in answers if not self.written_since(node, one.started))
            found = composed(point.command, untouched, node.profile)
        try:
            return point.value_of(found[-1]) if found else None
        except GarbledReply:
            # Used for the audit log, as the value before a write: an error here must not prevent the write.
            return None

    # nodes

    def note_stop(self, record: NodeRecord) -> None:
        """Implement `Node.note_stop`."""
        self.arbiter.note_stop(record)
        for notify in self.on_stop:
            notify(record)

    def forget_node(self, node: Requester, record: NodeRecord) -> None:
        """Remove a node that is no longer used, and its state."""
        self.arbiter.remove_node(record)
        if self.limiter is not None:
            self.limiter.forget_node(node)
        # Clients can borrow one node after another: these tables would grow for ever (R12).
        self._written.pop(record, None)
        for touched in [what for what in self._touched if node in (what if isinstance(what, tuple) else (what,))]:
            del self._touched[touched]

    def add_client(self, share: float, owner_time: float = 0.0, user: Hashable = None) -> LineClient:
        """Return a client, a program with which this one takes turns from now on; see `LineClient`."""
        self.clients += 1
        return self.arbiter.add_client(share, owner_time, user)

    def remove_client(self, client: LineClient) -> None:
        """Remove a client: no further request is made for it."""
        self.clients -= 1
        self.arbiter.remove_client(client)

    @property
    def sharing(self) -> Sharing:
        """Return who shares the line, for the bounds of what a request waits."""
        return Sharing(self.clients, self.arbiter.longest_hold)

    def ahead(self, priority: Priority) -> int:
        """Return how many queued requests of this program go before another one of this class."""
        dispatcher = self.arbiter.dispatcher
        queues = dispatcher.writes.queues.values()
        # Parked writes are in no class queue, but go before a new request of this program.
        parked = sum(write.phase is Phase.PARKED and write.client is None for queue in queues for write in queue)
        return dispatcher.backlog.waiting_of(priority, None) + parked

    def release(self, hold: Hold) -> None:
        """End an exclusive sequence."""
        self.arbiter.release(hold, self.now())
        self.pump.turn()

    def suspend(self, record: NodeRecord, seconds: float) -> None:
        """Implement `Node.suspend`."""
        self.check_loop()
        self.arbiter.dispatcher.suspend(record, self.now() + seconds)
        self.pump.turn()

    def touched(self, write: Transaction, when: float) -> None:
        """Record that a write has ended: values requested before that time are not newer than the write."""
        self._touched[write.touches] = self._written[write.node] = self.last_touched = when
        if write.node.address == write.node.profile.broadcast:
            self._all_touched = when
        # A write that names no quantity has made the whole node stale already.
        if isinstance(write.touches, tuple) and isinstance(write.command, Changing):
            # the same place can have another name, or be read in another run
            for place in write.command.changes(write.node.profile):
                self._touched[write.touches[0], place] = when
        # Not isinstance: that would calculate the text of a `Rounding` twice, for every write.
        if text := getattr(write.command, "rounded", ""):
            self.logbook.rounded(write.node, text, self.now())
        # Last: the listeners query which values are stale now.
        for notify in self.on_touched:
            notify(write.node, when)

    def written_since(self, node: NodeRecord, started: float) -> bool:
        """Return True if a write to this node, or to a point of it, has ended since then."""
        return max(self._written.get(node, -inf), self._all_touched) > started

    def is_stale(self, point: Point[Any], started: float) -> bool:
        """Return True if a write to the point's quantity, or to its whole node, has ended since its read began."""
        touched = self._touched
        # By quantity: points with other names and scales read it too. A read that starts when the write ends is fresh.
        if max(touched.get(point.quantity, -inf), touched.get(point.node, -inf), self._all_touched) > started:
            return True
        places = point.command.places if isinstance(point.command, Placed) else ()
        return any(touched.get((point.node, place), -inf) > started for place in places)

    # misuse

    def check_loop(self) -> None:
        """Raise InvalidCommand if an open bus is used from another thread or another event loop."""
        # A bus that is not open has no thread: handles can be made before it is entered, by another thread too.
        if self.running and running_loop() is not self.loop:
            self._check_elsewhere()

    def _check_elsewhere(self) -> None:
        """Check a use while the loop is not running here: allowed only in its own thread, between two runs of the
        loop."""
        if get_ident() != self.thread or running_loop() is not None:
            raise InvalidCommand(
                f"the bus on {self.name} was used from thread {current_thread().name!r} outside the "
                "event loop that opened it: hand the call to that loop, with portal.call (anyio.from_thread) or "
                "asyncio.run_coroutine_threadsafe"
            )

    def not_open(self, *, record: NodeRecord | None = None, command: str | None = None) -> BusClosed:
        """Return the error for an operation that needs an open bus."""
        if not self.closed:
            error = BusClosed("the bus is not open", node=record, command=command)
        else:
            hint = "make a new Bus: one is opened and closed once"
            error = BusClosed("the bus was closed", node=record, command=command, hint=hint)
        error.line = self.name
        return error
