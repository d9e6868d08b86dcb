"""Ask an exchange as the arbiter does, and take the manuals' frames from the vectors."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from busmaster.contract.driver import Driver
from busmaster.contract.exchange import MORE, Exchange

VECTORS = Path(__file__).parent.parent / "vectors" / "frames.json"


def vectors(protocol: str) -> dict[str, bytes]:
    """The frames of one protocol by name."""
    return {entry["name"]: bytes.fromhex(entry["hex"]) for entry in json.loads(VECTORS.read_text())[protocol]}


def answer(exchange: Exchange[Any], *chunks: bytes) -> Any:
    """The value that these bytes bring, MORE if they bring none yet; whatever `feed` raises is raised.

    Bytes after the reply fail the test: it says so where it wants them.
    """
    ending = Driver(exchange).feed(*chunks).ending
    if ending is None:
        return MORE
    if ending.error is not None:
        raise ending.error
    assert not ending.rest
    return ending.value


def outcome(exchange: Exchange[Any], chunks: Iterable[bytes]) -> object:
    """What these bytes bring, in a form that can be compared: a value, MORE, or the kind of failure.

    A bug is raised.
    """
    ending = Driver(exchange).feed(*chunks).ending
    if ending is None:
        return MORE
    if ending.error is not None and ending.is_bug:
        raise ending.error
    return ("value", ending.value) if ending.error is None else type(ending.error)


def single_bytes(data: bytes) -> list[bytes]:
    return [data[i : i + 1] for i in range(len(data))]


def debris(*frames: bytes) -> st.SearchStrategy[list[bytes]]:
    """Chunks of whole frames, halves of them, control characters and noise: nearer to a reply than noise alone."""
    controls = [bytes([byte]) for byte in (0x02, 0x03, 0x04, 0x06, 0x15, 0x82)]
    halves = [half for frame in frames for half in (frame[: len(frame) // 2], frame[len(frame) // 2 :])]
    piece = st.one_of(st.sampled_from([*frames, *halves, *controls]), st.binary(min_size=1, max_size=4))
    return st.lists(piece, max_size=6)
