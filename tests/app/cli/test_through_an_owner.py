"""Commands on a line that another program owns, here a thread of this process, and on a line without an owner."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import sqlite3
from collections.abc import Iterator
from contextlib import closing, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest

from busmaster import Priority
from busmaster.app.cli import output, poll, reaching, safe, status, top, write
from busmaster.app.cli.arguments import Connection
from busmaster.app.cli.ending import SIGNALS
from busmaster.app.cli.output import Level
from busmaster.app.cli.parsing import Assignment
from busmaster.app.service.folder import Owner
from busmaster.app.service.remote import RemoteBus, connect
from busmaster.capture.pcapng import read_packets
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer, serve_tcp
from busmaster.errors import LineDown
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.mentor.device import EmulatedMentor
from busmaster.registry import find, make_device
from tests.app.cli.conftest import SLITTER, Command, owner_here, serve, without_time
from tests.patience import PATIENCE

HCP2 = ("--protocol", "hcp2")


@pytest.fixture
def file(file: Path) -> Path:
    """The file of the line, with the short window of the document: each command waits for it once."""
    file.write_text(file.read_text().replace("timing = { window = 0.3 }\n", ""))
    return file


def held(server: TcpServer, *elements: int, node: int = 1) -> list[float]:
    def read(line: Line, now: float) -> list[float]:
        drive = line.device(node)
        assert isinstance(drive, EmulatedMint)
        return [drive.comms[element] for element in elements]

    return server.call(read)


def preset(server: TcpServer, *values: float, node: int = 1) -> None:
    server.call(lambda line, now: line.device(node).preset("10", *values))


def used(file: Path, server: TcpServer) -> str:
    """What a command reports before it uses the line of this process."""
    port, socket = server.path.removeprefix("socket://"), os.environ["XDG_RUNTIME_DIR"] + "/busmaster/slitter.sock"
    return f"busmaster: {port} is owned by process {os.getpid()}; using it through unix:{socket}\n"


@pytest.fixture
def points(file: Path, three_controllers: TcpServer) -> Path:
    """A file with points that have a precision, labels and a run of values."""
    more = (
        'points.speed = { item = "12", precision = 2, unit = "rpm" }\n'
        'points.mode = { item = "11", labels = { 1 = "on" } }\n'
    )
    file.write_text(file.read_text().replace("[groups.fast]", f"{more}[groups.fast]"))
    preset(three_controllers, 400, 1, 2.5)
    return file


# read


@pytest.mark.parametrize("owned", [False, True])
def test_points_of_a_file_are_read_each_in_its_unit_and_with_its_precision(
    busmaster: Command, points: Path, three_controllers: TcpServer, owned: bool
) -> None:
    def read() -> None:
        ran = busmaster("read", str(points), "winder/force", "winder/speed", "winder/mode")
        assert (ran.status, ran.lines) == (0, ["winder/force 40", "winder/speed 2.50", "winder/mode 1 on"])
        assert ran.err == (used(points, three_controllers) if owned else "")
        ran = busmaster("read", str(points), "winder/speed", "winder/mode", "--json")
        first, second = map(without_time, ran.lines)
        assert first == {"point": "winder/speed", "value": 2.5, "unit": "rpm"}
        assert second == {"point": "winder/mode", "value": 1, "label": "on", "unit": ""}
        ran = busmaster("read", str(points), "winder/force", "winder/farce")
        assert (ran.status, ran.out) == (2, "")

    if owned:
        with owner_here(points):
            read()
    else:
        read()


def test_points_of_an_owned_line_are_read_over_its_owner(
    busmaster: Command, points: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connected: list[str] = []

    def counted(address: str) -> RemoteBus:
        connected.append(address)
        return connect(address)

    monkeypatch.setattr("busmaster.app.cli.read.connect", counted)
    with owner_here(points) as service:
        assert busmaster("read", str(points), "winder/force").status == 0
    assert connected == [service.address]


@pytest.mark.slow
def test_the_values_of_a_run_are_on_one_line_each_with_the_precision_of_the_point(
    busmaster: Command, tmp_path: Path
) -> None:
    path = tmp_path / "line.toml"
    with serve("modbus", 1) as server:
        path.write_text(
            f'port = "{server.path}?baudrate=19200"\n[nodes.press]\nprotocol = "modbus"\naddress = 1\n'
            'points.cam = { item = "holding:10:3", factor = 0.5, precision = 2 }\n'
        )
        modbus = (server.path, "--protocol", "modbus", "--node", "1")
        (tmp_path / "table").write_text("\n".join(map(str, range(200))))
        ran = busmaster("write", *modbus, f"holding:100:200=@{tmp_path}/table")  # more than fit into one exchange
        assert (ran.status, ran.lines) == (0, ["holding:100:200 ok"]), ran.err
        assert busmaster("read", *modbus, "holding:299").lines == ["holding:299 199"]
        assert busmaster("write", str(path), "press/cam=0.5,1,1.5").status == 0
        ran = busmaster("read", str(path), "press/cam")
    assert (ran.status, ran.lines) == (0, ["press/cam 0.50,1.00,1.50"]), ran.err


@pytest.mark.parametrize(
    "command",
    [("read", "winder/force"), ("write", "winder/force=1"), ("trend", "winder/force", "--seconds", "0.5")],
)
def test_what_is_sent_on_the_line_of_a_file_is_recorded(
    busmaster: Command, points: Path, tmp_path: Path, command: tuple[str, ...]
) -> None:
    capture = tmp_path / "line.pcapng"
    verb, *rest = command
    ran = busmaster(verb, str(points), *rest, "--capture", str(capture))
    assert ran.status == 0, ran.err
    with capture.open("rb") as file:
        assert len(list(read_packets(file))) >= 2


@pytest.mark.slow
def test_a_node_without_a_reply_ends_a_read_with_its_error(
    busmaster: Command, points: Path, three_controllers: TcpServer
) -> None:
    points.write_text(points.read_text().replace("window = 0.3", "window = 0.01").replace("address = 1", "address = 9"))
    ran = busmaster("read", str(points), "winder/force", "winder/mode")
    assert (ran.status, ran.out) == (1, "")
    assert "no reply" in ran.err


def test_a_command_on_an_owned_port_goes_through_its_owner(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    port = three_controllers.path
    with owner_here(file) as service:
        ran = busmaster("write", port, *HCP2, "--node", "2", "1=5", "--verify")
        assert (ran.status, ran.out, ran.err) == (0, "1 ok\n", used(file, three_controllers))
        ran = busmaster("read", service.address, *HCP2, "--node", "2", "1")
        assert (ran.status, ran.out, ran.err) == (0, "1 5\n", "")
        ran = busmaster("write", port, *HCP2, "--node", "1", "10=501")
        assert ran.status == 2
        assert "above its maximum of 50" in ran.err
        ran = busmaster("do", f"2@{port}", "stop", *HCP2)
        assert ran.err.startswith(used(file, three_controllers))
        ran = busmaster("scan", port, *HCP2, "--nodes", "2-3")
        assert (ran.status, [line.split()[0] for line in ran.lines]) == (0, ["2", "3"])
        assert ran.err.startswith(used(file, three_controllers))


@pytest.mark.parametrize(
    "command",
    [
        ("read", "FILE", "winder/force"),
        ("write", "FILE", "winder/force=1"),
        ("trend", "FILE", "winder/force", "--seconds", "0.1"),
        ("do", "winder@FILE", "stop"),
        ("params", "diff", "winder@FILE", "winder@FILE", "--items", "10"),
        ("read", "PORT", *HCP2, "--node", "1", "1"),
        ("read", "SERVED", *HCP2, "--node", "1", "1"),
        ("params", "diff", "1@PORT", "2@PORT", "--items", "10", *HCP2),
    ],
)
def test_the_line_of_another_program_is_not_recorded(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path, command: tuple[str, ...]
) -> None:
    capture = tmp_path / "x.pcapng"
    with owner_here(file) as service:
        words = [
            word.replace("FILE", str(file)).replace("PORT", three_controllers.path).replace("SERVED", service.address)
            for word in command
        ]
        ran = busmaster(*words, "--capture", str(capture))
    assert (ran.status, ran.out) == (2, "")
    assert "is the line of another program; leave out --capture, and record it there" in ran.err
    assert not capture.exists()


# write


def test_points_of_a_file_are_written_through_the_owner_which_keeps_the_record(
    busmaster: Command, points: Path, three_controllers: TcpServer
) -> None:
    with owner_here(points):
        ran = busmaster("write", str(points), "winder/force=3", "winder/13=7", "--verify")
        assert (ran.status, ran.out) == (0, "winder/force ok\nwinder/13 ok\n")
        assert ran.err == used(points, three_controllers)
        assert held(three_controllers, 10, 13) == [30, 7]
        ran = busmaster("write", str(points), "winder/13=8", "--json")
        assert without_time(ran.out) == {"point": "winder/13", "ok": True}
        ran = busmaster("write", str(points), "winder/13=9", "winder/force=51")
        assert (ran.status, ran.out) == (2, "")
        assert held(three_controllers, 10, 13) == [30, 8]
    with closing(sqlite3.connect(points.parent / "line.sqlite", timeout=PATIENCE)) as database:
        rows = database.execute("select distinct interface from audit where outcome = 'written'").fetchall()
    assert rows == [("service",)]


@pytest.mark.slow
@pytest.mark.parametrize("owned", [False, True])
@pytest.mark.parametrize("named", ["PORT", "FILE"])
def test_a_value_that_does_not_read_back_is_found_only_with_verify(
    busmaster: Command, file: Path, three_controllers: TcpServer, owned: bool, named: str
) -> None:
    class Forgetful(EmulatedMint):
        def write_element(self, *_: object, **__: object) -> bool:
            return True

    def forget(line: Line, now: float) -> None:
        line.device(1).__class__ = Forgetful

    three_controllers.call(forget)
    command = (
        ("write", str(file), "winder/13=7")
        if named == "FILE"
        else ("write", three_controllers.path, *HCP2, "--node", "1", "13=7")
    )

    def attempt() -> None:
        assert busmaster(*command).status == 0
        ran = busmaster(*command, "--verify")
        assert (ran.status, ran.out) == (1, "")

    if owned:
        with owner_here(file):
            attempt()
    else:
        attempt()


# poll and trend


@pytest.fixture
def ctrl_c_after_three(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """End each poll by Ctrl-C once three cycles were printed."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    usual, printed = output.emit_all, list[str]()

    def emit_all(lines: list[str]) -> None:
        usual(lines)
        printed.extend(lines[:1])
        if len(printed) == 3:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr("busmaster.app.cli.poll.emit_all", emit_all)
    yield printed
    for number, handler in before.items():  # after a signal a command ignores further ones: its process ends
        signal.signal(number, handler)


