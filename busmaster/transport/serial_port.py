"""A serial port, based on pyserial and pyserial-asyncio, with workarounds for problems of the latter.

pyserial opens and configures the port. From pyserial-asyncio only these parts are used: registering reader and writer
with the loop, pausing and resuming reading, and the write buffer limits that pause the protocol. All parts that cost
time or hide errors are replaced:

- A write leaves immediately instead of one loop turn later.
- Reading does not use select(), which fails above descriptor 1023.
- Every loss is reported once, and never from within a write.
- Bytes with parity or framing errors are marked.
- Calls that can block (open, configure, drain, close) do not run on the loop's thread.

Each method of `PortTransport` gives its reason.
"""

from __future__ import annotations

import asyncio
import contextlib
import errno
import fcntl
import functools
import math
import os
import termios
import threading
import time
import warnings
from collections.abc import Callable, Hashable
from concurrent.futures import Future
from dataclasses import KW_ONLY, dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import serial
from serial.rs485 import RS485Settings

from busmaster.contract.arguments import Between
from busmaster.contract.profile import LineSettings
from busmaster.errors import InvalidCommand, LineDown
from busmaster.transport import identity
from busmaster.transport.identity import Identity, identify, is_pty, resolve
from busmaster.transport.marks import ESCAPE, MarkingSerial, Unescape, stop_marking, taker_of_marked_bytes
from busmaster.transport.own_thread import in_own_thread
from busmaster.transport.rs485 import Rs485, RtsSwitch, keep_lines_at_close, set_driver, set_rts, settings_of

if TYPE_CHECKING:

    class _SerialTransport(asyncio.Transport):
        """What we use of pyserial-asyncio, which has no types."""

        _loop: asyncio.AbstractEventLoop
        _protocol: asyncio.Protocol
        _serial: MarkingSerial
        _closing: bool
        _write_buffer: list[bytes]

        def __init__(
            self, loop: asyncio.AbstractEventLoop, protocol: asyncio.Protocol, serial_instance: MarkingSerial
        ) -> None: ...
        def _ensure_writer(self) -> None: ...
        def _remove_writer(self) -> None: ...
        def _remove_reader(self) -> None: ...
        def _maybe_pause_protocol(self) -> None: ...
        def _maybe_resume_protocol(self) -> None: ...
else:
    from serial_asyncio import SerialTransport as _SerialTransport

OPEN_DEADLINE = 10.0
"""Seconds after which an opening that does not return is given up."""
CLOSE_DEADLINE = 0.5
"""Seconds for which `close` waits for the driver. Then the port is reported as closed anyway."""
CLOSING_PATIENCE = 5.0
"""Seconds for which an opening waits for this program's own earlier closing of the device. A driver that holds unsent
bytes may take half a minute. The next attempt waits again."""
IN_USE = errno.EBUSY, errno.EAGAIN
"""The error of the driver's exclusive flag, and that of the lock."""
READ_SIZE = 448
"""Bytes per read, more than any frame has. Python allocates up to 512 bytes, including its own header, from its own
pool. A larger buffer costs a malloc, and a second one to shrink it."""


