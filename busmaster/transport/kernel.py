"""What the kernel knows of an open port and asyncio does not tell.

What lies unread, what has not left yet, and what a serial driver has counted. Nothing here waits, and nothing is asked
on the hot path of a port that never held anything: of what lies unread or unsent when a deadline falls due, of the
counts when somebody looks at them.
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

DELAYED_ACK = 0.050
"""Seconds for which a healthy peer may keep an acknowledgement back (Linux: 40 ms)."""
SIOCOUTQNSD = 0x894B
"""linux/sockios.h: bytes that were not sent yet; SIOCOUTQ, the same number as TIOCOUTQ, also counts those under way."""
TCP_INFO_TIMES = struct.Struct("68xII")
"""struct tcp_info (linux/tcp.h): the smoothed round trip time and its variation, in microseconds."""
TIOCGICOUNT = 0x545D
FRAME, OVERRUN, PARITY, BRK, BUF_OVERRUN = range(6, 11)
"""struct serial_icounter_struct (linux/serial.h): where its counts are, in ints."""
DAMAGE = FRAME, PARITY, BRK
"""Those of them that a tty marks."""
ICOUNTER_SIZE = 20
WRAP = 0xFFFFFFFF


class OpenPort:
    """A port without a descriptor that we know: all that can be asked is its transport's own buffer."""

    stuck_because = "the port does not take it; open it again"
    flow_controlled = False
    """The other end may stop what is sent, for as long as it likes."""

    def __init__(self, transport: asyncio.Transport) -> None:
        self._buffered = _buffer_of(transport)

    def unread(self) -> bool:
        """Return whether bytes have come that were not handed over yet, as far as can be seen.

        A loop that was blocked may run a timer before it reads: a late reply would lie there, and the silence that R3
        waits for would be a mistake.
        """
        return False

    def unsent(self, waited: float) -> int | None:
        """Return how many bytes have not left, `waited` seconds after the last write; None if that cannot be told."""
        return None if self._buffered is None else self._buffered()

    def discard_unsent(self) -> None:
        """See to it that what has not left never leaves when the transport is aborted."""

    def errors(self) -> DriverErrors | None:
        """Return what its driver has counted since it was opened or reset; None where there is none that counts."""
        return None

    def is_break(self) -> bool:
        """Return whether what a tty marks as a break, and hands over now, was one, as far as the driver tells."""
        return True

    def reset(self) -> None:
        """Start the driver's counts again."""


class _Descriptor(OpenPort):
    def __init__(self, transport: asyncio.Transport, descriptor: int) -> None:
        super().__init__(transport)
        self._fd = descriptor
        self._input = select.poll()  # select() fails above descriptor 1023
        self._input.register(descriptor, select.POLLIN)

    def unread(self) -> bool:
        found = self._input.poll(0)
        return bool(found) and found[0][1] & select.POLLIN > 0

    def _count(self, request: int) -> int:
        """Return a number that an ioctl tells; 0 where it tells nothing."""
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
        now, before = self._counted(), self._before
        if now is None or before is None:
            return None
        # The counts have 32 bits, and wrap.
        framing, overruns, parity, breaks, lost = (
            (now[field] - before[field]) & WRAP for field in (FRAME, OVERRUN, PARITY, BRK, BUF_OVERRUN)
        )
        return DriverErrors(framing, parity, breaks, overruns, lost)

    def is_break(self) -> bool:
        """Return whether the driver has counted a break that was not marked yet.

        A tty marks a break by the same bytes as a damaged byte 00, and on a line at a wrong rate there are many of
        those. The marks of a driver that has counted nothing at all are believed.
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
        """The driver's count of breaks up to the last one that was marked."""

    def _counted(self) -> array.array[int] | None:
        """Return the driver's counts since it was loaded; None where it keeps none, as for a pty."""
        counts = array.array("i", [0] * ICOUNTER_SIZE)
        try:
            fcntl.ioctl(self._fd, TIOCGICOUNT, counts)
        except OSError:
            return None
        return counts


class Socket(_Descriptor):
    """A TCP connection. What was sent and is not acknowledged may stand still on the way."""

    stuck_because = "the network or the server stands still; check both"

    def __init__(self, transport: asyncio.Transport, sock: socket.socket) -> None:
        super().__init__(transport, sock.fileno())
        self._socket = sock
        self._remote: Callable[[], DriverErrors | None] | None = transport.get_extra_info("line_errors")
        self.reset()

    def unsent(self, waited: float) -> int | None:
        """Count what is under way only if its acknowledgement is later than is usual on this path."""
        under_way = waited >= DELAYED_ACK and waited >= self._usual_acknowledgement()
        return (super().unsent(waited) or 0) + self._count(termios.TIOCOUTQ if under_way else SIOCOUTQNSD)

    def errors(self) -> DriverErrors | None:
        """Return what the remote port has counted, where the server reports it (RFC 2217)."""
        now = None if self._remote is None else self._remote()
        return now if now is None or self._before is None else now.since(self._before)

    def reset(self) -> None:
        self._before = None if self._remote is None else self._remote()

    def discard_unsent(self) -> None:
        """Have the connection reset: closing would leave it to the kernel, which goes on sending."""
        with contextlib.suppress(OSError):  # it may be gone already
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    def _usual_acknowledgement(self) -> float:
        """Return it in seconds, as the kernel calculates for its own repeats; 0 where it does not tell."""
        if not hasattr(socket, "TCP_INFO"):
            return 0.0
        try:
            info = self._socket.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, TCP_INFO_TIMES.size)
            mean, variation = TCP_INFO_TIMES.unpack(info)
        except (OSError, struct.error):
            return 0.0
        return float(mean + 4 * variation) / 1e6


def open_port(transport: asyncio.Transport) -> OpenPort:
    """Return what can be asked of the port behind this transport."""
    device = transport.get_extra_info("serial")
    if device is not None:
        return Tty(transport, device.fileno(), device.rtscts)
    sock = transport.get_extra_info("socket")
    return OpenPort(transport) if sock is None else Socket(transport, sock)


def _buffer_of(transport: asyncio.Transport) -> Callable[[], int] | None:
    """Return what tells how much the transport still has to write; None for one that does not tell."""
    try:
        transport.get_write_buffer_size()
    except (AttributeError, NotImplementedError):
        return None
    return transport.get_write_buffer_size
