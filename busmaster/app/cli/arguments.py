"""What the commands have in common on their command lines, checked before anything is sent."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from busmaster import Bus, LineSettings, SerialPort, TcpPort, Timings, endpoint
from busmaster.app.cli.capturing import capture_option, capturing
from busmaster.app.cli.lines import is_line_file
from busmaster.app.cli.parsing import Whole, option_type, parse_nodes, parse_seconds, parse_window, parsed
from busmaster.app.cli.protocols import handle_options, protocol_option, take_options
from busmaster.ext import Handle, Learned, NodeSource, Profile, documented, find

F = TypeVar("F", bound=Callable[..., Any])

NOT_THE_FILES = (
    *("capture", "capture_files", "capture_mb", "verify", "as_json"),
    *("items", "output", "dry_run", "yes", "enabled", "undo", "within", "at_least"),
    *("period", "csv_path", "span", "seconds", "plain"),
)
"""Options that do not describe a line, and are permitted with a LINE.toml."""


@dataclass(frozen=True, slots=True)
class Connection:
    """A PORT and the protocol and settings given by the options. Nothing is opened."""

    port: str
    protocol: str
    baud: int | None = None
    echo: bool = False
    timeout: float | Learned | None = None
    retries: int | None = None
    capture: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of the protocol's handle."""

    @property
    def profile(self) -> Profile:
        """The profile of the protocol."""
        return find(self.protocol).profile

    @property
    def line(self) -> LineSettings:
        """The settings of the line: those of the protocol, at the baud rate of the options."""
        return line_settings(self.profile, self.baud)

    @property
    def timings(self) -> Timings | Learned | None:
        """The timings given by the options; None for those of the protocol."""
        if self.timeout is None or isinstance(self.timeout, Learned):
            return self.timeout
        return self.profile.timings.with_window(self.timeout)

    @property
    def max_reply_delay(self) -> float:
        """Maximum reply delay in seconds, from the options, by default the protocol's."""
        return (documented(self.timings) or self.profile.timings).read.max_reply_delay

    def endpoint(self) -> SerialPort | TcpPort:
        """Return the endpoint that PORT names. Raises InvalidCommand for a PORT that is none."""
        found = endpoint(self.port, defaults=self.line)
        return replace(found, echo=True) if self.echo else found

    def open_bus(self) -> Bus:
        """Return the bus on PORT, which `async with` opens. Raises InvalidCommand for a PORT that is none.

        With --capture it is recorded until the command ends. Raises UsageError if that file cannot be written.
        """
        where = self.endpoint()
        recording = capturing(self.capture, port=where.name, protocol=self.protocol, echo=where.echo)
        # left with the command, when no loop runs any more: leaving waits for the disk
        return Bus(where, tap=click.get_current_context().with_resource(recording))

    def open_handle(self, bus: NodeSource, address: int) -> Handle:
        """Return a handle on the bus, which need not be open. Raises InvalidCommand."""
        handle: Callable[..., Handle] = find(self.protocol).handle
        return handle(bus, address, timings=self.timings, retries=self.retries, **self.options)

    def node_number(self, address: int) -> int | None:
        """Return the address as JSON has it: null where the protocol has no addresses."""
        return address if self.profile.addressed else None

    def one_address(self, node: int | None) -> int:
        """Return the address of `--node N`.

        Raises UsageError if it is missing, or given where there are no addresses.
        """
        return only_address(self.profile) if node is None else checked(self.profile, (node,))[0]

    def addresses(self, nodes: Sequence[int] | None) -> tuple[int, ...]:
        """Return the addresses of `--nodes N-M,K`.

        Raises UsageError if they are missing, or given where there are no addresses.
        """
        return (only_address(self.profile),) if nodes is None else checked(self.profile, nodes)


@dataclass(frozen=True, slots=True)
class View:
    """How polled values are shown: until a time or Ctrl-C, as JSON, as plain lines, or on the screen."""

    seconds: float | None = None
    as_json: bool = False
    plain: bool = False
    read_only: bool = False
    """No key of the screen writes."""
    silent: bool = False
    """Show no values; report important events on standard error."""


def line_settings(profile: Profile, baud: int | None) -> LineSettings:
    """Return the settings of the protocol's line, at another baud rate if one is given."""
    return profile.line if baud is None else replace(profile.line, baudrate=baud)


def only_address(profile: Profile) -> int:
    """Return the one address of a protocol without addresses. Raises UsageError for one that has them."""
    if profile.addressed:
        raise click.UsageError(f"{profile.name} needs a node address, {span(profile)}; none was given")
    return profile.addresses[0]


