"""OpenMetrics, scraped over HTTP as Prometheus does, and read by its own parser."""

from __future__ import annotations

import asyncio
import errno
import gzip
import importlib
import os
import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster import Priority, ext
from busmaster.app.config import emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs import metrics as metrics_module
from busmaster.app.outputs import scrapes
from busmaster.app.outputs.base import OutputStatistics
from busmaster.app.outputs.metrics import MetricsOutput, number_of
from busmaster.app.outputs.settings import MetricsSettings
from busmaster.app.service.refusals import Refusals
from busmaster.arbiter.counters import DriverErrors
from busmaster.arbiter.health import Health
from busmaster.bus.bus import Bus
from busmaster.bus.meaning import Meaning
from busmaster.bus.node import Node
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort, MemoryTransport
from busmaster.errors import GarbledReply, LineDown, NoReply, Refused
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.msc.status import ProgramStatus
from busmaster.registry import make_device
from busmaster.testing.virtual_time import run_in_virtual_time
from tests.app.outputs.cycles import BUS, cycle, until
from tests.patience import PATIENCE
from tests.ports import free_port

pytestmark = pytest.mark.skipif(
    find_spec("prometheus_client") is None, reason="needs prometheus-client (the extra named metrics)"
)
Metrics = dict[tuple[str, frozenset[tuple[str, str]]], float]


def scraped(port: int, host: str = "127.0.0.1") -> Metrics:
    parser = importlib.import_module("prometheus_client.openmetrics.parser")
    request = urllib.request.Request(
        f"http://{host}:{port}/metrics", headers={"Accept": "application/openmetrics-text; version=1.0.0"}
    )
    with urllib.request.urlopen(request, timeout=PATIENCE) as answer:
        text = answer.read().decode()
    return {
        (sample.name, frozenset(sample.labels.items())): sample.value
        for family in parser.text_string_to_metric_families(text)
        for sample in family.samples
    }


def of(metrics: Metrics, name: str, **labels: str) -> float:
    return metrics[f"busmaster_{name}", frozenset(labels.items())]


@pytest.fixture(autouse=True)
def scrapes_have_time(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in (metrics_module, scrapes):
        monkeypatch.setattr(module, "PATIENCE", PATIENCE)


def test_a_scrape_has_the_counts_of_nodes_groups_line_and_outputs() -> None:
    run_in_virtual_time(count_and_scrape())


async def count_and_scrape() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)])))
    controller, absent = Hcp2Controller(bus, 5), Hcp2Controller(bus, 6)
    counts = OutputStatistics("sqlite", "written", 10, 2, 3, "disk full", 1, 7)
    other = OutputStatistics("csv", "written", 11, 12, 13, "")
    output = MetricsOutput("metrics", MetricsSettings(port=0), bus, outputs=lambda: (counts, other))
    async with bus:
        output.start()
        group = bus.poll_group("axes", period=0.02, points=[controller.point("1")])
        async for snapshot in group:
            if snapshot.cycle == 3:
                break
        group.pause()
        with pytest.raises(NoReply):
            await absent.read(1, retries=0)
        await asyncio.to_thread(until, lambda: output.port != 0)
        metrics = await asyncio.to_thread(scraped, output.port)
        line, achieved = ext.line_statistics(bus), group.statistics().achieved
        await asyncio.to_thread(output.close, PATIENCE)
    assert of(metrics, "node_attempts_total", node="node 5") == 3
    for name in ("attempts", "late", "overdue", "retries", "unheard", "failed", "probes"):
        assert of(metrics, f"node_{name}_total", node="node 6") == getattr(Node.of(absent).statistics(), name)
    names = "exchanges cancelled unexpected_bytes tainted collisions sync_reads ambiguous resyncs noisy losses"
    for name in (*names.split(), "damaged", "breaks"):
        assert of(metrics, f"line_{name}_total") == getattr(line, name)
    assert of(metrics, "node_exchanges_total", node="node 5", outcome="ok") == 3
    assert of(metrics, "node_exchanges_total", node="node 6", outcome="no_reply") == 1
    assert of(metrics, "node_latency_seconds_count", node="node 5") == 3
    assert of(metrics, "node_latency_seconds_bucket", node="node 5", le="0.001") == 0
    assert of(metrics, "node_latency_seconds_bucket", node="node 5", le="0.5") == 3
    assert 0.001 < of(metrics, "node_latency_seconds_sum", node="node 5") < 1
    assert of(metrics, "group_cycles_total", group="axes") == 3
    assert of(metrics, "group_missed_total", group="axes") == group.statistics().missed
    assert of(metrics, "group_period_seconds", group="axes") == 0.02
    assert of(metrics, "group_achieved_period_seconds", group="axes") == achieved > 0.019
    assert of(metrics, "line_backlog") == line.backlog
    assert of(metrics, "line_quiet_seconds_total") == line.quiet_time != line.busy
    waits = {priority.name.lower(): line.waits[priority].p99 for priority in Priority}
    assert {name: of(metrics, "line_wait_p99_seconds", priority=name) for name in waits} == waits
    assert 0 < of(metrics, "line_utilisation_ratio") <= 1
    assert of(metrics, "output_dropped_total", output="sqlite") == 2
    assert of(metrics, "output_up", output="sqlite") == 0
    of_output = ("written_total", "dropped_total", "waiting", "spilled", "suppressed_total", "up")
    assert [of(metrics, f"output_{name}", output="sqlite") for name in of_output] == [10, 2, 3, 1, 7, 0]
    assert [of(metrics, f"output_{name}", output="csv") for name in of_output] == [11, 12, 13, 0, 0, 1]
    # What has not happened yet is there with 0: an alert on an increase sees the first one too.
    for role in ("read", "write", "admin", "safe", "unknown"):
        assert of(metrics, "connections_refused_total", role=role) == 0


