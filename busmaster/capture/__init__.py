"""Captures: recording the traffic of a line, reading it back, and decoding it without a master."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from busmaster.capture.decode import DEFAULT_GAP, Decoder
    from busmaster.capture.files import COUNT, SIZE
    from busmaster.capture.pcapng import CaptureError, CutOff, Packet, read_packets
    from busmaster.capture.recorder import Recorder
    from busmaster.capture.replay import Replayed, replay_packets
    from busmaster.contract.frames import Direction, Frame, Kind

__all__ = [
    "COUNT",
    "DEFAULT_GAP",
    "DISSECTOR",
    "SIZE",
    "CaptureError",
    "CutOff",
    "Decoder",
    "Direction",
    "Frame",
    "Kind",
    "Packet",
    "Recorder",
    "Replayed",
    "read_packets",
    "replay_packets",
]

DISSECTOR = Path(__file__).parent / "dissectors" / "busmaster.lua"
"""The Wireshark dissector for busmaster captures: `tshark -X lua_script:DISSECTOR -r FILE`."""

_ON_DEMAND = {
    "COUNT": "busmaster.capture.files",
    "CaptureError": "busmaster.capture.pcapng",
    "CutOff": "busmaster.capture.pcapng",
    "DEFAULT_GAP": "busmaster.capture.decode",
    "Decoder": "busmaster.capture.decode",
    "Direction": "busmaster.contract.frames",
    "Frame": "busmaster.contract.frames",
    "Kind": "busmaster.contract.frames",
    "Packet": "busmaster.capture.pcapng",
    "Recorder": "busmaster.capture.recorder",
    "Replayed": "busmaster.capture.replay",
    "SIZE": "busmaster.capture.files",
    "read_packets": "busmaster.capture.pcapng",
    "replay_packets": "busmaster.capture.replay",
}
"""The module of each public name, imported when the name is first used."""


def __getattr__(name: str) -> object:
    """Import the module of a public name when the name is first used."""
    if name in _ON_DEMAND:
        return getattr(import_module(_ON_DEMAND[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
