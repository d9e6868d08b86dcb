"""The contract of an endpoint, and the URLs of endpoints."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Hashable, Mapping
from dataclasses import asdict
from typing import Any, Protocol
from urllib.parse import parse_qsl, urlsplit

from busmaster.contract.arguments import meant
from busmaster.contract.profile import LineSettings
from busmaster.errors import InvalidCommand
from busmaster.transport.identity import USB, Identity
from busmaster.transport.rs485 import LEVELS, SWITCHES, Rs485
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

HOST_PORT = re.compile(r"[\w.-]+:\d+")


class Endpoint(Protocol):
    """A way to reach a line: a frozen value that can be opened repeatedly."""

    @property
    def name(self) -> str:
        """Return its name in messages: the path, or "host:port"."""
        ...

    @property
    def settings(self) -> LineSettings | None:
        """Return the line settings, from which tau is calculated; None if unknown (a TCP port without `baudrate`)."""
        ...

    @property
    def echo(self) -> bool:
        """Return True if sent bytes are received too (two-wire adapters)."""
        ...

    @property
    def receive_latency(self) -> float:
        """Return the seconds for which an adapter or a server can hold received bytes."""
        ...

    @property
    def paced(self) -> bool | None:
        """Return True if bytes leave at the baud rate; None if not known before it is open (see `is_paced`)."""
        ...

    def presence(self) -> Hashable | None:
        """Return a value that changes when the device appears, without opening it. None if this cannot be observed.

        It is called several times per second on the loop while the line is down, and must return immediately. An
        endpoint may also have a method `folders()`, which returns the folders in which an entry appears, or its
        permissions change, when the device returns. Then the folders are watched, and `presence` is called after a
        change in them.

        An endpoint whose port sends later than it gets the bytes has a property `send_delay`, in seconds, which R9's
        bound includes.
        """
        ...

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> asyncio.Transport:
        """Open the port; `connection_made` has been called when this returns. Raises LineDown.

        `only`: the device to open, from the extra info "identity" of an earlier transport (None if devices cannot be
        distinguished). If another device has its name now, it is not opened. The transport must write immediately if
        nothing is buffered, and call `pause_writing` and `resume_writing` as soon as anything is. It calls
        `connection_lost` exactly once: with None only if it was closed locally (or in good order by a TCP peer), else
        with the cause.
        """
        ...


def is_paced(endpoint: Endpoint, transport: asyncio.BaseTransport) -> bool:
    """Return True if bytes leave `transport` at the baud rate, so that bytes that arrive too early cannot be a reply
    (R4)."""
    # None: a serial port can be a pty, which is known only when it is open.
    return bool(transport.get_extra_info("paced", False) if endpoint.paced is None else endpoint.paced)


def endpoint(url: str, *, defaults: LineSettings | None = None) -> SerialPort | TcpPort:
    """Return the endpoint for a URL: "/dev/ttyUSB0", "usb:A500ABC?baudrate=9600&parity=E", "socket://host:port".

    The keys of a table have its name in front, as in LINE.toml: "/dev/ttyS1?rs485.level=low&rs485.by=software".
    `defaults`: line settings for a serial port or an RFC 2217 port whose URL leaves them out; behind a TCP port the
    server sets them. Raises InvalidCommand, with the nearest option, for an invalid URL.
    """
    if not isinstance(url, str):
        raise InvalidCommand(f"a port must be text, such as '/dev/ttyUSB0?baudrate=57600', not {url!r}")
    # The two kinds of address are confused easily: both are given to `busmaster` in the same place.
    if is_served(url):
        raise InvalidCommand(
            f"{url} is the address of a running line, for read, write, poll and scan. A port is needed here; "
            "write a serial server as socket://HOST:PORT"
        )
    if "://" not in url:
        path, _, query = url.partition("?")
        if HOST_PORT.fullmatch(path) and not path.startswith(USB):  # usb:12345678 looks like a host and its port
            raise InvalidCommand(f"{path!r} is not a device path; write a TCP port as socket://{path}")
        return SerialPort(path, **_with_line(path, _with_rs485(_options(query, SERIAL_OPTIONS)), defaults))
    scheme = url.partition("://")[0]
    if scheme == "rfc2217":
        from busmaster.transport.rfc2217 import Rfc2217Port  # most lines have none: it would take 2 % of the import

        host, port, query = _address(url)
        return Rfc2217Port(host, port, **_with_line(url, _options(query, RFC2217_OPTIONS), defaults))
    if scheme != "socket":
        raise InvalidCommand(
            f"no such kind of port: {scheme}://; use a device path, usb:SERIAL, socket://HOST:PORT or rfc2217://HOST:PORT"
        )
    host, port, query = _address(url)
    return TcpPort(host, port, **_options(query, TCP_OPTIONS))


def is_served(address: str) -> bool:
    """Return True if this is the address of a line that another program serves, and not a port."""
    return address.startswith(("unix:", "tcp://"))


def _with_line(name: str, options: dict[str, Any], defaults: LineSettings | None) -> dict[str, Any]:
    """Return the options, and the defaults for line settings that they leave open. Raises InvalidCommand."""
    if defaults is not None:
        # The protocol's document has these defaults; only the user knows which of several baud rates a line uses.
        options = asdict(defaults) | options
    if "baudrate" not in options:
        raise InvalidCommand(f"{name}: no baud rate given; write for example {name.partition('?')[0]}?baudrate=57600")
    return options


def _with_rs485(options: dict[str, Any]) -> dict[str, Any]:
    """Return the options with those of RS-485 as one. Raises InvalidCommand."""
    parts = {key.removeprefix(RS485): options.pop(key) for key in tuple(options) if key.startswith(RS485)}
    if parts and "rs485" in options:
        raise InvalidCommand(f"port options rs485 and {RS485}{next(iter(parts))} exclude each other: leave rs485 out")
    return options | {"rs485": Rs485(**parts)} if parts else options


def _address(url: str) -> tuple[str, int, str]:
    """Return host, port and query of a serial server's URL. Raises InvalidCommand."""
    try:
        parts = urlsplit(url)
        host, port = parts.hostname, parts.port
    except ValueError:
        # A port that is not a number, or above 65535.
        host, port = None, None
    if not host or port is None or parts.path not in ("", "/"):
        raise InvalidCommand(f"{url!r} is not of the form {url.partition('://')[0]}://HOST:PORT")
    return host, port, parts.query


