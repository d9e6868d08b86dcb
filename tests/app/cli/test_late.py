"""Controllers that answer after the reply window: their values are delivered, and the commands say what to try."""

from __future__ import annotations

import asyncio
import json
import random
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from busmaster.app.cli import late
from busmaster.app.cli.late import advice, late_nodes
from busmaster.app.cli.output import Level
from busmaster.bus.node import Health
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.serve import PtyServer, TcpServer, serve_pty, serve_tcp
from busmaster.errors import LineDown, NoReply
from busmaster.events import MaxReplyDelayRaised, NodeChanged, RepliesLate
from busmaster.registry import find, make_device
from tests.app.cli.conftest import Command, owner_here
from tests.patience import PATIENCE

LATE = Delay(0.13)
TOO_LATE = Delay(0.2)
DELAYS = {1: 0.102, 2: 0.105, 3: 0.108}
"""Seconds after which controllers answer whose document allows 150 ms; the window is 100 ms. A busy machine adds some:
tests/bus/test_late_replies.py has the last millisecond, in virtual time."""


@pytest.fixture
def slow() -> Iterator[TcpServer]:
    """Two HCP controllers whose replies begin after 130 ms, 30 ms beyond the window, and after 200 ms."""
    devices = [make_device("hcp", 2, delay=LATE), make_device("hcp", 4, delay=TOO_LATE)]
    line = Line(find("hcp").profile.line, devices, chance=random.Random(1), paced=False)
    with serve_tcp(line) as server:
        yield server


@pytest.fixture
def allowed() -> Iterator[PtyServer]:
    """Three controllers that are as late as their document allows."""
    devices = [make_device("hcp2", address, delay=Delay(delay)) for address, delay in DELAYS.items()]
    with serve_pty(Line(find("hcp2").profile.line, devices, chance=random.Random(1))) as server:
        yield server


