"""The awaitable per-node handles, and by what name the command line and LINE.toml know them."""

from __future__ import annotations

from busmaster.handles.base import Handle
from busmaster.handles.dc104 import Dc104Drive
from busmaster.handles.hcp import HcpController
from busmaster.handles.hcp2 import Hcp2Controller
from busmaster.handles.mentor import MentorDrive
from busmaster.handles.microflex import MicroFlexDrive
from busmaster.handles.msc import MscController

HANDLES: dict[str, type[Handle]] = {
    "hcp": HcpController,
    "hcp2": Hcp2Controller,
    "microflex": MicroFlexDrive,
    "msc": MscController,
    "mentor": MentorDrive,
    "dc104": Dc104Drive,
}
"""`--protocol P` -> the handle that speaks it."""

__all__ = [
    "HANDLES",
    "Dc104Drive",
    "Handle",
    "Hcp2Controller",
    "HcpController",
    "MentorDrive",
    "MicroFlexDrive",
    "MscController",
]
