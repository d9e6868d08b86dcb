"""The system's data about a serial port: programs that have it open, permissions, and its driver's effect on timing.

Nothing here opens a port. Each finding comes with advice. Linux only: elsewhere there are no findings.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import os
import stat
import termios
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from busmaster import LineDown
from busmaster.ext import PROC, holders, how_to_open, identity, owning_group, serves

SLOW_LATENCY_TIMER = 2
"""Milliseconds; above that, an FTDI adapter's batching shows in every reply."""

FLAGS, BAUD_BASE = 4, 7
ASYNC_LOW_LATENCY = 1 << 13
"""Of struct serial_struct (linux/serial.h, linux/tty_flags.h): where its flags are and the rate that a UART divides by
whole numbers, and the flag that we look for."""
TIOCGRS485 = 0x542E
SER_RS485_ENABLED = 1
"""Of linux/serial.h: the flags are the first word of struct serial_rs485."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding about a port. `ok` False: it should be changed, as `advice` describes."""

    topic: str
    ok: bool
    what: str
    advice: str = ""


def inspect(name: str, *, low_latency: bool | None = None, proc: Path = PROC) -> tuple[Finding, ...]:
    """Return all findings about the port at a path, or of usb:SERIAL, without opening it. May block.

    If `low_latency` is to be set when it is opened, its latency timer is not looked at before: see `opened_latency`.
    """
    scan = identity.Scan()
    try:
        path = identity.resolve(name, scan)
    except LineDown as error:
        return (Finding("port", False, error.what, error.hint),)
    found = [_existence(path)]
    if found[0].ok:
        found += [*_name(name, path, scan), _permission(path), _holders(path, proc), *_driver(path)]
        if not low_latency:
            found += _latency(path, f"add ?low_latency=1 to the port (low_latency=True in Python), or {_by_root(path)}")
    return tuple(found)


def opened_latency(path: str) -> Iterator[Finding]:
    """Return an FTDI adapter's latency timer in a port that was opened with `low_latency`. May block."""
    yield from _latency(path, f"low_latency=1 did not shorten it; {_by_root(path)}")


def latency_timer(path: str) -> int | None:
    """Return the milliseconds for which an FTDI adapter gathers bytes before it passes them on; else None."""
    try:
        return int((_device(path) / "latency_timer").read_text())
    except (OSError, ValueError):
        return None


def low_latency(descriptor: int) -> bool | None:
    """Return whether the driver of an open port has its low-latency flag set; None if it knows no such flag."""
    settings = array.array("i", [0] * 32)  # struct serial_struct, with room to grow
    try:
        fcntl.ioctl(descriptor, termios.TIOCGSERIAL, settings)
    except OSError:
        return None
    return bool(settings[FLAGS] & ASYNC_LOW_LATENCY)


def made_rate(descriptor: int, baudrate: int) -> float | None:
    """Return the rate that the UART of an open port makes for `baudrate`; None if its driver does not report it."""
    settings = array.array("i", [0] * 32)
    try:
        fcntl.ioctl(descriptor, termios.TIOCGSERIAL, settings)
    except OSError:
        return None
    base = settings[BAUD_BASE]
    return base / max(1, round(base / baudrate)) if base > 0 else None


def rs485_mode(descriptor: int) -> bool | None:
    """Return whether the driver of an open port switches the transmitter by itself; None if it cannot."""
    settings = array.array("I", [0] * 32)  # struct serial_rs485, with room to grow
    try:
        fcntl.ioctl(descriptor, TIOCGRS485, settings)
    except OSError:
        return None
    return bool(settings[0] & SER_RS485_ENABLED)


def _existence(path: str) -> Finding:
    if not os.path.exists(path):
        if os.path.islink(path):
            return Finding("port", False, f"{path} points to {os.readlink(path)}, which is gone", "plug it in again")
        return Finding("port", False, f"{path} does not exist", "see `python -m serial.tools.list_ports`")
    status = os.stat(path)
    if not stat.S_ISCHR(status.st_mode):
        return Finding("port", False, f"{path} is not a device", "give the path of a serial port")
    subsystem = identity.entry(status.st_rdev) / "subsystem"
    if subsystem.exists() and subsystem.resolve().name != "tty":
        return Finding("port", False, f"{path} is not a serial port", "see `python -m serial.tools.list_ports`")
    return Finding("port", True, f"{path} is {os.path.realpath(path)}" if os.path.islink(path) else f"{path} exists")


def _name(name: str, path: str, scan: identity.Scan) -> Iterator[Finding]:
    """Return which USB adapter it is, and a name that stays the same."""
    with contextlib.suppress(OSError):  # it has just disappeared, which opening it will report
        device = identity.usb_device(os.stat(path).st_rdev)
        if device is None:
            return
        lasting = identity.lasting_name(device, scan)
        what = f"{path} is {identity.identify(path, scan)}"
        by_id, by_path = f"{identity.LINKS}/by-id/", f"{identity.LINKS}/by-path/"
        if name.startswith((identity.USB, by_path)) or (name.startswith(by_id) and lasting.startswith(by_id)):
            yield Finding("name", True, f"{what}, which {name} finds again")
        elif lasting:
            advice = f"name it {lasting}, because {path} can change between adapters"
            yield Finding("name", True, what, advice)
        else:
            yield Finding("name", True, what, "it has no serial number; leave it in this USB port")


def _permission(path: str) -> Finding:
    if os.access(path, os.R_OK | os.W_OK):
        return Finding("permission", True, "this user may open it")
    what = f"this user may not open it; it belongs to the group {owning_group(path)}"
    return Finding("permission", False, what, how_to_open(path))


def _holders(path: str, proc: Path) -> Finding:
    device = os.path.realpath(path)
    # The emulator of a pseudo-terminal has it open as well, but is not a second master.
    found = [str(holder) for holder in holders(path, proc=proc) if not serves(proc / str(holder.pid), device)]
    if not found:
        if os.geteuid():
            advice = "only root sees the programs of other users: `sudo busmaster doctor`"
            return Finding("holders", True, "no other program of yours has it open", advice)
        return Finding("holders", True, "no other program has it open")
    return Finding(
        "holders",
        False,
        f"open in {', '.join(found)}",
        "end it: two masters on one line garble each other (ModemManager and gpsd open ports unexpected)",
    )


def _driver(path: str) -> Iterator[Finding]:
    driver = _device(path) / "driver"
    if driver.exists():
        yield Finding("driver", True, f"its driver is {driver.resolve().name}")


def _latency(path: str, advice: str) -> Iterator[Finding]:
    """Return how long the adapter gathers bytes; `advice` is for one that gathers for too long."""
    timer = latency_timer(path)
    if timer is None:
        return
    what = f"the adapter gathers received bytes for up to {timer} ms (latency_timer)"
    if timer <= SLOW_LATENCY_TIMER:
        yield Finding("latency", True, what)
    else:
        yield Finding("latency", False, what, advice)


def _by_root(path: str) -> str:
    return f"write 1 to {_device(path) / 'latency_timer'} as root"


def _device(path: str) -> Path:
    return identity.SYS / "class/tty" / os.path.basename(os.path.realpath(path)) / "device"
