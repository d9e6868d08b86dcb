"""`busmaster modbus-tcp`: Modbus TCP over a line that another program owns."""

from __future__ import annotations

import ipaddress
from importlib.util import find_spec

import click

from busmaster.app.cli.app import OK
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.interfaces import following, interface_options, place_of
from busmaster.app.cli.output import Level, note
from busmaster.app.interfaces.modbus_tcp import FORMATS, IDLE, Rules, Values, map_text, read_map, serve
from busmaster.app.service.tcp import is_loopback

BIND = "127.0.0.1:1502"
EXAMPLE = "Example: busmaster modbus-tcp --allow 'drive*/speed_reference'"


@click.command(short_help="Serve a line that another program owns by Modbus TCP.", epilog=EXAMPLE)
@interface_options(BIND)
@click.option("--map", "map_file", metavar="FILE", help="The points and their registers; without it, all points.")
@click.option("--print-map", "prints", is_flag=True, help="Print the map as CSV, and end.")
@click.option(
    "--type",
    "type_",
    type=click.Choice(list(FORMATS)),
    metavar="TYPE",
    help="Of all registers without --map, like float32; float64 by default.",
)
@click.option("--last", is_flag=True, help="Without --map: send old values too, each before a status register.")
@click.option(
    "--allow",
    multiple=True,
    metavar="POINT",
    help="Clients may write it, like winder/force or 'drive*/speed'. Again for more.",
)
@click.option("--pass-through", is_flag=True, help="Forward requests to the line's Modbus RTU units, by their ids.")
@click.option(
    "--allow-unit",
    multiple=True,
    type=click.IntRange(1, 247),
    metavar="ID",
    help="With --pass-through, clients may write to this unit. Again for more.",
)
@click.option(
    "--allow-from",
    multiple=True,
    metavar="ADDRESS",
    help="Only clients of this address, or network like 10.0.0.0/24, write. Again for more.",
)
@click.option(
    "--idle",
    type=click.FloatRange(1, 86400),
    default=IDLE,
    show_default=True,
    metavar="SECONDS",
    help="Without a request for so long, a connection is closed.",
)
def command(
    line: str | None,
    bind: str,
    read_only: bool,
    map_file: str | None,
    prints: bool,
    type_: str | None,
    last: bool,
    allow: tuple[str, ...],
    pass_through: bool,
    allow_unit: tuple[int, ...],
    allow_from: tuple[str, ...],
    idle: float,
) -> int:
    """Serve a line to Modbus TCP clients: its points as registers, and with --pass-through its Modbus RTU units.

    LINE is the name that `busmaster status` lists, its LINE.toml or its port; without it, the one line that runs. A
    value that is not current is replied to by exception 11. Clients write the points that --allow names, through the
    owner's authorisation; the reply is sent when the owner has confirmed the write. Modbus TCP has no login: beyond
    this machine (--bind 0.0.0.0:502) --allow needs --allow-from. docs/modbus-tcp.md has the map file.
    """
    if any(find_spec(module) is None for module in ("msgspec", "websockets")):
        raise click.UsageError("support for Modbus TCP is not installed; pip install 'busmaster[modbus-tcp]'")
    listen = place_of(bind)
    if read_only and (allow or allow_unit):
        raise click.UsageError("--allow and --read-only exclude each other; leave out one of them")
    if allow_unit and not pass_through:
        raise click.UsageError("--allow-unit needs --pass-through")
    if map_file is not None and (type_ or last):
        raise click.UsageError("--type and --last are for the automatic map; define both in the file of --map")
    if (allow or allow_unit) and not allow_from and not is_loopback(listen[0]):
        raise click.UsageError(f"--allow at {bind}, which the whole network can reach, needs --allow-from")
    if allow_from and not (allow or allow_unit):
        raise click.UsageError("--allow-from needs points that may be written; add --allow")
    try:
        peers = tuple(ipaddress.ip_network(one) for one in allow_from)
    except ValueError as error:
        raise click.UsageError(f"--allow-from: {error}") from None
    fixed = None if map_file is None else read_map(map_file)
    rules = Rules(allow=allow, units=frozenset(allow_unit), peers=peers or None, pass_through=pass_through)
    followed = following(line, read_only=read_only)

    async def run() -> None:
        values = Values(
            followed, fixed, type_=type_ or "float64", last=last, warn=lambda text: note(text, Level.WARNING)
        )
        if prints:
            click.echo(await map_text(values, allow), nl=False)
        else:
            await serve(values, rules, listen, lambda at: note(f"serving Modbus TCP at {at}"), note, idle)

    until_ended(run)
    return OK