@dataclass(frozen=True, slots=True)
class SerialPort:
    """A serial port of this machine, or a pty. Raises InvalidCommand for invalid values.

    `path`: the path of the device or of a symbolic link to it, or "usb:SERIAL" for the USB adapter with this serial
    number under any name. If the adapter has several ports, use "usb:SERIAL:INTERFACE".
    """

    path: str
    """The device, a link to it, or `usb:SERIAL`."""
    _: KW_ONLY
    baudrate: Annotated[int, Between(1, self_checked=True)]
    """Baud rate. In LINE.toml the protocol's by default, if all nodes need the same."""
    bytesize: Annotated[int, Between(5, 8, self_checked=True)] = 8
    """Bits of a byte. In LINE.toml the protocol's by default."""
    parity: str = "N"
    """N, E, O, M or S. In LINE.toml the protocol's by default."""
    stopbits: float = 1
    """1, 1.5 or 2. In LINE.toml the protocol's by default."""
    rtscts: bool = False
    """Whether RTS and CTS control the flow of sent bytes."""
    rs485: Rs485 | RS485Settings | bool | None = None
    """Whether RTS switches the transmitter. `true`: the driver sets RTS high while sending. A table (in Python `Rs485`,
    or pyserial's `RS485Settings`) has levels and delays, and can have it switched by software."""
    echo: bool = False
    """Whether sent bytes are received too, as on some two-wire adapters. They are compared byte for byte."""
    low_latency: bool | None = None
    """Sets or clears the driver's flag of that name. Left alone by default."""
    receive_latency: Annotated[float, Between(0, unit="s", self_checked=True)] = 0.0
    """How long the adapter may hold bytes back: FTDI's latency timer, for example."""
    exclusive: bool = True
    """Whether other programs are kept from opening the port."""
    paced: bool | None = None
    """Whether bytes leave at the baud rate. By default they do for a serial device, and not for a pseudo-terminal."""

    def __post_init__(self) -> None:
        if not self.path:
            raise InvalidCommand("a serial port needs a path, such as /dev/ttyUSB0")
        if self.path == identity.USB:
            raise InvalidCommand("a USB adapter needs a serial number, such as usb:A500ABC")
        if not (math.isfinite(self.receive_latency) and self.receive_latency >= 0):
            raise InvalidCommand(f"receive_latency must be at least 0 s, not {self.receive_latency}")
        if not isinstance(self.rs485, bool):
            # pyserial's settings have no value of their own: two ports with the same ones would differ.
            object.__setattr__(self, "rs485", settings_of(self.rs485))
        # An adapter would switch its transmitter with the same line that is to stop it.
        if self.rtscts and self.rs485:
            raise InvalidCommand("rtscts and rs485 exclude each other: both drive the RTS line")
        LineSettings(self.baudrate, self.bytesize, self.parity, self.stopbits)

    @property
    def name(self) -> str:
        """Return its name in messages: its path."""
        return self.path

    @property
    def settings(self) -> LineSettings:
        """Return baud rate and framing."""
        return LineSettings(self.baudrate, self.bytesize, self.parity, self.stopbits)

    @property
    def rts(self) -> Rs485 | None:
        """Return how RTS switches the transmitter; None if it does not."""
        return settings_of(self.rs485)

    @property
    def send_delay(self) -> float:
        """Return the seconds for which each frame waits for the transmitter."""
        return 0.0 if self.rts is None else self.rts.delay_before

    def presence(self) -> Hashable | None:
        """Return a value that changes when the node at the path (possibly a symlink) changes.

        For a serial number it covers all ttys.
        """
        return identity.all_ttys() if self._by_serial else identity.node_at(self.path)

    def folders(self) -> tuple[str, ...]:
        """Return the folders in which an entry appears, or its permissions change, when the device returns."""
        return (str(identity.DEV),) if self._by_serial else identity.folders_to(self.path)

    @property
    def _by_serial(self) -> bool:
        return self.path.startswith(identity.USB)

    async def open(
        self, protocol_factory: Callable[[], asyncio.Protocol], only: Identity | None = None
    ) -> PortTransport:
        """Open and configure the port in a thread. Raises LineDown, after OPEN_DEADLINE at the latest."""
        if self.rts is not None and self.rts.by == "software":
            # Python shows it once for each port, however often that is opened again.
            warnings.warn(
                f"{self.path}: RTS is switched by software, which releases the line late on a busy machine: a reply "
                "that begins before that is damaged. `busmaster doctor` measures it; an adapter that switches by "
                "itself is safer",
                stacklevel=1,
            )
        # In a thread: an open() that hangs on a USB adapter would block every line of this loop.
        opening = in_own_thread(functools.partial(_open, self, only), f"open {self.path}")
        try:
            async with asyncio.timeout(OPEN_DEADLINE):
                device, paced, found = await asyncio.wrap_future(opening)
        except TimeoutError:
            opening.add_done_callback(functools.partial(_drop, self.exclusive))
            # with some drivers an opening does not return before the closing has ended
            if any(closing.name == self.path for closing in tuple(_closings)):
                raise _still_closing(self.path) from None
            raise LineDown(f"{self.path} did not open within {OPEN_DEADLINE:g} s", hint="replug the adapter") from None
        # The thread cannot be cancelled, so the port it opens later is released when it returns.
        except asyncio.CancelledError:
            opening.add_done_callback(functools.partial(_drop, self.exclusive))
            raise
        transport = PortTransport(asyncio.get_running_loop(), protocol_factory(), device, self, paced, found)
        try:
            await asyncio.sleep(0)  # connection_made is called in between
        except BaseException:
            transport.abort()
            raise
        return transport


