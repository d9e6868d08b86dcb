"""`busmaster web`: a page for the operator and a REST API over a line that another program owns."""

from __future__ import annotations

import re
from importlib.util import find_spec
from pathlib import Path

import click

from busmaster.app.cli.app import OK
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.interfaces import following, interface_options, place_of
from busmaster.app.cli.output import Level, note
from busmaster.app.config.service import read_tokens

BIND = "127.0.0.1:8420"
HOST_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?(\.[A-Za-z0-9]([A-Za-z0-9-]*[A-Za-z0-9])?)*")
NEEDED = ("starlette", "uvicorn", "websockets")


@click.command(short_help="Serve a page and a REST API over a line that another program owns.")
@interface_options(BIND)
@click.option("--token-file", metavar="FILE", help="Who may write: a name and its token on each line.")
@click.option(
    "--host",
    "hosts",
    metavar="NAME",
    multiple=True,
    help="A name under which a proxy passes requests on, without a port. A write then needs a token. Repeatable.",
)
@click.option(
    "--history",
    metavar="FILE",
    help="The database of the line's output sqlite: for /api/history, and the plots of the page.",
)
def command(
    line: str | None,
    bind: str,
    read_only: bool,
    token_file: str | None,
    hosts: tuple[str, ...],
    history: str | None,
) -> int:
    """Show a line in browsers: values with trends, health, every exchange on the wire, events; and write its points.

    LINE is the name that `busmaster status` lists, its LINE.toml or its port; without it, the one line that runs. The
    line goes on whatever becomes of the page, and the page waits for a line whose owner is away. /openapi.json says
    what programs may ask. Beyond this machine (--bind 0.0.0.0:8420) nobody writes without a token, and what is said
    can be read on the way: put a proxy with TLS before it, whose name is said with --host, or come by ssh -L.
    """
    if any(find_spec(module) is None for module in NEEDED):
        raise click.UsageError("the page needs an extra: pip install 'busmaster[web]'")
    from busmaster.app.interfaces.web import serve
    from busmaster.app.outputs.history import HistoryFile

    listen, secrets = place_of(bind), {} if token_file is None else read_tokens(token_file)
    for host in hosts:
        if not HOST_NAME.fullmatch(host):
            raise click.UsageError(f"--host: {host!r} is not the name of a host, like plant.example")
    followed = following(line, read_only=read_only)
    if history is not None and not Path(history).exists():
        note(f"--history: there is no file {history} yet", Level.WARNING)
    past = None if history is None else HistoryFile(history)
    until_ended(serve, followed, listen, secrets, hosts, lambda url: note(f"the page is at {url}"), note, past)
    return OK
