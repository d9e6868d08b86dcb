"""The one frame of WebSocket that nearly all are: a whole text. The library knows the others, and takes five times as
long for this one, at either end of each request.
"""

from __future__ import annotations

import os

TEXT = 0x81
"""The first byte of a message of text in one piece."""
MASKED = 0x80
SHORT, LONG = 126, 127


def frame_size(data: bytearray) -> int:
    """Return how many bytes the frame that begins so has, or how many it takes to tell."""
    if len(data) < 2:
        return 2
    length = data[1] & ~MASKED
    head = 6 if data[1] & MASKED else 2
    if length < SHORT:
        return head + length
    wide = 4 if length == SHORT else 10
    return head + wide - 2 + int.from_bytes(data[2:wide], "big") if len(data) >= wide else wide


def is_whole_text(frame: bytes | bytearray, masked: bool) -> bool:
    """Return whether a frame is a whole text, masked or not as its sender is to do."""
    return frame[0] == TEXT and (frame[1] >= MASKED) is masked


def payload(frame: bytes) -> bytes:
    """Return what is in a frame."""
    length = frame[1] & ~MASKED
    begin = 2 if length < SHORT else 4 if length == SHORT else 10
    return frame[begin:] if frame[1] < MASKED else mask(frame[begin + 4 :], frame[begin : begin + 4])


def text_frame(data: bytes, masked: bool) -> bytes:
    """Return the frame of a text."""
    length, flag = len(data), MASKED if masked else 0
    if length < SHORT:
        head = bytes((TEXT, flag | length))
    elif length < 1 << 16:
        head = bytes((TEXT, flag | SHORT)) + length.to_bytes(2, "big")
    else:
        head = bytes((TEXT, flag | LONG)) + length.to_bytes(8, "big")
    if not masked:
        return head + data
    key = os.urandom(4)
    return head + key + mask(data, key)


def mask(data: bytes, key: bytes) -> bytes:
    """Return data with a mask put on, or taken off."""
    length = len(data)
    keys = (key * (length // 4 + 1))[:length]
    return (int.from_bytes(data, "little") ^ int.from_bytes(keys, "little")).to_bytes(length, "little")
