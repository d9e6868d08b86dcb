"""State of an open port that the kernel knows and asyncio does not report.

Unread bytes, unsent bytes, the counters of a serial driver, and why a connection was lost. No function here blocks.
The hot path of a port that never held bytes back makes no query: unread and unsent bytes are queried when a deadline
expires, counters when they are displayed.
"""

from __future__ import annotations

import array
import asyncio
import contextlib
import fcntl
import select
import socket
import struct
import termios
from collections.abc import Callable

from busmaster.arbiter.counters import DriverErrors
from busmaster.errors import BusError

DELAYED_ACK = 0.050
"""Seconds for which a healthy peer may delay an acknowledgement (Linux: 40 ms)."""
SIOCOUTQNSD = 0x894B
"""linux/sockios.h: bytes not sent yet. SIOCOUTQ, the same number as TIOCOUTQ, includes those on the way."""
TCP_INFO_TIMES = struct.Struct("68xII")
"""struct tcp_info (linux/tcp.h): the smoothed round trip time and its variation, in microseconds."""
TIOCGICOUNT = 0x545D
FRAME, OVERRUN, PARITY, BRK, BUF_OVERRUN = range(6, 11)
"""struct serial_icounter_struct (linux/serial.h): where its counts are, in ints."""
DAMAGE = FRAME, PARITY, BRK
"""The errors that a tty marks."""
ICOUNTER_SIZE = 20
WRAP = 0xFFFFFFFF


class OpenPort:
    """A port without a known descriptor: only its transport's buffer can be queried."""

    stuck_because = "the port does not take it; open it again"
    flow_controlled = False
    """Written bytes can stay in the driver for a time: flow control, or a delay of its RS-485 mode."""

    def __init__(self, transport: asyncio.Transport) -> None:
        # Looked up once: it is called at every deadline.
        self._buffered = _buffer_of(transport)

    def unread(self) -> bool:
        """Return True if received bytes were not passed on yet, as far as can be determined.

        A loop that was blocked may run a timer before it reads. A late reply would then lie unread, and the silence
        that R3 requires would be wrong.
        """
        return False

    def unsent(self, waited: float) -> int | None:
        """Return the number of bytes that have not left, `waited` seconds after the last write; None if unknown."""
        return None if self._buffered is None else self._buffered()

    def discard_unsent(self) -> None:
        """Ensure that unsent bytes are never sent after the transport is aborted."""

    def errors(self) -> DriverErrors | None:
        """Return the driver's counters since the port was opened or they were reset; None if there are none."""
        return None

    def is_break(self) -> bool:
        """Return True if a byte marked as a break was one, as far as the driver reports it."""
        return True

    def reset(self) -> None:
        """Reset the driver's counters."""


class _Descriptor(OpenPort):
    def __init__(self, transport: asyncio.Transport, descriptor: int) -> None:
        super().__init__(transport)
        self._fd = descriptor
        self._input = select.poll()  # select() fails above descriptor 1023
        self._input.register(descriptor, select.POLLIN)

    def unread(self) -> bool:
        found = self._input.poll(0)
        # Not for POLLHUP alone: a lost port is readable for ever, but has no bytes.
        return bool(found) and found[0][1] & select.POLLIN > 0

    def _count(self, request: int) -> int:
        """Return the result of an ioctl that returns a number; 0 if it fails."""
        answer = array.array("i", [0])
        try:
            fcntl.ioctl(self._fd, request, answer)
        except OSError:
            return 0
        return answer[0]


