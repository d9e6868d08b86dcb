"""`busmaster do`: actions of drives, by a port, by a file, and through the program that owns the line."""

from __future__ import annotations

import asyncio
import sqlite3
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import click
import pytest

from busmaster import Priority
from busmaster.app.cli import do
from busmaster.app.cli.do import RecordedNode, options_of
from busmaster.app.cli.read import plain_lines
from busmaster.app.service.authorisation import WriteRequest
from busmaster.bus.bus import Bus
from busmaster.bus.handle import Action
from busmaster.bus.limits import Limit
from busmaster.emulator.device import Delay
from busmaster.emulator.line import Line
from busmaster.emulator.serve import TcpServer
from busmaster.errors import InvalidCommand
from busmaster.protocols._comms.mint import EmulatedMint
from busmaster.protocols.hcp2 import codec as hcp2
from busmaster.protocols.hcp2.handle import Hcp2Controller
from busmaster.protocols.hcp2.microflex_device import EmulatedMicroFlex
from busmaster.registry import kinds
from tests.app.cli.conftest import Command, owner, serve, without_time
from tests.handles.test_handshake import careful
from tests.patience import PATIENCE
from tests.stories import on_a_bus

MICROFLEX = ("--protocol", "microflex", "--timeout", "1000")
FILE = """
port = "PORT?baudrate=57600"
[nodes.drive]
protocol = "microflex"
address = 7
timing = { window = 1.0 }
[outputs.sqlite]
path = "FOLDER/line.sqlite"
"""


@pytest.fixture
def drive() -> Iterator[TcpServer]:
    """A MicroFlex drive at address 7."""
    with serve("microflex", 7) as server:
        yield server


def microflex(line: Line) -> EmulatedMicroFlex:
    device = line.device(7)
    assert isinstance(device, EmulatedMicroFlex)
    return device


def enabled(server: TcpServer) -> bool:
    return server.call(lambda line, now: microflex(line).enabled)


@pytest.fixture
def file(tmp_path: Path, drive: TcpServer) -> Path:
    path = tmp_path / "line.toml"
    path.write_text(FILE.replace("PORT", drive.path).replace("FOLDER", str(tmp_path)))
    return path


def audit(path: Path) -> list[tuple[Any, ...]]:
    """By whom, point, value and outcome of each write that is on record."""
    with sqlite3.connect(path.parent / "line.sqlite", timeout=PATIENCE) as database:
        rows = database.execute("select by, point, value, outcome from audit order by time").fetchall()
    database.close()
    return rows


@pytest.mark.slow
def test_a_drive_is_enabled_and_disabled_by_its_address(busmaster: Command, drive: TcpServer) -> None:
    node = f"7@{drive.path}"
    ran = busmaster("do", node, "enable", *MICROFLEX)
    assert (ran.status, ran.out, ran.err) == (0, "enable ok 192 HARDWARE_ENABLE|ENABLED\n", "")
    assert enabled(drive)
    ran = busmaster("do", node, "disable", *MICROFLEX, "--json")
    said = {"node": 7, "action": "disable", "ok": True, "value": 64, "names": ["HARDWARE_ENABLE"]}
    assert (ran.status, without_time(ran.out)) == (0, said)
    assert not enabled(drive)


@pytest.mark.slow
def test_a_reset_cancels_the_errors(busmaster: Command, drive: TcpServer) -> None:
    drive.call(lambda line, now: setattr(microflex(line), "axis_error", 4))
    ran = busmaster("do", f"7@{drive.path}", "enable", *MICROFLEX, "--within", "0.05")
    assert (ran.status, ran.out) == (1, "")
    assert "not enabled: it has an error" in ran.err
    ran = busmaster("do", f"7@{drive.path}", "reset", *MICROFLEX)
    assert (ran.status, ran.err) == (0, "")
    assert drive.call(lambda line, now: (microflex(line).axis_error, microflex(line).command_word & 64)) == (0, 0)


