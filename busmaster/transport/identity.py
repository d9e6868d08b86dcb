"""Which device stands behind the name of a port: names go to whoever comes next, a line does not (R13).

Linux only. Nothing here may run on a loop: whoever reads of a USB device waits while the kernel resets it.
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
"""Where the nodes of the devices are."""
LINKS = Path("/dev/serial")
"""Where udev keeps lasting names: by-id, by-path."""
USB = "usb:"
"""Begins a name that is a serial number, and perhaps an interface: usb:A500ABC, usb:A500ABC:1."""

MOST_LINKS = 40
"""Symbolic links on one way, as many as the kernel follows."""
LEVELS = "", "/..", "/../..", "/../../.."
"""From what the kernel calls a tty's device up to the USB interface that it is a part of: CDC adapters have the tty at
the interface, all others one level below, those behind another driver (HID) two or more."""
UNIX98_PTYS = range(136, 144)
BSD_PTYS = 3
"""The major device numbers of Linux's pseudo-terminals (Documentation/admin-guide/devices.txt)."""


class Identity(Protocol):
    """One device, told from every other. `str` is how messages call it."""

    @property
    def advice(self) -> str:
        """What to try where another device has its name."""
        ...

    def accepts(self, found: Identity) -> bool:
        """Return whether `found` is this device, come back."""
        ...

    def is_behind(self, descriptor: int) -> bool:
        """Return whether this open port is this device. Raises OSError if it has just gone."""
        ...


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """One serial port of a USB adapter, as the kernel describes it.

    `kind` is "vendor:product", `serial` the adapter's serial number or "", `number` tells several ports on one
    interface apart, `place` is the physical USB port that it is plugged in to, such as 1-1.2.
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
    """A port of a USB adapter, known by its serial number, or by where it is plugged in if it has none of its own.

    `alone`: no other adapter that is plugged in has this serial number (cheap ones have all the same).
    """

    device: UsbDevice
    alone: bool

    def __str__(self) -> str:
        device = self.device
        text = f"{device.maker} {device.serial}".rstrip()
        if device.interface or device.number:
            text += f" interface {device.interface}" + (f" port {device.number}" if device.number else "")
        return text if device.serial and self.alone else f"{text} at USB port {device.place}"

    @property
    def advice(self) -> str:
        if self.device.serial and self.alone:
            name = f"{USB}{self.device.serial}" + (f":{self.device.interface}" if self.device.interface else "")
            return f"name it {name}, which finds it wherever it is, or restart to go on with the other"
        return f"plug it in at {self.device.place} again, or restart to go on with the other"

    def accepts(self, found: Identity) -> bool:
        if not isinstance(found, UsbIdentity) or _marks(self.device) != _marks(found.device):
            return False
        known_by_serial = bool(self.device.serial) and self.alone and found.alone
        return known_by_serial or self.device.place == found.device.place

    def is_behind(self, descriptor: int) -> bool:
        return usb_device(os.fstat(descriptor).st_rdev) == self.device


class PtyIdentity:
    """A pseudo-terminal, and the symbolic links by which it was found.

    Its number, and with that its inode number, go to the next one when it is gone, and a chmod changes its times. So
    its node is held: a node that is still in its folder is still the same. Holding it keeps neither it nor its
    number in use.
    """

    advice = "restart to go on with the other, or name it by a symbolic link, which is followed when it is made anew"

    _node = -1

    def __init__(self, path: str) -> None:
        self._node = os.open(path, os.O_PATH)
        self._links = tuple(_links(path))
        self._made = datetime.fromtimestamp(os.fstat(self._node).st_ctime, UTC)

    def __del__(self) -> None:
        if self._node >= 0:
            os.close(self._node)

    def __str__(self) -> str:
        return f"the pseudo-terminal made at {self._made:%Y-%m-%dT%H:%M:%S}.{self._made.microsecond // 1000:03d}Z"

    def accepts(self, found: Identity) -> bool:
        """Accept a link that was made anew: it vouches for what it leads to; one left behind by the dead does not."""
        if not isinstance(found, PtyIdentity):
            return False
        made_anew = found._links != self._links and found._links != ()
        return made_anew or found.is_behind(self._node)

    def is_behind(self, descriptor: int) -> bool:
        node = os.fstat(descriptor)
        return node.st_nlink > 0 and os.path.samestat(os.fstat(self._node), node)


@dataclass(frozen=True, slots=True)
class TtyIdentity:
    """A port that stays where it is (a UART on the board, a card): its name and its device number."""

    path: str
    number: int

    advice = "restart to go on with the other"

    def __str__(self) -> str:
        return f"{self.path} ({os.major(self.number)}:{os.minor(self.number)})"

    def accepts(self, found: Identity) -> bool:
        return found == self

    def is_behind(self, descriptor: int) -> bool:
        return os.fstat(descriptor).st_rdev == self.number


class Scan:
    """The USB serial ports that are plugged in, read at most once, when they are first needed.

    One attempt to open a port asks for them several times. Each reading opens eight files per adapter.
    """

    @cached_property
    def devices(self) -> list[UsbDevice]:
        """All of them, in the order of their names."""
        return usb_devices()


def resolve(name: str, scan: Scan | None = None) -> str:
    """Return the path of the device that a port's name stands for now.

    That is the name itself, unless it is usb:SERIAL or usb:SERIAL:INTERFACE. Raises LineDown, saying what is there.
    """
    if not name.startswith(USB):
        return name
    wanted = name.removeprefix(USB)
    scan = scan or Scan()
    there = scan.devices
    serial, _, interface = wanted.rpartition(":")  # a serial number may have colons of its own
    numbered = (serial, int(interface)) if interface.isdecimal() else None
    found = [device for device in there if device.serial == wanted] or [
        device for device in there if (device.serial, device.interface) == numbered
    ]
    match found:
        case [device]:
            return device.path
        case []:
            others = f"there is {_listed(there, scan)}" if there else "no USB serial port was found"
            raise LineDown(f"{name} is not plugged in: {others}", hint="plug it in, or use one that is there")
        case _:
            raise LineDown(f"{name} could be any of {_listed(found, scan)}", hint="say which, by one of these names")


def identify(path: str, scan: Scan | None = None) -> Identity:
    """Return which device has this name now. Raises OSError where there is none, or it goes away meanwhile."""
    status = os.stat(path)
    device = usb_device(status.st_rdev)
    if device is not None:
        there = (scan or Scan()).devices
        return UsbIdentity(device, alone=not any(_is_double(device, other) for other in there))
    if is_pty(path):
        return PtyIdentity(path)
    # Where the kernel describes devices at all, one that it does not describe has just gone.
    if stat.S_ISCHR(status.st_mode) and entry(status.st_rdev).parent.is_dir() and not entry(status.st_rdev).exists():
        raise OSError(errno.ENODEV, os.strerror(errno.ENODEV), path)
    return TtyIdentity(os.path.realpath(path), status.st_rdev)


def lasting_name(device: UsbDevice, scan: Scan | None = None) -> str:
    """Return a name that stays this adapter's whatever else is plugged in; "" where it can have none."""
    alike = [other for other in (scan or Scan()).devices if other.serial == device.serial]
    if device.serial and len(alike) == 1:
        return f"{USB}{device.serial}"
    if device.serial and sum(other.interface == device.interface for other in alike) == 1:
        return f"{USB}{device.serial}:{device.interface}"
    double = any(_is_double(device, other) for other in alike)
    return _link(device.path, "by-id" if device.serial and not double else "by-path")