def checked(profile: Profile, nodes: Iterable[int]) -> tuple[int, ...]:
    """Return the nodes that were given.

    Raises UsageError for one that the protocol cannot have, and for any where it has no addresses.
    """
    if not profile.addressed:
        raise click.UsageError(f"{profile.name} has no node addresses (one drive per line); leave out the node")
    for node in nodes:
        parsed(profile.check_address, node)
    return tuple(nodes)


def single_nodes(profile: Profile, nodes: Sequence[int]) -> tuple[int, ...]:
    """Return the nodes that were given. Raises UsageError as `checked`, and for the address that means all nodes."""
    if profile.broadcast in nodes:
        raise click.UsageError(f"{profile.name}: {profile.broadcast} is the broadcast address; name a single node")
    return checked(profile, nodes)


def nodes_to_ask(profile: Profile, nodes: Sequence[int] | None) -> tuple[int, ...]:
    """Return the addresses of --nodes, by default all. Raises UsageError for an address that is not possible."""
    return tuple(profile.addresses) if nodes is None else single_nodes(profile, nodes)


def span(profile: Profile) -> str:
    """Return the protocol's lowest and highest address, as `1-8`."""
    return f"{profile.addresses[0]}-{profile.addresses[-1]}"


def connected(command: F, *, or_file: bool = False, port: bool = True) -> F:
    """Give a command PORT, --protocol and the options of a port, as one `Connection` named `connection`.

    `or_file`: PORT may be a LINE.toml, which defines all of that; `connection.protocol` is then "". Without `port` the
    command has no PORT of its own, and `connection` is a function that returns the connection for one.
    """

    @functools.wraps(command)
    def gathered(
        protocol: str | None,
        baud: int | None,
        echo: bool,
        timeout: float | Learned | None,
        retries: int | None,
        capture: str | None,
        **options: Any,
    ) -> Any:
        given = {offer.option.name: options.pop(offer.option.name, None) for offer in handle_options()}
        where = options.pop("port", None)

        def connection(port: str) -> Connection:
            if or_file and is_line_file(port):
                chosen = none_but_the_files(port)
            elif protocol is None:
                raise click.UsageError("protocol missing; use --protocol P, or a LINE.toml instead of the port")
            else:
                chosen = protocol
            own = take_options(handle_options(), chosen, dict(given))
            return Connection(port, chosen, baud, echo, timeout, retries, capture, own)

        return command(connection=connection if where is None else connection(where), **options)

    options = (
        *([click.argument("port", metavar="PORT|LINE.toml" if or_file else "PORT")] if port else []),
        protocol_option(required=not or_file),
        click.option("--baud", type=Whole(min=1), metavar="N", help="Baud rate; the protocol's by default."),
        click.option("--echo", is_flag=True, help="The adapter receives its own transmissions (two-wire)."),
        click.option(
            "--timeout",
            type=option_type(parse_window),
            metavar="MS",
            help="The reply window, in milliseconds; or `learned`, from the replies.",
        ),
        click.option("--retries", type=Whole(min=0), metavar="N", help="How many times a failed read is repeated."),
        capture_option,
    )
    for option in reversed(options):  # the help lists the option first that was added last
        gathered = option(gathered)
    return gathered  # type: ignore[return-value]  # the decorated function takes more than the one it wraps


def none_but_the_files(path: str) -> str:
    """Return "", the protocol of a whole file. Raises UsageError for an option that the file stands for."""
    context = click.get_current_context()
    for parameter in context.command.get_params(context):
        name = parameter.name or ""
        is_set = context.get_parameter_source(name) is ParameterSource.COMMANDLINE
        if is_set and isinstance(parameter, click.Option) and name not in NOT_THE_FILES:
            raise click.UsageError(f"{path} already defines the line; leave out {parameter.opts[0]}")
    return ""


def viewed(command: F) -> F:
    """Give a command the options of a view, as one `View` named `view`."""

    @functools.wraps(command)
    def gathered(seconds: float | None, as_json: bool, plain: bool, read_only: bool, **options: Any) -> Any:
        return command(view=View(seconds, as_json, plain, read_only), **options)

    read_only = click.option("--read-only", is_flag=True, help="Reject writes from keys, MQTT commands and programs.")
    for option in (read_only, plain_option, json_option, seconds_option):
        gathered = option(gathered)
    return gathered  # type: ignore[return-value]  # likewise


node_option = click.option("--node", type=Whole(0), metavar="N", help="The node's address.")
nodes_option = click.option(
    "--nodes", type=option_type(parse_nodes), metavar="N-M,K", help="Node addresses, like 1-8,255."
)
json_option = click.option("--json", "as_json", is_flag=True, help="One JSON object a line.")
plain_option = click.option("--plain", is_flag=True, help="Plain lines on a terminal too.")
seconds_option = click.option(
    "--seconds", type=option_type(parse_seconds), metavar="S", help="End after this many seconds."
)