def test_the_utilisation_of_the_line_is_of_the_last_seconds() -> None:
    run_in_virtual_time(poll_and_pause())


async def poll_and_pause() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)])))
    output = MetricsOutput("metrics", MetricsSettings(port=0), bus)
    async with bus:
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        group = bus.poll_group("axes", period=0.02, points=[Hcp2Controller(bus, 5).point("1")])
        await asyncio.sleep(60)
        busy = await asyncio.to_thread(scraped, output.port)
        group.pause()
        await asyncio.sleep(metrics_module.UTILISATION_WINDOW + 1)
        idle = await asyncio.to_thread(scraped, output.port)
        bus.reset_statistics()
        group.resume()
        await asyncio.sleep(metrics_module.UTILISATION_WINDOW + 1)
        again = await asyncio.to_thread(scraped, output.port)
        await asyncio.to_thread(output.close, PATIENCE)
    share = of(busy, "line_busy_seconds_total") / 60
    assert share > 0.1
    assert of(busy, "line_utilisation_ratio") == pytest.approx(share, rel=0.02)
    assert of(idle, "line_utilisation_ratio") == 0
    assert of(idle, "line_busy_seconds_total") == pytest.approx(share * 60, rel=0.01)
    assert of(again, "line_utilisation_ratio") == pytest.approx(share, rel=0.02)


@pytest.mark.asyncio
async def test_a_scrape_has_the_drivers_counts_where_there_are_any(monkeypatch: pytest.MonkeyPatch) -> None:
    found: DriverErrors | None = None
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [])))
    monkeypatch.setattr(bus._pump, "driver_errors", lambda: found)
    output = MetricsOutput("metrics", MetricsSettings(port=0), bus)
    async with bus:
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        without = await asyncio.to_thread(scraped, output.port)
        found = DriverErrors(framing=1, parity=2, breaks=3, overruns=4, buffer_overruns=5)
        metrics = await asyncio.to_thread(scraped, output.port)
        await asyncio.to_thread(output.close, PATIENCE)
    assert of(without, "line_damaged_total") == of(without, "line_breaks_total") == 0
    assert not any(name.startswith("busmaster_driver") for name, _ in without)
    names = ("framing", "parity", "breaks", "overruns", "buffer_overruns")
    assert [of(metrics, f"driver_{name}_total") for name in names] == [1, 2, 3, 4, 5]


@pytest.mark.asyncio
async def test_a_port_that_is_taken_is_told_and_tried_again() -> None:
    said: list[str] = []
    port = free_port()
    with socket.create_server(("127.0.0.1", port)):
        output = MetricsOutput("metrics", MetricsSettings(port=port), BUS, said.append)
        output._retry = 0.01
        output.start()
        await asyncio.to_thread(until, lambda: bool(said))
    await asyncio.to_thread(until, lambda: said[-1] == "metrics is up again")
    await asyncio.to_thread(scraped, port)
    await asyncio.to_thread(output.close, PATIENCE)
    down, up = said
    assert down.startswith(f"metrics is down: 127.0.0.1:{port}: Address already in use")
    assert up == "metrics is up again"


@asynccontextmanager
async def served(**options: Any) -> AsyncIterator[MetricsOutput]:
    """A line with one node, polled three times, and its metrics."""
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)], paced=False)))
    controller = Hcp2Controller(bus, 5)
    output = MetricsOutput("metrics", MetricsSettings(port=0, **options), bus)
    async with bus:
        await controller.write(1, 12.5)
        group = bus.poll_group("axes", period=0.02, points=[controller.point("1")])
        async for snapshot in group:
            if snapshot.cycle == 3:
                break
        group.pause()
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        try:
            yield output
        finally:
            await asyncio.to_thread(output.close, PATIENCE)
    assert not output._thread.is_alive()


