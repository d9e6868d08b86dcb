"""The port of a file: any form that the command line takes, or a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from functools import cache
from typing import Any

from busmaster import LineSettings, Rfc2217Port, SerialPort, TcpPort, endpoint
from busmaster.app.config.keys import Form, Key, keys_of, names_of, read_keys
from busmaster.app.config.table import Table
from busmaster.ext import Profile

PORT = Form(
    "text or table",
    {"anyOf": [{"type": "string"}, *({"$ref": f"#/$defs/{name}_port"} for name in ("serial", "tcp", "rfc2217"))]},
    required=True,
)


@dataclass(frozen=True, slots=True)
class ByRfc2217:
    """The key that distinguishes the two kinds of serial servers."""

    rfc2217: bool = False
    """Whether the server takes the line settings by RFC 2217."""


@cache
def serial_keys() -> tuple[Key, ...]:
    """Return the keys of a serial port. By default baud rate and framing are those of the nodes' protocol."""
    return _with_framing_of_the_protocol(SerialPort)


@cache
def tcp_keys() -> tuple[Key, ...]:
    """Return the keys of a serial server that passes raw bytes."""
    return keys_of(TcpPort) + keys_of(ByRfc2217)


@cache
def rfc2217_keys() -> tuple[Key, ...]:
    """Return the keys of a serial server whose line settings are set by RFC 2217."""
    return _with_framing_of_the_protocol(Rfc2217Port) + keys_of(ByRfc2217)


def _with_framing_of_the_protocol(port: type) -> tuple[Key, ...]:
    framing = {part.name for part in fields(LineSettings)}
    return tuple(replace(key, required=False, default=None) if key.name in framing else key for key in keys_of(port))


def read_port(top: Table, profiles: Sequence[Profile]) -> SerialPort | TcpPort:
    """Read `port = "/dev/ttyUSB0"` or `[port]`.

    Line settings that it does not contain are those of the nodes' protocols.
    """
    if isinstance(top.data.get("port"), str):
        with top.at("port"):
            return endpoint(top.text("port"), defaults=_agreed(profiles))
    if "port" not in top:
        raise top.error(
            "'port' is missing; use a device path, socket://HOST:PORT, rfc2217://HOST:PORT, or a table: [port]"
        )
    table = top.table("port")
    is_remote = "host" in table
    if is_remote and not ("rfc2217" in table and table.flag("rfc2217")):
        values = _read(table, tcp_keys())
        with table.at():
            return TcpPort(**values)
    agreed = _agreed(profiles)
    values = _read(table, rfc2217_keys() if is_remote else serial_keys())
    if "baudrate" not in values and agreed is None:
        raise table.error("'baudrate' is missing, and the nodes' protocols have different defaults; add it")
    with table.at():
        kind = Rfc2217Port if is_remote else SerialPort
        return kind(**({} if agreed is None else asdict(agreed)) | values)


def _read(table: Table, keys: Sequence[Key]) -> dict[str, Any]:
    table.only(*names_of(keys))
    values = read_keys(table, keys)
    values.pop("rfc2217", None)
    return values


def _agreed(profiles: Sequence[Profile]) -> LineSettings | None:
    """Return the line that all the protocols are meant for, None if there is none."""
    lines = {profile.line for profile in profiles}
    return lines.pop() if len(lines) == 1 else None
