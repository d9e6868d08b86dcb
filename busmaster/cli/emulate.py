"""`busmaster emulate`: drives that are not there, on a pseudo-terminal or a TCP port."""

from __future__ import annotations

import os
import random
import threading
from collections.abc import Iterable

import click

from busmaster.cli.arguments import (
    line_settings,
    nodes_option,
    option_type,
    parse_host_port,
    parsed,
    protocol_option,
    seconds_option,
    slaves_of,
)
from busmaster.cli.output import emit
from busmaster.emulator.build import make_device
from busmaster.emulator.device import Delay, Device
from busmaster.emulator.faults import Faults
from busmaster.emulator.line import Line
from busmaster.emulator.serve import LineServer, serve_pty, serve_tcp
from busmaster.errors import LineDown
from busmaster.handles import HANDLES
from busmaster.profile import LineSettings


@click.command(short_help="Emulate drives on a pseudo-terminal or a TCP port.")
@protocol_option
@nodes_option
@click.option(
    "--pty", is_flag=False, flag_value="", metavar="[LINK]", help="A pseudo-terminal (the default), and a link to it."
)
@click.option("--tcp", type=option_type(parse_host_port), metavar="HOST:PORT", help="A TCP port; 0 picks a free one.")
@click.option("--baud", type=click.IntRange(min=1), metavar="N", help="Baud rate; the protocol's by default.")
@click.option("--paced", is_flag=True, help="Bytes take their time on the wire.")
@click.option(
    "--reply-delay",
    type=option_type(Delay.parse),
    metavar="MS[-MS]",
    help="From a request to its reply, in milliseconds; 2 by default.",
)
@click.option(
    "--fault",
    "faults",
    multiple=True,
    metavar="NAME=VALUE",
    help="What goes wrong with every drive, like lost=0.1. Again for more.",
)
@click.option("--seed", type=int, default=1, metavar="N", help="Of all that is random; 1 by default.")
@seconds_option
def command(
    protocol: str,
    nodes: tuple[int, ...] | None,
    pty: str | None,
    tcp: tuple[str, int] | None,
    baud: int | None,
    paced: bool,
    reply_delay: Delay | None,
    faults: tuple[str, ...],
    seed: int,
    seconds: float | None,
) -> None:
    """Emulate the drives of a line until Ctrl-C. The first line printed is the PORT to use.

    Node 1 alone unless --nodes names others.
    """
    if pty is not None and tcp is not None:
        raise click.UsageError("either --pty or --tcp, not both")
    profile = HANDLES[protocol].profile
    devices = [make_device(protocol, address, delay=reply_delay) for address in slaves_of(profile, nodes)]
    line = make_line(line_settings(profile, baud), devices, parsed(Faults.parse, faults), seed, paced)
    with serve(line, pty, tcp) as server:
        emit(server.path)
        threading.Event().wait(seconds)


def make_line(settings: LineSettings, devices: Iterable[Device], faults: Faults, seed: int, paced: bool) -> Line:
    """The faults strike every device; they share one seeded source of chance."""
    line = Line(settings, devices, chance=random.Random(seed), paced=paced)
    for device in line.devices:
        device.faults = faults
    return line


def serve(line: Line, link: str | None, address: tuple[str, int] | None) -> LineServer:
    """On TCP if there is an address, else on a pty. Raises LineDown for what cannot be had."""
    try:
        return serve_tcp(line, *address) if address else serve_pty(line, link or None)
    except OSError as error:
        where = f"{address[0]}:{address[1]}" if address else link or "a pseudo-terminal"
        hint = "use another port, or 0 for a free one" if address else "name a link that is not there yet"
        what = os.strerror(error.errno) if error.errno else str(error)
        raise LineDown(f"cannot serve on {where}: {what}", hint=hint) from error