def _options(query: str, known: Mapping[str, Callable[[str], object]]) -> dict[str, Any]:
    """Parse `a=1&b=2` with the table of known options."""
    options: dict[str, Any] = {}
    for key, text in parse_qsl(query, keep_blank_values=True):  # an empty value must be rejected, not skipped
        if key not in known:
            raise InvalidCommand(f"no such port option {key!r}; {meant(key, known)}")
        try:
            options[key] = known[key](text)
        except (ValueError, KeyError):
            raise InvalidCommand(f"port option {key}={text!r}: {MEANT[known[key]]}") from None
    return options


def _flag(text: str) -> bool:
    return {"1": True, "true": True, "yes": True, "on": True, "0": False, "false": False, "no": False, "off": False}[
        text.lower()
    ]


def _parity(text: str) -> str:
    names = {"none": "N", "even": "E", "odd": "O", "mark": "M", "space": "S"}
    return names.get(text.lower()) or {letter: letter for letter in names.values()}[text.upper()]


def _stopbits(text: str) -> float:
    return {"1": 1, "1.5": 1.5, "2": 2}[text]


def _switch(text: str) -> str:
    return {name: name for name in SWITCHES}[text]


def _level(text: str) -> str:
    return {name: name for name in LEVELS}[text]


RS485 = "rs485."
"""What the options that stand for the keys of the table `rs485` begin with."""

SERIAL_OPTIONS: dict[str, Callable[[str], object]] = {
    "baudrate": int,
    "bytesize": int,
    "parity": _parity,
    "stopbits": _stopbits,
    "rtscts": _flag,
    "rs485": _flag,
    "rs485.by": _switch,
    "rs485.level": _level,
    "rs485.delay_before": float,
    "rs485.delay_after": float,
    "rs485.rx_during_tx": _flag,
    "echo": _flag,
    "low_latency": _flag,
    "receive_latency": float,
    "exclusive": _flag,
    "paced": _flag,
}

TCP_OPTIONS: dict[str, Callable[[str], object]] = {
    "baudrate": int,
    "echo": _flag,
    "receive_latency": float,
    "paced": _flag,
}

RFC2217_OPTIONS: dict[str, Callable[[str], object]] = {
    "baudrate": int,
    "bytesize": int,
    "parity": _parity,
    "stopbits": _stopbits,
    "rtscts": _flag,
    "dtr": _flag,
    "rts": _flag,
    "echo": _flag,
    "receive_latency": float,
    "paced": _flag,
}

MEANT: dict[Callable[[str], object], str] = {
    int: "use a whole number",
    float: "use a number of seconds, such as 0.016",
    _flag: "use 1 or 0, true or false",
    _parity: "use N, E, O, M or S",
    _stopbits: "use 1, 1.5 or 2",
    _switch: f"use {' or '.join(SWITCHES)}",
    _level: f"use {' or '.join(LEVELS)}",
}
