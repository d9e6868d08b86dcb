"""The direction of an RS-485 line that RTS switches: by the serial driver, or by this program (`RtsSwitch`).

The driver is more precise, because it switches in the interrupt of the last bit. A thread can only wait for that bit.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import os
import queue
import select
import struct
import termios
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass
from typing import Annotated, Literal

from serial.rs485 import RS485Settings

from busmaster.contract.arguments import Between
from busmaster.errors import InvalidCommand

LONGEST_DELAY = 0.1
"""The longest delay, in seconds, that Linux has: a driver shortens longer ones (serial_core.c)."""
TIOCGRS485, TIOCSRS485, TIOCSERGETLSR = 0x542E, 0x542F, 0x5459
ENABLED, RTS_ON_SEND, RTS_AFTER_SEND, RX_DURING_TX = 1, 2, 4, 16
"""linux/serial.h: flags, the first word of struct serial_rs485. The two delays follow, in milliseconds."""
RS485_SIZE = 8
TEMT = 1
"""linux/serial.h: the transmitter has sent its last bit."""
LOOK = 0.0001
"""Seconds between two queries of the transmitter."""
LATE_EMPTY = 0.05
"""Seconds after the calculated end. A driver that has not reported an empty transmitter by then is not queried again.
"""
REMEMBERED = 64
"""Number of frames of which the times of the release are kept, for `busmaster doctor`."""

LEVELS = "high", "low"
SWITCHES = "driver", "software"


@dataclass(frozen=True, slots=True)
class Rs485:
    """How RTS switches the transmitter of an RS-485 transceiver. Raises InvalidCommand for invalid values."""

    _: KW_ONLY
    by: Literal["driver", "software"] = "driver"
    """What switches RTS: the serial driver, or busmaster for a driver that cannot. Software is less precise."""
    level: Literal["high", "low"] = "high"
    """Level of RTS while sending."""
    delay_before: Annotated[float, Between(0, LONGEST_DELAY, "s")] = 0.0
    """From switching on to the first byte. A driver has whole milliseconds only."""
    delay_after: Annotated[float, Between(0, LONGEST_DELAY, "s")] = 0.0
    """From the last byte to switching off. A driver has whole milliseconds only."""
    rx_during_tx: bool = False
    """Whether the driver receives while it sends, for four wires. Use `echo` too if sent bytes are received then."""

    def __post_init__(self) -> None:
        for name, value, known in (("by", self.by, SWITCHES), ("level", self.level, LEVELS)):
            if value not in known:
                raise InvalidCommand(f"rs485: {name} must be {' or '.join(known)}, not {value!r}")
        for name in ("delay_before", "delay_after"):
            delay = getattr(self, name)
            if type(delay) not in (int, float) or not 0 <= delay <= LONGEST_DELAY:
                raise InvalidCommand(f"rs485: {name} must be 0 to {LONGEST_DELAY:g} s, not {delay!r}")
            # Not rounded: 0.4 ms would become 0, which is a delay that the user did not set.
            if self.by == "driver" and abs(delay * 1000 - round(delay * 1000)) > 1e-6:
                raise InvalidCommand(
                    f"rs485: {name} must be a whole number of milliseconds, such as 0.001, not {delay:g}: drivers have "
                    'no shorter steps; by = "software" has'
                )
        if not isinstance(self.rx_during_tx, bool):
            raise InvalidCommand(f"rs485: rx_during_tx must be true or false, not {self.rx_during_tx!r}")
        if self.rx_during_tx and self.by == "software":
            raise InvalidCommand(
                'rs485: rx_during_tx must be false with by = "software": there the wiring of the transceiver decides '
                "whether sent bytes are received; if they are, use echo"
            )

    @property
    def rts_while_sending(self) -> bool:
        """Return whether RTS is high while sending; it has the other level at all other times."""
        return self.level == "high"


def settings_of(value: object) -> Rs485 | None:
    """Return the settings that a port's `rs485` stands for, None if it is off. Raises InvalidCommand."""
    if value is None or value is False:
        return None
    if value is True:
        return Rs485()
    if isinstance(value, Rs485):
        return value
    if not isinstance(value, RS485Settings):
        raise InvalidCommand(f"rs485 must be true, false, an Rs485 or pyserial's RS485Settings, not {value!r}")
    if bool(value.rts_level_for_tx) is bool(value.rts_level_for_rx):
        raise InvalidCommand("rs485: rts_level_for_tx and rts_level_for_rx must differ: RTS would never switch")
    return Rs485(
        level="high" if value.rts_level_for_tx else "low",
        delay_before=value.delay_before_tx or 0.0,
        delay_after=value.delay_before_rx or 0.0,
        rx_during_tx=bool(value.loopback),
    )