@pytest.mark.asyncio
async def test_scrapes_of_another_address_of_this_machine_are_answered_and_counted() -> None:
    async with served(host="127.0.0.2") as output:
        for _ in range(2):
            await asyncio.to_thread(scraped, output.port, "127.0.0.2")
        counts = output.statistics()
    assert (counts.what, counts.written, counts.waiting, counts.dropped) == ("answered", 2, 0, 0)


@pytest.mark.asyncio
async def test_values_are_gauges_where_their_group_is_named() -> None:
    async with served(groups=("axes",)) as output:
        metrics = await asyncio.to_thread(scraped, output.port)
    labels = {"group": "axes", "node": "5", "item": "1", "unit": ""}
    assert of(metrics, "value", **labels) == 12.5
    assert of(metrics, "value_time_seconds", **labels) == pytest.approx(time.time(), abs=60)
    async with served() as output:
        metrics = await asyncio.to_thread(scraped, output.port)
    assert not any(name.startswith("busmaster_value") for name, _ in metrics)


@pytest.mark.asyncio
async def test_a_stale_value_is_told_as_such_and_a_lost_one_keeps_its_time(monkeypatch: pytest.MonkeyPatch) -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)])))
    output = MetricsOutput("metrics", MetricsSettings(port=0, groups=("axes",)), bus)
    labels = {"group": "axes", "node": "5", "item": "10", "unit": ""}
    async with bus:
        point = Hcp2Controller(bus, 5).point("10")
        group = bus.poll_group("axes", period=1000.0, points=[point])
        async for _ in group:
            break
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        metrics = await asyncio.to_thread(scraped, output.port)
        assert (of(metrics, "line_up"), of(metrics, "node_up", node="node 5")) == (1, 1)
        assert of(metrics, "value_good", **labels) == 1
        read_at = of(metrics, "value_time_seconds", **labels)
        await point.write(7.0)
        metrics = await asyncio.to_thread(scraped, output.port)
        assert (of(metrics, "value", **labels), of(metrics, "value_good", **labels)) == (0, 0)
        monkeypatch.setattr(MemoryPort, "open", never_opens)
        transport = bus._pump._transport
        assert isinstance(transport, MemoryTransport)
        transport.lose(OSError("unplugged"))
        while not bus.condition.is_lost:  # noqa: ASYNC110  nobody tells it
            await asyncio.sleep(0)
        metrics = await asyncio.to_thread(scraped, output.port)
        await asyncio.to_thread(output.close, PATIENCE)
    assert (of(metrics, "line_up"), of(metrics, "node_up", node="node 5")) == (0, 0)
    assert of(metrics, "line_lost_seconds_total") > 0
    assert of(metrics, "value_good", **labels) == 0
    assert of(metrics, "value_time_seconds", **labels) == read_at
    assert ("busmaster_value", frozenset(labels.items())) not in metrics


@pytest.mark.asyncio
async def test_a_value_that_can_no_longer_be_read_keeps_the_time_of_the_last_read_without_an_error() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)], paced=False)))
    output = MetricsOutput("metrics", MetricsSettings(port=0, groups=("axes",)), bus)
    labels = {"group": "axes", "node": "5", "item": "10", "unit": ""}
    fails = False

    def decode(value: float) -> float:
        if fails:
            raise GarbledReply("no number")
        return value

    async with bus:
        point = replace(Hcp2Controller(bus, 5).point("10"), decode=decode)
        group = bus.poll_group("axes", period=0.02, points=[point])
        async for snapshot in group:
            if snapshot[point].error is not None:
                break
            read_at, fails = snapshot[point].wall, True
        group.pause()
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        metrics = await asyncio.to_thread(scraped, output.port)
        await asyncio.to_thread(output.close, PATIENCE)
    assert of(metrics, "value_time_seconds", **labels) == pytest.approx(read_at, abs=1e-3)
    assert of(metrics, "value_good", **labels) == 0
    assert ("busmaster_value", frozenset(labels.items())) not in metrics


def test_metrics_count_no_values_because_each_scrape_has_the_last_ones() -> None:
    output = MetricsOutput("metrics", MetricsSettings(port=0), BUS)
    output.offer(cycle(1, 1.0))
    output.miss(2)
    output.suppress(3)
    counts = output.statistics()
    assert (counts.written, counts.dropped, counts.waiting, counts.suppressed) == (0, 0, 0, 0)


PAGE = (Path(__file__).parents[3] / "docs" / "howto" / "mqtt-and-grafana.md").read_text()
"""What users are told to put into panels and alerts."""


def firing(metrics: Metrics) -> set[str]:
    """Which alerts of the page, `METRIC == 0` or `METRIC != 0`, fire on these samples, as Prometheus computes them."""
    alerts = re.findall(r"`(busmaster_\w+) (==|!=) 0`", PAGE)
    assert len(alerts) >= 5
    return {
        name
        for name, sign in alerts
        if any(sample == name and (value == 0) == (sign == "==") for (sample, _), value in metrics.items())
    }