def test_a_poll_through_the_owner_prints_each_value_and_a_summary(
    busmaster: Command, file: Path, three_controllers: TcpServer, ctrl_c_after_three: list[str]
) -> None:
    options = ("--nodes", "2,3", "--items", "1,2", "--period", "0.05")
    before = {number: signal.getsignal(number) for number in SIGNALS}
    with owner_here(file) as service:
        ran = busmaster("poll", three_controllers.path, *HCP2, *options)
        assert ran.status == 130, ran.err
        assert {line.split()[1] for line in ran.lines} == {"2/1", "2/2", "3/1", "3/2"}
        found = re.search(r"poll: (\d+) cycles, (\d+) missed, period ([\d.]+) ms mean, ([\d.]+) ms p99", ran.err)
        assert found is not None, ran.err
        assert float(found[3]) >= 40
        for number, handler in before.items():
            signal.signal(number, handler)
        ctrl_c_after_three.clear()
        ran = busmaster("poll", service.address, *HCP2, *options, "--json")
        assert ran.status == 130
        cycles = [json.loads(line) for line in ran.lines]
        assert {cycle["group"] for cycle in cycles} == {"poll"}
        assert cycles[0]["samples"].keys() == {"2/1", "2/2", "3/1", "3/2"}
        assert all(0 <= cycle["due"] <= cycle["started"] + 0.001 < PATIENCE for cycle in cycles)


