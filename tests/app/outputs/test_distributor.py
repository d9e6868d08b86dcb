"""From the line to its outputs: what is polled and what happens reaches each of them."""

from __future__ import annotations

import asyncio
import json
import os
import sqlite3
import time
from collections.abc import AsyncIterator
from contextlib import closing
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, ClassVar

import anyio
import pytest

from busmaster import Bus, Hcp2Controller, Health, MemoryPort, Snapshot
from busmaster.app.config import FileError, emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs import distributor
from busmaster.app.outputs.base import Happening, Item, Kept, Output, OutputKind, OutputLine
from busmaster.app.outputs.distributor import Distributor, News, Wanted, label_of
from busmaster.app.outputs.settings import FileSettings, MqttSettings, Settings
from busmaster.app.service.record import Outcome, WriteRecord
from busmaster.bus.meaning import Meaning
from busmaster.bus.node import Node
from busmaster.emulator.line import Line
from busmaster.events import (
    AlarmChanged,
    BusEvent,
    LineChange,
    LineChanged,
    MaxReplyDelayLowered,
    MaxReplyDelayRaised,
    NodeChanged,
    PortFailed,
    RepliesLate,
)
from busmaster.ext import Outdated
from busmaster.registry import make_device
from tests.app.outputs.cycles import BUS, NODE, cycle
from tests.app.outputs.test_audit import WRITE
from tests.app.outputs.test_exceptions import meant
from tests.patience import PATIENCE

TEXT = """
port = "/dev/ttyUSB0"
[nodes.winder]
protocol = "hcp2"
address = 1
[nodes.away]
protocol = "hcp2"
address = 2
[groups.fast]
period = 0.02
points = "winder/1-2"
[groups.slow]
period = 0.1
points = "winder/3"
[emulator.nodes.away]
faults = { dead = 1 }
[outputs.sqlite]
path = "FOLDER/x.db"
[outputs.jsonl]
path = "FOLDER/x.jsonl"
groups = ["slow"]
"""


def opened(folder: Path, text: str = TEXT, outputs: bool = True) -> ConfiguredLine:
    file = read(Source("line.toml", text.replace("FOLDER", str(folder))))
    return ConfiguredLine(file, port=MemoryPort(emulated_line(file)), outputs=outputs)


async def run(line: ConfiguredLine, cycles: int) -> None:
    async with line:
        async for snapshot in line.groups["fast"]:
            if snapshot.cycle >= cycles:
                break


@pytest.mark.asyncio
async def test_nothing_is_lost_between_the_line_and_an_output(tmp_path: Path) -> None:
    """What was polled before the line was closed is written when it is closed."""
    line = opened(tmp_path)
    await run(line, 20)
    check_written(line, tmp_path)


@pytest.mark.asyncio
async def test_nothing_is_lost_if_the_program_is_cancelled_and_stays_so(tmp_path: Path) -> None:
    """As in a task group of anyio: every wait in a cancelled scope is cancelled, also one while the line is closed."""
    line = opened(tmp_path)
    with anyio.CancelScope() as scope:
        async with line:
            async for snapshot in line.groups["fast"]:
                if snapshot.cycle >= 20:
                    scope.cancel()
    check_written(line, tmp_path)


def check_written(line: ConfiguredLine, folder: Path) -> None:
    counts = {output.kind: output for output in line.outputs.statistics()}
    assert counts["sqlite"].dropped == counts["sqlite"].waiting == 0
    polled = 2 * line.groups["fast"].statistics().cycles + line.groups["slow"].statistics().cycles
    with closing(sqlite3.connect(folder / "x.db")) as database:
        [samples] = database.execute("select count(*) from samples").fetchone()
        [events] = database.execute("select count(*) from events").fetchone()
    assert samples == polled
    assert samples + events == counts["sqlite"].written


@pytest.mark.asyncio
async def test_an_output_gets_the_groups_that_it_asked_for_and_all_events(tmp_path: Path) -> None:
    line = opened(tmp_path)
    async with line:
        await Node.of(line.nodes["away"]).probe()
        async for _ in line.groups["slow"]:
            break
    objects = [json.loads(text) for text in (tmp_path / "x.jsonl").read_text().splitlines()]
    assert {found["group"] for found in objects if "group" in found} == {"slow"}
    assert ("away is down, was unknown", "away") in [(found.get("event"), found.get("node")) for found in objects]


