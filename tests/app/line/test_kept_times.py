"""Reply times that a line has learned are kept for its next run: on an emulated line, in virtual time."""

from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Iterable
from pathlib import Path

import pytest

from busmaster import InvalidCommand, MemoryPort, ext
from busmaster.app.config import emulated_line
from busmaster.app.config.sections import read
from busmaster.app.config.source import Source
from busmaster.app.line import ConfiguredLine, kept_times
from busmaster.bus.node import Node
from busmaster.emulator.line import Echo
from busmaster.statistics import LearnedTimes
from busmaster.testing import run_in_virtual_time

TEXT = """
port = "/dev/ttyUSB0"
timing = "learned"
learned = "FILE"
[nodes.winder]
protocol = "hcp2"
address = 1
[nodes.drive]
protocol = "hcp2"
address = 2
[groups.fast]
period = 0.05
points = ["winder,drive/1"]
"""
LONG = 15.0
"""Seconds in which 200 replies of each node come."""
SHORT = 3.0
"""In which 20 do."""


OFTEN = 20.0
"""Seconds from one keeping to the next, here."""


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kept_times, "KEEP_EVERY", OFTEN)


@pytest.fixture
def text(tmp_path: Path) -> str:
    return TEXT.replace("FILE", str(tmp_path / "learned.json"))


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    return tmp_path / "learned.json"


def opened(text: str, told: Callable[[str], None] = lambda _: None) -> ConfiguredLine:
    file = read(Source("line.toml", text))
    return ConfiguredLine(file, port=MemoryPort(emulated_line(file)), report=told)


def trusted(line: ConfiguredLine) -> set[str]:
    return {
        name
        for name, handle in line.nodes.items()
        if any(times.trusted for times in Node.of(handle).statistics().learned)
    }


def run_for(text: str, seconds: float, told: Callable[[str], None] = lambda _: None) -> set[str]:
    """Run the line, and return the nodes whose times it trusted then."""

    async def main() -> set[str]:
        async with opened(text, told) as line:
            await asyncio.sleep(seconds)
            return trusted(line)

    return run_in_virtual_time(main())


def test_a_line_begins_with_what_its_last_run_has_learned_and_trusts_it_after_fewer_replies(text: str) -> None:
    assert run_for(text, SHORT) == set()
    assert run_for(text, LONG) == {"winder", "drive"}
    assert run_for(text, SHORT) == {"winder", "drive"}


def test_a_run_that_is_too_short_to_learn_leaves_what_was_kept(text: str, kept: Path) -> None:
    run_for(text, LONG)
    before = json.loads(kept.read_text())
    run_for(text, 0.3)
    assert json.loads(kept.read_text()) == before


def test_times_are_kept_while_the_line_runs_too(text: str, kept: Path) -> None:
    def names() -> set[str]:
        return set(json.loads(kept.read_text())["nodes"]) if kept.exists() else set()

    async def main() -> None:
        async with opened(text):
            await asyncio.sleep(OFTEN - 1.0)
            assert names() == set()
            await asyncio.sleep(2.0)
            assert names() == {"winder", "drive"}

    run_in_virtual_time(main())


@pytest.mark.parametrize(
    ("before", "after", "left"),
    [
        ('"/dev/ttyUSB0"', '"/dev/ttyUSB0?baudrate=19200"', set()),
        ('protocol = "hcp2"\naddress = 2', 'protocol = "hcp"\naddress = 2', {"winder"}),
        ('protocol = "hcp2"\naddress = 2', 'protocol = "hcp2"\naddress = 3', {"winder"}),
        ("address = 2", "address = 2\ntiming = { window = 0.12 }", {"winder"}),
        ("[nodes.winder]", "[nodes.reel]", {"drive"}),
    ],
)
def test_what_was_learned_with_other_settings_is_forgotten(text: str, before: str, after: str, left: set[str]) -> None:
    run_for(text, LONG)
    changed = text.replace(before, after)
    assert run_for(changed if "reel" not in after else changed.replace("winder,", "reel,"), SHORT) == left


