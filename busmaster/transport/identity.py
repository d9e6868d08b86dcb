"""Identity of the device behind a port's name: another device can get the same name, but must not be opened (R13).

Linux only. Must not run on an event loop: reading from a USB device blocks while the kernel resets it.
"""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Protocol

from busmaster.errors import LineDown

SYS = Path("/sys")
"""Where the kernel describes its devices."""
DEV = Path("/dev")
"""Folder of the device nodes."""
LINKS = Path("/dev/serial")
"""Folder of udev's permanent names: by-id, by-path."""
USB = "usb:"
"""Prefix of a name by serial number, with an optional interface: usb:A500ABC, usb:A500ABC:1."""

MOST_LINKS = 40
"""Maximum number of symbolic links in a path, as in the kernel."""
LEVELS = "", "/..", "/../..", "/../../.."
"""Relative paths from the kernel's device of a tty up to its USB interface. CDC adapters have the tty at the interface,
all others one level below, those behind another driver (HID) two or more."""
UNIX98_PTYS = range(136, 144)
BSD_PTYS = 3
"""The major device numbers of Linux's pseudo-terminals (Documentation/admin-guide/devices.txt)."""


class Identity(Protocol):
    """Identity of one device. `str` returns its name in messages."""

    @property
    def advice(self) -> str:
        """Hint if another device has its name."""
        ...

    def accepts(self, found: Identity) -> bool:
        """Return True if `found` is the same device after its return."""
        ...

    def is_behind(self, descriptor: int) -> bool:
        """Return True if this open port is this device. Raises OSError if it has just disappeared."""
        ...


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """One serial port of a USB adapter, as described by the kernel.

    `kind`: "vendor:product". `serial`: serial number of the adapter, or "". `number`: number of the port on the
    interface. `place`: physical USB port of the adapter, such as 1-1.2.
    """

    path: str
    maker: str
    kind: str
    serial: str
    interface: int
    number: int
    place: str


@dataclass(frozen=True, slots=True)
class UsbIdentity:
    """A port of a USB adapter, identified by its serial number, or by its USB port if it has no unique serial number.

    `alone`: no other connected adapter has this serial number (some cheap ones all have the same).
    """

    device: UsbDevice
    alone: bool

    def __str__(self) -> str:
        device = self.device
        text = f"{device.maker} {device.serial}".rstrip()
        if device.interface or device.number:
            text += f" interface {device.interface}" + (f" port {device.number}" if device.number else "")
        # Cheap adapters have all the same serial number, or none: then only the place distinguishes them.
        return text if device.serial and self.alone else f"{text} at USB port {device.place}"

    @property
    def advice(self) -> str:
        if self.device.serial and self.alone:
            name = f"{USB}{self.device.serial}" + (f":{self.device.interface}" if self.device.interface else "")
            return f"name it {name}, which finds it at any USB port, or restart to use the other device"
        return f"plug it in at {self.device.place} again, or restart to use the other device"

    def accepts(self, found: Identity) -> bool:
        if not isinstance(found, UsbIdentity) or _marks(self.device) != _marks(found.device):
            return False
        # Both: the second adapter with the same number may have been plugged in since.
        known_by_serial = bool(self.device.serial) and self.alone and found.alone
        return known_by_serial or self.device.place == found.device.place

    def is_behind(self, descriptor: int) -> bool:
        return usb_device(os.fstat(descriptor).st_rdev) == self.device


class PtyIdentity:
    """A pseudo-terminal, and the symbolic links that lead to it.

    When it disappears, the next one gets its number and with it its inode number, and a chmod changes its times. So its
    node is kept open: a node that is still in its folder is the same. The open descriptor keeps neither the
    pseudo-terminal nor its number in use.
    """

    advice = "restart to use the other device, or use a symbolic link as the port's name: it is followed when recreated"

    _node = -1

    def __init__(self, path: str) -> None:
        self._node = os.open(path, os.O_PATH)
        # A program that makes a new pty and sets its link anew means the new one (socat, for example).
        self._links = tuple(_links(path))
        # For messages: the name of a pseudo-terminal does not distinguish it from the next one.
        self._made = datetime.fromtimestamp(os.fstat(self._node).st_ctime, UTC)

    def __del__(self) -> None:
        if self._node >= 0:
            os.close(self._node)

    def __str__(self) -> str:
        return f"the pseudo-terminal made at {self._made:%Y-%m-%dT%H:%M:%S}.{self._made.microsecond // 1000:03d}Z"

    def accepts(self, found: Identity) -> bool:
        """Accept the same node, or a symbolic link that was created anew. An old link to a new node is not accepted."""
        if not isinstance(found, PtyIdentity):
            return False
        made_anew = found._links != self._links and found._links != ()
        return made_anew or found.is_behind(self._node)

    def is_behind(self, descriptor: int) -> bool:
        node = os.fstat(descriptor)
        # 0 links: its other end was closed, and the node is no longer in its folder.
        return node.st_nlink > 0 and os.path.samestat(os.fstat(self._node), node)