@pytest.mark.asyncio
async def test_each_output_of_a_line_reports_why_it_is_down(tmp_path: Path) -> None:
    text = TEXT.partition("[outputs.sqlite]")[0]
    for kind in ("csv", "jsonl", "sqlite"):
        (tmp_path / kind).mkdir()
        text += f'[outputs.{kind}]\npath = "FOLDER/{kind}"\n'
    reported: list[str] = []
    line = opened(tmp_path, text)
    line.outputs.report = reported.append
    async with line, asyncio.timeout(PATIENCE):
        while len(reported) < 3:  # noqa: ASYNC110  threads report it
            await asyncio.sleep(0.01)
    assert sorted(reported[:3]) == [
        f"{kind} is down: {tmp_path}/{kind}: Is a directory" for kind in ("csv", "jsonl", "sqlite")
    ]


@pytest.mark.asyncio
async def test_without_outputs_nothing_is_written(tmp_path: Path) -> None:
    await run(opened(tmp_path, outputs=False), 1)
    assert os.listdir(tmp_path) == []


def test_an_extra_that_is_not_there_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    for output, extra in (("mqtt", "mqtt"), ("metrics", "metrics")):
        with pytest.raises(FileError, match=rf"outputs\.{output}: .* pip install 'busmaster\[{extra}\]'"):
            opened(tmp_path, f"{TEXT}[outputs.{output}]\n")


@pytest.mark.asyncio
async def test_a_bug_that_ends_the_feed_of_the_outputs_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(_: object, snapshot: Snapshot) -> Snapshot:
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr(News, "of", broken)
    reported: list[str] = []
    line = opened(tmp_path)
    line.outputs.report = reported.append
    await run(line, 3)
    assert "outputs get no more values of fast: ZeroDivisionError: a bug; report this bug, and restart" in "".join(
        reported
    )


@pytest.mark.asyncio
async def test_an_event_of_a_node_has_its_label_and_one_of_the_line_has_none(tmp_path: Path) -> None:
    line = opened(tmp_path, outputs=False)
    async with line:
        node, point = line.bus.nodes[0]._record, line.groups["fast"].points[0]
        events: list[BusEvent] = [
            NodeChanged(node, Health.UP, Health.DOWN, returning=False),
            MaxReplyDelayRaised(node, age=0.2, max_reply_delay=0.25),
            MaxReplyDelayLowered(node, max_reply_delay=0.15),
            RepliesLate(node, age=0.12, window=0.1),
            AlarmChanged(point, limit="high", bound=5.0, value=6.0, active=True),
        ]
        assert [label_of(event) for event in events] == ["winder"] * len(events)
        assert label_of(LineChanged(LineChange.UP)) == label_of(PortFailed("unplugged")) == ""


def test_an_output_is_another_one_if_its_settings_or_what_it_lets_others_write_differ() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line)))
    point, settings = Hcp2Controller(bus, 5).point("1"), MqttSettings()
    wanted = Wanted(settings, {"5/1": point})
    assert wanted.same(Wanted(MqttSettings(), {"5/1": point}))
    assert not wanted.same(None)
    assert not wanted.same(Wanted(MqttSettings(port=1884), {"5/1": point}))
    assert not wanted.same(Wanted(settings, {}))
    assert not wanted.same(Wanted(settings, {"5/1": point, "5/2": point}))
    assert not Wanted(settings, {}).same(wanted)
    assert not wanted.same(Wanted(settings, {"5/1": replace(point)})), "an equal point may have another scale"


# the distributor alone


class Listed(Output):
    """Keeps its items. Its thread does nothing."""

    order: ClassVar[list[str]] = []

    def __init__(self, kind: str, settings: Settings, line: OutputLine) -> None:
        super().__init__(kind, settings, line.report)
        self.line = line
        self.items: list[Item] = []
        self.entries: list[Kept] = []
        self.reopened = 0

    def offer(self, item: Item) -> None:
        super().offer(item)
        self.items.append(item)

    def offer_entry(self, entry: WriteRecord, kept: Kept) -> None:
        self.entries.append(kept)

    def reopen(self) -> None:
        self.reopened += 1

    def close_interface(self) -> None:
        self.order.append("interface")

    def work(self) -> None:
        self._stop.wait()
        self.order.append("closed")
        self._waiting.clear()
        self.written = self.offered - self.dropped

    @property
    def cycles(self) -> list[int]:
        return [item.cycle for item in self.items if isinstance(item, Snapshot)]

    @property
    def texts(self) -> list[str]:
        return [item.text for item in self.items if isinstance(item, Happening)]