class PortTransport(_SerialTransport):
    """pyserial-asyncio's transport, changed to write immediately, to report every loss, and never to block.

    A damaged byte is passed to the protocol's `byte_marked(byte, mark)`, in order with `data_received`, or to
    `data_received` if the protocol does not have that method.
    """

    def __init__(
        self,
        loop: asyncio.AbstractEventLoop,
        protocol: asyncio.Protocol,
        device: MarkingSerial,
        port: SerialPort,
        paced: bool,
        found: Identity,
    ) -> None:
        self._fd = device.fileno()
        self._escapes = Unescape()
        self._byte_marked = taker_of_marked_bytes(protocol)
        self._port = port
        self._paced = paced
        self._identity = found
        self._lost = False
        self._switch: RtsSwitch | None = None
        self._deadline: asyncio.TimerHandle | None = None
        device.is_open = False  # the base class sets timeouts, which would reconfigure an open port on the loop
        super().__init__(loop, protocol, device)
        # From here on settings may be changed: `tune` relies on it.
        device.is_open = True
        if port.rts is not None and port.rts.by == "software":
            self._switch = RtsSwitch(
                self._fd,
                port.rts,
                self._byte_time(port.settings),
                sent=lambda: self._call_soon(self._note_sent),
                lost=lambda error: self._call_soon(self._lose_once, error),
            )
        self.set_write_buffer_limits(high=0)  # R2: buffered bytes have not left, so any of them pauses the protocol

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        """Return pyserial's object for `serial`, the device's identity for `identity`.

        For `paced`, return whether bytes leave at the baud rate. For `delayed`, return whether RS-485 switching delays
        them. For `released`, return the seconds after which software released the line (see `RtsSwitch`), or None.
        """
        extra: dict[str, Any] = {
            "serial": self._serial,
            "paced": self._paced,
            "identity": self._identity,
            "delayed": self._port.rts is not None and self._port.rts.delay_before > 0,
            "released": None if self._switch is None else tuple(self._switch.released),
        }
        return extra.get(name, default)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self._port.name}{' closing' if self._closing else ''}>"

    async def tune(self, settings: LineSettings) -> None:
        """Change baud rate and framing of the open port. Raises LineDown if it does not accept them.

        For a pseudo-terminal, which has no framing, only the rate and odd parity are set.
        """
        change = functools.partial(_tune, self._port, self._serial, settings)
        await asyncio.wrap_future(in_own_thread(change, f"tune {self._port.path}"))
        if self._switch is not None:
            self._switch.byte_time = self._byte_time(settings)

    def get_write_buffer_size(self) -> int:
        """Return the number of bytes that the driver does not have yet."""
        return super().get_write_buffer_size() if self._switch is None else self._switch.unwritten

    def _read_ready(self) -> None:
        """Read from the descriptor: pyserial's read uses select(), which fails above descriptor 1023."""
        try:
            data = os.read(self._fd, READ_SIZE)
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(error)
            return
        if not data:  # VMIN is 1, so no data would raise BlockingIOError: an empty read is a hang-up
            self._lose(None)
        elif (ESCAPE in data or self._escapes.begun) and self._serial.marks:
            self._take_marked(data)
        else:
            self._protocol.data_received(data)

    def _take_marked(self, data: bytes) -> None:
        for piece, mark in self._escapes.take(data):
            if mark is None:
                self._protocol.data_received(piece)
            else:
                self._byte_marked(piece, mark)

    def write(self, data: bytes | bytearray | memoryview) -> None:
        """Write immediately if nothing is buffered. Otherwise bytes would leave one loop turn after their time
        stamp."""
        if self._closing:
            return  # the loss was already reported, or the port is being closed
        if self._switch is not None:
            self._switch.send(bytes(data))
            self._maybe_pause_protocol()
            return
        # Bytes must not overtake buffered ones.
        if not self._write_buffer:
            try:
                sent = os.write(self._fd, data)
            # The driver's buffer is full, so all bytes are kept.
            except BlockingIOError:
                sent = 0
            except OSError as error:
                self._lose(error)
                return
            if sent == len(data):
                return
            data = data[sent:]
            self._ensure_writer()
        self._write_buffer.append(bytes(data))
        self._maybe_pause_protocol()

    def _write_ready(self) -> None:
        data = b"".join(self._write_buffer)
        try:
            # All buffered pieces in one call: a request in two writes would have a pause in it.
            sent = os.write(self._fd, data)
        except BlockingIOError:
            return
        except OSError as error:
            self._lose(error)
            return
        # In place: the base class holds the same list.
        self._write_buffer[:] = [data[sent:]] if sent < len(data) else []
        if not self._write_buffer:
            self._remove_writer()
            self._maybe_resume_protocol()

    def close(self) -> None:
        """Discard unsent bytes, close the device in a thread, then call `connection_lost(None)`.

        The call comes after CLOSE_DEADLINE at the latest: a blocked line never drains, and a driver may wait for it.
        """
        if self._closing:
            return
        # Detached first: no byte may be delivered after the call of close().
        closed = self._detach()
        self._deadline = self._loop.call_later(CLOSE_DEADLINE, self._report, None)
        asyncio.wrap_future(closed, loop=self._loop).add_done_callback(lambda _: self._report(None))

    def abort(self) -> None:
        """Close without waiting for the device."""
        if not self._closing:
            self._detach()
        self._loop.call_soon(self._report, None)

    def _lose(self, error: OSError | None) -> None:
        """Handle a lost port. The protocol is notified at the loop's next turn, never within its own `write`."""
        self._detach()
        why = "it hung up" if error is None or error.errno == errno.EIO else error.strerror
        cause = LineDown(f"{self._port.name} was lost: {why}", hint="")
        # Deferred: the protocol may be inside its own write(), during which its state must not change.
        self._loop.call_soon(self._report, cause)

    def _byte_time(self, settings: LineSettings) -> float:
        return settings.byte_time if self._paced else 0.0

    def _call_soon(self, call: Callable[..., None], *arguments: object) -> None:
        """Call it on the loop, from the thread of the switch."""
        with contextlib.suppress(RuntimeError):  # the loop was closed
            self._loop.call_soon_threadsafe(call, *arguments)

    def _note_sent(self) -> None:
        if not self._closing:
            self._maybe_resume_protocol()

    def _lose_once(self, error: OSError) -> None:
        if not self._closing:
            self._lose(error)

    def _detach(self) -> Future[None]:
        self._closing = True
        if self._switch is not None:
            self._switch.stop()
        self._remove_reader()
        self._remove_writer()
        # Unsent bytes must not leave later: a request that is that old could move a machine unexpectedly.
        self._write_buffer.clear()
        # By device number: the next opening may use another name of the same device.
        closing = _Closing(self._port.path, os.fstat(self._fd).st_rdev)
        _closings.add(closing)  # before the thread starts, which removes it

        def release() -> None:
            try:
                if self._switch is not None:
                    # Otherwise its last query could reach a port that gets this descriptor next.
                    _discard_output(self._fd)
                    self._switch.join()
                _release(self._serial, self._port.exclusive)
            finally:
                _closings.discard(closing)
                closing.over.set()

        return in_own_thread(release, f"close {self._port.path}")

    def _report(self, cause: LineDown | None) -> None:
        if self._deadline is not None:
            self._deadline.cancel()
        if not self._lost:
            self._lost = True
            self._protocol.connection_lost(cause)