@pytest.mark.asyncio
async def test_the_alerts_of_the_page_fire_when_the_line_is_lost_and_not_before(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)])))
    counts = OutputStatistics("sqlite", "written", 10, 0, 0, "")
    output = MetricsOutput("metrics", MetricsSettings(port=0, groups=("axes",)), bus, outputs=lambda: (counts,))
    async with bus:
        point = replace(Hcp2Controller(bus, 5).point("10"), meaning=Meaning(high=5.0))
        group = bus.poll_group("axes", period=0.05, points=[point])
        async for _ in group:
            break
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        calm = await asyncio.to_thread(scraped, output.port)
        monkeypatch.setattr(MemoryPort, "open", never_opens)
        transport = bus._pump._transport
        assert isinstance(transport, MemoryTransport)
        transport.lose(OSError("unplugged"))
        while not bus.condition.is_lost:  # noqa: ASYNC110  nobody tells it
            await asyncio.sleep(0)
        lost = await asyncio.to_thread(scraped, output.port)
        await asyncio.to_thread(output.close, PATIENCE)
    assert firing(calm) == set()
    assert firing(lost) == {"busmaster_line_up", "busmaster_node_up", "busmaster_value_good"}
    named = set(re.findall(r"busmaster_(?!group)\w+|busmaster_group_missed_total", PAGE))
    assert named <= {name for name, _ in calm}


async def never_opens(*_: object, **__: object) -> None:
    raise LineDown("unplugged")


class Mode(Enum):
    """A word that is not a number itself."""

    JOG = 2


@pytest.mark.parametrize(
    ("value", "number"),
    [
        (3, 3.0),
        (2.5, 2.5),
        (ProgramStatus(65), 65.0),
        (Mode.JOG, 2.0),
        (Health.UP, None),
        ((1, 2), None),
        ("on", None),
    ],
)
def test_what_is_no_number_is_no_gauge(value: object, number: float | None) -> None:
    assert number_of(value) == number


def threads_of_ours() -> int:
    return sum(thread.name.startswith("busmaster") for thread in threading.enumerate())


@pytest.mark.slow
@pytest.mark.asyncio
async def test_a_thousand_half_open_connections_cost_no_threads_and_keep_no_scrape_out(
    capfd: pytest.CaptureFixture[str],
) -> None:
    async with served() as output:
        await asyncio.to_thread(scraped, output.port)
        threads, descriptors = threads_of_ours(), len(os.listdir("/proc/self/fd"))
        half_open = []
        try:
            for _ in range(700):
                half_open.append(socket.create_connection(("127.0.0.1", output.port), PATIENCE))
                half_open[-1].sendall(b"GET /metrics HT")
            await asyncio.to_thread(scraped, output.port)
            assert threads_of_ours() <= threads
            assert len(os.listdir("/proc/self/fd")) - descriptors < 700 + 256 + 100
        finally:
            for connection in half_open:
                connection.close()
        await asyncio.to_thread(scraped, output.port)
    assert capfd.readouterr().err == ""


@pytest.mark.slow
@pytest.mark.asyncio
async def test_two_hundred_scrapes_at_once_are_all_answered_by_a_few_threads(capfd: pytest.CaptureFixture[str]) -> None:
    async def scrape(port: int) -> bytes:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n")
        answer = await reader.read()
        writer.close()
        return answer

    async with served() as output:
        await asyncio.to_thread(scraped, output.port)
        threads = threads_of_ours()
        async with asyncio.timeout(PATIENCE):
            answers = await asyncio.gather(*(scrape(output.port) for _ in range(200)))
        assert threads_of_ours() <= threads
    assert all(answer.startswith(b"HTTP/1.1 200 OK") and b"busmaster_line_busy" in answer for answer in answers)
    assert capfd.readouterr().err == ""


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("asked", "answered"),
    [
        (b"POST /metrics HTTP/1.1\r\n\r\n", b"HTTP/1.1 405"),
        (b"what is this\r\n\r\n", b"HTTP/1.1 400"),
        (b"x" * 100_000, b""),
        (b"", b""),
    ],
)
async def test_what_is_no_scrape_is_refused_and_the_next_one_answered(asked: bytes, answered: bytes) -> None:
    async with served() as output:
        reader, writer = await asyncio.open_connection("127.0.0.1", output.port)
        with suppress(ConnectionError):
            writer.write(asked)
            writer.write_eof()
            assert (await reader.read()).startswith(answered)
        writer.close()
        await asyncio.to_thread(scraped, output.port)


