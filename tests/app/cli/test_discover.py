"""`busmaster discover` on real ports: it asks first, finds what is there, and writes a file that runs."""

from __future__ import annotations

import asyncio
import json
import os
import pty
import random
import sys
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import click
import pytest

from busmaster.app.cli import discover
from busmaster.app.cli.capturing import capturing
from busmaster.app.cli.discover import EnterStops, Job, print_plan, what_to_try
from busmaster.app.cli.output import note
from busmaster.app.cli.progress import Bar
from busmaster.app.config import load
from busmaster.app.diagnostics.search import Discovery, Found
from busmaster.app.diagnostics.steps import Step
from busmaster.capture import Recorder
from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Line
from busmaster.emulator.serve import PtyServer, serve_pty, serve_tcp
from busmaster.registry import find, make_device
from busmaster.transport.rfc2217 import Rfc2217Port
from busmaster.transport.serial_port import SerialPort
from tests.app.cli.conftest import Command, ended_once
from tests.patience import PATIENCE

HCP2 = ("--protocol", "hcp2", "--nodes", "1-3")


@pytest.fixture
def unknown() -> Iterator[PtyServer]:
    """A line at a rate that is not the protocol's usual one."""
    devices = [make_device("hcp2", node) for node in (1, 3)]
    with serve_pty(Line(LineSettings(9600), devices, chance=random.Random(1), paced=False)) as server:
        yield server


@pytest.mark.slow
def test_what_it_finds_is_a_file_that_runs(busmaster: Command, unknown: PtyServer, tmp_path: Path) -> None:
    path = tmp_path / "line.toml"
    done = busmaster("discover", unknown.path, *HCP2, "--yes", "-o", str(path))
    assert (done.status, done.out) == (0, ""), done.err
    assert "found Host Comms Protocol 2 at 9600 8N1, nodes 1, 3" in done.err
    file = load(path)
    assert file.port.settings == LineSettings(9600)
    assert {name: node.address for name, node in file.nodes.items()} == {"node1": 1, "node3": 3}
    run = ended_once(
        lambda lines: json.loads(lines[-1])["samples"]["node1/1"]["value"] == 0, "run", str(path), "--json"
    )
    assert run.status == 130, run.err


@pytest.mark.parametrize(
    ("name", "nodes"),
    [
        pytest.param("ct-ansi", (12, 23), marks=pytest.mark.slow),
        pytest.param("microflex", tuple(range(1, 11)), marks=pytest.mark.exhaustive),  # 37 s of waiting
        pytest.param("modbus", (5, 17, 18), marks=pytest.mark.exhaustive),  # a minute
    ],
)
def test_every_node_of_the_protocol_is_found(
    busmaster: Command, tmp_path: Path, name: str, nodes: tuple[int, ...]
) -> None:
    path, settings = tmp_path / "line.toml", find(name).profile.line
    line = Line(settings, [make_device(name, node) for node in nodes], chance=random.Random(1), paced=False)
    with serve_pty(line) as server:
        port = f"{server.path}?baudrate={settings.baudrate}&bytesize={settings.bytesize}&parity={settings.parity}"
        for _ in range(3):  # the drives are in this process: on a busy machine, their replies can be late
            done = busmaster("discover", port, "--protocol", name, "--yes", "-o", str(path))
            found = {node.address: node.protocol for node in load(path).nodes.values()} if done.status == 0 else {}
            if len(found) == len(nodes):
                break
            path.unlink(missing_ok=True)
    assert done.status == 0, done.err
    assert found == dict.fromkeys(nodes, name)
    assert "the other addresses are tried too" in done.err
    assert "not tried" not in done.err


def test_behind_rfc_2217_the_settings_of_the_line_are_tried_as_on_a_serial_port() -> None:
    port, tried = what_to_try("rfc2217://server:4001?dtr=0", ["hcp2"], None)
    assert port == Rfc2217Port("server", 4001, baudrate=9600, dtr=False)
    assert len({step.settings for step in tried}) == 5
    _, tried = what_to_try("rfc2217://server:4001?baudrate=9600&parity=N", ["hcp2"], None)
    assert [step.settings for step in tried] == [LineSettings(9600)]