class First(Listed):
    """Finds out by itself what a write has made stale."""

    finds_outdated = True


@pytest.fixture
def _listed(monkeypatch: pytest.MonkeyPatch) -> None:
    def found(name: str) -> OutputKind:
        made = First if name == "first" else Listed
        return OutputKind(
            name=name, settings=Settings, make=lambda settings, line: made(name, settings, line), about="A list."
        )

    monkeypatch.setattr(Listed, "order", [])
    monkeypatch.setattr(distributor, "find", found)


class Cycles:
    """The cycles of a source; with each comes how many were dropped before it."""

    def __init__(self, *steps: tuple[Snapshot, int]) -> None:
        self._steps = steps
        self.dropped = 0

    async def __aiter__(self) -> AsyncIterator[Snapshot]:
        for snapshot, dropped in self._steps:
            self.dropped = dropped
            yield snapshot


class Fed:
    """A source of these cycles, which begin again with each subscription."""

    def __init__(self, name: str, *steps: tuple[Snapshot, int]) -> None:
        self.name = name
        self.points = tuple(steps[0][0].samples)
        self.subscriptions = 0
        self._steps = steps

    def subscribe(self, _buffer: int, /, *, changes: bool = False) -> Any:
        assert changes
        self.subscriptions += 1
        return Cycles(*self._steps)