@pytest.mark.asyncio
async def test_a_reply_to_head_has_the_header_of_a_scrape_and_no_page() -> None:
    async with served() as output:
        replies = []
        for method in (b"HEAD", b"GET"):
            reader, writer = await asyncio.open_connection("127.0.0.1", output.port)
            writer.write(method + b" /metrics HTTP/1.1\r\n\r\n")
            replies.append((await reader.read()).partition(b"\r\n\r\n"))
            writer.close()
    (head, _, nothing), (whole, _, page) = replies
    assert head.startswith(b"HTTP/1.1 200 OK\r\n")
    assert [line.partition(b":")[0] for line in head.splitlines()] == [
        line.partition(b":")[0] for line in whole.splitlines()
    ]
    assert nothing == b""
    assert b"busmaster_line_busy" in page


def has_ipv6() -> bool:
    try:
        socket.create_server(("::1", 0), family=socket.AF_INET6).close()
    except OSError:
        return False
    return True


@pytest.mark.parametrize(
    "host", ["127.0.0.1", pytest.param("::1", marks=pytest.mark.skipif(not has_ipv6(), reason="no IPv6"))]
)
def test_metrics_can_listen_on_addresses_of_both_families(host: str) -> None:
    with (
        scrapes.listening(host, 0) as listener,
        socket.create_connection(listener.getsockname()[:2], PATIENCE) as scraper,
    ):
        assert scraper.getpeername()[0] == host


@pytest.mark.skipif(not has_ipv6(), reason="no IPv6")
def test_metrics_listen_at_the_interface_of_a_link_local_address() -> None:
    with pytest.raises(OSError, match=os.strerror(errno.EADDRNOTAVAIL)):  # without the interface it is no valid address
        scrapes.listening("fe80::1%lo", 0)


def test_a_histogram_adds_what_fine_buckets_have_up_to_each_edge() -> None:
    added: list[Any] = []
    family: Any = SimpleNamespace(add_metric=lambda *given: added.append(given))
    metrics_module.add_histogram(family, "winder", [(0.001, 1), (0.0011, 2), (0.0019, 3), (2.0, 4), (9.0, 5)], 46.5)
    [(labels, buckets, total)] = added
    assert (labels, total) == (["winder"], 46.5)
    assert [(edge, count) for edge, count in buckets if edge in ("0.001", "0.002", "1.0", "2.0", "+Inf")] == [
        ("0.001", 1),
        ("0.002", 6),
        ("1.0", 6),
        ("2.0", 10),
        ("+Inf", 15),
    ]


@pytest.mark.parametrize(("sort", "fits"), [("number", True), ("run", False), ("set", False), ("text", False)])
def test_a_point_that_is_not_one_number_cannot_be_a_gauge(sort: str, fits: bool) -> None:
    points = {"winder/force": "number", "winder/x": sort}
    found = metrics_module.unsuitable(MetricsSettings(groups=("axes",)), "axes", points)
    assert (found is None) is fits
    assert found is None or (f"cannot take winder/x: it is a {sort}" in found.why and found.key == "groups")
    assert metrics_module.unsuitable(MetricsSettings(), "axes", points) is None, "without groups only counts are served"


@pytest.mark.asyncio
async def test_values_and_alarms_on_both_sides_are_served() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)], paced=False)))
    controller = Hcp2Controller(bus, 5)
    output = MetricsOutput("metrics", MetricsSettings(port=0, groups=("axes",)), bus)
    async with bus:
        for item, value in ((1, 10.0), (3, -10.0), (4, 0.0)):
            await controller.write(item, value)
        meanings = {"1": Meaning(high=5.0), "3": Meaning(low=-5.0), "4": Meaning(high=5.0)}
        points = [replace(controller.point(item), meaning=meaning) for item, meaning in meanings.items()]
        points.append(replace(controller.point("2"), decode=lambda _: "a text"))
        group = bus.poll_group("axes", period=1000.0, points=points)
        async for _ in group:
            break
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        metrics = await asyncio.to_thread(scraped, output.port)
        await asyncio.to_thread(output.close, PATIENCE)
    found = {dict(labels)["item"]: value for (name, labels), value in metrics.items() if name == "busmaster_value"}
    assert found == {"1": 10, "3": -10, "4": 0}
    assert "2" not in {dict(labels).get("item") for _, labels in metrics}, "a text is no gauge"
    assert [of(metrics, "alarm", node="5", item=item) for item in ("1", "3", "4")] == [1, -1, 0]


