"""What a UART found wrong, in words: for the doctor, and for the summary at the end of a watch."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

from busmaster.app.diagnostics.adapters import Finding
from busmaster.ext import DriverErrors

UART_ERRORS = {
    "framing": ("framing error", "wrong baud rate, or no termination; then missing biasing, swapped wires A and B"),
    "parity": ("parity error", "wrong parity or number of data bits; then noise: termination, shield, common ground"),
    "damaged": ("parity or framing error", "wrong baud rate or parity, or no termination"),
    "breaks": (
        "break",
        "swapped wires A and B, a loose contact, missing biasing, or a far slower sender",
    ),
    "overruns": (
        "byte lost in the UART",
        "this machine reads too late; use an adapter that buffers more",
    ),
    "buffer_overruns": ("byte lost in the driver", "it was not read in time; look for a load on this machine"),
}
"""The name of each counter, and advice."""


def damage(damaged: int, breaks: int, driver: DriverErrors | None) -> dict[str, int]:
    """Return the errors by the keys of UART_ERRORS: the driver's counts if it has any, else the marks."""
    counts = {} if driver is None else {name: getattr(driver, name) for name in UART_ERRORS if name != "damaged"}
    if not any(counts.values()):
        counts = {"damaged": damaged, "breaks": breaks}
    return {name: count for name, count in counts.items() if count}


def damage_text(counts: Mapping[str, int]) -> str:
    """Return the errors in a few words; empty if there are none."""
    return ", ".join(counted(count, UART_ERRORS[name][0]) for name, count in counts.items())


def findings(damaged: int, breaks: int, driver: DriverErrors | None) -> Iterator[Finding]:
    """Return the errors of the UART during the requests. Nothing is returned for a port that cannot report them."""
    counts = damage(damaged, breaks, driver)
    if driver is not None and not counts:
        yield Finding("uart", True, "no byte was damaged or lost")
    for name, count in counts.items():
        what, advice = UART_ERRORS[name]
        yield Finding("uart", False, counted(count, what), advice)


def counted(count: int, what: str) -> str:
    """Return a count in words: `1 break`, `2 bytes lost in the UART`."""
    first, space, rest = what.partition(" lost")
    return f"{count} {what}" if count == 1 else f"{count} {first}s{space}{rest}"
