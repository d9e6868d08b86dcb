"""Report by exception: outputs are told what is news, and the rest is counted, not lost."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import replace
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from busmaster import MemoryPort
from busmaster.app.config import LineFile, emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine
from busmaster.app.outputs.distributor import News, differs
from busmaster.bus.meaning import Meaning
from busmaster.bus.polling import Quality, Snapshot
from busmaster.errors import GarbledReply, NoReply
from tests.app.outputs.cycles import cycle


def meant(snapshot: Snapshot, *meanings: Meaning) -> Snapshot:
    """Return the cycle, whose points mean this."""
    points = zip(snapshot.samples.items(), meanings, strict=True)
    return replace(snapshot, samples={replace(point, meaning=what): sample for (point, sample), what in points})


def news(*values: Any, period: float = 1.0, **said: Any) -> list[Any]:
    """Return which of these values of one point, a cycle each, are news."""
    known, meaning = News(), Meaning(**said)
    found: list[Any] = []
    for number, value in enumerate(values):
        told = known.of(meant(cycle(number, value, at=number * period), meaning))
        found += [sample.value if sample.error is None else "error" for sample in told.samples.values()]
    return found


def test_a_value_is_news_where_it_is_further_than_the_deadband_from_what_was_told() -> None:
    assert news(1.0, 1.3, 1.5, 1.51, 1.2, 1.0, deadband=0.5) == [1.0, 1.51, 1.0]
    assert news(1, 1, 2, 2, 1, deadband=0) == [1, 2, 1]
    assert news(1.0, 1.0) == [1.0, 1.0]


def test_a_slow_drift_is_told_since_it_is_measured_from_what_was_told() -> None:
    drift = [number / 10 for number in range(31)]
    assert news(*drift, deadband=0.95) == [0.0, 1.0, 2.0, 3.0]


def test_the_heartbeat_tells_what_did_not_change_on_the_grid() -> None:
    assert news(*[5] * 11, period=0.1, heartbeat=0.3) == [5, 5, 5, 5]
    assert news(*[5] * 20, period=0.1, heartbeat=0.2) == [5] * 10
    assert news(5, 5, 5, 6, 6, 6, 6, period=1, deadband=0, heartbeat=3) == [5, 6, 6]


def test_the_same_value_is_news_where_it_was_stale_or_bad_in_between() -> None:
    outdated: list[float] = []
    known = News(lambda _, asked: asked in outdated)
    first = meant(cycle(0, 5.0, at=0.0), Meaning(deadband=1))
    assert len(known.of(first)) == 1
    assert len(known.of(first)) == 0
    [sample] = first.samples.values()
    outdated.append(sample.finished if sample.started is None else sample.started)
    assert len(known.of(first)) == 1


def test_a_change_of_quality_is_always_news() -> None:
    gone = NoReply("no reply within 100 ms")
    assert news(1.0, gone, NoReply("no reply within 101 ms"), 1.0, 1.0, deadband=10) == [1.0, "error", 1.0]
    known, meaning = News(), Meaning(deadband=10)
    late = cycle(1, 1.0)
    late = replace(late, samples={p: s._replace(quality=Quality.LATE) for p, s in late.samples.items()})
    garbled = cycle(1, gone)
    garbled = replace(garbled, samples={p: s._replace(error=GarbledReply("?")) for p, s in garbled.samples.items()})
    seen = [known.of(meant(what, meaning)) for what in (cycle(1, 1.0), late, late, cycle(1, gone), garbled)]
    assert list(map(len, seen)) == [1, 1, 0, 1, 1]


@pytest.mark.parametrize(
    ("before", "now", "deadband", "differ"),
    [
        (1, 1, 0, False),
        (1, 2, 1, False),
        (1, 2.5, 1, True),
        (nan, nan, 1, False),
        (nan, 1, 1e9, True),
        (1, nan, 1e9, True),
        (inf, inf, 1, False),
        (inf, -inf, 1, True),
        ((1, 2), (1, 2.4), 0.5, False),
        ((1, 2), (1, 3), 0.5, True),
        ((1, 2), (1,), 9, True),
        ((1, 2), 1, 9, True),
        (1, (1, 2), 9, True),
        ("a", "a", 0, False),
        ("a", "b", 0, True),
        (frozenset({1}), frozenset({2}), 0, True),
        (None, None, 0, False),
        ("tripped", 3, 9, True),
        (3, "tripped", 9, True),
        (3, None, 9, True),
    ],
)
def test_values_of_any_kind_are_compared(before: Any, now: Any, deadband: float, differ: bool) -> None:
    assert differs(before, now, deadband) is differ


@given(st.lists(st.integers(0, 8), min_size=1, max_size=40), st.integers(0, 3), st.sampled_from([None, 2.0, 5.0]))
def test_whoever_listens_is_never_further_off_than_the_deadband_nor_older_than_the_heartbeat(
    values: list[int], deadband: int, heartbeat: float | None
) -> None:
    known, meaning = News(), Meaning(deadband=deadband, heartbeat=heartbeat)
    last, since = values[0], 0
    for number, value in enumerate(values):
        told = known.of(meant(cycle(number, value, at=float(number)), meaning))
        for sample in told.samples.values():
            last, since = sample.value, number
        assert abs(value - last) <= deadband
        assert heartbeat is None or number - since < heartbeat


def test_points_of_which_nothing_is_said_are_told_each_time_beside_others() -> None:
    known, only = News(), Meaning(deadband=5)
    first, second = (known.of(meant(cycle(n, 1.0, 2.0), only, Meaning())) for n in (1, 2))
    assert [point.item for point in first] == ["1", "2"]
    assert [point.item for point in second] == ["2"]
    plain = meant(cycle(1, 1.0), Meaning())
    assert known.of(plain) is plain


TEXT = """
port = "/dev/ttyUSB0"
[nodes.winder]
protocol = "hcp2"
address = 1
[nodes.winder.points]
force = { item = "1", deadband = 0.5 }
status = { item = "2", bits = { READY = 0 }, deadband = 0 }
[groups.fast]
period = 0.02
points = "winder/force,status,3"
[emulator]
lively = false
[outputs.jsonl]
path = "FOLDER/x.jsonl"
"""


def opened(folder: Path, text: str = TEXT) -> ConfiguredLine:
    parsed = file(folder, text)
    return ConfiguredLine(parsed, port=MemoryPort(emulated_line(parsed)))


def file(folder: Path, text: str) -> LineFile:
    return read(Source("line.toml", text.replace("FOLDER", str(folder))))


def of(folder: Path, key: str) -> list[Any]:
    lines = map(json.loads, (folder / "x.jsonl").read_text().splitlines())
    cycles: list[Mapping[str, Any]] = [line["samples"] for line in lines if "samples" in line]
    return [samples[key]["value"] for samples in cycles if key in samples]


@pytest.mark.asyncio
async def test_the_poll_and_its_consumers_have_every_value_and_what_outputs_do_not_get_is_counted(
    tmp_path: Path,
) -> None:
    line = opened(tmp_path)
    seen: list[int] = []
    async with line:
        async for snapshot in line.groups["fast"]:
            seen.append(len(snapshot))
            if len(seen) == 3:
                await line.nodes["winder"].point("2").write(1)
            if snapshot[line.point("winder/status")].value == 1:
                break
    cycles = line.groups["fast"].statistics().cycles
    assert set(seen) == {4}
    told = {key: of(tmp_path, f"winder/{key}") for key in ("force", "status", "status.READY", "3")}
    # each value once, and once more where it was late, stale or not read, which is another quality
    values = {key: [value for value in dict.fromkeys(found) if value is not None] for key, found in told.items()}
    assert values == {"force": [0], "status": [0, 1], "status.READY": [0, 1], "3": [0]}
    assert len(told["3"]) == cycles
    [counts] = line.outputs.statistics()
    events = sum('"event"' in line for line in (tmp_path / "x.jsonl").read_text().splitlines())
    assert counts.written - events == sum(map(len, told.values()))
    objects = [one for one in map(json.loads, (tmp_path / "x.jsonl").read_text().splitlines()) if "cycle" in one]
    again = [len(one["samples"]) for n, one in enumerate(objects) if n and one["cycle"] == objects[n - 1]["cycle"]]
    assert sum(again) <= 2  # what the write made stale: two points of one word
    assert counts.suppressed == 4 * cycles + sum(again) - counts.written + events > 0
    assert counts.dropped == 0


@pytest.mark.asyncio
async def test_after_the_file_was_read_again_outputs_are_told_all_once_more(tmp_path: Path) -> None:
    line = opened(tmp_path)
    async with line:
        cycles = line.groups["fast"].subscribe(100)
        await anext(cycles)
        await line.take(file(tmp_path, TEXT))
        await anext(cycles)
    assert len(of(tmp_path, "winder/force")) >= 2


@pytest.mark.asyncio
async def test_after_the_file_was_read_again_the_values_of_every_group_are_told_once_more(tmp_path: Path) -> None:
    text = TEXT.replace('"winder/force,status,3"', '"winder/force"')
    text = text.replace("[emulator]", '[groups.slow]\nperiod = 0.02\npoints = "winder/status"\n[emulator]')
    line = opened(tmp_path, text)
    async with line:
        streams = [line.groups[name].subscribe(100) for name in ("fast", "slow")]
        for cycles in streams:
            await anext(cycles)
        await line.take(file(tmp_path, text))
        for cycles in streams:
            await anext(cycles)
    assert [len(of(tmp_path, f"winder/{key}")) >= 2 for key in ("force", "status")] == [True, True]