def test_a_late_value_is_read_and_what_to_try_is_said(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("read", slow.path, "--protocol", "hcp", "--node", "2", "1", "--retries", "0")
    assert (done.status, done.out) == (0, "1 0\n")
    assert "node 2: late reply, 1" in done.err
    assert "; try --timeout 2" in done.err


def test_a_read_of_a_node_beyond_its_max_reply_delay_says_that_it_is_late_and_what_to_try(
    busmaster: Command, slow: TcpServer
) -> None:
    done = busmaster("read", slow.path, "--protocol", "hcp", "--node", "4", "1", "--retries", "0")
    assert done.status == 1
    assert "node 4: no reply within 150 ms" in done.err
    assert "late reply, " in done.err
    assert "; try --timeout 3" in done.err
    assert "check the node's address" not in done.err


def test_of_a_node_that_is_not_there_nothing_is_said_of_max_reply_delay(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("read", slow.path, "--protocol", "hcp", "--node", "3", "1", "--retries", "0")
    assert done.status == 1
    assert "late" not in done.err
    assert "check the node's address" in done.err


def test_a_write_that_is_confirmed_late_says_what_to_try(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("write", slow.path, "--protocol", "hcp", "--node", "2", "1=5")
    assert (done.status, done.out) == (0, "1 ok\n")
    assert "node 2: late reply, 1" in done.err
    assert "; try --timeout 2" in done.err


SLOW_FILE = """
port = "PORT"
[nodes.winder]
protocol = "hcp"
address = 2
timing = { window = 0.02, max_reply_delay = 0.3 }
points.force = { item = "10" }
"""
SET = """format = 1
[drive]
protocol = "hcp"
address = 2
identity = {}
[saved]
time = 2026-01-31T12:00:00Z
[parameters]
"10" = { value = 5 }
"""
IN_FILE, OPTION = "in its section of the file", "; try --timeout "


@pytest.mark.parametrize("owned", [False, True])
@pytest.mark.parametrize(
    "command",
    [
        ("read", "FILE", "winder/force"),
        ("write", "FILE", "winder/force=5"),
        ("trend", "FILE", "winder/force", "--seconds", "0.4"),
        ("params", "save", "FILE", "winder", "-o", "NEW", "--items", "force"),
        ("params", "diff", "SET", "winder@FILE"),
        ("params", "load", "SET", "winder@FILE", "--yes", "--enabled", "--undo", "NEW"),
    ],
)
def test_the_advice_for_a_node_of_a_file_is_a_key_of_the_file(
    busmaster: Command, tmp_path: Path, command: tuple[str, ...], owned: bool
) -> None:
    device = make_device("hcp", 2, delay=Delay(0.04))
    path, saved = tmp_path / "line.toml", tmp_path / "one.toml"
    saved.write_text(SET)
    with serve_tcp(Line(find("hcp").profile.line, [device], chance=random.Random(1), paced=False)) as server:
        path.write_text(SLOW_FILE.replace("PORT", server.path))
        places = {"FILE": str(path), "SET": str(saved), "NEW": str(tmp_path / "new.toml")}
        for name, where in places.items():
            command = tuple(word.replace(name, where) for word in command)
        with owner_here(path, outputs=False) if owned else nullcontext():
            done = busmaster(*command)
    assert "winder: late reply, " in done.err, done.err
    assert IN_FILE in done.err
    assert OPTION not in done.err


@pytest.mark.parametrize(
    "command",
    [
        ("trend", "PORT", "2/10", "--seconds", "0.4"),
        ("params", "save", "PORT", "2", "-o", "NEW", "--items", "10"),
        ("params", "diff", "SET", "2@PORT"),
        ("params", "load", "SET", "2@PORT", "--yes", "--enabled", "--undo", "NEW"),
    ],
)
def test_the_advice_for_a_node_of_a_port_is_an_option(
    busmaster: Command, slow: TcpServer, tmp_path: Path, command: tuple[str, ...]
) -> None:
    saved = tmp_path / "one.toml"
    saved.write_text(SET)
    for name, where in {"PORT": slow.path, "SET": str(saved), "NEW": str(tmp_path / "new.toml")}.items():
        command = tuple(word.replace(name, where) for word in command)
    done = busmaster(*command, "--protocol", "hcp")
    assert "node 2: late reply, 1" in done.err, done.err
    assert OPTION in done.err
    assert IN_FILE not in done.err


@dataclass
class Late:
    """A bus with these events, after which it is silent."""

    happened: Sequence[object]

    async def events(self) -> AsyncIterator[object]:
        for event in self.happened:
            yield event
        await asyncio.Event().wait()


def node(address: int) -> Any:
    return SimpleNamespace(address=address, label=f"node {address}")


def test_the_advice_is_a_window_half_as_long_again_in_steps_of_50_ms() -> None:
    assert advice(0.13) == "late reply, 130 ms after the request; try --timeout 200"
    assert advice(0.19) == "late reply, 190 ms after the request; try --timeout 300"
    assert advice(0.2) == "late reply, 200 ms after the request; try --timeout 300"
    assert advice(0.21, in_file=True) == (
        "late reply, 210 ms after the request; set timing = { window = 0.35 } in its section of the file"
    )


def test_each_node_that_is_late_has_its_advice_once_with_the_latest_reply(monkeypatch: pytest.MonkeyPatch) -> None:
    notes: list[tuple[str, Level]] = []
    monkeypatch.setattr(late, "note", lambda text, level=Level.INFO: notes.append((text, level)))
    happened = [
        RepliesLate(node(1), 0.11, 0.1),
        NodeChanged(node(9), Health.UP, Health.UNKNOWN, False),
        MaxReplyDelayRaised(node(2), 0.21, 0.21),
        RepliesLate(node(1), 0.13, 0.1),
    ]

    async def story() -> None:
        async with late_nodes(Late(happened), in_file=True) as found:  # type: ignore[arg-type]  # a stand-in
            await asyncio.sleep(0)
            first = len(asyncio.all_tasks())
            found.print_advice()
            found.print_advice()
            assert len(notes) == 2, "once for each"
        for _ in range(3):
            await asyncio.sleep(0)
        assert len(asyncio.all_tasks()) == first - 1, "it does not listen any more"

    asyncio.run(story())
    in_file = "in its section of the file"
    assert notes == [
        (f"node 1: late reply, 130 ms after the request; set timing = {{ window = 0.2 }} {in_file}", Level.WARNING),
        (f"node 2: late reply, 210 ms after the request; set timing = {{ window = 0.35 }} {in_file}", Level.WARNING),
    ]


def test_an_error_is_explained_by_the_reply_that_comes_after_it_and_reported_only_there(
    capfd: pytest.CaptureFixture[str],
) -> None:
    async def story() -> None:
        bus = Late([RepliesLate(node(1), 0.2, 0.1)])
        async with late_nodes(bus) as found:  # type: ignore[arg-type]  # a stand-in
            error, other, nameless = NoReply("no reply"), NoReply("no reply"), NoReply("no reply")
            error.address, other.address = 1, 2
            for one in (error, other, nameless):
                await found.explain(one, 0.001)
            assert error.hint == advice(0.2)
            assert other.hint == nameless.hint == NoReply.hint

    asyncio.run(story())
    assert capfd.readouterr().err == ""


def test_events_of_the_last_moment_are_reported(capfd: pytest.CaptureFixture[str]) -> None:
    async def story() -> None:
        came = asyncio.Event()

        class Quiet:
            async def events(self) -> AsyncIterator[object]:
                await came.wait()
                yield RepliesLate(node(1), 0.2, 0.1)
                await asyncio.Event().wait()

        async with late_nodes(Quiet()):  # type: ignore[arg-type]  # a stand-in
            came.set()

    asyncio.run(story())
    assert capfd.readouterr().err.startswith("busmaster: node 1: late reply, 200 ms")


@pytest.mark.parametrize("owner", ["replies", "is gone", "is silent"])
def test_an_owner_is_waited_for_at_the_end_as_long_as_it_may_take(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], owner: str
) -> None:
    """Its event comes after the reply that has caused it, and before the next reply."""

    class Remote(Late):
        async def events(self) -> AsyncIterator[object]:
            await asked.wait()
            async for event in super().events():
                yield event

        async def statistics(self) -> None:
            asked.set()
            if owner == "is gone":
                raise LineDown("the owner has ended")
            if owner == "is silent":
                await asyncio.Event().wait()

    async def story() -> None:
        async with asyncio.timeout(PATIENCE), late_nodes(Remote([RepliesLate(node(1), 0.2, 0.1)])):  # type: ignore[arg-type]  # a stand-in
            pass

    monkeypatch.setattr(late, "RemoteBus", Remote)
    monkeypatch.setattr(late, "OWNER_REPLIES_WITHIN", 0.01)
    asked = asyncio.Event()
    asyncio.run(story())
    assert capfd.readouterr().err.startswith("busmaster: node 1: late reply, 200 ms")


def test_advice_is_printed_though_the_command_fails(capfd: pytest.CaptureFixture[str]) -> None:
    async def story() -> None:
        with pytest.raises(NoReply):
            async with late_nodes(Late([RepliesLate(node(1), 0.2, 0.1)])):  # type: ignore[arg-type]  # a stand-in
                raise NoReply("no reply")
        for _ in range(3):
            await asyncio.sleep(0)
        assert len(asyncio.all_tasks()) == 1, "it does not listen any more"

    asyncio.run(story())
    assert capfd.readouterr().err.startswith("busmaster: node 1: late reply, 200 ms")


@pytest.mark.slow
def test_a_scan_finds_who_is_late_and_names_who_is_too_late(busmaster: Command, slow: TcpServer) -> None:
    done = busmaster("scan", slow.path, "--protocol", "hcp", "--nodes", "1-4")
    assert done.status == 0
    assert done.out.startswith("2 read element 1: 0\n")
    assert "node 2: late reply, 1" in done.err
    assert "node 4: late reply, " in done.err


@pytest.mark.slow
def test_r2_poll_prints_every_value_of_nodes_that_are_as_late_as_their_document_allows(
    busmaster: Command, allowed: PtyServer
) -> None:
    for _ in range(3):  # on a busy machine, a reply can be later than the drive sends it
        done = busmaster(
            *("poll", allowed.path, "--protocol", "hcp2", "--nodes", "1-3"),
            *("--items", "1", "--period", "0.6", "--seconds", "2.2", "--json"),
        )
        assert done.status == 0
        cycles = [json.loads(line) for line in done.lines]
        values = [value for cycle in cycles for value in cycle["samples"].values()]
        if "is down" not in done.err and all(value["late"] for value in values):
            break
    assert len(cycles) >= 2
    assert len(values) == 3 * len(cycles)
    assert all(value["value"] == 0 and value["late"] for value in values), values
    for node in DELAYS:
        assert f"node {node}: late reply, 1" in done.err
    assert "; try --timeout 200" in done.err
    assert "is down" not in done.err


@pytest.mark.slow
def test_r2_run_delivers_every_value_of_such_nodes_and_says_what_to_write(
    busmaster: Command, allowed: PtyServer, tmp_path: Path
) -> None:
    file = tmp_path / "late.toml"
    file.write_text(
        f'port = "{allowed.path}"\n'
        + "".join(
            f'[nodes.drive{node}]\nprotocol = "hcp2"\naddress = {node}\n[nodes.drive{node}.points.state]\nitem = "1"\n'
            for node in DELAYS
        )
        + '[groups.states]\nperiod = 0.6\npoints = ["drive1/state", "drive2/state", "drive3/state"]\n'
    )
    done = busmaster("run", str(file), "--seconds", "2.2", "--json")
    assert done.status == 0
    values = [value for line in done.lines for value in json.loads(line)["samples"].values()]
    assert len(values) >= 6
    assert all(value["value"] == 0 and value["late"] for value in values), values
    for node in DELAYS:
        assert f"drive{node}: late reply, 1" in done.err
    assert "set timing = { window = 0.2 } in its section" in done.err


@pytest.mark.slow
def test_a_scan_in_hcp2_tries_hcp_too(busmaster: Command) -> None:
    line = Line(find("hcp").profile.line, [make_device("hcp", 2), make_device("hcp2", 3)], paced=False)
    with serve_tcp(line) as server:
        done = busmaster("scan", server.path, "--protocol", "hcp2", "--nodes", "1-4", "--timeout", "1000")
    assert done.out == "3 read element 1: 0\n"
    assert "node 2 replies in Host Comms Protocol; use --protocol hcp\n" in done.err
    assert "node 3: late reply" not in done.err
