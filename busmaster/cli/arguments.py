"""What the commands have in common on their command lines, checked before anything is sent."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import click

from busmaster.bus import Bus
from busmaster.cli.capturing import capture_option, capturing
from busmaster.errors import InvalidCommand
from busmaster.exchange import Timings
from busmaster.handles import HANDLES, Handle, MscController
from busmaster.profile import LineSettings, Profile
from busmaster.transport.endpoints import endpoint
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

F = TypeVar("F", bound=Callable[..., Any])
S = TypeVar("S")
T = TypeVar("T")

HIGHEST_ADDRESS = 255
HIGHEST_PORT = 65535
LONGEST_WINDOW = 60.0
"""Seconds. Lateness moves with it, and a line is first listened to for that long."""

WHAT_ITEMS_ARE = """\b
ITEM, by protocol:
  hcp        a comms element, 1 to 99
  hcp2       an element, 1 to 255, or its name: axis0.position (to axis7;
             position velocity mode axis_error demand encoder idle
             following_error), inputs outputs adc0 (to adc7) error error_line
             error_axis running line_number firmware
  microflex  an element, or its name: position demand_position
             following_error axis_error drive_error command_word status_word
             speed_reference speed_demand speed_measured speed_error
             torque_reference torque_demand current current_u current_v
             bus_voltage drive_overload motor_overload hall_state
             absolute_encoder phase_search_status inputs outputs analog_input
             firmware temperature
  msc        2008 (a data address), 2008:32 (32 values from there on), flag:5,
             flags, status
  mentor     1.17 (menu and parameter), 15.60:wide, 1.17:hires, 1.17:20 (20
             parameters from there on)
  dc104      a parameter, 1 to 255
"""
"""For the help of commands that take some."""


class Whole(click.IntRange):
    """Says "is not a valid whole number" of what is none."""

    name = "whole number"


def option_type(parse: Callable[[str], T]) -> Callable[[str], T]:
    """For click's `type=`: a value that `parse` refuses with InvalidCommand is wrong usage of that option."""

    def convert(text: str) -> T:
        try:
            return parse(text)
        except InvalidCommand as error:
            raise click.BadParameter(str(error)) from None

    return convert


def parse_nodes(text: str) -> tuple[int, ...]:
    """The addresses of `1-8,255`. Raises InvalidCommand."""
    addresses: dict[int, None] = {}
    for part in text.split(","):
        first, dash, last = (piece.strip() for piece in part.partition("-"))
        if not is_decimal(first) or (dash and not is_decimal(last)):
            raise InvalidCommand(f"a node list is written like 1-8,255, not {text!r}")
        start, stop = int(first), int(last or first)
        if start > stop:
            raise InvalidCommand(f"a range goes upwards: {stop}-{start}, not {part.strip()}")
        if stop > HIGHEST_ADDRESS:
            raise InvalidCommand(f"no protocol has a node {stop}")
        addresses.update(dict.fromkeys(range(start, stop + 1)))
    return tuple(addresses)


def parse_seconds(text: str) -> float:
    """Seconds above 0. Raises InvalidCommand."""
    seconds = parse_value(text)
    if not 0 < seconds < float("inf"):
        raise InvalidCommand(f"a time is above 0, not {text}")
    return seconds


def parse_window(text: str) -> float:
    """A reply window in milliseconds, in seconds. Raises InvalidCommand for one that nobody would wait for."""
    seconds = parse_seconds(text) / 1000
    if seconds > LONGEST_WINDOW:
        raise InvalidCommand(f"a reply window is at most {LONGEST_WINDOW * 1000:.0f} ms, not {text}")
    return seconds


def parse_items(text: str) -> tuple[str, ...]:
    """The items of `--items a,b,c`. Raises InvalidCommand for none."""
    items = tuple(item for item in (part.strip() for part in text.split(",")) if item)
    if not items:
        raise InvalidCommand("--items names at least one item")
    return tuple(dict.fromkeys(items))


def parse_assignment(text: str) -> tuple[str, tuple[float, ...]]:
    """`ITEM=VALUE[,VALUE...]` -> the item and its numbers. Raises InvalidCommand."""
    item, equals, values = text.partition("=")
    if not equals or not item.strip() or not values.strip():
        raise InvalidCommand(f"an assignment is written ITEM=VALUE, like 1=123.456, not {text!r}")
    return item.strip(), tuple(parse_value(part) for part in values.split(","))


