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
NEEDED = ("msgspec", "starlette", "uvicorn", "websockets")


@click.command()
@interface_options(BIND)
@click.option("--token-file", metavar="FILE", help="Users who may write: a name and a token on each line.")
@click.option(
    "--host",
    "hosts",
    metavar="NAME",
    multiple=True,
    help="Host name, without a port, of a proxy in front of the page. A write then needs a token. Repeatable.",
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

    LINE is a name in `busmaster status`, a LINE.toml or a port. It is optional if only one line is running. The line
    does not depend on the page, and the page waits for a line that is not running. /openapi.json describes the REST
    API. If other machines can connect (--bind 0.0.0.0:8420), a write needs a token, and the traffic is not encrypted.
    Use a proxy with TLS, and name it with --host, or connect with ssh -L.
    """
    if any(find_spec(module) is None for module in NEEDED):
        raise click.UsageError("the web page is not installed; pip install 'busmaster[web]'")
    from busmaster.app.interfaces.web import serve
    from busmaster.app.outputs.history import HistoryFile

    listen, secrets = place_of(bind), {} if token_file is None else read_tokens(token_file)
    for host in hosts:
        if not HOST_NAME.fullmatch(host):
            raise click.UsageError(f"--host: {host!r} is not a host name; write it like plant.example")
    followed = following(line, read_only=read_only)
    if history is not None and not Path(history).exists():
        note(f"--history: there is no file {history} yet", Level.WARNING)
    past = None if history is None else HistoryFile(history)
    until_ended(serve, followed, listen, secrets, hosts, lambda url: note(f"the page is at {url}"), note, past)
    return OK