def test_what_was_learned_at_another_port_is_forgotten(text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run_for(text, LONG)
    for attribute, other in (("name", "/dev/ttyUSB1"), ("receive_latency", 0.001)):
        with monkeypatch.context() as patch:
            patch.setattr(MemoryPort, attribute, other)
            assert run_for(text, SHORT) == set()
    assert run_for(text, SHORT) == {"winder", "drive"}


def test_what_was_learned_without_an_echo_is_forgotten_where_there_is_one(text: str) -> None:
    run_for(text, LONG)

    async def main() -> set[str]:
        file = read(Source("line.toml", text))
        emulated = emulated_line(file)
        emulated.echo = Echo()
        async with ConfiguredLine(file, port=MemoryPort(emulated)) as line:
            await asyncio.sleep(SHORT)
            return trusted(line)

    assert run_in_virtual_time(main()) == set()


DAMAGED = [
    "",
    "{",
    "[]",
    '{"version": 1, "nodes": {}}',
    '{"nodes": {}}',
    '{"version": 2}',
    '{"version": 2, "nodes": {"winder": {"times": []}}}',
    '{"version": 2, "nodes": {"winder": {"settings": "", "times": [{"kind": "Read"}]}}}',
    '{"version": 2, "nodes": {"winder": 5}}',
    '{"version": 2, "nodes": [5]}',
    "\0\0\0\0",
    "[" * 100_000,
]


@pytest.mark.parametrize("damaged", DAMAGED, ids=range(len(DAMAGED)))
def test_a_file_that_is_damaged_is_told_once_and_begun_anew(text: str, kept: Path, damaged: str) -> None:
    kept.write_text(damaged)
    told: list[str] = []
    assert run_for(text, SHORT, told.append) == set()
    assert len(told) == 1
    assert str(kept) in told[0]
    assert "learned again" in told[0]
    told.clear()
    run_for(text, LONG, told.append)
    assert run_for(text, SHORT, told.append) == {"winder", "drive"}
    assert len(told) == 1, "by the second run, for the first had nothing to keep"


@pytest.mark.parametrize(
    ("key", "value"),
    [
        *(("slowest", -1.0), ("received", -1.0), ("pause", float("nan")), ("window", "5"), ("window", 1e400)),
        *(("kind", []), ("packet", 1), ("trusted", 1), ("slowest", True)),
    ],
)
def test_no_time_that_cannot_be_is_taken(text: str, kept: Path, key: str, value: object) -> None:
    run_for(text, LONG)
    said = json.loads(kept.read_text())
    assert key in said["nodes"]["winder"]["times"][0]
    said["nodes"]["winder"]["times"][0][key] = value
    kept.write_text(json.dumps(said))
    told: list[str] = []
    assert run_for(text, SHORT, told.append) == set()
    assert len(told) == 1


def test_where_nothing_can_be_kept_it_is_told_once(text: str, kept: Path) -> None:
    kept.mkdir()
    told: list[str] = []
    run_for(text, 3 * OFTEN, told.append)
    assert told == [
        f"{kept}: Is a directory; reply times are learned again",
        f"{kept}: Is a directory; the learned reply times are not stored",
    ]


def test_a_node_that_was_away_when_the_line_was_opened_begins_with_what_was_kept(text: str) -> None:
    run_for(text, LONG)

    async def main() -> None:
        file = read(Source("line.toml", text))
        emulated = emulated_line(file)
        late = next(device for device in emulated.devices if device.address == 2)
        late.faults.dead = True
        async with ConfiguredLine(file, port=MemoryPort(emulated)) as line:
            await asyncio.sleep(SHORT)
            assert trusted(line) == {"winder"}
            late.faults.dead = False
            await asyncio.sleep(8.0)  # too short for 200 replies
            assert trusted(line) == {"winder", "drive"}

    run_in_virtual_time(main())


def test_a_file_that_is_read_again_may_bring_back_a_node_and_its_times(text: str) -> None:
    run_for(text, LONG)
    alone = text.replace('[nodes.drive]\nprotocol = "hcp2"\naddress = 2\n', "").replace("winder,drive/1", "winder/1")

    async def main() -> None:
        file = read(Source("line.toml", text))
        line = ConfiguredLine(read(Source("line.toml", alone)), port=MemoryPort(emulated_line(file)))
        async with line:
            await asyncio.sleep(SHORT)
            await line.take(file)
            await asyncio.sleep(SHORT)
            assert trusted(line) == {"winder", "drive"}

    run_in_virtual_time(main())


def test_a_file_that_is_read_again_does_not_begin_with_the_kept_times_again(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run_for(text, LONG)
    begun: list[str] = []
    begin_with = ext.begin_with

    def noted(node: Node, times: Iterable[LearnedTimes]) -> None:
        begun.append(node.label)
        begin_with(node, times)

    async def main() -> None:
        async with opened(text) as line:
            await line.take(read(Source("line.toml", text)))

    monkeypatch.setattr(ext, "begin_with", noted)
    run_in_virtual_time(main())
    assert begun == ["winder", "drive"]


def test_a_file_that_is_read_again_may_name_another_place_for_the_times(text: str, kept: Path) -> None:
    other = kept.with_name("other.json")

    async def main() -> None:
        async with opened(text) as line:
            await asyncio.sleep(1.5 * OFTEN)
            await line.take(read(Source("line.toml", text.replace(kept.name, other.name))))

    run_in_virtual_time(main())
    assert json.loads(other.read_text())["nodes"].keys() == json.loads(kept.read_text())["nodes"].keys()


def test_a_file_that_is_read_again_without_a_place_keeps_no_more_times(text: str, kept: Path) -> None:
    reported: list[str] = []

    async def main() -> None:
        async with opened(text, reported.append) as line:
            await asyncio.sleep(1.5 * OFTEN)
            await line.take(read(Source("line.toml", text.replace(f'learned = "{kept}"\n', ""))))
            asyncio.get_running_loop().call_soon(kept.unlink)
            await asyncio.sleep(OFTEN)

    run_in_virtual_time(main())
    assert (list(kept.parent.iterdir()), reported) == ([], [])


def test_what_a_killed_run_left_beside_the_file_is_not_in_the_next_one(text: str, kept: Path) -> None:
    kept.with_name(f"{kept.name}.new").write_text("x" * 100_000)
    run_for(text, LONG)
    assert run_for(text, SHORT) == {"winder", "drive"}
    assert list(kept.parent.iterdir()) == [kept]


def test_the_times_of_each_kind_of_request_are_kept(text: str, kept: Path) -> None:
    async def main() -> int:
        async with opened(text) as line:
            for value in range(250):
                await line.nodes["winder"].write(10, value)
                await line.nodes["winder"].read(10)
            return len(ext.times_to_keep(Node.of(line.nodes["winder"])))

    both = run_in_virtual_time(main())
    assert both > 1
    assert len(json.loads(kept.read_text())["nodes"]["winder"]["times"]) == both


def test_a_disk_that_hangs_holds_up_nothing_and_is_written_by_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    reported: list[str] = []
    released, begun = threading.Event(), list[threading.Thread]()

    def hang(path: str) -> None:
        begun.append(threading.current_thread())
        released.wait()

    line = ConfiguredLine(read(Source("line.toml", TEXT)), outputs=False)
    kept = kept_times.KeptTimes(line.bus, reported.append)
    monkeypatch.setattr(kept_times, "PATIENCE", 0.01)
    try:
        for _ in range(2):
            kept._do(kept_times.NOT_KEPT, hang, "x.json")
            kept._report_trouble()
    finally:
        released.set()
    assert reported == ["x.json: the file system did not respond for 0.01 s; the learned reply times are not stored"]
    [thread] = begun
    assert thread.daemon  # a process can end without it
    thread.join()
    monkeypatch.setattr(kept_times, "PATIENCE", 5.0)
    kept._do(kept_times.NOT_KEPT, hang, "x.json")
    assert len(begun) == 2


@pytest.mark.parametrize(
    ("error", "why"),
    [
        (OSError(28, "No space left on device"), "No space left on device"),
        (OSError("odd"), "the file is damaged, or from another version"),
        (ValueError("odd"), "the file is damaged, or from another version"),
    ],
)
def test_why_times_are_not_kept_is_reported_in_words(
    text: str, kept: Path, error: Exception, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(_: str) -> bytes:
        raise error

    monkeypatch.setattr(kept_times, "read_file", failing)
    reported: list[str] = []
    run_for(text, 0.3, reported.append)
    assert reported == [f"{kept}: {why}; reply times are learned again"]


def test_a_place_without_a_folder_or_without_learning_is_refused(text: str) -> None:
    with pytest.raises(InvalidCommand, match=r"the folder .* does not exist"):
        opened(text.replace("learned.json", "nowhere/learned.json"))
    with pytest.raises(
        InvalidCommand, match='has no effect, because reply times are not learned; add timing = "learned"'
    ):
        opened(text.replace('timing = "learned"\n', ""))


def test_it_is_enough_that_one_node_learns(text: str, kept: Path) -> None:
    one = text.replace('timing = "learned"\n', "").replace("address = 2", 'address = 2\ntiming = "learned"')
    assert run_for(one, LONG) == {"drive"}
    assert set(json.loads(kept.read_text())["nodes"]) == {"drive"}


@pytest.mark.slow
def test_times_that_could_be_kept_again_are_reported_when_they_cannot_be_kept_any_more(text: str, kept: Path) -> None:
    told: list[str] = []

    def block(is_blocked: bool) -> None:
        """Have a folder in the place of the file, or nothing."""
        if not is_blocked:
            return kept.rmdir()
        kept.unlink(missing_ok=True)
        return kept.mkdir()

    async def main() -> None:
        async with opened(text, told.append) as line:
            block(True)
            await asyncio.sleep(1.5 * OFTEN)
            block(False)
            await asyncio.sleep(OFTEN)
            block(True)
            for value in range(250):  # more is learned, so that there is something to keep
                await line.nodes["winder"].write(10, value)
            await asyncio.sleep(OFTEN)

    run_in_virtual_time(main())
    assert told == 2 * [f"{kept}: Is a directory; the learned reply times are not stored"]


def test_a_line_whose_file_was_read_again_leaves_no_task_when_it_is_closed(text: str) -> None:
    async def main() -> None:
        before = asyncio.all_tasks()
        async with opened(text) as line:
            for _ in range(2):
                await line.take(read(Source("line.toml", text)))
        assert asyncio.all_tasks() == before

    run_in_virtual_time(main())


def test_an_error_of_the_file_that_comes_back_is_reported_again() -> None:
    async def story() -> list[str]:
        reported: list[str] = []
        line = ConfiguredLine(read(Source("line.toml", TEXT)), outputs=False)
        kept = kept_times.KeptTimes(line.bus, reported.append)
        for trouble in ("disk full", "disk full", "", "disk full", "read-only"):
            kept._trouble = trouble
            kept._report_trouble()
        return reported

    assert asyncio.run(story()) == ["disk full", "disk full", "read-only"]