def listed(outputs: Distributor) -> dict[str, Listed]:
    return {output.kind: output for output in outputs._outputs if isinstance(output, Listed)}


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_of_outputs_that_are_replaced_each_gets_each_cycle_and_event_once() -> None:
    bus = Bus(MemoryPort(Line(Hcp2Controller.profile.line, [make_device("hcp2", 5)], paced=False)))
    reported: list[str] = []
    kept, changed = Wanted(Settings(), {}), Wanted(Settings(buffer=7), {})
    async with bus:
        point = Hcp2Controller(bus, 5).point("1")
        one = bus.poll_group("one", period=1000.0, points=[point])
        outputs = Distributor(bus, reported.append)
        for kind in ("kept", "changed", "left"):
            outputs.add(kind, Settings())
        outputs.start([one])
        before = listed(outputs)
        two = bus.poll_group("two", period=1000.0, points=[point])
        for _ in range(2):  # the second time nothing is another one
            await outputs.replace({"kept": kept, "changed": changed}, [one, two])
        after = listed(outputs)
        await Node.of(Hcp2Controller(bus, 6)).probe()
        async with asyncio.timeout(PATIENCE):
            while any(
                len({item.group for item in of.items if isinstance(item, Snapshot)}) < 2 for of in after.values()
            ):
                one.demand()
                two.demand()
                await asyncio.sleep(0.01)
    await outputs.close()
    assert list(after) == ["kept", "changed"]
    assert after["kept"] is before["kept"]
    assert after["kept"].reopened == 2
    assert after["changed"] is not before["changed"]
    assert after["changed"].reopened == 1
    assert [text for text in reported if "is ended" in text] == ["left is ended: 0 written, 0 dropped"]
    for output in after.values():
        groups = [(item.group, item.cycle) for item in output.items if isinstance(item, Snapshot)]
        assert sorted(set(groups)) == sorted(groups)
        assert {"one", "two"} == {group for group, _ in groups}
        assert output.texts.count("node 6 is down, was unknown") == 1
        assert all(abs(item.time - time.time()) < 600 for item in output.items if isinstance(item, Happening))


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_cycles_that_the_loop_was_too_slow_for_are_counted_once_with_all_of_their_values() -> None:
    outputs = Distributor(BUS)
    outputs.add("all", Settings())
    outputs.add("other", Settings(groups=("other", "axes")))
    outputs.add("none", Settings(groups=("other",)))
    source = Fed("axes", *((cycle(number, 1.0, 2.0), dropped) for number, dropped in ((1, 0), (4, 2), (5, 2), (7, 3))))
    outputs.start([source])
    await asyncio.gather(*outputs._feeding.values())
    counts = [output.dropped for output in outputs._outputs]
    cycles = [output.cycles for output in listed(outputs).values()]
    await outputs.close()
    assert counts == [6, 6, 0]
    assert cycles == [[1, 4, 5, 7], [1, 4, 5, 7], []]


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_missed_cycles_count_with_all_of_their_values_though_some_are_suppressed() -> None:
    outputs = Distributor(BUS)
    outputs.add("all", Settings())
    steps = [(meant(cycle(number, 1.0, 2.0), Meaning(deadband=5), Meaning()), number - 1) for number in (1, 2)]
    outputs.start([Fed("axes", *steps)])
    await asyncio.gather(*outputs._feeding.values())
    [counts] = outputs.statistics()
    await outputs.close()
    assert (counts.dropped, counts.suppressed) == (2, 1)


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_a_new_group_of_the_same_name_is_followed_while_the_one_before_it_has_not_ended() -> None:
    outputs = Distributor(BUS)
    outputs.add("all", Settings())
    outputs.start([Fed("axes", (cycle(1, 1.0), 0))])
    await outputs.replace({"all": Wanted(Settings(), {})}, [Fed("axes", (cycle(2, 1.0), 0))])
    await asyncio.gather(*outputs._feeding.values())
    [output] = listed(outputs).values()
    assert output.cycles == [1, 2]
    await outputs.close()


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_a_source_that_has_ended_is_followed_again_when_it_is_there_again() -> None:
    outputs = Distributor(BUS)
    outputs.add("all", Settings())
    source = Fed("axes", (cycle(1, 1.0), 0))
    outputs.start([source])
    await asyncio.gather(*outputs._feeding.values())
    await outputs.replace({"all": Wanted(Settings(), {})}, [source])
    await asyncio.gather(*outputs._feeding.values())
    assert source.subscriptions == 2
    await outputs.close()


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_what_a_write_made_stale_comes_to_outputs_behind_one_that_finds_it_by_itself() -> None:
    outputs = Distributor(BUS)
    for kind in ("first", "second"):
        outputs.add(kind, Settings())
    stale = Outdated(**{field.name: getattr(cycle(2, 1.0), field.name) for field in fields(Snapshot)})
    outputs.start([Fed("axes", (cycle(1, 1.0), 0), (stale, 0))])
    await asyncio.gather(*outputs._feeding.values())
    assert [output.cycles for output in listed(outputs).values()] == [[1], [1, 2]]
    await outputs.close()


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_cycles_missed_before_a_stale_value_count_at_an_output_that_finds_it_by_itself() -> None:
    outputs = Distributor(BUS)
    for kind in ("first", "second"):
        outputs.add(kind, Settings())
    stale = Outdated(**{field.name: getattr(cycle(5, 1.0), field.name) for field in fields(Snapshot)})
    outputs.start([Fed("axes", (cycle(1, 1.0), 0), (stale, 3), (cycle(6, 1.0), 3))])
    await asyncio.gather(*outputs._feeding.values())
    counts = [output.dropped for output in outputs._outputs]
    await outputs.close()
    assert counts == [3, 3]


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_a_cycle_without_a_value_to_report_is_not_offered() -> None:
    outputs = Distributor(BUS)
    outputs.add("all", Settings())
    quiet = [meant(cycle(number, 1.0), Meaning(deadband=5)) for number in (1, 2)]
    outputs.start([Fed("axes", *((snapshot, 0) for snapshot in quiet))])
    await asyncio.gather(*outputs._feeding.values())
    [output] = listed(outputs).values()
    assert output.cycles == [1]
    assert output.statistics().suppressed == 1
    await outputs.close()


STRICT = FileSettings(path="x", audit="strict")