@dataclass(frozen=True, slots=True)
class TtyIdentity:
    """A port at a fixed place (a UART on the board, a card): its name and its device number."""

    path: str
    number: int

    advice = "restart to use the other device"

    def __str__(self) -> str:
        return f"{self.path} ({os.major(self.number)}:{os.minor(self.number)})"

    def accepts(self, found: Identity) -> bool:
        return found == self

    def is_behind(self, descriptor: int) -> bool:
        return os.fstat(descriptor).st_rdev == self.number


class Scan:
    """The connected USB serial ports, read at most once and only if needed.

    One attempt to open a port needs them several times, and each scan opens eight files per adapter.
    """

    @cached_property
    def devices(self) -> list[UsbDevice]:
        """All of them, sorted by name."""
        return usb_devices()


def resolve(name: str, scan: Scan | None = None) -> str:
    """Return the path of the device that a port's name stands for now.

    The name itself, unless it is usb:SERIAL or usb:SERIAL:INTERFACE. Raises LineDown with a list of connected ports.
    """
    if not name.startswith(USB):
        return name
    wanted = name.removeprefix(USB)
    scan = scan or Scan()
    there = scan.devices
    # Both readings are tried below, the whole text as a serial number first.
    serial, _, interface = wanted.rpartition(":")  # a serial number may contain colons
    numbered = (serial, int(interface)) if interface.isdecimal() else None
    found = [device for device in there if device.serial == wanted] or [
        device for device in there if (device.serial, device.interface) == numbered
    ]
    match found:
        case [device]:
            return device.path
        case []:
            # The list saves the user a search: serial numbers are seldom printed on adapters.
            others = f"connected: {_listed(there, scan)}" if there else "no USB serial port was found"
            raise LineDown(f"{name} is not plugged in: {others}", hint="plug it in, or use one of the connected ports")
        case _:
            raise LineDown(f"{name} could be any of {_listed(found, scan)}", hint="use one of these names")


def identify(path: str, scan: Scan | None = None) -> Identity:
    """Return the identity of the device with this name. Raises OSError if it does not exist or disappears."""
    status = os.stat(path)
    device = usb_device(status.st_rdev)
    if device is not None:
        there = (scan or Scan()).devices
        return UsbIdentity(device, alone=not any(_is_double(device, other) for other in there))
    if is_pty(path):
        return PtyIdentity(path)
    # If the kernel describes devices, one without a description has just disappeared.
    if stat.S_ISCHR(status.st_mode) and entry(status.st_rdev).parent.is_dir() and not entry(status.st_rdev).exists():
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV), path)
    return TtyIdentity(os.path.realpath(path), status.st_rdev)


def lasting_name(device: UsbDevice, scan: Scan | None = None) -> str:
    """Return a name that this adapter keeps whatever else is connected; "" if there is none."""
    alike = [other for other in (scan or Scan()).devices if other.serial == device.serial]
    if device.serial and len(alike) == 1:
        return f"{USB}{device.serial}"
    if device.serial and sum(other.interface == device.interface for other in alike) == 1:
        return f"{USB}{device.serial}:{device.interface}"
    double = any(_is_double(device, other) for other in alike)
    return _link(device.path, "by-id" if device.serial and not double else "by-path")


def usb_device(number: int) -> UsbDevice | None:
    """Return the USB serial port with this device number, or None. Raises OSError if it disappears."""
    return _described(str(entry(number)))


def usb_devices() -> list[UsbDevice]:
    """Return all connected USB serial ports, sorted by name."""
    try:
        names = sorted(os.listdir(SYS / "class/tty"))
    except OSError:
        return []
    return [device for name in names if (device := _described_if_there(f"{SYS}/class/tty/{name}")) is not None]


def all_ttys() -> Hashable | None:
    """Return a value that changes when a tty appears or its permissions change, without reading from any device.

    The kernel describes an adapter before its node exists, and udev sets the node's group later still. Only then can a
    program without root permissions open it. None if the kernel describes no ttys.
    """
    try:
        names = sorted(os.listdir(SYS / "class/tty"))
    except OSError:
        return None
    # The kernel writes "!" for the "/" of a name such as usb/tty0.
    return tuple((name, node_at(f"{DEV}/{name.replace('!', '/')}")) for name in names)