class Tty(_Descriptor):
    """A serial port or a pseudo-terminal."""

    stuck_because = "flow control holds it or the adapter is stuck; check CTS, replug"

    def __init__(self, transport: asyncio.Transport, descriptor: int, flow_controlled: bool = False) -> None:
        super().__init__(transport, descriptor)
        self.flow_controlled = flow_controlled
        self._opened = self._counted()
        self.reset()

    def unsent(self, waited: float) -> int | None:
        return (super().unsent(waited) or 0) + self._count(termios.TIOCOUTQ)

    def errors(self) -> DriverErrors | None:
        # TIOCGICOUNT counts from the loading of the driver, also for earlier programs.
        now, before = self._counted(), self._before
        if now is None or before is None:
            return None
        # The counters have 32 bits and wrap around.
        framing, overruns, parity, breaks, lost = (
            (now[field] - before[field]) & WRAP for field in (FRAME, OVERRUN, PARITY, BRK, BUF_OVERRUN)
        )
        return DriverErrors(framing, parity, breaks, overruns, lost)

    def is_break(self) -> bool:
        """Return True if the driver has counted a break that was not marked yet.

        A tty marks a break with the same bytes as a damaged byte 00, of which there are many at a wrong baud rate. If
        the driver has counted no error at all, its marks are trusted.
        """
        now = self._counted()
        if now is None or self._opened is None or not any(now[field] != self._opened[field] for field in DAMAGE):
            return True
        if not (now[BRK] - self._breaks) & WRAP:
            return False
        self._breaks += 1
        return True

    def reset(self) -> None:
        self._before = self._counted()
        self._breaks = 0 if self._before is None else self._before[BRK]
        """The driver's count of breaks up to the last marked one."""

    def _counted(self) -> array.array[int] | None:
        """Return the driver's counters since it was loaded; None if it has none, as for a pty."""
        counts = array.array("i", [0] * ICOUNTER_SIZE)
        try:
            fcntl.ioctl(self._fd, TIOCGICOUNT, counts)
        except OSError:
            return None
        return counts


class Socket(_Descriptor):
    """A TCP connection. Sent bytes that are not acknowledged may be stuck on the way."""

    stuck_because = "the network or the serial server does not respond; check both"

    def __init__(self, transport: asyncio.Transport, sock: socket.socket) -> None:
        super().__init__(transport, sock.fileno())
        self._socket = sock
        self._remote: Callable[[], DriverErrors | None] | None = transport.get_extra_info("line_errors")
        self.reset()

    def unsent(self, waited: float) -> int | None:
        """Count unsent bytes. Bytes on the way count only if their acknowledgement is later than usual on this path."""
        # Each request would otherwise count as held for 40 ms: the peer delays its acknowledgement until it has data to
        # send.
        under_way = waited >= DELAYED_ACK and waited >= self._usual_acknowledgement()
        return (super().unsent(waited) or 0) + self._count(termios.TIOCOUTQ if under_way else SIOCOUTQNSD)

    def errors(self) -> DriverErrors | None:
        """Return the errors counted by the remote port, if the server reports them (RFC 2217)."""
        now = None if self._remote is None else self._remote()
        return now if now is None or self._before is None else now.since(self._before)

    def reset(self) -> None:
        self._before = None if self._remote is None else self._remote()

    def discard_unsent(self) -> None:
        """Make the connection end with a reset: after a normal close the kernel would continue to send."""
        with contextlib.suppress(OSError):  # it may be gone already
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    def _usual_acknowledgement(self) -> float:
        """Return its usual time, in seconds, as the kernel calculates it for retransmissions; 0 if unknown."""
        if not hasattr(socket, "TCP_INFO"):
            # The port was lost in the meantime. Its transport reports that.
            return 0.0
        try:
            info = self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO_TIMES.size)
            mean, variation = TCP_INFO_TIMES.unpack(info)
        except (OSError, struct.error):
            return 0.0
        # The retransmission timeout of RFC 6298, without its minimum.
        return float(mean + 4 * variation) / 1e6


def open_port(transport: asyncio.Transport) -> OpenPort:
    """Return the port object for this transport."""
    device = transport.get_extra_info("serial")
    # By the transport and not by the endpoint: an application can pass an endpoint of its own.
    if device is not None:
        return Tty(transport, device.fileno(), device.rtscts or bool(transport.get_extra_info("delayed")))
    sock = transport.get_extra_info("socket")
    return OpenPort(transport) if sock is None else Socket(transport, sock)


def _buffer_of(transport: asyncio.Transport) -> Callable[[], int] | None:
    """Return a function for the number of buffered bytes of the transport; None if it has none."""
    try:
        transport.get_write_buffer_size()
    except (AttributeError, NotImplementedError):
        return None
    return transport.get_write_buffer_size


def cause_text(cause: Exception | None, otherwise: str) -> str:
    """Return why a connection was lost, as text; `otherwise` if there was no error. Never empty."""
    if cause is None:
        return otherwise
    if isinstance(cause, BusError):
        return cause.what
    return getattr(cause, "strerror", None) or str(cause) or type(cause).__name__
