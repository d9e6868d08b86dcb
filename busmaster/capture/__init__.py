"""Seeing the wire: recording what passes on a line, reading it back, and decoding it without a master."""

from __future__ import annotations

from pathlib import Path

DISSECTOR = Path(__file__).parent.parent / "dissectors" / "busmaster.lua"
"""The Wireshark dissector for captures of ours: `tshark -X lua_script:DISSECTOR -r FILE`."""