@pytest.mark.asyncio
async def test_a_node_that_is_down_is_not_up_and_exchanges_are_counted_by_their_outcome() -> None:
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [make_device("hcp2", 5)], paced=False)))
    controller, absent = Hcp2Controller(bus, 5), Hcp2Controller(bus, 6)
    output = MetricsOutput("metrics", MetricsSettings(port=0), bus)
    async with bus:
        await controller.read(1)
        with pytest.raises(Refused):
            await controller.write(100, 1.0)
        await Node.of(absent).probe()
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        metrics = await asyncio.to_thread(scraped, output.port)
        await asyncio.to_thread(output.close, PATIENCE)
    for handle, is_up in ((controller, 1), (absent, 0)):
        node = Node.of(handle)
        assert of(metrics, "node_up", node=node.label) == is_up
        for outcome in metrics_module.OUTCOMES:
            counted = of(metrics, "node_exchanges_total", node=node.label, outcome=outcome)
            assert counted == getattr(node.statistics(), outcome)
    assert Node.of(controller).statistics().refused > Node.of(absent).statistics().refused == 0


def answers(port: int) -> bool:
    try:
        socket.create_connection(("127.0.0.1", port), PATIENCE).close()
    except OSError:
        return False
    return True


@pytest.mark.asyncio
async def test_metrics_of_a_line_have_its_other_outputs_and_its_refusals(tmp_path: Path) -> None:
    port = free_port()
    text = (
        'port = "/dev/ttyUSB0?baudrate=57600"\n[nodes.winder]\nprotocol = "hcp2"\naddress = 5\n'
        f'[outputs.csv]\npath = "{tmp_path}/x.csv"\n[outputs.metrics]\nport = {port}\n'
    )
    file = read(Source("line.toml", text))
    async with ConfiguredLine(file, port=MemoryPort(emulated_line(file))) as line:
        line.authorisation.refusals.logins.update(web=2)
        await asyncio.to_thread(until, lambda: answers(port))
        metrics = await asyncio.to_thread(scraped, port)
    assert [of(metrics, "output_up", output=output) for output in ("csv", "metrics")] == [1, 1]
    assert of(metrics, "logins_failed_total", interface="web") == 2


@pytest.mark.asyncio
async def test_refusals_of_each_sort_are_counted_by_their_labels() -> None:
    refusals = Refusals()
    refusals.connections.update(read=1, write=2, safe=3)
    refusals.logins.update(web=4, opcua=5)
    refusals.at_interfaces.update({("modbus-tcp", "requests"): 6, ("modbus-tcp", "connections"): 7})
    bus = Bus(MemoryPort(Line(hcp2.PROFILE.line, [])))
    output = MetricsOutput("metrics", MetricsSettings(port=0), bus, refusals=refusals)
    async with bus:
        output.start()
        await asyncio.to_thread(until, lambda: output.port != 0)
        metrics = await asyncio.to_thread(scraped, output.port)
        await asyncio.to_thread(output.close, PATIENCE)
    assert [of(metrics, "connections_refused_total", role=role) for role in ("read", "write", "safe")] == [1, 2, 3]
    assert [of(metrics, "logins_failed_total", interface=interface) for interface in ("web", "opcua")] == [4, 5]
    kinds = ("requests", "connections")
    assert [of(metrics, "interface_refused_total", interface="modbus-tcp", kind=kind) for kind in kinds] == [6, 7]


@pytest.mark.asyncio
async def test_reads_after_writes_are_counted_by_their_outcome(monkeypatch: pytest.MonkeyPatch) -> None:
    counts = SimpleNamespace(read=1, failed=2, shared=3)
    monkeypatch.setattr("busmaster.ext.reads_after_writes", lambda _: counts)
    async with served() as output:
        metrics = await asyncio.to_thread(scraped, output.port)
    outcomes = ("read", "failed", "shared")
    assert [of(metrics, "reads_after_writes_total", outcome=outcome) for outcome in outcomes] == [1, 2, 3]


@pytest.mark.asyncio
async def test_a_scrape_while_the_loop_of_the_line_is_busy_is_refused_in_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(metrics_module, "PATIENCE", 0.01)
    async with served() as output:
        with socket.create_connection(("127.0.0.1", output.port), PATIENCE) as scraper:
            scraper.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
            reply = scraper.recv(4096)  # not asynchronous: meanwhile the loop serves nothing
    assert reply.startswith(b"HTTP/1.1 503 ")
    assert b"loop is busy" in reply


# the server alone


class Scrapes:
    """A server of scrapes, whose pages wait for `go_on`."""

    def __init__(self) -> None:
        self.listener = scrapes.listening("127.0.0.1", 0)
        self.go_on = threading.Event()
        self.made: list[str] = []
        self.longer: dict[str, int] = {}
        """Bytes behind the page for a form."""
        self.stop = threading.Event()
        self.error: Exception | None = None
        self.inner: Any = None
        self.writers: list[asyncio.StreamWriter] = []

    def make(self, accept: str) -> tuple[str, bytes]:
        self.made.append(accept)
        self.go_on.wait(PATIENCE)
        if self.error is not None:
            raise self.error
        return "text/plain", f"page for {accept}".encode() + bytes(self.longer.get(accept, 0))

    async def connect(self) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
        reader, writer = await asyncio.open_connection(*self.listener.getsockname())
        self.writers.append(writer)  # one that is forgotten is closed
        return reader, writer

    async def ask(self, *fields: str) -> asyncio.StreamReader:
        reader, writer = await self.connect()
        writer.write("\r\n".join(["GET /metrics HTTP/1.1", *fields, "", ""]).encode())
        return reader

    async def until_asking(self, count: int) -> None:
        while len(self.inner._asking) < count:  # noqa: ASYNC110  nothing reports it
            await asyncio.sleep(0.001)

    async def until_made(self, count: int) -> None:
        while len(self.made) < count:  # noqa: ASYNC110  it is made in a thread
            await asyncio.sleep(0.001)