def usb_device(number: int) -> UsbDevice | None:
    """Return the USB serial port with this device number; None if that is no such port. Raises OSError as it goes."""
    return _described(str(entry(number)))


def usb_devices() -> list[UsbDevice]:
    """Return all USB serial ports that are plugged in now, in the order of their names."""
    try:
        names = sorted(os.listdir(SYS / "class/tty"))
    except OSError:
        return []
    return [device for name in names if (device := _described_if_there(f"{SYS}/class/tty/{name}")) is not None]


def all_ttys() -> Hashable | None:
    """Return what is seen of all ttys without reading of any device: it changes when one comes, or its rights change.

    The kernel describes an adapter before its node exists, and udev gives the node its group later still. A program
    without root's rights can open it only then. None where the kernel describes no ttys.
    """
    try:
        names = sorted(os.listdir(SYS / "class/tty"))
    except OSError:
        return None
    return tuple((name, node_at(f"{DEV}/{name.replace('!', '/')}")) for name in names)


def node_at(path: str) -> Hashable | None:
    """Return what tells the node that this path leads to from the next one; None where there is none."""
    try:
        status = os.stat(path)
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_rdev, status.st_ctime_ns


def folders_to(path: str) -> tuple[str, ...]:
    """Return the folders in which something changes when a device comes to this path, by way of symbolic links or not.

    In place of a folder that does not exist it is the nearest one above: udev removes /dev/serial with its last link.
    """
    found: list[str] = []
    while len(found) < MOST_LINKS:
        folder = os.path.realpath(os.path.dirname(path))
        while not os.path.isdir(folder):
            folder = os.path.dirname(folder)
        found.append(folder)
        try:
            path = os.path.join(os.path.dirname(path), os.readlink(path))
        except OSError:
            break
    return tuple(dict.fromkeys(found))


def is_pty(device: int | str) -> bool:
    """Tell a pseudo-terminal by the device number of a descriptor or a path: a name can be a symlink to anything."""
    major = os.major(os.stat(device).st_rdev)
    return major in UNIX98_PTYS or major == BSD_PTYS


def entry(number: int) -> Path:
    """Return where the kernel describes the device with this number; a pseudo-terminal is not there."""
    return SYS / f"dev/char/{os.major(number)}:{os.minor(number)}"


def _described(tty: str) -> UsbDevice | None:
    """Return the USB serial port that is described in this folder; None for a tty that is none.

    Paths are text here, and the kernel follows the links in them: pathlib and realpath took half of the time of a scan.
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
    return UsbDevice(  # what must be there was read last: had the adapter gone, this would not be reached
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
    """Return whether these are two adapters that claim the same serial number."""
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
    """Yield what tells each symbolic link on the way from one that is made in its place later."""
    while os.path.islink(path):
        link = os.lstat(path)
        yield link.st_dev, link.st_ino, link.st_ctime_ns
        path = os.path.join(os.path.dirname(path), os.readlink(path))