@pytest.mark.slow
def test_without_a_file_it_is_printed(busmaster: Command, unknown: PtyServer) -> None:
    done = busmaster("discover", f"{unknown.path}?baudrate=9600", *HCP2, "--yes")
    assert done.status == 0
    assert done.out.startswith(f"# What answered on {unknown.path}: Host Comms Protocol 2 at 9600 8N1, nodes 1, 3.\n")
    assert "then 3 reads, at 9600 8N1, in Host" in done.err


def test_the_plan_is_told_and_nothing_is_sent_unless_somebody_says_yes(busmaster: Command, unknown: PtyServer) -> None:
    done = busmaster("discover", unknown.path, *HCP2)
    assert done.status == 2
    assert "listen for 3 s; then 15 reads, at 5 settings of the line, in Host Comms Protocol 2" in done.err
    assert "s if no node replies" in done.err
    assert (
        "confirmation required, but there is no terminal; nothing was sent; use --yes to skip the question" in done.err
    )
    assert unknown.line.host is None


def test_a_file_that_is_there_is_not_overwritten(busmaster: Command, unknown: PtyServer, tmp_path: Path) -> None:
    path = tmp_path / "mine.toml"
    path.write_text("mine")
    done = busmaster("discover", unknown.path, *HCP2, "--yes", "-o", str(path))
    assert done.status == 2
    assert "exists and is not overwritten" in done.err
    assert path.read_text() == "mine"
    folder = busmaster("discover", unknown.path, *HCP2, "--yes", "-o", str(tmp_path))
    assert (folder.status, folder.err.count("\n")) == (2, 1), "nothing is searched"


@pytest.mark.slow
def test_where_nobody_answers_the_status_is_1(busmaster: Command) -> None:
    with serve_tcp(Line(LineSettings(9600), [], paced=False)) as server:
        done = busmaster("discover", server.path, "--protocol", "dc104", "--yes")
    assert (done.status, done.out) == (1, "")
    assert "then 1 read, at the server's own rate, in DC104-SER" in done.err
    assert "no node replied" in done.err
    assert "not tried" not in done.err, "it has no addresses"


@pytest.mark.slow
def test_what_was_not_asked_is_printed(busmaster: Command) -> None:
    with serve_tcp(Line(LineSettings(9600), [], paced=False)) as server:
        done = busmaster("discover", server.path, "--protocol", "msc", "--yes")
    assert done.status == 1
    assert "not tried: msc 9-15" in done.err


@pytest.mark.slow
def test_a_device_server_is_searched_at_the_rate_that_it_has(busmaster: Command) -> None:
    with serve_tcp(Line(LineSettings(9600), [make_device("mentor", 2)], paced=False)) as server:
        done = busmaster("discover", server.path, "--protocol", "mentor", "--nodes", "2", "--yes")
    assert done.status == 0
    assert f"host = {server.host!r}".replace("'", '"') in done.out
    assert "baudrate" not in done.out


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (("unix:/tmp/x.sock",), "discover needs the port itself"),
        (("/dev/null?baud=1",), "no such port option 'baud'"),
        (("/dev/null", "--protocol", "msc", "--nodes", "99"), "nothing is left to try"),
    ],
)
def test_wrong_usage_is_status_2(busmaster: Command, arguments: tuple[str, ...], told: str) -> None:
    done = busmaster("discover", *arguments, "--yes")
    assert done.status == 2
    assert told in done.err


def test_a_port_that_is_not_there_is_an_error_of_the_line(busmaster: Command) -> None:
    done = busmaster("discover", "/dev/no-such-port", "--protocol", "dc104", "--yes")
    assert done.status == 1
    assert "does not exist" in done.err