def set_driver(descriptor: int, wanted: Rs485) -> str:
    """Have the driver switch RTS. Returns which setting it does not take, "" if it takes all. Raises OSError.

    The settings are read back: a driver replaces those that it does not have, without an error.
    """
    state = array.array("I", [0] * RS485_SIZE)
    fcntl.ioctl(descriptor, TIOCGRS485, state)
    # All other flags stay: one of them switches the termination of the bus.
    kept = state[0] & ~(ENABLED | RTS_ON_SEND | RTS_AFTER_SEND | RX_DURING_TX)
    level = RTS_ON_SEND if wanted.rts_while_sending else RTS_AFTER_SEND
    state[0] = kept | ENABLED | level | (RX_DURING_TX if wanted.rx_during_tx else 0)
    state[1], state[2] = round(wanted.delay_before * 1000), round(wanted.delay_after * 1000)
    before, after = state[1], state[2]
    fcntl.ioctl(descriptor, TIOCSRS485, state)
    fcntl.ioctl(descriptor, TIOCGRS485, state)
    flags = state[0]
    if not flags & ENABLED:
        return "it stays off"
    if flags & (RTS_ON_SEND | RTS_AFTER_SEND) != level:
        return f"level {wanted.level}"
    for name, milliseconds, found in (("delay_before", before, state[1]), ("delay_after", after, state[2])):
        if found != milliseconds:
            return f"{name} {milliseconds / 1000:g}: it has {found / 1000:g}"
    # Only this way: if the transceiver's receiver is off while it sends, nothing is received in spite of the flag.
    if wanted.rx_during_tx and not flags & RX_DURING_TX:
        return "rx_during_tx true"
    return ""


def set_rts(descriptor: int, on: bool) -> None:
    """Set the RTS line to high (on) or low. Raises OSError if the driver has no such line."""
    fcntl.ioctl(descriptor, termios.TIOCMBIS if on else termios.TIOCMBIC, struct.pack("I", termios.TIOCM_RTS))


def keep_lines_at_close(descriptor: int) -> None:
    """Have the driver leave RTS as it is when the port is closed. By default it sets RTS to low."""
    settings = termios.tcgetattr(descriptor)
    settings[2] &= ~termios.HUPCL
    termios.tcsetattr(descriptor, termios.TCSANOW, settings)


class RtsSwitch:
    """Sends the frames of one open port, in a thread, and switches RTS before and after each.

    In a thread, because each step can block: a USB adapter takes about a millisecond to set RTS, and an event loop's
    timer is up to a millisecond late. `sent` and `lost` are called in that thread. `byte_time`: seconds per byte, 0 for
    a port without a baud rate.
    """

    def __init__(
        self,
        descriptor: int,
        settings: Rs485,
        byte_time: float,
        sent: Callable[[], None],
        lost: Callable[[OSError], None],
    ) -> None:
        self.byte_time = byte_time
        self.released: deque[float] = deque(maxlen=REMEMBERED)
        """Seconds from the end of the last bit to the release of the line, of the last frames.

        The end is calculated from the time of the write and the baud rate. An adapter may send later than that.
        """
        self._fd = descriptor
        self._settings = settings
        self._sent = sent
        self._lost = lost
        self._frames: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        # Two counters, each with one writer: the loop and the thread need no lock.
        self._given = self._taken = 0
        self._stopped = threading.Event()
        self._reports_empty = True
        self._thread = threading.Thread(target=self._run, name=f"RTS of descriptor {descriptor}", daemon=True)
        self._thread.start()

    @property
    def unwritten(self) -> int:
        """Return the number of bytes that were not written to the port yet."""
        return self._given - self._taken

    def send(self, data: bytes) -> None:
        """Send these bytes after all earlier ones. Returns immediately."""
        self._given += len(data)
        self._frames.put(data)

    def stop(self) -> None:
        """Write nothing more, and release the line. Returns immediately."""
        self._stopped.set()
        self._frames.put(b"")

    def join(self) -> None:
        """Wait until the thread no longer uses the port. Blocks while the driver blocks."""
        self._thread.join()

    def _run(self) -> None:
        try:
            while (data := self._frames.get()) and not self._stopped.is_set():
                self._send(data)
        except OSError as error:
            self._lost(error)
        finally:
            # Whatever happened: a transmitter that stays on blocks the line for all nodes.
            with contextlib.suppress(OSError):
                self._set(sending=False)

    def _send(self, data: bytes) -> None:
        self._set(sending=True)
        self._stopped.wait(self._settings.delay_before)
        # Before the write: a reply must never arrive while bytes count as unwritten.
        self._taken += len(data)
        self._write(data)
        end = time.monotonic() + len(data) * self.byte_time
        self._sent()
        self._wait_until_empty(end)
        self._stopped.wait(self._settings.delay_after)
        self._set(sending=False)
        self.released.append(time.monotonic() - end)

    def _set(self, *, sending: bool) -> None:
        set_rts(self._fd, self._settings.rts_while_sending is sending)

    def _write(self, data: bytes) -> None:
        writable = select.poll()  # select() fails above descriptor 1023
        writable.register(self._fd, select.POLLOUT)
        while data and not self._stopped.is_set():
            try:
                data = data[os.write(self._fd, data) :]
            except BlockingIOError:
                writable.poll(LOOK * 1000)

    def _wait_until_empty(self, end: float) -> None:
        """Wait until the last bit has left: first by the baud rate, then until the driver confirms it."""
        self._stopped.wait(max(0.0, end - time.monotonic()))
        # Not `tcdrain` alone: it looks only once in a tick of the kernel, 1 to 10 ms.
        while self._reports_empty and not self._stopped.is_set():
            state = array.array("I", [0])
            try:
                fcntl.ioctl(self._fd, TIOCSERGETLSR, state)
            except OSError:
                # Many USB adapters have no such query, and a pty does not.
                self._reports_empty = False
                break
            if state[0] & TEMT:
                return
            self._reports_empty = time.monotonic() < end + LATE_EMPTY
            self._stopped.wait(LOOK)
        if not self._stopped.is_set():
            try:
                termios.tcdrain(self._fd)
            except termios.error as error:
                raise OSError(*error.args) from None