@pytest.mark.parametrize(
    ("node", "arguments", "complaint"),
    [
        ("7@PORT", ("enabel", *MICROFLEX), "no such action 'enabel'; microflex has enable, disable, reset"),
        ("7@PORT", ("enable", "1", *MICROFLEX), "1 numbers do not fit; write: enable"),
        ("7@PORT", ("reset", *MICROFLEX, "--within", "1"), "reset takes no --within"),
        ("7@PORT", ("enable", *MICROFLEX, "--at-least", "1"), "enable takes no --at-least"),
        ("7@PORT", ("enable", *MICROFLEX, "--wihtin", "1"), "no such option '--wihtin'"),
        ("7@PORT", ("--enable", *MICROFLEX), "no such option '--enable'"),
        ("7@PORT", ("enable", *MICROFLEX, "--within", "0"), "a time must be above 0"),
        ("drive@PORT", ("enable", *MICROFLEX), "on a PORT, name the node by its address"),
        ("7", ("enable", *MICROFLEX), "'7' is not a node"),
        ("11@PORT", ("enable", "--protocol", "mentor"), "mentor has no actions; write its values with busmaster write"),
        ("2@PORT", ("execute", "1", "--protocol", "hcp"), "execute needs --within S"),
        ("2@PORT", ("execute", "1", "--protocol", "hcp", "--at-least", "1"), "execute needs --within S"),
        ("2@PORT", ("execute", "--protocol", "hcp", "--within", "1"), "0 numbers do not fit; write: execute COMMAND"),
        ("2@PORT", ("execute", "0", "--protocol", "hcp", "--within", "1"), "0 is not a command"),
        ("2@PORT", ("execute", "1", "x", "--protocol", "hcp", "--within", "1"), "'x' is not a number"),
        ("3@PORT", ("set-flag", "256", "--protocol", "msc"), "256"),
        ("3@PORT", ("set-flag", "1.5", "--protocol", "msc"), "1.5"),
    ],
)
def test_what_is_no_action_is_status_2_and_nothing_is_sent(
    busmaster: Command, node: str, arguments: tuple[str, ...], complaint: str
) -> None:
    """Nobody listens on this port, and nobody is asked to."""
    ran = busmaster("do", node.replace("PORT", "socket://127.0.0.1:1"), *arguments)
    assert (ran.status, ran.out) == (2, "")
    assert complaint in ran.err


@pytest.mark.slow
def test_a_program_carries_out_a_command_with_data_below_0(busmaster: Command, tmp_path: Path) -> None:
    with serve("hcp2", 1) as server:
        mint = server.call(lambda line, now: line.device(1))
        assert isinstance(mint, EmulatedMint)

        def run(line: Line, now: float) -> None:
            mint.program = careful
            mint.start_program()

        server.call(run)
        arguments = ("execute", "1", "10", "-2", "--within", "30", "--protocol", "hcp2", "--timeout", "1000")
        ran = busmaster("do", f"1@{server.path}", *arguments, "--at-least", "0.1")
        assert (ran.status, ran.out, ran.err) == (0, "execute ok\n", "")
        assert server.call(lambda line, now: mint.axes[1].position(now)) == -2
        ran = busmaster("do", f"1@{server.path}", *arguments, "--at-least", "20")
        assert ran.status == 1
        assert "the command takes 20 s at least" in ran.err


@pytest.mark.slow
def test_flags_are_set_and_cleared(busmaster: Command) -> None:
    with serve("msc", 3) as server:
        msc = ("--protocol", "msc", "--timeout", "1000")
        assert busmaster("do", f"3@{server.path}", "set-flag", "0", *msc).out == "set-flag ok\n"
        assert busmaster("read", server.path, *msc, "--node", "3", "flag:0").out == "flag:0 1\n"
        assert busmaster("do", f"3@{server.path}", "clear-flag", "0", *msc).out == "clear-flag ok\n"
        assert busmaster("read", server.path, *msc, "--node", "3", "flag:0").out == "flag:0 0\n"


