"""The port of a file: any form that the command line takes, or a table."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict

from busmaster import LineSettings, Rfc2217Port, SerialPort, TcpPort, endpoint
from busmaster.app.config.table import Table
from busmaster.ext import Profile


def read_port(top: Table, profiles: Sequence[Profile]) -> SerialPort | TcpPort:
    """Read `port = "/dev/ttyUSB0"` or `[port]`.

    What it leaves open of a serial line is as the nodes' protocols want it.
    """
    if isinstance(top.data.get("port"), str):
        with top.at("port"):
            return endpoint(top.text("port"), defaults=_agreed(profiles))
    if "port" not in top:
        raise top.error("'port' is missing: a device path, socket://HOST:PORT, rfc2217://HOST:PORT, or a table: [port]")
    table = top.table("port")
    remote = "host" in table
    if remote and not table.flag("rfc2217", False):
        said = table.typed(TcpPort, "rfc2217")
        with table.at():
            return TcpPort(**said)
    agreed = _agreed(profiles)
    kind = Rfc2217Port if remote else SerialPort
    said = table.typed(kind, *(("rfc2217",) if remote else ()), optional=("baudrate",))
    if "baudrate" not in said and agreed is None:
        raise table.error("'baudrate' is missing: the nodes' protocols are meant for different lines")
    with table.at():
        return kind(**({} if agreed is None else asdict(agreed)) | said)


def _agreed(profiles: Sequence[Profile]) -> LineSettings | None:
    """Return the line that all the protocols are meant for, None if there is none."""
    lines = {profile.line for profile in profiles}
    return lines.pop() if len(lines) == 1 else None
