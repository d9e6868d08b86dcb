"""What the options of a command become: each reaches the port, the node, the view or the capture that it is for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import click
import pytest
from click.testing import CliRunner

from busmaster import LEARNED, Timings
from busmaster.app.cli import arguments, capturing
from busmaster.app.cli.app import cli
from busmaster.app.cli.arguments import Connection, View, connected, nodes_to_ask, single_nodes, viewed
from busmaster.app.cli.protocols import NodeCommand
from busmaster.app.cli.read import command as read
from busmaster.bus.bus import Bus
from busmaster.bus.node import Node
from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Line
from busmaster.emulator.memory import MemoryPort
from busmaster.errors import InvalidCommand
from busmaster.ext import Learned
from busmaster.protocols.msc.handle import MscController
from busmaster.registry import find
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort
from tests.app.cli.conftest import Command

HCP2 = find("hcp2").profile
TOP = click.Context(cli, **cli.context_settings)
"""click keeps the names of the help option of the first context in which a command is used."""


@pytest.fixture
def context() -> Iterator[click.Context]:
    with click.Context(read, TOP) as context:
        yield context


# of a port


def test_baud_and_echo_reach_the_port() -> None:
    plain = Connection("/dev/ttyS0", "mentor").endpoint()
    assert plain == SerialPort("/dev/ttyS0", baudrate=9600, bytesize=7, parity="E")
    changed = Connection("/dev/ttyS0", "mentor", baud=4800, echo=True)
    assert changed.endpoint() == SerialPort("/dev/ttyS0", baudrate=4800, bytesize=7, parity="E", echo=True)
    assert changed.line == LineSettings(4800, bytesize=7, parity="E")
    assert Connection("socket://server:4001?echo=1", "hcp2").endpoint() == TcpPort("server", 4001, echo=True)


def test_timeout_is_the_window_and_moves_the_longest_reply_delay_with_it() -> None:
    longest = HCP2.timings.read.max_reply_delay
    plain, longer, learned = (Connection("/dev/ttyS0", "hcp2", timeout=one) for one in (None, 0.5, LEARNED))
    assert (plain.timings, plain.max_reply_delay) == (None, longest)
    assert isinstance(longer.timings, Timings)
    assert longer.timings == HCP2.timings.with_window(0.5)
    assert longer.max_reply_delay == longer.timings.read.max_reply_delay > longest
    assert isinstance(learned.timings, Learned)
    assert learned.max_reply_delay == longest


def test_retries_and_options_of_the_protocol_reach_the_handle() -> None:
    bus = Bus(MemoryPort(Line(find("msc").profile.line)))
    first = Connection("/dev/ttyS0", "msc", retries=0, options={"address_step": 4}).open_handle(bus, 3)
    assert isinstance(first, MscController)
    assert first.address_step == 4
    with pytest.raises(InvalidCommand, match="other retries"):
        Connection("/dev/ttyS0", "msc", retries=1).open_handle(bus, 3)


def test_the_window_of_the_options_reaches_the_node() -> None:
    bus = Bus(MemoryPort(Line(HCP2.line)))
    longer = Connection("/dev/ttyS0", "hcp2", timeout=0.5)
    assert Node.of(longer.open_handle(bus, 1)).timings == longer.timings
    assert Node.of(Connection("/dev/ttyS0", "hcp2").open_handle(bus, 2)).timings == HCP2.timings


def test_json_has_the_number_of_a_node_where_the_protocol_has_addresses() -> None:
    assert Connection("/dev/ttyS0", "dc104").node_number(0) is None
    assert Connection("/dev/ttyS0", "hcp2").node_number(0) == 0


@pytest.mark.usefixtures("context")
def test_each_address_is_checked() -> None:
    hcp2, mint = Connection("/dev/ttyS0", "hcp2"), Connection("/dev/ttyS0", "hcp")
    assert hcp2.addresses((1, 255)) == (1, 255)
    assert hcp2.one_address(7) == 7
    for wrong in ((1, 16), (16, 1)):
        with pytest.raises(click.UsageError, match="16"):
            mint.addresses(wrong)
    with pytest.raises(click.UsageError, match="16"):
        mint.one_address(16)
    mentor = find("mentor").profile
    for wrong in ((0, 1), (1, 0)):
        with pytest.raises(click.UsageError, match="0 is the broadcast address"):
            nodes_to_ask(mentor, wrong)
        with pytest.raises(click.UsageError, match="0 is the broadcast address"):
            single_nodes(mentor, wrong)
    assert nodes_to_ask(mentor, None) == tuple(mentor.addresses)
    assert nodes_to_ask(mentor, (2, 1)) == (2, 1)


def test_a_capture_has_the_port_its_protocol_and_whether_it_echoes(
    monkeypatch: pytest.MonkeyPatch, context: click.Context
) -> None:
    given: list[tuple[str | None, dict[str, Any]]] = []

    def noted(path: str | None, **fields: Any) -> Any:
        given.append((path, fields))
        return capturing.capturing(None, port="")

    monkeypatch.setattr(arguments, "capturing", noted)
    Connection("/dev/ttyS0", "hcp2", echo=True, capture="line.pcapng").open_bus()
    assert given == [("line.pcapng", {"port": "/dev/ttyS0", "protocol": "hcp2", "echo": True})]
    context.close()


# of a command


def connection_of(*options: str, or_file: bool = False) -> Connection:
    """What a command with these options gets."""
    seen: list[Connection] = []

    @click.command(cls=NodeCommand)
    @partial(connected, or_file=or_file)
    def command(connection: Connection) -> None:
        seen.append(connection)

    ran = CliRunner().invoke(command, ["/dev/ttyS0", *options], catch_exceptions=False)
    assert ran.exit_code == 0, ran.output
    return seen[0]


def test_every_option_of_a_port_reaches_the_command() -> None:
    assert connection_of("--protocol", "hcp2") == Connection("/dev/ttyS0", "hcp2")
    options = (
        "--baud",
        "4800",
        "--echo",
        "--timeout",
        "250",
        "--retries",
        "0",
        "--capture",
        "a",
        "--address-step",
        "4",
    )
    assert connection_of("--protocol", "msc", *options) == Connection(
        "/dev/ttyS0", "msc", 4800, True, 0.25, 0, "a", {"address_step": 4}
    )
    assert connection_of("--protocol", "msc", "--timeout", "learned", or_file=True).timeout is LEARNED


def test_options_of_a_protocol_reach_each_of_several_ports() -> None:
    seen: list[Connection] = []

    @click.command(cls=NodeCommand)
    @partial(connected, port=False)
    def command(connection: Callable[[str], Connection]) -> None:
        seen.extend((connection("/dev/ttyS0"), connection("/dev/ttyS1")))

    arguments = ["--protocol", "msc", "--address-step", "4"]
    assert CliRunner().invoke(command, arguments, catch_exceptions=False).exit_code == 0
    assert [(one.port, one.options) for one in seen] == [
        ("/dev/ttyS0", {"address_step": 4}),
        ("/dev/ttyS1", {"address_step": 4}),
    ]


@pytest.mark.parametrize(
    ("options", "view"),
    [
        ((), View()),
        (("--seconds", "2.5"), View(seconds=2.5)),
        (("--json",), View(as_json=True)),
        (("--plain",), View(plain=True)),
        (("--read-only",), View(read_only=True)),
    ],
)
def test_every_option_of_a_view_reaches_the_command(options: tuple[str, ...], view: View) -> None:
    seen: list[View] = []

    @click.command()
    @viewed
    def command(view: View) -> None:
        seen.append(view)

    assert CliRunner().invoke(command, options).exit_code == 0
    assert seen == [view]


ONE_OF_THE_LINE = {"protocol", "baud", "echo", "timeout", "retries", "address_step", "node", "decimals", "chain"}
"""Options that a LINE.toml stands for."""
BESIDE_A_FILE = {
    *("capture", "capture_mb", "capture_files", "as_json", "verify", "within", "at_least"),
    *("period", "csv_path", "span", "seconds", "plain"),
    *("output", "items", "dry_run", "yes", "enabled", "undo"),
}


@pytest.mark.parametrize("name", ["read", "write", "do", "trend", "params save", "params diff", "params load"])
def test_beside_a_file_only_options_that_do_not_describe_its_line_are_permitted(name: str) -> None:
    command: click.Command | None = cli
    for part in name.split():
        assert isinstance(command, click.Group)
        command = command.get_command(TOP, part)
    assert command is not None
    for option in command.get_params(click.Context(command, TOP)):
        if not isinstance(option, click.Option) or "--help" in option.opts:
            continue
        given = [option.opts[0], *([] if option.is_flag else ["1"])]
        with command.make_context(name, given, resilient_parsing=True):
            if option.name in BESIDE_A_FILE:
                assert arguments.none_but_the_files("a.toml") == ""
            else:
                assert option.name in ONE_OF_THE_LINE
                with pytest.raises(click.UsageError, match=f"already defines the line; leave out {option.opts[0]}$"):
                    arguments.none_but_the_files("a.toml")


def test_node_0_is_an_address(busmaster: Command) -> None:
    ran = busmaster("read", "socket://127.0.0.1:1", "--protocol", "hcp2", "--node", "0", "1")
    assert ran.status == 1, "no usage error: nothing listens on this port"