def test_help_lists_the_actions_of_each_protocol(busmaster: Command) -> None:
    text = busmaster("do", "--help").out.partition("ACTION, by protocol")[2]
    for kind in kinds().values():
        for name in kind.handle._actions:
            assert f"{kind.name} " in text
            assert f" {name}" in text
    words = " ".join(text.split())
    assert "hcp2 execute COMMAND DATA... Have the Mint program carry out a command" in words
    assert "microflex enable Enable the drive, and wait" in words


# by a file


@pytest.mark.slow
def test_each_write_of_an_action_is_on_record_by_its_point(busmaster: Command, file: Path, drive: TcpServer) -> None:
    assert busmaster("do", f"drive@{file}", "enable").status == 0
    assert busmaster("do", f"drive@{file}", "reset").status == 0
    assert busmaster("do", f"drive@{file}", "disable").status == 0
    assert audit(file) == [
        ("busmaster do enable", "drive/command_word", 128, "written"),
        ("busmaster do reset", "drive/command_word", 192, "written"),
        ("busmaster do reset", "drive/command_word", 128, "written"),
        ("busmaster do disable", "drive/command_word", 0, "written"),
    ]
    assert not enabled(drive)


@pytest.mark.slow
def test_a_point_of_the_file_names_the_record(busmaster: Command, file: Path) -> None:
    file.write_text(file.read_text() + '[nodes.drive.points]\ncontrol = { item = "108" }\n')
    assert busmaster("do", f"drive@{file}", "enable").status == 0
    assert audit(file) == [("busmaster do enable", "drive/control", 128, "written")]


@pytest.mark.slow
def test_limits_hold_for_an_action_and_not_for_a_stop(busmaster: Command, file: Path, drive: TcpServer) -> None:
    text = file.read_text()
    assert busmaster("do", f"drive@{file}", "enable").status == 0
    file.write_text(text + '[nodes.drive.points]\ncommand_word = { item = "command_word", writable = false }\n')
    for action in ("enable", "reset"):
        ran = busmaster("do", f"drive@{file}", action)
        assert (ran.status, ran.out) == (2, "")
    assert enabled(drive)
    assert busmaster("do", f"drive@{file}", "disable").status == 0
    assert not enabled(drive)
    assert [row[-1] for row in audit(file)] == ["written", "refused", "refused", "written"]


