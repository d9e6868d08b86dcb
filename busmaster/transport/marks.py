"""Damaged bytes: how a tty marks them, and how the marks are separated from data.

With INPCK and PARMRK set, a tty delivers `FF 00 x` for a byte x with a parity or framing error, and `FF 00 00` for a
break. It doubles each valid byte FF, so that no data begins with `FF 00`.
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
"""The only flags that are set. All flags that drop, change or answer bytes (IGNPAR, IGNBRK, BRKINT, ISTRIP, INLCR,
IXON, IMAXBEL ...) are cleared, whichever program has set them."""

MarkedByte = Callable[[bytes, Mark], None]


class MarkingSerial(serial.Serial):
    """pyserial's port, which marks errors again after each configuration: that clears the flags."""

    marks = False
    """True if errors are marked. Some drivers do not support it."""

    def _reconfigure_port(self, force_update: bool = False) -> None:
        super()._reconfigure_port(force_update)  # type: ignore[misc]  # its types leave it out
        assert self.fd is not None
        self.marks = mark_errors(self.fd)


def mark_errors(descriptor: int) -> bool:
    """Make the tty mark damaged bytes and pass all others unchanged. Returns False if it does not support marks."""
    settings = termios.tcgetattr(descriptor)
    # Assigned, not added: a flag left by another program, such as ICRNL, would change bytes of telegrams.
    settings[0] = _INPUT_FLAGS
    with contextlib.suppress(termios.error):
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)
    # Read back, because a driver may ignore a flag without an error.
    return bool(termios.tcgetattr(descriptor)[0] & termios.PARMRK)


def stop_marking(descriptor: int) -> None:
    """Restore the flags for programs that do not expect marks: some drivers keep them after a close."""
    with contextlib.suppress(termios.error):
        settings = termios.tcgetattr(descriptor)
        settings[0] &= ~_INPUT_FLAGS
        termios.tcsetattr(descriptor, termios.TCSANOW, settings)


def taker_of_marked_bytes(protocol: asyncio.Protocol) -> MarkedByte:
    """Return the protocol's `byte_marked(byte, mark)`. A protocol without it gets a damaged byte as data."""
    own: MarkedByte | None = getattr(protocol, "byte_marked", None)
    return own if own is not None else lambda byte, _: protocol.data_received(byte)


class Unescape:
    """Separates marks from data. An escape may be split over any number of reads."""

    def __init__(self) -> None:
        self.begun = b""
        """An incomplete escape."""

    def take(self, data: bytes) -> list[tuple[bytes, Mark | None]]:
        """Return the pieces of this read in order: valid bytes with None, each damaged byte separately with its
        mark."""
        data = self.begun + data
        self.begun = b""
        pieces: list[tuple[bytes, Mark | None]] = []
        sound = bytearray()
        at = 0
        while (escape := data.find(ESCAPE, at)) >= 0:
            sound += data[at:escape]
            # The two bytes that decide: FF is a data byte FF; 00 and a byte is a mark; less is not decided yet.
            behind = data[escape + 1 : escape + 3]
            if behind in (b"", b"\0"):
                self.begun = data[escape:]
                at = len(data)
            elif behind[0] == 0:
                if sound:
                    pieces.append((bytes(sound), None))
                    sound.clear()
                # A damaged byte 00 has the same mark as a break: `Tty.is_break` distinguishes them.
                pieces.append((behind[1:], Mark.DAMAGED if behind[1] else Mark.BREAK))
                at = escape + 3
            else:  # a byte FF, also without its double: another program may have cleared PARMRK in the meantime
                sound.append(ESCAPE)
                at = escape + (2 if behind[0] == ESCAPE else 1)
        sound += data[at:]
        if sound:
            pieces.append((bytes(sound), None))
        return pieces
