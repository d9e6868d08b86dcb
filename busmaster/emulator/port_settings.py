"""What the other end of a pseudo-terminal is set to, as far as the kernel tells it.

It tells the rate, and whether odd parity is meant. Data bits and whether there is a parity at all it takes out of the
settings of every pseudo-terminal: these are taken to be the line's.
"""

from __future__ import annotations

import contextlib
import fcntl
import struct
import termios
from dataclasses import replace

from busmaster.contract.profile import LineSettings

GET, SET = 0x802C542A, 0x402C542B
"""TCGETS2 and TCSETS2, as most of Linux' machines number them: they tell any rate, termios the usual ones alone."""
TERMIOS2 = struct.Struct("4I20s2I")
CONTROL, RATES = 2, slice(5, 7)
"""Of TERMIOS2: the control flags, and the rates of hearing and of saying."""
OTHER_RATE = 0o10000
"""BOTHER: the rates are as they stand, not one of the codes."""


def words(descriptor: int) -> bytes:
    """Return how a terminal is set, to be compared; nothing where the kernel does not tell it."""
    try:
        return fcntl.ioctl(descriptor, GET, bytes(TERMIOS2.size))
    except OSError:
        return b""


def set_rate(descriptor: int, baudrate: int) -> None:
    """Set a terminal's rate, where the kernel lets it be set."""
    with contextlib.suppress(OSError):
        said = list(TERMIOS2.unpack(words(descriptor) or bytes(TERMIOS2.size)))
        said[CONTROL] = said[CONTROL] & ~termios.CBAUD | OTHER_RATE
        said[RATES] = [baudrate, baudrate]
        fcntl.ioctl(descriptor, SET, TERMIOS2.pack(*said))


def differing(terminal: bytes, line: LineSettings) -> LineSettings | None:
    """Return how a terminal with these words is set, None where that is as the line is, or nobody knows."""
    if len(terminal) != TERMIOS2.size:
        return None
    said = TERMIOS2.unpack(terminal)
    odd = bool(said[CONTROL] & termios.PARODD)
    parity = "O" if odd else "N" if line.parity == "O" else line.parity
    port = replace(line, baudrate=said[RATES][-1] or line.baudrate, parity=parity)
    return None if port == line else port


def mismatch_text(port: LineSettings, line: LineSettings) -> str:
    """Return what is wrong with a port that is set otherwise than the line, as a sentence for the user."""
    if port.baudrate != line.baudrate:
        what, wanted = f"{port.baudrate} baud", f"{line.baudrate} baud"
    else:
        what, wanted = port.framing, line.framing
    return (
        f"the other side sends with {what}, but the emulated line has {wanted}: neither can read the other. "
        f"Set the other side to {wanted}, or emulate a line with {what}"
    )


__all__ = ["differing", "mismatch_text", "set_rate", "words"]