def parse_value(text: str) -> float:
    """A whole number stays one. Hexadecimal (0x41) is taken for the words. Raises InvalidCommand."""
    text = text.strip()
    try:
        return int(text, 16) if text.lower().startswith("0x") else int(text)
    except ValueError:
        pass
    try:
        return float(text)
    except ValueError:
        raise InvalidCommand(f"{text!r} is no number") from None


def parse_host_port(text: str) -> tuple[str, int]:
    """`HOST:PORT`. Raises InvalidCommand."""
    host, colon, port = text.rpartition(":")
    if not colon or not host or not is_decimal(port) or int(port) > HIGHEST_PORT:
        raise InvalidCommand(f"a TCP address is written HOST:PORT, like 127.0.0.1:5020, not {text!r}")
    return host.strip("[]"), int(port)


def parsed(parse: Callable[[S], T], value: S) -> T:
    """What `parse` makes of an argument; what it refuses is wrong usage. Raises UsageError."""
    try:
        return parse(value)
    except InvalidCommand as error:
        raise click.UsageError(str(error), click.get_current_context()) from None


def is_run(item: str) -> bool:
    """`2008:32`, `1.17:20`: values from there on."""
    first, colon, count = item.partition(":")
    return bool(colon) and first != "flag" and is_decimal(count)


def run_names(handle: Handle, item: str, count: int) -> tuple[str, ...]:
    """What each value of a run, or of several from `item` on, is called: 1.17, 1.18, ..."""
    if isinstance(handle, MscController):
        return handle.run_items(item)
    first, colon, kind = item.partition(":")
    suffix = f":{kind}" if colon and not is_decimal(kind) else ""
    menu, dot, number = first.rpartition(".")
    if not is_decimal(number):
        raise InvalidCommand(f"several values begin at a number, not at {item!r}")
    return tuple(f"{menu}{dot}{int(number) + i:0{len(number)}d}{suffix}" for i in range(count))


def is_decimal(text: str) -> bool:
    return text.isascii() and text.isdigit()


@dataclass(frozen=True, slots=True)
class Connection:
    """A PORT and how to speak on it, as the options say. Nothing is opened."""

    port: str
    protocol: str
    baud: int | None = None
    echo: bool = False
    timeout: float | None = None
    retries: int | None = None
    address_step: int | None = None
    capture: str | None = None

    @property
    def handle(self) -> type[Handle]:
        return HANDLES[self.protocol]

    @property
    def profile(self) -> Profile:
        return self.handle.profile

    @property
    def line(self) -> LineSettings:
        return line_settings(self.profile, self.baud)

    @property
    def timings(self) -> Timings | None:
        return None if self.timeout is None else self.profile.timings.with_window(self.timeout)

    def endpoint(self) -> SerialPort | TcpPort:
        """Raises InvalidCommand for a PORT that is none."""
        found = endpoint(self.port, defaults=self.line)
        return replace(found, echo=True) if self.echo else found

    def open_bus(self) -> Bus:
        """The bus on it, which `async with` opens. Raises InvalidCommand for a PORT that is none.

        With --capture it is recorded until the command ends. Raises UsageError if that file cannot be written.
        """
        where = self.endpoint()
        recording = capturing(self.capture, port=where.name, protocol=self.protocol, echo=where.echo)
        return Bus(where, tap=click.get_current_context().with_resource(recording))

    def open_handle(self, bus: Bus, address: int) -> Handle:
        """A handle on the bus, which need not be open. Raises InvalidCommand."""
        options: dict[str, Any] = {"timings": self.timings, "retries": self.retries}
        if self.address_step is not None:
            options["address_step"] = self.address_step
        return self.handle(bus, address, **options)

    def node_number(self, address: int) -> int | None:
        """For JSON: null where the protocol has no addresses."""
        return address if self.profile.addressed else None

    def one_address(self, node: int | None) -> int:
        """Of `--node N`. Raises UsageError if it is missing, or given where there are no addresses."""
        return only_address(self.profile) if node is None else checked(self.profile, (node,))[0]

    def addresses(self, nodes: Sequence[int] | None) -> tuple[int, ...]:
        """Of `--nodes N-M,K`, likewise."""
        return (only_address(self.profile),) if nodes is None else checked(self.profile, nodes)


