"""The port of a file: any form that the command line takes, or a table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from busmaster.config.table import Table
from busmaster.contract.profile import LineSettings, Profile
from busmaster.transport.endpoints import endpoint
from busmaster.transport.serial_port import SerialPort
from busmaster.transport.tcp import TcpPort

SERIAL: Mapping[str, str] = {
    "baudrate": "whole",
    "bytesize": "whole",
    "parity": "text",
    "stopbits": "number",
    "rtscts": "flag",
    "rs485": "flag",
    "echo": "flag",
    "low_latency": "flag",
    "receive_latency": "seconds",
    "exclusive": "flag",
    "paced": "flag",
}
TCP: Mapping[str, str] = {"baudrate": "whole", "receive_latency": "seconds", "echo": "flag", "paced": "flag"}


def read_port(top: Table, profiles: Sequence[Profile]) -> SerialPort | TcpPort:
    """`port = "/dev/ttyUSB0"` or `[port]`. What it leaves open of a serial line is as the nodes' protocols want it."""
    if isinstance(top.data.get("port"), str):
        with top.at("port"):
            return endpoint(top.text("port"), defaults=_agreed(profiles))
    if "port" not in top:
        raise top.error("'port' is missing: a device path, socket://HOST:PORT, or a table: [port]")
    table = top.table("port")
    if "host" in table:
        table.only("host", "port", *TCP)
        host, port = table.text("host"), table.whole("port", least=1, most=65535)
        options = _options(table, TCP)
        with table.at():
            return TcpPort(host, port, **options)
    table.only("path", *SERIAL)
    path = table.text("path")
    options = _options(table, SERIAL)
    defaults = _agreed(profiles)
    if defaults is not None:
        options = {name: getattr(defaults, name) for name in ("baudrate", "bytesize", "parity", "stopbits")} | options
    if "baudrate" not in options:
        raise table.error("'baudrate' is missing: the nodes' protocols are meant for different lines")
    with table.at():
        return SerialPort(path, **options)


def _agreed(profiles: Sequence[Profile]) -> LineSettings | None:
    """The line that all the protocols are meant for, if there is one."""
    lines = {profile.line for profile in profiles}
    return lines.pop() if len(lines) == 1 else None


def _options(table: Table, kinds: Mapping[str, str]) -> dict[str, Any]:
    readers: dict[str, Callable[[str], Any]] = {
        "whole": table.whole,
        "text": table.text,
        "number": table.number,
        "seconds": table.seconds,
        "flag": lambda name: table.flag(name, False),
    }
    return {name: readers[kind](name) for name, kind in kinds.items() if name in table}
