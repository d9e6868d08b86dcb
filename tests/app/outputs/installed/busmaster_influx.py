"""An output that another package brings: values as InfluxDB lines in UDP packets, for a socket_listener of Telegraf."""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import Annotated, Any

from busmaster import Snapshot
from busmaster.app.outputs.base import Item, Output, OutputKind, OutputLine
from busmaster.app.outputs.settings import Settings
from busmaster.ext import Between


@dataclass(frozen=True, slots=True, kw_only=True)
class InfluxSettings(Settings):
    """The keys of `[outputs.influx]`, beside `enabled`, `groups` and `buffer`."""

    host: str = "127.0.0.1"
    """The host of Telegraf."""
    port: Annotated[int, Between(1, 65535)] = 8094
    """Its UDP port."""

    @property
    def destination(self) -> str:
        """Return the address, as messages name it."""
        return f"{self.host}:{self.port}"


class InfluxOutput(Output):
    """Sends each cycle as one packet."""

    def __init__(self, settings: InfluxSettings, line: OutputLine) -> None:
        super().__init__("influx", settings, line.report)
        self._settings = settings

    def work(self) -> None:
        """Send what is offered, in the output's own thread. It is called again, after a pause, if it raises."""
        host, port = self._settings.host, self._settings.port
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)[0]
        with socket.socket(family, socket.SOCK_DGRAM) as out:
            self.drain(lambda item: send(out, address, item))


def send(out: socket.socket, address: Any, item: Item) -> None:
    """Send one item. The socket is not connected, so it raises no error if nobody receives."""
    if isinstance(item, Snapshot) and (found := lines(item)):  # the others are events and audit entries
        out.sendto("\n".join(found).encode(), address)


def lines(cycle: Snapshot) -> list[str]:
    """Return a line for each current value that is a number. A stale value was sent before the write."""
    return [
        f"busmaster,point={point.key} value={float(sample.value)} {int(sample.wall * 1e9)}"
        for point, sample in cycle.samples.items()
        if sample.quality.is_current and isinstance(sample.value, int | float)
    ]


INFLUX = OutputKind(
    name="influx",
    settings=InfluxSettings,
    make=InfluxOutput,
    about="Values as InfluxDB lines in UDP packets.",
)