class _Closing:
    """A closing that may take longer than CLOSE_DEADLINE. The device with this number is locked until it has ended."""

    __slots__ = ("name", "number", "over")

    def __init__(self, name: str, number: int) -> None:
        self.name = name
        self.number = number
        self.over = threading.Event()


_closings: set[_Closing] = set()
"""All running closings. Changed by the loop and by the closing threads, with atomic operations only."""


def _still_closing(path: str) -> LineDown:
    return LineDown(
        f"this program is still closing {path}: its driver holds unsent bytes",
        hint="it can be opened after that; if that does not end, check CTS, replug the adapter",
    )


def _own_closing(path: str) -> _Closing | None:
    """Return the running closing of the device at this path, or None."""
    with contextlib.suppress(OSError):
        # The path may be gone, for example after an adapter was unplugged.
        number = os.stat(path).st_rdev
        return next((closing for closing in tuple(_closings) if closing.number == number), None)
    return None


def _names_pty(path: str) -> bool:
    """Return True for a pseudo-terminal. False if the path does not exist: opening it reports that."""
    try:
        return is_pty(path)
    except OSError:
        return False


def _open(port: SerialPort, only: Identity | None) -> tuple[MarkingSerial, bool, Identity]:
    """Open and configure the device. Also returns whether it is paced, and its identity. Blocks. Raises LineDown."""
    scan = identity.Scan()
    # One scan of the ttys for both: a replug between two scans could make them disagree.
    port = replace(port, path=resolve(port.path, scan))
    found = _found(port, only, scan)
    device = MarkingSerial()
    device.port = port.path
    device.baudrate, device.stopbits = port.baudrate, port.stopbits
    if not _names_pty(port.path):  # a pty stays at 8N1, and the C library reports a change without effect as an error
        device.bytesize, device.parity = port.bytesize, port.parity
    device.rtscts = port.rtscts
    if port.rts is not None:
        # pyserial raises RTS when it opens a port: the transmitter would block the line until the first request.
        device.rts = not port.rts.rts_while_sending
    # None and not False: pyserial would release a lock that it does not have.
    device.exclusive = True if port.exclusive else None
    # Non-blocking: only the loop waits for this port.
    device.timeout = device.write_timeout = 0
    device.inter_byte_timeout = 0  # sets VMIN to 1, so that an empty read means a hang-up and nothing else
    try:
        _open_device(device, port.path)
    except (OSError, ValueError, termios.error) as error:
        if isinstance(error, LineDown):
            raise
        raise _refusal(port, error) from None
    try:
        # The name may have been given to another adapter between the check and the open.
        if not found.is_behind(device.fileno()):
            raise LineDown(f"{port.path} was replaced by another device while it was opened", hint="try again")
        _equip(port, device)
        return device, (not is_pty(device.fileno()) if port.paced is None else port.paced), found
    except BaseException as error:
        _release(device, port.exclusive)
        if isinstance(error, OSError | termios.error) and not isinstance(error, LineDown):
            raise _refusal(port, error) from None
        raise


