"""Latency and throughput of a line, as the application sees them: `bench` emulates one, `measure` takes an open bus.

    def test_reads_stay_within_their_budget():
        report = bench("hcp2", range(1, 33), virtual=True)
        report.check("p99=400", "urgent.p99=30", "errors=0", "missed=0")

`busmaster bench` is the same on the command line.
"""

from __future__ import annotations

import asyncio
import random
from array import array
from collections import Counter
from collections.abc import Awaitable, Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import count, cycle
from statistics import median
from typing import Any, TypeVar

from busmaster import Bus, Point, Priority, SerialPort, ext
from busmaster.contract.arguments import meant, seconds, whole_number
from busmaster.contract.exchange import Command
from busmaster.emulator.device import Delay
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import BusError, InvalidCommand, Refused
from busmaster.ext import Attempt, Handle, Verdict, find
from busmaster.testing.emulated_process import EmulatedLine, in_own_process
from busmaster.testing.latency_plot import check_plot, plot
from busmaster.testing.latency_report import (
    CYCLE,
    FIGURES,
    BenchReport,
    Budget,
    BudgetExceeded,
    Times,
    check_scope,
    histogram,
    ratios,
)
from busmaster.testing.virtual_time import VirtualTimeLoop

T = TypeVar("T")
MOST_CALLERS = 1000
"""As many requests as may wait in one class (R12)."""
LONGEST = 3600.0
"""Seconds of one run: each latency is kept for the percentiles, so that memory grows with it."""
PAUSE_AFTER_ERROR = 0.05
"""Seconds for which a caller waits after an error: a node that is down fails at once, and would be read in a spin."""
READS = 4
"""How many different reads a caller takes in turn, of the probe and the sync reads of the profile."""
GROUP = "bench"
"""The name of the poll group."""

Application = Callable[[Bus, "Stopwatch"], Awaitable[object]]
"""What an application does on the bus while it is measured. It is cancelled at the end."""


@dataclass(frozen=True, slots=True)
class Workload:
    """The load on a line, and its duration. Times are in seconds. Raises InvalidCommand for invalid values.

    Each of the `callers` reads again as soon as it has its value; None: one per node; 0: none. With `every`, each reads
    once per this many seconds, on a fixed grid. `priorities`: the classes of the reads, and their shares. With
    `period`, a poll group reads one value of each node in addition. `items`: the items to read; by default the probe
    and the sync reads of the protocol, which harm no node.
    """

    seconds: float = 10.0
    callers: int | None = None
    priorities: Mapping[Priority, int] = field(default_factory=lambda: {Priority.COMMAND: 1})
    every: float | None = None
    period: float | None = None
    items: tuple[str, ...] = ()
    seed: int = 1

    def __post_init__(self) -> None:
        if not 0 < seconds(self.seconds, "the time of a run") <= LONGEST:
            raise InvalidCommand(f"a run takes more than 0 s, and {LONGEST:g} s at most, not {self.seconds:g} s")
        for value, what in ((self.every, "every"), (self.period, "period")):
            if value is not None and not seconds(value, what) > 0:
                raise InvalidCommand(f"{what} is a time above 0 s, not {value:g}")
        if self.callers is not None:
            whole_number(self.callers, 0, MOST_CALLERS, "the number of callers")
        if not any(self.priorities.values()) or any(share < 0 for share in self.priorities.values()):
            raise InvalidCommand("each share of a priority is 0 or more, and one of them is above 0")

    def fields(self) -> dict[str, Any]:
        """Return the workload for JSON."""
        return {
            "seconds": self.seconds,
            "callers": self.callers,
            "priorities": {priority.name.lower(): share for priority, share in self.priorities.items()},
            "every": self.every,
            "period": self.period,
            "items": list(self.items),
            "seed": self.seed,
        }


def parse_priorities(text: str) -> dict[Priority, int]:
    """Return the classes, and how often each is drawn, of `command=8,urgent=1`; alone, a class counts once.

    Raises InvalidCommand.
    """
    known = {priority.name.lower(): priority for priority in Priority}
    shares: dict[Priority, int] = {}
    for part in text.split(","):
        name, equals, number = (piece.strip() for piece in part.partition("="))
        if name not in known:
            raise InvalidCommand(f"no such priority {name!r}; {meant(name, known)}")
        if equals and not number.isdecimal():
            raise InvalidCommand(f"a share is a whole number, as in {name}=8, not {part.strip()!r}")
        shares[known[name]] = int(number[:9]) if equals else 1
    return shares