def node_at(path: str) -> Hashable | None:
    """Return a value that distinguishes the node at this path from the next one; None if there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    # With the time: a pty that is closed and made again can get the same numbers.
    return status.st_dev, status.st_ino, status.st_rdev, status.st_ctime_ns


def folders_to(path: str) -> tuple[str, ...]:
    """Return the folders in which an entry changes when a device appears at this path, through symbolic links or not.

    A missing folder is replaced by its nearest existing parent: udev removes /dev/serial with its last link.
    """
    found: list[str] = []
    while len(found) < MOST_LINKS:
        folder = os.path.realpath(os.path.dirname(path))
        while not os.path.isdir(folder):
            folder = os.path.dirname(folder)
        # Each link on the path: udev replaces /dev/serial/by-id/NAME, while /dev/ttyUSB0 stays the same name.
        found.append(folder)
        try:
            path = os.path.join(os.path.dirname(path), os.readlink(path))
        except OSError:
            break
    return tuple(dict.fromkeys(found))


def is_pty(device: int | str) -> bool:
    """Return True for a pseudo-terminal, by its device number: a name can be a symlink to anything."""
    major = os.major(os.stat(device).st_rdev)
    return major in UNIX98_PTYS or major == BSD_PTYS


def entry(number: int) -> Path:
    """Return where the kernel describes the device with this number. Pseudo-terminals are not described."""
    return SYS / f"dev/char/{os.major(number)}:{os.minor(number)}"


def _described(tty: str) -> UsbDevice | None:
    """Return the USB serial port described in this folder; None for other ttys.

    Paths are text here, and the kernel follows their links: pathlib and realpath took half of the time of a scan.
    """
    port = f"{tty}/device"
    interface = next((f"{port}{up}" for up in LEVELS if os.path.exists(f"{port}{up}/bInterfaceNumber")), None)
    if interface is None:
        return None
    adapter = f"{interface}/.."
    settings = dict(line.split("=", 1) for line in _read(f"{tty}/uevent").splitlines())
    maker = _optional(f"{adapter}/manufacturer") or _optional(f"{adapter}/product")
    serial, number = _optional(f"{adapter}/serial"), _optional(f"{port}/port_number")
    kind = ":".join(_read(f"{adapter}/{name}") for name in ("idVendor", "idProduct"))
    # the mandatory files were read last: if the adapter had disappeared, an error would have been raised
    return UsbDevice(
        path=f"{DEV}/{settings['DEVNAME']}",
        maker=maker or kind,
        kind=kind,
        serial=serial,
        interface=int(_read(f"{interface}/bInterfaceNumber"), 16),
        number=int(number or 0),
        place=os.path.basename(os.path.realpath(adapter, strict=True)),
    )


def _described_if_there(tty: str) -> UsbDevice | None:
    try:
        return _described(tty)
    except OSError:
        return None


def _read(attribute: str) -> str:
    with open(attribute, errors="replace") as file:
        return file.read().strip()


def _optional(attribute: str) -> str:
    try:
        return _read(attribute)
    except FileNotFoundError:
        return ""


def _marks(device: UsbDevice) -> tuple[str, str, int, int]:
    return device.kind, device.serial, device.interface, device.number


def _is_double(device: UsbDevice, other: UsbDevice) -> bool:
    """Return True if these are two adapters with the same serial number."""
    return (device.kind, device.serial) == (other.kind, other.serial) and device.place != other.place


def _listed(devices: list[UsbDevice], scan: Scan) -> str:
    named = ((lasting_name(device, scan) or "one without a lasting name", device.path) for device in devices)
    return ", ".join(f"{name} ({path})" for name, path in named)


def _link(path: str, folder: str) -> str:
    try:
        names = sorted(os.listdir(LINKS / folder))
    except OSError:
        return ""
    links = (str(LINKS / folder / name) for name in names)
    return next((link for link in links if os.path.realpath(link) == os.path.realpath(path)), "")


def _links(path: str) -> Iterator[tuple[int, int, int]]:
    """Yield a value for each symbolic link on the path that changes if the link is created anew."""
    while os.path.islink(path):
        link = os.lstat(path)
        yield link.st_dev, link.st_ino, link.st_ctime_ns
        path = os.path.join(os.path.dirname(path), os.readlink(path))
