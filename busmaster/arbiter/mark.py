"""What a UART says of a byte."""

from __future__ import annotations

import enum


class Mark(enum.Enum):
    """What the UART says of a byte that it received."""

    DAMAGED = "parity or framing error"
    BREAK = "break"