def _open_device(device: MarkingSerial, path: str) -> None:
    """Open the device, and retry if only an own closing was in the way. Raises LineDown and pyserial's errors."""
    until = time.monotonic() + CLOSING_PATIENCE
    while True:
        closing = _own_closing(path)  # read before the attempt: if the closing ends during it, the device is free
        try:
            device.open()
            return
        except (OSError, termios.error) as error:
            # Another program's lock is not worth a wait: it may be held for months.
            if closing is None or _code(error) not in IN_USE:
                raise
        if not closing.over.wait(until - time.monotonic()):
            raise _still_closing(path)


def _found(port: SerialPort, only: Identity | None, scan: identity.Scan) -> Identity:
    """Return the identity of the device with this name. Raises LineDown, before touching it, if it is not `only`."""
    try:
        found = identify(port.path, scan)
    except OSError as error:
        raise _refusal(port, error) from None
    if only is not None and not only.accepts(found):
        raise LineDown(f"{port.path} is now {found}, the line was opened on {only}", hint=only.advice)
    return found


def _equip(port: SerialPort, device: serial.Serial) -> None:
    """Set options that only some drivers support, if requested. Raises LineDown if they are rejected."""
    if port.exclusive:  # flock is advisory, and TIOCEXCL does not stop root: only both together exclude other programs
        fcntl.ioctl(device.fileno(), termios.TIOCEXCL)
    # Only if the user sets it: most adapters reject the ioctl, and a pty has none (ENOTTY).
    if port.rts is not None:
        _equip_rts(port.path, port.rts, device.fileno())
    if port.low_latency is not None:
        try:
            device.set_low_latency_mode(port.low_latency)
        except ValueError:
            raise LineDown(
                f"the driver of {port.path} has no low-latency flag",
                hint="leave low_latency out; `busmaster doctor` shows what the adapter does",
            ) from None


def _equip_rts(path: str, rts: Rs485, descriptor: int) -> None:
    if rts.by == "software":
        try:
            set_rts(descriptor, not rts.rts_while_sending)
        except OSError:
            hint = "leave rs485 out: without RTS only the adapter itself can switch direction"
            raise LineDown(f"the driver of {path} has no RTS line", hint=hint) from None
        if not rts.rts_while_sending:
            # A closed port has RTS low, which would leave the transmitter on.
            keep_lines_at_close(descriptor)
        return
    hint = 'leave rs485 out: most adapters switch direction by themselves; for one that needs RTS: by = "software"'
    try:
        refused = set_driver(descriptor, rts)
    except OSError:
        raise LineDown(f"the driver of {path} has no RS-485 mode", hint=hint) from None
    if refused:
        raise LineDown(
            f"the driver of {path} does not take this setting of its RS-485 mode: {refused}",
            hint='leave that setting out, or use by = "software"',
        )