async def turns() -> None:
    """Let calls from other threads arrive."""
    for _ in range(3):
        await asyncio.sleep(0)


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_a_write_is_durable_when_every_strict_output_has_its_entry() -> None:
    outputs = Distributor(BUS)
    for kind, settings in (("one", STRICT), ("batched", Settings()), ("two", STRICT)):
        outputs.add(kind, settings)
    made = listed(outputs)
    written, failed = WRITE._replace(outcome=Outcome.WRITTEN), WRITE._replace(outcome=Outcome.REFUSED)
    assert outputs.record(failed) is None
    durable = outputs.record(written)
    assert durable is not None
    assert made["batched"].items == [failed, written]
    made["one"].entries[0]("")
    await turns()
    assert not durable.done()
    made["two"].entries[0]("")
    await turns()
    assert durable.result() == ""
    durable = outputs.record(written)
    assert durable is not None
    made["two"].entries[1]("two dropped it")
    made["one"].entries[1]("one ended")  # the first reason counts
    await turns()
    assert durable.result() == "two dropped it"
    assert len(made["one"].items) == 1  # of the write that failed


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_without_a_strict_output_a_write_waits_for_none() -> None:
    outputs = Distributor(BUS)
    outputs.add("batched", Settings())
    assert outputs.record(WRITE._replace(outcome=Outcome.WRITTEN)) is None


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_strict_outputs_that_do_not_write_an_entry_in_time_are_named_with_their_reasons(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(distributor, "AUDIT_WITHIN", 0.01)
    outputs = Distributor(BUS)
    for kind, settings in (("one", STRICT), ("two", STRICT), ("three", STRICT), ("other", Settings())):
        outputs.add(kind, settings)
    made = listed(outputs)
    made["two"].error, made["other"].error = "disk full", "gone"
    durable = outputs.record(WRITE._replace(outcome=Outcome.WRITTEN))
    assert durable is not None
    made["three"].entries[0]("")
    async with asyncio.timeout(PATIENCE):
        assert await durable == "one and two did not write it within 0.01 s; two is down: disk full"
    made["one"].entries[0]("")  # too late, and no error
    await turns()


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_of_strict_outputs_that_do_not_write_an_entry_each_has_its_reason(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(distributor, "AUDIT_WITHIN", 0.01)
    outputs = Distributor(BUS)
    for kind in ("one", "two"):
        outputs.add(kind, STRICT)
    made = listed(outputs)
    made["one"].error, made["two"].error = "disk full", "read-only"
    durable = outputs.record(WRITE._replace(outcome=Outcome.WRITTEN))
    assert durable is not None
    async with asyncio.timeout(PATIENCE):
        assert (await durable).endswith("; one is down: disk full; two is down: read-only")


@pytest.mark.usefixtures("_listed")
def test_what_an_output_reports_after_the_loop_has_ended_is_discarded() -> None:
    reported: list[str] = []

    async def opened_and_closed() -> tuple[Distributor, Listed]:
        outputs = Distributor(BUS, reported.append)
        outputs.add("one", STRICT)
        outputs.start(())
        [output] = listed(outputs).values()
        outputs.record(WRITE._replace(outcome=Outcome.WRITTEN))
        output.line.report("in time")
        await outputs.close()
        return outputs, output

    _, output = asyncio.run(opened_and_closed())
    output.entries[0]("")
    output.line.report("too late")
    assert reported == ["in time"]


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_all_interfaces_are_closed_before_any_output_is() -> None:
    outputs = Distributor(BUS)
    for kind in ("one", "two"):
        outputs.add(kind, Settings())
    outputs.start(())
    await outputs.close()
    assert Listed.order == ["interface", "interface", "closed", "closed"]


@pytest.mark.usefixtures("_listed")
@pytest.mark.asyncio
async def test_an_output_knows_of_its_line_what_it_may_report_and_what_others_count() -> None:
    listens = Distributor(BUS, in_charge=False, asks=False)
    polls = Distributor(BUS)
    for outputs in (listens, polls):
        outputs.add("one", Settings(), commands={"5/1": NODE.point("1")})
        outputs.add("two", Settings())
    (one, two), (other, _) = (listed(outputs).values() for outputs in (listens, polls))
    assert (one.line.in_charge, one.line.polls, other.line.in_charge, other.line.polls) == (False, False, True, True)
    assert one.line.commands == {"5/1": NODE.point("1")}
    assert two.line.commands == {}
    assert [counts.kind for counts in one.line.statistics()] == ["one", "two"]
    assert one.line.authorisation is listens.authorisation
