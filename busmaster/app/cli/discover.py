"""`busmaster discover`: which rate, framing, protocol and nodes an unknown cable has."""

from __future__ import annotations

import asyncio
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import click

from busmaster import InvalidCommand, LineSettings, Rfc2217Port, SerialPort, TcpPort, endpoint
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
from busmaster.ext import NodeKind, Tap, find, is_served, kinds, open_file

FAILED = 1
USUAL = LineSettings(9600)
"""What a port is opened with until something is tried."""


@dataclass(frozen=True, slots=True)
class Job:
    """The port of a search and the steps to try."""

    port: SerialPort | TcpPort
    tried: Sequence[Step]


@click.command()
@click.argument("port")
@click.option("--yes", is_flag=True, help="Send without a question.")
@click.option(
    "-o", "--output", metavar="LINE.toml", help="Write the result to this file; by default to standard output."
)
@click.option(
    "--protocol",
    "names",
    multiple=True,
    type=click.Choice(list(kinds())),
    metavar="P",
    help="Try only this protocol. Repeatable. All by default.",
)
@nodes_option
@capture_option
def command(
    port: str, yes: bool, output: str | None, names: tuple[str, ...], nodes: tuple[int, ...] | None, capture: str | None
) -> int:
    """Find the baud rate, framing and protocols of the nodes on PORT, and write a LINE.toml for them.

    The command prints its steps and their duration, and requests a confirmation. It listens first, and sends nothing if
    another master is active. It sends only reads. Nodes 1 to 8 are tried unless --nodes names others. If one replies,
    all other addresses of its protocol are tried too, and the addresses that were not tried are printed. A baud rate in
    PORT (`?baudrate=9600`) is the only one that is tried, and so is a framing with it (`&bytesize=7&parity=E`).
    """
    job = Job(*parsed(lambda text: what_to_try(text, names, nodes), port))
    if output is not None and Path(output).exists():
        raise click.UsageError(f"{output} exists and is not overwritten; choose another name")
    print_plan(job)
    if not yes and not sys.stdin.isatty():
        raise click.UsageError(
            "confirmation required, but there is no terminal; nothing was sent; use --yes to skip the question"
        )
    if not yes and not click.confirm("Send these reads, if no other master is active?", err=True):
        note("nothing was sent")
        return FAILED
    with capturing(capture, port=job.port.name, protocol="", echo=job.port.echo) as recorder:
        discovery = until_ended(discover, job, recorder)
    if discovery is None:
        return FAILED
    text = line_text(lasting(job.port), discovery)
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
    """Return the port and the steps to try there. Raises InvalidCommand."""
    if is_served(port):
        raise InvalidCommand(f"{port} is the line of another program; stop it, discover needs the port itself")
    wanted: Sequence[NodeKind] = list(dict.fromkeys(find(name) for name in names)) or usual_kinds()
    where = endpoint(port, defaults=USUAL)
    if isinstance(where, TcpPort) and not isinstance(where, Rfc2217Port):
        return where, untuned_steps(wanted, nodes)
    options = port.partition("?")[2]
    framing = any(f"{key}=" in options for key in ("bytesize", "parity", "stopbits"))
    allowed = (where.settings if framing else where.baudrate) if "baudrate=" in options else None
    return where, steps(wanted, nodes, allowed)


def print_plan(job: Job) -> None:
    """Print the steps and their duration."""
    tried = job.tried
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
    note(f"{job.port.name}: listen for {LISTENING:g} s; then {reads}, {at}, in {', '.join(titles)}")
    note(f"at most {seconds(tried):.0f} s if no node replies; nothing is written to any node")
    if any(step.rest for step in tried):
        note("if a node replies, the other addresses of its protocol are tried too")


async def discover(job: Job, tap: Tap | None) -> Discovery | None:
    """Listen, then search. Returns None, after a message, if nothing was sent or found."""
    from busmaster.app.cli.progress import Bar  # it takes a fifth of the time of --help

    async with opened(job.port, tap) as wire, EnterStops() as stop:
        search = Search(wire, job.port, note, Bar, stop.offered)
        if talk := await search.listen(job.tried):
            note(f"{talk}; nothing was sent. `busmaster monitor` shows it; stop the other master to look for nodes")
            return None
        discovery = await search.look(job.tried)
    if not discovery.found:
        note("no node replied; check power, wires A and B (swap them), termination; name nodes beyond 1-8 with --nodes")
    for name, addresses in discovery.not_asked.items():
        note(f"not tried: {name} {ranges(addresses)}")
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
        """Print how to stop, if that is possible, and return a function that returns whether the user did."""
        if sys.stdin.isatty() and self._watched is None:
            try:
                asyncio.get_running_loop().add_reader(sys.stdin.fileno(), self._press)
            except NotImplementedError:  # Windows: its event loop does not watch a console
                return lambda: False
            self._watched = sys.stdin.fileno()
            note("press Enter to stop and keep the nodes found so far")
        return lambda: self._pressed

    def _press(self) -> None:
        os.read(sys.stdin.fileno(), 1024)  # else the shell would get the line
        self._pressed = True
