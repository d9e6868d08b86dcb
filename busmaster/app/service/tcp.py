"""Connections by TCP: listening sockets, and tokens."""

from __future__ import annotations

import errno
import ipaddress
import os
import socket
from collections.abc import Sequence

from busmaster import InvalidCommand
from busmaster.app.service.peers import Holder, holder_of
from busmaster.app.service.permission import Access

HostPort = tuple[str, int]
BACKLOG = 64


def is_loopback(host: str) -> bool:
    """Return whether a host is this machine alone, as it is written."""
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def check_listening(listen: HostPort, *, tokens: bool) -> None:
    """Raise InvalidCommand if any machine of the network could connect without a token."""
    if not (tokens or is_loopback(listen[0])):
        raise InvalidCommand(
            f"{listen[0]} is reachable from the network; give each program a token in the token_file, "
            "or listen on 127.0.0.1"
        )


def address_text(host: str, port: int) -> str:
    """Return an address as HOST:PORT, with an IPv6 address in brackets."""
    return f"[{host}]:{port}" if ":" in host else f"{host}:{port}"


def listening_error(host: str, port: int, error: OSError) -> str:
    """Return why nothing can listen there."""
    if error.errno == errno.EADDRINUSE:
        return f"{address_text(host, port)} is in use by another program; end that one, or use another port"
    # the text of create_server repeats the address
    what = os.strerror(error.errno) if error.errno and not isinstance(error, socket.gaierror) else error.strerror
    return f"cannot listen on {address_text(host, port)}: {what or error}"


def listening(listen: HostPort) -> socket.socket:
    """Open a socket that listens there; port 0 is any free one. A name may take its time. Raises InvalidCommand."""
    host, port = listen
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        opened = socket.create_server(address, family=family, backlog=BACKLOG)
    except OSError as error:
        raise InvalidCommand(listening_error(host, port, error)) from None
    opened.setblocking(False)
    return opened


def is_our_name(host: str, listen: HostPort) -> bool:
    """Return whether a Host header names us: by an address, or as we listen. A page would have another name."""
    name = host.rpartition("]")[0].lstrip("[") if host.startswith("[") else host.partition(":")[0]
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name.lower() in (listen[0].lower(), socket.gethostname().lower())  # a browser sends small letters
    return True


def holder(connected: socket.socket, shown: Sequence[str], access: Access) -> Holder | None:
    """Return the client that has connected, by its Authorization headers; None if a known token is required and they do
    not contain one. If there are no tokens, none is required."""
    if not shown and not access.secrets:
        return holder_of(connected, "", None)
    if len(shown) != 1:
        return None
    kind, _, secret = shown[0].partition(" ")
    name = access.token_name(secret.strip()) if kind.lower() == "bearer" else None
    return None if name is None else holder_of(connected, name, access.secrets[name])
