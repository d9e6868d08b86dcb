"""The settings of the other end of a pseudo-terminal, as far as the kernel reports them.

The kernel reports the rate and the flag for odd parity. It removes the data bits and the flag that enables parity from
the settings of every pseudo-terminal, so they are assumed to be those of the line.
"""

from __future__ import annotations

import contextlib
import fcntl
import struct
import termios
from dataclasses import replace

from busmaster.contract.profile import LineSettings

GET, SET = 0x802C542A, 0x402C542B
"""TCGETS2 and TCSETS2, as on most architectures of Linux. They support any rate, termios only the usual ones."""
TERMIOS2 = struct.Struct("4I20s2I")
CONTROL, RATES = 2, slice(5, 7)
"""Fields of TERMIOS2: the control flags, and the rates for input and output."""
OTHER_RATE = 0o10000
"""BOTHER: the rates are numbers, not codes."""


def words(descriptor: int) -> bytes:
    """Return the settings of a terminal, for comparison; empty if the kernel does not report them."""
    try:
        return fcntl.ioctl(descriptor, GET, bytes(TERMIOS2.size))
    except OSError:
        return b""


def set_rate(descriptor: int, baudrate: int) -> None:
    """Set a terminal's rate, if the kernel permits it."""
    with contextlib.suppress(OSError):
        attributes = list(TERMIOS2.unpack(words(descriptor) or bytes(TERMIOS2.size)))
        attributes[CONTROL] = attributes[CONTROL] & ~termios.CBAUD | OTHER_RATE
        attributes[RATES] = [baudrate, baudrate]
        fcntl.ioctl(descriptor, SET, TERMIOS2.pack(*attributes))


def differing(terminal: bytes, line: LineSettings) -> LineSettings | None:
    """Return the settings of a terminal with these words; None if they are those of the line, or unknown."""
    if len(terminal) != TERMIOS2.size:
        return None
    attributes = TERMIOS2.unpack(terminal)
    odd = bool(attributes[CONTROL] & termios.PARODD)
    parity = "O" if odd else "N" if line.parity == "O" else line.parity
    port = replace(line, baudrate=attributes[RATES][-1] or line.baudrate, parity=parity)
    return None if port == line else port


def mismatch_text(port: LineSettings, line: LineSettings) -> str:
    """Return a sentence for the user about a port whose settings differ from those of the line."""
    if port.baudrate != line.baudrate:
        what, wanted = f"{port.baudrate} baud", f"{line.baudrate} baud"
    else:
        what, wanted = port.framing, line.framing
    return (
        f"the other side sends with {what}, but the emulated line has {wanted}: neither can read the other. "
        f"Set the other side to {wanted}, or emulate a line with {what}"
    )


__all__ = ["differing", "mismatch_text", "set_rate", "words"]