class Stopwatch:
    """Times the calls of an application: `value = await stopwatch("position", axis.read(1))`."""

    def __init__(self, measurement: Measurement) -> None:
        self._measurement = measurement

    async def __call__(self, name: str, call: Awaitable[T]) -> T:
        """Await a call, record how long that took under a name, and return its value.

        An error is counted, and raised.
        """
        return await self._measurement.timed(name, call)


class Measurement:
    """One run on one bus. `report` can be called at any time, and after the run was cancelled too.

    `reply_delay` is the mean delay of the replies in seconds, if it is known; else the median that was observed
    counts. `known_reads`: every node answers the reads of the profile, so that a refusal is an error.
    """

    def __init__(
        self,
        bus: Bus,
        handles: Sequence[Handle],
        workload: Workload,
        *,
        application: Application | None = None,
        reply_delay: float | None = None,
        known_reads: bool = False,
        about: Mapping[str, Any] | None = None,
    ) -> None:
        if not handles:
            raise InvalidCommand("a bench needs at least one node")
        self.bus = bus
        self.workload = workload
        self._application = application
        self._known_reads = known_reads or bool(workload.items)
        self._about = dict(about or {})
        self._reads = {handle: reads_of(handle, workload.items) for handle in handles}
        self._wire = Wire(bus, reply_delay)
        self._names = [str(handle.node.address) for handle in handles]
        self._series: dict[tuple[str, str], tuple[array[float], array[float]]] = {}
        """By node (or "") and by class or call: when each value came, and its latency."""
        self._cycles: array[float] = array("d")
        self._missed = 0
        self._errors: Counter[str] = Counter()
        self._begun: float | None = None
        self._ended: float | None = None

    @property
    def begun(self) -> bool:
        """Return True if the measurement has begun: the bus is open, and each node was read once."""
        return self._begun is not None

    # measuring

    async def run(self) -> None:
        """Open the bus, measure for the duration of the workload, and close it. Raises LineDown if it cannot open."""
        async with self.bus:
            await self.run_open()

    async def run_open(self) -> None:
        """Measure on an open bus."""
        await self._warm_up()
        ext.add_tap(self.bus, self._wire)
        self._begun = begun = self.bus.now()
        until = begun + self.workload.seconds
        try:
            async with asyncio.TaskGroup() as tasks:
                beside = self._beside(tasks)
                callers = [tasks.create_task(self._call(*one, until)) for one in self._callers(begun)]
                await asyncio.sleep(self.workload.seconds)
                # A caller that has a read on its way waits for it: to leave it out would leave out the slowest ones.
                if callers:
                    await asyncio.wait(callers)
                self._ended = self.bus.now()
                for task in beside:
                    task.cancel()
        except BaseExceptionGroup as several:
            raise several.exceptions[0] from None  # the application's own error, as its caller expects it
        finally:
            self._ended = self.bus.now() if self._ended is None else self._ended
            ext.remove_tap(self.bus, self._wire)

    def _beside(self, tasks: asyncio.TaskGroup) -> list[asyncio.Task[None]]:
        """Start what runs beside the callers, until it is cancelled: the poll group, and the application."""
        beside = []
        if self.workload.period is not None:
            beside.append(tasks.create_task(self._poll(self.workload.period)))
        if self._application is not None:
            beside.append(tasks.create_task(self._apply(self._application)))
        return beside

    async def _warm_up(self) -> None:
        """Read everything once, uncounted; a read that a node refuses is left out, unless it refuses all."""
        for handle, reads in self._reads.items():
            refused = []
            for read in reads:
                try:
                    await handle.node.request(read)
                except Refused:
                    refused.append(read)
                except BusError:
                    break  # a missing node costs one read
            if not self._known_reads and 0 < len(refused) < len(reads):
                self._reads[handle] = [read for read in reads if read not in refused]

    def _callers(self, begun: float) -> Iterator[tuple[int, Sequence[Handle], float]]:
        """Yield each caller's number, its nodes, and when it begins.

        Callers are spread over the nodes, or nodes over the callers; callers with a period begin spread over it, like
        those of an application.
        """
        handles = list(self._reads)
        callers = len(handles) if self.workload.callers is None else self.workload.callers
        for number in range(callers):
            own = handles[number::callers] if callers < len(handles) else [handles[number % len(handles)]]
            yield number, own, begun + (self.workload.every or 0.0) * number / callers

    async def _call(self, number: int, handles: Sequence[Handle], due: float, until: float) -> None:
        """Read one value after another, the first when it is due, until the time is over."""
        workload, bus = self.workload, self.bus
        chance = random.Random(f"{workload.seed}/{number}")
        classes, shares = list(workload.priorities), list(workload.priorities.values())
        turns = cycle([(str(handle.node.address), handle.node, cycle(self._reads[handle])) for handle in handles])
        every = workload.every
        for name, node, reads in turns:
            if every is None:
                due = bus.now()
            if due >= until:
                return
            if every is not None:
                await asyncio.sleep(due - bus.now())
            priority = chance.choices(classes, shares)[0]
            try:
                await node.request(next(reads), priority=priority)
            except BusError as error:
                self._errors[type(error).__name__] += 1
                await asyncio.sleep(PAUSE_AFTER_ERROR)
            else:
                self._record(name, priority.name.lower(), due)
            if every is not None:
                late = int((bus.now() - due) / every)
                self._missed += late
                due += (1 + late) * every

    async def timed(self, name: str, call: Awaitable[T]) -> T:
        """Await a call of the application, and record how long it took."""
        called = self.bus.now()
        try:
            value = await call
        except BusError as error:
            self._errors[type(error).__name__] += 1
            raise
        self._record("", name, called)
        return value

    def _record(self, node: str, kind: str, since: float) -> None:
        now = self.bus.now()
        series = self._series.get((node, kind))
        if series is None:
            series = self._series[node, kind] = array("d"), array("d")
        series[0].append(now)
        series[1].append(now - since)

    async def _poll(self, period: float) -> None:
        """Read one value of each node once a period, and take each snapshot as a consumer does."""
        points: list[Point[Any]] = []
        for handle, reads in self._reads.items():
            points.append(Point(handle.node, str(reads[0]), reads[0]))
        names = (f"{GROUP}{number or ''}" for number in count())
        taken = {group.name for group in self.bus.groups}
        group = self.bus.poll_group(next(name for name in names if name not in taken), period=period, points=points)
        try:
            async for snapshot in group:
                self._cycles.append(self.bus.now() - snapshot.due)
                self._errors.update(type(one.error).__name__ for one in snapshot.samples.values() if one.error)
        finally:
            self._missed += group.statistics().missed
            group.close()

    async def _apply(self, application: Application) -> None:
        await application(self.bus, Stopwatch(self))

    # the report

    def report(self) -> BenchReport:
        """Return the results so far."""
        begun = self.bus.now() if self._begun is None else self._begun
        elapsed = (self.bus.now() if self._ended is None else self._ended) - begun
        kinds = [priority.name.lower() for priority in Priority if self.workload.priorities.get(priority)]
        called = sorted({kind for node, kind in self._series if not node})
        every = [latency for _, latencies in self._series.values() for latency in latencies]
        needed = self._wire.needed()
        return BenchReport(
            line=self._about,
            workload={"nodes": [int(name) for name in self._names], **self.workload.fields()},
            elapsed=elapsed,
            values=self._wire.values,
            limit=self._wire.values / needed if needed else 0.0,
            share=needed / elapsed if elapsed > 0 else 0.0,
            total=Times.of(every),
            nodes={name: self._times(node=name) for name in self._names},
            priorities={name: self._times(kind=name) for name in kinds},
            calls={name: self._times(node="", kind=name) for name in called},
            cycles=Times.of(self._cycles),
            missed=self._missed,
            errors=dict(sorted(self._errors.items())),
            histogram=histogram(every),
            samples=tuple(self._samples(begun)),
        )

    def _times(self, *, node: str | None = None, kind: str | None = None) -> Times:
        """Return the distribution of the latencies of a node, of a class of reads to all nodes, or of a call."""
        return Times.of(
            latency
            for (of_node, of_kind), (_, latencies) in self._series.items()
            if (of_node == node or (node is None and of_node)) and kind in (None, of_kind)
            for latency in latencies
        )

    def _samples(self, begun: float) -> Iterator[tuple[float, float, str]]:
        for (_, kind), (moments, latencies) in self._series.items():
            for moment, latency in zip(moments, latencies, strict=True):
                yield moment - begun, latency, kind