@dataclass(frozen=True, slots=True)
class View:
    """How what is polled is shown: for so many seconds or until Ctrl-C, as JSON, as plain lines, or on the screen."""

    seconds: float | None = None
    as_json: bool = False
    plain: bool = False
    read_only: bool = False
    """No key of the screen writes."""


def line_settings(profile: Profile, baud: int | None) -> LineSettings:
    """The protocol's line, at another baud rate if one is given."""
    return profile.line if baud is None else replace(profile.line, baudrate=baud)


def only_address(profile: Profile) -> int:
    if profile.addressed:
        raise click.UsageError(f"{profile.name} needs a node: one of {span(profile)}")
    return profile.addresses.start


def checked(profile: Profile, nodes: Iterable[int]) -> tuple[int, ...]:
    if not profile.addressed:
        raise click.UsageError(f"{profile.name} has no addresses: one drive a line, named without a node")
    for node in nodes:
        parsed(profile.check_address, node)
    return tuple(nodes)


def slaves_of(profile: Profile, nodes: Sequence[int] | None) -> tuple[int, ...]:
    """The addresses to emulate: those of --nodes, else 1, or the one drive. Raises UsageError."""
    if nodes is None:
        return (1,) if profile.addressed else (profile.addresses.start,)
    if profile.broadcast in nodes:
        raise click.UsageError(f"{profile.name}: no node has address {profile.broadcast}, which means all of them")
    return checked(profile, nodes)


def span(profile: Profile) -> str:
    return f"{profile.addresses.start}-{profile.addresses.stop - 1}"


def protocol_option(command: F) -> F:
    return click.option(
        "--protocol", required=True, type=click.Choice(list(HANDLES)), metavar="P", help=f"One of {', '.join(HANDLES)}."
    )(command)


def connected(command: F) -> F:
    """Give a command PORT, --protocol and the options of a port, as one `Connection` named `connection`."""

    @functools.wraps(command)
    def gathered(
        port: str,
        protocol: str,
        baud: int | None,
        echo: bool,
        timeout: float | None,
        retries: int | None,
        address_step: int | None,
        capture: str | None,
        **options: Any,
    ) -> Any:
        if address_step is not None and protocol != "msc":
            raise click.UsageError("--address-step is msc's alone")
        connection = Connection(port, protocol, baud, echo, timeout, retries, address_step, capture)
        return command(connection=connection, **options)

    options = (
        click.argument("port"),
        protocol_option,
        click.option("--baud", type=Whole(min=1), metavar="N", help="Baud rate; the protocol's by default."),
        click.option("--echo", is_flag=True, help="The adapter hears what it sends (two-wire)."),
        click.option(
            "--timeout", type=option_type(parse_window), metavar="MS", help="The reply window, in milliseconds."
        ),
        click.option("--retries", type=Whole(min=0), metavar="N", help="How often a read is tried again."),
        capture_option,
        click.option(
            "--address-step", type=Whole(min=1), metavar="N", help="msc: addresses from one value to the next."
        ),
    )
    for option in reversed(options):
        gathered = option(gathered)
    return gathered  # type: ignore[return-value]  # the decorated function takes more than the one it wraps


def viewed(command: F) -> F:
    """Give a command the options of a view, as one `View` named `view`."""

    @functools.wraps(command)
    def gathered(seconds: float | None, as_json: bool, plain: bool, read_only: bool, **options: Any) -> Any:
        return command(view=View(seconds, as_json, plain, read_only), **options)

    read_only = click.option("--read-only", is_flag=True, help="Live view: no key writes to a node.")
    for option in (read_only, plain_option, json_option, seconds_option):
        gathered = option(gathered)
    return gathered  # type: ignore[return-value]  # likewise


node_option = click.option("--node", type=Whole(0, HIGHEST_ADDRESS), metavar="N", help="The node's address.")
nodes_option = click.option(
    "--nodes", type=option_type(parse_nodes), metavar="N-M,K", help="Node addresses, like 1-8,255."
)
json_option = click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
plain_option = click.option("--plain", is_flag=True, help="Plain lines on a terminal too.")
seconds_option = click.option(
    "--seconds", type=option_type(parse_seconds), metavar="S", help="End by itself after so many seconds."
)