@asynccontextmanager
async def scrape_server(patch: pytest.MonkeyPatch) -> AsyncIterator[Scrapes]:
    server = Scrapes()
    made = scrapes._Server

    def noted(*arguments: Any) -> Any:
        server.inner = made(*arguments)
        return server.inner

    patch.setattr(scrapes, "_Server", noted)
    serving = asyncio.ensure_future(scrapes.serve(server.listener, server.make, server.stop))
    try:
        async with asyncio.timeout(PATIENCE):
            yield server
    finally:
        server.go_on.set()
        server.stop.set()
        await serving
        for writer in server.writers:
            writer.close()


@pytest.mark.asyncio
async def test_scrapers_that_wait_share_a_page_of_their_own_form_and_later_ones_get_a_new_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with scrape_server(monkeypatch) as server:
        first = await server.ask("ACCEPT: one")
        await server.until_made(1)
        others = [await server.ask(f"accept: {accept}") for accept in ("one", "two")]
        await server.until_asking(3)
        server.go_on.set()
        pages = [(await reader.read()).partition(b"\r\n\r\n")[2] for reader in (first, *others)]
        assert pages == [b"page for one", b"page for one", b"page for two"]
        assert (await (await server.ask("Accept: one")).read()).endswith(b"page for one")
    assert server.made[0] == "one"
    assert sorted(server.made) == ["one", "one", "two"]


