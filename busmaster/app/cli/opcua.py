"""`busmaster opcua`: a line that another program owns, as an OPC UA server."""

from __future__ import annotations

from importlib.util import find_spec

import click

from busmaster.app.cli.app import OK
from busmaster.app.cli.ending import until_ended
from busmaster.app.cli.interfaces import following, interface_options, place_of
from busmaster.app.cli.output import note
from busmaster.app.config.service import read_tokens
from busmaster.app.service.tcp import is_loopback

BIND = "127.0.0.1:4840"
FILE = click.Path(exists=True, dir_okay=False)
FOLDER = click.Path(exists=True, file_okay=False)


@click.command()
@interface_options(BIND)
@click.option(
    "--allow",
    multiple=True,
    metavar="POINT",
    help="Points that clients may write, like winder/force or 'drive*/speed'. Repeatable.",
)
@click.option("--token-file", metavar="FILE", help="Users who may write: a name and a token on each line.")
@click.option(
    "--certificate", type=FILE, metavar="FILE", help="The server's certificate. Messages are then signed or encrypted."
)
@click.option("--key", type=FILE, metavar="FILE", help="The private key of the certificate.")
@click.option("--trusted", type=FOLDER, metavar="FOLDER", help="Certificates of the permitted clients.")
def command(
    line: str | None,
    bind: str,
    read_only: bool,
    allow: tuple[str, ...],
    token_file: str | None,
    certificate: str | None,
    key: str | None,
    trusted: str | None,
) -> int:
    """Show a line to OPC UA clients: nodes as objects, points as variables with unit, range, status and time.

    LINE is the name that `busmaster status` lists, its LINE.toml or its port; without it, the one line that runs. The
    line goes on whatever becomes of the server, and the server waits for a line whose owner is away. Clients write the
    points that --allow names, through the owner's authorisation. Beyond this machine (--bind 0.0.0.0:4840) they need a
    token for that: it is the password of the user of its name.
    """
    if any(find_spec(module) is None for module in ("asyncua", "msgspec", "websockets")):
        raise click.UsageError("OPC UA support is not installed; pip install 'busmaster[opcua]'")
    listen = place_of(bind)
    is_local = is_loopback(listen[0])
    if read_only and allow:
        raise click.UsageError("--allow and --read-only exclude each other; leave out one of them")
    if allow and not is_local and token_file is None:
        raise click.UsageError(f"--allow at {bind}, which the whole network can reach, needs --token-file")
    if (certificate is None) != (key is None):
        raise click.UsageError("--certificate and --key need each other; give both")
    if trusted is not None and certificate is None:
        raise click.UsageError("--trusted needs --certificate: without it, clients do not send theirs")
    secrets = {} if token_file is None else read_tokens(token_file)
    followed = following(line, read_only=read_only)
    from busmaster.app.interfaces.opcua import read_trusted, serve
    from busmaster.app.interfaces.opcua_access import Rules

    known = None if trusted is None else read_trusted(trusted)
    rules = Rules(allow=allow, secrets=secrets, trusted=known, is_signed=certificate is not None, is_local=is_local)
    pair = None if certificate is None or key is None else (certificate, key)

    def opened(url: str) -> None:
        note(f"serving OPC UA at {url}")

    until_ended(serve, followed, rules, listen, opened, note, pair)
    return OK
