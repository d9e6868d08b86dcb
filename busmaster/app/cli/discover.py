"""`busmaster discover`: which rate, framing, protocol and nodes an unknown cable has."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from busmaster import LineSettings, Rfc2217Port, SerialPort, TcpPort, endpoint
from busmaster.app.cli.arguments import nodes_option
from busmaster.app.cli.capturing import capture_option, capturing
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.output import emit_all, note
from busmaster.app.cli.parsing import parsed
from busmaster.app.diagnostics.diagnosis import speed
from busmaster.app.diagnostics.probing import opened
from busmaster.app.diagnostics.search import Discovery, Search
from busmaster.app.diagnostics.steps import LISTENING, Step, ranges, seconds, steps, untuned_steps, usual_kinds
from busmaster.app.diagnostics.writing import lasting, line_text, summary
from busmaster.errors import InvalidCommand
from busmaster.ext import Tap, is_served, open_file
from busmaster.registry import NodeKind, find, kinds

FAILED = 1
USUAL = LineSettings(9600)
"""What a port is opened with until something is tried."""


@dataclass(frozen=True, slots=True)
class Errand:
    """What is to be done: on which port, and what is tried."""

    port: SerialPort | TcpPort
    tried: Sequence[Step]


@click.command(short_help="Find out what is on an unknown cable.")
@click.argument("port")
@click.option("--yes", is_flag=True, help="Send without asking first.")
@click.option("-o", "--output", metavar="LINE.toml", help="Write what was found there; to standard output by default.")
@click.option(
    "--protocol",
    "names",
    multiple=True,
    type=click.Choice(list(kinds())),
    metavar="P",
    help="Try this protocol alone (or these: may be given again); all by default.",
)
@nodes_option
@capture_option
def command(
    port: str, yes: bool, output: str | None, names: tuple[str, ...], nodes: tuple[int, ...] | None, capture: str | None
) -> int:
    """Find out at which rate, in which framing and which protocols the nodes on PORT speak; write a LINE.toml for them.

    It says what it will try and how long that takes, and asks before it does. It listens first, and sends nothing where
    somebody else talks. Nothing but reads is sent. Nodes 1 to 8 are asked unless --nodes names others. If one answers,
    all other addresses of its protocol are asked too, and what was not asked is printed. A baud rate in PORT
    (`?baudrate=9600`) is the only one that is tried, and with a framing (`&bytesize=7&parity=E`) that too.
    """
    errand = Errand(*parsed(lambda text: what_to_try(text, names, nodes), port))
    if output is not None and Path(output).exists():
        raise click.UsageError(f"{output} is there already, and not overwritten: choose another name")
    tell_plan(errand)
    if not yes and not sys.stdin.isatty():
        raise click.UsageError("nobody can be asked here, so nothing was sent: say --yes")
    if not yes and not click.confirm("Send these reads, if nobody else talks there?", err=True):
        note("nothing was sent")
        return FAILED
    with capturing(capture, port=errand.port.name, protocol="", echo=errand.port.echo) as recorder:
        discovery = until_ended(discover, errand, recorder)
    if discovery is None:
        return FAILED
    text = line_text(lasting(errand.port), discovery)
    note(f"found {summary(discovery)}")
    if output is None:
        emit_all(text.splitlines())
    else:
        with open(open_file(output, os.O_WRONLY | os.O_EXCL), "w", encoding="utf-8") as file:
            file.write(text)
        note(f"written to {output}: `busmaster run {output}` polls it")
    return 0


def what_to_try(
    port: str, names: Sequence[str], nodes: Sequence[int] | None
) -> tuple[SerialPort | TcpPort, Sequence[Step]]:
    """Return the port, and what is tried there. Raises InvalidCommand."""
    if is_served(port):
        raise InvalidCommand(f"{port} is a line that a program owns and knows: discover needs the port itself")
    wanted: Sequence[NodeKind] = list(dict.fromkeys(find(name) for name in names)) or usual_kinds()
    where = endpoint(port, defaults=USUAL)
    if isinstance(where, TcpPort) and not isinstance(where, Rfc2217Port):
        return where, untuned_steps(wanted, nodes)
    options = port.partition("?")[2]
    framing = any(f"{key}=" in options for key in ("bytesize", "parity", "stopbits"))
    allowed = (where.settings if framing else where.baudrate) if "baudrate=" in options else None
    return where, steps(wanted, nodes, allowed)


def tell_plan(errand: Errand) -> None:
    """Say what will be tried, and for how long."""
    tried = errand.tried
    settings = list(dict.fromkeys(step.settings for step in tried))
    titles = dict.fromkeys(step.kind.profile.title for step in tried)
    requests = sum(len(step.addresses) for step in tried)
    match settings:
        case [None]:
            at = "at the server's own rate"
        case [LineSettings() as only]:
            at = f"at {speed(only)}"
        case _:
            at = f"at {len(settings)} settings of the line"
    reads = "1 read" if requests == 1 else f"{requests} reads"
    note(f"{errand.port.name}: listen for {LISTENING:g} s; then {reads}, {at}, in {', '.join(titles)}")
    note(f"that takes {seconds(tried):.0f} s at most where nobody answers; nothing is written to any node")
    if any(step.rest for step in tried):
        note("if a node answers, the other addresses of its protocol are asked too")


async def discover(errand: Errand, tap: Tap | None) -> Discovery | None:
    """Listen, and look. Returns None where nothing was found or nothing was sent, having said why."""
    from busmaster.app.cli.progress import Bar  # it takes a fifth of the time of --help

    async with opened(errand.port, tap) as wire, EnterStops() as stop:
        search = Search(wire, errand.port, note, Bar, stop.offered)
        if talk := await search.listen(errand.tried):
            note(f"{talk}; nothing was sent. `busmaster monitor` shows it; end the other master to look for nodes")
            return None
        discovery = await search.look(errand.tried)
    if not discovery.found:
        note("nobody answered: check power, wires A and B (swap them), termination; name nodes beyond 1-8 with --nodes")
    for name, addresses in discovery.not_asked.items():
        note(f"not asked: {name} {ranges(addresses)}")
    return discovery if discovery.found else None


class EnterStops:
    """Lets the user stop a search with the Enter key, if standard input is a terminal."""

    def __init__(self) -> None:
        self._pressed = False
        self._watched: int | None = None

    async def __aenter__(self) -> EnterStops:
        return self

    async def __aexit__(self, *error: object) -> None:
        if self._watched is not None:
            asyncio.get_running_loop().remove_reader(self._watched)

    def offered(self) -> Callable[[], bool]:
        """Tell the user how to stop, where that is possible, and return what says whether the user has."""
        if sys.stdin.isatty() and self._watched is None:
            try:
                asyncio.get_running_loop().add_reader(sys.stdin.fileno(), self._press)
            except NotImplementedError:  # Windows: its event loop does not watch a console
                return lambda: False
            self._watched = sys.stdin.fileno()
            note("press Enter to stop and keep what was found")
        return lambda: self._pressed

    def _press(self) -> None:
        os.read(sys.stdin.fileno(), 1024)  # else the shell would get the line
        self._pressed = True
