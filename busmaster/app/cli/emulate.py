"""`busmaster emulate`: drives that are not there, on a pseudo-terminal or a TCP port."""

from __future__ import annotations

import os
import random
import time
from collections.abc import Sequence
from functools import partial
from math import inf

import click

from busmaster import LineDown, Rfc2217Port, SerialPort, TcpPort
from busmaster.app.cli.arguments import line_settings, nodes_option, seconds_option, single_nodes
from busmaster.app.cli.lines import file_argument, load
from busmaster.app.cli.output import Level, emit, note
from busmaster.app.cli.parsing import Whole, option_type, parsed
from busmaster.app.cli.protocols import protocol_option
from busmaster.app.config import LineFile, emulated_line
from busmaster.app.line import ConfiguredLine
from busmaster.emulator import NAMES, Delay, Faults, Line, LineServer, serve_pty, serve_tcp
from busmaster.ext import USB, Profile, find, host_and_port, make_device

LOOK_FOR_SIGNALS = 0.2
"""Seconds from one look to the next."""


@click.command()
@file_argument(required=False)
@protocol_option(required=False, text="Protocol without a file. One of {}.")
@nodes_option
@click.option(
    "--pty",
    is_flag=False,
    flag_value="",
    metavar="[LINK]",
    help="Use a pseudo-terminal (the default), and make this link to it.",
)
@click.option(
    "--tcp", type=option_type(host_and_port), metavar="HOST:PORT", help="Use a TCP port; 0 selects a free one."
)
@click.option("--baud", type=Whole(min=1), metavar="N", help="Baud rate; the protocol's by default.")
@click.option("--paced", is_flag=True, help="Simulate the transmission time of each byte.")
@click.option(
    "--reply-delay",
    type=option_type(Delay.parse),
    metavar="MS[-MS]",
    help="Reply delay, in milliseconds; 2 by default.",
)
@click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="NAME=VALUE",
    help=f"Fault of every drive, like lost=0.1. Repeatable. One of {' '.join(NAMES)}.",
)
@click.option("--seed", type=int, metavar="N", help="Seed of all random numbers; the file's, or 1, by default.")
@seconds_option
def command(
    path: str | None,
    protocol: str | None,
    nodes: tuple[int, ...] | None,
    pty: str | None,
    tcp: tuple[str, int] | None,
    baud: int | None,
    paced: bool,
    reply_delay: Delay | None,
    faults: tuple[str, ...],
    seed: int | None,
    seconds: float | None,
) -> None:
    """Emulate the drives of a line until Ctrl-C. The first line printed is the PORT to use.

    With LINE.toml, all its nodes are emulated at its port, as its [emulator] defines. The port is a TCP port of this
    machine, or a link to a pseudo-terminal, which is never created in /dev. Without a file, the line has node 1 only,
    unless --nodes names others.
    """
    if pty is not None and tcp is not None:
        raise click.UsageError("--pty and --tcp exclude each other; leave out one of them")
    if path is not None:
        if protocol is not None or nodes is not None or baud is not None:
            raise click.UsageError("the file defines protocol, nodes and baud rate; leave out the options for these")
        file = load(path)
        if pty is None and tcp is None:
            pty, tcp = own_port(file.port)
        line = line_of(file, reply_delay, faults, seed, paced)
    else:
        line = drives(protocol, nodes, baud, reply_delay, faults, seed, paced)
    with serve(line, pty, tcp) as server:
        emit(server.path)
        serve_for(seconds)


def serve_for(seconds: float | None) -> None:
    """Wait this many seconds, or forever, while the line's own thread serves it.

    A signal that the system delivers to that thread does not wake this one, so it is checked periodically.
    """
    end = inf if seconds is None else time.monotonic() + seconds
    while (left := end - time.monotonic()) > 0:
        time.sleep(min(left, LOOK_FOR_SIGNALS))


def line_of(file: LineFile, delay: Delay | None, faults: tuple[str, ...], seed: int | None, paced: bool) -> Line:
    """Return the file's line. Options of the command line override the file."""
    ConfiguredLine(file, outputs=False)  # reports faults of the file as everywhere
    line = emulated_line(file, paced=paced or None, seed=seed)
    for device in line.devices:
        device.delay = delay or device.delay
        device.faults = parsed(Faults.parse, faults) if faults else device.faults
    return line


def own_port(port: SerialPort | TcpPort) -> tuple[str | None, tuple[str, int] | None]:
    """Return the link, or the address, by which `busmaster run` with the same file will find the line.

    Raises UsageError for a port of RFC 2217.
    """
    if isinstance(port, Rfc2217Port):
        raise click.UsageError(f"{port.name}: an emulated line does not support RFC 2217; use --tcp or --pty")
    if isinstance(port, TcpPort):
        return None, (port.host, port.port)
    is_device = port.path.startswith(USB) or os.path.abspath(port.path).startswith("/dev/")
    return None if is_device else port.path, None


def drives(
    protocol: str | None,
    nodes: tuple[int, ...] | None,
    baud: int | None,
    delay: Delay | None,
    faults: tuple[str, ...],
    seed: int | None,
    paced: bool,
) -> Line:
    """Make the line that the options define, without a file. Raises UsageError."""
    if protocol is None:
        raise click.UsageError("no drives to emulate; name a LINE.toml, or use --protocol P")
    profile = find(protocol).profile
    devices = [make_device(protocol, address, delay=delay) for address in nodes_to_emulate(profile, nodes)]
    wrong = parsed(Faults.parse, faults)
    for device in devices:
        device.faults = wrong
    chance = random.Random(1 if seed is None else seed)
    return Line(line_settings(profile, baud), devices, chance=chance, paced=paced)


def nodes_to_emulate(profile: Profile, nodes: Sequence[int] | None) -> Sequence[int]:
    """Return the addresses to emulate: those of --nodes, else 1, or the one drive. Raises UsageError."""
    if nodes is not None:
        return single_nodes(profile, nodes)
    return (1,) if 1 in profile.addresses else profile.addresses[:1]


def serve(line: Line, link: str | None, address: tuple[str, int] | None) -> LineServer:
    """Serve the line on TCP if there is an address, else on a pty. Raises LineDown for what cannot be had."""
    try:
        return (
            serve_tcp(line, *address) if address else serve_pty(line, link or None, partial(note, level=Level.WARNING))
        )
    except OSError as error:
        where = f"{address[0]}:{address[1]}" if address else link or "a pseudo-terminal"
        hint = "use another port, or 0 for a free one" if address else "name a link that does not exist yet"
        what = os.strerror(error.errno) if error.errno else str(error)
        raise LineDown(f"cannot serve on {where}: {what}", hint=hint) from error
