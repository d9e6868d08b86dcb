"""Reaching the line of a PORT: its port, or the program that owns it.

A PORT that another busmaster owns is reached through that, and so are `unix:PATH` and `tcp://HOST:PORT`, which name it.
"""

from __future__ import annotations

import os
from collections.abc import Hashable, Mapping
from typing import Any
from urllib.parse import parse_qs

import click

from busmaster import Bus, BusError, Endpoint, InvalidCommand, LineDown, TcpPort
from busmaster.app.cli.arguments import Connection
from busmaster.app.cli.output import note
from busmaster.app.service.folder import Owner, addresses_of, owners
from busmaster.app.service.remote import RemoteBus
from busmaster.ext import is_served, resolve

TOKEN = "BUSMASTER_TOKEN"
"""Names the environment variable with the token for tcp://HOST:PORT: on the command line every user would see it."""
FRAMING = ("bytesize", "parity", "stopbits")
RECORD_THERE = "is the line of another program; leave out --capture, and record it there"


class ReachedLine(RemoteBus):
    """A line that another program owns, for a command whose options are to be those of the line.

    Entering it raises UsageError, naming both, for options that differ.
    """

    def __init__(self, address: str, connection: Connection) -> None:
        super().__init__(address, token=token_for(address))
        self._connection = connection

    async def __aenter__(self) -> ReachedLine:
        await super().__aenter__()
        try:
            check_settings(self._connection, self.about)
        except BaseException:
            await self.__aexit__(None, None, None)
            raise
        return self


def reach(connection: Connection) -> Bus | RemoteBus:
    """Return the bus on PORT or, if another program owns that line, the bus that it serves.

    The latter is reported on standard error unless PORT names that program. Raises UsageError for a capture of such a
    line.
    """
    address = connection.port
    if is_served(address):
        if connection.capture is not None:
            raise click.UsageError(f"{address} {RECORD_THERE}")
        return ReachedLine(address, connection)
    owner = owner_to_use(connection.endpoint(), connection.capture)
    return connection.open_bus() if owner is None else ReachedLine(owner.address, connection)


def owner_to_use(endpoint: Endpoint, capture: str | None) -> Owner | None:
    """Return the program that owns a port, reported on standard error; None if none does.

    Raises UsageError for a capture of the line of another program.
    """
    owner = owner_of(endpoint)
    if owner is not None:
        if capture is not None:
            raise click.UsageError(f"{owner.port} {RECORD_THERE}")
        print_owner(owner)
    return owner


def print_owner(owner: Owner) -> None:
    """Report on standard error which process owns the line."""
    note(f"{owner.port} is owned by process {owner.pid}; using it through {owner.address}")


def check_no_owner(endpoint: Endpoint) -> None:
    """Raise LineDown where another program owns the line of a port: a serial server would let in two masters."""
    owner = owner_of(endpoint)
    if owner is not None:
        hint = "stop that process first: two masters on one line garble each other's frames"
        raise LineDown(f"{owner.port} is owned by process {owner.pid}", hint=hint)


def owner_of(endpoint: Endpoint) -> Owner | None:
    """Return the program of this user that owns a port, whatever that is called there and here; None if none does."""
    wanted = device_of(endpoint.name, by_tcp=isinstance(endpoint, TcpPort))
    for owner in owners():
        if wanted & device_of(owner.port, by_tcp=isinstance(endpoint, TcpPort)):
            return owner
    return None


def device_of(name: str, *, by_tcp: bool) -> set[Hashable]:
    """Return what a port's name leads to: a device, or the addresses of a host with the port."""
    try:
        if by_tcp:
            return addresses_of(name)
        return {os.path.realpath(resolve(name))}
    except (InvalidCommand, BusError, OSError):  # it is not there now, or a name of the other kind
        return {name}


def check_settings(connection: Connection, about: Mapping[str, Any]) -> None:
    """Raise UsageError for given line settings that differ from the owner's."""
    wanted = None if is_served(connection.port) else connection.endpoint().settings
    in_url = set(parse_qs(connection.port.partition("?")[2]))
    baud = wanted.baudrate if wanted is not None and "baudrate" in in_url else connection.baud
    framing = wanted.framing if wanted is not None and not in_url.isdisjoint(FRAMING) else None
    differs = [
        *([f"{baud} baud"] if about["baudrate"] and baud not in (None, about["baudrate"]) else []),
        *([framing] if about["framing"] and framing not in (None, about["framing"]) else []),
        *(["with an echo"] if connection.echo and not about["echo"] else []),
    ]
    if differs:
        has = f"{about['baudrate']} {about['framing']}" + (" with an echo" if about["echo"] else "")
        raise click.UsageError(
            f"process {about['process']} owns {about['line']} with {has}, not {', '.join(differs)}; "
            "leave out these settings"
        )


def token_for(address: str) -> str | None:
    """Return the token that the environment has for an address; None where none is needed, or there is none."""
    return (os.environ.get(TOKEN) or None) if address.startswith("tcp://") else None