def test_a_poll_through_the_owner_ends_by_itself_with_1_if_there_was_no_value(
    busmaster: Command, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = ("--nodes", "9,12", "--items", "1,2", "--period", "0.05", "--seconds", "0.2")
    requested: list[tuple[float, list[str]]] = []
    usual = RemoteBus.poll_group

    def poll_group(self: RemoteBus, name: str, *, period: float, points: Any, **more: Any) -> Any:
        requested.append((period, [point.key for point in points]))
        return usual(self, name, period=period, points=points, **more)

    monkeypatch.setattr(RemoteBus, "poll_group", poll_group)
    with owner_here(file) as service:
        ran = busmaster("poll", service.address, *HCP2, *options)
    assert requested == [(0.05, ["9/1", "9/2", "12/1", "12/2"])]
    assert ran.status == 1
    assert "no value was received" in ran.err


def test_a_poll_ends_with_the_owner_of_its_line_and_reports_why(
    busmaster: Command, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    serving = owner_here(file)
    service = serving.__enter__()
    printed: list[str] = []

    def emit_all(lines: list[str]) -> None:
        if not printed:
            serving.__exit__(None, None, None)
        printed.extend(lines)

    monkeypatch.setattr("busmaster.app.cli.poll.emit_all", emit_all)
    monkeypatch.setattr(poll, "wants_screen", lambda view: not view.plain)
    ran = busmaster("poll", service.address, *HCP2, "--nodes", "2", "--items", "1", "--period", "0.05")
    assert printed
    assert ran.status == 1
    assert "the program that owns the line has ended" in ran.err
    assert "no live view of another program's line here, showing plain lines; use busmaster top" in ran.err


@pytest.mark.slow
def test_a_trend_through_the_owner_samples_each_point_at_its_period_and_ends_by_itself(
    busmaster: Command, points: Path, three_controllers: TcpServer
) -> None:
    names = ("winder/force", "winder/speed")
    with owner_here(points) as service:
        ran = busmaster("trend", str(points), *names, names[0], "--period", "0.2", "--seconds", "0.5")
        assert ran.status == 0
        assert {line.split(" ", 1)[1] for line in ran.lines} == {"winder/force 40", "winder/speed 2.50"}
        assert all(1 <= sum(name in line for line in ran.lines) <= 3 for name in names)
        assert ran.err.startswith(used(points, three_controllers))
        assert re.search(r"winder/speed: \d samples, [\d.]+ a second, lowest 2.50, highest 2.50 rpm, 0 lost", ran.err)
        ran = busmaster("trend", service.address, *HCP2, "2/1", "3/1", "--period", "0.2", "--seconds", "0.3", "--json")
        assert {json.loads(line)["point"] for line in ran.lines} == {"2/1", "3/1"}
        assert len(ran.lines) <= 4


# status and top


def test_status_prints_one_row_for_each_line_and_what_its_owner_refused(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    port = three_controllers.path.removeprefix("socket://")
    with owner_here(file):
        while not (said := json.loads(busmaster("status", "--json").out))["up"]:
            pass
        assert (said["name"], said["port"], said["programs"], said["nodes"]) == ("slitter", port, 0, 1)
        assert (said["state"], said["tcp"], said["error"], said["refused_requests"]) == ("ready", None, None, 0)
        ran = busmaster("status")
        assert (ran.status, ran.err) == (0, "")
        head, row = ran.lines
        assert head.split("  ")[0] == "NAME"
        assert row.split()[:4] == ["slitter", port, str(os.getpid()), "0"]
        assert re.fullmatch(r"\d+\.\d%", row.split()[4])
        assert row.split()[5] == "1/1"
        assert len(head) == len(row)  # the last column is flush right


@pytest.fixture
def owners(monkeypatch: pytest.MonkeyPatch) -> list[Owner]:
    """The running owners."""
    found: list[Owner] = []
    for module in ("status", "top"):
        monkeypatch.setattr(f"busmaster.app.cli.{module}.owners", lambda: iter(found))
    return found


def test_a_process_that_does_not_reply_makes_the_status_1_and_another_line_is_listed(
    busmaster: Command, file: Path, tmp_path: Path, owners: list[Owner], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("busmaster.app.cli.status.ANSWER_WITHIN", 0.3)
    with owner_here(file) as service, socket.socket(socket.AF_UNIX) as silent:
        path = str(tmp_path / "x.sock")
        silent.bind(path)
        silent.listen()
        owners += [Owner("mute", "/dev/ttyUSB0", path, 7), Owner("slitter", "here", service.address[5:], os.getpid())]
        ran = busmaster("status")
        assert ran.status == 1
        assert ran.lines[1].split(maxsplit=3) == ["mute", "/dev/ttyUSB0", "7", "no reply from its process"]
        assert ran.lines[2].split()[0] == "slitter"
        ran = busmaster("status", "--json")
        assert [json.loads(line)["error"] for line in ran.lines] == ["no reply from its process", None]
        owners.pop(0)
        assert busmaster("status").status == 0
    owners[:] = [Owner("gone", "/dev/ttyUSB0", str(tmp_path / "none.sock"), 7)]
    ran = busmaster("status")
    assert ran.status == 1
    assert "none.sock" in ran.lines[1]


class Asked:
    """The owner of a line whose port is lost, or of an older version, which does not report all of its counts."""

    def __init__(self, **different: Any) -> None:
        nodes = [{"health": health} for health in ("up", "suspect", "up")]
        self.about = {"nodes": nodes, "tcp": "tcp://127.0.0.1:7420", "clients": 3, "refused_requests": 2, **different}

    async def __aenter__(self) -> Asked:
        return self

    async def __aexit__(self, *_: object) -> None:
        pass

    async def statistics(self) -> Any:
        return SimpleNamespace(utilisation=0.25)


@pytest.mark.parametrize(
    ("different", "state", "up", "row"),
    [({}, "ready", 2, ["2", "25.0%", "2/3"]), ({"state": "offline"}, "offline", 0, ["2", "offline", "0/3"])],
)
def test_of_a_line_that_is_offline_no_node_is_up(
    busmaster: Command,
    owners: list[Owner],
    monkeypatch: pytest.MonkeyPatch,
    different: dict[str, Any],
    state: str,
    up: int,
    row: list[str],
) -> None:
    owners.append(Owner("slitter", "/dev/ttyUSB0", "/run/slitter.sock", 7))
    monkeypatch.setattr(status, "connect", lambda address: Asked(**different))
    assert without_time(busmaster("status", "--json").out) == {
        "name": "slitter",
        "port": "/dev/ttyUSB0",
        "address": "unix:/run/slitter.sock",
        "process": 7,
        "tcp": "tcp://127.0.0.1:7420",
        "programs": 2,
        "utilisation": 0.25,
        "state": state,
        "refused_connections": None,
        "refused_requests": 2,
        "failed_logins": None,
        "up": up,
        "nodes": 3,
        "error": None,
    }
    ran = busmaster("status")
    assert (ran.status, ran.err) == (0, "busmaster: slitter: 2 requests refused\n")
    assert ran.lines[1].split() == ["slitter", "/dev/ttyUSB0", "7", *row]


def test_what_each_line_has_refused_is_reported(
    busmaster: Command, owners: list[Owner], monkeypatch: pytest.MonkeyPatch
) -> None:
    async def ask(owner: Owner) -> dict[str, Any]:
        counts = {"refused_connections": owner.pid, "refused_requests": 0, "failed_logins": 0}
        state = {"state": "ready", "utilisation": 0.125, "programs": 2, "up": 1, "nodes": 3, "error": None}
        return {"name": owner.name, "port": owner.port, "process": owner.pid, **state, **counts}

    owners += [Owner(name, f"/dev/{name}", f"/run/{name}.sock", pid) for name, pid in (("a", 7), ("b", 0), ("c", 9))]
    monkeypatch.setattr(status, "ask", ask)
    ran = busmaster("status")
    assert ran.status == 0
    assert ran.lines[1].split() == ["a", "/dev/a", "7", "2", "12.5%", "1/3"]
    assert ran.err == "busmaster: a: 7 connections refused\nbusmaster: c: 9 connections refused\n"
    assert busmaster("status", "--json").err == ""


def test_a_line_that_is_not_for_this_user_is_no_error(
    busmaster: Command, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connect = socket.socket.connect

    def refused(self: socket.socket, address: Any) -> None:
        if self.family == socket.AF_UNIX:
            raise PermissionError(13, "Permission denied")
        connect(self, address)

    with owner_here(file):
        monkeypatch.setattr(socket.socket, "connect", refused)
        ran = busmaster("status")
        monkeypatch.undo()
    assert ran.status == 0
    assert ran.lines[1].endswith("not for this user")


def test_the_line_of_top_is_known_by_its_name_its_file_its_port_or_its_address(
    file: Path, tmp_path: Path, three_controllers: TcpServer
) -> None:
    with pytest.raises(LineDown, match=r"no running line of .*slitter.toml.*busmaster run"):
        top.address_of(str(file))
    with owner_here(file) as service:
        other = tmp_path / "other.toml"
        other.write_text(file.read_text())
        port = three_controllers.path.removeprefix("socket://")
        for meant in ("slitter", str(file), str(other), three_controllers.path, port, service.address, None):
            assert top.address_of(meant) == service.address
        # a file whose port is another, and whose name is that of the line
        file.write_text(file.read_text().replace(three_controllers.path, "socket://127.0.0.1:1"))
        assert top.address_of(str(file)) == service.address
    assert top.address_of("unix:/x") == "unix:/x"
    assert top.address_of("tcp://x:1") == "tcp://x:1"
    assert top.address_of("nobody") == "nobody"


def test_top_names_the_lines_of_which_one_is_to_be_named(owners: list[Owner], monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(LineDown, match="no running line of this user"):
        top.address_of(None)
    owners += [Owner(name, f"/dev/{name}", f"/run/{name}.sock", 1) for name in ("one", "two", "closed")]
    monkeypatch.setattr(os, "access", lambda path, mode: mode == os.F_OK or "closed" not in str(path))
    with pytest.raises(click.UsageError, match=r"several lines are running; name one of one, two$"):
        top.address_of(None)
    del owners[1]
    assert top.address_of(None) == "unix:/run/one.sock"


def test_what_a_line_has_refused_is_listed_without_what_it_has_not() -> None:
    line = {"refused_connections": 2, "refused_requests": 0, "failed_logins": 3}
    assert status.refused_text(line) == "2 connections refused, 3 logins failed"
    assert status.refused_text({**line, "refused_requests": 1}) == (
        "2 connections refused, 1 requests refused, 3 logins failed"
    )
    assert status.refused_text(dict.fromkeys(line)) == ""


# the settings of a line and of its owner

ABOUT = {"baudrate": 57600, "framing": "7E1", "echo": False, "process": 7, "line": "slitter"}
TCP: dict[str, Any] = {**ABOUT, "baudrate": None, "framing": None}


@pytest.mark.parametrize(
    ("port", "options", "about", "differs"),
    [
        ("/dev/ttyUSB0", {}, ABOUT, ""),
        ("/dev/ttyUSB0", {"baud": 57600}, ABOUT, ""),
        ("/dev/ttyUSB0", {"baud": 9600}, ABOUT, "with 57600 7E1, not 9600 baud;"),
        ("/dev/ttyUSB0?baudrate=57600", {"baud": 57600}, ABOUT, ""),
        ("/dev/ttyUSB0?baudrate=9600", {}, ABOUT, "not 9600 baud;"),
        ("/dev/ttyUSB0?bytesize=7&parity=E&stopbits=1", {}, ABOUT, ""),
        ("/dev/ttyUSB0?bytesize=8&parity=N&stopbits=1", {}, ABOUT, "not 8N1;"),
        ("/dev/ttyUSB0?parity=O", {}, ABOUT, "O"),
        ("/dev/ttyUSB0?stopbits=2", {}, ABOUT, "2;"),
        ("/dev/ttyUSB0?baudrate=9600&parity=N&bytesize=8", {"echo": True}, ABOUT, "not 9600 baud, 8N1, with an echo;"),
        ("/dev/ttyUSB0", {"echo": True}, ABOUT, "not with an echo;"),
        ("/dev/ttyUSB0", {"echo": True}, {**ABOUT, "echo": True}, ""),
        ("/dev/ttyUSB0", {"baud": 9600}, {**ABOUT, "echo": True}, "with 57600 7E1 with an echo, not 9600 baud;"),
        ("unix:/run/line.sock", {"baud": 9600}, ABOUT, "not 9600 baud;"),
        ("unix:/run/line.sock", {}, ABOUT, ""),
        ("/dev/ttyUSB0?baudrate=9600&parity=N", {"baud": 9600}, TCP, ""),
    ],
)
def test_given_settings_that_differ_from_the_owners_are_wrong_usage(
    port: str, options: dict[str, Any], about: dict[str, Any], differs: str
) -> None:
    connection = Connection(port, "hcp2", **options)
    if not differs:
        reaching.check_settings(connection, about)
        return
    with pytest.raises(click.UsageError) as caught:
        reaching.check_settings(connection, about)
    assert caught.value.message.startswith("process 7 owns slitter with 57600 7E1")
    assert differs in caught.value.message
    assert caught.value.message.endswith("; leave out these settings")


def test_a_command_whose_settings_differ_leaves_the_owner_at_once(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner_here(file) as service:
        ran = busmaster("read", service.address, *HCP2, "--baud", "9600", "--node", "2", "1")
        assert (ran.status, ran.out) == (2, "")
        assert f"process {os.getpid()} owns" in ran.err
        assert json.loads(busmaster("status", "--json").out)["programs"] == 0


def test_the_token_of_the_environment_is_for_tcp_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(reaching.TOKEN, "secret")
    assert reaching.token_for("tcp://plant:5020") == "secret"
    assert reaching.token_for("unix:/run/line.sock") is None
    monkeypatch.setenv(reaching.TOKEN, "")
    assert reaching.token_for("tcp://plant:5020") is None
    monkeypatch.delenv(reaching.TOKEN)
    assert reaching.token_for("tcp://plant:5020") is None


def test_a_line_that_listens_by_tcp_is_used_with_the_token_of_the_environment(
    busmaster: Command, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tokens = tmp_path / "slitter.tokens"
    tokens.write_text("hmi a-token-of-the-hmi-0001\n")
    tokens.chmod(0o600)
    section = f'\n[service]\nlisten = "127.0.0.1:0"\ntoken_file = "{tokens}"\n[service.tokens.hmi]\nrole = "read"\n'
    file.write_text(file.read_text() + section)
    with owner_here(file) as service:
        address = service.tcp_address
        assert address is not None
        read = ("read", address, *HCP2, "--node", "2", "1")
        assert busmaster(*read).status == 1
        monkeypatch.setenv(reaching.TOKEN, "a-token-of-the-hmi-0001")
        ran = busmaster(*read)
        assert (ran.status, ran.out) == (0, "1 0\n"), ran.err
        assert json.loads(busmaster("status", "--json").out)["tcp"] == address
        monkeypatch.setenv(reaching.TOKEN, "another-token-0001")
        assert busmaster(*read).status == 1
        assert busmaster("status").err == "busmaster: slitter: 1 logins failed\n"
        assert busmaster("status", "--json").err == ""


def test_of_several_owners_that_of_the_port_is_found(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    found = [Owner("one", "/dev/a", "/run/one.sock", 1), Owner("two", str(tmp_path), "/run/two.sock", 2)]
    monkeypatch.setattr(reaching, "owners", lambda: iter(found))
    endpoint: Any = SimpleNamespace(name=str(tmp_path))
    owner = reaching.owner_of(endpoint)
    assert owner is not None
    assert owner.name == "two"


def test_one_common_address_of_two_hosts_is_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    places = {"plant:1": {"192.0.2.1", "192.0.2.2"}, "winder:1": {"192.0.2.2", "192.0.2.3"}, "other:1": {"192.0.2.3"}}
    found = [Owner("line", "plant:1", "/run/one.sock", 1)]
    monkeypatch.setattr(reaching, "owners", lambda: iter(found))
    monkeypatch.setattr(reaching, "device_of", lambda name, by_tcp: places[name])
    for name, owned in (("plant:1", True), ("winder:1", True), ("other:1", False)):
        endpoint: Any = SimpleNamespace(name=name)
        assert (reaching.owner_of(endpoint) is not None) is owned


def test_a_host_that_is_not_known_is_known_by_its_name(monkeypatch: pytest.MonkeyPatch) -> None:
    def unknown(*_: object, **__: object) -> None:
        raise socket.gaierror(socket.EAI_NONAME, "Name or service not known")

    monkeypatch.setattr(socket, "getaddrinfo", unknown)
    assert reaching.device_of("plant.invalid:4001", by_tcp=True) == {"plant.invalid:4001"}
    assert reaching.device_of("/dev/ttyUSB0", by_tcp=True) == {"/dev/ttyUSB0"}
    assert reaching.device_of("usb:none", by_tcp=False) == {"usb:none"}


# the safe state

SAFE = '[safe]\nwithin = 2.0\nrepeatable = ["winder/force"]\nwrites = { "winder/force" = 1.5 }\n'


def test_the_owner_sends_its_safe_state_and_is_not_recorded(
    busmaster: Command, file: Path, three_controllers: TcpServer, tmp_path: Path
) -> None:
    file.write_text(file.read_text() + SAFE)
    with owner_here(file):
        capture = tmp_path / "x.pcapng"
        ran = busmaster("safe", str(file), "--capture", str(capture))
        assert (ran.status, ran.out) == (0, "winder/force ok\n")
        warning, reached = ran.err.splitlines()
        assert "is the line of another program; leave out --capture, and record it there" in warning
        assert f"{reached}\n" == used(file, three_controllers)
        assert not capture.exists()
        assert held(three_controllers, 10) == [15]
        other = file.with_name("other.toml")
        other.write_text(file.read_text().replace('"winder/force" = 1.5', '"winder/force" = 2'))
        ran = busmaster("safe", str(other))
        assert (ran.status, ran.out) == (2, "")
        assert held(three_controllers, 10) == [15]


def test_a_safe_state_has_a_place_of_its_own_at_the_owner_and_a_missing_recording_is_a_warning(
    busmaster: Command, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file.write_text(file.read_text() + SAFE)
    connected: list[dict[str, Any]] = []
    noted: list[Level] = []

    def counted(address: str, **options: Any) -> RemoteBus:
        connected.append(options)
        return connect(address, **options)

    monkeypatch.setattr(safe, "connect", counted)
    monkeypatch.setattr(safe, "note", lambda text, level: noted.append(level))
    with owner_here(file):
        assert busmaster("safe", str(file), "--capture", "x.pcapng").status == 0
    assert connected == [{"safe_only": True}]  # though programs have taken all other places
    assert noted == [Level.WARNING]


def test_the_safe_state_goes_to_the_given_port_and_only_to_the_owner_of_that_port(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    file.write_text(file.read_text() + SAFE)
    with serve("hcp2", 1, 2, 3) as other, owner_here(file):
        ran = busmaster("safe", str(file), "--port", other.path)
        assert (ran.status, ran.out, ran.err) == (0, "winder/force ok\n", "")
        assert (held(other, 10), held(three_controllers, 10)) == ([15], [0])
        preset(other, 3)
        moved = file.with_name("moved.toml")
        moved.write_text(file.read_text().replace(three_controllers.path, other.path))
        ran = busmaster("safe", str(moved), "--port", three_controllers.path)
        assert (ran.status, ran.out, ran.err) == (0, "winder/force ok\n", used(file, three_controllers))
        assert (held(other, 10), held(three_controllers, 10)) == ([3], [15])


@pytest.mark.parametrize("command", ["run", "serve"])
def test_a_second_master_is_refused(busmaster: Command, file: Path, command: str) -> None:
    with owner_here(file):
        ran = busmaster(command, str(file), "--seconds", "0.1")
    assert ran.status == 1
    assert f"is owned by process {os.getpid()}; stop that process first: two masters on one line garble" in ran.err


def test_a_line_that_is_read_only_takes_no_write_of_a_program(
    busmaster: Command, file: Path, three_controllers: TcpServer
) -> None:
    with owner_here(file, read_only=True):
        ran = busmaster("write", three_controllers.path, *HCP2, "--node", "2", "1=5")
        assert ran.status != 0
        assert "read-only" in ran.err


# the report of a write


@pytest.mark.slow
def test_each_item_of_a_write_is_printed_and_listed_in_json(
    busmaster: Command, three_controllers: TcpServer, tmp_path: Path
) -> None:
    port = three_controllers.path
    ran = busmaster("write", port, *HCP2, "--node", "2", "10=1,2,3", "20=4")
    assert (ran.status, ran.lines) == (0, ["10 ok", "11 ok", "12 ok", "20 ok"])
    assert held(three_controllers, 10, 11, 12, 20, node=2) == [1, 2, 3, 4]
    ran = busmaster("write", port, *HCP2, "--node", "2", "10=5,6", "20=7", "--json")
    assert [without_time(line) for line in ran.lines] == [
        {"node": 2, "item": "10", "items": ["10", "11"], "ok": True},
        {"node": 2, "item": "20", "ok": True},
    ]
    table = tmp_path / "table.csv"
    table.write_text("\n".join(str(number) for number in range(1, 91)))
    ran = busmaster("write", port, *HCP2, "--node", "2", f"1=@{table}")
    assert (ran.status, len(ran.lines)) == (0, 90)
    assert held(three_controllers, *range(1, 91), node=2) == list(range(1, 91))


@pytest.mark.parametrize("command", [("read", "1"), pytest.param(("write", "1=5"), marks=pytest.mark.slow), ("scan",)])
def test_a_node_without_an_address_is_null_in_json(busmaster: Command, command: tuple[str, ...]) -> None:
    with serve("dc104", 0) as server:
        ran = busmaster(command[0], server.path, "--protocol", "dc104", *command[1:], "--json")
    assert json.loads(ran.out)["node"] is None, ran.err


def test_a_table_from_a_file_is_written_in_the_background() -> None:
    single, table = Assignment("1", (5,)), Assignment("1", (5, 6), "cam.csv")
    assert write.options_of(single, False) == {"verify": False}
    assert write.options_of(single, True) == {"verify": True}
    assert write.options_of(table, False) == {"verify": False, "priority": Priority.BACKGROUND}
    assert write.options_of(table, True) == {"verify": True, "priority": Priority.BACKGROUND}
    assert write.write_request_of("a/1", (5,)).value == 5
    assert write.write_request_of("a/1", (5, 6)).value == (5, 6)


def test_a_table_on_a_port_is_written_in_the_background(
    busmaster: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[dict[str, Any]] = []

    def prepare_write(handle: Any, item: str, values: Any, **options: Any) -> list[Any]:
        requested.append({"item": item, "values": tuple(values), **options})
        return []

    monkeypatch.setattr("busmaster.app.cli.write.ext.prepare_write", prepare_write)
    (tmp_path / "table").write_text("5 6")
    busmaster("write", "socket://127.0.0.1:1", *HCP2, "--node", "2", f"1=@{tmp_path}/table", "3=7", "--verify")
    assert requested == [
        {"item": "1", "values": (5, 6), "verify": True, "priority": Priority.BACKGROUND},
        {"item": "3", "values": (7,), "verify": True},
    ]


def test_a_table_for_a_point_is_written_in_the_background_over_the_bus_that_is_given() -> None:
    requested: dict[str, Any] = {}
    point = SimpleNamespace(where="winder", source=SimpleNamespace(item="10"))
    handle = SimpleNamespace(_counted=lambda item: (item,))
    line: Any = SimpleNamespace(
        point=lambda name: point,
        nodes={"winder": handle},
        prepare_write=lambda name, values, **options: requested.update(name=name, values=values, **options),
    )
    bus: Any = object()
    write.prepare_point(line, Assignment("winder/cam", (5, 6), "cam.csv"), True, bus)
    assert requested == {
        "name": "winder/cam",
        "values": (5, 6),
        "bus": bus,
        "verify": True,
        "priority": Priority.BACKGROUND,
    }


def test_the_precision_and_the_names_of_a_value_are_printed_on_a_port_too(busmaster: Command) -> None:
    with serve("microflex", 7) as server:
        microflex = (server.path, "--protocol", "microflex", "--node", "7")
        ran = busmaster("read", *microflex, "status_word", "--json")
        assert without_time(ran.out)["names"] == ["HARDWARE_ENABLE"]


@pytest.mark.parametrize(
    ("command", "owned"),
    [
        (("read", "FILE", "winder/force"), False),
        (("write", "FILE", "winder/13=7"), False),
        (("trend", "FILE", "winder/force", "--seconds", "0.5"), False),
        (("trend", "FILE", "winder/force", "--seconds", "0.5"), True),
        (("params", "diff", "winder@FILE", "winder@FILE", "--items", "force"), False),
    ],
)
def test_a_late_reply_of_a_node_of_a_file_is_reported_with_the_key_of_the_file(
    busmaster: Command, tmp_path: Path, command: tuple[str, ...], owned: bool
) -> None:
    path = tmp_path / "slitter.toml"
    # beyond the window, and before the maximum reply delay
    device = make_device("hcp2", 1, delay=Delay(0.06))
    with serve_tcp(Line(find("hcp2").profile.line, [device], paced=False)) as server:
        text = SLITTER.replace("PORT", server.path).replace("FOLDER", str(tmp_path))
        path.write_text(text.replace("window = 0.3", "window = 0.02").partition("[groups")[0])
        with owner_here(path) if owned else nullcontext():
            ran = busmaster(*(word.replace("FILE", str(path)) for word in command))
    assert ran.status == 0, ran.err
    # with a LINE.toml the option --timeout is refused
    assert re.search(r"winder: late reply, \d+ ms after the request; set timing = \{ window = ", ran.err)
    assert "--timeout" not in ran.err


def test_a_node_of_a_file_that_is_too_late_is_reported_with_the_key_of_the_file(
    busmaster: Command, tmp_path: Path
) -> None:
    path = tmp_path / "slitter.toml"
    device = make_device("hcp2", 1, delay=Delay(0.1))
    with serve_tcp(Line(find("hcp2").profile.line, [device], paced=False)) as server:
        text = SLITTER.replace("PORT", server.path).replace("FOLDER", str(tmp_path))
        text = text.replace("window = 0.3", "window = 0.02, max_reply_delay = 0.08").partition("[groups")[0]
        path.write_text(text.replace("address = 1", "address = 1\nretries = 0"))
        ran = busmaster("read", str(path), "winder/force")
    assert (ran.status, ran.out) == (1, "")
    assert "; late reply, " in ran.err
    assert "set timing = { window = " in ran.err
    assert "--timeout" not in ran.err


@pytest.fixture
def mentor() -> Iterator[TcpServer]:
    with serve("mentor", 12) as server:
        yield server


def test_the_options_of_a_read_reach_each_item(
    busmaster: Command, mentor: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[tuple[str, dict[str, Any]]] = []

    async def read_item(handle: Any, item: str, **options: Any) -> float:
        requested.append((item, options))
        return 5

    monkeypatch.setattr("busmaster.app.cli.read.ext.read_item", read_item)
    read = ("read", mentor.path, "--protocol", "mentor", "--node", "12", "1.17", "1.18")
    assert busmaster(*read, "--chain").lines == ["1.17 5", "1.18 5"]
    assert requested == [("1.17", {"chain": True}), ("1.18", {"chain": True})]
    requested.clear()
    assert busmaster(*read).status == 0
    assert requested == [("1.17", {}), ("1.18", {})]


@pytest.mark.parametrize("decimals", [0, 1])
def test_a_number_of_decimals_is_that_of_each_item_of_a_write(
    busmaster: Command, monkeypatch: pytest.MonkeyPatch, decimals: int
) -> None:
    options: list[dict[str, Any]] = []
    usual = Connection.open_handle

    def open_handle(self: Connection, bus: Any, address: int) -> Any:
        options.append(dict(self.options))
        return usual(self, bus, address)

    monkeypatch.setattr(Connection, "open_handle", open_handle)
    nobody, items = ("socket://127.0.0.1:1", "--node", "12"), ("1.17=1", "1.18:2=2,3", "1.21=4,5")
    ran = busmaster("write", *nobody, "--protocol", "mentor", *items, "--decimals", str(decimals))
    assert (ran.status, ran.out) == (1, "")
    assert options[-1] == {"decimals": dict.fromkeys(("1.17", "1.18", "1.19", "1.21", "1.22"), decimals)}
    ran = busmaster("write", *nobody, *HCP2, "1=2", "--decimals", str(decimals))
    assert ran.status == 2
    assert "hcp2 sends the decimal point itself; leave out --decimals" in ran.err


@pytest.mark.parametrize(
    ("owned", "options"),
    [
        (True, ""),
        pytest.param(True, "chained = true\n", marks=pytest.mark.slow),
        pytest.param(False, "", marks=pytest.mark.slow),
    ],
)
def test_the_decimals_of_a_file_apply_with_and_without_an_owner(
    busmaster: Command, mentor: TcpServer, tmp_path: Path, owned: bool, options: str
) -> None:
    def sent(parameter: int) -> int:
        def value(line: Line, now: float) -> int:
            drive = line.device(12)
            assert isinstance(drive, EmulatedMentor)
            return drive.value(parameter, now)

        return mentor.call(value)

    file, kept = tmp_path / "screw.toml", tmp_path / "kept.toml"
    file.write_text(
        f'port = "{mentor.path}?baudrate=19200"\n[nodes.screw]\nprotocol = "mentor"\naddress = 12\n{options}'
        '[nodes.screw.points]\nspeed = { item = "1.17", decimals = 1 }\njog = { item = "1.18" }\n'
    )
    with owner_here(file) if owned else nullcontext():
        ran = busmaster("write", str(file), "screw/speed=-47.6", "screw/jog=3", "--verify")
        assert (ran.status, sent(117), sent(118)) == (0, -476, 3), ran.err
        assert busmaster("read", str(file), "screw/speed", "screw/jog").lines == ["screw/speed -47.6", "screw/jog 3"]
        assert busmaster("params", "save", str(file), "screw", "--items", "1.17,1.18", "-o", str(kept)).status == 0
        assert busmaster("write", str(file), "screw/1.17=20.5").status == 0
        assert sent(117) == 205
        _, differs = busmaster("params", "diff", str(kept), f"screw@{file}").lines
        assert differs.split()[-2:] == ["-47.6", "20.5"]
        ran = busmaster("params", "load", str(kept), f"screw@{file}", "--yes", "--enabled")
        assert (ran.status, sent(117), sent(118)) == (0, -476, 3), ran.err


@pytest.mark.slow
@pytest.mark.parametrize("owned", [False, True])
def test_the_symbols_of_a_file_are_known_with_and_without_an_owner(
    busmaster: Command, tmp_path: Path, owned: bool
) -> None:
    file = tmp_path / "press.toml"
    with serve("msc", 3) as server:
        file.write_text(
            f'port = "{server.path}?baudrate=9600"\n[nodes.press]\nprotocol = "msc"\naddress = 3\n'
            "symbols = { count = 2008 }\n[nodes.press.points]\nbatch = { item = 'count', maximum = 50 }\n"
        )
        with owner_here(file) if owned else nullcontext():
            ran = busmaster("write", str(file), "press/batch=7", "--verify")
            assert (ran.status, ran.lines) == (0, ["press/batch ok"]), ran.err
            assert busmaster("read", str(file), "press/count", "press/2008").lines == ["press/count 7", "press/2008 7"]
            assert busmaster("write", str(file), "press/count=51").status == 2


@pytest.mark.slow
def test_the_decimals_of_a_write_are_those_of_each_item(busmaster: Command, mentor: TcpServer) -> None:
    node = (mentor.path, "--protocol", "mentor", "--node", "12")
    ran = busmaster("write", *node, "1.17=1.5", "1.18:2=2.5,3.5", "--decimals", "1")
    assert (ran.status, ran.lines) == (0, ["1.17 ok", "1.18:2 ok"]), ran.err
    assert busmaster("read", *node, "1.17:3").lines == ["1.17 15", "1.18 25", "1.19 35"]


def test_a_trend_ends_with_the_owner_of_its_line(
    busmaster: Command, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    serving = owner_here(file)
    serving.__enter__()
    printed: list[str] = []

    def emit_all(lines: Any) -> None:
        found = list(lines)
        if found and not printed:
            serving.__exit__(None, None, None)
        printed.extend(found)

    monkeypatch.setattr("busmaster.app.cli.trend.emit_all", emit_all)
    ran = busmaster("trend", str(file), "winder/force", "--period", "0.05")
    assert printed
    assert ran.status == 1
    # Whether a read was on its way when it ended.
    assert re.search("the program that owns the line (has ended|ends)", ran.err)
    assert "start it, and connect again" in ran.err