class Wire:
    """A tap that adds up how long the wire needs for the exchanges that brought a value: bits and reply delays alone.

    The silence that a protocol demands after an exchange counts too. Probes, sync reads and failed attempts do not.
    """

    def __init__(self, bus: Bus, reply_delay: float | None) -> None:
        self._bus = bus
        self._reply_delay = reply_delay
        self._echo = bus.endpoint.echo
        self._attempt: Attempt | None = None
        self._sent: dict[Attempt, tuple[float, int]] = {}
        self._received: dict[Attempt, int] = {}
        self._delays: array[float] = array("d")
        self._shapes: dict[Command[Any], tuple[int, int, float]] = {}
        self._bytes = self._replies = 0
        self._silence = 0.0
        self.values = 0
        """Exchanges that brought a value."""

    def transmitted(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Count the bytes of a request, and of what the host sends within its exchange."""
        if attempt is None:
            return
        # A new request may come behind the closing ACK of the exchange before it, which `closing` counts.
        size = len(data) if attempt is self._attempt else len(attempt.request)
        since, before = self._sent.get(attempt, (now, 0))
        self._attempt = attempt
        self._sent[attempt] = since, before + size

    def received(self, now: float, data: bytes, attempt: Attempt | None, /) -> None:
        """Count the bytes of a reply, and observe its delay."""
        if attempt is None or attempt not in self._sent:
            return
        if attempt not in self._received and not self._echo:
            since, size = self._sent[attempt]
            self._delays.append(max(0.0, now - since - (size + len(data)) * self._byte_time))
        self._received[attempt] = self._received.get(attempt, 0) + len(data)

    def attempted(self, attempt: Attempt, /) -> None:
        """Take the bytes of an exchange that is over, if it brought a value to a caller or a poll."""
        _, sent = self._sent.pop(attempt, (0.0, 0))
        received = self._received.pop(attempt, 0)
        if attempt.verdict is not Verdict.OK or attempt.purpose in ("probe", "check") or not sent:
            return
        shape = self._shapes.get(attempt.command)
        if shape is None:
            exchange = attempt.command.open(attempt.address, attempt.timings)
            shape = exchange.closing, 1 + len(exchange.later), exchange.timing.driver_release_time
            self._shapes[attempt.command] = shape
        closing, replies, silence = shape
        self._bytes += received + closing + (0 if self._echo else sent)
        self._replies += replies
        self._silence += silence
        self.values += 1

    @property
    def _byte_time(self) -> float:
        return self._bus._byte_time

    def needed(self) -> float:
        """Return the seconds that the wire needs for all of them."""
        delay = self._reply_delay
        if delay is None:
            delay = median(self._delays) if self._delays else 0.0
        return self._bytes * self._byte_time + self._replies * delay + self._silence


def reads_of(handle: Handle, items: Sequence[str] = ()) -> list[Command[Any]]:
    """Return the reads that a bench takes in turn: those of the items, else of the profile.

    Raises InvalidCommand for an item that does not exist, and for a command that writes.
    """
    profile = handle.node.profile
    commands = [handle.point(item).command for item in items] or [profile.probe, *profile.sync_reads]
    reads = list(dict.fromkeys(commands))
    reads = reads if items else reads[:READS]
    for read in reads:
        if read.writes:
            raise InvalidCommand(f"{handle.node.label}: {read} is a write, and a bench only reads")
    return reads


async def measure(
    bus: Bus, handles: Iterable[Handle], workload: Workload | None = None, *, application: Application | None = None
) -> BenchReport:
    """Measure an open bus, a real line's too, by reads of these handles' nodes alone.

    `application` runs beside the callers, and may time its own calls: see `Stopwatch`.
    """
    several = list(handles)
    name = several[0].node.profile.kind_name if several else ""
    measurement = Measurement(
        bus, several, workload or Workload(), application=application, about=about(bus, name, bus.endpoint.name)
    )
    await measurement.run_open()
    return measurement.report()


def bench(
    protocol: str,
    nodes: Iterable[int] = (1,),
    *,
    baud: int | None = None,
    delay: Delay | None = None,
    faults: Iterable[str] = (),
    seed: int = 1,
    virtual: bool = False,
    application: Application | None = None,
    **workload: Any,
) -> BenchReport:
    """Measure an emulated line of devices of one protocol, and return the report.

    `baud`: by default that of the protocol. `delay`: reply delay of the devices (2 ms). `faults`: texts such as
    "lost=0.1". `workload`: the arguments of `Workload`; `priorities` can be a text such as "command=8,urgent=1".

    The line is on a pseudo-terminal, in a process of its own. The loop of this thread is measured. With `virtual` it is
    in virtual time: the same arguments give the same report, on any machine. `application` runs beside the callers, and
    can time its own calls: see `Stopwatch`. Raises InvalidCommand for invalid values.
    """
    if isinstance(workload.get("priorities"), str):
        workload["priorities"] = parse_priorities(workload["priorities"])
    wanted = Workload(seed=seed, **workload)
    low_high = (Delay() if delay is None else delay).low, (Delay() if delay is None else delay).high
    line = EmulatedLine(protocol, tuple(nodes), baud, (low_high[0], low_high[1] or low_high[0]), tuple(faults), seed)
    with emulated(line, wanted, virtual=virtual, application=application) as measurement:
        with asyncio.Runner(loop_factory=VirtualTimeLoop if virtual else None) as runner:
            runner.run(measurement.run())
        return measurement.report()


@contextmanager
def emulated(
    line: EmulatedLine,
    workload: Workload,
    *,
    virtual: bool = False,
    application: Application | None = None,
    handle: Callable[[Bus, int], Handle] | None = None,
) -> Iterator[Measurement]:
    """Have an emulated line while the context lasts, and yield a measurement of it that is not begun.

    If `virtual`, it is to be run by a loop that keeps virtual time. `handle` makes the handles; the protocol's own by
    default.
    """
    made = line.line()  # before a process is started: whatever cannot be is refused here
    profile = find(line.protocol).profile
    for node in line.nodes:
        profile.check_address(node)
    make = find(line.protocol).handle if handle is None else handle

    def measurement(bus: Bus) -> Measurement:
        return Measurement(
            bus,
            [make(bus, node) for node in line.nodes],
            workload,
            application=application,
            reply_delay=sum(line.delay) / 2,
            known_reads=True,
            about={
                **about(bus, line.protocol, "emulated"),
                "virtual": virtual,
                "reply_delay": list(line.delay),
                "faults": list(line.faults),
            },
        )

    if virtual:
        yield measurement(Bus(MemoryPort(made), seed=line.seed))
        return
    settings = line.settings()
    with in_own_process(line) as path:
        port = SerialPort(
            path,
            baudrate=settings.baudrate,
            bytesize=settings.bytesize,
            parity=settings.parity,
            stopbits=settings.stopbits,
        )
        yield measurement(Bus(port, seed=line.seed))


def about(bus: Bus, protocol: str, port: str) -> dict[str, Any]:
    """Return the fields of a report about the line."""
    settings = bus.endpoint.settings
    return {
        "protocol": protocol,
        "port": port,
        "baudrate": None if settings is None else settings.baudrate,
        "framing": None if settings is None else settings.framing,
    }


__all__ = [
    "CYCLE",
    "FIGURES",
    "LONGEST",
    "MOST_CALLERS",
    "Application",
    "BenchReport",
    "Budget",
    "BudgetExceeded",
    "EmulatedLine",
    "Measurement",
    "Stopwatch",
    "Times",
    "VirtualTimeLoop",
    "Workload",
    "bench",
    "check_plot",
    "check_scope",
    "emulated",
    "measure",
    "parse_priorities",
    "plot",
    "ratios",
    "reads_of",
]