# steps of a search


@pytest.mark.parametrize("port", ["/dev/ttyS0", "socket://server:4001", "rfc2217://server:4001"])
def test_each_protocol_that_is_named_is_tried_once(port: str) -> None:
    _, tried = what_to_try(port, ["msc", "hcp2", "msc"], (3,))
    settings = [(step.kind.name, step.settings) for step in tried]
    assert {name for name, _ in settings} == {"msc", "hcp2"}
    assert len(set(settings)) == len(settings)
    assert {step.addresses for step in tried} == {(3,)}


def test_all_protocols_are_tried_unless_some_are_named() -> None:
    _, tried = what_to_try("/dev/ttyS0", [], None)
    assert {"hcp2", "msc", "mentor", "modbus"} <= {step.kind.name for step in tried}


@pytest.mark.parametrize(
    ("options", "settings"),
    [
        ("baudrate=4800", {LineSettings(4800, framing[0], framing[1]) for framing in ((8, "N"), (8, "E"), (8, "O"))}),
        ("baudrate=4800&bytesize=7", {LineSettings(4800, 7, "N")}),
        ("baudrate=4800&parity=E", {LineSettings(4800, 8, "E")}),
        ("baudrate=4800&stopbits=2", {LineSettings(4800, 8, "N", 2)}),
    ],
)
def test_a_rate_of_the_port_is_the_only_one_and_so_is_a_framing_with_it(
    options: str, settings: set[LineSettings]
) -> None:
    _, tried = what_to_try(f"/dev/ttyS0?{options}", ["modbus"], None)
    assert {step.settings for step in tried if step.settings} == settings


def plan(port: str, *tried: Step) -> None:
    print_plan(Job(SerialPort(port, baudrate=9600), tried))


def test_the_plan_counts_reads_settings_and_names_each_protocol(capfd: pytest.CaptureFixture[str]) -> None:
    hcp2, msc = find("hcp2"), find("msc")
    fast, slow = LineSettings(57600), LineSettings(9600)
    plan("COM1", Step(fast, hcp2, (1,)))
    plan("COM1", Step(fast, hcp2, (1, 2)), Step(slow, hcp2, (1, 2)), Step(slow, msc, (3,), (4,)))
    one, longest, many, _, rest = capfd.readouterr().err.splitlines()
    assert one == ("busmaster: COM1: listen for 3 s; then 1 read, at 57600 8N1, in Host Comms Protocol 2")
    assert longest == "busmaster: at most 3 s if no node replies; nothing is written to any node"
    assert many == (
        "busmaster: COM1: listen for 3 s; then 5 reads, at 2 settings of the line, in Host Comms Protocol 2, "
        f"{msc.profile.title}"
    )
    assert rest == "busmaster: if a node replies, the other addresses of its protocol are tried too"
    plan("COM1", Step(None, hcp2, (1, 2)), Step(None, hcp2, (3,)))
    assert "then 3 reads, at the server's own rate, in Host Comms Protocol 2\n" in capfd.readouterr().err


# the command, where a search has these results

FOUND = Discovery(LineSettings(9600), found=[Found(find("hcp2"), 3, (0.002,), "element 1: 0", False)])


