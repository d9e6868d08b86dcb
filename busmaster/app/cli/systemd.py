"""Notifies systemd, by datagrams, that a service is ready, is alive, reloads or stops.

The protocol (sd_notify) is one NAME=VALUE per line, sent to the socket that NOTIFY_SOCKET names.
"""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Mapping

import anyio

from busmaster import Bus, Health, LineState, ext

AT_LEAST = 0.1
"""Shortest time in seconds between two watchdog messages, independent of the configured interval."""


class ServiceManager:
    """Notifies systemd, if there is one. Failures of the notification never delay or end the program.

    `interval`: seconds within which systemd expects a watchdog message, 0 for none.
    """

    def __init__(self, environment: Mapping[str, str] = os.environ) -> None:
        path = environment.get("NOTIFY_SOCKET", "")
        # @ stands for the zero byte that begins an abstract address
        self._address = "\0" + path[1:] if path.startswith("@") else path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) if path else None
        if self._socket is not None:
            self._socket.setblocking(False)  # a manager that does not read holds up no line
        micros = environment.get("WATCHDOG_USEC", "")
        # a child inherits the parent's variable: compare the process id
        wanted = micros.isdecimal() and environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        self.interval = int(micros) / 1e6 if wanted and path else 0.0

    def notify(self, **fields: str | int) -> None:
        """Send these fields, as one message."""
        if self._socket is not None:
            text = "\n".join(f"{name}={value}" for name, value in fields.items())
            try:
                self._socket.sendto(text.encode(), self._address)
            except OSError:
                pass

    def ready(self) -> None:
        """Report that the service is ready; also after `reloading`."""
        self.notify(READY=1)

    def reloading(self) -> None:
        """Report that the service reloads its file, until it is `ready`."""
        self.notify(RELOADING=1, MONOTONIC_USEC=time.monotonic_ns() // 1000)

    def stopping(self) -> None:
        """Report that the service stops in an orderly way."""
        self.notify(STOPPING=1)

    def close(self) -> None:
        """Close the socket; nothing is sent any more."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    async def show_life(self, bus: Bus) -> None:
        """Give a sign of life twice an interval, as long as the line moves; until cancelled."""
        if not self.interval:
            return
        movement = Movement(bus)
        while True:
            if movement.goes_on(self.interval):
                self.notify(WATCHDOG=1)
            await anyio.sleep(max(AT_LEAST, self.interval / 2))


class Movement:
    """Watches whether a line works: exchanges take place, not only iterations of the loop."""

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._exchanges = -1
        self._since = bus.now()

    def goes_on(self, patience: float) -> bool:
        """Return whether there was an exchange in the last `patience` seconds, or in two periods if those are longer.

        No exchange is expected while the port is lost (reopening is reported separately), while nothing is polled, or
        while every node is down or suspended.
        """
        now = self._bus.now()
        exchanges = ext.line_statistics(self._bus).exchanges
        periods = [group.period for group in self._bus.groups if group.points and not group.paused]
        asked = any(node.health is not Health.DOWN and not node.suspended for node in self._bus.nodes)
        if exchanges != self._exchanges or not periods or not asked or self._bus.state is LineState.OFFLINE:
            self._exchanges, self._since = exchanges, now
        return now - self._since < max(patience, 2 * min(periods, default=0.0))
