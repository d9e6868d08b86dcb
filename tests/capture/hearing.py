"""Conversations as hex, and decoders that hear them."""

from __future__ import annotations

import json
from pathlib import Path

from busmaster.capture.decode import Decoder
from busmaster.contract.frames import Direction, Frame
from busmaster.registry import find

HOST, NODE, UNKNOWN = Direction.HOST, Direction.NODE, Direction.UNKNOWN
VECTORS = json.loads((Path(__file__).parents[1] / "vectors" / "frames.json").read_text())
SECTIONS = {"HCP": "hcp", "HCP2": "hcp2", "Mentor": "mentor", "CT-ANSI": "mentor", "MSC": "msc", "DC104": "dc104"}
"""The vectors' sections and the protocol that speaks each."""


def vectors() -> list[tuple[str, str, bytes]]:
    """Protocol, name and bytes of every frame."""
    return [
        (protocol, frame["name"], bytes.fromhex(frame["hex"]))
        for section, protocol in SECTIONS.items()
        for frame in VECTORS[section]
    ]


def sender_of(name: str) -> Direction:
    """Whose frame a vector is, by its name."""
    return NODE if "reply" in name.lower() else HOST


def hear(protocol: str, *chunks: str, gap: float = 0.1) -> list[Frame]:
    """What a listener makes of these bytes, a millisecond apart; "|" is a silence longer than the gap."""
    decoder = Decoder(find(protocol).protocol.dialect(), gap=gap)
    frames: list[Frame] = []
    now = 0.0
    for chunk in chunks:
        if chunk == "|":
            now += 2 * gap
            frames += decoder.quiet()
        else:
            now += 0.001
            frames += decoder.feed(bytes.fromhex(chunk), now)
    return frames


def said(frames: list[Frame]) -> list[str]:
    """Who said what, in a word or two: "host 2 read 1", "node 2 1 = 5", and what is wrong in brackets."""
    lines = []
    for frame in frames:
        node = "" if frame.node is None else f" {frame.node}"
        fault = f" [{frame.fault}]" if frame.fault else ""
        lines.append(f"{frame.sender.name.lower()}{node} {frame.text}{fault}")
    return lines