def test_advice_for_a_late_reply_is_a_key_only_for_a_node_of_a_file(
    busmaster: Command, file: Path, drive: TcpServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    requested: list[bool] = []

    def late_nodes(_: object, *, in_file: bool = False) -> None:
        requested.append(in_file)
        raise click.UsageError("that is enough")

    monkeypatch.setattr("busmaster.app.cli.do.late_nodes", late_nodes)
    for node in (("do", f"drive@{file}", "enable"), ("do", f"7@{drive.path}", "enable", *MICROFLEX)):
        assert "that is enough" in busmaster(*node).err
    assert requested == [True, False]


def test_an_action_that_fails_is_on_record(busmaster: Command, file: Path, drive: TcpServer) -> None:
    drive.call(lambda line, now: line.cut(now, line.device(7)))
    text = file.read_text().replace("window = 1.0", "window = 0.05, max_reply_delay = 0.05")
    file.write_text(text + '[nodes.drive.points]\ncontrol = { item = "108", factor = 0.5 }\n')
    assert busmaster("do", f"drive@{file}", "enable").status == 1
    assert audit(file) == [("busmaster do enable", "drive/control", 64, "unconfirmed")]


def quick_start(file: Path, timing: str = "window = 0.3") -> None:
    """Reduce the longest reply delay, for which a new line is first listened to."""
    file.write_text(file.read_text().replace("window = 1.0", timing))


def test_a_reply_of_0_is_printed(busmaster: Command, file: Path, drive: TcpServer) -> None:
    drive.call(lambda line, now: microflex(line).set_hardware_enable(False, now))
    quick_start(file)
    ran = busmaster("do", f"drive@{file}", "disable")
    assert (ran.status, ran.out, ran.err) == (0, "disable ok 0\n", "")
    file.write_text(file.read_text() + '[nodes.drive.points]\ncontrol = { item = "108" }\n')
    ran = busmaster("do", f"drive@{file}", "disable", "--json")
    assert without_time(ran.out) == {"node": "drive", "action": "disable", "ok": True, "value": 0, "names": []}
    assert [row[:3] for row in audit(file)] == [
        ("busmaster do disable", "drive/command_word", 0),
        ("busmaster do disable", "drive/control", 0),  # as the file names it
    ]


@pytest.mark.parametrize(
    ("name", "value", "text", "fields"),
    [
        ("", None, "move ok", {"node": 11}),
        ("", 0, "move ok 0", {"node": 11, "value": 0}),
        ("winder", None, "move ok", {"node": "winder"}),
    ],
)
def test_an_action_is_reported_with_its_reply_and_by_the_name_of_its_node_or_its_address(
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    name: str,
    value: int | None,
    text: str,
    fields: dict[str, Any],
) -> None:
    checked: list[Any] = []

    async def run(handle: Any, *values: float, **options: float) -> int | None:
        assert (values, options) == ((1, -2.5), {"within": 4.0})
        return value

    move = Action("move", run, lambda *given: checked.append(given), numbers=("AXIS", "DISTANCE..."))
    handle = SimpleNamespace(node=SimpleNamespace(address=11))
    line = object() if name else None  # of a file, whose line has an owner: it keeps the record
    target: Any = SimpleNamespace(line=line, owned=True, handle=handle, name=name, bus=nullcontext())
    monkeypatch.setattr(do, "late_nodes", lambda bus, in_file: nullcontext())
    for as_json in (False, True):
        asyncio.run(do.carry_out(target, "move", move, (1, -2.5), {"within": 4.0}, as_json))
    plain, json_ = capfd.readouterr().out.splitlines()
    assert plain == text
    assert without_time(json_) == {"action": "move", "ok": True} | fields
    assert checked == [(handle, 1, -2.5)] * 2


def test_a_late_reply_to_an_action_is_reported_with_the_key_of_the_file(
    busmaster: Command, file: Path, drive: TcpServer
) -> None:
    drive.call(lambda line, now: setattr(microflex(line), "delay", Delay(0.03)))
    quick_start(file, "window = 0.01, max_reply_delay = 0.2")
    ran = busmaster("do", f"drive@{file}", "disable")
    assert ran.status == 0, ran.err
    assert "drive: late reply, " in ran.err
    assert "; set timing = { window = 0." in ran.err


def test_an_output_that_cannot_store_the_record_of_an_action_is_reported(
    busmaster: Command, file: Path, drive: TcpServer
) -> None:
    (file.parent / "line.sqlite").mkdir()
    quick_start(file)
    ran = busmaster("do", f"drive@{file}", "disable")
    assert (ran.status, ran.out) == (0, "disable ok 64 HARDWARE_ENABLE\n")
    down, incomplete = ran.err.splitlines()
    assert down.startswith("busmaster: sqlite is down: ")
    assert incomplete.startswith("busmaster: sqlite: the audit log is incomplete: ")
    assert down.endswith("Is a directory")
    assert incomplete.endswith("Is a directory")


@pytest.mark.parametrize("option", [("--protocol", "microflex"), ("--baud", "9600")])
def test_what_the_file_says_is_not_said_again(busmaster: Command, file: Path, option: tuple[str, ...]) -> None:
    ran = busmaster("do", f"drive@{file}", "enable", *option)
    assert ran.status == 2
    assert f"already defines the line; leave out {option[0]}" in ran.err


def test_a_node_that_the_file_does_not_have_is_named(busmaster: Command, file: Path) -> None:
    ran = busmaster("do", f"drvie@{file}", "enable")
    assert ran.status == 2
    assert "has no node 'drvie'; did you mean 'drive'?" in ran.err


# through the owner


@pytest.mark.slow
def test_the_owner_of_the_line_carries_it_out_and_keeps_the_record(
    busmaster: Command, file: Path, drive: TcpServer
) -> None:
    with owner("serve", str(file)):
        ran = busmaster("do", f"drive@{file}", "enable")
        assert (ran.status, ran.out) == (0, "enable ok 192 HARDWARE_ENABLE|ENABLED\n")
        assert "is owned by process" in ran.err
        assert enabled(drive)
        assert busmaster("do", f"7@{drive.path}", "disable", *MICROFLEX[:2]).status == 0
        assert not enabled(drive)
    enabling, disabling = audit(file)  # as the owner keeps them
    assert enabling[2:] == ("'write element 108 = 128'", "written")
    assert disabling[2:] == ("'write element 108 = 0'", "written")


def test_each_write_of_an_action_is_checked_before_the_first_is_sent() -> None:
    """As a node does: an action of two writes whose second is beyond its limit writes nothing."""
    refused: list[tuple[object, str]] = []
    line = SimpleNamespace(authorisation=SimpleNamespace(refuse=lambda request, why: refused.append((request, why))))

    async def story(bus: Bus) -> None:
        controller = Hcp2Controller(bus, 1)
        controller.node.limit(Limit(name="pull", read=hcp2.Read(11), decode=float, maximum=10.0))
        node = RecordedNode(controller.node, line, "drive", controller, "me")  # type: ignore[arg-type]
        node._write_request = lambda command: command  # type: ignore[method-assign, assignment, return-value]
        node.check(hcp2.Write(10, (5.0,)), hcp2.Write(11, (5.0,)))
        with pytest.raises(InvalidCommand):
            node.check(hcp2.Write(10, (5.0,)), hcp2.Write(11, (50.0,)))

    on_a_bus(story, EmulatedMint(1))
    [(request, why)] = refused
    assert request == hcp2.Write(11, (50.0,))
    assert "pull = 50 is above its maximum of 10" in why


class Kept:
    """A node that keeps its requests and their options."""

    label = "drive"
    profile = Hcp2Controller.profile

    def __init__(self) -> None:
        self.given: list[tuple[Any, dict[str, Any]]] = []

    def check(self, *commands: Any, stop: bool | None = None) -> None:
        self.given.append((commands, {"stop": stop}))

    async def request(self, command: Any, /, **options: Any) -> str:
        self.given.append((command, options))
        return "done"

    @asynccontextmanager
    async def exclusive(self, *, max_hold: float = 0.5) -> AsyncIterator[Kept]:
        self.given.append(("exclusive", {"max_hold": max_hold}))
        yield self


def recorded(node: Kept) -> tuple[RecordedNode, list[WriteRequest]]:
    """The node as an action of a file has it, and the writes that were begun on it."""
    begun: list[WriteRequest] = []

    def begin(request: WriteRequest) -> nullcontext[None]:
        begun.append(request)
        return nullcontext()

    line = SimpleNamespace(
        authorisation=SimpleNamespace(begin=begin),
        file=SimpleNamespace(nodes={"drive": SimpleNamespace(points=())}),
    )
    handle = SimpleNamespace(items=lambda: ())
    return RecordedNode(node, line, "drive", handle, "busmaster do move"), begun  # type: ignore[arg-type]  # a stand-in


def test_a_node_of_a_file_sends_each_request_with_its_options_and_records_the_writes() -> None:
    node = Kept()
    ours, begun = recorded(node)
    read: Any
    write: Any
    read, write, other = hcp2.Read(10), hcp2.Write(10, (5.0,)), hcp2.Write(11, (6.0,))

    async def story() -> None:
        assert await ours.request(read, stops_seen=3, priority=Priority.URGENT) == "done"
        assert begun == []
        assert await ours.request(write, touches=other, stops_seen=4, stop=True, priority=Priority.URGENT) == "done"
        ours.check(write, stop=True)
        async with ours.exclusive(max_hold=2.5) as held:
            await held.request(other)

    asyncio.run(story())
    assert node.given == [
        (read, {"stops_seen": 3, "priority": Priority.URGENT}),
        (write, {"touches": other, "stops_seen": 4, "stop": True, "priority": Priority.URGENT}),
        ((write,), {"stop": True}),
        ("exclusive", {"max_hold": 2.5}),
        (other, {"touches": None, "stops_seen": None, "stop": False}),
    ]
    assert [(one.interface, one.by, one.name, one.value) for one in begun] == [
        ("command line", "busmaster do move", "drive/raw command", str(write)),
        ("command line", "busmaster do move", "drive/raw command", str(other)),
    ]


NEVER_RUN: Any = None
MOVE = Action("move", NEVER_RUN, NEVER_RUN, numbers=("AXIS", "DISTANCE..."), time="within", least="at_least")
STOP = Action("stop", NEVER_RUN, NEVER_RUN, numbers=("AXIS",), time="timeout")


@pytest.mark.parametrize(
    ("action", "values", "times", "options"),
    [
        (MOVE, (1,), (None, None), {}),
        (MOVE, (1, 2.5, -3), (4.0, None), {"within": 4.0}),
        (MOVE, (1, 2), (4.0, 0.5), {"within": 4.0, "at_least": 0.5}),
        (STOP, (1,), (2.0, None), {"timeout": 2.0}),
    ],
)
def test_times_are_arguments_of_the_action_by_its_names(
    action: Action, values: tuple[float, ...], times: tuple[float | None, float | None], options: dict[str, float]
) -> None:
    assert options_of(action, "move", values, *times) == options


@pytest.mark.parametrize(
    ("action", "values", "complaint"),
    [
        (MOVE, (), "0 numbers do not fit; write: move AXIS DISTANCE..."),
        (STOP, (1, 2), "2 numbers do not fit; write: move AXIS"),
        (STOP, (), "0 numbers do not fit; write: move AXIS"),
    ],
)
def test_an_action_takes_as_many_numbers_as_it_names(action: Action, values: tuple[float, ...], complaint: str) -> None:
    with pytest.raises(click.UsageError) as refused:
        options_of(action, "move", values, None, None)
    assert refused.value.message == complaint


def test_a_misspelt_option_behind_a_number_is_not_a_number(busmaster: Command) -> None:
    ran = busmaster("do", "2@PORT", "execute", "1", "--wihtin", "1", "--protocol", "hcp")
    assert ran.status == 2
    assert "no such option '--wihtin'" in ran.err


@pytest.mark.slow
def test_a_reply_in_json_has_the_node_by_the_name_of_the_file_and_the_names_of_bits(
    busmaster: Command, file: Path, drive: TcpServer
) -> None:
    ran = busmaster("do", f"drive@{file}", "enable", "--json")
    assert ran.status == 0
    assert without_time(ran.out) == {
        "node": "drive",
        "action": "enable",
        "ok": True,
        "value": 192,
        "names": ["HARDWARE_ENABLE", "ENABLED"],
    }
    assert audit(file) == [("busmaster do enable", "drive/command_word", 128, "written")]


def test_numbers_that_cannot_be_sent_are_refused_before_the_port_is_opened(
    busmaster: Command, file: Path, drive: TcpServer
) -> None:
    file.write_text(file.read_text().replace("microflex", "msc").replace("57600", "9600"))
    drive.close()
    ran = busmaster("do", f"drive@{file}", "set-flag", "256")
    assert (ran.status, ran.out) == (2, "")
    assert "256" in ran.err


def test_each_value_of_a_run_is_printed_with_the_precision_of_its_point() -> None:
    async def story(bus: Bus) -> None:
        controller = Hcp2Controller(bus, 1)
        lines = [*plain_lines(controller, "1:2", (1.2345, 2.0), 1)]
        assert [line.split()[-1] for line in lines] == ["1.2", "2.0"]

    on_a_bus(story, EmulatedMint(1))
