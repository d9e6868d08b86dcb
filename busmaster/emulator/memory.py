"""An emulated line in this process: bytes that take their time, without a port."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass
from math import inf
from typing import Any

from busmaster.contract.profile import LineSettings
from busmaster.emulator.line import Line
from busmaster.transport.clock import clock_of, is_virtual
from busmaster.transport.identity import Identity


@dataclass(frozen=True, slots=True)
class MemoryPort:
    """The host's end of an emulated line; one host at a time.

    In real time, replies arrive up to a millisecond late (the loop rounds its timers up); under a loop that keeps
    virtual time they are exact.
    """

    line: Line

    @property
    def name(self) -> str:
        """Return its name in messages."""
        return "the emulated line"

    @property
    def settings(self) -> LineSettings:
        """Return baud rate and framing of the emulated line."""
        return self.line.settings

    @property
    def echo(self) -> bool:
        """Return True if sent bytes are received too."""
        return self.line.echo is not None

    @property
    def receive_latency(self) -> float:
        """Return the seconds for which the emulated adapter can hold bytes."""
        return self.line.latency

    @property
    def paced(self) -> bool:
        """Return True if bytes have a duration on the wire."""
        return self.line.paced

    def presence(self) -> None:
        """Return None: it is always present."""
        return None

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> MemoryTransport:
        """Open it. Never fails."""
        return MemoryTransport(asyncio.get_running_loop(), protocol_factory(), self.line)


class MemoryTransport(asyncio.Transport):
    """Sends to the line, and passes the line's bytes to the protocol when they are due."""

    def __init__(self, loop: asyncio.AbstractEventLoop, protocol: asyncio.Protocol, line: Line) -> None:
        super().__init__()
        self._loop = loop
        self._clock = clock_of(loop)
        self._real_time = not is_virtual(loop)
        self._protocol = protocol
        self._line = line
        self._closing = False
        self._held: bytes | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._armed = inf
        line.prompt = True
        line.receive(self._clock())  # discard the bytes from before the connection
        protocol.connection_made(self)
        self._arm(line.next_event())

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Return the emulated line for the name `line`; the default for any other."""
        return self._line if name == "line" else default

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Pass `data` to the line, unless writes are held. The line sends it byte by byte."""
        if self._closing:
            return
        if self._held is not None:
            self._held += bytes(data)
            self._protocol.pause_writing()
        elif self._real_time:
            # Not before the sender has read its clock: if the process stands still in between, a reply could come
            # earlier than the time from which the sender counts its request as sent.
            self._loop.call_soon(self._send, bytes(data))
        else:
            self._send(bytes(data))

    def get_write_buffer_size(self) -> int:
        """Return the number of held bytes."""
        return len(self._held or b"")

    async def tune(self, settings: LineSettings) -> None:
        """Set the port to another rate and framing. If they differ from the line, both sides receive wrong bytes."""
        self._line.host = None if settings == self._line.settings else settings

    def hold(self) -> None:
        """Hold back all writes from now on, as if flow control stopped the port."""
        if self._held is None:
            self._held = b""

    def release(self) -> None:
        """Release the bytes held back."""
        held, self._held = self._held, None
        if held and not self._closing:
            self.write(held)
            self._protocol.resume_writing()

    def is_closing(self) -> bool:
        return self._closing

    def close(self) -> None:
        self.lose(None)

    def abort(self) -> None:
        self.lose(None)

    def lose(self, cause: Exception | None) -> None:
        """Lose the port, as if it were unplugged. The protocol is notified once, at the next turn of the loop."""
        if self._closing:
            return
        self._closing = True
        if self._timer is not None:
            self._timer.cancel()
        self._loop.call_soon(self._protocol.connection_lost, cause)

    def _send(self, data: bytes) -> None:
        self._line.send(data, self._clock())
        self._arm(self._line.next_event())

    def _arm(self, due: float) -> None:
        """Set the one timer, which is left alone if it comes sooner."""
        if due >= self._armed or self._closing:
            return
        if self._timer is not None:
            self._timer.cancel()
        self._armed = due
        self._timer = self._loop.call_at(self._loop.time() + max(0.0, due - self._clock()), self._on_time)

    def _on_time(self) -> None:
        self._timer = None
        self._armed = inf
        now = self._clock()
        data = self._line.receive(now)
        if data:
            self._protocol.data_received(data)
        self._arm(self._line.next_event())


__all__ = [
    "MemoryPort",
    "MemoryTransport",
]
