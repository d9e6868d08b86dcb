"""A passive decoder: what passes on a line, cut into frames and put into words.

It hears both directions, mixed, and mostly does not know who speaks; so it is not the master's reader. Frames are cut
by position: any byte may be a check. Silence ends a frame only to give it up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from busmaster.capture.frames import Direction, Frame, Kind
from busmaster.contract.exchange import Command

LONGEST_FRAME = 250
DEFAULT_GAP = 0.1
"""Seconds of silence that end an unfinished frame: longer than any adapter's batching, shorter than a retry."""


class Dialect(Protocol):
    """How one protocol's frames are cut and read, and who may have sent them. It remembers what was asked last."""

    starts: bytes
    """The bytes that can begin a frame."""

    def size(self, data: bytes, sender: Direction, /, *, quiet: bool = False) -> int:
        """Return the length of the frame that `data`, never empty, begins with.

        A length of 0 says that the frame is not whole yet; one below 0 that so many bytes are no frame. With `quiet`
        nothing more follows, and the length is never 0.
        """
        ...

    def explain(self, raw: bytes, sender: Direction, /) -> Frame:
        """Return what a whole frame says.

        A `sender` that is UNKNOWN is inferred from the frame and what was asked before.
        """
        ...

    def command(self, request: Frame, continued: Sequence[Frame], /) -> Command[Any]:
        """Return the command that a request speaks, with what the host said in the midst of the same exchange.

        Raises InvalidCommand, ValueError or KeyError for a request that no command would send.
        """
        ...


class Decoder:
    """Bytes and their times in, frames out. `gap`: seconds of silence that end an unfinished frame."""

    def __init__(self, dialect: Dialect, *, gap: float = DEFAULT_GAP) -> None:
        self._dialect = dialect
        self._gap = gap
        self._buffer = bytearray()
        self._rejected = bytearray()
        self._rejected_at = 0.0
        self._rejected_joined = False
        self._joined = False
        """What is in the buffer came in one piece with what was before it."""
        self._started = 0.0
        self._heard = 0.0
        self._spoken = 0.0
        self._sender = Direction.UNKNOWN

    def feed(self, data: bytes, now: float, sender: Direction = Direction.UNKNOWN) -> list[Frame]:
        """Take the next bytes, heard at `now` in seconds. A change of a known `sender` ends an unfinished frame."""
        frames = self.quiet() if now - self._heard > self._gap or sender is not self._sender else []
        if not self._buffer:
            self._started = now
            self._joined = False
        self._buffer += data
        self._heard = now
        self._sender = sender
        self._cut(frames)
        return frames

    def quiet(self) -> list[Frame]:
        """End what is unfinished here: the line was silent for the gap, or somebody else began to speak."""
        frames: list[Frame] = []
        self._cut(frames, quiet=True)
        self._flush(frames)
        return frames

    @property
    def unfinished(self) -> bool:
        """Return whether something waits for more bytes, or for silence."""
        return bool(self._buffer or self._rejected)

    def _cut(self, frames: list[Frame], *, quiet: bool = False) -> None:
        while self._buffer:
            size = self._dialect.size(bytes(self._buffer), self._sender, quiet=quiet)
            if size == 0:
                return
            raw = bytes(self._buffer[: abs(size)])
            del self._buffer[: abs(size)]
            if size < 0:
                self._reject(raw, frames)
            else:
                self._flush(frames)
                frames.append(self._timed(self._dialect.explain(raw, self._sender)))
            self._started = self._heard
            self._joined = bool(self._buffer)

    def _timed(self, frame: Frame) -> Frame:
        frame.time = self._started
        frame.ended = self._heard
        frame.joined = self._joined
        if frame.answers:
            frame.delay = self._started - self._spoken
        if frame.sender is Direction.HOST or frame.answers:
            self._spoken = self._heard
        return frame

    def _reject(self, raw: bytes, frames: list[Frame]) -> None:
        if len(self._rejected) + len(raw) > LONGEST_FRAME:
            self._flush(frames)
        if not self._rejected:
            self._rejected_at = self._started
            self._rejected_joined = self._joined
        self._rejected += raw

    def _flush(self, frames: list[Frame]) -> None:
        """Make one frame of its own of what could not be read."""
        if not self._rejected:
            return
        raw = bytes(self._rejected)
        self._rejected.clear()
        fault = f"cut short after {len(raw)} bytes" if raw[0] in self._dialect.starts and len(raw) > 1 else "no frame"
        frames.append(
            Frame(
                Kind.NOISE,
                self._sender,
                raw,
                fault=fault,
                joined=self._rejected_joined,
                time=self._rejected_at,
                ended=self._heard,
            )
        )


__all__ = [
    "DEFAULT_GAP",
    "LONGEST_FRAME",
    "Decoder",
    "Dialect",
]
