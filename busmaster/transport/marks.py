"""Damaged bytes: how a tty is made to mark them, and how its marks are told from data.

With INPCK and PARMRK set, a tty says `FF 00 x` for a byte x with a parity or framing error, `FF 00 00` for a break, and
doubles every sound byte FF, so that nothing else begins with `FF 00`.
"""

from __future__ import annotations

import asyncio
import contextlib
import termios
from collections.abc import Callable

import serial

from busmaster.arbiter.counters import Mark

ESCAPE = 0xFF
_INPUT_FLAGS = termios.INPCK | termios.PARMRK
"""All that is set: whatever drops, changes or answers a byte (IGNPAR, IGNBRK, BRKINT, ISTRIP, INLCR, IXON, IMAXBEL ...)
is cleared, whoever has left it set."""

MarkedByte = Callable[[bytes, Mark], None]


class MarkingSerial(serial.Serial):
    """pyserial's port, made to mark its errors again whenever it configures itself, which clears the flags for that."""

    marks = False
    """Whether errors are marked: not every driver does it."""

    def _reconfigure_port(self, force_update: bool = False) -> None:
        super()._reconfigure_port(force_update)  # type: ignore[misc]  # its types leave it out
        assert self.fd is not None
        self.marks = mark_errors(self.fd)


def mark_errors(descriptor: int) -> bool:
    """Have the tty mark damaged bytes and pass all others unchanged. Return False where it refuses to mark."""
    settings = termios.tcgetattr(descriptor)
    settings[0] = _INPUT_FLAGS
    with contextlib.suppress(termios.error):
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    # Asked, since a driver may leave out a flag without an error.
    return bool(termios.tcgetattr(descriptor)[0] & termios.PARMRK)


def stop_marking(descriptor: int) -> None:
    """Leave the tty as a program that knows no marks expects it: some drivers keep its flags when it is closed."""
    with contextlib.suppress(termios.error):
        settings = termios.tcgetattr(descriptor)
        settings[0] &= ~_INPUT_FLAGS
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def taker_of_marked_bytes(protocol: asyncio.Protocol) -> MarkedByte:
    """Return the protocol's own `byte_marked(byte, mark)`; a protocol without it takes a damaged byte for data."""
    own: MarkedByte | None = getattr(protocol, "byte_marked", None)
    return own if own is not None else lambda byte, _: protocol.data_received(byte)


class Unescape:
    """Tells marks from data in what a marking tty says. An escape may be split over any number of reads."""

    def __init__(self) -> None:
        self.begun = b""
        """The beginning of an escape, the rest of which has not come yet."""

    def take(self, data: bytes) -> list[tuple[bytes, Mark | None]]:
        """Return what this read adds, in order: sound bytes with None, each damaged byte alone with its mark."""
        data = self.begun + data
        self.begun = b""
        pieces: list[tuple[bytes, Mark | None]] = []
        sound = bytearray()
        at = 0
        while (escape := data.find(ESCAPE, at)) >= 0:
            sound += data[at:escape]
            behind = data[escape + 1 : escape + 3]
            if behind in (b"", b"\0"):
                self.begun = data[escape:]
                at = len(data)
            elif behind[0] == 0:
                if sound:
                    pieces.append((bytes(sound), None))
                    sound.clear()
                pieces.append((behind[1:], Mark.DAMAGED if behind[1] else Mark.BREAK))
                at = escape + 3
            else:  # a byte FF: one without its double is one too, where somebody has cleared PARMRK behind our back
                sound.append(ESCAPE)
                at = escape + (2 if behind[0] == ESCAPE else 1)
        sound += data[at:]
        if sound:
            pieces.append((bytes(sound), None))
        return pieces