@pytest.mark.asyncio
async def test_scrapers_beyond_the_bound_are_refused_until_others_have_their_page(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(scrapes, "MOST_ASKING", 1)
    async with scrape_server(monkeypatch) as server:
        first = await server.ask()
        await server.until_made(1)
        refused = await (await server.ask()).read()
        assert refused.startswith(b"HTTP/1.1 503 ")
        server.go_on.set()
        assert (await first.read()).startswith(b"HTTP/1.1 200 OK")
        for _ in range(2):
            assert (await (await server.ask()).read()).startswith(b"HTTP/1.1 200 OK")


@pytest.mark.asyncio
async def test_of_too_many_silent_connections_the_oldest_is_closed_and_none_that_waits_for_its_page(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(scrapes, "MOST_SILENT", 2)
    async with scrape_server(monkeypatch) as server:
        asking = await server.ask()
        await server.until_made(1)
        oldest, _ = await server.connect()
        later = [await server.connect() for _ in range(2)]
        assert await oldest.read() == b""
        server.go_on.set()
        assert (await asking.read()).startswith(b"HTTP/1.1 200 OK")
        for reader, writer in later:
            writer.write(b"GET / HTTP/1.1\r\n\r\n")
            assert (await reader.read()).startswith(b"HTTP/1.1 200 OK")


@pytest.mark.asyncio
async def test_half_a_scrape_is_closed_when_its_time_is_over(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scrapes, "PATIENCE", 0.02)
    async with scrape_server(monkeypatch) as server:
        reader, writer = await server.connect()
        writer.write(b"GET /metrics HT")
        assert await reader.read() == b""


@pytest.mark.asyncio
@pytest.mark.parametrize("size", [60_000, 8_000_000])
async def test_a_scraper_that_does_not_take_its_page_is_disconnected_when_its_time_is_over(
    monkeypatch: pytest.MonkeyPatch, size: int
) -> None:
    monkeypatch.setattr(scrapes, "MOST_ASKING", 1)
    async with scrape_server(monkeypatch) as server:
        server.listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 4096)
        server.longer["all"] = size
        with socket.socket() as lazy:
            lazy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            lazy.connect(server.listener.getsockname())
            lazy.sendall(b"GET /metrics HTTP/1.1\r\nAccept: all\r\n\r\n")
            await server.until_made(1)
            monkeypatch.setattr(scrapes, "PATIENCE", 0.02)
            server.go_on.set()
            while not (await (await server.ask()).read()).startswith(b"HTTP/1.1 200 OK"):
                pass  # the other one still has the only place
            lazy.setblocking(False)
            received = 0
            with suppress(ConnectionResetError):
                while part := await asyncio.get_running_loop().sock_recv(lazy, size):
                    received += len(part)
            assert 0 < received < size, "the rest of the page was discarded"


@pytest.mark.asyncio
async def test_connections_are_closed_at_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    async with scrape_server(monkeypatch) as server:
        silent, _ = await server.connect()
        asking = await server.ask()
        await server.until_made(1)
        server.stop.set()
        server.go_on.set()
        assert await silent.read() == b""
        await asking.read()


@pytest.mark.asyncio
@pytest.mark.parametrize(
    ("error", "status", "reason"),
    [
        (KeyError("axes"), b"500 Internal Server Error", b"KeyError('axes')"),
        (RuntimeError("a bug"), b"500 Internal Server Error", b"RuntimeError('a bug')"),
        (OSError("a bug"), b"500 Internal Server Error", b"OSError('a bug')"),
        (TimeoutError(), b"503 Service Unavailable", b"the line's loop is busy"),
    ],
    ids=["key", "runtime", "system", "time"],
)
async def test_whatever_fails_while_a_page_is_made_is_reported_to_all_that_wait_and_the_next_one_gets_its_page(
    monkeypatch: pytest.MonkeyPatch, error: Exception, status: bytes, reason: bytes
) -> None:
    async with scrape_server(monkeypatch) as server:
        server.error = error
        waiting = [await server.ask() for _ in range(2)]
        await server.until_asking(2)
        server.go_on.set()
        for reader in waiting:
            head, _, body = (await reader.read()).partition(b"\r\n\r\n")
            assert head.startswith(b"HTTP/1.1 " + status)
            assert f"Content-Length: {len(body)}".encode() in head
            assert body == reason + b"\n"
        assert len(server.made) == 1
        server.error = None
        assert (await (await server.ask()).read()).startswith(b"HTTP/1.1 200 OK")


@pytest.mark.asyncio
async def test_a_reply_to_head_has_no_body_also_if_it_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    async def reply_to(asked: bytes) -> tuple[bytes, bytes, bytes]:
        reader, writer = await server.connect()
        writer.write(asked)
        return (await reader.read()).partition(b"\r\n\r\n")

    async with scrape_server(monkeypatch) as server:
        server.go_on.set()
        server.error = KeyError("axes")
        head, end, body = await reply_to(b"HEAD /metrics HTTP/1.1\r\n\r\n")
        assert (head.partition(b"\r\n")[0], end, body) == (b"HTTP/1.1 500 Internal Server Error", b"\r\n\r\n", b"")
        monkeypatch.setattr(scrapes, "MOST_ASKING", 0)
        head, end, body = await reply_to(b"HEAD /metrics HTTP/1.1\r\n\r\n")
        assert (head.partition(b"\r\n")[0], end, body) == (b"HTTP/1.1 503 Service Unavailable", b"\r\n\r\n", b"")
        assert (await reply_to(b"GET /metrics HTTP/1.1\r\n\r\n"))[2] == b"too many ask at once\n"


@pytest.mark.asyncio
async def test_a_metric_that_cannot_be_collected_is_reported_to_the_scraper() -> None:
    def fail() -> tuple[OutputStatistics, ...]:
        raise KeyError("sqlite")

    output = MetricsOutput("metrics", MetricsSettings(port=0), BUS, outputs=fail)
    output.start()
    await asyncio.to_thread(until, lambda: output.port != 0)
    with pytest.raises(urllib.error.HTTPError) as failed:
        await asyncio.to_thread(scraped, output.port)
    with failed.value as reply:
        assert (reply.code, reply.read()) == (500, b"KeyError('sqlite')\n")
    await asyncio.to_thread(output.close, PATIENCE)


@pytest.mark.asyncio
async def test_a_page_is_compressed_for_those_who_take_that_and_an_error_is_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    async with scrape_server(monkeypatch) as server:
        server.go_on.set()
        head, _, body = (await (await server.ask("Accept-Encoding: deflate, gzip")).read()).partition(b"\r\n\r\n")
        assert b"Content-Encoding: gzip" in head
        assert f"Content-Length: {len(body)}".encode() in head
        assert gzip.decompress(body) == b"page for "
        assert b"Content-Encoding: gzip" in await (await server.ask("Accept-Encoding: GZIP; q=0.5, deflate")).read()
        for rejected in ("deflate", "gzip;q=0", "deflate, gzip; q=0.000"):
            assert b"Content-Encoding" not in await (await server.ask(f"Accept-Encoding: {rejected}")).read()
        server.error = ValueError("a bug")
        reply = await (await server.ask()).read()
        assert reply.startswith(b"HTTP/1.1 500 ")
        assert b"ValueError('a bug')" in reply
        reader, writer = await server.connect()
        writer.write(b"POST / HTTP/1.1\r\n\r\n")
        assert b"\r\nAllow: GET, HEAD\r\n" in await reader.read()
