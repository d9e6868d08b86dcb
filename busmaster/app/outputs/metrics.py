"""OpenMetrics: the counters of line, nodes, groups and outputs, for scrapes by Prometheus.

With `groups`, their values too. Scrapes are served by one thread, one after the other. Each number is read on the loop
that owns the line, a node at a time, so that no scrape keeps it for more than some ten microseconds.
"""

from __future__ import annotations

import asyncio
import enum
from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import accumulate
from typing import TYPE_CHECKING, ClassVar, TypeVar

from busmaster import Bus, Health, Node, Priority, ext
from busmaster.app.outputs.base import Output, OutputKind, OutputLine, OutputStatistics, Unsuitable, check_extra
from busmaster.app.outputs.scrapes import listening, page, serve
from busmaster.app.outputs.settings import MetricsSettings
from busmaster.app.service.refusals import TOO_FAST, Refusals
from busmaster.app.service.rights import Role
from busmaster.app.service.values import micros
from busmaster.ext import LineStatistics, NodeStatistics, RecentUtilisation

if TYPE_CHECKING:
    from prometheus_client.core import HistogramMetricFamily, Metric

T = TypeVar("T")

EDGES = (0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Of the latency histogram's buckets, in seconds."""
PATIENCE = 2.0
"""Seconds for which a scrape waits for a loop that is busy."""
UTILISATION_WINDOW = 5.0
"""Seconds before a scrape over which the utilisation of the line is taken."""
NOTED_EVERY = 1.0
"""Seconds between two looks at it, so that it does not depend on who scrapes, and how often."""
OUTCOMES = ("ok", "no_reply", "garbled", "refused")
COUNTS = {
    "attempts": "Exchanges with this node that have ended",
    "late": "Replies accepted after late_after",
    "overdue": "Replies after the reply window, accepted all the same",
    "retries": "Reads that were tried again",
    "unheard": "Replies to callers that had gone",
    "failed": "Requests that ended with an error, retries and all",
    "probes": "Probes of the node while it was down",
}
LINE_COUNTS = {
    "exchanges": "Exchanges on the line",
    "cancelled": "Requests whose callers had gone",
    "unexpected_bytes": "Bytes without a request",
    "tainted": "Replies that came sooner than the baud rate allows",
    "collisions": "Echoes that differ from the sent bytes",
    "sync_reads": "Reads that proved the line to be in sync",
    "ambiguous": "Replies that were discarded because they could belong to another request",
    "resyncs": "Times the line was resynchronised",
    "noisy": "Times the line would not be silent",
    "losses": "Times the port was lost",
    "damaged": "Bytes that came marked with a parity or framing error",
    "breaks": "Breaks that came marked",
}

DRIVER_COUNTS = {
    "framing": "Framing errors, by the driver's count",
    "parity": "Parity errors, by the driver's count",
    "breaks": "Breaks, by the driver's count",
    "overruns": "Bytes lost in the UART, by the driver's count",
    "buffer_overruns": "Bytes lost because they were not read in time, by the driver's count",
}


class MetricsOutput(Output):
    """Serves until it is closed. Raises InvalidCommand if the extra is missing."""

    what: ClassVar[str] = "answered"

    def __init__(
        self,
        kind: str,
        settings: MetricsSettings,
        bus: Bus,
        report: Callable[[str], None] = lambda _: None,
        outputs: Callable[[], Sequence[OutputStatistics]] = tuple,
        refusals: Refusals | None = None,
    ) -> None:
        check_extra("prometheus_client", "metrics")
        super().__init__(kind, settings, report)
        self.port = settings.port
        """The port in use, if the configured one is 0."""
        self._host = settings.host
        self._bus = bus
        self._others = outputs
        self._refusals = refusals or Refusals()
        self._owner: asyncio.AbstractEventLoop | None = None
        self._utilisation = RecentUtilisation(UTILISATION_WINDOW)

    def start(self) -> None:
        self._owner = asyncio.get_running_loop()
        self._note_utilisation()
        super().start()

    def _note_utilisation(self) -> None:
        """Look at how busy the line is, now and again and again until the output is closed. Runs on the loop."""
        assert self._owner is not None
        if not self._stop.is_set() and self._bus.running:
            self._utilisation.note(self._bus.now(), ext.line_statistics(self._bus))
            self._owner.call_later(NOTED_EVERY, self._note_utilisation)

    def offer(self, item: object) -> None:
        """Ignore the item: nothing is queued here, and each scrape reads the present values."""

    def miss(self, values: int) -> None:
        """Ignore the count: nothing waits here, so nothing is lost."""

    def suppress(self, values: int) -> None:
        """Ignore the count: a scrape always gets the last value."""

    # on threads

    def work(self) -> None:
        """Serve the metrics until it is stopped."""
        from prometheus_client.core import CollectorRegistry

        registry = CollectorRegistry()
        registry.register(self)
        with listening(self._host, self.port) as listener:
            self.port = listener.getsockname()[1]
            self.up()
            asyncio.run(serve(listener, partial(page, registry), self._stop))

    def describe(self) -> Iterable[Metric]:
        """Return nothing, so that registering does not read the line."""
        return ()

    def collect(self) -> Iterator[Metric]:
        """Yield every metric for a scrape, on its thread. Raises TimeoutError if the loop does not respond."""
        yield from self._of_line()
        yield from self._of_nodes()
        yield from self._of_groups()
        yield from self._of_points()
        yield from self._of_outputs()
        yield from self._of_refusals()
        self.offered += 1
        self.written = self.offered

    def _ask(self, read: Callable[[], T]) -> T:
        """Have the loop that owns the line call `read`."""

        async def asked() -> T:
            return read()

        assert self._owner is not None
        return asyncio.run_coroutine_threadsafe(asked(), self._owner).result(PATIENCE)

    def _of_line(self) -> Iterator[Metric]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        line, utilisation = self._ask(self._line_and_utilisation)
        lost = self._ask(lambda: self._bus.condition.is_lost)
        yield GaugeMetricFamily("busmaster_line_up", "1 while the port is there, 0 while it is lost", value=not lost)
        yield CounterMetricFamily(
            "busmaster_line_lost_seconds", "Time for which the port was lost", value=self._ask(self._lost_seconds)
        )
        yield GaugeMetricFamily(
            "busmaster_line_utilisation_ratio",
            f"Share of the last {UTILISATION_WINDOW:g} s in which the line was busy or resynchronising",
            value=utilisation,
        )
        yield CounterMetricFamily("busmaster_line_busy_seconds", "Time in exchanges", value=line.busy)
        yield CounterMetricFamily(
            "busmaster_line_quiet_seconds", "Quiet time: time spent resynchronising", value=line.quiet_time
        )
        yield GaugeMetricFamily("busmaster_line_backlog", "Requests that wait", value=line.backlog)
        for name, text in LINE_COUNTS.items():
            yield CounterMetricFamily(f"busmaster_line_{name}", text, value=getattr(line, name))
        for name, text in DRIVER_COUNTS.items() if line.driver is not None else ():
            yield CounterMetricFamily(f"busmaster_driver_{name}", text, value=getattr(line.driver, name))
        reads = CounterMetricFamily(
            "busmaster_reads_after_writes",
            "Reads of points with read_after_write; shared: writes that the read of another served too",
            labels=["outcome"],
        )
        for outcome, count in self._ask(self._counts_of_reads).items():
            reads.add_metric([outcome], count)
        yield reads
        waits = GaugeMetricFamily(
            "busmaster_line_wait_p99_seconds", "From being queued to being sent, 99 of 100", labels=["priority"]
        )
        for priority in Priority:
            waits.add_metric([priority.name.lower()], line.waits[priority].p99)
        yield waits

    def _line_and_utilisation(self) -> tuple[LineStatistics, float]:
        line = ext.line_statistics(self._bus)
        return line, self._utilisation.note(self._bus.now(), line)

    def _counts_of_reads(self) -> dict[str, int]:
        counts = ext.reads_after_writes(self._bus)
        return {"read": counts.read, "failed": counts.failed, "shared": counts.shared}

    def _lost_seconds(self) -> float:
        return ext.lost_seconds(self._bus)

    def _of_nodes(self) -> Iterator[Metric]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

        counters = {
            name: CounterMetricFamily(f"busmaster_node_{name}", text, labels=["node"]) for name, text in COUNTS.items()
        }
        outcomes = CounterMetricFamily(
            "busmaster_node_exchanges", "Exchanges by their outcome", labels=["node", "outcome"]
        )
        health = GaugeMetricFamily(
            "busmaster_node_up", "1 while the node answers, 0 while it is down or its line is lost", labels=["node"]
        )
        latency = HistogramMetricFamily(
            "busmaster_node_latency_seconds", "From the start of a request to the end of its reply", labels=["node"]
        )
        for node in self._bus.nodes:
            counts, buckets, total = self._ask(partial(read_node, node))
            for name, family in counters.items():
                family.add_metric([node.label], getattr(counts, name))
            for outcome in OUTCOMES:
                outcomes.add_metric([node.label, outcome], getattr(counts, outcome))
            health.add_metric([node.label], float(node.health not in (Health.DOWN, Health.OFFLINE)))
            add_histogram(latency, node.label, buckets, total)
        yield from (*counters.values(), outcomes, health, latency)

    def _of_groups(self) -> Iterator[Metric]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        cycles = CounterMetricFamily("busmaster_group_cycles", "Cycles that were polled", labels=["group"])
        missed = CounterMetricFamily("busmaster_group_missed", "Cycles that could not start", labels=["group"])
        wanted = GaugeMetricFamily("busmaster_group_period_seconds", "Configured period", labels=["group"])
        achieved = GaugeMetricFamily("busmaster_group_achieved_period_seconds", "Period as seen", labels=["group"])
        for group in self._bus.groups:
            counts = self._ask(group.statistics)
            cycles.add_metric([group.name], counts.cycles)
            missed.add_metric([group.name], counts.missed)
            wanted.add_metric([group.name], counts.period)
            achieved.add_metric([group.name], counts.achieved)
        yield from (cycles, missed, wanted, achieved)

    def _of_points(self) -> Iterator[Metric]:
        """Yield the last values of the groups in the settings. Values that are not numbers are left out.

        A point that cannot be read has no value, but the time of the last one, so that an alert on its age continues.
        """
        from prometheus_client.core import GaugeMetricFamily

        labels = ["group", "node", "item", "unit"]
        values = GaugeMetricFamily("busmaster_value", "The value that was read last", labels=labels)
        times = GaugeMetricFamily(
            "busmaster_value_time_seconds", "When it was last read without an error, since 1970", labels=labels
        )
        good = GaugeMetricFamily(
            "busmaster_value_good", "1 while the value is good, 0 while it is stale or cannot be read", labels=labels
        )
        for group in self._bus.groups:
            latest = group.latest if group.name in self.groups else None
            for point, sample in latest.samples.items() if latest is not None else ():
                now = self._bus.as_of_now(point, sample)
                number, read_at = number_of(now.value), group.good_at(point)
                if now.error is None and number is None:
                    continue
                node, _, item = point.key.partition("/")
                place = [group.name, node, item, point.unit]
                if number is not None:
                    values.add_metric(place, number)
                if read_at is not None:
                    times.add_metric(place, micros(read_at))
                good.add_metric(place, float(now.quality.is_current))
        alarms = GaugeMetricFamily(
            "busmaster_alarm", "1 while a value is above its high, -1 below its low, else 0", labels=["node", "item"]
        )
        for point, alarm in self._bus.alarms.items():
            node, _, item = point.key.partition("/")
            alarms.add_metric([node, item], 0.0 if alarm is None else 1.0 if alarm.limit == "high" else -1.0)
        yield from (values, times, good, alarms)

    def _of_outputs(self) -> Iterator[Metric]:
        from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

        written = CounterMetricFamily("busmaster_output_written", "Values and events written", labels=["output"])
        dropped = CounterMetricFamily("busmaster_output_dropped", "Values and events dropped", labels=["output"])
        waiting = GaugeMetricFamily("busmaster_output_waiting", "Values and events that wait", labels=["output"])
        spilled = GaugeMetricFamily("busmaster_output_spilled", "Of those, on disk", labels=["output"])
        suppressed = CounterMetricFamily(
            "busmaster_output_suppressed", "Unchanged values, by deadband and heartbeat", labels=["output"]
        )
        up = GaugeMetricFamily("busmaster_output_up", "1 while the output works", labels=["output"])
        for counts in self._others():
            written.add_metric([counts.kind], counts.written)
            dropped.add_metric([counts.kind], counts.dropped)
            waiting.add_metric([counts.kind], counts.waiting)
            spilled.add_metric([counts.kind], counts.spilled)
            suppressed.add_metric([counts.kind], counts.suppressed)
            up.add_metric([counts.kind], float(not counts.error))
        yield from (written, dropped, waiting, spilled, suppressed, up)

    def _of_refusals(self) -> Iterator[Metric]:
        from prometheus_client.core import CounterMetricFamily

        connections = CounterMetricFamily(
            "busmaster_connections_refused",
            "Connections for which no place was free, by role; unknown: those of programs that connect too fast",
            labels=["role"],
        )
        logins = CounterMetricFamily(
            "busmaster_logins_failed",
            "Logins that failed, by interface; service: at the line's socket",
            labels=["interface"],
        )
        at_interfaces = CounterMetricFamily(
            "busmaster_interface_refused",
            "Connections and requests that an interface in another process has refused",
            labels=["interface", "kind"],
        )
        counts = self._refusals
        refused, failed, beyond = self._ask(
            lambda: (dict(counts.connections), dict(counts.logins), dict(counts.at_interfaces))
        )
        for role in (*(role.value for role in Role), "safe", TOO_FAST):
            connections.add_metric([role], refused.get(role, 0))
        for interface, count in failed.items():
            logins.add_metric([interface], count)
        for labels, count in beyond.items():
            at_interfaces.add_metric(labels, count)
        yield from (connections, logins, at_interfaces)


def number_of(value: object) -> float | None:
    """Return a value for a gauge: words and flags as their number, None for a value that is not one number."""
    number = value.value if isinstance(value, enum.Enum) else value
    return float(number) if isinstance(number, int | float) else None


def read_node(node: Node) -> tuple[NodeStatistics, list[tuple[float, int]], float]:
    """Return the counts of a node and its latencies.

    The latencies are pairs (upper edge, count) of the buckets in use, and their sum; edges and sum are in seconds.
    """
    latency = ext.record_of(node).counters.latency
    return node.statistics(), latency.buckets(), latency.total


def add_histogram(family: HistogramMetricFamily, node: str, buckets: Sequence[tuple[float, int]], total: float) -> None:
    """Add our fine buckets in a few: each is counted with the first edge that is not below its own."""
    counts = [0] * (len(EDGES) + 1)
    for upper, count in buckets:
        counts[bisect_left(EDGES, upper)] += count
    edges = (*map(str, EDGES), "+Inf")
    family.add_metric([node], list(zip(edges, accumulate(counts), strict=True)), total)


def make(settings: MetricsSettings, line: OutputLine) -> MetricsOutput:
    """Make the output of a line."""
    return MetricsOutput("metrics", settings, line.bus, line.report, line.statistics, line.authorisation.refusals)


def unsuitable(settings: MetricsSettings, group: str, points: Mapping[str, str]) -> Unsuitable | None:
    """Return why a point of a group cannot be a gauge, or None. Without `groups`, only counts are served."""
    for key, sort in points.items() if settings.groups else ():
        if sort in ("run", "set", "text"):
            return Unsuitable(f"cannot take {key}: it is a {sort}, and a gauge is one number", "groups")
    return None


METRICS = OutputKind(
    name="metrics",
    settings=MetricsSettings,
    make=make,
    about="Counts, and values, for Prometheus; the extra metrics.",
    without=("buffer",),
    unsuitable=unsuitable,
)