@pytest.fixture
def searched(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The searches that were begun, each a port and a recorder. One node is found."""
    begun: list[Any] = []

    def until_ended(_: object, job: Job, recorder: Recorder | None) -> Discovery:
        begun.append((job.port, recorder))
        return FOUND

    monkeypatch.setattr(discover, "until_ended", until_ended)
    return begun


@pytest.mark.parametrize("agreed", [True, False])
def test_a_user_at_a_terminal_is_asked_and_only_yes_begins_the_search(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, searched: list[Any], agreed: bool
) -> None:
    asked: list[tuple[str, bool]] = []

    def confirm(question: str, err: bool = False) -> bool:
        asked.append((question, err))
        return agreed

    monkeypatch.setattr(click, "confirm", confirm)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    done = busmaster("discover", "/dev/ttyS0", *HCP2)
    assert asked == [("Send these reads, if no other master is active?", True)]
    assert len(searched) == agreed
    assert done.status == (0 if agreed else 1)
    assert done.out.startswith("# What answered on /dev/ttyS0" if agreed else "")
    assert ("busmaster: nothing was sent\n" in done.err) is not agreed


def test_yes_asks_nothing_and_a_file_gets_the_result(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, searched: list[Any], tmp_path: Path
) -> None:
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    path, capture = tmp_path / "line.toml", tmp_path / "line.pcapng"
    given: list[dict[str, Any]] = []

    def noted(file: str | None, **fields: Any) -> Any:
        given.append(fields)
        return capturing(file, **fields)

    monkeypatch.setattr(discover, "capturing", noted)
    monkeypatch.setattr(discover, "lasting", lambda port: replace(port, path="/dev/serial/by-id/adapter"))
    done = busmaster("discover", "/dev/ttyS0?echo=1", *HCP2, "--yes", "-o", str(path), "--capture", str(capture))
    assert (done.status, done.out) == (0, "")
    assert "\nbusmaster: found Host Comms Protocol 2 at 9600 8N1, node 3\n" in done.err
    assert done.err.endswith(f"busmaster: written to {path}: `busmaster run {path}` polls it\n")
    assert [node.address for node in load(path).nodes.values()] == [3]
    assert load(path).port.name == "/dev/serial/by-id/adapter"
    [(_, recorder)] = searched
    assert recorder.path == str(capture)
    assert given == [{"port": "/dev/ttyS0", "protocol": "", "echo": True}]


def test_a_search_without_a_result_is_a_failure_and_writes_no_file(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(discover, "until_ended", lambda *_: None)
    path = tmp_path / "line.toml"
    for output in ((), ("-o", str(path))):
        done = busmaster("discover", "/dev/ttyS0", *HCP2, "--yes", *output)
        assert (done.status, done.out) == (1, "")
    assert not path.exists()


def test_ctrl_c_at_the_question_is_its_status_and_nothing_is_sent(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, searched: list[Any]
) -> None:
    def confirm(*_: object, **__: object) -> bool:
        raise click.Abort

    monkeypatch.setattr(click, "confirm", confirm)
    monkeypatch.setattr(sys.stdin, "isatty", lambda: True)
    assert busmaster("discover", "/dev/ttyS0", *HCP2).status == 130
    assert searched == []


def test_a_file_that_appears_during_the_search_is_kept(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    path = tmp_path / "line.toml"

    def until_ended(*_: object) -> Discovery:
        path.write_text("mine")
        return FOUND

    monkeypatch.setattr(discover, "until_ended", until_ended)
    done = busmaster("discover", "/dev/ttyS0", *HCP2, "--yes", "-o", str(path))
    assert (done.status, path.read_text()) == (1, "mine")
    assert "File exists" in done.err


class FakeSearch:
    """A search with these results, which notes its steps."""

    talk = ""
    result = Discovery()
    looked = False

    def __init__(self, wire: object, port: object, report: object, progress: object, offered: Callable[[], Any]):
        self.given = (wire, port, report, progress)
        self.offered = offered

    async def listen(self, tried: object) -> str:
        return self.talk

    async def look(self, tried: object) -> Discovery:
        FakeSearch.looked = True
        return self.result


@asynccontextmanager
async def nothing_opened(*_: object) -> AsyncIterator[None]:
    yield None


@pytest.mark.parametrize(
    ("talk", "result", "told"),
    [
        ("a master polls in msc", FOUND, ["a master polls in msc; nothing was sent. `busmaster monitor` shows it; "]),
        ("", Discovery(), ["no node replied; check power"]),
        (
            "",
            Discovery(found=FOUND.found, not_asked={"msc": (9, 10), "hcp2": (0, 9)}),
            ["not tried: msc 9-10", "not tried: hcp2 0, 9"],
        ),
    ],
)
def test_a_search_reports_another_master_silence_and_what_was_not_tried(
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    talk: str,
    result: Discovery,
    told: list[str],
) -> None:
    monkeypatch.setattr(discover, "opened", nothing_opened)
    monkeypatch.setattr(discover, "Search", FakeSearch)
    monkeypatch.setattr(FakeSearch, "talk", talk)
    monkeypatch.setattr(FakeSearch, "result", result)
    monkeypatch.setattr(FakeSearch, "looked", False)
    job = Job(SerialPort("COM1", baudrate=9600), [Step(None, find("hcp2"), (1,))])
    found = asyncio.run(discover.discover(job, None))
    assert FakeSearch.looked is not bool(talk)
    assert (found is not None) == (bool(result.found) and not talk)
    said = capfd.readouterr().err.splitlines()
    assert [line.startswith(f"busmaster: {text}") for line, text in zip(said, told, strict=True)] == [True] * len(told)


# Enter


def test_enter_stops_a_search_and_the_shell_does_not_get_the_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    master, slave = pty.openpty()

    async def story() -> None:
        loop = asyncio.get_running_loop()
        async with EnterStops() as stops:
            pressed, again = stops.offered(), stops.offered()
            assert not pressed()
            os.write(master, b"\n")
            async with asyncio.timeout(PATIENCE):
                while not pressed():  # noqa: ASYNC110  a callback of the loop makes it true
                    await asyncio.sleep(0.001)
            assert again()
        assert not loop.remove_reader(slave), "it is not watched any more"
        os.set_blocking(slave, False)
        with pytest.raises(BlockingIOError):
            os.read(slave, 1)

    with open(slave, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        asyncio.run(story())
    os.close(master)
    assert capfd.readouterr().err == "busmaster: press Enter to stop and keep the nodes found so far\n"


def test_a_search_that_is_not_stopped_gives_standard_input_back(monkeypatch: pytest.MonkeyPatch) -> None:
    master, slave = pty.openpty()

    async def story() -> None:
        async with EnterStops() as stops:
            assert stops.offered()() is False
        assert not asyncio.get_running_loop().remove_reader(slave), "it is not watched any more"

    with open(slave, encoding="utf-8") as terminal:
        monkeypatch.setattr(sys, "stdin", terminal)
        asyncio.run(story())
    os.close(master)


def test_without_a_terminal_nothing_is_offered(capfd: pytest.CaptureFixture[str]) -> None:
    async def story() -> None:
        async with EnterStops() as stops:
            assert stops.offered()() is False

    asyncio.run(story())
    assert capfd.readouterr().err == ""


def test_the_port_of_a_search_is_opened_with_its_recorder(monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[tuple[object, ...]] = []

    @asynccontextmanager
    async def noted(*arguments: object) -> AsyncIterator[None]:
        requested.append(arguments)
        yield None

    monkeypatch.setattr(discover, "opened", noted)
    monkeypatch.setattr(discover, "Search", FakeSearch)
    port = SerialPort("COM1", baudrate=9600)
    recorder: Any = object()
    asyncio.run(discover.discover(Job(port, []), recorder))
    assert requested == [(port, recorder)]


def test_the_search_can_be_stopped_by_enter(monkeypatch: pytest.MonkeyPatch) -> None:
    searches: list[FakeSearch] = []

    class Kept(FakeSearch):
        async def look(self, tried: object) -> Discovery:
            searches.append(self)
            return FOUND

    monkeypatch.setattr(discover, "opened", nothing_opened)
    monkeypatch.setattr(discover, "Search", Kept)
    port = SerialPort("COM1", baudrate=9600)
    asyncio.run(discover.discover(Job(port, []), None))
    assert searches[0].given == (None, port, note, Bar)
    assert isinstance(searches[0].offered.__self__, EnterStops)  # type: ignore[attr-defined]  # a bound method
