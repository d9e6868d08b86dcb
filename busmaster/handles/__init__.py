"""The awaitable per-node handles, and by what name the command line and LINE.toml know them."""

from __future__ import annotations

from busmaster.handles.base import Handle
from busmaster.handles.hcp import HcpController
from busmaster.handles.hcp2 import Hcp2Controller
from busmaster.handles.microflex import MicroFlexDrive

HANDLES: dict[str, type[Handle]] = {
    "hcp": HcpController,
    "hcp2": Hcp2Controller,
    "microflex": MicroFlexDrive,
}
"""`--protocol P` -> the handle that speaks it."""

__all__ = ["HANDLES", "Handle", "Hcp2Controller", "HcpController", "MicroFlexDrive"]
