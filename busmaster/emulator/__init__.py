"""An emulated line and its devices, with bus physics. It tests what cannot be tested on real drives."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from busmaster.emulator.device import Delay, Device
    from busmaster.emulator.faults import CALM, NAMES, SECONDS, Faults
    from busmaster.emulator.line import Echo, Line
    from busmaster.emulator.serve import LineServer, serve_pty, serve_tcp

__all__ = [
    "CALM",
    "NAMES",
    "SECONDS",
    "Delay",
    "Device",
    "Echo",
    "Faults",
    "Line",
    "LineServer",
    "serve_pty",
    "serve_tcp",
]

_ON_DEMAND = {
    "CALM": "busmaster.emulator.faults",
    "Delay": "busmaster.emulator.device",
    "Device": "busmaster.emulator.device",
    "Echo": "busmaster.emulator.line",
    "Faults": "busmaster.emulator.faults",
    "Line": "busmaster.emulator.line",
    "LineServer": "busmaster.emulator.serve",
    "NAMES": "busmaster.emulator.faults",
    "SECONDS": "busmaster.emulator.faults",
    "serve_pty": "busmaster.emulator.serve",
    "serve_tcp": "busmaster.emulator.serve",
}
"""The module of each public name, imported when the name is first used."""


def __getattr__(name: str) -> object:
    """Import the module of a public name when the name is first used."""
    if name in _ON_DEMAND:
        return getattr(import_module(_ON_DEMAND[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