def _tune(port: SerialPort, device: serial.Serial, settings: LineSettings) -> None:
    wanted: dict[str, object] = {"baudrate": settings.baudrate, "stopbits": settings.stopbits}
    if is_pty(device.fileno()):
        # See `_open`: the C library reports an error for settings that a pty ignores.
        wanted["parity"] = "O" if settings.parity == "O" else "N"
    else:
        wanted |= {"bytesize": settings.bytesize, "parity": settings.parity}
    try:
        device.apply_settings(wanted)
    except (OSError, ValueError, termios.error):
        raise LineDown(f"{port.path} does not take {settings.baudrate} baud, {settings.framing}") from None


def _refusal(port: SerialPort, error: Exception) -> LineDown:
    """Return the error for a port that could not be opened, with a hint."""
    path, code = port.path, _code(error)
    if code in IN_USE:
        # Not at the start of the function: an import fails if there is no free descriptor.
        from busmaster.transport import holders

        # The name of the other program saves a search: nearly always it is a second instance of the same one.
        owner = holders.lock_owner(path) or next(iter(holders.holders(path)), "another program")
        return LineDown(
            f"{path} is in use by {owner}", hint="end that first: two masters on one line garble each other"
        )
    if code == errno.ENOENT:
        target = f": it points to {os.readlink(path)}, which is gone" if os.path.islink(path) else ""
        return LineDown(
            f"{path} does not exist{target}",
            hint="plug it in or start its emulator, or see `python -m serial.tools.list_ports`",
        )
    if code in (errno.EACCES, errno.EPERM):
        from busmaster.transport import holders

        return LineDown(f"no permission to open {path}", hint=holders.how_to_open(path))
    if isinstance(error, ValueError):
        return LineDown(f"{path} does not take {port.baudrate} baud, {port.settings.framing}", hint="use another rate")
    if code in (errno.EIO, errno.ENXIO, errno.ENODEV):
        return LineDown(f"there is no hardware behind {path}", hint="see `python -m serial.tools.list_ports`")
    if code in (errno.ENOTTY, errno.EISDIR):
        return LineDown(f"{path} is not a serial port", hint="see `python -m serial.tools.list_ports`")
    return LineDown(f"cannot open {path}: {error if code is None else os.strerror(code)}")


def _code(error: Exception) -> int | None:
    """Return the errno of a pyserial error, which hides some in its text; None if there is none."""
    # pyserial raises SerialException without an errno from within the handler of the original error.
    for raised in (error, error.__context__):
        if isinstance(raised, termios.error):
            return int(raised.args[0])
        if isinstance(raised, OSError) and raised.errno is not None:
            return raised.errno
    return None


def _release(device: serial.Serial, exclusive: bool) -> None:
    """Discard unsent bytes, release the locks (they would remain on a pty that stays open), and close.

    The flags are restored too, unless another program may be using the port with them.
    """
    # Otherwise the close waits until the bytes have left: with flow control off, up to 30 s by the driver's default.
    with contextlib.suppress(serial.SerialException):
        _discard_output(device.fileno())
    if exclusive:
        # Only with exclusive use: a second program with the port open still needs its flags.
        stop_marking(device.fileno())
        with contextlib.suppress(OSError):
            fcntl.ioctl(device.fileno(), termios.TIOCNXCL)
        with contextlib.suppress(OSError):
            fcntl.flock(device.fileno(), fcntl.LOCK_UN)
    with contextlib.suppress(OSError):
        device.close()


def _discard_output(descriptor: int) -> None:
    with contextlib.suppress(OSError, termios.error):
        termios.tcflush(descriptor, termios.TCOFLUSH)


def _drop(exclusive: bool, opening: Future[tuple[MarkingSerial, bool, Identity]]) -> None:
    """Release a port that was opened after its caller had stopped waiting."""
    if not opening.cancelled() and opening.exception() is None:
        device, *_ = opening.result()
        _release(device, exclusive)
